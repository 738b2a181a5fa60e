"""The simulated world: a scene spec becomes bodies, actions become ticks, ticks become state records.

Every reset rebuilds the world from scratch in one fixed order: PyBullet reproduces results bit for bit only in a fresh
world, not after moving the bodies of an old one. A snapshot therefore consists of a scene and the actions since tick 0.
Restoring it executes the actions again and checks the hash of every tick.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace
from types import TracebackType
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from roboxim_core import limits
from roboxim_core.actions import ActionSemantics
from roboxim_core.config import digest
from roboxim_core.errors import ErrorCode, InvalidRequestError, SimError, one_of
from roboxim_core.kinematics import ArmKinematics, Controller, ControllerState, DeltaController, JointController
from roboxim_core.models.description import RobotModel
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import ScenePoses
from roboxim_core.poses import Pose, Vec3
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_core.state import StateRecord
from roboxim_sim.bodies import ObjectBody
from roboxim_sim.physics import Physics
from roboxim_sim.snapshots import Snapshot
from roboxim_sim.trajectories import JointTrajectory, checked_trajectory

R = TypeVar("R")


class World:
    """A robot at a table in PyBullet. A context manager; use it from one thread at a time.

    Non-obvious: while an episode holds the world, time advances in ticks (`tick`), otherwise freely (`step`,
    `follow`, `move_gripper`). Free motion marks the record as ``disturbed``, because actions alone cannot
    reproduce it.
    """

    def __init__(self, library: ModelLibrary | None = None) -> None:
        """Connect to an in-process physics server.

        Args:
            library: Library of the models; none: RoboXim's own.
        """
        self.library = library or ModelLibrary()
        self.physics = Physics()
        """The bodies. Move them only through this world, otherwise its records become wrong."""
        self._arms: dict[str, ArmKinematics] = {}
        self._scene: SceneSpec | None = None
        self._tick0_scene: SceneSpec | None = None
        self._episode_id = ""
        self._moving = self._stopped = False
        self._loads = 0
        self._scene_poses: ScenePoses | None = None

    def __enter__(self) -> World:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """Disconnect from the physics server."""
        self.physics.close()

    # ---------------------------------------------------------------- state

    @property
    def scene(self) -> SceneSpec:
        """The current scene, with spawned and without deleted entities.

        Raises:
            SimError: With code ``NO_SCENE`` when nothing is loaded.
        """
        if self._scene is None:
            raise SimError("no scene is loaded; load one first", ErrorCode.NO_SCENE)
        return self._scene

    @property
    def loaded(self) -> bool:
        """Whether a scene is loaded."""
        return self._scene is not None

    @property
    def episode_id(self) -> str:
        """Id of the episode that holds the world; empty: none."""
        return self._episode_id

    @property
    def record(self) -> StateRecord:
        """The current state.

        Raises:
            SimError: With code ``NO_SCENE`` when nothing is loaded.
        """
        _ = self.scene
        return self._record

    @property
    def robot(self) -> RobotModel:
        """The robot's model.

        Raises:
            SimError: With code ``NO_SCENE`` when nothing is loaded.
        """
        return self.library.robot(self.scene.robot.model)

    @property
    def first_scene(self) -> SceneSpec:
        """The scene as it was loaded.

        Raises:
            SimError: With code ``NO_SCENE`` when nothing is loaded.
        """
        _ = self.scene
        assert self._tick0_scene is not None
        return self._tick0_scene

    @property
    def moving(self) -> bool:
        """Whether free steps, a trajectory or a gripper motion are in progress."""
        return self._moving

    @property
    def steps_per_tick(self) -> int:
        """Number of physics steps in a control period.

        Raises:
            SimError: With code ``NO_SCENE`` when nothing is loaded.
        """
        return round(self.scene.physics_rate_hz / self.scene.control_rate_hz)

    def require_entity(self, name: str) -> None:
        """Check that the scene has an entity of this name.

        Raises:
            SimError: With code ``NO_SCENE``, or ``UNKNOWN_ENTITY`` and the list of known names.
        """
        self._object(name)

    @property
    def scene_poses(self) -> ScenePoses:
        """Computes the poses of the scene's bodies and cameras from a state; replaced when the scene changes.

        Raises:
            SimError: With code ``NO_SCENE`` when nothing is loaded.
        """
        scene = self.scene
        if self._scene_poses is None:
            self._scene_poses = ScenePoses(scene, self.library, self._controller.arm)
        return self._scene_poses

    def body_poses(self) -> dict[str, Pose]:
        """Return the poses of all moving bodies in the world, by the keys of `render_world`."""
        return self.scene_poses.body_poses(self._record)

    def camera_poses(self) -> dict[str, Pose]:
        """Return the poses of all cameras' optical frames in the world, by camera name."""
        return self.scene_poses.camera_poses(self._record.robot)

    def link_poses(self) -> dict[str, Pose]:
        """Return the poses of all robot links in the world, by link name."""
        return self.scene_poses.link_poses(self._record.robot)

    # ---------------------------------------------------------------- life of a scene

    def load(self, scene: SceneSpec, episode_id: str = "", semantics: ActionSemantics | None = None) -> StateRecord:
        """Rebuild the world from a scene and let it settle.

        Args:
            scene: The scene.
            episode_id: Episode that holds the world afterwards; empty: none.
            semantics: Meaning of the ticks' actions, one that `ActionSemantics.executed` returns; none: the default.

        Returns:
            Tick 0.

        Raises:
            ConfigError: When a model, modifier or camera parent is unknown; the old world then remains.
            InvalidRequestError: When the robot's start is beyond its limits.
            EvaluationError: With code ``SEMANTICS_MISMATCH`` when the simulator does not execute these semantics.
        """
        semantics = _executable(semantics, scene)
        model = self.library.robot(scene.robot.model)
        if scene.robot.model not in self._arms:
            self._arms[scene.robot.model] = ArmKinematics(model)
        arm = self._arms[scene.robot.model]
        joints = self._start_joints(scene, arm)
        models = {entity.name: self.library.entity_model(entity) for entity in scene.entities}
        ScenePoses(scene, self.library, arm)
        self._scene = None  # until the new world is complete

        self.physics.build(scene, model, joints, models)
        make = JointController if semantics.control.is_joint_space else DeltaController
        self._controller: Controller = make(
            arm, workspace=scene.workspace, pose_base_in_world=scene.robot.pose, semantics=semantics
        )
        self._semantics = semantics
        self._command = self._controller.start(joints, scene.robot.gripper_opening)
        self._moving = False
        self._loads += 1
        self._steps_per_tick = round(scene.physics_rate_hz / scene.control_rate_hz)
        self._step_ns = 1e9 / scene.physics_rate_hz
        self._scene = self._tick0_scene = scene
        self._scene_hash = digest(scene)
        self._rewatch()
        self._advance(max(0, scene.settle_steps - self._steps_per_tick))
        self.physics.begin_tick()
        self._advance(min(scene.settle_steps, self._steps_per_tick))
        self._episode_id = episode_id
        self._seq = self._steps = 0
        self._disturbed = False
        self._record = self._read()
        self._actions: list[tuple[float, ...]] = []
        self._hashes = [self._record.state_hash]
        return self._record

    def release(self, episode_id: str = "") -> None:
        """Release the world from an episode; its state does not change.

        Args:
            episode_id: The episode that holds the world; empty: any.

        Raises:
            SimError: With code ``LEASE_HELD`` when another episode holds the world.
        """
        if episode_id and self._episode_id and episode_id != self._episode_id:
            raise SimError(f"episode '{self._episode_id}' holds the sim, not '{episode_id}'", ErrorCode.LEASE_HELD)
        self._episode_id = ""

    def tick(self, seq: int, action: npt.ArrayLike, *, episode_id: str | None = None) -> StateRecord:
        """Execute one action.

        Args:
            seq: Number of the resulting tick: the last tick's + 1.
            action: An action of the episode's semantics: 7 numbers by default, else one per arm joint and the gripper.
            episode_id: The requesting episode; none: not checked.

        Returns:
            The new tick.

        Raises:
            SimError: With code ``NO_SCENE``, ``LEASE_HELD`` (another episode) or ``WRONG_SEQ``.
            InvalidRequestError: With code ``INVALID_ACTION``. In all these cases the world has not moved.
        """
        _ = self.scene
        if self._moving:
            raise SimError("a trajectory or gripper motion is being executed; cancel it first", ErrorCode.LEASE_HELD)
        if episode_id is not None and episode_id != self._episode_id:
            holder = f"episode '{self._episode_id}' holds" if self._episode_id else "no episode holds"
            raise SimError(f"{holder} the sim, not '{episode_id}'; load a scene for it first", ErrorCode.LEASE_HELD)
        if seq != self._seq + 1:
            raise SimError(f"got tick {seq}, expected the next one, {self._seq + 1}", ErrorCode.WRONG_SEQ)
        step = self._controller.step(self._command, action, self._record.robot.joint_positions)
        self.physics.begin_tick()
        self.physics.robot.drive_gripper(step.state.gripper)
        before, self._command = self._command, step.state
        self._advance(self._steps_per_tick, before)
        self._seq += 1
        self._steps += self._steps_per_tick
        self._actions.append(step.action_executed)
        self._record = replace(
            self._read(),
            action_executed=step.action_executed,
            clipped=step.clipped,
            left_workspace=step.left_workspace,
        )
        self._hashes.append(self._record.state_hash)
        return self._record

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

    def move_gripper(
        self, opening: float, force_n: float | None = None, timeout_s: float = 3.0
    ) -> Generator[StateRecord, None, None]:
        """Move the gripper until it arrives or stalls; advances time.

        Args:
            opening: 1 = open, 0 = closed.
            force_n: Maximum force of each finger [N]; none: the model's.
            timeout_s: Simulated time after which the motion ends [s].

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
        return self._exclusive(self._move_gripper(opening, force_n, timeout_s))

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
            linear_velocity: Linear velocity, set together with the pose [m/s].
            angular_velocity: Angular velocity, set together with the pose [rad/s].
            joint_positions: Positions by joint name [m or rad].

        Raises:
            SimError: With code ``NO_SCENE`` or ``UNKNOWN_ENTITY``.
            InvalidRequestError: On a number that is not finite or an unknown joint.
        """
        body = self._object(name)
        limits.require_finite(f"the velocities of '{name}'", [*linear_velocity, *angular_velocity], limits.SPEED)
        limits.require_finite(f"the joint positions of '{name}'", (joint_positions or {}).values(), limits.LENGTH_M)
        if pose is not None:
            limits.require_finite(f"the position of '{name}'", pose.position, limits.LENGTH_M)
        for joint in joint_positions or {}:
            if joint not in body.joint_names:
                raise InvalidRequestError(f"'{name}' has no joint '{joint}'; {one_of(body.joint_names, joint)}")
        body.set_state(pose, linear_velocity, angular_velocity, joint_positions)
        return self._disturb()

    def spawn_entity(self, entity: EntitySpec) -> StateRecord:
        """Add an object; marks the episode as disturbed.

        Raises:
            SimError: With code ``NO_SCENE``.
            ConfigError: When the model is unknown.
            InvalidRequestError: When the name is taken.
        """
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
            SimError: With code ``DIVERGED`` and the first tick whose hash differs, or when a disturbed snapshot is to
                be restored exactly.
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
        snapshot.check(record)
        for seq, action in enumerate(snapshot.actions, 1):
            record = self.tick(seq, action)
            snapshot.check(record)
        return record

    # ---------------------------------------------------------------- inside

    def _start_joints(self, scene: SceneSpec, arm: ArmKinematics) -> tuple[float, ...]:
        joints = scene.robot.joint_positions or arm.model.home
        if len(joints) != len(arm.model.joint_names) or not arm.within_limits(joints, -1e-9):
            raise InvalidRequestError(
                f"the robot's start must be {len(arm.model.joint_names)} joint positions within "
                f"{arm.model.limits.lower} and {arm.model.limits.upper}, got {joints}",
                ErrorCode.START_OUTSIDE_LIMITS,
            )
        if not 0.0 <= scene.robot.gripper_opening <= 1.0:
            raise InvalidRequestError(f"gripper_opening must be from 0 to 1, got {scene.robot.gripper_opening}")
        return joints

    def _rewatch(self) -> None:
        self.physics.rewatch()
        self._scene_poses = None
        self.physics.robot.drive_gripper(self._command.gripper)

    def _advance(self, steps: int, before: ControllerState | None = None) -> None:
        """Step the physics while the arm's target moves at constant velocity from `before` to the current command."""
        self.physics.advance(steps, self._command.joints, None if before is None else before.joints)

    def _read(self) -> StateRecord:
        return self.physics.read(
            self._controller.arm,
            self._command,
            episode_id=self._episode_id,
            seq=self._seq,
            stamp_ns=round(self._steps * self._step_ns),
            disturbed=self._disturbed,
            scene_hash=self._scene_hash,
        )

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

    def _free_motion(self, steps: int, before: ControllerState | None = None) -> StateRecord:
        self._disturbed = True
        self.physics.begin_tick()
        self._advance(steps, before)
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

    def _object(self, name: str) -> ObjectBody:
        _ = self.scene
        for body in self.physics.objects:
            if body.name == name:
                return body
        names = [body.name for body in self.physics.objects]
        raise SimError(f"no entity '{name}' in the scene; {one_of(names, name)}", ErrorCode.UNKNOWN_ENTITY)

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

    def _move_gripper(
        self, opening: float, force_n: float | None, timeout_s: float
    ) -> Generator[StateRecord, None, None]:
        self._command = replace(self._command, gripper=float(opening))
        self.physics.robot.drive_gripper(opening, force_n)
        last, still = self._record.robot.gripper_opening, 0
        for _ in range(round(timeout_s * self.scene.control_rate_hz)):
            record = self._free_motion(self._steps_per_tick)
            yield record
            still = still + 1 if abs(record.robot.gripper_opening - last) < 0.005 else 0
            last = record.robot.gripper_opening
            if still >= 3:
                return

    def _restore_poses(self, snapshot: Snapshot, episode_id: str) -> StateRecord:
        record = snapshot.record
        self.load(snapshot.scene_now(self.library), episode_id, snapshot.semantics)
        self._command = replace(self._command, gripper=record.robot.gripper_command)
        self._seq = record.seq
        self._steps = round(record.stamp_ns / self._step_ns)
        return self._disturb()


def _executable(semantics: ActionSemantics | None, scene: SceneSpec) -> ActionSemantics:
    """Return the semantics at the scene's rate; refuse those that the simulator does not execute."""
    requested = semantics or ActionSemantics(rate_hz=scene.control_rate_hz)
    executed = requested.executed(scene.control_rate_hz)
    requested.require_compatible(executed, mine="the request", theirs="the simulator")
    return executed
