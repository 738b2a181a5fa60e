"""Training of a network of any family: deterministic for a seed, interruptible at any step, exactly resumable.

Everything random (the order of the samples, the augmentation) is a function of (seed, step). A checkpoint therefore
needs only the weights, the optimiser's state and the step, and a resumed training gives the same bits as an
uninterrupted one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
import optax
from jax import Array

from roboxim_core.config import from_json, to_json, to_plain
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.differences import differences
from roboxim_policies.learning.augment import seen
from roboxim_policies.learning.checkpoint import Checkpoint, Chosen, Statistics, load_checkpoint, save_checkpoint
from roboxim_policies.learning.config import LearningConfig
from roboxim_policies.learning.data import Demonstrations
from roboxim_policies.learning.families import config_class, make_network
from roboxim_policies.learning.features import state_features
from roboxim_policies.learning.samples import Samples, loss_of
from roboxim_policies.learning.start import carried_statistics, carried_weights, record_of, require_start
from roboxim_policies.learning.supply import Supply
from roboxim_policies.learning.validation import HeldOut

DEAD_DELTA = 1e-5
CHECKPOINT = "checkpoint.npz"


@dataclass(frozen=True, kw_only=True)
class TrainProgress:
    """Progress of a training, for a progress bar."""

    step: int
    """Steps done."""
    steps: int
    """Steps in all."""
    loss: float
    """Loss, averaged over the last steps."""
    parts: dict[str, float]
    """The loss's parts."""
    steps_per_s: float
    """Steps per second since this start, compilation excluded [1/s]."""


def statistics(data: Demonstrations) -> Statistics:
    """Measure the normalisation of inputs and outputs.

    A component of the actions that is always 0 gets scale 0, so that the policy outputs exactly 0 instead of noise.
    """
    motion = data.actions[:, :6].astype(np.float64)
    scale = np.sqrt(np.mean(motion**2, axis=0))
    scale[:2] = np.sqrt(np.mean(scale[:2] ** 2))  # one scale, because the network turns these vectors
    state = state_features(data.proprio, data.yaw, data.grasps, data.least_opening, data.released, data.failed)
    target_scale = np.maximum(data.targets.std(axis=0), 1e-2)
    target_scale[:2] = np.sqrt(np.mean(target_scale[:2] ** 2))
    return Statistics(
        state_mean=state.mean(axis=0).astype(np.float32),
        state_scale=np.maximum(state.std(axis=0), 1e-2).astype(np.float32),
        motion_scale=np.where(np.abs(motion).max(axis=0) < DEAD_DELTA, 0.0, scale).astype(np.float32),
        target_mean=data.targets.mean(axis=0).astype(np.float32),
        target_scale=target_scale.astype(np.float32),
    )


class Trainer:
    """Trainer on demonstrations in memory; `run` may be interrupted and called again."""

    def __init__(
        self, data: Demonstrations, config: LearningConfig, out: Path, *, resume: bool = True,
        encoding: Callable[[int, int], None] = lambda done, total: None, held_out: Demonstrations | None = None,
        start: Checkpoint | None = None,
    ) -> None:  # fmt: skip
        """Prepare a training, or continue from the folder's checkpoint.

        Args:
            data: The demonstrations.
            config: Network and training.
            out: Folder for the checkpoint.
            resume: Whether to continue from an existing checkpoint.
            encoding: Called with (pictures done, pictures in all) while a pre-trained encoder reads the pictures.
            held_out: Demonstrations that choose the weights, assembled like ``data``; needed where the configuration
                holds some out.
            start: Checkpoint whose averaged weights and normalisation the training begins with; None: they are drawn
                and measured.

        Raises:
            ConfigError: When a checkpoint exists and ``resume`` is False; when it belongs to another configuration,
                dataset or start, or has no state to continue from, see `checkpoint.policy_only`; or when ``start`` is
                of another family or shape.
        """
        self.data, self.config, self.out = data, config, out
        self.path = out / CHECKPOINT
        self.cameras = tuple(sorted(data.images))
        self.stats = statistics(data)
        if bool(config.held_out) != bool(held_out):
            raise ConfigError(f"held_out is {config.held_out}, and there are {'' if held_out else 'no '}such episodes")
        self._started_from = record_of(start) if start else {}
        self._identity = Checkpoint.identity_of(config, data, self._started_from, held_out)
        if start:
            require_start(start, config, data)
            self.stats = carried_statistics(start, self.stats)
            weights = carried_weights(start, config, data)
        else:
            weights, _ = make_network(config, self.cameras, len(data.vocabulary), config.seed)
        # State, step and choice are one value, so that an interruption cannot separate them.
        state: tuple[Any, ...] = (weights, _optimizer(config).init(weights), weights)
        self._at: tuple[Any, int, Chosen | None] = ((*state, weights) if config.held_out else state, 0, None)
        if self.path.exists():
            self._resume(resume)
        self._supply = Supply(data, config, progress=encoding)
        self._samples = self._supply.samples(self.stats)
        self._held_out = HeldOut(held_out, config, self.stats, self.cameras) if held_out else None
        self._update = _compiled_update(config.FAMILY, to_json(config), self.cameras, len(data.vocabulary))

    def _resume(self, resume: bool) -> None:
        if not resume:
            raise ConfigError(f"{self.path} exists; resume it or choose another folder")
        found = load_checkpoint(self.path)
        if not found.continues:
            raise ConfigError(
                f"an earlier version of RoboXim wrote {self.path}: its policy acts, and its training cannot be "
                "continued. To train again, choose another output folder (--out or out=)"
            )
        if found.identity != self._identity:
            ignored = () if self.config.held_out else ("checkpoint_every",)
            changes = differences(to_plain(found.config), to_plain(self.config), ignore=ignored)
            other = [f"another configuration ({changes})"] if changes else []
            if found.config.FAMILY != self.config.FAMILY:
                other = [f"another family ('{found.config.FAMILY}', not '{self.config.FAMILY}')"]
            if found.started_from.get("digest") != self._started_from.get("digest"):
                other.append("another start (--from)")
            elif found.identity.rpartition("-")[2] != self._identity.rpartition("-")[2]:
                other.append("another dataset")
            raise ConfigError(
                f"{self.path} is of {' and '.join(other) or 'another version of RoboXim'}; "
                "choose another output folder (--out or out=), or continue with the same configuration and dataset"
            )
        if found.original_sha256:
            done = "has all its steps" if found.step >= self.config.steps else "cannot continue"
            raise ConfigError(
                f"{self.path} has the averaged weights only, after {found.step} of {self.config.steps} steps: 'roboxim "
                f"experiment pack' left out the optimiser's state. The policy runs from it; the training {done}. "
                "To train again, choose another output folder (--out or out=)"
            )
        self._at = found.restore(self._at[0]), found.step, found.chosen

    @property
    def done(self) -> bool:
        """Whether nothing is left to train: all steps are done, or the held-out loss has stopped to fall."""
        chosen, patience = self.chosen, self.config.patience
        return self.step >= self.config.steps or bool(patience and chosen and chosen.since >= patience)

    @property
    def chosen(self) -> Chosen | None:
        """The best weights so far by their loss on held-out demonstrations."""
        return self._at[2]

    @property
    def step(self) -> int:
        """Number of completed steps."""
        return self._at[1]

    def run(self, progress: Callable[[TrainProgress], None] = lambda report: None, *, until: int = 0) -> Path:
        """Train to the end; on any exception (Ctrl-C included) save a checkpoint first.

        Args:
            progress: Called about once per second.
            until: Stop after this step; 0: run to the configured end.

        Returns:
            The checkpoint's path.

        Raises:
            ConfigError: When the loss is no longer finite; the checkpoint stays what it was.
        """
        last = min(until or self.config.steps, self.config.steps)
        begun = first = self.step
        started = time.monotonic()
        recent: list[dict[str, Array]] = []
        try:
            while self.step < last and not self.done:
                step = self.step + 1
                due = step % self.config.checkpoint_every == 0 or step == self.config.steps
                parts = self._one_step(choose=due)
                if self.step == begun + 1:  # the first step compiles
                    parts["loss"].block_until_ready()
                    started, first = time.monotonic(), self.step
                recent.append(parts)
                if due or self.step % 10 == 0 or self.step == last:
                    report = self._report(recent, time.monotonic() - started, self.step - first)
                    if not math.isfinite(report.loss):
                        raise self._diverged(self.step)
                    progress(report)
                    recent.clear()
                if due:
                    self.save()
        except ConfigError:
            raise
        except BaseException:
            self.save()
            raise
        self.save()
        return self.path

    def _diverged(self, step: int) -> ConfigError:
        begun = f"{self.path} is as it was after an earlier step" if self.path.exists() else "no checkpoint was written"
        return ConfigError(
            f"the training has diverged: the loss or the weights are not finite at step {step}; {begun}. Train again "
            f"with a learning_rate below {self.config.learning_rate:g}, in another output folder"
        )

    def _one_step(self, *, choose: bool) -> dict[str, Array]:
        """Do a step, with the comparison that belongs to it: an interruption loses both or none."""
        parts: dict[str, Array]
        (*state, averaged), step, chosen = self._at
        kept = [averaged] if self.config.held_out else []
        state = state if kept else [*state, averaged]
        batch, draws = self._supply.batch(step)
        state, parts = self._update(tuple(state), self._samples, batch, draws, jnp.asarray(step))
        at = (*state, *kept), step + 1, chosen
        self._at = self._compared(*at) if choose else at
        return parts

    def _compared(self, state: tuple[Any, ...], step: int, before: Chosen | None) -> tuple[Any, int, Chosen | None]:
        """Take the present average as the policy's weights, if its loss on the held-out demonstrations is lowest."""
        if self._held_out is None:
            return state, step, before
        loss = self._held_out.loss(state[2])
        if not math.isfinite(loss):
            raise self._diverged(step)
        checks = before.checks + 1 if before else 1
        if before and before.loss <= loss:
            return state, step, replace(before, checks=checks, since=before.since + 1)
        now = Chosen(step=step, loss=loss, held_out=self._held_out.episodes, checks=checks, since=0)
        return (*state[:3], state[2]), step, now

    def first_batch(self, count: int) -> dict[str, tuple[npt.NDArray[np.float32], Array]]:
        """Return pictures of the first step's samples: as recorded, and as that step shows them to the network.

        Args:
            count: Most samples.

        Returns:
            By camera, twice shape (N, side, side, 3), in 0..1.
        """
        batch, draws = self._supply.batch(0)
        newest = slice(self.config.frames - 1, count * self.config.frames, self.config.frames)
        found = {}
        for name in self.cameras:
            recorded = np.asarray(self._samples.images[name])[np.asarray(batch)[newest]].astype(np.float32) / 255
            own = {key: value[newest] for key, value in draws.items() if key.startswith(f"{name}/")}
            found[name] = recorded, seen(jnp.asarray(recorded), name, own, self.config) + 0.5
        return found

    def _report(self, recent: list[dict[str, Array]], seconds: float, steps: int) -> TrainProgress:
        parts = {name: float(np.mean([float(p[name]) for p in recent])) for name in recent[0]}
        speed = steps / seconds if steps and seconds > 0 else 0.0
        return TrainProgress(
            step=self.step, steps=self.config.steps, loss=parts.pop("loss"), parts=parts, steps_per_s=speed,
        )  # fmt: skip

    def save(self) -> None:
        """Write the checkpoint. Before the first comparison on held-out demonstrations, the policy has the average.

        Raises:
            ConfigError: When the weights are not finite; the checkpoint stays what it was.
        """
        state, step, chosen = self._at
        state = state if chosen else (*state[:2], *[state[2]] * (len(state) - 2))
        if not jnp.isfinite(state[2]).all():
            raise self._diverged(step)
        self.out.mkdir(parents=True, exist_ok=True)
        save_checkpoint(
            self.path, state, step=step, config=self.config, data=self.data, stats=self.stats, chosen=chosen,
            identity=self._identity, started_from=self._started_from,
        )  # fmt: skip


@lru_cache(maxsize=4)
def _compiled_update(family: str, config_json: str, cameras: tuple[str, ...], vocabulary: int) -> Callable[..., Any]:
    """Return the compiled training step, compiled once per shape and process."""
    config = from_json(config_json, config_class(family))
    optimizer = _optimizer(config)
    _, network_of = make_network(config, cameras, vocabulary, config.seed)

    def update(state: Any, samples: Samples, batch: Array, draws: dict[str, Any], step: Array) -> Any:
        weights, optimizer_state, average = state
        inputs, wanted = samples.draw(batch, draws, config)

        def loss(weights: Array) -> tuple[Array, dict[str, Array]]:
            return loss_of(network_of(weights), inputs, wanted, config)

        gradient, parts = jax.grad(loss, has_aux=True)(weights)
        changes, optimizer_state = optimizer.update(gradient, optimizer_state, weights)
        weights = weights + changes
        decay = jnp.minimum(config.ema_decay, (1.0 + step) / (10.0 + step))
        average = decay * average + (1 - decay) * weights
        return (weights, optimizer_state, average), parts

    return jax.jit(update)


def _optimizer(config: LearningConfig) -> optax.GradientTransformation:
    warmup = min(config.warmup_steps, config.steps // 4)
    peak = config.learning_rate
    schedule = optax.warmup_cosine_decay_schedule(0.0, peak, warmup, max(config.steps, 2), config.decay_to * peak)
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(schedule, weight_decay=config.weight_decay))
