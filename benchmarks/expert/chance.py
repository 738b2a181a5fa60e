"""What chance scores in every skill: a policy of random actions, in the scenes in which policies are evaluated.

Each action is drawn evenly within the action limits. An episode counts as solved if the verdict is a success at any of
its ticks, by the lenient thresholds of evaluations. ``--docs`` writes the table into docs/results/verdicts.md.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml
from benchmarks._harness import Bench
from tqdm import tqdm

from roboxim_bringup.core_graph import CoreActor, CoreGraph
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_eval.statistics.rates import success_rate
from roboxim_policies.builtin import RandomPolicy
from roboxim_runs.episodes.task_choice import task_text
from roboxim_tasks.skills import SKILLS

DOCS = Path(__file__).resolve().parents[2] / "docs" / "results" / "verdicts.md"
BEGIN, END = "<!-- chance: begin -->", "<!-- chance: end -->"
HEAD = "| skill | random episodes | solved at any tick | 95 % interval |\n| --- | --- | --- | --- |"


def main() -> None:
    """Measure and print."""
    bench = Bench("chance", __doc__, add_options)
    options = bench.options
    skills = options.skills or list(SKILLS)
    episodes = 2 if bench.quick else options.episodes
    kept: Path | None = options.out
    found = json.loads(kept.read_text()) if kept and kept.is_file() else {}
    with tempfile.TemporaryDirectory() as folder, CoreGraph(Path(folder), renderer="tiny") as cores:
        runner = Runner(cores, folder)
        jobs = [(index, skill) for index in range(episodes) for skill in skills]
        for index, skill in tqdm(jobs, unit="episode", disable=None):
            outcomes = found.setdefault(skill, [])
            if index >= len(outcomes):
                outcomes.append(runner.run(skill, index))
                if kept:
                    kept.parent.mkdir(parents=True, exist_ok=True)
                    kept.write_text(json.dumps(found))
    rows = [row(skill, found[skill][:episodes]) for skill in skills]
    for one in rows:
        bench.row(**one)
    if options.docs:
        write_docs(rows)
    worst = max(one["solved"] / one["episodes"] for one in rows)
    bench.finish("largest share of random episodes that solve a skill", worst, "", at_most=0.15)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--out", type=Path, metavar="FILE", help="store episodes here and continue from them")
    parser.add_argument("--skills", nargs="*", default=[], metavar="SKILL", help="these alone (default: all)")
    parser.add_argument("--episodes", type=int, default=100, metavar="N", help="episodes of each (default: 100)")
    parser.add_argument("--docs", action="store_true", help="write the table into docs/results/verdicts.md")


class Runner:
    """Runs episodes of random actions, without cameras."""

    def __init__(self, cores: CoreGraph, folder: str) -> None:
        """Set the graph and the folder of the bags, which are not kept."""
        self._ports = replace(cores.ports, actor=CoreActor(RandomPolicy()))
        self._folder = folder

    def run(self, skill: str, index: int) -> dict[str, Any]:
        """Run an episode; return whether any tick was a success, and the reason of its end."""
        task = yaml.safe_load(task_text(skill=skill))
        task.setdefault("reset", {})["cameras"] = {"names": []}
        config = RunConfig(
            output_dir=self._folder, purpose="eval", keep="none", run_seed=1, task_config=yaml.safe_dump(task)
        )
        result = EpisodeRunner(self._ports, config).run_index(index)
        return {"solved": bool(result.success_ever), "reason": result.reason, "outcome": str(result.outcome)}


def row(skill: str, outcomes: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a skill's row."""
    solved = sum(one["solved"] for one in outcomes)
    rate = success_rate(solved, len(outcomes))
    ends = Counter(one["reason"] or one["outcome"] for one in outcomes)
    return {
        "skill": skill, "episodes": len(outcomes), "solved": solved,
        "low": round(rate.low, 3), "high": round(rate.high, 3),
        "ends": ", ".join(f"{reason} {count}" for reason, count in ends.most_common(3)),
    }  # fmt: skip


def write_docs(rows: list[dict[str, Any]]) -> None:
    """Replace the table in docs/results/verdicts.md."""
    lines = [
        f"| `{one['skill']}` | {one['episodes']} | {one['solved']} "
        f"| {100 * one['low']:.1f} to {100 * one['high']:.1f} % |"
        for one in sorted(rows, key=lambda one: (-one["solved"], one["skill"]))
    ]
    before, rest = DOCS.read_text().split(BEGIN, 1)
    DOCS.write_text("\n".join([before + BEGIN, HEAD, *lines, END + rest.split(END, 1)[1]]))


if __name__ == "__main__":
    main()
