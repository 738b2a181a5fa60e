"""An experiment with trainings, evaluations and comparisons, for tests of its stages, cost and results."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from planted_cards import experiment_of

from roboxim_eval.experiments import Design, ExperimentConfig, Outcomes
from roboxim_eval.statistics.tables import Count

TEXT = """
about: Do policies combine a skill and an object that they never saw together?
thesis: "5.4.3"
factors:
  task: {pick_up: {}, rotate: {arguments: {direction: {values: [clockwise]}}}}
  target: [cube, apple, onion]
dimensions: {task: skill, target: object}
unseen:
  - {task: pick_up, target: cube}
  - {task: rotate, target: apple}
set: {distractors: {minimum: 0, maximum: 0}}
datasets:
  leave_out: {cells: seen, per_cell: 27}
  baseline: {cells: all, per_cell: 18}
conditions:
  leave_out: {train: leave_out}
  baseline: {train: baseline}
  blind: {checkpoint_of: leave_out, instruction: ""}
trainers:
  bc: {command: "roboxim train bc {dataset} --out {out} --seed {seed} --steps {steps}", until: "--until {until}",
    policy: bc, steps: 4000}
evaluate: {per_cell: 20, cells: {blind: unseen}}
replicates: {count: 5}
compare:
  - {first: leave_out, second: baseline, where: unseen, primary: true}
  - {first: leave_out, second: blind, where: unseen}
scales:
  smoke: {replicates: {count: 1}, evaluate: {per_cell: 2}, trainers: {bc: {steps: 50}}}
"""
SEEN_AND_UNSEEN = TEXT.replace(
    "  - {first: leave_out, second: baseline, where: unseen, primary: true}\n",
    "  - {first: leave_out, second: leave_out, where: unseen, against: seen, primary: true}\n",
)


def config(text: str = TEXT, **changes: Any) -> ExperimentConfig:
    """Return the experiment, with some of its keys replaced."""
    return experiment_of(text, **changes)


def planted(
    design: Design, rate: Callable[[str, bool], float], *, seed: int = 0, spread: float = 0.0,
    failed: Any = None, pairs: Any = None,
) -> Outcomes:  # fmt: skip
    """Return the outcomes of policies whose success rates are planted: `rate(condition, cell)`."""
    rng = np.random.default_rng(seed)
    counts: dict[str, list[dict[str, Count]]] = {}
    for name in design.config.conditions:
        wanted = next(e.counts for e in design.evaluations if e.condition == name and not e.checkpoint)
        unseen = {cell.key: cell.unseen for cell in design.cells}
        counts[name] = []
        for _ in range(design.config.replicates.count):
            shift = rng.normal() * spread / 0.16
            row = {}
            for key, episodes in wanted.items():
                p = rate(name, unseen[key])
                p = 1 / (1 + math.exp(-(math.log(p / (1 - p)) + shift))) if 0 < p < 1 else p
                row[key] = Count(successes=int(rng.binomial(episodes, p)), episodes=episodes)
            counts[name].append(row)
    return Outcomes(counts=counts, failed=failed, pairs=pairs or {})
