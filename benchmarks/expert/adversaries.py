"""Whether every skill's evaluator rejects cheats and accepts honest solutions (roboxim_tasks/trials).

Each trial acts in scenes of its skill through the delta controller, as a policy does, over the cores and without
cameras. A cheat is as expected if no tick is a success; an honest solution if the episode is a success after settling.
With ``--out`` each finished episode is stored, and the same command continues an interrupted run. ``--docs`` writes the
rows of the chosen trials into the tables of docs/results/verdicts.md (cheats) and honest_ways.md.
"""

from __future__ import annotations

import argparse
import contextlib
import time
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks._harness import Bench
from benchmarks.expert._kept import Kept
from tqdm import tqdm

from roboxim_runs.evaluation.trials import TrialRuns
from roboxim_tasks.trials import TRIALS, Trial

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"
DOCS = {False: RESULTS / "verdicts.md", True: RESULTS / "honest_ways.md"}
"""Pages of cheats and of honest ways."""
BEGIN, END = "<!-- adversaries: begin -->", "<!-- adversaries: end -->"
HEAD = "| skill | what is tried | must | as expected |\n| --- | --- | --- | --- |"


def main() -> None:
    """Measure and print."""
    bench = Bench("adversaries", __doc__, add_options)
    options = bench.options
    chosen = {key: TRIALS[key] for key in TRIALS if any(text in key for text in options.trials.split(","))}
    if not chosen:
        raise SystemExit(f"no trial's name contains any of '{options.trials}'; known trials: {', '.join(TRIALS)}")
    scenes = 1 if bench.quick else options.scenes
    start = time.perf_counter()
    outcomes = measure(chosen, scenes, options.out)
    chosen = {key: trial for key, trial in chosen.items() if key in outcomes}
    for key, trial in chosen.items():
        bench.row(**row(trial, outcomes[key]))
    if options.docs:
        write_docs(chosen, outcomes)
    found = [outcome for key in chosen for outcome in outcomes[key]]
    print(f"{len(found)} episodes, {time.perf_counter() - start:.0f} s")
    share = sum(outcome["as_expected"] for outcome in found) / len(found)
    bench.finish("trials judged as expected", share, "", at_least=1.0)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--out", type=Path, metavar="DIR", help="store episodes here and continue from them")
    parser.add_argument("--trials", default="", metavar="TEXT[,TEXT]", help="only trials whose name contains a text")
    parser.add_argument("--scenes", type=int, default=10, metavar="N", help="scenes per trial (default: 10)")
    parser.add_argument(
        "--docs", action="store_true", help="write the rows into docs/results/verdicts.md and honest_ways.md"
    )


def measure(chosen: dict[str, Trial], scenes: int, out: Path | None) -> dict[str, list[dict[str, Any]]]:
    """Run the missing episodes, all trials in turns; return the episodes of each trial that has some.

    An interruption (Ctrl-C) ends the run early.
    """
    kept = Kept(out, {key: trial.config() for key, trial in chosen.items()}) if out else None
    known = kept.load() if kept else {}
    outcomes = {key: [o for o in known.get(key, []) if o["index"] < scenes] for key in chosen}
    done = sum(map(len, outcomes.values()))
    missing = [
        (index, key)
        for index in range(scenes)
        for key in chosen
        if index not in {outcome["index"] for outcome in outcomes[key]}
    ]
    with (
        TrialRuns() as runs,
        tqdm(total=scenes * len(chosen), initial=done, unit="episode", disable=None) as bar,
        contextlib.suppress(KeyboardInterrupt),
    ):
        for index, key in missing:
            outcome = {"cell": key, **runs.run(chosen[key], index).plain()}
            outcomes[key].append(outcome)
            if kept:
                kept.add([outcome])
            bar.update()
    return {key: found for key, found in outcomes.items() if found}


def row(trial: Trial, outcomes: list[dict[str, Any]]) -> dict[str, str | float]:
    """Return a trial's row."""
    reasons = Counter(outcome["reason"] or "success" for outcome in outcomes)
    return {
        "skill": trial.skill,
        "trial": trial.name,
        "expected": trial.reason or "success",
        "as_expected": f"{sum(outcome['as_expected'] for outcome in outcomes)} of {len(outcomes)}",
        "ended": ", ".join(f"{reason} {count}" for reason, count in reasons.most_common()),
    }


def write_docs(chosen: dict[str, Trial], outcomes: dict[str, list[dict[str, Any]]]) -> None:
    """Replace the rows of some trials in both pages; rows of trials that are no more are dropped."""
    for honest, page in DOCS.items():
        text = page.read_text()
        if BEGIN not in text or END not in text:
            raise SystemExit(f"{page} has no '{BEGIN}' and '{END}' to write the table between")
        before, rest = text.split(BEGIN, 1)
        old, after = rest.split(END, 1)
        lines = [HEAD]
        for key, trial in sorted(((key, TRIALS[key]) for key in TRIALS), key=_place):
            if trial.honest != honest:
                continue
            start = f"| `{trial.skill}` | {trial.does.rstrip('.')} | "
            kept = next((line for line in old.splitlines() if line.startswith(start)), "")
            if key in chosen:
                must = "succeed" if trial.honest else f"fail: `{trial.reason}`"
                kept = f"{start}{must} | {row(trial, outcomes[key])['as_expected']} |"
            lines += [kept] if kept else []
        page.write_text("\n".join([before + BEGIN, *lines, END + after]))


def _place(item: tuple[str, Trial]) -> tuple[str, str]:
    return item[1].skill, item[1].name


if __name__ == "__main__":
    main()
