"""Flip the lever of a switch to its other side.

Randomisation: the switch's place, yaw and colour; the side on which its lever stands; where the end effector starts;
distractors, other switches among them.

Success: the lever has turned by more than ``flip_rad`` from where it stood, pushed by fingers of the robot alone, the
robot does not touch the switch, for ``hold_s``. As in every task, the joints of other objects have to stay. The box
stands fixed, as everything with joints does.

Non-obvious:
    - "Flip" says no direction: the goal is the side on which the lever does not stand at the start.
    - The way of the lever counts only in ticks in which nothing but fingers touches the switch.
    - The fingers pass 26 mm above the box: lower, they would jam against the lever's foot with 200 N instead of 1 N.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from roboxim_core.errors import ConfigError
from roboxim_core.models.description import JointModel, ObjectModel
from roboxim_core.poses import Pose
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.measures import Conditions
from roboxim_tasks.motion import ExpertScene, Stage, fingers_touch, shifted
from roboxim_tasks.reach import reaches_in_lines, start_clear
from roboxim_tasks.sampling.generators import GenerationContext
from roboxim_tasks.script import SLOW, Script
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.parts import (
    APPROACH_M,
    DWELL_S,
    Part,
    beyond_travel,
    far_enough,
    generate_part_task,
    part_in,
    turned_by_fingers,
)

HEIGHT_M = 0.026
"""Height of the tool centre point above the lever's pivot [m]."""
BEGIN_M = 0.072
"""Distance from the pivot at which the push begins, on the lever's side [m]."""
END_M = -0.008
"""Position of the tool centre point at the end of the push, beyond the pivot [m]; the fingers reach 11 mm farther."""
YAWS = (0.0, math.pi)
"""Headings of the tool against the push: the closed fingers are narrow along it."""


@dataclass(frozen=True, kw_only=True)
class FlipSwitchParameters:
    """Thresholds of success."""

    flip_rad: float = 0.6
    """Turn of the lever that a flip must exceed [rad]."""
    hold_s: float = 0.3
    """Time that the lever must stay flipped [s]."""
    joint: str = ""
    """Name of the lever's joint; set by the generator."""
    fingers: str = ""
    """Names of the robot's finger links, separated by blanks; set by the generator."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a threshold is out of range.
        """
        if self.flip_rad <= 0 or self.hold_s < 0:
            raise ConfigError(f"needs flip_rad > 0 and hold_s >= 0, got {self}")


@register
class FlipSwitch(Skill):
    """Generator, resetter, executor and evaluator of ``flip_switch``."""

    name = "flip_switch"
    roles = {"target": Role(affordance="flippable", models=("switch",))}
    templates = ("Flip the {target}", "Toggle the {target}", "Flip the lever of the {target} to the other side")
    components = ("robot", "objects", "joints", "distractors", "cameras", "lights")
    rotations = 3
    max_steps = 120
    Parameters = FlipSwitchParameters

    def mismatch(self, parameters: Any, models: Mapping[str, ObjectModel]) -> str:
        """Return that the lever does not turn so far; else an empty text."""
        return beyond_travel(models["target"], models["target"].handles[0].joint, "flip_rad", parameters.flip_rad)

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task and record the names of the lever's joint and of the robot's fingers."""
        return generate_part_task(context, fingers=True)

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require a lever that can turn so far, and that the arm can reach its side and push it over."""
        entity = context.task.objects["target"].entity

        def reachable(scene: SceneSpec) -> bool:
            spec = scene.entity(entity)
            (handle, *_), base = (model := context.library.entity_model(spec)).handles, scene.robot.pose.inverse()
            at = lever_at(Part(model=model, handle=handle, base=base @ spec.pose, joints=spec.joint_positions))
            return any(
                reaches_in_lines(context, shifted(begin, APPROACH_M), begin, end)
                for begin, end in (at.push(yaw) for yaw in YAWS)
            )

        flip_rad = parameters_of(context.task, FlipSwitchParameters).flip_rad
        return (
            far_enough(context, "target", lambda part: abs(lever_at(part).goal_rad - part.position), flip_rad),
            Constraint(name="target_reachable", holds=reachable),
            start_clear(context),
        )

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Go down beside the lever with closed fingers, push it over, go up; the nearest heading comes first."""
        entity = scene.task.objects["target"].entity
        at = lever_at(part_in(scene, entity, scene.model_of(entity).handles[0]))
        for yaw in at.headings(scene.pose_tcp):
            script = Script(scene, opening=0.0)
            pushed(script, entity, at, *at.push(yaw))
            yield script.stages

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge: flipped by fingers, and let go."""
        parameters: FlipSwitchParameters = parameters_of(task, FlipSwitchParameters)
        flipped = turned_by_fingers(task, initial, "flipped", parameters.flip_rad)
        return Conditions(flipped, hold_s=parameters.hold_s)


@dataclass(frozen=True, kw_only=True)
class LeverAt:
    """A lever, in the frame of its switch's base pose."""

    joint: JointModel
    """Its joint."""
    pivot: Pose
    """Pose of the pivot, z upwards; the lever turns in the plane of x and z."""
    side: float
    """Side of x to which it is to be pushed, 1 or -1."""

    @property
    def goal_rad(self) -> float:
        """Position of the joint after the flip [rad]."""
        return self.joint.upper if self.side > 0 else self.joint.lower

    @property
    def way_rad(self) -> float:
        """Heading of the push in the base [rad]."""
        x, y, _ = self.pivot.rotation.apply([self.side, 0.0, 0.0])
        return math.atan2(y, x)

    def tool(self, along_m: float, yaw_rad: float, up_m: float = HEIGHT_M) -> Pose:
        """Return the tool's pose, pointing down, at a distance beyond the pivot along the push [m]."""
        from scipy.spatial.transform import Rotation

        x, y, z = self.pivot.apply((self.side * along_m, 0.0, up_m)).tolist()
        down = Rotation.from_euler("z", self.way_rad + yaw_rad) * Rotation.from_euler("x", math.pi)
        return Pose.from_arrays((x, y, z), down)

    def push(self, yaw_rad: float) -> tuple[Pose, Pose]:
        """Return the tool's poses at the begin and the end of the push."""
        return self.tool(-BEGIN_M, yaw_rad), self.tool(END_M, yaw_rad)

    def headings(self, tcp: Pose) -> list[float]:
        """Return `YAWS`, the nearest to the tool's present heading first."""
        x, y, _ = tcp.rotation.apply([1.0, 0.0, 0.0])
        now = math.atan2(y, x) - self.way_rad
        return sorted(YAWS, key=lambda yaw: abs(math.remainder(now - yaw, 2 * math.pi)))


def lever_at(part: Part) -> LeverAt:
    """Return the lever of a switch."""
    upright, joint = Pose(position=part.base.inverse().apply(part.frame.position).tolist()), part.joint
    side = 1.0 if 2 * part.position < joint.lower + joint.upper else -1.0
    return LeverAt(joint=joint, pivot=part.base @ upright, side=side)


def pushed(script: Script, entity: str, at: LeverAt, begin: Pose, end: Pose, speed: float = SLOW) -> None:
    """Add the stages of a push: down beside the lever, along, dwell, and up."""
    touching = fingers_touch(script.scene, entity)
    script.move(shifted(begin, APPROACH_M), name="approach", free=True)
    script.move(begin, name="reach", speed=max(speed, SLOW))
    script.set_entity(entity, joints={at.joint.name: at.goal_rad})
    script.move(end, name="push", speed=speed, touching=touching)
    script.wait(DWELL_S, name="dwell")
    script.move(shifted(end, APPROACH_M), name="withdraw", touching=touching)
