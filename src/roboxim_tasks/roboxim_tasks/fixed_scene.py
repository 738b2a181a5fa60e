"""A task whose scene is given and not drawn: made by hand, in the studio, or taken from a recorded episode.

Its YAML names the skill and, below ``fixed``, the scene, the entity of each role and the instruction. Every index of a
run then has the same scene, with the same hash; only the actor's seed differs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from roboxim_core.errors import one_of
from roboxim_core.models.library import ModelLibrary
from roboxim_core.plain_data.merging import merged
from roboxim_core.rates import DEFAULT_RATE_HZ, ticks
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import PhysicalObject, SceneSpec, TaskSpec
from roboxim_tasks.checks import Document
from roboxim_tasks.limits import LimitsConfig
from roboxim_tasks.roles import DISTRACTOR, STAY
from roboxim_tasks.sampling.generators import GenerationContext
from roboxim_tasks.skills import SKILLS
from roboxim_tasks.task_config import TaskConfig, VisibleConfig

FIXED = "fixed"
"""Key of a task's YAML that makes its scene a given one."""


@dataclass(frozen=True, kw_only=True)
class FixedScene:
    """A given scene and what the task is in it."""

    instruction: str
    """The instruction."""
    roles: dict[str, str]
    """Role of the skill, or ``distractor_<n>``, to the entity of the scene that fills it."""
    scene: SceneSpec
    """The scene, complete: start of the robot, objects, cameras, look."""
    stay_m: float = 0.0
    """Largest displacement of a distractor, beyond which the episode has failed [m]; 0: no limit."""


@dataclass(frozen=True, kw_only=True)
class FixedTask:
    """The YAML file of a task with a given scene."""

    skill: str
    """Registered skill."""
    fixed: FixedScene
    """The scene."""
    parameters: Any = None
    """The skill's parameters and thresholds."""
    lenient: Any = None
    """Parameters with other values for the evaluation of policies (purpose ``eval`` or ``train``)."""
    visible: VisibleConfig = VisibleConfig()
    """Required visibility of the objects that the instruction names."""
    limits: LimitsConfig | None = None
    """Measures beside success, and their limits; none: they are not recorded, ``{}``: recorded without limits."""
    max_steps: int = 0
    """Actions after which an episode has failed; 0: the skill's number, scaled to the same duration."""


@dataclass(frozen=True, kw_only=True)
class FixedTaskConfig(TaskConfig):
    """A complete task with a given scene. What a reset would draw, it does not have."""

    fixed: FixedScene
    """The scene."""

    def base_scene(self) -> SceneSpec:
        """Return the given scene."""
        return self.fixed.scene

    def task(self, purpose: str, library: ModelLibrary) -> TaskSpec:
        """Return the task, with the arguments that the skill's generator gives it in this scene.

        Args:
            purpose: Those of `EVALUATED` use the lenient parameters.
            library: Library of the objects, the source of their nouns.
        """
        objects = {}
        for role, name in self.fixed.roles.items():
            entity = self.fixed.scene.entity(name)
            noun = library.entity_model(entity).name
            objects[role] = PhysicalObject(entity=name, model=entity.model, name=noun, modifiers=entity.modifiers)
        skill = SKILLS[self.skill]
        context = GenerationContext(
            seed=SeedPath(run_seed=0, purpose=purpose, index=0), config=self, library=library, roles=skill.roles,
            mismatch=skill.mismatch, given={role: objects[role] for role in skill.roles}, text=skill.templates[0],
        )  # fmt: skip
        stay = {STAY: self.fixed.stay_m} if self.fixed.stay_m else {}
        arguments = skill.generate(context).arguments | stay | self.limit_arguments()
        return TaskSpec(skill=self.skill, objects=objects, arguments=arguments, instruction=self.fixed.instruction)


def fixed_task_config(data: Mapping[str, Any], *, source: str, library: ModelLibrary) -> FixedTaskConfig:
    """Build a task with a given scene from plain data.

    Args:
        data: As of `roboxim_tasks.config.task_config`, with the key ``fixed``.
        source: Name of the data's source, for messages.
        library: Library of the objects.

    Raises:
        ConfigError: When keys are wrong, a role is missing or unknown, an entity is not in the scene, or a model cannot
            fill its role.
    """
    document = Document(source, data)
    file: FixedTask = document.build(data, FixedTask, ())
    document.require(("skill",), file.skill, SKILLS)
    skill, fixed = SKILLS[file.skill], _started(document, file.fixed, library)
    _check_roles(document, file, library)
    given = {key: data.get(key) or {} for key in ("parameters", "lenient")}
    parameters = document.build(given["parameters"], skill.Parameters, ("parameters",))
    lenient = document.build(merged(given["parameters"], given["lenient"]), skill.Parameters, ("lenient",))
    models = {role: (library.entity_model(fixed.scene.entity(fixed.roles[role])),) for role in skill.roles}
    for key, values in (("parameters", parameters), ("lenient", lenient)):
        with document.section((key,)):
            skill.check(values, models)
        if problem := skill.mismatch(values, {role: found[0] for role, found in models.items()}):
            raise document.error((FIXED, "roles"), problem)
    rate_hz = fixed.scene.control_rate_hz
    return FixedTaskConfig(
        skill=file.skill, parameters=parameters, lenient=lenient, visible=file.visible, limits=file.limits,
        rate_hz=rate_hz, fixed=fixed, max_steps=file.max_steps or ticks(skill.max_steps / DEFAULT_RATE_HZ, rate_hz),
    )  # fmt: skip


def _started(document: Document, fixed: FixedScene, library: ModelLibrary) -> FixedScene:
    """Return a given scene whose robot has a start: its home, if the file gives none."""
    robot = fixed.scene.robot
    with document.section((FIXED, "scene", "robot")):
        home = library.robot(robot.model).home
    if robot.joint_positions:
        return fixed
    return replace(fixed, scene=replace(fixed.scene, robot=replace(robot, joint_positions=tuple(home))))


def _check_roles(document: Document, file: FixedTask, library: ModelLibrary) -> None:
    """Check that every role is filled, once, by an entity of the scene that suits it."""
    roles, fixed = SKILLS[file.skill].roles, file.fixed
    where = (FIXED, "roles")
    for role in roles:
        if role not in fixed.roles:
            raise document.error(where, f"skill '{file.skill}' needs the role '{role}', and no entity has it")
    names = [entity.name for entity in fixed.scene.entities]
    for role, name in fixed.roles.items():
        if role not in roles and not role.startswith(f"{DISTRACTOR}_"):
            raise document.error((*where, role), f"unknown role; {one_of((*roles, f'{DISTRACTOR}_1'), role)}")
        if name not in names:
            raise document.error((*where, role), f"the scene has no entity '{name}'; {one_of(names, name)}")
        with document.section((FIXED, "scene", "entities")):
            model = library.entity_model(fixed.scene.entity(name))
        if role in roles and not roles[role].suits(model):
            raise document.error((*where, role), f"a {model.id} ('{name}') cannot fill it")
    if len(set(fixed.roles.values())) < len(fixed.roles):
        raise document.error(where, "two roles have the same entity; each needs one of its own")
    if not fixed.instruction.strip():
        raise document.error((FIXED, "instruction"), "expected a text, got none")
