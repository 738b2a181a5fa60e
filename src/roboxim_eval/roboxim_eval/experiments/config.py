"""The experiment file: ``config/experiments/NAME.yaml``.

It states cells (combinations of factor levels), which of them are held out, the datasets of each training condition,
the trainings, the evaluations and the comparisons. Held-out cells are listed once, so that training and evaluation
cannot disagree. `roboxim_eval.experiments.cells` expands it to ordinary task mixes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from roboxim_core import limits
from roboxim_core.errors import ConfigError, one_of
from roboxim_eval.experiments.trainers import FORMAT, TrainerConfig

TASK = "task"
"""The factor whose levels are tasks of ``config/tasks``."""
WHERE = ("all", "seen", "unseen")
"""Groups of cells."""
VARIES = ("training", "data")
FULL = "full"
"""Name of the scale without replaced keys."""
MIN_SEED, MAX_SEED = 10_000, 2_000_000_000
"""Range of seeds of fresh scenes; the public ones are below."""
Match = Mapping[str, str]
"""Factor to level; a cell matches if it has all of them."""


@dataclass(frozen=True, kw_only=True)
class DatasetConfig:
    """Demonstrations of a training condition."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("export", "more")
    """Later fields, see `roboxim_core.config.LEFT_OUT`: cards and stages without them keep their hashes."""

    cells: str = "all"
    """``all``, ``seen`` (not held out) or ``unseen``."""
    per_cell: int
    """Demonstrations of each cell. Datasets with a cell in common have its first demonstrations in common."""
    more: dict[str, int] = field(default_factory=dict)
    """Cell, e.g. ``pick_up target=apple``, to demonstrations beyond ``per_cell``: the next ones of the cell."""
    only: tuple[dict[str, str], ...] = ()
    """Selection among those cells: a cell must match all factors of one of these; empty: all of them."""
    fault: str = ""
    """A data fault to plant, e.g. ``wrong_instruction``; empty: none."""
    share: float = 0.0
    """Share of the episodes with the fault, 0..1."""
    export: dict[str, Any] = field(default_factory=dict)
    """Options of its export that replace those of the trainer's ``dataset``, e.g. ``{actions: tool}``: actions along
    the tool's axes. The trainer must be able to learn from it."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: When a value is unknown or out of range.
        """
        _require_where("cells", self.cells)
        if not 1 <= self.per_cell <= limits.MIX_EPISODES:
            raise ConfigError(f"per_cell must be from 1 to {limits.MIX_EPISODES}, got {self.per_cell}")
        for cell, more in self.more.items():
            if not 0 <= more <= limits.MIX_EPISODES:
                raise ConfigError(f"more: numbers must be from 0 to {limits.MIX_EPISODES}, got {more} of '{cell}'")
        if not 0.0 <= self.share <= 1.0 or bool(self.fault) != bool(self.share):
            raise ConfigError(f"share must be from 0 to 1, and above 0 with a fault alone; got {self.share:g}")
        if FORMAT in self.export:
            raise ConfigError("export: the trainer chooses the format of its datasets; leave out format")


@dataclass(frozen=True, kw_only=True)
class NoiseConfig:
    """Noise in the free motions of demonstrations: they show the policy how to return to the path."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("descents",)
    """Later fields, see `roboxim_core.config.LEFT_OUT`: cards without them keep their hashes."""

    translation_mm: float = 6.0
    """Standard deviation per axis and tick [mm]."""
    rotation_mrad: float = 20.0
    """Standard deviation per axis and tick [mrad]."""
    descents: float = 0.0
    """Share of this noise on descents, until 5 cm before a grasp and 3 cm before a place, 0..1."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: When one is out of range, or ``descents`` is a share of no noise.
        """
        for name, maximum in (("translation_mm", 50.0), ("rotation_mrad", 200.0), ("descents", 1.0)):
            if not 0.0 <= getattr(self, name) <= maximum:
                raise ConfigError(f"{name} must be from 0 to {maximum:g}, got {getattr(self, name):g}")
        if self.descents and not (self.translation_mm or self.rotation_mrad):
            raise ConfigError(
                f"descents {self.descents:g} is a share of translation_mm and rotation_mrad, which are both 0; set one "
                "of them, or leave descents out"
            )


@dataclass(frozen=True, kw_only=True)
class ConditionConfig:
    """A condition: policies that are trained, or evaluated, in the same way."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("arguments",)
    """Later fields, see `roboxim_core.config.LEFT_OUT`: cards without them keep their hashes."""

    about: str = ""
    """Purpose of the condition, one sentence."""
    train: str = ""
    """Dataset to train with."""
    checkpoint_of: str = ""
    """Condition whose checkpoints are evaluated in another way."""
    given: bool = False
    """Whether the policies exist already, e.g. public checkpoints; they are named by ``--policy CONDITION.R=SPEC``."""
    instruction: str | None = None
    """Instruction that the policy receives instead of the task's; empty: none at all."""
    latency_ticks: int = 0
    """Ticks by which each of the policy's answers arrives late in this condition's evaluation."""
    steps: int = 0
    """Training steps; 0: the trainer's."""
    arguments: dict[str, str] = field(default_factory=dict)
    """Trainer to arguments that this condition adds to its command, e.g. ``{bc: --set depth=2}``; see `design_of`."""
    set: dict[str, Any] = field(default_factory=dict)
    """Keys of the task to replace in this condition's evaluation."""

    def __post_init__(self) -> None:
        """Check that the policies have one origin.

        Raises:
            ConfigError: When none or several are given, steps or ticks are negative, or arguments are for a condition
                that is not trained.
        """
        if sum((bool(self.train), bool(self.checkpoint_of), self.given)) != 1:
            raise ConfigError(
                "give one of train (a dataset), checkpoint_of (a condition) and given: true (policies that exist)"
            )
        if self.steps < 0:
            raise ConfigError(f"steps must be >= 0, got {self.steps}")
        if self.arguments and not self.train:
            raise ConfigError("arguments: are those of a training; this condition has none (train)")
        if self.latency_ticks < 0:
            raise ConfigError(f"latency_ticks must be >= 0, got {self.latency_ticks}")


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """Rollouts of each policy."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("seed",)
    """Later fields, see `roboxim_core.config.LEFT_OUT`: cards and stages without them keep their hashes."""

    per_cell: int = 20
    """Rollouts of each cell."""
    per_unseen_cell: int = 0
    """Rollouts of each held-out cell, where it differs; 0: as ``per_cell``."""
    cells: dict[str, str] = field(default_factory=dict)
    """Condition to its cells: ``all``, ``seen`` or ``unseen``; conditions that are left out are evaluated in all."""
    max_steps: int = 0
    """Actions after which an episode has failed; 0: the task's limit."""
    seed: int = 0
    """Seed of the first replicate's scenes; 0: the public one, which every run of the file has."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: When a value is unknown or out of range.
        """
        if self.seed and not MIN_SEED <= self.seed <= MAX_SEED:
            raise ConfigError(f"seed must be 0 (public) or from {MIN_SEED} to {MAX_SEED}, got {self.seed}")
        for name, cells in self.cells.items():
            _require_where(f"cells.{name}", cells)
        if self.per_cell < 1 or self.per_unseen_cell < 0 or self.max_steps < 0:
            raise ConfigError("needs per_cell >= 1, per_unseen_cell >= 0 and max_steps >= 0")


@dataclass(frozen=True, kw_only=True)
class ReplicatesConfig:
    """Repetitions of the whole comparison."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("first_seed",)
    """Later fields, see `roboxim_core.config.LEFT_OUT`: cards and stages without them keep their hashes."""

    count: int = 5
    """Number of trainings of each condition; each has its own scenes, which all conditions share."""
    vary: tuple[str, ...] = ("training",)
    """What differs between replicates: ``training`` (the seed), and ``data`` (the demonstrations too)."""
    first_seed: int = 0
    """Seed of the first replicate's training and scenes; parts of a rotated design have their own seeds."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: When the number is out of range, or a name is unknown.
        """
        if not 1 <= self.count <= 1000:
            raise ConfigError(f"count must be from 1 to 1000, got {self.count}")
        if not 0 <= self.first_seed < 1000:
            raise ConfigError(f"first_seed must be from 0 to 999, got {self.first_seed}")
        for name in self.vary:
            if name not in VARIES:
                raise ConfigError(f"vary: unknown '{name}'; {one_of(VARIES, name)}")


@dataclass(frozen=True, kw_only=True)
class CurveConfig:
    """Learning curve, on scenes that the final evaluation never uses."""

    every: int
    """Training steps between checkpoints."""
    per_checkpoint: int = 20
    """Rollouts of each checkpoint, spread over the cells."""
    replicates: int = 0
    """Trainings with a curve, the first ones; 0: all."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: When one is out of range.
        """
        if self.every < 1 or self.per_checkpoint < 1 or self.replicates < 0:
            raise ConfigError("needs every >= 1, per_checkpoint >= 1 and replicates >= 0")


@dataclass(frozen=True, kw_only=True)
class CombinationsConfig:
    """Transfer as a curve: success in held-out cells against the number of cells that were trained with."""

    seen: tuple[int, ...]
    """Numbers of seen cells, ascending; each set of cells contains the smaller ones."""
    demonstrations: int
    """Demonstrations of each training, the same for all numbers of cells; divisible by each of them."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: When they do not ascend, or the demonstrations cannot be spread evenly.
        """
        if len(self.seen) < 2 or self.seen[0] < 1 or list(self.seen) != sorted(set(self.seen)):
            raise ConfigError(f"seen: expected at least two ascending numbers of cells, got {list(self.seen)}")
        odd = [number for number in self.seen if self.demonstrations % number or self.demonstrations < number]
        if odd:
            raise ConfigError(
                f"demonstrations: {self.demonstrations} cannot be spread evenly over {odd[0]} cells; give a "
                f"multiple of {math.lcm(*self.seen)}"
            )


@dataclass(frozen=True, kw_only=True)
class CompareConfig:
    """A comparison of two conditions, or of one condition in two groups of cells."""

    first: str
    """Condition."""
    second: str
    """Condition that it is compared with."""
    where: str = "all"
    """Cells of the first condition: ``all``, ``seen`` or ``unseen``."""
    against: str = ""
    """Cells of the second condition; empty: the same as of the first."""
    primary: bool = False
    """Whether the experiment was designed for this comparison; the first sentence of the report is about it."""

    def __post_init__(self) -> None:
        """Check the groups of cells.

        Raises:
            ConfigError: When one is unknown.
        """
        _require_where("where", self.where)
        if self.against:
            _require_where("against", self.against)
        if self.first == self.second and (not self.against or self.against == self.where):
            raise ConfigError(f"'{self.first}' is compared with itself; give another second or against")


@dataclass(frozen=True, kw_only=True)
class DecideConfig:
    """Limits of the verdicts."""

    alpha: float = 0.05
    """Probability of any false alarm within the file, two-sided; at most 0.05, because 95 % intervals are shown."""
    margin: float = 0.10
    """Largest difference of success rates that counts as equally good."""
    refuse_below: float = 0.10
    """Lower bound of the baseline's success rate below which no ratio is stated."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a number is out of range.
        """
        if not 0.0 < self.alpha <= 0.05:
            raise ConfigError(f"alpha must be above 0 and at most 0.05, got {self.alpha:g}")
        if not 0.0 < self.margin < 1.0:
            raise ConfigError(f"margin must be between 0 and 1, got {self.margin:g}")
        if not 0.0 <= self.refuse_below < 1.0:
            raise ConfigError(f"refuse_below must be from 0 to below 1, got {self.refuse_below:g}")


@dataclass(frozen=True, kw_only=True)
class ExperimentConfig:
    """A YAML file of ``config/experiments``."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("combinations",)
    """Later fields, see `roboxim_core.config.LEFT_OUT`: cards and stages without them keep their hashes."""

    about: str
    """The question, one sentence."""
    thesis: str = ""
    """Section of the thesis that the shipped experiments follow (see the glossary), e.g. ``5.4.3``; empty: none."""
    deviations: tuple[str, ...] = ()
    """What differs from the thesis, a sentence each."""
    factors: dict[str, Any]
    """Factor to its levels. A list: tasks of ``config/tasks`` (factor ``task``) or object models (a role, e.g.
    ``target``). A mapping: level to the keys of the task that it sets, e.g. ``camera: {left: {reset: ...}}``. Object
    models may be drawn by seed: ``target: {draw: {set: shapes, count: 60, hold_out: 15, seed: 1}}``."""
    dimensions: dict[str, str] = field(default_factory=dict)
    """Factor to the benchmark's dimension that it varies, e.g. ``{task: skill, target: object}``."""
    unseen: tuple[dict[str, str], ...] = ()
    """Held-out cells: those that match all factors of one of these."""
    cells: tuple[dict[str, str], ...] = ()
    """Cells that exist: those that match all factors of one of these; empty: every combination."""
    set: dict[str, Any] = field(default_factory=dict)
    """Keys of every task to replace; a null removes a key."""
    datasets: dict[str, DatasetConfig] = field(default_factory=dict)
    """Datasets by name."""
    conditions: dict[str, ConditionConfig] = field(default_factory=dict)
    """Conditions by name; at least one, unless ``combinations`` makes them."""
    trainers: dict[str, TrainerConfig] = field(default_factory=dict)
    """Trainers by name; the first one is the default."""
    evaluate: EvaluateConfig = EvaluateConfig()
    """Rollouts."""
    replicates: ReplicatesConfig = ReplicatesConfig()
    """Trainings of each condition."""
    combinations: CombinationsConfig | None = None
    """Transfer as a curve; it adds datasets, conditions and comparisons. None: the file states them."""
    curve: CurveConfig | None = None
    """Learning curve; none: only the last checkpoint is evaluated."""
    compare: tuple[CompareConfig, ...] = ()
    """Comparisons."""
    decide: DecideConfig = DecideConfig()
    """Limits of the verdicts."""
    noise: NoiseConfig = NoiseConfig()
    """Noise in the free motions of demonstrations."""
    image_size: str = "256x256"
    """Width and height of the recorded images [px]."""
    scales: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Scale to the keys of this file that it replaces, e.g. ``laptop: {replicates: {count: 3}}``."""

    @property
    def primary(self) -> CompareConfig | None:
        """The comparison that the experiment was designed for; none: it compares nothing."""
        return next((c for c in self.compare if c.primary), self.compare[0] if self.compare else None)

    def compares_same_trainings(self, compare: CompareConfig) -> bool:
        """Tell whether both sides of a comparison evaluate the same trainings."""
        return len({self.conditions[name].checkpoint_of or name for name in (compare.first, compare.second)}) == 1

    @property
    def blind(self) -> str:
        """Condition that evaluates the primary comparison's first condition without words; empty: none."""
        first = self.primary.first if self.primary else ""
        return next(
            (name for name, c in self.conditions.items() if c.checkpoint_of == first and c.instruction == ""), ""
        )


def _require_where(name: str, value: str) -> None:
    if value not in WHERE:
        raise ConfigError(f"{name}: unknown '{value}'; {one_of(WHERE, value)}")
