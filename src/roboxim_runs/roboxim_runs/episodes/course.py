"""The course of a recorded episode: actions, joints and conditions tick by tick, from its bag."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_eval.report.course import ConditionCourse, what_happened
from roboxim_recorder.bag import BagReader, BagTick
from roboxim_tasks.judging import Judge


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
        recorded = [tick.step.verdict.predicates for tick in self.ticks]
        return tuple(
            ConditionCourse(
                name=one.name, measure=one.measure.name, least=one.least, most=one.most, reason=one.reason,
                fatal=one.fatal,
                values=np.array([found.get(one.measure.name, np.nan) for found in recorded]),
                holds=np.array([bool(found.get(one.name, 0.0)) for found in recorded]),
            )
            for one in self.judge.conditions
            if all(one.name in found for found in recorded)
        )  # fmt: skip

    @property
    def told(self) -> str:
        """What happened, in a sentence with numbers; empty for a success.

        Raises:
            TaskError: When the task's skill is not registered here.
        """
        if self.result.outcome == "success" or not self.ticks:
            return ""
        held = max(tick.step.verdict.predicates.get("held_s", 0.0) for tick in self.ticks)
        return what_happened(
            self.conditions, solved=False, reason=self.result.reason, hold_s=self.judge.hold_s, held_s=held
        )
