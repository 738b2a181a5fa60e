"""Evaluates two policies until they differ or the planned scenes are used up (Q1), without more false alarms.

The largest number of scenes and the looks at the results are fixed before the first episode. `evaluate` runs up to each
look; the next look continues the same run. See `roboxim_eval.statistics.sequential`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from roboxim_core.errors import ConfigError
from roboxim_runs.evaluation.results import EvaluationResult, PolicyResult
from roboxim_runs.evaluation.run import EvaluationConfig, evaluate
from roboxim_runs.events import OnEvent, ignore
from roboxim_runs.executors import Cancellation, Executor

if TYPE_CHECKING:
    from roboxim_eval.statistics.paired import Pairs


@dataclass(frozen=True, kw_only=True)
class SequentialResult:
    """Result of an evaluation that may stop early."""

    evaluation: EvaluationResult
    """The evaluation as far as it ran."""
    decided: bool
    """Whether the policies differ."""
    sentence: str
    """What was planned, when it stopped, and what follows."""


def evaluate_sequentially(
    config: EvaluationConfig,
    looks: int,
    *,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    executor: Executor | None = None,
    servers: Sequence[Executor] = (),
) -> SequentialResult:
    """Evaluate two policies on the same scenes, and stop at the first look at which they differ.

    If no look decides, the report calls neither better, even if a test that ignores the looks finds a difference.

    Args:
        config: Configuration of the evaluation; ``episodes`` is the largest number of scenes.
        looks: Number of looks at the results, evenly spaced.
        on_event: Receives the run's events.
        cancellation: Ends the run when it is set.
        executor: Runs the episodes; none: processes of this machine.
        servers: Serve the policies; see `evaluate`.

    Raises:
        ConfigError: When there are not two policies, or fewer scenes than looks, or only a shard is to be run.
        RoboximError: As of `evaluate`.
    """
    from roboxim_eval.statistics.sequential import SequentialPlan, sequential_test

    named = config.policies
    if isinstance(named, str) or not isinstance(named, Sequence) or len(named) != 2:
        raise ConfigError("stopping early compares two policies: name exactly two (--policy)")
    if config.shard:
        raise ConfigError(
            "a shard has a part of the scenes and cannot decide when to stop; run all of them (no --shard)"
        )
    config = config.sized(config.task_text(), ignore)
    if not 1 < looks <= config.episodes:
        raise ConfigError(f"looks must be from 2 to the number of episodes ({config.episodes}), got {looks}")
    config.film.require_scenes(config.indices)
    plan = SequentialPlan.even(config.episodes, looks)
    seen = []
    for number, scenes in enumerate(plan.looks, start=1):
        planned = f"Planned: at most {plan.looks[-1]} scenes, looks after {', '.join(map(str, plan.looks))}."
        note = f"{planned} This is look {number}."
        step = replace(config, episodes=scenes, stopped=note, undecided=True, page=False)
        evaluation = evaluate(step, on_event=on_event, cancellation=cancellation, executor=executor, servers=servers)
        first, second = evaluation.policies.values()
        seen.append(_pairs(first, second))
        state = sequential_test(plan, seen)
        if state.finished:
            sentence = _sentence(planned, first, second, state.decided, scenes)
            undecided = not state.decided
            film = replace(config.film, only=tuple(one for one in config.film.only if int(one) < scenes))
            whole = replace(step, stopped=sentence, undecided=undecided, page=config.page, film=film)  # the only page
            evaluation = evaluate(whole, on_event=ignore, cancellation=cancellation)
            return SequentialResult(evaluation=evaluation, decided=state.decided, sentence=sentence)
    raise AssertionError("the last look finishes the comparison")


def _pairs(first: PolicyResult, second: PolicyResult) -> Pairs:
    from roboxim_eval.statistics.paired import Pairs

    one, two = ({r.index: r.outcome == "success" for r in policy.results} for policy in (first, second))
    return Pairs.of((one[index], two[index]) for index in sorted(one) if index in two)


def _sentence(planned: str, first: PolicyResult, second: PolicyResult, decided: bool, scenes: int) -> str:
    if not decided:
        return f"{planned} The limits were not reached: cannot tell which is better."
    won = sum(r.outcome == "success" for r in first.results), sum(r.outcome == "success" for r in second.results)
    better, worse = (first.name, second.name) if won[0] > won[1] else (second.name, first.name)
    return (
        f"{planned} Stopped after {scenes}: {better} is better than {worse} "
        "(group-sequential exact test, error probability 5 % over all looks). Intervals below do not account for the "
        "looks; they are slightly too narrow."
    )
