"""Readout of a tick: contacts, falls and joint extremes over its physics steps, and the state at its end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from roboxim_core.kinematics import ArmKinematics, ControllerState
from roboxim_core.models.description import RobotModel
from roboxim_core.poses import IDENTITY, Pose, Vec3
from roboxim_core.state import Contact, EntityState, RobotState, hash_floats
from roboxim_sim.bodies import ObjectBody
from roboxim_sim.bullet import BulletClient
from roboxim_sim.robot_body import RobotBody

_Pair = tuple[str, str, str, str]


class TickObserver:
    """Accumulates contacts, falls and joint extremes over the physics steps of one tick."""

    def __init__(
        self, client: BulletClient, robot: RobotBody, objects: Sequence[ObjectBody], fixed: Mapping[int, str]
    ) -> None:
        """Start observing.

        Args:
            client: PyBullet client.
            robot: The robot.
            objects: The objects.
            fixed: Names of the table and the floor by body id.
        """
        self._client = client
        self._names = {**fixed, robot.id: "robot", **{body.id: body.name for body in objects}}
        self._links = {robot.id: robot.link_names, **{body.id: body.link_names for body in objects}}
        self._jointed = [body for body in objects if body.joint_names]
        self._falling = [(body.id, body.name) for body in objects]
        self._pairs: dict[tuple[int, int, int, int], _Pair] = {}
        self._swapped: set[tuple[int, int, int, int]] = set()
        self.begin()

    def begin(self) -> None:
        """Clear the observations of the last tick."""
        self._last: dict[_Pair, float] = {}
        self._highest_force: dict[_Pair, float] = {}
        self._extremes: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {}
        self._lowest_velocity = {name: 0.0 for _, name in self._falling}

    def after_step(self) -> None:
        """Observe one physics step."""
        last: dict[_Pair, float] = {}
        pairs, highest_force = self._pairs, self._highest_force
        for point in self._client.getContactPoints():
            force = point[9]
            if force > 0.0:
                key = point[1:5]
                pair = pairs[key] if key in pairs else self._name(key)
                last[pair] = last[pair] + force if pair in last else force
        for pair, force in last.items():
            if pair not in highest_force or force > highest_force[pair]:
                highest_force[pair] = force
        self._last = last
        lowest_velocity = self._lowest_velocity
        for body_id, name in self._falling:
            velocity = self._client.getBaseVelocity(body_id)[0][2]
            if velocity < lowest_velocity[name]:
                lowest_velocity[name] = velocity
        for body in self._jointed:
            now, _ = body.read_joints()
            lowest, highest = self._extremes.get(body.name, (now, now))
            self._extremes[body.name] = tuple(map(min, lowest, now)), tuple(map(max, highest, now))

    def contacts(self) -> tuple[Contact, ...]:
        """Return the tick's contacts, sorted."""
        vectors = self._force_vectors()
        return tuple(
            Contact(
                body_a=pair[0],
                link_a=pair[1],
                body_b=pair[2],
                link_b=pair[3],
                force_last=self._last.get(pair, 0.0),
                force_max=self._highest_force[pair],
                force_on_b=vectors.get(pair, (0.0, 0.0, 0.0)),
            )
            for pair in sorted(self._highest_force)
        )

    def fastest_fall(self, body: ObjectBody) -> float:
        """Return the largest downward speed of the centre of mass of an object's base over the tick [m/s]."""
        return 0.0 - self._lowest_velocity[body.name]

    def extremes(self, body: ObjectBody) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the lowest and highest joint positions of an object over the tick."""
        now, _ = body.read_joints()
        return self._extremes.get(body.name, (now, now))

    def _force_vectors(self) -> dict[_Pair, Vec3]:
        """Return the summed normal forces on the second body of each pair in the last physics step [N]."""
        vectors: dict[_Pair, Vec3] = {}
        if not self._last:
            return vectors
        for point in self._client.getContactPoints():
            key, force = point[1:5], point[9]
            if force > 0.0:
                pair = self._pairs[key]
                sign = force if key in self._swapped else -force  # Bullet's normal points towards its first body
                x, y, z = vectors.get(pair, (0.0, 0.0, 0.0))
                dx, dy, dz = point[7]
                vectors[pair] = (x + sign * dx, y + sign * dy, z + sign * dz)
        return vectors

    def _name(self, key: tuple[int, int, int, int]) -> _Pair:
        body_a, body_b, link_a, link_b = key
        first, second = (
            (self._names[body], self._links[body][link] if body in self._links else "")
            for body, link in ((body_a, link_a), (body_b, link_b))
        )
        if second < first:
            self._swapped.add(key)
            first, second = second, first
        self._pairs[key] = (*first, *second)
        return self._pairs[key]


def read_robot(
    body: RobotBody, model: RobotModel, arm: ArmKinematics, command: ControllerState, base: Pose
) -> tuple[RobotState, list[float]]:
    """Return the robot's state, and all its joint positions and velocities for the hash.

    Args:
        body: The robot.
        model: The robot's model.
        arm: The robot's kinematics.
        command: The current command.
        base: Pose of the robot's base in the world.
    """
    positions, velocities, efforts = body.read_joints()
    count = len(model.joint_names)
    fingers = tuple(positions[count:])
    measured = arm.fk(positions[:count])
    state = RobotState(
        joint_names=model.joint_names,
        joint_positions=tuple(positions[:count]),
        joint_velocities=tuple(velocities[:count]),
        joint_commands=command.joints,
        pose_tcp_measured=measured if base == IDENTITY else base @ measured,
        pose_tcp_commanded=command.pose if base == IDENTITY else base @ command.pose,
        gripper_opening=model.gripper.opening(fingers),
        gripper_command=command.gripper,
        finger_positions=fingers,
        joint_efforts=tuple(efforts[:count]),
        finger_velocities=tuple(velocities[count:]),
        finger_efforts=tuple(effort / model.gripper.arm_m for effort in efforts[count:]),
    )
    return state, positions + velocities


def hash_state(
    robot_joints: list[float],
    command: ControllerState,
    entities: Sequence[EntityState],
    joint_velocities: Sequence[tuple[float, ...]],
) -> str:
    """Hash all moving state: joint positions and velocities, the command, object poses, twists and joints."""
    groups: list[tuple[float, ...] | list[float]] = [
        robot_joints,
        (*command.pose.position, *command.pose.quat_xyzw, *command.joints, command.gripper),
    ]
    for entity, speeds in zip(entities, joint_velocities, strict=True):
        groups.append(
            (
                *entity.pose.position,
                *entity.pose.quat_xyzw,
                *entity.linear_velocity,
                *entity.angular_velocity,
                *entity.joint_positions,
                *speeds,
            )
        )
    return hash_floats(*groups)
