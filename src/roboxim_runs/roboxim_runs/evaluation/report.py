"""Record and report of an evaluation.

The report is imported where it is needed: the import takes seconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from roboxim_core.config import from_plain, to_plain
from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_core.errors import ConfigError, listed
from roboxim_core.plain_data.documents import read_json_object
from roboxim_core.plain_data.results_log import RESULTS_FILE
from roboxim_core.whole_files import write_json
from roboxim_eval.film_options import FilmOptions
from roboxim_runs.episodes.run import EpisodesJob
from roboxim_runs.evaluation.results import EvaluationResult, PolicyResult
from roboxim_runs.evaluation.shown import shown_runs, with_bags
from roboxim_runs.policies.specs import ChosenPolicy
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.storage.store import readable_run

RECORD_FILE = "evaluation.json"
"""File beside a report, by which `roboxim merge` writes it again."""
REPORT_FILE = "report.html"
"""The report's file."""
UNTRAINED = ("expert", "random", "zero", "replay")
"""Policies that are no checkpoint of a training."""


@dataclass(frozen=True, kw_only=True)
class EvaluationRecord:
    """What a report says about an evaluation and its episodes do not; stored as `RECORD_FILE` beside it."""

    task: str
    """Name of the task."""
    seed: int
    """Seed of the run."""
    policies: tuple[str, ...]
    """Names of the policies, the one under test first; each has a run in a subfolder of its name."""
    facts: Mapping[str, str] = field(default_factory=dict)
    """Options and files of the policies."""
    command: str = ""
    """Command that reproduces the evaluation."""
    stopped: str = ""
    """How the number of episodes was decided; empty: it was fixed beforehand."""
    undecided: bool = False
    """Whether planned looks at the results have not decided; then no policy is called better."""
    trained: tuple[str, ...] | None = None
    """Policies that are checkpoints of a training; none: an earlier version did not say; then their facts do."""
    warnings: tuple[str, ...] = ()
    """What weakens the results, a sentence each."""
    film: FilmOptions = FilmOptions()
    """Which films the report shows. Each shown episode has its own page."""

    def is_trained(self, policy: str) -> bool:
        """Return whether a policy is a checkpoint of a training."""
        if self.trained is not None:
            return policy in self.trained
        return self.facts.get(f"policy {policy}", "").partition(",")[0] not in UNTRAINED


def stored_record(out: Path) -> EvaluationRecord:
    """Return the record in an evaluation's folder.

    Raises:
        ConfigError: When the folder has none, or it is damaged.
    """
    file = out / RECORD_FILE
    if out.is_dir() and not file.exists():
        raise ConfigError(f"{out} is not an evaluation's folder: there is no {file}{inside(out)}")
    return from_plain(read_json_object(file), EvaluationRecord, source=str(file))


def inside(folder: Path) -> str:
    """Return which evaluations and runs a folder holds, as the end of an error; empty: none."""
    found = sorted(
        {
            file.parent
            for name in (RECORD_FILE, RESULTS_FILE)
            for depth in ("*", "*/*")
            for file in folder.glob(f"{depth}/{name}")
        }
    )
    return f"; in it are {', '.join(map(str, found[:4]))}{' and others' * (len(found) > 4)}" if found else ""


def report_of(out: Path, record: EvaluationRecord | None = None, *, page: bool = True) -> EvaluationResult:
    """Write the report of the finished episodes in an evaluation's folder.

    Args:
        out: The evaluation's folder, with a run for each policy.
        record: What the report says about the evaluation; none: as stored in the folder.
        page: Whether to write its page, or only the record.

    Raises:
        ConfigError: When the folder has no record, or its files are damaged.
        RecorderError: With code ``BAG_DAMAGED`` when a bag that the page shows is not whole.
    """
    record = record or stored_record(out)
    found = {
        name: PolicyResult(name=name, results=tuple(RunFolder(out / name).results()), folder=out / name)
        for name in record.policies
    }
    return write_evaluation(record, found, out, page=page)


def policy_facts(chosen: Sequence[ChosenPolicy], jobs: Mapping[str, EpisodesJob]) -> dict[str, str]:
    """Return each policy's options and files, for the report."""
    facts = {}
    for policy in chosen:
        files = (f"{file} {digest[:16]}" for file, digest in jobs[policy.name].policy_files.items())
        server = jobs[policy.name].server.get("server", {})
        remote = [
            f"version {policy.options.get('version')}", f"convention {server['convention']['name']}",
            str(policy.options.get("url")),
        ] if server else []  # fmt: skip
        facts[f"policy {policy.name}"] = ", ".join([policy.spec, *remote, *files])
    return facts


def write_evaluation(
    record: EvaluationRecord, found: Mapping[str, PolicyResult], out: Path, *, page: bool
) -> EvaluationResult:  # fmt: skip
    """Write the record of an evaluation and, if asked for, its page.

    Args:
        record: What the report says about the evaluation.
        found: Policy to result, the policy under test first.
        out: The evaluation's folder.
        page: Whether to write the page.

    Returns:
        The evaluation's result.
    """
    from roboxim_eval.report import PolicyRun, verdict_line

    doubts = [text for result in found.values() for text in doubts_about(record, result)]
    write_json(out / RECORD_FILE, to_plain(record))
    infos = {name: info for name, result in found.items() if (info := _first_info(result)) is not None}
    runs = [
        PolicyRun(policy=name, results=result.results, trained=record.is_trained(name))
        for name, result in found.items()
    ]
    return EvaluationResult(
        policies=dict(found), report=_page(record, found, infos, doubts, out) if page else None,
        comparison=verdict_line(runs, undecided=record.undecided),
        privileged=tuple(n for n, info in infos.items() if info.actor_privileged), doubts=tuple(doubts),
    )  # fmt: skip


def doubts_about(record: EvaluationRecord, result: PolicyResult) -> list[str]:
    """Return what keeps a policy's results from being relied upon; a run that was stopped early is whole."""
    return [] if record.stopped else RunFolder(result.folder).doubts()


def _page(
    record: EvaluationRecord, found: Mapping[str, PolicyResult], infos: Mapping[str, EpisodeInfo],
    doubts: Sequence[str], out: Path,
) -> Path:  # fmt: skip
    """Write the page and return its file."""
    from roboxim_eval.report import Report, write_report

    facts = {"task": record.task, "run seed": str(record.seed), "purpose": "eval"}
    facts |= {"episodes": str(len(next(iter(found.values())).results)), **record.facts}
    versions: dict[str, str] = {}
    for name, result in found.items():
        facts[f"timing of {name}"] = timing_line(result.results)
        if name not in infos:
            continue
        info = infos[name]
        facts |= {
            "robot": info.scene.robot.model, "renderer": info.renderer,
            "control rate": f"{info.semantics.rate_hz:g} Hz",
        }  # fmt: skip
        facts |= {f"camera {camera.name}": f"{camera.width} x {camera.height}" for camera in info.scene.cameras}
        versions |= info.versions | {f"model {model}": digest for model, digest in info.models.items()}
        if info.actor_version:
            versions[f"policy {name}"] = info.actor_version
        if info.actor_privileged:
            facts[f"policy {name} is privileged"] = "it sees the task, scene and state"
    trained = {name for name in found if record.is_trained(name)}
    runs, place = shown_runs(found, out, film=record.film, trained=trained)
    report = Report(
        title=f"Evaluation of {listed(found)} on {record.task}", runs=runs, facts=facts, versions=versions,
        command=record.command, stopped=record.stopped, undecided=record.undecided, 
        place=place, warnings=(*record.warnings, *doubts),
    )  # fmt: skip
    return write_report(report, out)


def _first_info(result: PolicyResult) -> EpisodeInfo | None:
    """Return the episode information of a policy's first bag; none without a bag."""
    from roboxim_recorder.bag import BagReader

    first = next(iter(with_bags(result)), None)
    if first is None:
        return None
    with readable_run(result.folder, [first.bag]) as run:
        return BagReader(run / first.bag).info


def timing_line(results: Sequence[EpisodeResult]) -> str:
    """Return when a policy's answers arrived, in words."""
    acting = [result for result in results if result.steps]
    if not acting:
        return "no episode was acted"
    line, held = acting[0].timing, sum(result.held for result in acting)
    if line == "lockstep":
        return line
    delay = sum(result.delay_ticks for result in acting) / len(acting)
    return (
        f"{line}: answers arrive {delay:.1f} ticks after their observation on average; the robot held still without an "
        f"answer at {held} of {sum(result.steps for result in acting)} ticks"
    )
