"""How far a sequence is: judges the state records step by step.

- A step is judged by its own skill's evaluator, which begins when the step's turn begins. With the order ``any`` it is
  the turn of every step that is not done; with ``fixed``, of the first one.
- A step is done once its evaluator has held for its ``hold_s``. In a fixed order it must have been unsolved at some
  tick of its turn, so that a later step done before its turn does not count. An event, such as a press, is looked for
  only in its turn; so it counts there from the first tick on.
- A step that is done must hold at the end, unless a later step moves its objects on (`superseded`). With the order
  ``any``, later is what was done after it.
- The sequence is solved while all steps are done and hold.

Non-obvious: a step's evaluator compares with tick 0 what no earlier step has handled, and with the start of its turn
what one has. So a lifted object counts as lifted even if the step before was done a tick late.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_core.verdicts import STEP, STEPS_DONE, STEPS_SHARE
from roboxim_tasks.measures import Assessment, Conditions, Evaluator, fallen_off, lowest_lift
from roboxim_tasks.sequences.steps import ORDER, own_objects, steps_of, superseded
from roboxim_tasks.skills.base import SKILLS

OTHERS = frozenset({"others_left", "others_stayed", "reference_stayed", "support_stayed", "nothing_else_put"})
"""Conditions about other objects and joints, which later steps may move: they do not bind a step that is done."""


@dataclass
class _Step:
    """One step and how far it is."""

    task: TaskSpec
    lasting: bool
    """Whether it must hold at the end."""
    evaluator: Evaluator | None = None
    unsolved: bool = False
    """Whether it has been unsolved since its turn began."""
    since_ns: int | None = None
    done: bool = False
    holds: bool = False
    reason: str = ""


class Progress:
    """Evaluator of a sequence; see the module."""

    def __init__(self, task: TaskSpec, initial: StateRecord) -> None:
        """Start at tick 0.

        Args:
            task: The task, with steps.
            initial: State of tick 0.
        """
        steps = steps_of(task)
        self._any = task.arguments.get(ORDER) == "any"
        self._initial = initial
        later = [() if self._any else steps[k + 1 :] for k in range(len(steps))]
        self._steps = [_Step(s, not superseded(s, rest)) for s, rest in zip(steps, later, strict=True)]
        self._handled: set[str] = set()
        targets = {own_objects(step)["target"] for step in steps if "target" in step.objects}
        falls = lowest_lift(sorted(targets), initial, "targets_lift_m")
        self._fallen = Conditions((fallen_off(falls),), hold_s=0.0)
        self._begin(initial)
        self.hold_s = max((s.evaluator or SKILLS[s.task.skill].evaluator(s.task, initial)).hold_s for s in self._steps)

    @property
    def done(self) -> tuple[bool, ...]:
        """Which steps are done, even if they no longer hold."""
        return tuple(step.done for step in self._steps)

    def assess(self, state: StateRecord) -> Assessment:
        """Assess the next tick."""
        predicates: dict[str, float] = {}
        fallen = self._fallen.assess(state)
        failed, reason = fallen.failed, fallen.reason
        finished: set[str] = set()
        for number, step in enumerate(self._steps, start=1):
            if step.evaluator is None:
                continue
            found = step.evaluator.assess(state)
            predicates |= {f"step_{number}.{name}": value for name, value in found.predicates.items()}
            if step.done:
                step.holds = not step.lasting or _holds(step.evaluator, found)
                continue
            step.reason = found.reason
            if found.failed:
                failed, reason = True, reason or f"step_{number}_{found.reason}"
            if self._count(step, found, state):
                own = own_objects(step.task)
                finished |= {own["target"]} if "target" in own else set(own.values())
        if finished:
            self._begin(state, finished)
        counted = sum(step.done and step.holds for step in self._steps)
        predicates |= {f"step_{n}_done": float(s.done and s.holds) for n, s in enumerate(self._steps, start=1)}
        predicates |= {
            STEP: float(self.current + 1),
            STEPS_DONE: float(counted),
            STEPS_SHARE: counted / len(self._steps),
        }
        solved = counted == len(self._steps) and not failed
        return Assessment(
            solved=solved, failed=failed, reason="" if solved else reason or self._reason(),
            predicates=predicates | fallen.predicates,
        )  # fmt: skip

    @property
    def current(self) -> int:
        """Number, from 0, of the first step that is not done; the last one if all are."""
        return next((n for n, step in enumerate(self._steps) if not step.done), len(self._steps) - 1)

    def _count(self, step: _Step, found: Assessment, state: StateRecord) -> bool:
        """Return whether a step whose turn it is has become done at this tick."""
        assert step.evaluator is not None
        if not found.solved:
            step.unsolved, step.since_ns = True, None
            return False
        if not (step.unsolved or self._any):
            step.reason = "before_its_turn"
            return False
        step.since_ns = state.stamp_ns if step.since_ns is None else step.since_ns
        held_s = (state.stamp_ns - step.since_ns) / 1e9
        if held_s < step.evaluator.hold_s - 1e-9:
            step.reason = "not_held"
            return False
        for before in (other for other in self._steps if self._any and other.done):
            before.lasting &= not superseded(before.task, (step.task,))
        step.done = step.holds = True
        self._handled |= set(own_objects(step.task).values())
        return True

    def _begin(self, state: StateRecord, moved: Collection[str] = ()) -> None:
        """Begin the turn of the next step, or again of those that are left and are about objects just moved."""
        known = {e.name: e for e in self._initial.entities if e.name not in self._handled}
        for step in (step for step in self._steps if not step.done):
            skill, things = SKILLS[step.task.skill], set(own_objects(step.task).values())
            if step.evaluator is not None and not things & set(moved):
                continue
            own = things if skill.event else set()
            start = tuple(e if e.name in own else known.get(e.name, e) for e in state.entities)
            step.evaluator = skill.evaluator(step.task, replace(state, entities=start))
            step.unsolved, step.since_ns = skill.event, None
            if not self._any:
                break

    def _reason(self) -> str:
        """Return which step is not done, or done no longer, and why."""
        for number, step in enumerate(self._steps, start=1):
            if step.done and not step.holds:
                return f"step_{number}_undone"
            if not step.done and not self._any:
                return f"step_{number}_{step.reason or 'not_solved'}"
        number, step = next((n, s) for n, s in enumerate(self._steps, start=1) if not s.done)
        return f"step_{number}_{step.reason or 'not_solved'}"


def _holds(evaluator: Evaluator, found: Assessment) -> bool:
    """Return whether a step that is done still holds, conditions about other objects aside."""
    if not isinstance(evaluator, Conditions):
        return found.solved
    return all(found.predicates[c.name] == 1.0 for c in evaluator.conditions if c.name not in OTHERS)
