"""The simulated world: a scene spec becomes bodies, actions become ticks, ticks become state records.

Every reset rebuilds the world from scratch in one fixed order: PyBullet reproduces results bit for bit only in a fresh
world, not after moving the bodies of an old one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy.typing as npt

from roboxim_core import limits
from roboxim_core.actions import ActionSemantics
from roboxim_core.closing import Closing
from roboxim_core.config import digest
from roboxim_core.errors import ErrorCode, InvalidRequestError, SimError, one_of
from roboxim_core.kinematics import ArmKinematics, Arms, Controller, ControllerState, DeltaController, JointController
from roboxim_core.models.description import RobotModel
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import ScenePoses
from roboxim_core.poses import Pose
from roboxim_core.specs import RESERVED_NAMES, SceneSpec, optical_frame
from roboxim_core.state import StateRecord
from roboxim_sim.bodies import ObjectBody
from roboxim_sim.physics import Physics

R = TypeVar("R")


class EpisodeWorld(Closing):
    """A robot at a table in PyBullet that executes the actions of an episode; see `World` for everything else."""

    def __init__(self, library: ModelLibrary | None = None) -> None:
        """Connect to an in-process physics server.

        Args:
            library: Library of the models; none: RoboXim's own.
        """
        self.library = library or ModelLibrary()
        self.physics = Physics()
        """The bodies. Move them only through this world, otherwise its records become wrong."""
        self._arms = Arms(self.library)
        self._scene: SceneSpec | None = None
        self._tick0_scene: SceneSpec | None = None
        self._episode_id = ""
        self._moving = self._stopped = False
        self._loads = 0
        self._scene_poses: ScenePoses | None = None

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

    @property
    def reserved_names(self) -> tuple[str, ...]:
        """Names that no entity may have: those of every scene's frames and bodies, the robot's links, the cameras.

        Raises:
            SimError: With code ``NO_SCENE`` when nothing is loaded.
        """
        return _reserved_names(self.scene, self._controller.arm)

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
            InvalidRequestError: When the robot's start is beyond its limits, or an entity has the name of one of its
                links or of a camera's frame; the old world then remains.
            EvaluationError: With code ``SEMANTICS_MISMATCH`` when the simulator does not execute these semantics; the
                old world then remains. After any other error no scene is loaded.
        """
        semantics = _executable(semantics, scene)
        model = self.library.robot(scene.robot.model)
        arm = self._arms[scene.robot.model]
        joints = self._start_joints(scene, arm)
        models = {entity.name: self.library.entity_model(entity) for entity in scene.entities}
        ScenePoses(scene, self.library, arm)
        for name in models:
            limits.require_name("entity", name, _reserved_names(scene, arm))
        self.unload()  # until the new world is complete

        self.physics.build(scene, model, joints, models)
        make = JointController if semantics.control.is_joint_space else DeltaController
        self._controller: Controller = make(
            arm, workspace=scene.workspace, pose_base_in_world=scene.robot.pose, semantics=semantics
        )
        self._semantics = semantics
        self._command = self._controller.start(joints, scene.robot.gripper_opening)
        self._steps_per_tick = round(scene.physics_rate_hz / scene.control_rate_hz)
        self._step_ns = 1e9 / scene.physics_rate_hz
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
        self._scene = self._tick0_scene = scene
        return self._record

    def unload(self) -> None:
        """Remove the scene: no episode holds the world, and requests fail with ``NO_SCENE`` until a scene is loaded."""
        self._scene, self._episode_id, self._moving = None, "", False
        self._loads += 1

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

    def _object(self, name: str) -> ObjectBody:
        _ = self.scene
        for body in self.physics.objects:
            if body.name == name:
                return body
        names = [body.name for body in self.physics.objects]
        raise SimError(f"no entity '{name}' in the scene; {one_of(names, name)}", ErrorCode.UNKNOWN_ENTITY)


def _reserved_names(scene: SceneSpec, arm: ArmKinematics) -> tuple[str, ...]:
    frames = [optical_frame(camera.name) for camera in scene.cameras]
    return (*RESERVED_NAMES, f"{arm.model.id}_base", *arm.link_names, *frames)


def _executable(semantics: ActionSemantics | None, scene: SceneSpec) -> ActionSemantics:
    """Return the semantics at the scene's rate; refuse those that the simulator does not execute."""
    requested = semantics or ActionSemantics(rate_hz=scene.control_rate_hz)
    executed = requested.executed(scene.control_rate_hz)
    requested.require_compatible(executed, owner="the request", other_owner="the simulator")
    return executed
