"""Record and report of an evaluation.

The report is imported where it is needed: the import takes seconds.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from roboxim_core.config import from_plain, to_plain
from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_core.plain_data.documents import read_json_object
from roboxim_core.whole_files import write_whole
from roboxim_eval.film_options import FilmOptions
from roboxim_runs.episodes.run import EpisodesJob
from roboxim_runs.evaluation.results import EvaluationResult, PolicyResult
from roboxim_runs.policies.specs import ChosenPolicy
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.storage.store import readable_run

if TYPE_CHECKING:
    from roboxim_eval.report import PolicyRun
    from roboxim_eval.report.charts.table_map import Place
    from roboxim_runs.episodes.facts import EpisodeFacts

RECORD_FILE = "evaluation.json"
"""File beside a report, by which `roboxim merge` writes it again."""
MOST_OTHERS = 2
"""Largest number of episodes of others in an episode's page."""
REPORT_FILE = "report.html"
"""The report's file."""
PAGES = "pages"
"""Folder beside a report with the pages of the episodes that it shows, in a folder for each policy."""
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
    """Policies that are checkpoints of a training; none: an earlier version did not say, so all."""
    film: FilmOptions = FilmOptions()
    """Which films the report shows. Each shown episode has a page of its own."""


def stored_record(out: Path) -> EvaluationRecord:
    """Return the record in an evaluation's folder.

    Raises:
        ConfigError: When the folder has none, or it is damaged.
    """
    file = out / RECORD_FILE
    return from_plain(read_json_object(file), EvaluationRecord, source=str(file))


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

    write_whole(out / RECORD_FILE, json.dumps(to_plain(record), indent=2) + "\n")
    infos = {name: info for name, result in found.items() if (info := _first_info(result)) is not None}
    runs = [
        PolicyRun(policy=name, results=result.results, trained=record.trained is None or name in record.trained)
        for name, result in found.items()
    ]
    return EvaluationResult(
        policies=dict(found), report=_page(record, found, infos, out) if page else None,
        comparison=verdict_line(runs, undecided=record.undecided),
        privileged=tuple(n for n, info in infos.items() if info.actor_privileged),
    )  # fmt: skip


def _page(
    record: EvaluationRecord, found: Mapping[str, PolicyResult], infos: Mapping[str, EpisodeInfo], out: Path
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
    runs, places = evaluated_runs(record, found, out)
    report = Report(
        title=f"Evaluation of {' and '.join(found)} on {record.task}", runs=runs, facts=facts, versions=versions,
        command=record.command, stopped=record.stopped, undecided=record.undecided, 
        place=places.pop() if len(places) == 1 else None,
    )  # fmt: skip
    return write_report(report, out)


def evaluated_runs(
    record: EvaluationRecord, found: Mapping[str, PolicyResult], out: Path
) -> tuple[list[PolicyRun], set[Place]]:  # fmt: skip
    """Return the policies with what their bags say, and where robots and tables are; write the pages of shown episodes.

    Args:
        record: What the report says about the evaluation.
        found: Policy to result.
        out: The report's folder.
    """
    from roboxim_eval.report.charts.table_map import Place
    from roboxim_eval.report.films import chosen_scenes
    from roboxim_runs.episodes.facts import episode_facts

    with contextlib.ExitStack() as stack:
        whole = {name: _with_bags(result) for name, result in found.items()}
        bags = {
            name: stack.enter_context(readable_run(found[name].folder, [episode.bag for episode in episodes]))
            for name, episodes in whole.items()
        }
        outcomes: dict[str, list[str]] = {}
        for episodes in whole.values():
            for episode in episodes:
                outcomes.setdefault(str(episode.index), []).append(episode.outcome)
        scenes = set(chosen_scenes(outcomes, record.film.scenes))
        shown = {
            name: {e.index: bags[name] / e.bag for e in episodes if str(e.index) in scenes}
            for name, episodes in whole.items()
        }
        runs, places = [], set()
        for name, result in found.items():
            facts = episode_facts(result.folder, result.results, bags=bags[name])
            places |= {Place(robot=one.robot, table=one.table) for one in facts.values() if one.scene}
            runs.append(_policy_run(record, result, facts, shown, out))
    return runs, places


def _policy_run(
    record: EvaluationRecord, result: PolicyResult, facts: Mapping[str, EpisodeFacts],
    shown: Mapping[str, Mapping[int, Path]], out: Path,
) -> PolicyRun:  # fmt: skip
    """Return a policy with films, and write the pages of its shown episodes.

    Args:
        record: What the report says about the evaluation.
        result: The policy's results.
        facts: What its bags say.
        shown: Policy to index and bag of the shown episodes.
        out: The report's folder.
    """
    from roboxim_eval.report import PolicyRun
    from roboxim_eval.report.episode import episode_page
    from roboxim_runs.episodes.showing import Other, films_of, shown_episode

    name, films, pages = result.name, {}, {}
    for episode in result.results:
        bag = shown[name].get(episode.index)
        if bag is None:
            continue
        if both := films_of(bag, record.film):
            films[episode.episode_id] = both[0]
        others = [
            Other(name=other, bag=bags[episode.index], link=f"../{other}/{bags[episode.index].name}.html")
            for other, bags in shown.items() if other != name and episode.index in bags
        ]  # fmt: skip
        pages[episode.episode_id] = f"{PAGES}/{name}/{episode.episode_id}.html"
        there = os.path.relpath(result.folder / episode.bag, out)
        page = shown_episode(
            bag, others=others[:MOST_OTHERS], shown_as=there, films=record.film, name=name, run=result.folder
        )
        (out / PAGES / name).mkdir(parents=True, exist_ok=True)
        write_whole(out / pages[episode.episode_id], episode_page(page))
    return PolicyRun(
        policy=name, results=result.results, folder=Path(os.path.relpath(result.folder, out)).as_posix(), films=films,
        pages=pages, trained=record.trained is None or name in record.trained,
        drawn={key: one.drawn for key, one in facts.items()},
        starts={key: one.start for key, one in facts.items() if one.start is not None},
        told={key: one.told for key, one in facts.items() if one.told},
    )  # fmt: skip


def _first_info(result: PolicyResult) -> EpisodeInfo | None:
    """Return the episode information of a policy's first bag; none without a bag."""
    from roboxim_recorder.bag import BagReader

    first = next(iter(_with_bags(result)), None)
    if first is None:
        return None
    with readable_run(result.folder, [first.bag]) as run:
        return BagReader(run / first.bag).info


def _with_bags(result: PolicyResult) -> list[EpisodeResult]:
    """Return the episodes whose bags are in the folder or in its store; an unpacked run has none."""
    recorded = [episode for episode in result.results if episode.bag]
    gone = {episode.bag for episode in RunFolder(result.folder).without_bag(recorded)}
    return [episode for episode in recorded if episode.bag not in gone]


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
