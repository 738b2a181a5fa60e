"""The simulated world: an episode's ticks, and beside them free motion, interference and snapshots.

A world is reproduced only by a rebuild (see `episode_world`). A snapshot therefore consists of a scene and the actions
since tick 0. Restoring it executes the actions again and checks the hash of every tick.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from roboxim_core import limits
from roboxim_core.config import digest
from roboxim_core.errors import ErrorCode, InvalidRequestError, SimError, one_of
from roboxim_core.poses import Pose, Vec3
from roboxim_core.specs import EntitySpec
from roboxim_core.state import StateRecord
from roboxim_sim.episode_world import EpisodeWorld
from roboxim_sim.snapshots import Snapshot
from roboxim_sim.trajectories import JointTrajectory, checked_trajectory

R = TypeVar("R")
GRIPPER_S = 3.0
"""Simulated time after which a motion of the gripper ends [s]."""
JOINT_SLACK = 1e-3
"""How far beyond its limits a joint may be set: the physics exceeds them slightly, too [m or rad]."""


class World(EpisodeWorld):
    """A robot at a table in PyBullet. A context manager; use it from one thread at a time.

    Non-obvious: while an episode holds the world, time advances in ticks (`tick`), otherwise freely (`step`,
    `follow`, `move_gripper`). Free motion marks the record as ``disturbed``, because actions alone cannot
    reproduce it.
    """

    # ---------------------------------------------------------------- free motion, outside an episode

    def step(self, steps: int) -> StateRecord:
        """Step the physics.

        Args:
            steps: Number of physics steps, >= 1.

        Raises:
            SimError: With code ``NO_SCENE`` or ``LEASE_HELD``.
            InvalidRequestError: On a number below 1.
        """
        *_, record = self.steps(steps)
        assert record is not None
        return record

    def steps(self, steps: int) -> Iterator[StateRecord | None]:
        """Step the physics, one control period at a time.

        Args:
            steps: Number of physics steps, >= 1.

        Yields:
            None after every control period, finally the state. When the generator is closed, after `stop_motion` and
            after a timeout, the world keeps the state that it has reached.

        Raises:
            SimError: With code ``NO_SCENE``, ``LEASE_HELD``, or ``CANCELLED`` after `stop_motion` or a new scene.
            InvalidRequestError: On a number below 1 or above `limits.STEPS`.
        """
        self.require_free("step")
        limits.require_range("steps", steps, 1, limits.STEPS)
        return self._exclusive(self._steps_in_periods(steps))

    def ticks(self, steps: int) -> Generator[StateRecord, None, None]:
        """Step the physics as `steps` does, with a state for each control period.

        Args:
            steps: Number of physics steps, >= 0.

        Yields:
            The state after every control period.

        Raises:
            SimError: See `steps`.
            InvalidRequestError: On a number above `limits.STEPS`.
        """
        self.require_free("step")
        limits.require_range("steps", steps, 0, limits.STEPS)
        return self._exclusive(self._ticks(steps))

    def checked_trajectory(
        self,
        times_s: Sequence[float],
        positions: npt.ArrayLike,
        velocities: npt.ArrayLike | None = None,
        accelerations: npt.ArrayLike | None = None,
    ) -> JointTrajectory:
        """Return a validated trajectory that starts at the arm's commanded position.

        Args:
            times_s: Increasing times from the start, shape (m,) [s].
            positions: Arm joint positions, shape (m, n) [rad].
            velocities: Arm joint velocities, shape (m, n) [rad/s]; none: straight lines between the points.
            accelerations: Arm joint accelerations, shape (m, n) [rad/s^2]; none: cubic instead of quintic splines.

        Raises:
            SimError: With code ``NO_SCENE`` or ``LEASE_HELD``.
            InvalidRequestError: With code ``TRAJECTORY_INVALID``; see `trajectories.checked_trajectory`.
        """
        self.require_free("follow a trajectory")
        return checked_trajectory(
            self._controller.arm, self._command.joints, times_s, positions, velocities, accelerations
        )

    def follow(self, trajectory: JointTrajectory, settle_s: float = 0.0) -> Generator[StateRecord, None, None]:
        """Move the arm along a checked trajectory; advances time.

        Args:
            trajectory: The trajectory.
            settle_s: Time to hold the last point [s].

        Yields:
            The state after every control period; closing the generator stops the arm at its current position.

        Raises:
            SimError: With code ``NO_SCENE`` or ``LEASE_HELD``.
        """
        self.require_free("follow a trajectory")
        return self._exclusive(self._follow(trajectory, settle_s))

    def move_gripper(self, opening: float, force_n: float | None = None) -> Generator[StateRecord, None, None]:
        """Move the gripper until it arrives or stalls, for `GRIPPER_S` at most; advances time.

        Args:
            opening: 1 = open, 0 = closed.
            force_n: Maximum force of each finger [N]; none: the model's.

        Yields:
            The state after every control period.

        Raises:
            SimError: With code ``NO_SCENE`` or ``LEASE_HELD``.
            InvalidRequestError: When the opening is not within 0..1.
        """
        self.require_free("move the gripper")
        if not 0.0 <= opening <= 1.0:
            raise InvalidRequestError(f"the gripper's opening must be from 0 (closed) to 1 (open), got {opening}")
        if force_n is not None:
            limits.require_range("the gripper's force [N]", force_n, 0.0, limits.FORCE_N)
        return self._exclusive(self._move_gripper(opening, force_n))

    # ---------------------------------------------------------------- interference

    def set_entity_state(
        self,
        name: str,
        pose: Pose | None = None,
        linear_velocity: Vec3 = (0.0, 0.0, 0.0),
        angular_velocity: Vec3 = (0.0, 0.0, 0.0),
        joint_positions: dict[str, float] | None = None,
    ) -> StateRecord:
        """Move an object; marks the episode as disturbed.

        Args:
            name: The entity.
            pose: Pose of its base in the world; none: unchanged.
            linear_velocity: Velocity of its base's centre of mass, set together with the pose [m/s].
            angular_velocity: Angular velocity, set together with the pose [rad/s].
            joint_positions: Positions by joint name [m or rad].

        Raises:
            SimError: With code ``NO_SCENE`` or ``UNKNOWN_ENTITY``.
            InvalidRequestError: On a number that is not finite, an unknown joint, or a position beyond its limits.
        """
        body = self._object(name)
        limits.require_finite(f"the velocities of '{name}'", [*linear_velocity, *angular_velocity], limits.SPEED)
        limits.require_finite(f"the joint positions of '{name}'", (joint_positions or {}).values(), limits.LENGTH_M)
        if pose is not None:
            limits.require_finite(f"the position of '{name}'", pose.position, limits.LENGTH_M)
        joints = {joint.name: joint for joint in body.model.joints}
        for joint, position in (joint_positions or {}).items():
            if joint not in joints:
                raise InvalidRequestError(f"'{name}' has no joint '{joint}'; {one_of(body.joint_names, joint)}")
            low, high = joints[joint].lower - JOINT_SLACK, joints[joint].upper + JOINT_SLACK
            limits.require_range(f"the position of joint '{joint}' of '{name}'", position, low, high)
        body.set_state(pose, linear_velocity, angular_velocity, joint_positions)
        return self._disturb()

    def spawn_entity(self, entity: EntitySpec) -> StateRecord:
        """Add an object; marks the episode as disturbed.

        Raises:
            SimError: With code ``NO_SCENE``.
            ConfigError: When the model is unknown.
            InvalidRequestError: When the name is taken or reserved.
        """
        limits.require_name("entity", entity.name, self.reserved_names)
        scene = replace(self.scene, entities=(*self.scene.entities, entity))
        model = self.library.entity_model(entity)
        self.physics.add(entity, model)
        self._scene, self._scene_hash = scene, digest(scene)
        return self._disturb()

    def delete_entity(self, name: str) -> StateRecord:
        """Remove an object; marks the episode as disturbed.

        Raises:
            SimError: With code ``NO_SCENE`` or ``UNKNOWN_ENTITY``.
        """
        self.physics.remove(self._object(name))
        self._scene = replace(self.scene, entities=tuple(e for e in self.scene.entities if e.name != name))
        self._scene_hash = digest(self._scene)
        return self._disturb()

    # ---------------------------------------------------------------- snapshots

    def snapshot(self) -> Snapshot:
        """Return the full state.

        Raises:
            SimError: With code ``NO_SCENE``.
        """
        record = self.record
        scene = self.scene if record.disturbed else self._tick0_scene or self.scene
        return Snapshot(
            scene=scene, semantics=self._semantics, actions=tuple(self._actions), hashes=tuple(self._hashes),
            record=record,
        )  # fmt: skip

    def restore(self, snapshot: Snapshot, episode_id: str = "", *, approximate: bool = False) -> StateRecord:
        """Restore a snapshot.

        Args:
            snapshot: The snapshot.
            episode_id: Episode that holds the world afterwards; empty: none.
            approximate: Set poses and joints instead of executing the actions again: contacts and velocities are lost
                and the record is marked as disturbed.

        Raises:
            SimError: With code ``DIVERGED`` and the first tick whose hash differs; no scene is loaded then. Or when a
                disturbed snapshot is to be restored exactly.
        """
        if approximate:
            return self._restore_poses(snapshot, episode_id)
        if snapshot.record.disturbed:
            raise SimError(
                "this snapshot was taken after interference or free motion, which actions do not re-create; "
                "restore it with approximate=True",
                ErrorCode.DIVERGED,
            )
        record = self.load(snapshot.scene, episode_id, snapshot.semantics)
        try:
            snapshot.check(record)
            for seq, action in enumerate(snapshot.actions, 1):
                record = self.tick(seq, action)
                snapshot.check(record)
        except Exception:
            self.unload()
            raise
        return record

    # ---------------------------------------------------------------- inside

    def require_free(self, what: str) -> None:
        """Check that no episode and no motion holds the world.

        Raises:
            SimError: With code ``NO_SCENE`` or ``LEASE_HELD``.
        """
        _ = self.scene
        if self._episode_id:
            raise SimError(
                f"cannot {what}: episode '{self._episode_id}' holds the sim; release it first", ErrorCode.LEASE_HELD
            )
        if self._moving:
            raise SimError(
                f"cannot {what}: another motion is being executed; cancel its goal, or sim/set_simulation_state to "
                "STATE_PAUSED",
                ErrorCode.LEASE_HELD,
            )

    def stop_motion(self) -> None:
        """End the motion in progress, if any, with ``CANCELLED``; the robot stays at its current position."""
        self._stopped = self._moving

    def _exclusive(self, motion: Generator[R, None, None]) -> Generator[R, None, None]:
        """Yield a motion's states and block other motions; end it when it is stopped or the scene is replaced."""
        loads, self._moving, self._stopped = self._loads, True, False
        try:
            for record in motion:
                yield record
                if self._loads != loads:
                    raise SimError("the scene was replaced during the motion", ErrorCode.CANCELLED)
                if self._stopped:
                    raise SimError("the motion was stopped on request", ErrorCode.CANCELLED)
        finally:
            motion.close()
            if self._loads == loads:
                self._moving = False

    def _steps_in_periods(self, steps: int) -> Generator[StateRecord | None, None, None]:
        self._disturbed = True
        self.physics.begin_tick()
        loads, done = self._loads, 0
        try:
            while done < steps:
                chunk = min(self._steps_per_tick, steps - done)
                self._advance(chunk)
                done += chunk
                yield None
        finally:
            if self._loads == loads:
                self._seq += 1
                self._steps += done
                self._record = self._read()
        yield self._record

    def _ticks(self, steps: int) -> Generator[StateRecord, None, None]:
        for done in range(0, steps, self._steps_per_tick):
            yield self._free_motion(min(self._steps_per_tick, steps - done))

    def _free_motion(self, steps: int) -> StateRecord:
        self._disturbed = True
        self.physics.begin_tick()
        self._advance(steps)
        self._seq += 1
        self._steps += steps
        self._record = self._read()
        return self._record

    def _disturb(self) -> StateRecord:
        self._disturbed = True
        self._rewatch()
        self._record = replace(
            self._read(),
            action_executed=self._record.action_executed,
            clipped=self._record.clipped,
            left_workspace=self._record.left_workspace,
        )
        return self._record

    def _follow(self, trajectory: JointTrajectory, settle_s: float) -> Generator[StateRecord, None, None]:
        rate = self.scene.physics_rate_hz
        total = int(np.ceil(trajectory.duration_s * rate - 1e-9))
        targets = trajectory.sample(np.arange(1, total + 1) / rate).tolist()
        for start in range(0, total, self._steps_per_tick):
            self._disturbed = True
            self.physics.begin_tick()
            steps = targets[start : start + self._steps_per_tick]
            for target in steps:
                before, self._command = self._command, replace(self._command, joints=tuple(target))
                self._advance(1, before)
            self._seq += 1
            self._steps += len(steps)
            self._command = replace(self._command, pose=self._controller.arm.fk(self._command.joints))
            self._record = self._read()
            yield self._record
        for _ in range(int(np.ceil(settle_s * self.scene.control_rate_hz - 1e-9))):
            yield self._free_motion(self._steps_per_tick)

    def _move_gripper(self, opening: float, force_n: float | None) -> Generator[StateRecord, None, None]:
        self._command = replace(self._command, gripper=float(opening))
        self.physics.robot.drive_gripper(opening, force_n)
        last, still = self._record.robot.gripper_opening, 0
        for _ in range(round(GRIPPER_S * self.scene.control_rate_hz)):
            record = self._free_motion(self._steps_per_tick)
            yield record
            still = still + 1 if abs(record.robot.gripper_opening - last) < 0.005 else 0
            last = record.robot.gripper_opening
            if still >= 3:
                return

    def _restore_poses(self, snapshot: Snapshot, episode_id: str) -> StateRecord:
        record = snapshot.record
        self.load(snapshot.scene_now(self.library), episode_id, snapshot.semantics)
        commands, gripper = record.robot.joint_commands, record.robot.gripper_command
        pose = self._controller.arm.fk(commands)
        self._command = replace(self._command, joints=commands, pose=pose, gripper=gripper)
        self._seq = record.seq
        self._steps = round(record.stamp_ns / self._step_ns)
        return self._disturb()
