"""Cost of an experiment: time, disk, and the difference that it can find. Rates are measured, never assumed."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

from roboxim_core.errors import ConfigError
from roboxim_eval.experiments.config import ExperimentConfig
from roboxim_eval.experiments.design import Design, design_of
from roboxim_eval.statistics.power import Design as Size
from roboxim_eval.statistics.power import detectable
from roboxim_eval.statistics.replicates import MIN_REPLICATES

FILMS = 8
"""Films of each condition in an experiment's report."""
MIN_START_S = 0.5
"""Smallest time of a start, used where a measurement is too short to show one [s]."""
ASSUMED_SUCCEEDED = 0.8
"""Assumed share of successful rollouts until a run has measured one; power is computed at the same rate."""
MIN_LEARNING_STEPS = 1000
"""Smallest number of training steps for which any success is expected."""


@dataclass(frozen=True, kw_only=True)
class SideBySide:
    """Measured rate of trainings that run in parallel and share processors, memory and GPUs."""

    trainings: int
    """Number of trainings at a time."""
    steps_per_s: float
    """Training steps a second of each of them."""
    start_s: float
    """Wall time of each before its first step, when all start together [s]."""
    measured: str
    """Date of the measurement, ISO 8601."""
    source: str
    """Measured quantity."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: When one is not positive.
        """
        _require_positive(self)


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Measured rates of a machine; ``roboxim experiment calibrate`` measures and stores them."""

    experiment: str
    """Name of the experiment whose episodes were measured; those of another one may be longer or shorter."""
    machine: str
    """Processor and number of cores, for messages."""
    measured: str
    """Date of the measurement, ISO 8601."""
    source: str
    """What was measured, e.g. ``probe of 8 episodes`` or ``runs/demos``."""
    size: str
    """Width and height of the images [px], e.g. ``128x128``; rates hold for this size."""
    workers: int
    """Number of processes that ran episodes at a time."""
    demonstration_s: float
    """Wall time of a kept demonstration, with all workers busy [s]."""
    demonstration_bytes: float
    """Size of a demonstration's bag."""
    dataset_bytes: float
    """Size of a demonstration in an exported dataset."""
    export_s: float
    """Wall time of the export of a demonstration [s]."""
    steps_per_s: float
    """Training steps a second of a training alone."""
    checkpoint_bytes: float
    """Size of a training's folder."""
    success_s: float
    """Wall time of a successful rollout, with all workers busy [s]."""
    failure_s: float
    """Wall time of a rollout that fails, mostly at the limit of actions, with all workers busy [s]."""
    rollout_bytes: float
    """Size of a rollout's bag."""
    proof_s: float
    """Wall time of the proof of a bag, with all workers busy [s]."""
    start_s: float
    """Wall time of a generation besides its episodes: the start of the graph, and the pictures at the end [s]."""
    train_start_s: float
    """Wall time of a training alone before its first step: reading the data, compiling [s]."""
    first_evaluate_s: float
    """Wall time that an experiment's first evaluation takes longer: workers load the policy's libraries [s]."""
    evaluate_start_s: float
    """Wall time of a further evaluation besides its episodes: the start of graph and policy [s]."""
    proof_start_s: float
    """Wall time of the start of a proof [s]."""
    film_s: float
    """Wall time of a film of the report, its episode's facts included [s]."""
    succeeded: float | None = None
    """Success share of the rollouts of the experiment's last run, 0..1; none: not run yet."""
    side_by_side: tuple[SideBySide, ...] = ()
    """Rates of several trainings at a time, for each number that was measured."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: When one is not positive, or a share not from 0 to 1.
        """
        _require_positive(self)
        if self.succeeded is not None and not 0 <= self.succeeded <= 1:
            raise ConfigError(f"the share of successes must be from 0 to 1, got {self.succeeded!r}; measure again")

    def rollout_s(self, succeeded: float) -> float:
        """Return the mean wall time of a rollout at a success share of 0..1, with all workers busy [s]."""
        return succeeded * self.success_s + (1 - succeeded) * self.failure_s

    @property
    def training_rates(self) -> dict[int, SideBySide]:
        """Number of trainings at a time to their measured rate, by increasing number; 1 is a training alone."""
        alone = SideBySide(
            trainings=1, steps_per_s=self.steps_per_s, start_s=self.train_start_s, measured=self.measured,
            source=self.source,
        )  # fmt: skip
        return {rate.trainings: rate for rate in sorted((alone, *self.side_by_side), key=lambda rate: rate.trainings)}

    def at_once(self, trainings: int) -> SideBySide | None:
        """Return the rate of a number of trainings at a time; none: neither this number nor a larger one was measured.

        Rates between two measured numbers are interpolated.
        """
        known = self.training_rates
        if trainings in known or trainings > max(known):
            return known.get(trainings)
        low, high = max(n for n in known if n < trainings), min(n for n in known if n > trainings)
        part = (trainings - low) / (high - low)
        return SideBySide(
            trainings=trainings,
            steps_per_s=(1 - part) * known[low].steps_per_s + part * known[high].steps_per_s,
            start_s=(1 - part) * known[low].start_s + part * known[high].start_s,
            measured=known[high].measured,
            source=f"between {low} and {high} at a time, which were measured",
        )

    def learned(self, *rates: SideBySide) -> Rates:
        """Return the rates with those of several trainings at a time added; they replace those of the same numbers."""
        found = {rate.trainings: rate for rate in (*self.side_by_side, *rates)}
        return replace(self, side_by_side=tuple(found[number] for number in sorted(found)))


def _require_positive(rates: Rates | SideBySide) -> None:
    for name, value in vars(rates).items():
        if name != "succeeded" and isinstance(value, int | float) and not value > 0:
            raise ConfigError(f"a rate must be > 0, got {name} {value!r}; measure again")


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Cost of an experiment on a machine."""

    generate_s: float
    """Time of generating, proving, planting faults in and exporting the demonstrations [s]."""
    train_s: float | None
    """Time of the trainings [s]; none: they run elsewhere."""
    evaluate_s: float
    """Time of the rollouts, of their proofs and of the report [s]."""
    succeeded: float
    """Assumed share of successful rollouts, 0..1; failures last longer."""
    failing_s: float
    """Time of the rollouts, of their proofs and of the report if none succeeds [s]."""
    disk_bytes: float
    """Disk of bags, datasets and checkpoints."""
    detectable: float | None
    """Smallest drop from a success rate of 80 % that the primary comparison finds with a chance of 80 %, 0..1; none:
    no drop, or nothing is compared."""

    @property
    def total_s(self) -> float:
        """Time of all stages on this machine [s]."""
        return self.generate_s + (self.train_s or 0.0) + self.evaluate_s


def trainings_at_once(design: Design, trainings: int) -> int:
    """Return the number of trainings that run here at a time, below a limit; at least 1."""
    here = len(design.trainings) if design.trainer.command else 0
    return max(1, min(trainings, here))


def cost_of(design: Design, rates: Rates, trainings: int = 1) -> Cost:
    """Return the cost of an experiment.

    Args:
        design: The experiment.
        rates: Measured rates of the machine.
        trainings: Largest number of trainings at a time.

    Raises:
        ConfigError: When the rate of so many trainings at a time was not measured.
    """
    exported = design.generations * sum(sum(counts.values()) for counts in design.datasets.values())
    here = bool(design.trainer.command)
    train_s = _trainings_s(design, rates, trainings) if here or not design.trainings else None
    films = sum(
        min(FILMS, sum(one.rollouts for one in design.evaluations if one.condition == name and not one.checkpoint))
        for name in design.config.conditions
    )
    planted = design.generations * sum(
        design.config.datasets[name].share * sum(counts.values()) for name, counts in design.datasets.items()
    )
    plant_s = rates.demonstration_s * rates.workers  # most faults execute an episode again, in one process
    start_s = rates.start_s + rates.proof_start_s
    succeeded = expected_success(design, rates)
    around_s = (
        design.rollouts * rates.proof_s
        + len(design.evaluations) * rates.evaluate_start_s
        + rates.first_evaluate_s
        + films * rates.film_s
        + (2 if design.config.curve else 1) * design.config.replicates.count * rates.proof_start_s
    )
    return Cost(
        generate_s=design.episodes * (rates.demonstration_s + rates.proof_s)
        + planted * plant_s
        + exported * rates.export_s
        + design.generations * start_s,
        train_s=train_s,
        evaluate_s=design.rollouts * rates.rollout_s(succeeded) + around_s,
        succeeded=succeeded,
        failing_s=design.rollouts * rates.failure_s + around_s,
        disk_bytes=design.episodes * rates.demonstration_bytes
        + exported * rates.dataset_bytes
        + (len(design.trainings) * rates.checkpoint_bytes if here else 0.0)
        + design.rollouts * rates.rollout_bytes,
        detectable=detectable_drop(design),
    )


def expected_success(design: Design, rates: Rates) -> float:
    """Return the share of successful rollouts that a plan assumes for an experiment, 0..1.

    It is that of the experiment's last run, else an assumption; 0 for trainings that are too short to learn anything.
    """
    steps = [training.steps for training in design.trainings] if design.trainer.command else []
    if steps and max(steps) < MIN_LEARNING_STEPS:
        return 0.0
    return ASSUMED_SUCCEEDED if rates.succeeded is None else rates.succeeded


def _trainings_s(design: Design, rates: Rates, trainings: int) -> float:
    """Return the time of all trainings; the next one starts when one ends [s].

    Raises:
        ConfigError: When the rate of so many trainings at a time was not measured.
    """
    at_once = trainings_at_once(design, trainings)
    by_number = {number: rate for number in range(1, at_once + 1) if (rate := rates.at_once(number))}
    if len(by_number) < at_once:
        raise ConfigError(
            f"the rate of {at_once} trainings at a time was not measured; 'roboxim experiment calibrate --trainings "
            f"{at_once}' measures it"
        )
    waiting = [(training.steps, 1 + len(training.checkpoints)) for training in design.trainings]
    running: list[tuple[float, int, int]] = []  # remaining share, steps, starts
    passed_s = 0.0
    while waiting or running:
        running += [(1.0, *waiting.pop(0)) for _ in range(min(at_once - len(running), len(waiting)))]
        rate = by_number[len(running)]
        whole_s = [steps / rate.steps_per_s + starts * rate.start_s for _, steps, starts in running]
        next_s = min(left * whole for (left, *_), whole in zip(running, whole_s, strict=True))
        passed_s += next_s
        shares = [
            (left - next_s / whole, steps, starts)
            for (left, steps, starts), whole in zip(running, whole_s, strict=True)
        ]
        running = [share for share in shares if share[0] > 1e-9]
    return passed_s


def detectable_drop(design: Design, *, alone: bool = False) -> float | None:
    """Return the smallest drop from 80 % that a comparison finds with a chance of 80 %; none: not even one to 0.

    The drop is that of the primary comparison's first condition from its second one.

    Args:
        design: The experiment.
        alone: Whether none of the other comparisons is found. Holm's adjustment then requires p <= alpha / k with k
            comparisons; if all others are found, for p <= alpha.
    """
    config, scenes = design.config, design.compared_scenes
    if not scenes:
        return None
    size = Size(
        replicates=config.replicates.count, scenes=_scenes_against(design) or scenes,
        other_scenes=scenes if _scenes_against(design) else 0, same_checkpoints=same_checkpoints(design),
    )  # fmt: skip
    return detectable(size, alpha=config.decide.alpha / (max(1, len(config.compare)) if alone else 1))


def same_checkpoints(design: Design) -> bool:
    """Return whether both sides of the primary comparison are the same trainings, evaluated in two ways."""
    primary, conditions = design.config.primary, design.config.conditions
    if primary is None:
        return False
    first, second = (conditions[name].checkpoint_of or name for name in (primary.first, primary.second))
    return first == second


def _scenes_against(design: Design) -> int:
    """Return the rollouts of each training of the primary comparison's second condition; 0: on the first one's scenes.

    The two sides have different scenes if they are compared in different cells.
    """
    primary = design.config.primary
    if primary is None or primary.against in ("", primary.where):
        return 0
    return design.scenes(primary.second, primary.against)


REPLICATES = (1, 3, 4, 5, 6, 8, 10, 12, 16, 20)
SCENES = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
"""Numbers of trainings, and factors on the rollouts of each cell, among which a budget chooses."""


def fitted(
    config: ExperimentConfig, rates: Rates, budget_s: float, trainer: str = "", trainings: int = 1
) -> ExperimentConfig | None:
    """Return the size of an experiment that finds the smallest difference within a budget.

    Trainings are added before scenes, because they allow smaller differences to be found. Fewer than three are chosen
    only if no more fit, because they show nothing about a training condition.

    Args:
        config: The experiment at its scale.
        rates: Measured rates of the machine.
        budget_s: Time [s].
        trainer: Name of a trainer of the file; empty: the first one.
        trainings: Largest number of trainings at a time.

    Returns:
        The experiment with other replicates and rollouts; none: not even the smallest size fits.

    Raises:
        ConfigError: When the rate of so many trainings at a time was not measured.
    """
    found: list[tuple[bool, float, int, float, ExperimentConfig]] = []
    unseen = config.evaluate.per_unseen_cell  # 0: as many as in the other cells
    for replicates, factor in itertools.product(REPLICATES, SCENES):
        evaluate = replace(
            config.evaluate,
            per_cell=max(1, round(factor * config.evaluate.per_cell)),
            per_unseen_cell=max(1, round(factor * unseen)) if unseen else 0,
        )
        sized = replace(config, replicates=replace(config.replicates, count=replicates), evaluate=evaluate)
        cost = cost_of(design_of(sized, trainer), rates, trainings)
        if cost.total_s <= budget_s:
            about_training = replicates >= MIN_REPLICATES
            found.append((about_training, -(cost.detectable or 1.0), replicates, factor, sized))
    return max(found, key=lambda item: item[:4])[4] if found else None
