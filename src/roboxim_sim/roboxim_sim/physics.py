"""The bodies of a scene in PyBullet and the stepping of time, below `world`.

Python's overhead per physics step matters: PyBullet needs only about 0.1 ms for a step of a tabletop scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from roboxim_core.errors import ErrorCode, InvalidRequestError, SimError
from roboxim_core.kinematics import ArmKinematics, ControllerState
from roboxim_core.models.description import ObjectModel, RobotModel
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_core.state import StateRecord
from roboxim_sim.bodies import ObjectBody, build_table, configure
from roboxim_sim.bullet import BulletClient
from roboxim_sim.readout import TickObserver, hash_state, read_robot
from roboxim_sim.robot_body import RobotBody


class Physics:
    """An in-process PyBullet server with at most one scene. Use from one thread at a time."""

    robot: RobotBody
    """The robot."""

    def __init__(self) -> None:
        """Connect."""
        self.client = BulletClient()
        self.objects: list[ObjectBody] = []

    def close(self) -> None:
        """Disconnect. Closing twice is harmless."""
        if self.client.isConnected():
            self.client.disconnect()

    def build(
        self, scene: SceneSpec, robot: RobotModel, joints: Sequence[float], models: Mapping[str, ObjectModel]
    ) -> None:
        """Rebuild everything from scratch, in one fixed order.

        Args:
            scene: The scene.
            robot: The model of its robot.
            joints: Arm joint positions at the start [rad].
            models: Models by entity name.
        """
        configure(self.client, scene.physics_rate_hz)
        self._rate_hz = scene.physics_rate_hz
        self._base = scene.robot.pose
        self._fixed = build_table(self.client, scene.table)
        self.robot = RobotBody(self.client, robot, scene.robot, joints)
        self.objects = [ObjectBody(self.client, models[entity.name], entity) for entity in scene.entities]
        self.rewatch()

    def add(self, entity: EntitySpec, model: ObjectModel) -> None:
        """Add an object."""
        self.objects.append(ObjectBody(self.client, model, entity))

    def remove(self, body: ObjectBody) -> None:
        """Remove an object."""
        self.client.removeBody(body.id)
        self.objects.remove(body)

    def rewatch(self) -> None:
        """Restart the tick's observation after bodies were added, removed or moved."""
        self._observer = TickObserver(self.client, self.robot, self.objects, self._fixed)

    def begin_tick(self) -> None:
        """Clear the contacts and joint extremes of the last tick."""
        self._observer.begin()

    def advance(self, steps: int, end: Sequence[float], start: Sequence[float] | None = None) -> None:
        """Step the physics while the arm's target moves at constant velocity.

        Args:
            steps: Number of physics steps.
            end: Commanded arm joint positions at the last step [rad].
            start: Commanded arm joint positions before the first step [rad]; none: equal to `end`.
        """
        if steps < 1:
            return
        first, last = np.array(end if start is None else start), np.array(end)
        targets = (first + (last - first) * (np.arange(1, steps + 1) / steps)[:, None]).tolist()
        targets[-1] = last.tolist()
        velocities = ((last - first) * (self._rate_hz / steps)).tolist()
        for target in targets:
            self.robot.drive_arm(target, velocities)
            self.client.stepSimulation()
            self.robot.after_step()
            self._observer.after_step()

    def read(
        self,
        arm: ArmKinematics,
        command: ControllerState,
        *,
        episode_id: str,
        seq: int,
        stamp_ns: int,
        disturbed: bool,
        scene_hash: str,
    ) -> StateRecord:
        """Return the current state.

        Args:
            arm: The robot's kinematics.
            command: The arm's current command.
            episode_id: Copied into the record.
            seq: Copied into the record.
            stamp_ns: Copied into the record [ns].
            disturbed: Copied into the record.
            scene_hash: Copied into the record.

        Raises:
            SimError: With code ``SIM_FAULT`` when a pose is not finite.
        """
        try:
            robot, joints = read_robot(self.robot, arm.model, arm, command, self._base)
            read = [
                body.read(*self._observer.extremes(body), self._observer.fastest_fall(body)) for body in self.objects
            ]
        except InvalidRequestError as error:
            raise SimError(f"the physics has become unstable in tick {seq}: {error}", ErrorCode.SIM_FAULT) from None
        entities = tuple(entity for entity, _ in read)
        return StateRecord(
            episode_id=episode_id,
            seq=seq,
            stamp_ns=stamp_ns,
            robot=robot,
            entities=entities,
            contacts=self._observer.contacts(),
            disturbed=disturbed,
            state_hash=hash_state(joints, command, entities, [speeds for _, speeds in read]),
            scene_hash=scene_hash,
        )
