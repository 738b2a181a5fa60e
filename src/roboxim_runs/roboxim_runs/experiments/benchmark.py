"""Runs a benchmark: its experiments one after the other, each in a folder of its name, then one card for all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.plain_data.differences import differences
from roboxim_core.plain_data.documents import read_json
from roboxim_core.plain_data.shell import shell_line
from roboxim_core.whole_files import write_json, write_whole
from roboxim_eval.benchmark.card import BenchmarkCard, check_benchmark_card, concluded_benchmark
from roboxim_eval.benchmark.config import BenchmarkConfig, experiment_changes
from roboxim_eval.experiments import ExperimentConfig
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.fresh import SceneSeed
from roboxim_eval.experiments.reductions import deciding
from roboxim_runs.events import OnEvent, ignore
from roboxim_runs.executors import Cancellation, Executor
from roboxim_runs.experiments.card import CARD_FILE
from roboxim_runs.experiments.files import benchmark_experiments, load_benchmark, trainer_name
from roboxim_runs.experiments.report import (
    REPORT_FILE,
    ExperimentFolder,
    card_warnings,
    folder_card,
    has_only_card,
    policy_words,
    stored_card,
    write_card,
)
from roboxim_runs.experiments.report import STATE_FILE as EXPERIMENT_STATE_FILE
from roboxim_runs.experiments.run import run_experiment
from roboxim_runs.experiments.run_config import ExperimentRunConfig, SharedRunConfig
from roboxim_runs.experiments.scenes.fresh import in_scenes_of, store_seed, stored_seed
from roboxim_runs.policies.specs import PolicySpec
from roboxim_runs.storage.folder import checked_path, make_folder
from roboxim_runs.storage.occupied import require_own

STATE_FILE = "benchmark.json"


@dataclass(frozen=True, kw_only=True)
class BenchmarkRunConfig(SharedRunConfig):
    """Configuration of a benchmark's run."""

    benchmark: str
    """Name in ``config/benchmark``, or a YAML file."""
    out: Path | str = "runs/benchmark"
    """The run's folder, with a subfolder for each experiment."""
    policies: Mapping[str, PolicySpec] = field(default_factory=dict)
    """Policies that exist: ``EXPERIMENT.CONDITION[.REPLICATE]`` to the policy."""
    experiments: tuple[str, ...] = ()
    """The experiments to run, e.g. on one of several machines; none: all."""
    cards: tuple[Path, ...] = ()
    """Cards of experiments that ran elsewhere, as this benchmark runs them."""
    trained: Path | str = ""
    """With ``fresh``: folder of a finished run of the benchmark, whose trainings are evaluated again; empty: none."""

    def __post_init__(self) -> None:
        """Check the options of fresh scenes.

        Raises:
            ConfigError: When they exclude each other.
        """
        if self.trained and not self.fresh:
            raise ConfigError("--trained is for --fresh: without it the benchmark's folder has the trainings")
        if self.fresh and self.scene_seed:
            raise ConfigError("--fresh draws a seed; leave out --scene-seed")


@dataclass(frozen=True, kw_only=True)
class BenchmarkResult:
    """State of a benchmark after a call."""

    out: Path
    """The run's folder."""
    missing: tuple[str, ...]
    """``EXPERIMENT/STAGE`` of the stages that are not finished."""
    card: BenchmarkCard | None
    """Results; none while evaluations are missing."""


def run_benchmark(
    config: BenchmarkRunConfig,
    *,
    executor: Executor | None = None,
    training_executor: Executor | None = None,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
) -> BenchmarkResult:
    """Run the stages of a benchmark's experiments that its folder lacks; write its card and report at the end.

    Args:
        config: Configuration of the run.
        executor: Runs episodes and reads bags; none: processes of this machine.
        training_executor: Runs the trainings, see `run_experiment`; none: processes of this machine.
        on_event: Receives the events of all stages.
        cancellation: Ends the run when it is set.

    Raises:
        CancelledError: When the run was cancelled; the same call continues.
        ConfigError: When a file is invalid, a policy is not named, or inputs of a finished stage have changed.
        RoboximError: When a stage fails.
    """
    benchmark = load_benchmark(config.benchmark)
    out = checked_path(config.out)
    _require_experiments(benchmark, config)
    changes = experiment_changes(benchmark, config.scale)
    experiments = benchmark_experiments(benchmark, config.scale, config.trainer)  # a refused call leaves no state
    seed = _seed_of(benchmark, config)
    cards = _cards_from_elsewhere(benchmark, experiments, config, seed)
    require_own(out, "benchmark", after=("experiment attest",))
    make_folder(out)
    state = {"benchmark": config.benchmark, "scale": config.scale, "trainer": config.trainer}
    _require_same(out / STATE_FILE, state)
    write_json(out / STATE_FILE, state)
    for name, card in cards.items():
        make_folder(out / name)
        write_card(card, out / name)
    shared: dict[str, Any] = {one.name: getattr(config, one.name) for one in fields(SharedRunConfig)}
    missing: list[str] = []
    for name in benchmark.experiments:
        if has_only_card(out / name):
            continue
        if config.experiments and name not in config.experiments:
            missing.append(name)
            continue
        result = run_experiment(
            ExperimentRunConfig(
                **shared, experiment=name, out=out / name, changes=changes, benchmark=config.benchmark,
                policies=_policies_of(name, config.policies),
                trained=checked_path(config.trained) / name if config.trained else "",
            ),
            executor=executor, training_executor=training_executor, on_event=on_event, cancellation=cancellation,
            scenes=seed,
        )  # fmt: skip
        if seed is not None:  # only now: what is refused leaves no seed behind
            store_seed(seed, out)
        missing += [f"{name}/{stage}" for stage in result.missing]
        if result.card is None and not any(one.startswith(f"{name}/") for one in missing):
            missing.append(name)
    written = None if missing else write_benchmark_report(out)
    return BenchmarkResult(out=out, missing=tuple(missing), card=written)


def _seed_of(benchmark: BenchmarkConfig, config: BenchmarkRunConfig) -> SceneSeed | None:
    """Return the seed of fresh scenes that a benchmark's experiments share; none: the public scenes, or a given seed.

    It is the folder's, or that of an experiment of it, as of a first one that was interrupted.
    """
    out = checked_path(config.out)
    folders = (out, *(out / name for name in benchmark.experiments))
    stored = next((seed for folder in folders if (seed := stored_seed(folder)) is not None), None)
    return SceneSeed.drawn() if stored is None and config.fresh else stored


def _cards_from_elsewhere(
    benchmark: BenchmarkConfig, experiments: Mapping[str, ExperimentConfig], config: BenchmarkRunConfig,
    seed: SceneSeed | None,
) -> dict[str, Card]:  # fmt: skip
    """Return the cards that were named, and those that the folder holds without a run, by experiment.

    Raises:
        ConfigError: When a card was changed, is not of this benchmark, or a run of its experiment is in the folder.
    """
    out = checked_path(config.out)
    stored = [out / name / CARD_FILE for name in benchmark.experiments if has_only_card(out / name)]
    planned = {name: in_scenes_of(one, seed.seed if seed else config.scene_seed) for name, one in experiments.items()}
    found: dict[str, Card] = {}
    for path in (*stored, *config.cards):
        card = stored_card(path)
        name = card.experiment.name
        if name not in benchmark.experiments:
            raise ConfigError(f"{path} is of experiment '{name}'; {one_of(benchmark.experiments, name)}")
        if path in config.cards and (out / name / EXPERIMENT_STATE_FILE).exists():
            raise ConfigError(f"{path}: {out / name} has a run of '{name}' already; leave the card out")
        if name in found and found[name].sha256 != card.sha256:
            raise ConfigError(f"{path}: another card of '{name}' is given, or in {out / name}; name one of them")
        trainer = trainer_name(planned[name], config.trainer)
        if trainer != card.experiment.trainer:
            there, here = (f"'{one}'" if one else "the first trainer of its file" for one in
                           (card.experiment.trainer, trainer))  # fmt: skip
            raise ConfigError(f"{path} has {there}, and --trainer is {here}")
        ran, planned_here = deciding(card.experiment.config), deciding(planned[name])
        if changed := differences(ran, planned_here, words=("in the card", "here")):
            raise ConfigError(
                f"{path}: its experiment '{name}' differs from the one of this benchmark at scale {config.scale} "
                f"({changed}); run it by --experiment {name}"
            )
        found[name] = card
    return found


def _require_experiments(benchmark: BenchmarkConfig, config: BenchmarkRunConfig) -> None:
    for name in config.experiments:
        if name not in benchmark.experiments:
            raise ConfigError(f"no experiment '{name}' in this benchmark; {one_of(benchmark.experiments, name)}")
    for name in config.policies:
        first = name.partition(".")[0]
        if first not in benchmark.experiments:
            raise ConfigError(
                f"--policy {name}: expected EXPERIMENT.CONDITION[.R]; {one_of(benchmark.experiments, first)}"
            )


def _policies_of(experiment: str, policies: Mapping[str, PolicySpec]) -> dict[str, PolicySpec]:
    start = f"{experiment}."
    return {name.removeprefix(start): policy for name, policy in policies.items() if name.startswith(start)}


def _require_same(path: Path, state: Mapping[str, str]) -> None:
    if not path.exists():
        return
    stored = read_json(path)
    for key, value in state.items():
        if stored.get(key) != value:
            raise ConfigError(
                f"{path.parent} holds a benchmark with {key} '{stored.get(key)}', not '{value}'; choose another output "
                "folder (--out)"
            )


def benchmark_card(out: Path) -> BenchmarkCard:
    """Return the card of a benchmark's folder, from the checked cards of its experiments.

    Raises:
        ConfigError: When the folder is not a benchmark's, evaluations are missing, or a card was changed.
    """
    path = out / STATE_FILE
    if not path.exists():
        raise ConfigError(f"{out} is not the folder of a benchmark: it has no {STATE_FILE}")
    stored = read_json(path)
    benchmark = load_benchmark(stored["benchmark"])
    cards = {name: _card_of(out / name) for name in benchmark.experiments}
    return concluded_benchmark(BenchmarkCard(
        name=Path(stored["benchmark"]).stem, scale=stored["scale"], about=benchmark.about, thesis=benchmark.thesis,
        reference=benchmark.reference, experiments=cards,
    ))  # fmt: skip


def _card_of(folder: Path) -> Card:
    return stored_card(folder / CARD_FILE) if has_only_card(folder) else folder_card(ExperimentFolder.of(folder))


def write_benchmark_report(out: Path) -> BenchmarkCard:
    """Write ``card.json`` and ``report.html`` of a benchmark whose experiments are finished; return the card.

    Raises:
        ConfigError: When evaluations are missing, or a card was changed.
    """
    from roboxim_eval.report.benchmark import benchmark_page

    card = benchmark_card(out)
    pages = {name: f"{name}/{REPORT_FILE}" for name in card.experiments if (out / name / REPORT_FILE).exists()}
    write_json(out / CARD_FILE, card.plain)
    write_whole(out / REPORT_FILE, benchmark_page(
        card, command=benchmark_reproduction(out, card.experiments), pages=pages, warnings=benchmark_warnings(card),
    ))  # fmt: skip
    return card


def benchmark_warnings(card: BenchmarkCard) -> dict[str, tuple[str, ...]]:
    """Return what weakens the results of each experiment besides its card's warnings, see `card_warnings`."""
    return {name: card_warnings(one) for name, one in card.experiments.items()}


def benchmark_card_page(card: BenchmarkCard) -> str:
    """Return the page of a card without its run's folder."""
    from roboxim_eval.report.benchmark import benchmark_page

    return benchmark_page(card, warnings=benchmark_warnings(card))


def benchmark_reproduction(out: Path, experiments: Iterable[str]) -> str:
    """Return the command that runs a benchmark again, as far as its folder states it.

    Args:
        out: The benchmark's folder.
        experiments: Its experiments; those that ran elsewhere enter by their cards.
    """
    stored = read_json(out / STATE_FILE)
    words = ["roboxim", "benchmark", stored["benchmark"], "--scale", stored["scale"], "--out", out.name]
    words += ["--trainer", stored["trainer"]] if stored.get("trainer") else []
    here = {name: ExperimentFolder.of(out / name) for name in experiments if not has_only_card(out / name)}
    renderer = next((folder.renderer for folder in here.values()), "")
    words += ["--renderer", renderer] if renderer else []
    seed = next((folder.design.config.evaluate.seed for folder in here.values()), 0)
    words += ["--scene-seed", str(seed)] if seed else []
    for name in experiments:
        words += policy_words(here[name], f"{name}.") if name in here else ["--card", f"{out.name}/{name}/{CARD_FILE}"]
    return shell_line(*words)


def stored_benchmark_card(path: Path) -> BenchmarkCard:
    """Return the checked card of a file.

    Raises:
        ConfigError: When it is no benchmark's card, or was changed.
    """
    return check_benchmark_card(read_json(path), source=str(path))
