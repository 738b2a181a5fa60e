"""The report of an evaluation: policies on the same scenes, with rates, comparisons and descriptions of failures.

The input is plain values: results, and facts that the caller has read from bags.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from roboxim_core.episode import EpisodeResult
from roboxim_core.seeds import CELL, CELL_NUMBER
from roboxim_eval.experiments.cells import named_cell
from roboxim_eval.grouping import grouped
from roboxim_eval.report.charts.heat_map import HeatMap, arm_maps
from roboxim_eval.report.charts.table_map import Place
from roboxim_eval.report.course import shown
from roboxim_eval.report.episodes import Episode, any_of, episodes_json, episodes_link, recorded_factors
from roboxim_eval.report.films import Film
from roboxim_eval.report.page import render
from roboxim_eval.report.parts import (
    breakdowns,
    failure_rows,
    film_groups,
    films_shown,
    map_view,
    scene_patterns,
)
from roboxim_eval.statistics.beside import beside_success
from roboxim_eval.statistics.multiple import holm
from roboxim_eval.statistics.paired import Pairs, newcombe, paired_difference
from roboxim_eval.statistics.rates import (
    SuccessRate,
    error_line,
    error_reasons,
    failure_reasons,
    is_measured,
    rate_of,
    rates_by,
)
from roboxim_eval.statistics.steps import step_share
from roboxim_eval.statistics.tables import Count
from roboxim_eval.statistics.verdicts import MARGIN, ONE_TRAINING, Verdict, checkpoint_names, checkpoint_verdict

MEASURE_NAMES = {
    "force_max_n": "largest force of a contact", "speed_max_m_s": "largest speed", "path_m": "path of the tool",
    "smoothness": "smoothness (log dimensionless jerk)", "distractors_touched": "distractors touched",
    "keep_out_s": "time in a keep-out volume",
}  # fmt: skip
"""Measure other than success to its name in reports."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PolicyRun:
    """One policy's episodes."""

    policy: str
    """Name of the policy."""
    results: Sequence[EpisodeResult]
    """Results of the policy's episodes."""
    films: Mapping[str, Film] = field(default_factory=dict)
    """Episode id to its film, cameras side by side."""
    drawn: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """Episode id to the named draws of its reset components, e.g. ``{"interaction_area": "left"}``."""
    starts: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Episode id to the place of the task's first object at tick 0: x away from the robot, y to its left [m]."""
    explanation: Mapping[str, str] = field(default_factory=dict)
    """Episode id to its description, a sentence with numbers."""
    pages: Mapping[str, str] = field(default_factory=dict)
    """Episode id to the path of its own page, from the page's folder."""
    scenes: Mapping[str, str] = field(default_factory=dict)
    """Episode id to the name of its scene; policies that met the same scene share it. Others: by their index."""
    folder: str = ""
    """Path of the policy's run from the page's folder, to which bags are relative; empty: the same folder."""
    trained: bool = False
    """Whether the policy is a checkpoint of a training; sentences then say so."""

    @property
    def rates_by_dimension(self) -> dict[str, dict[str, SuccessRate]]:
        """Success rates by instruction, and by each recorded choice that differs between episodes.

        Numbers of ranges are in three groups of equal size, see `roboxim_eval.grouping`.
        """
        found = {"instruction": rates_by(self.results, lambda result: result.instruction)}
        for dimension in sorted({name for names in self.drawn.values() for name in names} - {CELL_NUMBER}):
            names = {episode: drawn[dimension] for episode, drawn in self.drawn.items() if dimension in drawn}
            groups = grouped(names)
            if len(set(groups.values())) > 1:
                found[dimension] = _rates_by_name(self.results, groups)
        return found

    def scene(self, result: EpisodeResult) -> str:
        """Return the name of an episode's scene."""
        return self.scenes.get(result.episode_id, str(result.index))

    @property
    def episodes(self) -> list[Episode]:
        """The episodes, as a page shows them."""
        return [
            Episode(
                arm=self.policy, cell=self.drawn.get(result.episode_id, {}).get(CELL, ""),
                scene=self.scene(result), outcome=result.outcome, reason=result.reason,
                message=result.message, instruction=result.instruction, steps=result.steps,
                bag="/".join(filter(None, (self.folder, result.bag))) if result.bag else "",
                start=self.starts.get(result.episode_id), explanation=self.explanation.get(result.episode_id, ""),
                page=self.pages.get(result.episode_id, ""),
                drawn=recorded_factors(
                    self.drawn.get(result.episode_id, {}), self.starts.get(result.episode_id)
                ),
            )
            for result in self.results
        ]  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """Content of a report."""

    title: str
    """Headline."""
    runs: Sequence[PolicyRun]
    """Runs of the policies, the one under test first."""
    facts: dict[str, str]
    """Facts that reproduce the evaluation: seed, task, renderer, dataset, ..."""
    versions: dict[str, str]
    """Package to version."""
    command: str
    """Command that reproduces the evaluation."""
    stopped: str = ""
    """Rule for the number of episodes; empty: it was fixed beforehand."""
    undecided: bool = False
    """Whether planned looks at the results did not decide; then the comparison does not decide either."""
    place: Place | None = None
    """Positions of robot and table; none: unknown, or not the same in all episodes."""
    warnings: Sequence[str] = ()
    """Limitations of the results."""


def _rates_by_name(results: Sequence[EpisodeResult], names: Mapping[str, str]) -> dict[str, SuccessRate]:
    having = [result for result in results if result.episode_id in names]
    return rates_by(having, lambda result: names[result.episode_id])


def pairs_of(first: PolicyRun, second: PolicyRun) -> Pairs:
    """Return the outcomes of two policies on the scenes that both met."""
    one, two = ({run.scene(r): r.outcome == "success" for r in run.results} for run in (first, second))
    return Pairs.of((one[scene], two[scene]) for scene in one if scene in two)


def comparisons(runs: Sequence[PolicyRun], *, undecided: bool = False) -> list[Verdict]:
    """Compare the first policy with each other one on the scenes that both met; p values are adjusted (Holm).

    Policies whose episodes mostly ended in errors are left out.

    Args:
        runs: Runs of the policies, the one under test first.
        undecided: Whether planned looks at the results did not decide. Then no policy is called better, and p is 1: a
            test that ignores the looks would have more false alarms.
    """
    measured = [run for run in runs if is_measured(run.results)]
    if not runs or not measured or measured[0] is not runs[0]:
        return []
    first, *others = measured
    found = [(other, pairs) for other in others if (pairs := pairs_of(first, other)).scenes]
    adjusted = holm([1.0 if undecided else paired_difference(pairs).p_value for _, pairs in found])
    as_good = holm([paired_difference(pairs).p_as_good(MARGIN) for _, pairs in found])
    verdicts = [
        checkpoint_verdict(
            first.policy, other.policy, pairs, p_value=p_value, p_as_good=equal, comparisons=len(found),
            trained=(first.trained, other.trained),
        )
        for (other, pairs), p_value, equal in zip(found, adjusted, as_good, strict=True)
    ]  # fmt: skip
    if not undecided:
        return verdicts
    return [
        _by_looks(verdict, first, other, pairs) for (other, pairs), verdict in zip(found, verdicts, strict=True)
    ]  # fmt: skip


def _by_looks(verdict: Verdict, first: PolicyRun, second: PolicyRun, pairs: Pairs) -> Verdict:
    """Return a verdict that says that the planned looks did not decide; one that shows equality as it is."""
    if verdict.kind != "cannot_tell":
        return verdict
    value, low, high = (
        f"{round(100 * x) + 0:+d}" for x in (verdict.difference.value, verdict.difference.low, verdict.difference.high)
    )
    trained = first.trained, second.trained
    one, other = checkpoint_names(first.policy, second.policy, trained)
    sentence = (
        f"Cannot tell whether {one} differs from {other}: the difference is {value} points ({low} to {high}, without "
        f"account of the looks), but the planned looks did not decide, on {pairs.scenes} scenes that both met."
    )
    sentence += f" {ONE_TRAINING}" if any(trained) else ""
    return replace(verdict, sentence=sentence)


def verdict_line(runs: Sequence[PolicyRun], *, undecided: bool = False) -> str:
    """Compare the first policy with each other policy, in one sentence each; empty for one policy.

    Args:
        runs: Runs of the policies, the one under test first.
        undecided: Whether planned looks at the results did not decide, see `comparisons`.
    """
    if len(runs) < 2:
        return ""
    broken = [
        f"{run.policy} is not compared: most of its episodes ended in errors."
        for run in runs
        if not is_measured(run.results)
    ]
    verdicts = (verdict.sentence for verdict in comparisons(runs, undecided=undecided))
    return " ".join([*broken, *verdicts, *unpaired_sentences(runs)])


def unpaired_sentences(runs: Sequence[PolicyRun]) -> list[str]:
    """Compare the first policy with each other one that met none of its scenes, by their rates alone."""
    if not runs or not is_measured(runs[0].results):
        return []
    first, found = runs[0], []
    for other in runs[1:]:
        if is_measured(other.results) and not pairs_of(first, other).scenes:
            rates = rate_of(first.results), rate_of(other.results)
            apart = rates[0].rate - rates[1].rate
            value, low, high = (f"{round(100 * x) + 0:+d}" for x in (apart, *newcombe(*rates)))
            found.append(
                f"{first.policy} and {other.policy} met no scene in common: their rates differ by {value} points "
                f"({low} to {high}), over all their episodes."
            )
    return found


def summary(report: Report) -> dict[str, Any]:
    """Return the report's numbers as plain data, the content of ``summary.json``."""
    return {
        "title": report.title,
        "policies": {run.policy: _numbers(run) for run in report.runs},
        "comparison": verdict_line(report.runs, undecided=report.undecided),
        "stopped": report.stopped,
        "facts": report.facts,
        "versions": report.versions,
        "command": report.command,
    }


def _numbers(run: PolicyRun) -> dict[str, Any]:
    """Return a policy's numbers; if most episodes ended in errors, the rate and its interval are None."""
    rate = rate_of(run.results)
    measured = is_measured(run.results)
    numbers: dict[str, Any] = {**asdict(rate), "rate": rate.rate, "measured": measured}
    if measured:
        for dimension, rates in run.rates_by_dimension.items():
            numbers[f"by_{dimension}"] = {name: asdict(rate) for name, rate in rates.items()}
    else:
        numbers |= {"rate": None, "low": None, "high": None}
    steps = step_share(run.results)
    numbers |= {"steps": asdict(steps)} if steps else {}
    beside = beside_success(run.results)
    numbers |= {"limits": asdict(beside)} if beside else {}
    return numbers | {"failure_reasons": failure_reasons(run.results), "errors": error_reasons(run.results)}


def write_report(report: Report, folder: Path) -> Path:
    """Write ``report.html`` (self-contained) and ``summary.json``.

    Args:
        report: Content of the report.
        folder: Existing folder.

    Returns:
        The HTML file.
    """
    (folder / "summary.json").write_text(json.dumps(summary(report), indent=2) + "\n")
    path = folder / "report.html"
    path.write_text(evaluation_page(report))
    return path


def evaluation_page(report: Report) -> str:
    """Return the page."""
    runs, arms = report.runs, [run.policy for run in report.runs]
    episodes = [episode for run in runs for episode in run.episodes]
    filmed = [run.films.get(result.episode_id) for run in runs for result in run.results]
    films = {number: film for number, film in enumerate(filmed) if film is not None}
    measured = [run for run in runs if is_measured(run.results)]
    return render(
        "evaluation.html",
        title=report.title,
        report=report,
        verdicts=comparisons(runs, undecided=report.undecided),
        unpaired=unpaired_sentences(runs),
        broken=[run.policy for run in runs if run not in measured],
        arms=[run.policy for run in measured],
        runs=[_run_view(run) for run in runs],
        value_of=shown,
        measure_names=MEASURE_NAMES,
        heat=_heat_maps(measured),
        map=map_view(episodes, arms, report.place),
        patterns=scene_patterns(episodes, [run.policy for run in measured]),
        breakdowns=breakdowns([e for run in measured for e in run.episodes], [run.policy for run in measured]),
        groups=film_groups(episodes, films, arms),
        films_shown=films_shown(episodes, films),
        data=episodes_json(episodes, films),
    )


def _heat_maps(runs: Sequence[PolicyRun]) -> list[HeatMap]:
    """Return the rates of each policy by the cells of a task mix, and the difference of the first two policies.

    Cells are recorded by name, e.g. ``pick_up target=apple``; those of another form, or of one factor, have no map.
    """
    names = dict.fromkeys(name for run in runs for drawn in run.drawn.values() if (name := drawn.get(CELL)))
    found = {name: named_cell(name) for name in names}
    cells = {name: cell for name, cell in found.items() if cell is not None}
    factors = {tuple(cell.levels) for cell in cells.values()}
    if len(cells) < max(2, len(names)) or len(factors) > 1 or len(min(factors)) < 2:
        return []
    named = {cell.key: name for name, cell in cells.items()}
    counts = {run.policy: _by_cell(run, {name: cell.key for name, cell in cells.items()}) for run in runs}
    pair = (runs[0].policy, runs[1].policy) if len(runs) > 1 else None
    return arm_maps(
        list(cells.values()), counts, pair, lambda arms, cell: episodes_link(arm=any_of(arms), cell=named[cell])
    )


def _by_cell(run: PolicyRun, keys: Mapping[str, str]) -> dict[str, Count]:
    cells = {episode: keys[name] for episode, drawn in run.drawn.items() if (name := drawn.get(CELL))}
    rates = _rates_by_name(run.results, cells)
    return {key: Count(successes=rate.successes, episodes=rate.episodes) for key, rate in rates.items()}


def _run_view(run: PolicyRun) -> dict[str, Any]:
    measured = is_measured(run.results)
    steps = [result.steps for result in run.results if result.outcome == "success"]
    inference = [1000 * result.inference_s / result.steps for result in run.results if result.steps]
    return {
        "policy": run.policy,
        "rate": rate_of(run.results) if measured else None,
        "steps": step_share(run.results) if measured else None,
        "beside": beside_success(run.results) if measured else None,
        "errors": error_line(run.results),
        "link": episodes_link(arm=run.policy),
        "errors_link": episodes_link(arm=run.policy, outcome="error"),
        "failures": failure_rows(run.episodes, arm=run.policy),
        "median_steps": int(np.median(steps)) if steps else None,
        "inference_ms": float(np.median(inference)) if inference else None,
    }
