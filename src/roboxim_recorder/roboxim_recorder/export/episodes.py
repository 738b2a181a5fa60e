"""A bag as an `Episode`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from roboxim_core.config import to_json
from roboxim_core.errors import ErrorCode, RecorderError
from roboxim_core.proprioception import STATE_FIELDS, Proprioception, ProprioField
from roboxim_datasets.episode import Episode, Floats, ImageSize, Step
from roboxim_recorder.bag import BagReader, BagTick
from roboxim_recorder.export.selection import Source

SNAP = 1e-5
"""Smaller deltas [m or rad] become 0: normalised, the noise of a dead dimension would look like an action."""
PROPRIO_FIELDS = (*STATE_FIELDS, ProprioField.JOINT_POSITIONS, ProprioField.JOINT_VELOCITIES)
"""Proprioception that an episode of a bag has."""


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

    def read(cameras: Sequence[str]) -> Iterator[Step]:
        observed: BagTick | None = None
        index = 0
        for tick in BagReader(source.path).ticks(cameras=list(cameras)):
            if observed is not None:
                if tick.step.phase != "act":
                    break
                yield _step(index, observed, tick, success=success and index == result.steps - 1, source=source)
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
        metadata={
            "file_path": f"{source.path.parent.name}/{source.path.name}",
            "run_seed": info.run_seed,
            "index": info.index,
            "attempt": info.attempt,
            "skill": info.task.skill,
            "actor": info.actor,
            "task": to_json(info.task),
        },
        read=read,
    )


def _step(index: int, observed: BagTick, following: BagTick, *, success: bool, source: Source) -> Step:
    measured = Proprioception.of(observed.state, source.info.scene.robot.pose)
    return Step(
        index=index,
        images=observed.images,
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
