"""A world's full state as its scene and actions: PyBullet reproduces a state bit for bit only from a fresh world."""

from __future__ import annotations

from dataclasses import dataclass, replace

from roboxim_core import limits
from roboxim_core.actions import ActionSemantics
from roboxim_core.errors import ErrorCode, InvalidRequestError, SimError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_core.state import StateRecord


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """A world's full state, represented by the scene and the actions that lead to it."""

    scene: SceneSpec
    """The scene of tick 0."""
    semantics: ActionSemantics | None = None
    """Meaning of the actions; None: the default."""
    actions: tuple[tuple[float, ...], ...] = ()
    """Executed actions since tick 0, D float32 values each."""
    hashes: tuple[str, ...] = ()
    """State hash of every tick, tick 0 first; empty: hashes are not checked."""
    record: StateRecord
    """State at the snapshot."""

    def __post_init__(self) -> None:
        """Check the counts.

        Raises:
            InvalidRequestError: When there are too many actions, or hashes for only some ticks.
        """
        limits.require_count("actions of a snapshot", len(self.actions), limits.SNAPSHOT_ACTIONS)
        if self.hashes and len(self.hashes) != len(self.actions) + 1:
            raise InvalidRequestError(
                f"hashes must be none or one for tick 0 and each of the {len(self.actions)} actions, "
                f"got {len(self.hashes)}"
            )

    def check(self, record: StateRecord) -> None:
        """Compare the hash of a re-executed tick with the recorded one.

        Raises:
            SimError: With code ``DIVERGED`` and the tick, when the hashes differ.
        """
        expected = self.hashes[record.seq] if self.hashes else ""
        if expected and record.state_hash != expected:
            raise SimError(
                f"restoring diverged at tick {record.seq} of {len(self.actions)}: the state's hash is "
                f"{record.state_hash}, expected {expected}; do versions or the type of machine differ?",
                ErrorCode.DIVERGED,
            )

    def scene_now(self, library: ModelLibrary) -> SceneSpec:
        """Return a scene that starts at the snapshot's poses and measured joint positions, without velocities.

        Args:
            library: Source of the joint limits, which the physics may have exceeded slightly.
        """
        robot, ends = self.record.robot, library.robot(self.scene.robot.model).limits
        joints = tuple(map(_clamped, robot.joint_positions, ends.lower, ends.upper))
        opening = min(1.0, max(0.0, robot.gripper_opening))
        return replace(
            self.scene,
            entities=tuple(self._entity_now(spec, library) for spec in self.scene.entities),
            robot=replace(self.scene.robot, joint_positions=joints, gripper_opening=opening),
            settle_steps=0,
        )

    def _entity_now(self, spec: EntitySpec, library: ModelLibrary) -> EntitySpec:
        state = self.record.entity(spec.name)
        ends = {joint.name: (joint.lower, joint.upper) for joint in library.entity_model(spec).joints}
        positions = {
            name: _clamped(position, *ends[name])
            for name, position in zip(state.joint_names, state.joint_positions, strict=True)
        }
        return replace(spec, pose=state.pose, joint_positions=positions)


def _clamped(value: float, lower: float, upper: float) -> float:
    return min(max(value, lower), upper)
