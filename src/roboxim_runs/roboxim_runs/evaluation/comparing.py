"""Compares finished evaluations: their policies side by side, paired where they met the same scenes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from roboxim_core.errors import ConfigError, listed
from roboxim_core.plain_data.shell import shell_line
from roboxim_eval.film_options import FilmOptions
from roboxim_runs.evaluation.report import REPORT_FILE, doubts_about, stored_record
from roboxim_runs.evaluation.results import PolicyResult
from roboxim_runs.evaluation.shown import shown_runs
from roboxim_runs.storage.folder import RunFolder, distinct_ends


def compare_evaluations(folders: Sequence[Path], out: Path, *, film: FilmOptions | None = None) -> tuple[Path, str]:
    """Write a report with the policies of several evaluations.

    Scenes are the same where robot, objects, their places, cameras and lights are, whatever the runs' seeds.

    Args:
        folders: At least two evaluations' folders; the first one's first policy is compared with all others.
        out: Folder of the report.
        film: Which films are shown; none: those of the first evaluation.

    Returns:
        The page, and the comparison in words, after what keeps the results from being relied upon.

    Raises:
        ConfigError: When a folder is no evaluation, is given twice, or is the output.
        RecorderError: With code ``BAG_DAMAGED`` when a bag is not whole.
    """
    from roboxim_eval.report import Report, verdict_line, write_report

    if len(folders) < 2 or len({folder.resolve() for folder in folders}) < len(folders):
        raise ConfigError(f"expected at least two different evaluations, got {', '.join(map(str, folders))}")
    if out.resolve() in [folder.resolve() for folder in folders]:
        raise ConfigError(f"{out} is one of the evaluations; choose another --out, so that its report stays")
    records = {name: stored_record(folder) for name, folder in zip(distinct_ends(folders), folders, strict=True)}
    found: dict[str, PolicyResult] = {}
    trained: set[str] = set()
    warnings: list[str] = []
    for policy in dict.fromkeys(policy for record in records.values() for policy in record.policies):
        having = [
            (name, folder) for name, folder in zip(records, folders, strict=True) if policy in records[name].policies
        ]
        for name, folder in having:  # those of one name side by side: they are what a reader compares
            shown = f"{name}: {policy}" if len(having) > 1 else policy
            results = tuple(RunFolder(folder / policy).results())
            found[shown] = PolicyResult(name=shown, results=results, folder=folder / policy)
            warnings += doubts_about(records[name], found[shown])
            trained |= {shown} if records[name].is_trained(policy) else set()
    facts: dict[str, str] = {}
    for (name, record), folder in zip(records.items(), folders, strict=True):
        facts |= {f"folder {name}": str(folder), f"task of {name}": record.task, f"seed of {name}": str(record.seed)}
    out.mkdir(parents=True, exist_ok=True)
    film = film or next(iter(records.values())).film
    runs, place = shown_runs(found, out, film=film, trained=trained, by_scene=True)
    shared = set.intersection(*({run.scene(result) for result in run.results} for run in runs))
    episodes = max(len(run.results) for run in runs)
    doubts = tuple(warnings)
    if len(shared) < episodes:
        warnings.append(
            f"{len(shared)} of {episodes} scenes were met by all policies. Rates are over all episodes of each; "
            "comparisons are over the scenes that both met."
        )
    report = Report(
        title=f"{listed(records)} side by side", runs=runs, facts=facts, versions={}, place=place, warnings=warnings,
        command=shell_line("roboxim", "report", *folders, "--out", out),
    )  # fmt: skip
    write_report(report, out)
    return out / REPORT_FILE, "\n".join(filter(None, (*doubts, verdict_line(runs))))
