"""Pre-training: one broad mix of demonstrations, a training on it, and a small named checkpoint to fine-tune from.

The same call continues an interrupted pre-training. The checkpoint states the content of the pre-training, which is
counted in the exported bags.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from roboxim_core.episode import EpisodeInfo
from roboxim_core.errors import ConfigError
from roboxim_core.user_folders import expanded
from roboxim_core.whole_files import write_json, write_whole
from roboxim_datasets.dataset import EXPORT_FILE
from roboxim_policies.learning.config import LearningConfig
from roboxim_recorder.bag import BagReader
from roboxim_recorder.run_bags import run_bags
from roboxim_runs.datasets.export import ExportConfig, export_dataset
from roboxim_runs.episodes.generation import GenerationConfig, generate
from roboxim_runs.events import OnEvent, Reporter, ignore
from roboxim_runs.executors import Cancellation, Executor
from roboxim_runs.storage.folder import RunFolder, checked_path
from roboxim_runs.storage.occupied import require_own
from roboxim_runs.training.run import TRAINED_ON, TrainingResult, train_policy

Handled = TypeVar("Handled")

TARGET = "target"
"""What pairs name; earlier versions counted the first role, e.g. the plate, and did not state it."""
SUITE = "pretrain"
"""Suite of ``config/suites`` that is demonstrated."""


@dataclass(frozen=True, kw_only=True)
class PretrainConfig:
    """What a pre-training consists of."""

    learning: LearningConfig
    """Family, network and training."""
    out: Path | str = "runs/pretrain"
    """Folder of everything."""
    name: str = ""
    """Name of the checkpoint; empty: that of the folder."""
    suite: str = SUITE
    """Suite of demonstrations."""
    episodes: int = 0
    """Number of demonstrations; 0: those of the suite."""
    size: int | tuple[int, int] = 128
    """Image size [px]: the side of a square, or width and height."""
    seed: int = 0
    """Seed of the demonstrations."""
    workers: int = 2
    """Processes that demonstrate."""
    renderer: str = "raster"
    """Renderer."""

    @property
    def checkpoint_name(self) -> str:
        """Name of the checkpoint.

        Raises:
            ConfigError: When it is not the name of a file.
        """
        name = self.name or expanded(self.out).name
        if not name or Path(name).name != name:
            raise ConfigError(f"the name of a checkpoint is a file's name without folders, got '{name}'")
        return name


@dataclass(frozen=True, kw_only=True)
class PretrainResult:
    """Result of a pre-training."""

    checkpoint: Path
    """The packed checkpoint, for ``--from`` and for the policy."""
    exposure: dict[str, Any]
    """What was demonstrated, see `exposure_of`."""
    training: TrainingResult
    """The training."""


def pretrain(
    config: PretrainConfig,
    *,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    executor: Executor | None = None,
) -> PretrainResult:
    """Demonstrate a mix, train on it, and pack the checkpoint with its name and exposure.

    Args:
        config: What is demonstrated and trained.
        on_event: Receives the events of all stages.
        cancellation: Ends the call when it is set; the same call continues.
        executor: Runs the demonstrations; none: processes of this machine.

    Raises:
        CancelledError: When the call was cancelled.
        ConfigError: When the configuration is wrong, or the folder holds something else.
        RoboximError: When a stage fails.
    """
    from roboxim_policies.learning.checkpoint import policy_only  # importing JAX takes a second

    out, name = checked_path(config.out), config.checkpoint_name
    demonstrations = GenerationConfig(
        out=out / "demos", suite=config.suite, episodes=config.episodes, seed=config.seed, workers=config.workers,
        size=config.size, renderer=config.renderer, noise_mm=6.0, noise_mrad=20.0, first_try=True,
    )  # fmt: skip
    require_own(out, "pretrain", own=("demos",))
    _require_same_number(out, len(demonstrations.job().indices))
    made = generate(demonstrations, on_event=on_event, cancellation=cancellation, executor=executor)
    made.require_any()
    export_dataset(
        "rlds", out / "demos", out / "rlds", ExportConfig(val_fraction=0.0, uneven=True), on_event=on_event,
        cancellation=cancellation,
    )  # fmt: skip
    training = train_policy(
        out / "rlds", out / "training", config.learning, on_event=on_event, cancellation=cancellation
    )
    bags = run_bags(out / "demos").paths  # as exported: all that the folder has
    reporter = Reporter(on_event, cancellation)
    with reporter.stage("counting what was demonstrated", len(bags), "episodes") as report:
        infos = []
        for number, bag in enumerate(bags):
            infos.append(BagReader(bag).info)
            report(number + 1)
    exposure = exposure_of(infos)
    trained_on = json.loads((out / "training" / TRAINED_ON).read_text())
    pretraining = {"name": name, "suite": config.suite, "dataset": trained_on["identity"], "exposure": exposure}
    packed = out / f"{name}.npz"
    content = policy_only(training.checkpoint, pretraining)
    if not packed.is_file() or packed.read_bytes() != content:
        write_whole(packed, content)
    write_json(out / "exposure.json", pretraining)
    return PretrainResult(checkpoint=packed, exposure=exposure, training=training)


def _require_same_number(out: Path, wanted: int) -> None:
    """Refuse more demonstrations in the folder of a pre-training that has begun to train.

    Raises:
        ConfigError: Naming both numbers.
    """
    made = len(RunFolder(out / "demos").results())
    if next((out / "rlds").rglob(EXPORT_FILE), None) and made < wanted:
        raise ConfigError(
            f"{out} holds a pre-training on {made} demonstrations, got --episodes {wanted}: give {made}, or another "
            "--out"
        )


def exposure_of(infos: Iterable[EpisodeInfo]) -> dict[str, Any]:
    """Count what demonstrations contain.

    Args:
        infos: The episodes.

    Returns:
        ``episodes``; and by name the number of episodes with each of ``skills``, ``objects`` (models in any role or as
        distractors), ``pairs`` (``SKILL MODEL``, see `handled_in`), ``looks``, ``cameras`` (name and place, metres),
        ``robots``; and ``instructions``, the number of different ones.
    """
    counts: dict[str, Counter[str]] = {
        kind: Counter() for kind in ("skills", "objects", "pairs", "looks", "cameras", "robots")
    }
    instructions, episodes = set(), 0
    for info in infos:
        task, scene = info.task, info.scene
        episodes += 1
        instructions.add(task.instruction)
        counts["skills"][task.skill] += 1
        counts["objects"].update({entity.model for entity in scene.entities})
        counts["pairs"].update({f"{task.skill} {handled.model}" for handled in handled_in(task.objects)})
        counts["looks"][task.drawn.get("look", "as the scene")] += 1
        counts["cameras"].update(
            f"{camera.name} " + " ".join(f"{x:.2f}" for x in camera.pose.position) for camera in scene.cameras
        )
        counts["robots"][scene.robot.model] += 1
    found: dict[str, Any] = {kind: dict(sorted(counter.items())) for kind, counter in counts.items()}
    return {"episodes": episodes, **found, "pairs_of": TARGET, "instructions": len(instructions)}


def handled_in(objects: Mapping[str, Handled]) -> tuple[Handled, ...]:
    """Return the objects that a task is about: its ``target``, and all of them where no role has this name.

    Args:
        objects: Role to object.
    """
    return (objects[TARGET],) if TARGET in objects else tuple(objects.values())
