"""The executors' vocabulary: a script of stages that tracks the held object and the objects' poses.

A skill's executor yields scripts, best first::

    for grasp in grasps_of(scene, "target"):
        script = Script(scene)
        script.pick("target", grasp)
        script.place(goal, onto="support")
        yield script.stages

The expert rolls each out through the delta controller and takes the first whose joint path is free of collisions.

Non-obvious: a script starts from the present scene, so that one executor serves three cases:
    - The first try.
    - A correction, after a grasp that differs a little from the plan: the gripper already holds the object, and `pick`
      only lifts.
    - A recovery, after a failed try: the script begins by opening the gripper and withdrawing.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from roboxim_core.models.description import ObjectModel
from roboxim_core.poses import Pose, Vec3
from roboxim_tasks.motion import (
    ANYTHING,
    GRIPPER,
    JAW_CLEARANCE_M,
    RELEASE_CLEARANCE_M,
    ROBOT,
    TABLE,
    ExpertScene,
    Grasp,
    Stage,
    fingers_touch,
    retreated,
    shifted,
)

APPROACH_M = 0.10
LIFT_M = 0.10
SLOW = 0.6
GRIP_S = 0.3
RETREAT_M = 0.08
EXACT_GRASP_M = 0.05
"""Distance from a grasp within which the fingers may be beside the object [m]."""
EXACT_PLACE_M = 0.03
"""Distance from a place within which the held object may touch what it is put on [m]."""
WITHDRAW_M = 0.10
CARRY_MARGIN_M = 0.03
CORRIDOR_MARGIN_M = 0.02
Touching = tuple[tuple[str, str], ...]


class Script:
    """Builder of stages. All poses are in the robot's base frame unless a name says otherwise."""

    def __init__(self, scene: ExpertScene, *, opening: float | None = None) -> None:
        """Start at the robot's present pose.

        Args:
            scene: The scene.
            opening: Opening of the gripper from the first stage on; None: open, or as it holds something.
        """
        self.scene = scene
        self.pose = scene.pose_tcp
        """Pose of the tool centre point at the end of the stages so far."""
        self.opening = 1.0
        self.held = scene.held
        self.held_in_tcp = Pose()
        self.release_opening = 1.0
        self._stages: list[Stage] = []
        self._where = {entity.name: entity for entity in scene.state.entities}
        self._moved: tuple[str, ...] = ()
        if self.held:
            self.opening = scene.state.robot.gripper_command
            measured = scene.in_base(scene.state.robot.pose_tcp_measured)
            self.held_in_tcp = measured.inverse() @ scene.pose_of(self.held)
            clearance = RELEASE_CLEARANCE_M / scene.robot.gripper.max_opening_m
            self.release_opening = min(1.0, scene.state.robot.gripper_opening + clearance)
        elif scene.recovering:
            self.grip(1.0, name="let_go")
            self.move(shifted(self.pose, WITHDRAW_M), name="withdraw", touching=((GRIPPER, ANYTHING),))
        if opening is not None:
            self.opening = opening

    @property
    def stages(self) -> tuple[Stage, ...]:
        """The stages so far."""
        return tuple(self._stages)

    def pose_of(self, entity: str) -> Pose:
        """Return an entity's pose after the stages so far."""
        if entity == self.held:
            return self.pose @ self.held_in_tcp
        return self.scene.in_base(self._where[entity].pose)

    def set_entity(self, entity: str, *, pose: Pose | None = None, joints: dict[str, float] | None = None) -> None:
        """Record an entity's pose, or its joint positions [m or rad], from here on."""
        state = self._where[entity]
        positions = dict(zip(state.joint_names, state.joint_positions, strict=True)) | (joints or {})
        self._where[entity] = replace(
            state,
            pose=self.scene.scene.robot.pose @ pose if pose is not None else state.pose,
            joint_positions=tuple(positions[name] for name in state.joint_names),
        )
        self._moved = tuple(dict.fromkeys((*self._moved, entity)))

    def move(
        self,
        pose: Pose,
        *,
        name: str,
        free: bool = False,
        speed: float = 1.0,
        touching: Touching = (),
        lifts: bool = False,
        exact_m: float = math.inf,
    ) -> None:
        """Go to a pose in a straight line.

        Args:
            pose: Goal of the tool centre point.
            name: Name of the stage for messages.
            free: Whether any path will do: the expert then plans a detour if the line is blocked.
            speed: Fraction of the largest speed.
            touching: Pairs of bodies that may touch.
            lifts: Whether the stage lifts the held object off its support.
            exact_m: Distance from the goal within which the exact path matters [m].
        """
        self._add(Stage(name=name, pose=pose, free=free, speed=speed, touching=touching, lifts=lifts, exact_m=exact_m))
        self.pose = pose

    def shift(self, vector: Vec3, *, name: str, speed: float = 1.0, touching: Touching = ()) -> None:
        """Move along a vector with fixed orientation [m]."""
        x, y, z = (a + b for a, b in zip(self.pose.position, vector, strict=True))
        self.move(Pose(position=(x, y, z), quat_xyzw=self.pose.quat_xyzw), name=name, speed=speed, touching=touching)

    def grip(self, opening: float, *, name: str) -> None:
        """Move the fingers and wait for them."""
        gripper, change = self.scene.robot.gripper, abs(opening - self.opening)
        way_s = change * gripper.travel_m / gripper.speed_m_s if gripper.keeps_speed else 0.0
        self.opening = opening
        self._add(Stage(name=name, duration_s=GRIP_S + way_s))

    def wait(self, duration_s: float, *, name: str = "hold") -> None:
        """Stay."""
        self._add(Stage(name=name, duration_s=duration_s))

    def pick(self, entity: str, grasp: Grasp | None, *, lift_m: float = LIFT_M) -> None:
        """Approach, descend, close, lift. An object that the gripper already holds is only lifted, if still needed.

        Args:
            entity: Entity to grasp.
            grasp: The grasp; none when the entity is already held.
            lift_m: Height of the lift [m]; 0: no lift. The object may touch the table then, and what it touches now.
        """
        if grasp is not None and self.held != entity:
            self.opening, self.release_opening = grasp.opening, grasp.release_opening
            self.move(retreated(grasp.pose, APPROACH_M), name="approach", free=True)
            touching = fingers_touch(self.scene, entity)
            self.move(grasp.pose, name="descend", speed=SLOW, touching=touching, exact_m=EXACT_GRASP_M)
            self.grip(0.0, name="close")
            self.held_in_tcp = grasp.pose.inverse() @ self.pose_of(entity)
            self.held = entity
        if lift_m and not self.scene.lifted:
            lifted = shifted(self.pose, lift_m)
            touched = {body for c in self.scene.state.contacts if entity in (c.body_a, c.body_b)
                       for body in (c.body_a, c.body_b)}  # fmt: skip
            others = sorted({TABLE} | touched - {entity, ROBOT})
            self.move(lifted, name="lift", speed=SLOW, touching=tuple((entity, on) for on in others), lifts=True)

    def place(self, pose_object: Pose, *, onto: str = TABLE, drop_m: float = 0.002) -> None:
        """Carry the held entity above a pose, lower it, release it, retreat.

        Args:
            pose_object: Goal of the held entity.
            onto: Entity that it may touch at the goal.
            drop_m: Height above the goal at which to release it [m].
        """
        goal = shifted(pose_object @ self.held_in_tcp.inverse(), drop_m)
        self.carry(goal)
        self.move(goal, name="lower", speed=SLOW, touching=((self.held, onto),), exact_m=EXACT_PLACE_M)
        self.release(pose_object)

    def carry(self, goal: Pose) -> None:
        """Move above a tool pose, over all objects in between.

        Non-obvious: the tool first rises straight up, no higher than needed. The expert plans around other obstacles.
        """
        over = 0.0 if self.scene.direct else self._height_over(goal)
        height = max(self.pose.position[2], goal.position[2] + APPROACH_M / 2, over)
        if height > self.pose.position[2] + 1e-3:
            self.shift((0.0, 0.0, height - self.pose.position[2]), name="rise")
        x, y, _ = goal.position
        self.move(Pose(position=(x, y, height), quat_xyzw=goal.quat_xyzw), name="carry", free=True)

    def release(self, pose_object: Pose, *, retreat_m: float = RETREAT_M) -> None:
        """Release the held entity at a pose, and retreat along the tool's axis."""
        entity, self.held, self.held_in_tcp = self.held, "", Pose()
        self.set_entity(entity, pose=pose_object)
        self.grip(self.release_opening, name="release")
        touching = fingers_touch(self.scene, entity)
        if self.scene.robot.gripper.one_jaw:  # the fixed jaw would drag it along
            aside = self.pose @ Pose(position=(0.0, -JAW_CLEARANCE_M, 0.0))
            self.move(aside, name="part", speed=SLOW, touching=touching)
        self.move(retreated(self.pose, retreat_m), name="retreat", touching=touching)

    def _height_over(self, goal: Pose) -> float:
        """Return the height at which the held object passes over everything on the line to a goal [m]."""
        below, radius = 0.0, 0.05
        if self.held:
            model = self.scene.model_of(self.held)
            below = self.pose.position[2] - self.pose_of(self.held).position[2] + model.rest_height
            if self.scene.lifted:
                below += _sag(self.pose_of(self.held), model)
            radius = float(np.hypot(*model.size[:2])) / 2
        start, end = np.array(self.pose.position[:2]), np.array(goal.position[:2])
        highest = 0.0
        for name in self._where:
            if name == self.held:
                continue
            model, pose = self.scene.model_of(name), self.pose_of(name)
            reach = float(np.hypot(*model.size[:2])) / 2 + radius + CORRIDOR_MARGIN_M
            if _distance_to_segment(np.array(pose.position[:2]), start, end) < reach:
                highest = max(highest, pose.position[2] + model.size[2] - model.rest_height)
        return highest + below + CARRY_MARGIN_M

    def _add(self, stage: Stage) -> None:
        moved = tuple(self._where[name] for name in self._moved)
        self._stages.append(
            replace(stage, opening=self.opening, held=self.held, held_in_tcp=self.held_in_tcp, moved=moved)
        )


def _sag(pose: Pose, model: ObjectModel) -> float:
    """Return the distance of a tilted object's lowest corner below the bottom of the upright object [m]."""
    width, depth, _ = model.size
    corners = [(x * width / 2, y * depth / 2, -model.rest_height) for x in (-1, 1) for y in (-1, 1)]
    lowest = float(pose.rotation.apply(corners)[:, 2].min())
    return max(0.0, -lowest - model.rest_height)


def _distance_to_segment(point: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    along = end - start
    length = float(along @ along)
    share = 0.0 if length < 1e-12 else min(1.0, max(0.0, float((point - start) @ along) / length))
    return float(np.linalg.norm(point - start - share * along))
