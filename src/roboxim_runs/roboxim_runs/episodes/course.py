"""The course of a recorded episode: actions, joints and conditions tick by tick, from its bag."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_eval.report.course import ConditionCourse, explain_steps, what_happened
from roboxim_recorder.bag import BagReader, BagTick
from roboxim_tasks.judging import Judge
from roboxim_tasks.measures import Condition, Conditions
from roboxim_tasks.sequences.steps import steps_of
from roboxim_tasks.skills import SKILLS


@dataclass(frozen=True, kw_only=True, eq=False)
class Course:
    """What was recorded of an episode, besides its images."""

    info: EpisodeInfo
    """The episode."""
    result: EpisodeResult
    """How it ended."""
    ticks: Sequence[BagTick]
    """Its ticks, from 0."""

    @staticmethod
    def of(bag: Path) -> Course:
        """Read a bag.

        Raises:
            ConfigError: When the path is not a bag.
            RecorderError: With code ``BAG_DAMAGED``.
        """
        reader = BagReader(bag)
        return Course(info=reader.info, result=reader.result, ticks=tuple(reader.ticks(cameras=())))

    @cached_property
    def judge(self) -> Judge:
        """The judge of its task, started at its tick 0.

        Raises:
            TaskError: When the task's skill is not registered here.
        """
        judge = Judge(self.info.task)
        judge.start(self.ticks[0].state)
        return judge

    @cached_property
    def conditions(self) -> tuple[ConditionCourse, ...]:
        """Its conditions, with the recorded measures and this version's bounds; those not recorded are left out.

        Raises:
            TaskError: When the task's skill is not registered here.
        """
        return (*self._of_step, *self._judged(self.judge.conditions))

    @cached_property
    def failed_step(self) -> int:
        """Number, from 1, of the step that failed in a task of several steps; 0: none did."""
        number, steps = self.result.verdict.step, len(self.info.task.step_words)
        if undone := re.match(r"step_(\d+)_", self.result.reason):
            number = int(undone[1])
        return number if self.result.outcome != "success" and number <= steps else 0

    @cached_property
    def _of_step(self) -> tuple[ConditionCourse, ...]:
        """The conditions of the step that failed; its ticks before its turn have no values."""
        if not self.failed_step:
            return ()
        step = steps_of(self.info.task)[self.failed_step - 1]
        evaluator = SKILLS[step.skill].evaluator(step, self.ticks[0].state)
        conditions = evaluator.conditions if isinstance(evaluator, Conditions) else ()
        return tuple(self._judged(conditions, f"step_{self.failed_step}"))

    def _judged(self, conditions: Iterable[Condition], of: str = "") -> Iterator[ConditionCourse]:
        """Yield the recorded course of conditions; those of a step are recorded with its name before theirs."""
        recorded = [tick.step.verdict.predicates for tick in self.ticks]
        prefix = f"{of}." if of else ""
        for one in conditions:
            judged = [prefix + one.name in found for found in recorded]
            if all(judged) or (of and judged[-1]):
                reason = f"{of}_{one.reason or f'not_{one.name}'}" if of else one.reason
                yield ConditionCourse(
                    name=one.name, measure=one.measure.name, least=one.least, most=one.most, reason=reason,
                    fatal=one.fatal and not of,
                    values=np.array([found.get(prefix + one.measure.name, np.nan) for found in recorded]),
                    holds=np.array([bool(found.get(prefix + one.name, 0.0)) for found in recorded]),
                )  # fmt: skip

    @property
    def explanation(self) -> str:
        """What happened, in a sentence with numbers; empty for a success.

        Raises:
            TaskError: When the task's skill is not registered here.
        """
        if self.result.outcome == "success" or not self.ticks:
            return ""
        words = self.info.task.step_words
        held = max(tick.step.verdict.predicates.get("held_s", 0.0) for tick in self.ticks)
        explanation = what_happened(
            self.conditions, solved=False, reason=self.result.reason, hold_s=self.judge.hold_s, held_s=held
        )
        if not words:
            return explanation
        done = [
            [bool(t.step.verdict.predicates.get(f"step_{k}_done")) for t in self.ticks] for k, _ in enumerate(words, 1)
        ]
        since = [len(of) - of[::-1].index(False) if False in of else 0 for of in done]
        ends = [tick if of[-1] else None for tick, of in zip(since, done, strict=True)]
        return explain_steps(words, ends, self.failed_step, explanation)
