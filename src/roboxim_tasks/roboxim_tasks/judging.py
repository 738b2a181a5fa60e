"""The judge: a pure fold of state records into verdicts; the same code judges live and from a bag."""

from __future__ import annotations

from roboxim_core.errors import ErrorCode, TaskError
from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_core.verdicts import NOT_HELD, Verdict
from roboxim_tasks.limits import Limits, limits_of
from roboxim_tasks.measures import (
    FALLEN_M,
    OPENED,
    TOPPLED_DEG,
    Assessment,
    Condition,
    Conditions,
    Evaluator,
    joints_moved,
    largest_shift,
    lowest_lift,
    toppled,
)
from roboxim_tasks.roles import STAY, task_distractors
from roboxim_tasks.sequences.skill import skill_of
from roboxim_tasks.sequences.steps import steps_of


class Judge:
    """Judge of one episode.

    Non-obvious: ``success`` at a tick means that the task has been solved without a break for the evaluator's
    ``hold_s``. It is lost again, for example when the object slips. A failure (the target fell off the table) is final.
    """

    def __init__(self, task: TaskSpec) -> None:
        """Prepare to judge a task.

        Raises:
            TaskError: With code ``UNKNOWN_SKILL`` when the task's skill is not registered.
        """
        self.task = task
        self._skill = skill_of(task)
        self._verdict = Verdict()
        self._state: StateRecord | None = None
        self._solved_since_ns: int | None = None

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """Everything that must hold in the started episode, with its measure and bounds: the skill's, then the rest.

        A skill whose evaluator is no `Conditions` contributes none.
        """
        parts = (self._evaluator, *reversed(self._others))
        return tuple(condition for part in parts if isinstance(part, Conditions) for condition in part.conditions)

    @property
    def hold_s(self) -> float:
        """Time for which all must hold without a break [s]."""
        return self._evaluator.hold_s

    def start(self, state: StateRecord) -> Verdict:
        """Judge tick 0.

        Raises:
            TaskError: When the state is of another tick, or the scene lacks an object of the task.
        """
        if state.seq != 0:
            raise TaskError(f"episode {state.episode_id}: judging starts with tick 0, got tick {state.seq}")
        present = {entity.name for entity in state.entities}
        missing = sorted(thing.entity for thing in self.task.objects.values() if thing.entity not in present)
        if missing:
            raise TaskError(
                f"episode {state.episode_id}: the scene lacks {missing} of the task; it has {sorted(present)}"
            )
        self._verdict, self._solved_since_ns = Verdict(), None
        self._evaluator = self._skill.evaluator(self.task, state)
        limits = limits_of(self.task)
        measured = Limits(limits, self.task) if limits else None
        others = (surroundings(self.task, state), undisturbed(self.task, state), measured)
        self._others: tuple[Evaluator, ...] = tuple(filter(None, others))
        return self._fold(state)

    def step(self, state: StateRecord) -> Verdict:
        """Judge the next tick.

        Raises:
            TaskError: When the state is not of the next tick of the started episode.
        """
        last = self._state
        if last is None or state.seq != last.seq + 1 or state.episode_id != last.episode_id:
            expected = f"tick {last.seq + 1} of {last.episode_id}" if last else "tick 0"
            raise TaskError(
                f"judging needs every tick in order: expected {expected}, got tick {state.seq} of {state.episode_id}",
                ErrorCode.UNKNOWN_EPISODE if last is None else ErrorCode.TASK_FAULT,
            )
        return self._fold(state)

    def _fold(self, state: StateRecord) -> Verdict:
        self._state = state
        assessment = self._evaluator.assess(state)
        for others in self._others:
            assessment = _both(others.assess(state), assessment)
        failed = self._verdict.failed or assessment.failed
        reason = self._verdict.reason if self._verdict.failed else assessment.reason
        if not assessment.solved or failed:
            self._solved_since_ns = None
        elif self._solved_since_ns is None:
            self._solved_since_ns = state.stamp_ns
        held_s = 0.0 if self._solved_since_ns is None else (state.stamp_ns - self._solved_since_ns) / 1e9
        success = self._solved_since_ns is not None and held_s >= self._evaluator.hold_s - 1e-9
        self._verdict = Verdict(
            success=success,
            success_ever=success or self._verdict.success_ever,
            failed=failed,
            reason="" if success else reason or (NOT_HELD if assessment.solved else "not_solved"),
            predicates=assessment.predicates | {"held_s": held_s},
        )
        return self._verdict


def surroundings(task: TaskSpec, initial: StateRecord) -> Conditions:
    """Return the evaluator of what a person sees besides the task, in every skill.

    Nothing but the target, or the targets of the steps, may have toppled, fallen off the table, or been opened; a joint
    that the task names may move.
    """
    steps = steps_of(task)
    targets = {step.objects["target"].entity for step in steps if "target" in step.objects}
    others = [entity.name for entity in initial.entities if entity.name not in targets]
    named = {thing.entity for thing in task.objects.values()} - {thing.entity for thing in task_distractors(task)}
    joints = {str(step.arguments.get("joint", "")) for step in steps}
    movable = {(name, joint) for name in named for joint in joints}
    # Of a target that stays in place, the step itself guards the other joints, but only until it is done.
    carried = {s.objects["target"].entity for s in steps if "target" in s.objects and not s.arguments.get("joint")}
    shut = others if len(steps) == 1 else [entity.name for entity in initial.entities if entity.name not in carried]
    return Conditions(
        (
            Condition(
                name="others_on_table", measure=lowest_lift(others, initial, "others_lift_m"), least=-FALLEN_M,
                reason="pushed_off_table", fatal=True,
            ),
            Condition(
                name="others_upright", measure=toppled(others, initial, "others_toppled_deg"), most=TOPPLED_DEG,
                reason="toppled_other",
            ),
            Condition(
                name="others_shut", most=OPENED, reason="opened_other",
                measure=joints_moved(shut, initial, "others_joint", but=movable),
            ),
        ),
        hold_s=0.0,
    )  # fmt: skip


def undisturbed(task: TaskSpec, initial: StateRecord) -> Conditions | None:
    """Return the evaluator that requires a task's distractors to stay in place; none: they may be moved."""
    if STAY not in task.arguments:
        return None
    shift = largest_shift((thing.entity for thing in task_distractors(task)), initial, "distractors_shift_m")
    most = float(task.arguments[STAY])
    stayed = Condition(
        name="distractors_stayed", measure=shift, most=most, reason="disturbed_distractor", fatal=True
    )  # fmt: skip
    return Conditions((stayed,), hold_s=0.0)


def _both(first: Assessment, second: Assessment) -> Assessment:
    return Assessment(
        solved=first.solved and second.solved,
        failed=first.failed or second.failed,
        reason=first.reason or second.reason,
        predicates=first.predicates | second.predicates,
    )
