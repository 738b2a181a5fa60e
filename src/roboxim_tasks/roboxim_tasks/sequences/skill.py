"""A sequence as a skill: generator, resetter and evaluator composed of those of its steps.

Non-obvious: the expert does not plan a sequence as one motion. It plans each step when the step before is done, so
`Sequence.stages` are those of the first step; `roboxim_tasks.demonstration.chain` plans all of them for a reset.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass, replace
from string import Formatter
from typing import Any

from roboxim_core.errors import ErrorCode, TaskError
from roboxim_core.models.description import ObjectModel
from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.components.toppled import ToppledReset
from roboxim_tasks.measures import Evaluator
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.roles import STAY, Role, description
from roboxim_tasks.sampling.generators import GenerationContext, generate_distractors, generate_objects
from roboxim_tasks.sequences.progress import Progress
from roboxim_tasks.sequences.steps import ORDER, arguments_of, is_sequence, joined, own_objects, steps_of, templates_of
from roboxim_tasks.skills import SKILLS
from roboxim_tasks.skills.base import Skill
from roboxim_tasks.task_config import DistractorConfig, ObjectConfig, StepConfig, TaskConfig

TOPPLED = ToppledReset.name


@dataclass(frozen=True, kw_only=True)
class SequenceParameters:
    """A sequence has no own parameters; its steps have."""


@dataclass(frozen=True, kw_only=True)
class _AllRoles(Role):
    """A role of the task that fills roles of several steps: a model must suit all of them."""

    of: tuple[Role, ...] = ()

    def suits(self, model: ObjectModel) -> bool:
        return all(role.suits(model) for role in self.of)


class Sequence(Skill):
    """A skill made of steps, each a registered skill whose roles are filled by roles of the sequence."""

    Parameters = SequenceParameters

    def __init__(self, steps: Many[StepConfig], order: str) -> None:
        """Compose steps.

        Args:
            steps: The steps; their ``roles`` name a role of the task for each role of the skill, or omit it if it has
                the same name.
            order: ``fixed`` or ``any``.
        """
        self.steps = tuple(replace(s, roles={r: s.roles.get(r, r) for r in SKILLS[s.skill].roles}) for s in steps)
        self.skills = tuple(SKILLS[step.skill] for step in steps)
        fills: dict[str, list[Role]] = {}
        for step, skill in zip(self.steps, self.skills, strict=True):
            for own, role in step.roles.items():
                fills.setdefault(role, []).append(skill.roles[own])
        pairs = zip(self.steps, self.skills, strict=True)
        lying = tuple(dict.fromkeys(step.roles["target"] for step, skill in pairs if TOPPLED in skill.components))
        vars(self).update(
            name=joined(step.skill for step in steps),
            roles={role: _joint_role(roles) for role, roles in fills.items()},
            words=tuple(f"step_{number}" for number in range(1, len(steps) + 1)),
            templates=templates_of(len(steps), order),
            components=tuple(dict.fromkeys(name for skill in self.skills for name in skill.components)),
            max_steps=sum(skill.max_steps for skill in self.skills),
            reset={TOPPLED: {"roles": lying}} if lying else {},
        )

    def mismatch(self, parameters: Any, models: Mapping[str, ObjectModel]) -> str:
        """Return why models do not go together in some step; empty if they do."""
        for number, (step, skill) in enumerate(zip(self.steps, self.skills, strict=True), start=1):
            step_models = {own: models[role] for own, role in step.roles.items()}
            for base, drawn in itertools.product(dict.fromkeys((step.parameters, step.lenient)), _combinations(step)):
                if base is not None and (reason := skill.mismatch(replace(base, **drawn), step_models)):
                    return f"step {number}: {reason}"
        return ""

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw the objects of all steps together, then each step's arguments and words, then the whole sentence."""
        contexts = [self._context(context, number) for number in range(len(self.steps))]
        wording = replace(context, text=self._instruction(context.template, contexts))
        objects = generate_objects(wording)
        distractors = generate_distractors(wording, objects)
        tasks = []
        for step, skill, step_context in zip(self.steps, self.skills, contexts, strict=True):
            given = {own: objects[role] for own, role in step.roles.items()} | distractors
            tasks.append((skill.generate(replace(step_context, given=given)), step.roles))
        words = {f"step_{n}": _lower_first(task.instruction) for n, (task, _) in enumerate(tasks, start=1)}
        sentence = context.template.format_map({role: description(thing) for role, thing in objects.items()} | words)
        stay_m = context.config.distractors.stay_m
        return TaskSpec(
            skill=self.name,
            objects=objects | distractors,
            arguments=arguments_of(tasks, context.config.order) | ({STAY: stay_m} if stay_m else {}),
            instruction=sentence[:1].upper() + sentence[1:],
        )

    def constraints(self, context: ResetContext) -> Many[Constraint]:
        """Return the constraints of the first step, and those of later ones whose objects are untouched until then.

        The other demands of later steps are checked by planning all steps.
        """
        found: dict[str, Constraint] = {}
        touched: set[str] = set()
        for number, task in enumerate(steps_of(context.task), start=1):
            own = set(own_objects(task).values())
            if not own & touched:
                for constraint in SKILLS[task.skill].constraints(replace(context, task=task)):
                    name = constraint.name if constraint.name == "start_clear" else f"step_{number}_{constraint.name}"
                    found.setdefault(name, replace(constraint, name=name))
            touched |= own
        return tuple(found.values())

    def stages(self, scene: ExpertScene) -> Iterable[tuple[Stage, ...]]:
        """Yield candidates of the first step."""
        first, *_ = steps_of(scene.task)
        return SKILLS[first.skill].stages(replace(scene, task=first))

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Return the fold that judges step by step."""
        return Progress(task, initial)

    def _context(self, context: GenerationContext, number: int) -> GenerationContext:
        """Return the inputs of a step's generator: its own configuration, without distractors."""
        step, skill = self.steps[number], self.skills[number]
        objects = {own: context.config.objects.get(role, ObjectConfig()) for own, role in step.roles.items()}
        config = replace(
            context.config, skill=step.skill, parameters=step.parameters, lenient=step.lenient, steps=(),
            arguments=step.arguments, templates=step.templates, objects=objects, exclude=(),
            distractors=DistractorConfig(),
        )  # fmt: skip
        text = context.step_template(number + 1)
        return replace(context, config=config, roles=skill.roles, mismatch=skill.mismatch, text=text)

    def _instruction(self, template: str, contexts: Many[GenerationContext]) -> str:
        """Return a template that contains each step's own template, with roles of the sequence."""
        steps = {}
        for number, (step, context) in enumerate(zip(self.steps, contexts, strict=True), start=1):
            parts = (
                text + (f"{{{step.roles.get(name, name)}}}" if name else "")
                for text, name, _, _ in Formatter().parse(context.template)
            )
            steps[f"step_{number}"] = "".join(parts)
        return "".join(
            text + (steps.get(name, f"{{{name}}}") if name else "")
            for text, name, _, _ in Formatter().parse(template)
        )  # fmt: skip


def skill_of(thing: TaskSpec | TaskConfig) -> Skill:
    """Return the skill of a task or of its configuration: a registered one, or the sequence that it describes.

    Raises:
        TaskError: With code ``UNKNOWN_SKILL`` when the task's skill, or that of a step, is not registered.
    """
    if not is_sequence(thing.skill):
        return _known(thing.skill)
    if isinstance(thing, TaskConfig) and thing.steps:
        return Sequence(thing.steps, thing.order)
    if isinstance(thing, TaskConfig):
        raise TaskError(f"'{thing.skill}' needs its 'steps'", ErrorCode.UNKNOWN_SKILL)
    whole = {entity: role for role, entity in ((r, t.entity) for r, t in thing.objects.items())}
    steps = []
    for task in steps_of(thing):
        roles = {own: whole[entity] for own, entity in own_objects(task).items()}
        steps.append(StepConfig(skill=task.skill, roles=roles, parameters=_known(task.skill).Parameters()))
    return Sequence(steps, str(thing.arguments.get(ORDER, "fixed")))


def _known(name: str) -> Skill:
    if name not in SKILLS:
        raise TaskError(f"unknown skill '{name}'; expected one of: {', '.join(SKILLS)}", ErrorCode.UNKNOWN_SKILL)
    return SKILLS[name]


def _joint_role(roles: Many[Role]) -> Role:
    """Return the role that fills several: their defaults are those of the first."""
    if len(roles) == 1:
        return roles[0]
    affordances = dict.fromkeys(role.affordance for role in roles if role.affordance)
    models = next((role.models for role in roles if role.models != ("cube",)), ("cube",))
    widths = [role.max_width_m for role in roles if role.max_width_m]
    return _AllRoles(
        affordance=" and ".join(affordances), models=models, max_width_m=min(widths, default=0.0), of=tuple(roles)
    )


def _combinations(step: StepConfig) -> Iterable[dict[str, Any]]:
    for values in itertools.product(*(choice.ends for choice in step.arguments.values())):
        yield dict(zip(step.arguments, values, strict=True))


def _lower_first(sentence: str) -> str:
    return sentence[:1].lower() + sentence[1:]
