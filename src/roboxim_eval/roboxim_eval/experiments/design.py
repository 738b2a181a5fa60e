"""Work of an experiment: demonstrations, trainings, rollouts, and the graph of stages between them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from roboxim_core.config import digest, to_plain
from roboxim_core.errors import ConfigError, one_of
from roboxim_eval.experiments.cells import Cell, cells_of, chosen, mix_of
from roboxim_eval.experiments.config import DatasetConfig, ExperimentConfig
from roboxim_eval.experiments.trainers import RLDS, TrainerConfig

DEMONSTRATION_SEED = 1000
EVALUATION_SEED = 2000
CURVE_SEED = 3000
CORRUPTION_SEED = 4000
"""Run seeds of the first replicate; the next replicates have the following ones. Curves never use final scenes."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """One training."""

    condition: str
    """Its condition."""
    replicate: int
    """Number of the replicate, from 0."""
    dataset: str
    """The dataset, see `Design.datasets`."""
    steps: int
    """Training steps; 0: unknown, since the trainer does not state them."""
    seed: int
    """Seed that the trainer's command receives; 0 for all replicates unless ``replicates.vary`` has ``training``."""
    arguments: str
    """Arguments that its condition adds to the trainer's command; empty: none."""
    checkpoints: tuple[int, ...]
    """Steps whose checkpoints are evaluated for the learning curve."""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Rollouts of one policy."""

    condition: str
    """Its condition."""
    replicate: int
    """Number of the replicate, from 0."""
    counts: dict[str, int]
    """Cell to number of rollouts."""
    checkpoint: int = 0
    """Training steps of a checkpoint on the learning curve; 0: the final one."""

    @property
    def rollouts(self) -> int:
        """Number of rollouts."""
        return sum(self.counts.values())


@dataclass(frozen=True, kw_only=True)
class Design:
    """An experiment, expanded."""

    config: ExperimentConfig
    """The experiment at its scale."""
    cells: tuple[Cell, ...]
    """All cells."""
    trainer: TrainerConfig
    """The chosen trainer."""
    demonstrations: dict[str, int]
    """Cell to number of demonstrations of one generation: the largest number of any dataset that has the cell."""
    generations: int
    """Number of generations: one for each replicate if the data varies, else 1; 0: no dataset is needed."""
    datasets: dict[str, dict[str, int]]
    """Dataset to number of demonstrations by cell: the first ones of each cell."""
    trainings: tuple[Training, ...]
    """All trainings."""
    evaluations: tuple[Evaluation, ...]
    """All evaluations."""

    @property
    def episodes(self) -> int:
        """Number of demonstrations in all generations."""
        return self.generations * sum(self.demonstrations.values())

    @property
    def rollouts(self) -> int:
        """Number of rollouts of all evaluations."""
        return sum(evaluation.rollouts for evaluation in self.evaluations)

    @property
    def steps(self) -> int:
        """Number of training steps of all trainings."""
        return sum(training.steps for training in self.trainings)

    @property
    def compared_scenes(self) -> int:
        """Rollouts of each training that the primary comparison counts; 0: it compares nothing."""
        primary = self.config.primary
        if primary is None:
            return 0
        return self.scenes(primary.first, primary.where)

    def counts(self, condition: str) -> dict[str, int]:
        """Return the numbers of rollouts by cell of a condition's final evaluations, which have equal ones.

        Raises:
            ConfigError: When it is not evaluated.
        """
        final = {e.condition: e.counts for e in self.evaluations if not e.checkpoint}
        if condition not in final:
            raise ConfigError(f"no condition '{condition}' is evaluated; {one_of(final, condition)}")
        return final[condition]

    def scenes(self, condition: str, where: str) -> int:
        """Return the rollouts of each of a condition's trainings in all, seen or unseen cells."""
        counts = self.counts(condition)
        return sum(counts.get(cell.key, 0) for cell in chosen(self.cells, where))


def design_of(config: ExperimentConfig, trainer: str = "") -> Design:
    """Expand an experiment.

    Args:
        config: The experiment at its scale.
        trainer: Name of a trainer of the file; empty: the first one.

    Raises:
        ConfigError: When a dataset has no cell, a comparison or the scores need cells that a condition is not evaluated
            in, trainings of a condition would be equal, or a condition has arguments for other trainers alone.
    """
    _check_replicates(config)
    cells = cells_of(config)
    trainer = trainer or next(iter(config.trainers), "")
    chosen_trainer = _trainer(config, trainer)
    datasets = {name: _counts(cells, name, dataset) for name, dataset in config.datasets.items()}
    used = {c.train for c in config.conditions.values() if c.train}
    demonstrations: dict[str, int] = {}
    for name in used:
        for cell, count in datasets[name].items():
            demonstrations[cell] = max(count, demonstrations.get(cell, 0))
    for name in used:
        if config.datasets[name].fault and datasets[name] != demonstrations:
            raise ConfigError(
                f"datasets.{name}: a fault is planted in a share of all demonstrations, so this dataset must have all "
                f"of them, {sum(demonstrations.values())}; it has {sum(datasets[name].values())}. Give all datasets "
                "the same cells and per_cell"
            )
    order = {cell.key: number for number, cell in enumerate(cells)}
    design = Design(
        config=config,
        cells=cells,
        trainer=chosen_trainer,
        demonstrations=dict(sorted(demonstrations.items(), key=lambda item: order[item[0]])),
        generations=(config.replicates.count if "data" in config.replicates.vary else 1) if used else 0,
        datasets={name: datasets[name] for name in datasets if name in used},
        trainings=tuple(_trainings(config, chosen_trainer, trainer)),
        evaluations=tuple(_evaluations(config, cells, chosen_trainer)),
    )
    _check_comparisons(design)
    _check_scores(design)
    return design


def require_different(design: Design) -> None:
    """Refuse conditions that a trainer's command would train alike: equal seeds would make them one policy.

    Raises:
        ConfigError: Naming two of them.
    """
    known: dict[tuple[Any, ...], str] = {}
    for training in design.trainings if design.trainer.command else ():
        recipe = training.replicate, training.seed, training.dataset, training.steps, training.arguments
        other = known.setdefault(recipe, training.condition)
        if other != training.condition:
            raise ConfigError(
                f"conditions.{training.condition}: would be trained like '{other}', with the same dataset, steps and "
                f"arguments. If it is evaluated in another way, write checkpoint_of: {other} in place of train; if "
                "not, give it another dataset (train), steps, or arguments for this trainer"
            )


def _check_replicates(config: ExperimentConfig) -> None:
    """Check that trainings of a condition differ: otherwise one training would count several times."""
    if not config.replicates.vary and any(condition.train for condition in config.conditions.values()):
        raise ConfigError(
            "replicates.vary: is empty, so that all trainings of a condition would have the same seed and the same "
            "demonstrations, and be equal; expected training, data or both, e.g. vary: [training]"
        )


def _trainer(config: ExperimentConfig, name: str) -> TrainerConfig:
    if not config.trainers:
        return TrainerConfig()
    if name not in config.trainers:
        raise ConfigError(f"no trainer '{name}' in the experiment; {one_of(config.trainers, name)}")
    return config.trainers[name]


def _counts(cells: tuple[Cell, ...], name: str, dataset: DatasetConfig) -> dict[str, int]:
    selected = chosen(cells, dataset.cells, dataset.only)
    if not selected:
        raise ConfigError(f"datasets.{name}: no cell is '{dataset.cells}' and matches 'only'")
    keys = [cell.key for cell in selected]
    for key in dataset.more:
        if key not in keys:
            raise ConfigError(f"datasets.{name}.more: no cell '{key}' in this dataset; {one_of(keys, key)}")
    return {key: dataset.per_cell + dataset.more.get(key, 0) for key in keys}


def _trainings(config: ExperimentConfig, trainer: TrainerConfig, trainer_name: str) -> Iterator[Training]:
    for name, condition in config.conditions.items():
        if trainer.command and condition.arguments and trainer_name not in condition.arguments:
            raise ConfigError(
                f"conditions.{name}: arguments are for {', '.join(condition.arguments)} alone, so trainer "
                f"'{trainer_name}' would train it like conditions without arguments; add what it needs there, e.g. "
                f'{trainer_name}: "--learning-rate 1e-4"'
            )
    for replicate in range(config.replicates.count):
        for name, condition in config.conditions.items():
            if condition.train:
                steps = condition.steps or trainer.steps
                yield Training(
                    condition=name, replicate=replicate, dataset=condition.train, steps=steps,
                    seed=config.replicates.first_seed + (replicate if "training" in config.replicates.vary else 0),
                    arguments=condition.arguments.get(trainer_name, ""),
                    checkpoints=_checkpoints(config, trainer, steps, replicate),
                )  # fmt: skip


def _checkpoints(config: ExperimentConfig, trainer: TrainerConfig, steps: int, replicate: int) -> tuple[int, ...]:
    curve = config.curve
    if curve is None or not trainer.until or (curve.replicates and replicate >= curve.replicates):
        return ()
    return tuple(range(curve.every, steps + 1, curve.every))


def _evaluations(config: ExperimentConfig, cells: tuple[Cell, ...], trainer: TrainerConfig) -> Iterator[Evaluation]:
    evaluate = config.evaluate
    for replicate in range(config.replicates.count):
        for name, condition in config.conditions.items():
            selected = chosen(cells, evaluate.cells.get(name, "all"))
            each = {cell.key: (cell.unseen and evaluate.per_unseen_cell) or evaluate.per_cell for cell in selected}
            if not each:
                raise ConfigError(f"evaluate.cells.{name}: no cell is '{evaluate.cells[name]}'")
            if condition.train and config.curve is not None:
                seen = [cell.key for cell in selected if not cell.unseen] or list(each)
                shares = _spread(config.curve.per_checkpoint, seen)
                for checkpoint in _checkpoints(config, trainer, condition.steps or trainer.steps, replicate):
                    yield Evaluation(condition=name, replicate=replicate, counts=shares, checkpoint=checkpoint)
            yield Evaluation(condition=name, replicate=replicate, counts=each)


def _spread(episodes: int, cells: list[str]) -> dict[str, int]:
    """Return a number of episodes spread over cells as evenly as possible."""
    counts = {cell: episodes // len(cells) + (place < episodes % len(cells)) for place, cell in enumerate(cells)}
    return {cell: count for cell, count in counts.items() if count}


def _check_comparisons(design: Design) -> None:
    for number, compare in enumerate(design.config.compare):
        for condition, where in ((compare.first, compare.where), (compare.second, compare.against or compare.where)):
            needed = chosen(design.cells, where)
            missing = [cell.key for cell in needed if cell.key not in design.counts(condition)]
            if not needed or missing:
                raise ConfigError(
                    f"compare.{number}: '{condition}' is not evaluated in "
                    f"{'any cell: none is ' + repr(where) if not needed else ', '.join(missing)}; change evaluate.cells"
                )


def _check_scores(design: Design) -> None:
    """Check that the condition without words is evaluated in all held-out cells, if the experiment has their scores.

    The scores need two other conditions there, those of the primary comparison: `_check_comparisons` checks them.
    """
    primary, blind = design.config.primary, design.config.blind
    if primary is None or primary.where != "unseen" or primary.against or not blind:
        return
    missing = [cell.key for cell in chosen(design.cells, "unseen") if cell.key not in design.counts(blind)]
    if missing:
        raise ConfigError(
            f"evaluate.cells.{blind}: '{blind}' evaluates '{primary.first}' without words, and the scores compare both "
            f"in all held-out cells, but '{blind}' is not evaluated in {', '.join(missing)}; expected {blind}: unseen "
            "or all"
        )


# ------------------------------------------------------------------ stages


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A stage of work: the same inputs give the same result on any machine, in every run."""

    name: str
    """Unique name, e.g. ``train/leave_out.0``; the folder of its result."""
    kind: str
    """``generate``, ``corrupt``, ``export``, ``train``, ``evaluate`` or ``prove``."""
    needs: tuple[str, ...]
    """Stages that must be finished before."""
    inputs: dict[str, Any]
    """All inputs of the result as plain data, except the stages that it needs."""
    sha: str
    """Hash of the inputs and of the needed stages' hashes."""

    @property
    def of_curve(self) -> bool:
        """Whether it is the proof of the rollouts of a learning curve."""
        return self.name.startswith("prove/curve")

    @property
    def part(self) -> str:
        """Group of the stage: ``generate``, ``export``, ``train`` or ``evaluate``."""
        if self.kind == "prove":
            return "export" if self.name.startswith("prove/training") else "evaluate"
        return "export" if self.kind == "corrupt" else self.kind


def stages_of(design: Design) -> tuple[Stage, ...]:
    """Return the stages of an experiment in an order in which they can run."""
    found: dict[str, Stage] = {}

    def add(kind: str, name: str, needs: tuple[str, ...], **inputs: Any) -> str:
        name = f"{kind}/{name}"
        sha = digest({"kind": kind, "inputs": inputs, "needs": [found[need].sha for need in needs]})
        found[name] = Stage(name=name, kind=kind, needs=needs, inputs=inputs, sha=sha)
        return name

    config = design.config
    for replicate in range(design.generations):
        add(
            "generate", f"{replicate}", (), mix=mix_of(config, design.demonstrations),
            episodes=sum(design.demonstrations.values()), seed=DEMONSTRATION_SEED + replicate, size=config.image_size,
            noise=to_plain(config.noise),
        )  # fmt: skip
        exports = []
        for name, counts in design.datasets.items():
            dataset, source = config.datasets[name], f"generate/{replicate}"
            if dataset.fault:
                source = add(
                    "corrupt", f"{name}.{replicate}", (source,), fault=dataset.fault, share=dataset.share,
                    counts=counts, seed=CORRUPTION_SEED + replicate,
                )  # fmt: skip
            exports.append(
                add(
                    "export", f"{name}.{replicate}", (source,), counts=counts, fault=dataset.fault,
                    share=dataset.share, **_exported(design.trainer, dataset),
                )
            )  # fmt: skip
        once = mix_of(config, {cell.key: 1 for cell in design.cells})
        add(
            "prove", f"training.{replicate}", tuple(exports), mix=once,
            unseen=[cell.key for cell in design.cells if cell.unseen],
        )  # fmt: skip
    for training in design.trainings:
        data = training.replicate if design.generations > 1 else 0
        add(
            "train", f"{training.condition}.{training.replicate}",
            (f"export/{training.dataset}.{data}", f"prove/training.{data}"),
            command=f"{design.trainer.command} {training.arguments}".strip(), steps=training.steps,
            seed=training.seed,
            checkpoints=list(training.checkpoints), until=design.trainer.until if training.checkpoints else "",
        )  # fmt: skip
    once = mix_of(config, {cell.key: 1 for cell in design.cells})
    for replicate in range(config.replicates.count):  # each is proved before the next one begins
        evaluations = [evaluation for evaluation in design.evaluations if evaluation.replicate == replicate]
        points: dict[str, list[str]] = {"evaluation": [], "curve": []}
        for evaluation in evaluations:
            condition = config.conditions[evaluation.condition]
            trained = condition.checkpoint_of or (evaluation.condition if condition.train else "")
            needs = (f"train/{trained}.{replicate}",) if trained in config.conditions else ()
            first = CURVE_SEED if evaluation.checkpoint else config.evaluate.seed or EVALUATION_SEED
            seed = first + config.replicates.first_seed + replicate
            at = f"@{evaluation.checkpoint}" if evaluation.checkpoint else ""
            points["curve" if at else "evaluation"].append(add(
                "evaluate", f"{evaluation.condition}.{replicate}{at}",
                tuple(need for need in needs if need in found), mix=mix_of(config, evaluation.counts, condition.set),
                episodes=evaluation.rollouts, seed=seed, checkpoint=evaluation.checkpoint, policy=design.trainer.policy,
                instruction=condition.instruction, latency_ticks=condition.latency_ticks,
                max_steps=config.evaluate.max_steps, **_policy_inputs(design.trainer, bool(needs)),
            ))  # fmt: skip
        for of, names in points.items():
            if names or of == "evaluation":
                add("prove", f"{of}.{replicate}", tuple(names), mix=once)
    return tuple(found.values())


def _exported(trainer: TrainerConfig, dataset: DatasetConfig) -> dict[str, Any]:
    """Return the inputs of an export that differ from the defaults: the format, and options."""
    options = {**trainer.export, **dataset.export}
    return ({} if trainer.format == RLDS else {"format": trainer.format}) | ({"options": options} if options else {})


def _policy_inputs(trainer: TrainerConfig, trained: bool) -> dict[str, Any]:
    """Return the inputs of a trained policy's evaluation that differ from the defaults: arguments, and the server."""
    given = {"policy_options": trainer.options, "serve": trainer.serve} if trained else {}
    return {name: value for name, value in given.items() if value}
