"""Whether an episode shows what its instruction says: it ends when the task is done, and it is that task."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.documents import parse_json
from roboxim_datasets.audit.check import AUDIT_CHECKS, AuditCheck
from roboxim_datasets.audit.values import AuditEpisode, CannotCheckError, Finding

AFTER_S = 1.0
AFTER_SHARE = 0.1


@AUDIT_CHECKS.register("continues_after_done")
class ContinuesAfterDone(AuditCheck):
    """Ticks after the task is done, or a success that is lost again (thesis 6.1.2, issue 1)."""

    title = "The episode continues after the task is done"
    reason = (
        "For one instruction the arm moves towards the object in some ticks and away from it in others; a policy "
        "learns both."
    )
    threshold = (
        f"more than {AFTER_S:g} s, or more than {100 * AFTER_SHARE:.0f} % of the ticks, after the tick from which the "
        "task stays solved; or a success that is lost before the end"
    )
    needs = "ground truth: the judge on the recorded states"
    order = 1

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find ticks after the success."""
        solved, last = np.array(episode.require_truth().solved), len(episode.episode)
        if not solved.any():
            raise CannotCheckError("the recorded task is never solved")
        curve = {"task solved": tuple(float(value) for value in solved)}
        if not solved[-1]:
            lost = int(np.flatnonzero(solved)[-1])
            yield episode.finding(
                f"the task is solved at tick {lost} and no longer at the end, tick {len(solved) - 1}",
                ticks=(lost, last),
                series=curve,
            )
            return
        unsolved = np.flatnonzero(~solved)
        done = int(unsolved[-1]) + 1 if len(unsolved) else 0
        after = last - done
        if after / episode.rate_hz > AFTER_S or after > max(1.0, AFTER_SHARE * last):
            yield episode.finding(
                f"{after} of {last} ticks ({after / episode.rate_hz:.1f} s) follow tick {done}, from which the "
                "task stays solved",
                ticks=(done, (done + last) // 2, last),
                series=curve,
            )


@AUDIT_CHECKS.register("wrong_instruction")
class WrongInstruction(AuditCheck):
    """An instruction that the episode does not carry out (thesis 6.1.2, issue 4)."""

    title = "The instruction is wrong"
    reason = "The policy learns to act against the instruction, and to ignore the words."
    threshold = (
        "the instruction's own predicate is true at no tick, it names an object that the scene lacks, or it is not the "
        "instruction of the recorded task; or it is empty"
    )
    needs = "ground truth: the judge on the recorded states; without it the recorded task, if the dataset has it"
    order = 4

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find instructions that are not carried out."""
        instruction = episode.episode.instruction
        text = ""
        if not instruction.strip():
            text = "the instruction is empty"
        elif episode.truth is not None and episode.truth.meaning is not None:
            if not episode.truth.meaning.ever and episode.episode.success is False:
                raise CannotCheckError("the episode failed, so its unfulfilled instruction is not a fault")
            if not episode.truth.meaning.ever:
                text = f"'{instruction}' is true at no tick; {episode.truth.meaning.detail}"
        else:
            recorded = episode.relabelled or _recorded_instruction(episode)
            if instruction not in (recorded, episode.prompt(recorded)):
                what = "the instruction that it was given" if episode.relabelled else "the recorded task"
                text = f"it is '{instruction}', {what} is '{episode.prompt(recorded)}'"
        if text:
            last = len(episode.episode) - 1
            yield episode.finding(text, ticks=(0, last // 2, last))


def _recorded_instruction(episode: AuditEpisode) -> str:
    """Return the instruction of the task that RoboXim's exports store beside the steps."""
    try:
        task = parse_json(str(episode.episode.metadata["task"]), source="task")
        return str(task["instruction"])
    except (ConfigError, KeyError, TypeError):
        if episode.truth is not None:
            raise CannotCheckError("the instruction follows no template of a known skill") from None
        raise CannotCheckError(f"{episode.no_truth}; nor does it hold the recorded task") from None
