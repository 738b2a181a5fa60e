"""Draws episodes: a task from the generators, a scene from the reset components."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from roboxim_core.config import to_json
from roboxim_core.episode import Draw
from roboxim_core.errors import ConfigError, ErrorCode, TaskError
from roboxim_core.kinematics import Arms
from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_tasks.components import COMPONENTS, ResetContext
from roboxim_tasks.config import TaskMix
from roboxim_tasks.demonstration.solvable import CONSTRAINT, Solvability
from roboxim_tasks.demonstration.solver import Solution
from roboxim_tasks.fixed_scene import FixedTaskConfig
from roboxim_tasks.reach import START_CLEARANCE_M
from roboxim_tasks.roles import Wording, description
from roboxim_tasks.sampling.generators import GenerationContext
from roboxim_tasks.sampling.rejection import RejectedError
from roboxim_tasks.sampling.scene_check import Finding, quick_findings, slow_findings
from roboxim_tasks.sampling.visible import Visibility
from roboxim_tasks.sequences.skill import skill_of
from roboxim_tasks.task_config import TaskConfig

CAUSES = {
    "start_clear": f"objects lie within {1000 * START_CLEARANCE_M:.0f} mm of where the hand starts",
    "_overlaps": "there is no free place for the object",
    "_visible": "a camera does not see enough of the object; see 'visible' of the task",
}
"""End of a constraint's name to what it means, where no number is known."""


class EpisodeGenerator:
    """Generator of tasks and scenes; deterministic in seed path and configuration. Not thread-safe (kinematics)."""

    def __init__(
        self, library: ModelLibrary, solvability: Solvability | None = None, visibility: Visibility | None = None
    ) -> None:
        """Make a generator. Omitting a check changes the scenes of a seed.

        Args:
            library: Robots and objects.
            solvability: Check that scenes have a solution; none: no check.
            visibility: Check that the fixed cameras see the objects that the instruction names; none: no check.
        """
        self._library = library
        self._solvability = solvability
        self._visibility = visibility
        self._arms = Arms(library)
        self.last_reset: ResetContext | None = None
        """The newest reset: how often it drew, and what refused its draws."""

    def draw(self, seed: SeedPath, config: TaskConfig | TaskMix) -> Draw:
        """Draw the episode of a seed path; for a mix, from the cell of the episode's index.

        Raises:
            TaskError: With code ``RESET_INFEASIBLE``, naming the constraint that refused most draws.
            ConfigError: When the configuration names what does not exist.
        """
        cell, ordinal = config.at(seed.index)
        task = self.task(seed, config)
        scene = self.reset(seed.of_task(task.drawn), cell, task, ordinal)
        drawn = task.drawn | (self.last_reset.drawn if self.last_reset else {})
        return Draw(task=replace(task, drawn=drawn), scene=scene, max_steps=cell.max_steps, config_json=to_json(cell))

    def task(self, seed: SeedPath, config: TaskConfig | TaskMix) -> TaskSpec:
        """Draw the task of a seed path, without its scene.

        Raises:
            TaskError: With code ``RESET_INFEASIBLE`` when there are no suitable objects or distractors.
            ConfigError: When the configuration names what does not exist.
        """
        cell, ordinal = config.at(seed.index)
        drawn = config.drawn(seed.index)
        if isinstance(cell, FixedTaskConfig):
            return replace(cell.task(seed.purpose, self._library), drawn=drawn)
        skill = skill_of(cell)
        context = GenerationContext(
            seed=seed.of_task(drawn),
            config=cell,
            library=self._library,
            roles=skill.roles,
            mismatch=skill.mismatch,
            ordinal=ordinal,
        )
        task = skill.generate(context)
        task = replace(task, arguments=task.arguments | cell.limit_arguments())
        return replace(task, drawn=drawn | context.drawn(task))

    def sample(self, seed: SeedPath, config: TaskConfig | TaskMix) -> TaskSpec:
        """Draw the task of a seed path, with the recorded choices of the components that place no objects.

        Raises:
            TaskError: With code ``RESET_INFEASIBLE`` when there are no suitable objects, or no reachable start.
            ConfigError: When the configuration names what does not exist.
        """
        cell, ordinal = config.at(seed.index)
        task = self.task(seed, config)
        if isinstance(cell, FixedTaskConfig):
            return task
        context = self._context(seed.of_task(task.drawn), cell, task, ordinal)
        self._begin(context, cell.base_scene())
        return replace(task, drawn=task.drawn | context.drawn)

    def reset(self, seed: SeedPath, config: TaskConfig, task: TaskSpec, ordinal: int | None = None) -> SceneSpec:
        """Draw the scene of a task.

        Components that place objects are drawn again until every constraint of the skill holds. All others are drawn
        once, so that their values do not depend on the number of refused placements.

        Raises:
            TaskError: With code ``RESET_INFEASIBLE``, naming the constraint that refused most draws.
            ConfigError: When the configuration names what does not exist.
        """
        if isinstance(config, FixedTaskConfig):
            return self._given(seed, config, task, ordinal)
        base = config.base_scene()
        wording = Wording.of_task(task, skill_of(config).roles, self._library)
        _check_unambiguous(base, config, task, wording)
        context = self._context(seed, config, task, ordinal)
        self.last_reset = context
        scene = self._begin(context, base)
        while context.draws < config.max_draws:
            context.draws += 1
            try:
                drawn = _apply(scene, context, places=True)
                if any(wording.mistakable(drawn, task)):
                    raise RejectedError("instruction_unambiguous")
                self._check(drawn, context)
                return drawn
            except RejectedError as error:
                context.rejections[error.constraint] += 1
                if error.cause:
                    context.causes.setdefault(error.constraint, Counter())[error.cause] += 1
        (worst, _), *_ = context.rejections.most_common(1)
        raise _infeasible(context, worst, context.draws)

    def context(self, config: FixedTaskConfig, seed: SeedPath) -> ResetContext:
        """Return the reset of a task with a given scene, to check the scene with."""
        return self._context(seed, config, self.task(seed, config), None)

    def findings(self, config: FixedTaskConfig, seed: SeedPath, *, slow: bool = True) -> Iterator[Finding]:
        """Yield every constraint that a given scene violates; the costly checks last, and only if no other does.

        Args:
            config: The task with its scene.
            seed: Seed path of the episode, which the planner's detours depend on.
            slow: Whether to look through the cameras and to plan.
        """
        context, quick = self.context(config, seed), True
        for finding in quick_findings(config.fixed.scene, context):
            quick = False
            yield finding
        if slow and quick:
            yield from slow_findings(config.fixed.scene, context, self._visibility, self._solvability)

    def solution(self, config: FixedTaskConfig, seed: SeedPath) -> Solution | None:
        """Return the expert's motion in a given scene; None: this generator checks no solutions.

        Raises:
            PolicyError: When there is none.
        """
        if self._solvability is None:
            return None
        context = self.context(config, seed)
        return self._solvability.solution(context.task, config.fixed.scene, context.seed.derived_seed("policy"))

    def _given(self, seed: SeedPath, config: FixedTaskConfig, task: TaskSpec, ordinal: int | None) -> SceneSpec:
        """Return a given scene, unless it violates a constraint."""
        self.last_reset = self._context(seed, config, task, ordinal)
        for finding in self.findings(config, seed):
            raise TaskError(
                f"the given scene of '{task.instruction}' breaks constraint {finding.constraint}: {finding.message}; "
                "open it with 'roboxim studio' to see where",
                ErrorCode.RESET_INFEASIBLE,
            )
        return config.fixed.scene

    def _context(self, seed: SeedPath, config: TaskConfig, task: TaskSpec, ordinal: int | None) -> ResetContext:
        context = ResetContext(
            seed=seed,
            config=config,
            task=task,
            library=self._library,
            arm=self._arms[config.base_scene().robot.model],
            ordinal=ordinal,
            way_blocked=partial(self._solvability.way_blocked, task) if self._solvability else None,
        )
        context.constraints = skill_of(config).constraints(context)
        return context

    def _begin(self, context: ResetContext, base: SceneSpec) -> SceneSpec:
        """Return the scene with the draws of the components that place no objects."""
        try:
            return _apply(replace(base, control_rate_hz=context.config.rate_hz), context, places=False)
        except RejectedError as error:
            raise _infeasible(context, error.constraint, context.config.max_draws, error.cause) from None

    def _check(self, scene: SceneSpec, context: ResetContext) -> None:
        """Refuse a scene by the first constraint that it violates; the costly ones come last."""
        for constraint in context.constraints:
            if not constraint.holds(scene):
                context.refused[constraint.name] = scene
                raise RejectedError(constraint.name)
        task, arm = context.task, context.arm
        if self._visibility and (refused := self._visibility.refusal(task, scene, arm, context.config.visible)):
            raise RejectedError(refused)
        if self._solvability is not None:
            cause = self._solvability.refusal(task, scene, context.seed.derived_seed("policy"))
            if cause is not None:
                raise RejectedError(CONSTRAINT, cause)


def _check_unambiguous(base: SceneSpec, config: TaskConfig, task: TaskSpec, wording: Wording) -> None:
    """Refuse a scene that already contains an object that the instruction could mean."""
    for thing in wording.mistakable(base, task):
        raise ConfigError(
            f"scene '{config.scene}' already has a {description(thing)} ('{thing.entity}'), so '{task.instruction}' "
            "would not name one solution; take it out of the scene or restrict the task's objects"
        )


def _apply(scene: SceneSpec, context: ResetContext, *, places: bool) -> SceneSpec:
    """Apply the task's components that place objects, or those that do not."""
    for name, section in context.config.reset.items():
        if COMPONENTS[name].places == places:
            scene = COMPONENTS[name](section).reset(scene, context)
    return scene


def _infeasible(context: ResetContext, constraint: str, draws: int, cause: str = "") -> TaskError:
    """Return the error of a task without a scene; ``cause`` says what no further draw of objects can change."""
    counted = ", ".join(f"{name} {count}" for name, count in context.rejections.most_common())
    advice = "widen the area or volume that it depends on, or ask for fewer objects"
    end = f"; {cause}" if cause else f"{_cause(context, constraint)}; {advice}"
    return TaskError(
        f"no scene for '{context.task.instruction}' in {draws} draws: constraint {constraint} refused most"
        f"{f' ({counted})' if counted else ''}{end}",
        ErrorCode.RESET_INFEASIBLE,
    )


def _cause(context: ResetContext, constraint: str) -> str:
    """Return what refused most draws, with a number where it is known, as the end of a message."""
    if causes := context.causes.get(constraint):
        return f", e.g. {causes.most_common(1)[0][0]}"
    why = next((one.why for one in context.constraints if one.name == constraint), None)
    if why is not None and constraint in context.refused:
        return f", e.g. {why(context.refused[constraint])}"
    return next((f": {text}" for name, text in CAUSES.items() if constraint.endswith(name)), "")
