"""Experiments for tests, and results of policies with planted behaviour, for tests of reports."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.config import load_yaml, named_config, parse_yaml
from roboxim_core.plain_data.merging import merged
from roboxim_eval.experiments import Cell, Design, ExperimentConfig, Rates, design_of, experiment_config
from roboxim_eval.experiments.card import Attestation, Card, CardEvaluation, CardExperiment, CardTraining, JudgedAgain
from roboxim_eval.experiments.card_checks import concluded

Won = dict[tuple[str, int, str], npt.NDArray[np.bool_]]
"""Condition, replicate and cell to the outcome of each episode."""
RATES = Rates(
    experiment="test", machine="test", measured="2026-01-01", source="test", size="128x128", workers=2,
    demonstration_s=1.2, demonstration_bytes=1e7, dataset_bytes=1e6, export_s=0.1, steps_per_s=5.7,
    checkpoint_bytes=1e7, success_s=3.0, failure_s=8.0, rollout_bytes=1e7, proof_s=0.1, start_s=10, train_start_s=10,
    first_evaluate_s=7, evaluate_start_s=10, proof_start_s=5, film_s=0.5,
)  # fmt: skip
"""Rates of a machine."""
SKILL_AND_OBJECT = """
about: Do policies combine a skill and an object that they never saw together?
factors: {task: [pick_up, place_on], target: [cube, soda_can]}
unseen: [{task: pick_up, target: cube}, {task: place_on, target: soda_can}]
set: {distractors: {minimum: 0, maximum: 0}}
datasets:
  leave_out: {cells: seen, per_cell: 3}
  baseline: {cells: all, per_cell: 2}
conditions:
  leave_out: {train: leave_out}
  baseline: {train: baseline}
  blind: {checkpoint_of: leave_out, instruction: ""}
replicates: {count: 3}
image_size: 64x64
"""
"""An experiment without trainers, evaluation and comparisons."""


def experiment_of(text: str, *, scale: str = "full", **changes: Any) -> ExperimentConfig:
    """Return the experiment of a file's text at a scale, with some of its keys replaced."""
    data = parse_yaml(text)  # it holds the lines of its keys, for messages
    data.update(changes)
    return experiment_config(data, source="mine.yaml", scale=scale)


@lru_cache(maxsize=32)
def shipped(name: str = "skill_object", replicates: int = 5, per_cell: int = 20) -> Design:
    """Return the design of a shipped experiment at a size."""
    changes = {"replicates": {"count": replicates}, "evaluate": {"per_cell": per_cell}}
    return design_of(experiment_config(merged(load_yaml(named_config("experiments", name)), changes), source=name))


def planted_card(
    design: Design, rate: Callable[[str, Cell], float], *, seed: int = 0, spread: float = 0.0,
    instead: Mapping[str, str] | None = None, steps: Mapping[str, int] | None = None,
    proofs: dict[str, tuple[int, int]] | None = None, exposure: str = "no",
) -> Card:  # fmt: skip
    """Return the card of planted policies.

    Args:
        design: The experiment.
        rate: (condition, cell) to the chance of success.
        seed: Seed of the outcomes.
        spread: Standard deviation between trainings at a rate of 0.8; constant on the logit.
        instead: Held-out cell to the seen cell that the leave-out policies do instead; none: not judged again.
        steps: Condition to training steps; none: equal.
        proofs: Proofs of delivery.
        exposure: Whether the pre-training had held-out combinations.
    """
    rng = np.random.default_rng(seed)
    config = design.config
    evaluations: list[CardEvaluation] = []
    won: Won = {}
    for evaluation in design.evaluations:
        shift = rng.normal() * spread / 0.16
        by_cell = {}
        for cell in design.cells:
            if cell.key in evaluation.counts:
                p = rate(evaluation.condition, cell)
                p = 1 / (1 + np.exp(-(np.log(p / (1 - p)) + shift))) if 0 < p < 1 else p
                outcomes = rng.random(evaluation.counts[cell.key]) < p
                won[evaluation.condition, evaluation.replicate, cell.key] = outcomes
                by_cell[cell.key] = (int(outcomes.sum()), len(outcomes), 0)
        evaluations.append(
            CardEvaluation(condition=evaluation.condition, replicate=evaluation.replicate, by_cell=by_cell)
        )
    pairs = {str(n): tuple(_pairs(design, n, won)) for n, c in enumerate(config.compare) if not c.against}
    card = Card(
        experiment=CardExperiment(name="planted", scale="full", config=config),
        trainings=tuple(
            CardTraining(
                condition=t.condition, replicate=t.replicate, dataset=t.dataset,
                attest=Attestation(
                    recipe={"steps": (steps or {}).get(t.condition, 10_000)}, pretraining="none", exposure=exposure
                ),
            )
            for t in design.trainings
        ),
        evaluations=tuple(evaluations), pairs=pairs, proofs=proofs or {},
        judged_again=None if instead is None else tuple(_judged(design, won, instead)),
    )  # fmt: skip
    return concluded(card, design)


def _pairs(design: Design, number: int, won: Won) -> Iterator[tuple[int, int, int, int]]:
    compare = design.config.compare[number]
    cells = [c.key for c in design.cells if compare.where == "all" or c.unseen == (compare.where == "unseen")]
    for replicate in range(design.config.replicates.count):
        one = np.concatenate([won[compare.first, replicate, cell] for cell in cells])
        two = np.concatenate([won[compare.second, replicate, cell] for cell in cells])
        yield int((one & two).sum()), int((one & ~two).sum()), int((~one & two).sum()), int((~one & ~two).sum())


def _judged(design: Design, won: Won, instead: Mapping[str, str]) -> Iterator[JudgedAgain]:
    primary = design.config.primary
    for (condition, _, cell), outcomes in won.items():
        if primary is not None and condition == primary.first and cell in {c.key for c in design.cells if c.unseen}:
            for _ in range(int((~outcomes).sum())):
                yield JudgedAgain(cell=cell, satisfied=(instead[cell],) if instead.get(cell) else ())


def planted_policies() -> dict[str, Card]:
    """Return the cards of the planted policies that the documentation quotes, by the planted behaviour."""
    design, worded = shipped(), shipped("skill_object_worded")
    unseen = [cell.key for cell in design.cells if cell.unseen]
    instead = {key: f"{'rotate' if 'pick_up' in key else 'pick_up'} {key.partition(' ')[2]}" for key in unseen}

    def by(unseen: Mapping[str, float], seen: Mapping[str, float]) -> Callable[[str, Cell], float]:
        return lambda condition, cell: (unseen if cell.unseen else seen)[condition]

    good = {"leave_out": 0.85, "baseline": 0.85}
    return {
        "combines": planted_card(design, by({**good, "blind": 0.05}, good)),
        "memorises pairs": planted_card(
            design, by({"leave_out": 0.02, "baseline": 0.8, "blind": 0.01}, good), instead=instead
        ),
        "ignores words, the scene suffices": planted_card(design, by({**good, "blind": 0.85}, good), seed=1),
        "ignores words, words are needed": planted_card(
            worded, by({"leave_out": 0.15, "baseline": 0.7, "blind": 0.15}, {"leave_out": 0.15, "baseline": 0.7})
        ),
        "baseline of 3 in 120": planted_card(
            design, by({"leave_out": 0.025, "baseline": 0.025, "blind": 0.025}, good), seed=4
        ),
        "shorter recipe of the baseline": planted_card(
            design, by({"leave_out": 0.5, "baseline": 0.5, "blind": 0.05}, {"leave_out": 0.85, "baseline": 0.6}),
            steps={"baseline": 4000},
        ),
        "as the thesis, 0.19 against 0.264": planted_card(
            design, by({"leave_out": 0.19, "baseline": 0.264, "blind": 0.02}, {"leave_out": 0.7, "baseline": 0.7}),
            seed=2, spread=0.046,
        ),
    }  # fmt: skip


if __name__ == "__main__":
    for name, card in planted_policies().items():
        scores = card.scores or {}
        print(f"{name}\n  {card.verdicts[0].sentence}")  # noqa: T201
        for key in ("relative", "relative_refused", "words", "substitution"):
            print(f"  {key}: {scores.get(key)}")  # noqa: T201
        for warning in card.warnings:
            print(f"  warning: {warning}")  # noqa: T201
