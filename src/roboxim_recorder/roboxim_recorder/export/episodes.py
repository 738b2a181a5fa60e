"""A bag as an `Episode`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from roboxim_core.config import to_json
from roboxim_core.errors import ErrorCode, RecorderError
from roboxim_core.images import resized
from roboxim_core.proprioception import STATE_FIELDS, Proprioception, ProprioField, component_names
from roboxim_datasets.episode import Episode, Floats, ImageSize, RGBImage, Step, Wanted
from roboxim_recorder.bag import BagReader, BagTick
from roboxim_recorder.export.selection import Selected, Source

SNAP = 1e-5
"""Smaller deltas [m or rad] become 0: normalised, the noise of a dead dimension would look like an action."""
PROPRIO_FIELDS = (*STATE_FIELDS, ProprioField.JOINT_POSITIONS, ProprioField.JOINT_VELOCITIES)
"""Proprioception that an episode of a bag has."""


def exported_episode(source: Source, selected: Selected) -> Episode:
    """Return a bag's episode as an export writes it.

    Args:
        source: The bag.
        selected: What the export consists of.
    """
    raw = bag_episode(source, selected.joint_names)
    description = selected.description

    def read(wanted: Wanted) -> Iterator[Step]:
        for step in raw.read(wanted):
            yield replace(
                step,
                images={camera: _fitting(image, selected.sizes[camera]) for camera, image in step.images.items()},
                proprio={
                    name: np.concatenate([step.proprio[field] for field in fields])
                    for name, fields in selected.vectors.items()
                },
            )

    return replace(raw, cameras=selected.sizes, vectors=description.features.vectors, read=read)


def _fitting(image: RGBImage, size: ImageSize) -> RGBImage:
    return resized(image, size.height, size.width)


def bag_episode(source: Source, joint_names: tuple[str, ...]) -> Episode:
    """Return a bag's episode without the settling ticks at its end.

    A step pairs the observation of tick k with the action that leads to tick k + 1, as an imitator should output it
    (``action_label``: without the noise that was injected).

    Args:
        source: The bag.
        joint_names: Arm joints of its robot, in the order of their positions.
    """
    info, result = source.info, source.result
    success = result.outcome == "success"

    def read(wanted: Wanted) -> Iterator[Step]:
        observed: BagTick | None = None
        index = 0
        for tick in BagReader(source.path).ticks(cameras=_cameras(wanted)):
            if observed is not None:
                if tick.step.phase != "act":
                    break
                solved = success and index == result.steps - 1
                yield _step(index, observed, tick, success=solved, source=source, wanted=wanted)
                index += 1
                if index == result.steps:
                    return
            observed = tick
        raise RecorderError(
            f"bag {source.path} has {index} actions, its result says {result.steps}; check it", ErrorCode.BAG_DAMAGED
        )

    return Episode(
        episode_id=info.episode_id,
        length=result.steps,
        instruction=info.task.instruction,
        semantics=info.semantics,
        cameras={c.name: ImageSize(height=c.height, width=c.width) for c in info.scene.cameras},
        success=success,
        robot=info.scene.robot.model,
        joint_names=joint_names,
        fps=info.semantics.rate_hz,
        vectors={str(field): component_names((field,), joint_names) for field in PROPRIO_FIELDS},
        depth=tuple(c.name for c in info.scene.cameras if c.depth),
        segmentation=tuple(c.name for c in info.scene.cameras if c.segmentation),
        metadata={
            "file_path": f"{source.path.parent.name}/{source.path.name}",
            "run_seed": info.run_seed,
            "index": info.index,
            "attempt": info.attempt,
            "skill": info.task.skill,
            "actor": info.actor,
            "task": to_json(info.task),
            "final_state_hash": result.final_state_hash,
        },
        read=read,
    )


def _cameras(wanted: Wanted) -> list[str]:
    return sorted({*wanted.cameras, *wanted.depth, *wanted.segmentation})


def _step(index: int, observed: BagTick, following: BagTick, *, success: bool, source: Source, wanted: Wanted) -> Step:
    measured = Proprioception.of(observed.state, source.info.scene.robot.pose)
    return Step(
        index=index,
        images={camera: observed.images[camera] for camera in wanted.cameras},
        depth={camera: observed.depth[camera] for camera in wanted.depth},
        segmentation={camera: observed.segmentation[camera] for camera in wanted.segmentation},
        proprio={str(field): measured.vector((field,)) for field in PROPRIO_FIELDS},
        action=_label(following.step.action_label),
        action_executed=np.array(following.step.action_executed, np.float32),
        reward=float(success),
    )


def _label(values: Sequence[float]) -> Floats:
    action = np.array(values, np.float32)
    deltas = action[:6]
    deltas[np.abs(deltas) < SNAP] = 0.0
    return action
