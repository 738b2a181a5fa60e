"""Push a button.

Randomisation: the button's place, yaw and colour; where the end effector starts; distractors, other buttons among them.

Success: in some physics step the button was pressed in by more than ``travel_m``, in a tick in which only fingers of
the robot touched it, and no button that the task does not name has been pressed.

Non-obvious:
    - Only a finger may press the button, with its tip or a side. A hand or an arm that leans on the button does not
      count, because a flailing arm hits it like that.
    - The press is latched, because a button springs back at once: it need not be pressed when the episode ends.
    - A button that is down when judging begins, e.g. from the step before, must come up before a press counts.
    - Buttons of other steps of a longer task may be pressed.
    - The expert dwells at the bottom, because the reference rounds corners where it does not stop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from roboxim_core.errors import ConfigError
from roboxim_core.models.articulation import object_link_poses
from roboxim_core.models.description import ObjectModel
from roboxim_core.poses import Pose
from roboxim_core.specs import EntitySpec, SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.handling import touching_links
from roboxim_tasks.measures import Condition, Conditions, Measure, above, joint_highest_ever, joint_value
from roboxim_tasks.motion import ExpertScene, Stage, fingers_touch, retreated
from roboxim_tasks.reach import reaches_in_lines, start_clear
from roboxim_tasks.roles import task_distractors, task_objects
from roboxim_tasks.sampling.generators import GenerationContext, generate_task
from roboxim_tasks.script import SLOW, Script
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.parts import beyond_travel

APPROACH_M = 0.08
DEPTH_M = 0.011
DWELL_S = 0.2
YAWS = tuple(math.radians(angle) for angle in (0, 90, -90, 45, -45, 30, -30, 60, -60, 15, -15, 75, -75))


@dataclass(frozen=True, kw_only=True)
class PushButtonParameters:
    """Thresholds of success."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("others",)

    travel_m: float = 0.006
    """Travel that the press must exceed [m]."""
    joint: str = ""
    """Name of the button's joint; set by the generator."""
    fingers: str = ""
    """Names of the robot's finger links, separated by blanks; set by the generator."""
    others: str = ""
    """Names of other buttons' joints that differ from ``joint``, separated by blanks; set by the generator."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a threshold is out of range.
        """
        if not 0 < self.travel_m <= 0.01:
            raise ConfigError(f"needs 0 < travel_m <= 0.01, got {self}")


@register
class PushButton(Skill):
    """Generator, resetter, executor and evaluator of ``push_button``."""

    name = "push_button"
    roles = {"target": Role(affordance="pressable", models=("button",))}
    templates = ("Push the {target}", "Press the {target}", "Press down on the {target}")
    max_steps = 100
    event = True
    Parameters = PushButtonParameters

    def mismatch(self, parameters: Any, models: Mapping[str, ObjectModel]) -> str:
        """Return that the button does not go down so far; else an empty text."""
        return beyond_travel(models["target"], models["target"].press_points[0].joint, "travel_m", parameters.travel_m)

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task and record the names of the joints of all buttons and of the robot's fingers."""
        task, library, scene = generate_task(context), context.library, context.config.base_scene()
        target = task.objects["target"]
        (point, *_) = library.object(target.model, target.modifiers).press_points
        fingers = " ".join(library.robot(scene.robot.model).gripper.links[1:])
        named = {thing.entity for thing in task_objects(task)}
        there = [thing for thing in scene.entities if thing.name not in named] + list(task_distractors(task))
        models = (library.object(thing.model, thing.modifiers) for thing in there)
        joints = {each.joint for model in models for each in model.press_points} - {point.joint}
        arguments = task.arguments | {"joint": point.joint, "fingers": fingers, "others": " ".join(sorted(joints))}
        return replace(task, arguments={name: value for name, value in arguments.items() if value or name != "others"})

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require that the arm can reach the button and press it."""
        entity = context.task.objects["target"].entity

        def reachable(scene: SceneSpec) -> bool:
            spec: EntitySpec = scene.entity(entity)
            face = button_face(context.library.entity_model(spec), scene.robot.pose.inverse() @ spec.pose)
            pressed = (pressed_pose(face, yaw) for yaw in YAWS)
            return any(reaches_in_lines(context, retreated(pose, APPROACH_M), pose) for pose in pressed)

        return (Constraint(name="target_reachable", holds=reachable), start_clear(context))

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Approach from above with closed fingers, press, withdraw; the tool's present yaw comes first."""
        entity = scene.task.objects["target"].entity
        face = button_face(scene.model_of(entity), scene.pose_of(entity))
        touching = fingers_touch(scene, entity)
        now = scene.pose_tcp.rotation.apply([1.0, 0.0, 0.0])
        heading = math.atan2(now[1], now[0])
        for yaw in YAWS:
            pressed = pressed_pose(face, heading + yaw)
            script = Script(scene, opening=0.0)
            script.move(retreated(pressed, APPROACH_M), name="approach", free=True)
            script.move(pressed, name="press", speed=SLOW, touching=touching)
            script.wait(DWELL_S, name="dwell")
            script.move(retreated(pressed, APPROACH_M), name="withdraw", touching=touching)
            yield script.stages

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge: pressed by a finger at some time, and no other button pressed."""
        parameters: PushButtonParameters = parameters_of(task, PushButtonParameters)
        target, fingers = task.objects["target"].entity, set(parameters.fingers.split())

        def by_finger(state: StateRecord) -> bool:
            links = touching_links(state, target)
            return bool(links) and links <= fingers

        return Conditions(
            (
                Condition(
                    name="others_left", measure=_others_travel(task, parameters, initial),
                    most=parameters.travel_m, reason="pressed_other_button", fatal=True,
                ),
                Condition(
                    name="pressed", measure=_travel("travel_m", target, parameters, initial),
                    least=above(parameters.travel_m),
                ),
                Condition(
                    name="by_finger", measure=_travel("finger_travel_m", target, parameters, initial, by_finger),
                    least=above(parameters.travel_m),
                ),
            ),
            hold_s=0.0,
        )  # fmt: skip


def button_face(model: ObjectModel, base: Pose) -> Pose:
    """Return the pose of the button's face, z outwards, in the frame of its base pose."""
    point = model.press_points[0]
    return base @ object_link_poses(model, {})[point.link] @ point.pose


def pressed_pose(face: Pose, yaw_rad: float) -> Pose:
    """Return the tool's pose at the pressed button, with its x axis at a heading in the base."""
    from scipy.spatial.transform import Rotation

    x, y, z = face.apply((0.0, 0.0, -DEPTH_M)).tolist()
    return Pose.from_arrays((x, y, z), Rotation.from_euler("z", yaw_rad) * Rotation.from_euler("x", math.pi))


def _travel(
    name: str,
    target: str,
    parameters: PushButtonParameters,
    initial: StateRecord,
    counts: Callable[[StateRecord], bool] = lambda state: True,
) -> Measure:
    """Measure a button's largest travel so far, over the ticks that count and since it was first up [m]."""
    best = [0.0]
    down = [joint_value(initial, target, parameters.joint, "joint_positions") > parameters.travel_m]

    def travel(state: StateRecord) -> float:
        if not down[0] and counts(state):
            best[0] = max(best[0], joint_value(state, target, parameters.joint, "joint_highest"))
        down[0] &= joint_value(state, target, parameters.joint, "joint_positions") > parameters.travel_m
        return best[0]

    return Measure(name=name, of=travel)


def _others_travel(task: TaskSpec, parameters: PushButtonParameters, initial: StateRecord) -> Measure:
    """Measure the largest travel so far of any button that the task does not name [m]."""
    named = {thing.entity for thing in task_objects(task)}
    joints = {parameters.joint, *parameters.others.split()}
    others = [(e.name, joint) for e in initial.entities if e.name not in named for joint in joints & {*e.joint_names}]
    measures = [joint_highest_ever(name, joint) for name, joint in others]
    return Measure(
        name="others_travel_m", of=lambda state: max((measure.of(state) for measure in measures), default=0.0)
    )
