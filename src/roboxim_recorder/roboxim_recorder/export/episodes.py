"""A bag as an `Episode`: as it was recorded (`bag_episode`), or as an export writes it (`exported_episode`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ActionContext, ActionSemantics, ControlMode
from roboxim_core.actions.transforms import convert_rows
from roboxim_core.config import to_json
from roboxim_core.errors import ErrorCode, RecorderError
from roboxim_core.proprioception import STATE_FIELDS, Proprioception, ProprioField, component_names
from roboxim_core.rotation.representations import RotationRepresentation
from roboxim_datasets.episode import Episode, Floats, ImageSize, MetaValue, Step, Wanted
from roboxim_recorder.acted import ACTED_BY, ACTORS
from roboxim_recorder.bag import BagReader, BagTick
from roboxim_recorder.export.content import Content
from roboxim_recorder.export.sources import Source

SNAP = 1e-5
"""Smaller motions [m, rad or rad/s] become 0: normalised, the noise of a dead dimension would look like an action."""
PROPRIO_FIELDS = (*STATE_FIELDS, ProprioField.JOINT_POSITIONS, ProprioField.JOINT_VELOCITIES)
"""Proprioception that an episode of a bag has."""
Rows = npt.NDArray[np.float64]


def bag_episode(source: Source, joint_names: tuple[str, ...]) -> Episode:
    """Return a bag's episode as it was recorded, without the settling ticks at its end.

    A step pairs the observation of tick k with the action that leads to tick k + 1, as an imitator should output it
    (``action_label``: without the noise that was injected).

    Args:
        source: The bag.
        joint_names: Arm joints of its robot, in the order of their positions.
    """
    info = source.info
    words = info.task.step_words

    def read(wanted: Wanted) -> Iterator[Step]:
        for index, (observed, following) in enumerate(_actions_of(source, wanted)):
            measured = Proprioception.of(observed.state, info.scene.robot.pose)
            yield Step(
                index=index,
                images={camera: observed.images[camera] for camera in wanted.cameras},
                depth={camera: observed.depth[camera] for camera in wanted.depth},
                segmentation={camera: observed.segmentation[camera] for camera in wanted.segmentation},
                proprio={str(field): measured.vector((field,)) for field in PROPRIO_FIELDS},
                action=_snapped(np.array(following.step.action_label), info.semantics).astype(np.float32),
                action_executed=np.array(following.step.action_executed, np.float32),
                reward=float(_solved(source) and index == source.result.steps - 1),
                subtask=_at_hand(words, observed),
                stamp_s=observed.stamp_ns / 1e9,
            )

    return Episode(
        episode_id=info.episode_id,
        length=source.result.steps,
        instruction=info.task.instruction,
        subtasks=words,
        semantics=info.semantics,
        cameras={c.name: ImageSize(height=c.height, width=c.width) for c in info.scene.cameras},
        success=_solved(source),
        robot=info.scene.robot.model,
        joint_names=joint_names,
        fps=info.semantics.rate_hz,
        vectors={str(field): component_names((field,), joint_names) for field in PROPRIO_FIELDS},
        depth=tuple(c.name for c in info.scene.cameras if c.depth),
        segmentation=tuple(c.name for c in info.scene.cameras if c.segmentation),
        metadata=_metadata(source),
        read=read,
    )


def exported_episode(source: Source, content: Content) -> Episode:
    """Return a bag's episode as an export writes it.

    With a lower rate, step i holds the observation of tick k = i * ``every`` and the action that leads to tick
    k + ``every``; its target is the one that the last of these ticks commanded, so no rounding accumulates.

    Args:
        source: The bag.
        content: Content of the export.
    """
    length = -(-source.steps // content.every)
    description = content.describe((source,))
    words = tuple(map(content.instruction, source.step_words))

    def read(wanted: Wanted) -> Iterator[Step]:
        converted = _converted(source, content) if content.converts else None
        for index, (observed, following) in enumerate(_actions_of(source, wanted)):
            at, rest = divmod(index, content.every)
            if rest:
                continue
            measured = Proprioception.of(observed.state, source.info.scene.robot.pose)
            if converted is None:
                label = _snapped(np.array(following.step.action_label), content.recorded).astype(np.float32)
                executed = np.array(following.step.action_executed, np.float32)
            else:
                label, executed = (rows[at] for rows in converted)
            yield Step(
                index=at,
                images={camera: content.picture(camera, observed.images[camera]) for camera in wanted.cameras},
                depth={c: content.flat(c, observed.depth[c]) for c in wanted.depth},
                segmentation={c: content.flat(c, observed.segmentation[c]) for c in wanted.segmentation},
                proprio={name: make(measured) for name, make in content.vectors.items()},
                action=label,
                action_executed=executed,
                reward=float(source.solved and at == length - 1),
                subtask=_at_hand(words, observed),
                signals=_signals(source, index),
            )

    return Episode(
        episode_id=source.episode_id,
        length=length,
        instruction=content.instruction(source.instruction),
        subtasks=words,
        semantics=content.semantics,
        cameras=content.sizes,
        success=source.solved,
        robot=source.info.scene.robot.model,
        joint_names=content.joint_names,
        fps=description.fps,
        vectors=content.names,
        signals={ACTED_BY: ACTORS} if source.actors else {},
        depth=content.depth,
        segmentation=content.segmentation,
        metadata=_metadata(source),
        read=read,
    )


def _at_hand(words: Sequence[str], tick: BagTick) -> str | None:
    """Return the words of the step at hand at a tick; None: its task has one step."""
    number = tick.step.verdict.step
    return words[number - 1] if 0 < number <= len(words) else None


def _signals(source: Source, index: int) -> Mapping[str, Floats]:
    """Return who acted at a step, 1 for one of `ACTORS`."""
    if not source.actors:
        return {}
    acted = source.actors[source.first + index]
    return {ACTED_BY: np.array([float(acted == actor) for actor in ACTORS], np.float32)}


def _solved(source: Source) -> bool:
    return source.result.outcome == "success"


def _metadata(source: Source) -> Mapping[str, MetaValue]:
    info = source.info
    return {
        "file_path": f"{source.path.parent.name}/{source.path.name}",
        "run_seed": info.run_seed,
        "index": info.index,
        "attempt": info.attempt,
        "skill": info.task.skill,
        "actor": info.actor,
        "task": to_json(info.task),
        "final_state_hash": source.result.final_state_hash,
    }


def _actions_of(source: Source, wanted: Wanted) -> Iterator[tuple[BagTick, BagTick]]:
    """Yield the tick before and the tick after each action of the source's part.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when the bag has fewer actions than its result says.
    """
    by_kind = {"image": wanted.cameras, "depth": wanted.depth, "segmentation": wanted.segmentation}
    cameras = sorted({camera for cameras in by_kind.values() for camera in cameras})
    kinds = [kind for kind, of in by_kind.items() if of]
    observed: BagTick | None = None
    count = 0
    for tick in BagReader(source.path, info=source.info).ticks(cameras=cameras, kinds=kinds):
        if observed is not None:
            if tick.step.phase != "act":
                break
            if count >= source.first:
                yield observed, tick
            count += 1
            if count == source.first + source.steps:
                return
        observed = tick
    raise RecorderError(
        f"bag {source.path} has {count} actions, its result says {source.result.steps}; check it",
        ErrorCode.BAG_DAMAGED,
    )


def _converted(source: Source, content: Content) -> tuple[Floats, Floats]:
    """Return the labels and the executed actions of all exported steps, converted to the dataset's meaning."""
    pairs = list(_actions_of(source, Wanted()))
    count, every = len(pairs), content.every
    first = np.arange(0, count, every)
    last = np.minimum(first + every, count) - 1
    labels, executed = (
        np.array([getattr(following.step, name) for _, following in pairs], np.float32)
        for name in ("action_label", "action_executed")
    )
    base = source.info.scene.robot.pose
    kinematics = content.kinematics(source.info.scene.robot.model)
    track = [ActionContext.of(observed.state, base, kinematics) for observed, _ in pairs]
    after = [replace(c, joints_after=f.state.robot.joint_commands) for c, (_, f) in zip(track, pairs, strict=True)]
    same = (labels == executed).all(axis=1)  # elsewhere noise replaced the label, so its joints are unknown
    known = [found if kept else context for found, context, kept in zip(after, track, same, strict=True)]

    def convert(rows: Rows, states: Sequence[ActionContext]) -> Rows:
        """Convert recorded actions to the target of a step's last tick, relative to the state before its first tick."""
        recorded, wanted, ends = content.recorded, content.actions, [states[i] for i in last]
        if every == 1:
            return convert_rows(rows, recorded, wanted, ends)
        target = _absolute(wanted)
        targets = convert_rows(rows[last], recorded, replace(target, rate_hz=recorded.rate_hz), ends)
        return convert_rows(targets, target, wanted, [track[i] for i in first])

    label_rows = _snapped(convert(_snapped(labels, content.recorded), known), content.actions)
    executed_rows = convert(executed.astype(float), after)
    if content.named:
        action, frames = content.convention.action, content.convention.frames
        plain = replace(action, normalisation=None)  # trainers normalise by the dataset's own statistics
        label_rows, executed_rows = (plain.encode(rows, frames) for rows in (label_rows, executed_rows))
    return label_rows.astype(np.float32), executed_rows.astype(np.float32)


def _absolute(semantics: ActionSemantics) -> ActionSemantics:
    """Return the absolute meaning in the same space, without loss."""
    if semantics.control.is_joint_space:
        return replace(semantics, control=ControlMode.JOINT_POSITION)
    return replace(
        semantics,
        control=ControlMode.END_EFFECTOR_ABSOLUTE,
        frame="robot_base",  # type: ignore[arg-type]  # text becomes the enumeration
        rotation=RotationRepresentation.QUATERNION_XYZW,
    )


def _snapped(rows: npt.ArrayLike, semantics: ActionSemantics) -> Rows:
    """Return actions with tiny relative motions set to 0; shape (..., D)."""
    values = np.array(rows, float)
    if semantics.control.is_relative:
        motion = values[..., :-1]
        motion[np.abs(motion) < SNAP] = 0.0
    return values
