"""Put an object into a container: a bowl, a tray, a mug.

Randomisation: which objects and colours; where both lie and at what yaw; where the end effector starts; distractors.

Success: the object's origin is inside the container's interior, it does not touch the table, the robot does not touch
it, and it lies still for ``hold_s``.

Non-obvious: the interior's size follows from the container; the generator puts it into the task's arguments. What does
not fit into the container's interior at every yaw is never drawn.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from roboxim_core.errors import ConfigError
from roboxim_core.poses import Pose
from roboxim_core.specs import Scalar, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.generators import GenerationContext, generate_task
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.predicates import Condition, Conditions, Measure, table_force
from roboxim_tasks.reach import above_reachable, graspable, start_clear
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.placing import GOAL_YAWS, fits, lies_still, put, raised, region_of, region_pose, upright

DROPS_M = (0.01, 0.03, 0.05)


@dataclass(frozen=True, kw_only=True)
class PutIntoParameters:
    """Thresholds of success."""

    hold_s: float = 0.3
    """How long it must lie still [s]."""
    floor_m: float = 0.0
    """Height of the interior's floor above the container's origin [m]; set by the generator."""
    depth_m: float = 0.0
    """Height of its rim above its floor [m]; set by the generator."""
    half_x_m: float = 0.0
    """Half of its extent along the container's x [m]; set by the generator."""
    half_y_m: float = 0.0
    """Half of its extent along the container's y [m]; set by the generator."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a threshold makes no sense.
        """
        if self.hold_s < 0:
            raise ConfigError(f"needs hold_s >= 0, got {self}")


@register
class PutInto(Skill):
    """Generator, resetter, executor and evaluator of ``put_into``."""

    name = "put_into"
    roles = {"container": Role(affordance="container", models=("bowl",)), "target": Role(affordance="graspable")}
    templates = (
        "Put the {target} into the {container}",
        "Place the {target} in the {container}",
        "Drop the {target} into the {container}",
    )
    max_steps = 200
    Parameters = PutIntoParameters

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a target that fits into the container, and note the interior's size."""
        task = generate_task(
            context,
            suits=lambda models: fits(models["target"], region_of(models["container"], "interior")),
        )
        container = task.objects["container"]
        interior = region_of(context.library.object(container.model, container.modifiers), "interior")
        x, y, depth = interior.size
        floor_m = interior.pose.position[2]
        size: dict[str, Scalar] = {"floor_m": floor_m, "depth_m": depth, "half_x_m": x / 2, "half_y_m": y / 2}
        return replace(task, arguments=task.arguments | size)

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """The arm reaches the target, and above the container."""
        return (graspable(context, "target"), above_reachable(context, "container"), start_clear(context))

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Pick it up, lower it into the middle, let go as low as the hand fits."""
        target, container = (scene.task.objects[role].entity for role in ("target", "container"))
        floor = region_pose(scene, container, region_of(scene.model_of(container), "interior"))
        position = raised(floor, floor.position[2] + scene.model_of(target).rest_height).position
        goals = [upright(scene.pose_of(target), position, yaw) for yaw in GOAL_YAWS]
        return put(scene, target, goals, onto=container, drops_m=DROPS_M)

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Inside, off the table, let go and at rest."""
        parameters: PutIntoParameters = parameters_of(task, PutIntoParameters)
        target, container = (task.objects[role].entity for role in ("target", "container"))

        def inside(state: StateRecord) -> Pose:
            return state.entity(container).pose.inverse() @ state.entity(target).pose

        def sideways(state: StateRecord) -> float:
            x, y, _ = inside(state).position
            return max(abs(x) / parameters.half_x_m, abs(y) / parameters.half_y_m)

        depth = Measure(name="above_floor_m", of=lambda state: inside(state).position[2] - parameters.floor_m)
        placed = (
            Condition(name="inside", measure=Measure(name="sideways_share", of=sideways), most=1.0),
            Condition(name="below_rim", measure=depth, least=0.0, most=parameters.depth_m + 0.01, reason="not_inside"),
            Condition(name="off_table", measure=table_force(target), most=0.0, reason="touches_table"),
        )
        return Conditions(lies_still(target, initial, placed, container), hold_s=parameters.hold_s)
