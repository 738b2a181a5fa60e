"""Articulated parts that a handle moves, e.g. drawers, doors and knobs: their path, their motion, their verdict.

A skill names the part, its goal and its conditions; the rest is the same for parts that slide and parts that turn.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from roboxim_core.episode.start import SPEED_M_S, SPIN_RAD_S
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.articulation import joint_motion, object_link_poses
from roboxim_core.models.bounds import shape_bounds
from roboxim_core.models.description import Handle, JointModel, ObjectModel
from roboxim_core.poses import Array, Pose
from roboxim_core.specs import EntitySpec, SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.handling import let_go, way_by_fingers
from roboxim_tasks.measures import Condition, Measure, above, joint_value, released, seconds_between, with_last
from roboxim_tasks.motion import ExpertScene, Stage, fingers_touch, retreated
from roboxim_tasks.reach import reaches_in_lines
from roboxim_tasks.sampling.generators import GenerationContext, generate_task
from roboxim_tasks.sampling.placement import footprint, overlap
from roboxim_tasks.script import SLOW, Script

APPROACH_M = 0.08
GRASP_OPENING = 0.6
OTHERS_M = 0.02
CLEARANCE_M = 0.02
STEP_RAD = 0.15
"""Turn of a part between two poses of the tool, which moves straight in between [rad]."""
PITCHES = tuple(math.radians(angle) for angle in (0, -6, 6, -12, 12))
FINGER_M = 0.022
"""Distance from the middle of the bar to the tool centre point when the leaning fingertips touch the bar [m]."""
STANDOFF_M = 0.015
PRESS_M = 0.002
"""Distance that fingers push beyond the part's goal, because friction would stop it where the push ends [m]."""
DWELL_S = 0.2
BEHIND_THE_MIDDLE: Mapping[str, Any] = {
    "area": {"lower": [0.66, -0.22], "upper": [0.78, 0.22]},
    "yaw_rad": {"lower": math.pi - 0.5, "upper": math.pi + 0.5},
}
"""Placement of furniture: behind the middle of the table, its front towards the robot."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part that a handle moves, in the frame of its object's base pose."""

    model: ObjectModel
    """The object."""
    handle: Handle
    """Its handle."""
    base: Pose
    """Pose of the object."""
    joints: Mapping[str, float]
    """Joint name to position [m or rad]; those left out are 0."""

    @property
    def joint(self) -> JointModel:
        """The joint that the handle moves."""
        return next(joint for joint in self.model.joints if joint.name == self.handle.joint)

    @property
    def position(self) -> float:
        """Position of the joint [m or rad]."""
        return self.joints.get(self.handle.joint, 0.0)

    @property
    def frame(self) -> Pose:
        """Pose of the joint, which the part does not move."""
        return self.base @ object_link_poses(self.model, {})[self.joint.parent] @ self.joint.pose

    @property
    def opening(self) -> Array:
        """Unit vector along which the middle of the handle moves when the joint's position grows, shape (3,)."""
        if self.joint.kind == "revolute":
            return np.asarray((self.link.rotation * self.handle.pose.rotation).apply((1.0, 0.0, 0.0)))
        return np.asarray(self.frame.rotation.apply(self.joint.axis))

    @property
    def lever_m(self) -> float:
        """Way of the handle's middle per position of the joint: 1 if the part slides, else its radius [m/rad]."""
        if self.joint.kind == "prismatic":
            return 1.0
        arm = (self.link @ self.handle.pose).position - np.array(self.frame.position)
        axis = self.frame.rotation.apply(self.joint.axis)
        return float(np.linalg.norm(np.cross(axis, arm)))

    @property
    def link(self) -> Pose:
        """Pose of the link with the handle."""
        return self.base @ object_link_poses(self.model, dict(self.joints))[self.handle.link]

    def at(self, position: float) -> Part:
        """Return the part at another position of its joint [m or rad]."""
        return replace(self, joints={**self.joints, self.handle.joint: position})

    def grasps(self) -> Iterator[Pose]:
        """Yield tool poses that grasp the handle, best first: as annotated, then with slightly different pitches."""
        from scipy.spatial.transform import Rotation

        link = self.link
        for pitch in PITCHES:
            for grasp in self.handle.grasps:
                for flip in (0.0, math.pi):
                    turn = Rotation.from_euler("z", flip) * Rotation.from_euler("y", pitch)
                    yield link @ grasp.pose @ Pose.from_arrays((0.0, 0.0, 0.0), turn)

    def way(self, tool: Pose, goal: float) -> Iterator[tuple[float, Pose]]:
        """Yield joint positions up to a goal, each with the pose to which the part takes a tool that moves with it.

        Args:
            tool: Pose of the tool at the present position.
            goal: Last position of the joint [m or rad].
        """
        change = goal - self.position
        if self.joint.kind == "prismatic":
            yield goal, moved_by(tool, self.opening * change)
            return
        frame, count = self.frame, max(1, math.ceil(abs(change) / STEP_RAD))
        at_zero = frame @ joint_motion(self.joint, self.position)
        for step in range(1, count + 1):
            position = self.position + change * step / count
            yield position, frame @ joint_motion(self.joint, position) @ at_zero.inverse() @ tool


def part_in(scene: ExpertScene, entity: str, handle: Handle) -> Part:
    """Return a part of an entity in the robot's base, at its present position."""
    state = scene.state.entity(entity)
    joints = dict(zip(state.joint_names, state.joint_positions, strict=True))
    return Part(model=scene.model_of(entity), handle=handle, base=scene.pose_of(entity), joints=joints)


def operated(scene: ExpertScene, entity: str, part: Part, grasp: Pose, goal: float) -> tuple[Stage, ...]:
    """Return the stages that grasp a handle, move its part to a joint position [m or rad], let go and withdraw."""
    touching = fingers_touch(scene, entity)
    script = Script(scene, opening=GRASP_OPENING)
    script.move(retreated(grasp, APPROACH_M), name="approach", free=True)
    script.move(grasp, name="reach", speed=SLOW, touching=touching)
    script.grip(0.0, name="close")
    for position, pose in part.way(grasp, goal):
        script.move(pose, name="pull", speed=SLOW, touching=touching)
        script.set_entity(entity, joints={part.handle.joint: position})
    script.grip(GRASP_OPENING, name="release")
    script.move(retreated(script.pose, APPROACH_M), name="retreat", touching=touching)
    return script.stages


def pushed_shut(
    scene: ExpertScene, entity: str, part: Part, grasp: Pose, inside: Sequence[str] = ()
) -> tuple[Stage, ...]:
    """Return the stages that push a handle's bar with closed fingers until its part is shut.

    Args:
        scene: The scene.
        entity: The object.
        part: Its part.
        grasp: Tool pose that grasps the handle; the push begins in front of it.
        inside: Entities that lie in the part and move with it.
    """
    touching, shut = fingers_touch(scene, entity), part.joint.lower
    touch = moved_by(grasp, part.opening * FINGER_M)
    begin = moved_by(touch, part.opening * STANDOFF_M)
    script = Script(scene, opening=0.0)
    script.move(retreated(begin, APPROACH_M), name="approach", free=True)
    script.move(begin, name="reach")
    for position, pose in part.way(touch, shut - PRESS_M / part.lever_m):
        script.set_entity(entity, joints={part.handle.joint: max(shut, position)})
        for name in inside:
            (_, moved), *_ = part.way(scene.pose_of(name), max(shut, position))
            script.set_entity(name, pose=moved)
        script.move(pose, name="push", speed=SLOW, touching=touching)
    script.wait(DWELL_S, name="dwell")
    script.move(moved_by(script.pose, part.at(shut).opening * STANDOFF_M), name="withdraw", touching=touching)
    script.move(retreated(script.pose, APPROACH_M), name="retreat", touching=touching)
    return script.stages


def generate_part_task(
    context: GenerationContext, name: str = "", words: Mapping[str, str] | None = None, fingers: bool = False
) -> TaskSpec:
    """Draw a task about a part, and record the name of its joint.

    Args:
        context: The generation.
        name: Parameter with the name of the part's handle; empty: the first handle.
        words: Words of the instruction.
        fingers: Whether to record the names of the robot's fingers too.

    Raises:
        ConfigError: When the object has no such part.
    """
    task = generate_task(context, words=dict(words or {}))
    target = task.objects["target"]
    model = context.library.object(target.model, target.modifiers)
    handle = handle_of(model, str(task.arguments[name])) if name else model.handles[0]
    arguments: dict[str, str | float | int | bool] = {"joint": handle.joint}
    if fingers:
        robot = context.library.robot(context.config.base_scene().robot.model)
        arguments["fingers"] = " ".join(robot.gripper.links[1:])
    return replace(task, arguments=task.arguments | arguments)


def handle_of(model: ObjectModel, drawer: str) -> Handle:
    """Return the handle of a drawer.

    Raises:
        ConfigError: When no handle has that name.
    """
    for handle in model.handles:
        if handle.name == drawer:
            return handle
    raise ConfigError(
        f"object '{model.id}' has no drawer '{drawer}'; {one_of([h.name for h in model.handles], drawer)}"
    )


def moved_by(pose: Pose, vector: Array) -> Pose:
    """Return a pose moved along a vector of its parent frame [m]."""
    return Pose.from_arrays(np.add(pose.position, vector), pose.rotation)


def way_clear(context: ResetContext, role: str, goal: float = 0.0) -> Constraint:
    """Return the constraint that no object stands in a part's way.

    Args:
        context: The reset.
        role: Role of the object.
        goal: Position up to which the part will be opened [m or rad].
    """

    def holds(scene: SceneSpec) -> bool:
        spec, part = _drawn(context, scene, role)
        swept = list(_swept(replace(part, base=spec.pose), max(part.position, goal)))
        others = [other for other in scene.entities if other.name != spec.name]
        return not any(
            _top(context, other) > lowest - CLEARANCE_M and overlap(corners, footprint(other, context.library))
            for corners, lowest in swept
            for other in others
        )

    return Constraint(name="way_clear", holds=holds)


def beyond_travel(model: ObjectModel, joint: str, name: str, way: float) -> str:
    """Return that a joint of an object does not move by more than a way; empty if it does.

    Args:
        model: The object.
        joint: Its joint.
        name: Parameter with the way.
        way: The way [m or rad].
    """
    found = next(one for one in model.joints if one.name == joint)
    travel, unit = found.upper - found.lower, "m" if found.kind == "prismatic" else "rad"
    return f"{name} {way:g} needs more than the {travel:g} {unit} of the {model.name}" if way >= travel else ""


def far_enough(context: ResetContext, role: str, left: Callable[[Part], float], way: float) -> Constraint:
    """Return the constraint that a part can move by more than a way from where it was drawn.

    Args:
        context: The reset.
        role: Role of the object.
        left: Returns how far the part can move [m or rad].
        way: The way [m or rad].
    """

    def why(scene: SceneSpec) -> str:
        spec, part = _drawn(context, scene, role)
        return (
            f"the {part.model.name} can move by {left(part):.3g} from {part.position:.3g}, and has to by more than "
            f"{way:g}; see the task's 'reset.joints'"
        )

    return Constraint(
        name="far_enough", holds=lambda scene: left(_drawn(context, scene, role)[1]) > way, why=why
    )  # fmt: skip


def not_there_already(context: ResetContext, role: str, there: Callable[[float], bool]) -> Constraint:
    """Return the constraint that a part is not yet at its goal.

    Args:
        context: The reset.
        role: Role of the object.
        there: Returns whether a position of the part is at the goal [m or rad].
    """
    return Constraint(name="not_there_already", holds=lambda scene: not there(_drawn(context, scene, role)[1].position))


def handle_reachable(
    context: ResetContext, role: str, goal: Callable[[Part], float], before_m: float = 0.0
) -> Constraint:
    """Return the constraint that the arm reaches a part's handle and moves it.

    Args:
        context: The reset.
        role: Role of the object.
        goal: Returns the position to which it moves the part [m or rad].
        before_m: Initial distance of the tool in front of the handle [m].
    """

    def holds(scene: SceneSpec) -> bool:
        spec, part = _drawn(context, scene, role)
        part = replace(part, base=scene.robot.pose.inverse() @ spec.pose)
        grasps = (moved_by(grasp, part.opening * before_m) for grasp in part.grasps())
        return any(
            reaches_in_lines(
                context, retreated(grasp, APPROACH_M), grasp, *(pose for _, pose in part.way(grasp, goal(part)))
            )
            for grasp in grasps
        )

    return Constraint(name=f"{role}_reachable", holds=holds)


def part_rests(task: TaskSpec, initial: StateRecord, goal: Condition, *, turns: bool = False) -> tuple[Condition, ...]:
    """Return the conditions of a moved part: at its goal, still and let go, the object's other parts not moved.

    Args:
        task: The task.
        initial: State of tick 0.
        goal: The condition on the part's position.
        turns: Whether it turns and does not slide.
    """
    entity, joint = task.objects["target"].entity, str(task.arguments["joint"])
    name, limit = ("part_speed_rad_s", SPIN_RAD_S) if turns else ("drawer_speed_m_s", SPEED_M_S)
    return (
        goal,
        Condition(name="others_stayed", measure=_others_moved(entity, joint, initial), most=OTHERS_M,
                  reason="moved_other_drawer"),
        *let_go(entity),
        Condition(name="at_rest", measure=_joint_speed(entity, joint, name), most=limit),
    )  # fmt: skip


def turned_by_fingers(
    task: TaskSpec, initial: StateRecord, name: str, least_rad: float, direction: float = 0.0
) -> tuple[Condition, ...]:
    """Return the conditions of a part that fingers of the robot turn, and nothing else.

    Args:
        task: The task; its arguments name the part's joint and the fingers.
        initial: State of tick 0.
        name: Name of the first condition.
        least_rad: Turn that the part must exceed [rad].
        direction: Direction in which the turn counts, 1 or -1; 0: both.
    """
    target, joint = task.objects["target"].entity, str(task.arguments["joint"])
    start, least = joint_value(initial, target, joint, "joint_positions"), above(least_rad)

    def turn(state: StateRecord) -> float:
        way = joint_value(state, target, joint, "joint_positions") - start
        return way * direction if direction else abs(way)

    by_fingers = way_by_fingers(target, joint, str(task.arguments["fingers"]).split(), initial, direction)
    return (
        Condition(name=name, measure=Measure(name="turn_rad", of=turn), least=least),
        Condition(name="by_finger_alone", measure=by_fingers, least=least),
        released(target),
    )


def _drawn(context: ResetContext, scene: SceneSpec, role: str) -> tuple[EntitySpec, Part]:
    """Return the entity of a role in a drawn scene, and the task's part of it, in the frame of its base pose."""
    spec = scene.entity(context.task.objects[role].entity)
    model = context.library.entity_model(spec)
    handle = next(h for h in model.handles if h.joint == str(context.task.arguments["joint"]))
    return spec, Part(model=model, handle=handle, base=Pose(), joints=spec.joint_positions)


def _others_moved(entity: str, joint: str, initial: StateRecord) -> Measure:
    start = initial.entity(entity)
    others = [i for i, name in enumerate(start.joint_names) if name != joint]

    def moved(state: StateRecord) -> float:
        now = state.entity(entity).joint_positions
        return max((abs(now[i] - start.joint_positions[i]) for i in others), default=0.0)

    return Measure(name="others_moved_m", of=moved)


def _joint_speed(entity: str, joint: str, name: str) -> Measure:
    def speed(state: StateRecord, before: StateRecord | None) -> float:
        if before is None:
            return 0.0
        now, then = (joint_value(each, entity, joint, "joint_positions") for each in (state, before))
        return abs(now - then) / seconds_between(before, state)

    return Measure(name=name, of=with_last(speed))


def _swept(part: Part, goal: float) -> Iterator[tuple[Array, float]]:
    """Yield rectangles on the table that a part sweeps from shut to a goal, shape (4, 2), with their lowest height [m].

    A part that slides sweeps one; one that turns sweeps one for each `STEP_RAD`.
    """
    shapes = next(link for link in part.model.links if link.name == part.handle.link).collision
    corners = np.concatenate([list(itertools.product(*zip(*shape_bounds(shape), strict=True))) for shape in shapes])
    steps = 1 if part.joint.kind == "prismatic" else max(1, math.ceil(goal / STEP_RAD))
    for ends in itertools.pairwise(np.linspace(0.0, goal, steps + 1).tolist()):
        cloud = np.concatenate([part.at(position).link.apply(corners) for position in ends])
        along = part.at(ends[0]).opening[:2]
        frame = np.array([along, [-along[1], along[0]]])
        (a, b), (c, d) = (cloud[:, :2] @ frame.T).min(axis=0), (cloud[:, :2] @ frame.T).max(axis=0)
        yield np.array([(c, d), (a, d), (a, b), (c, b)]) @ frame, float(cloud[:, 2].min())


def _top(context: ResetContext, entity: EntitySpec) -> float:
    model = context.library.entity_model(entity)
    return entity.pose.position[2] + max(model.size[2] - model.rest_height, max(model.size[:2]) / 2)
