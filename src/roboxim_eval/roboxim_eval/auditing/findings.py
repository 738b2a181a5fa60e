"""Finds faults in probes of an environment that make a benchmark's success rates wrong or not repeatable."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from roboxim_eval.auditing.trace import Probes, Trace
from roboxim_eval.statistics.rates import success_rate

TOO_EASY = 0.05
"""Lower bound of a success rate without skill above which it is a fault."""
Statements = Iterator[str]
"""Sentences of a check; none: it passed. A sentence that begins with ``?`` says why the check was impossible."""
Check = Callable[[Probes], Statements]


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A fault."""

    check: str
    """Name of the check."""
    sentence: str
    """Observation, in words."""


@dataclass(frozen=True, kw_only=True)
class Audit:
    """The result of all checks."""

    findings: tuple[Finding, ...]
    """The faults."""
    passed: tuple[str, ...]
    """Names of the checks that passed."""
    untested: dict[str, str]
    """Names of the checks that could not be made, with the reason."""
    rates: dict[str, str]
    """Success rate of each way to act, with its interval."""


def audit_findings(probes: Probes) -> Audit:
    """Judge the probes of an environment."""
    findings, passed, untested = [], [], {}
    for name, check in CHECKS.items():
        count = list(check(probes))
        if count and count[0].startswith("?"):
            untested[name] = count[0][1:].strip()
        elif count:
            findings += [Finding(check=name, sentence=sentence) for sentence in dict.fromkeys(count)]
        else:
            passed.append(name)
    ways = {
        "no motion": probes.noop, "random actions": probes.random, "solver": probes.solved,
        "solver without words": probes.wordless, "replayed actions with other seeds": probes.replayed_elsewhere,
    }  # fmt: skip
    rates = {way: _rate(traces) for way, traces in ways.items() if traces and _verdicts(traces)}
    return Audit(findings=tuple(findings), passed=tuple(passed), untested=untested, rates=rates)


def _verdicts(traces: Sequence[Trace]) -> list[bool]:
    return [trace.success for trace in traces if trace.success is not None]


def _rate(traces: Sequence[Trace]) -> str:
    verdicts = _verdicts(traces)
    return str(success_rate(sum(verdicts), len(verdicts)))


def _whole(probes: Probes) -> list[Trace]:
    return [*probes.noop, *probes.random, *probes.solved]


# ------------------------------------------------------------------ repeatable


def _same(one: Trace, two: Trace, what: str) -> Statements:
    if where := one.first_difference(two):
        yield f"{what} differs: {where}"


def _repeated(other: str, when: str) -> Check:
    """Return the check that the first probe's seed and actions give the same again in another probe, by its name."""
    return lambda p: _same(p.first, getattr(p, other), f"the same seed and actions {when}")


def _global_state(p: Probes) -> Statements:
    if p.touches_global_random:
        yield "a reset or a step changes the global generators of random or NumPy, on which other code may depend"


def _seeds_matter(p: Probes) -> Statements:
    distinct = len({(trace.observations[0], trace.instruction) for trace in p.seeds.values()})
    if distinct == 1:
        yield f"{len(p.seeds)} seeds give the same first observation and instruction"
    elif distinct < len(p.seeds):
        yield f"{len(p.seeds)} seeds give only {distinct} different first observations"


def _unseeded(p: Probes) -> Statements:
    one, two = p.unseeded
    if one != two:
        yield "resets without a seed, after the same seeded one, differ between two runs"
    elif len(set(one)) < len(one) and len({trace.observations[0] for trace in p.seeds.values()}) > 1:
        yield "resets without a seed repeat a scene"


# ------------------------------------------------------------------ observations and actions


def _values(p: Probes) -> Statements:
    for trace in (p.first, p.still, *p.seeds.values(), *_whole(p)):
        yield from trace.faults


def _notes(p: Probes) -> Statements:
    yield from p.notes


def _observes(p: Probes) -> Statements:
    if p.first.steps and len(set(p.first.observations)) == 1:
        yield f"{p.first.steps} random actions do not change the observation"
    elif p.first.steps and p.first.observations == p.still.observations:
        yield "random actions and no motion give the same observations: actions have no effect"


def _clips(p: Probes) -> Statements:
    if p.beyond.refused or p.beyond.steps and p.beyond.observations == p.clipped.observations:
        return
    if not p.beyond.steps:
        yield "? actions have no bounds, or their type cannot hold numbers beyond them"
    elif p.beyond.steps != p.clipped.steps:
        yield f"the episode has {p.beyond.steps} steps with actions at twice their bounds, {p.clipped.steps} at them"
    elif not p.beyond.final:
        yield "? observations have no floating-point numbers to compare with a tolerance, and they differ"
    elif not np.allclose(p.beyond.final, p.clipped.final, rtol=1e-3, atol=1e-3, equal_nan=True):
        yield "components of actions at twice their bounds have another effect than at their bounds, and no error"


def _nan(p: Probes) -> Statements:
    if p.not_a_number is None:
        yield "? actions are no array of floating-point numbers"
    elif not p.not_a_number.refused:
        yield "an action of NaN is accepted without an error"


# ------------------------------------------------------------------ success and reward


def _says_success(p: Probes) -> Statements:
    if not _verdicts(_whole(p)):
        yield "no step states whether the task succeeded (is_success or success in info)"


def _without_skill(traces: Sequence[Trace], how: str) -> Statements:
    verdicts = _verdicts(traces)
    if not verdicts:
        yield "? no episode states whether it succeeded"
    elif success_rate(sum(verdicts), len(verdicts)).low > TOO_EASY:
        yield f"{how} episodes succeed: {_rate(traces)}"


def _starts_unsolved(p: Probes) -> Statements:
    solved = sum(trace.start_success is True for trace in p.seeds.values())
    if all(trace.start_success is None for trace in p.seeds.values()):
        yield "? no reset states whether the task has succeeded"
    elif solved:
        yield f"{solved} of {len(p.seeds)} resets say that the task has succeeded"


def _reward(p: Probes) -> Statements:
    """Sparse rewards agree with the success step by step; of dense ones a success has the larger final one."""
    steps = [
        (reward, success)
        for trace in _whole(p)
        for reward, success in zip(trace.rewards, trace.successes, strict=True)
        if success is not None
    ]
    if not steps:
        yield "? no step states whether it succeeded"
        return
    if not all(math.isfinite(reward) for reward, _ in steps):
        yield "? not all rewards are finite"
        return
    levels = {reward for reward, _ in steps}
    good = [reward for reward, success in steps if success]
    bad = [reward for reward, success in steps if not success]
    if len(levels) <= 2 and good and bad:
        wrong = sum(reward == max(levels) for reward in bad) + sum(reward != max(levels) for reward in good)
        if wrong:
            yield f"reward and success disagree in {wrong} of {len(steps)} steps"
    elif len(levels) == 2 and not good:
        paid = sum(reward == max(levels) for reward in bad)
        yield f"{paid} of {len(steps)} steps have the larger one of two rewards, and none of them succeeds"
    elif good and bad and len(levels) > 2 and sum(good) / len(good) <= sum(bad) / len(bad):
        yield "the mean reward of successful steps is not above that of the others"
    elif not good:
        yield "? no step succeeded; give a solver"
    elif not bad:
        yield "? every step succeeded"


def _keeps_success(p: Probes) -> Statements:
    reached = [t for t in _whole(p) if any(t.successes)]
    lost = [t for t in reached if t.success is False]
    if not reached:
        yield "? no episode reports success; give a solver"
    elif lost:
        yield (
            f"{len(lost)} episodes report success at a step and none at their end; "
            "a rate depends on which of them an evaluation reads"
        )


def _ends(p: Probes) -> Statements:
    open_ones = sum(not trace.ended for trace in _whole(p))
    if open_ones:
        yield f"{open_ones} of {len(_whole(p))} episodes are not over after {p.limit} steps"


def _closes(p: Probes) -> Statements:
    for error in p.unclosed:
        yield f"close() failed after the last episode: {error}"


def _limit(p: Probes) -> Statements:
    """A time limit is a truncation: learners take a termination for a state without future reward."""
    failed = [t for t in _whole(p) if t.ended and t.success is False]
    longest = {t.steps for t in failed}
    if len(failed) < 3:
        yield f"? a limit shows in 3 episodes that end without success, got {len(failed)}; give more episodes"
    elif len(longest) == 1 and longest != {1} and all(t.terminated for t in failed):
        yield f"all failed episodes terminate after {longest.pop()} steps; a time limit is to be reported as truncated"


def _finite(p: Probes) -> Statements:
    if any(not math.isfinite(reward) for trace in (p.first, *_whole(p)) for reward in trace.rewards):
        yield "a reward is not finite"


# ------------------------------------------------------------------ words and replay


def _words(p: Probes) -> Statements:
    words = [trace.instruction for trace in p.seeds.values()]
    if all(word is None for word in words):
        yield "? the environment has no instruction"
    elif any(not (word or "").strip() for word in words):
        yield f"{sum(not (word or '').strip() for word in words)} of {len(words)} instructions are empty"


def _words_needed(p: Probes) -> Statements:
    if not p.wordless:
        yield "? needs an environment with an instruction, and a solver"
        return
    several = len({trace.instruction for trace in p.solved}) > 1
    with_words, without = sum(_verdicts(p.solved)), sum(_verdicts(p.wordless))
    if not several:
        yield "? all episodes have one instruction"
    elif not with_words:
        yield "? the solver never succeeded"
    elif with_words <= without:
        yield f"the solver succeeds as often without the instruction ({_rate(p.wordless)}): the scene reveals the task"


def _replay(p: Probes) -> Statements:
    if p.replayed is None or p.solved_trace is None:
        yield "? no episode succeeded; give a solver"
    else:
        yield from _same(p.solved_trace, p.replayed, "a successful episode, its actions replayed,")


def _scene_matters(p: Probes) -> Statements:
    verdicts = _verdicts(p.replayed_elsewhere)
    if not verdicts:
        yield "? no episode succeeded; give a solver"
    elif success_rate(sum(verdicts), len(verdicts)).low > 0.5:
        yield f"the actions of one episode solve other seeds without looking: {_rate(p.replayed_elsewhere)}"


CHECKS: dict[str, Check] = {
    "same_seed": _repeated("again", "a second time"),
    "instances": _repeated("other_instance", "in a second environment of the process"),
    "order": _repeated("after_others", "after resets to other seeds"),
    "reset_leak": _repeated("after_episode", "after an episode of another seed"),
    "global_random": _repeated("other_global_seed", "with other global random numbers"),
    "global_state": _global_state,
    "seeds_matter": _seeds_matter,
    "unseeded": _unseeded,
    "values": _values,
    "shared_memory": _notes,
    "observes_actions": _observes,
    "clipped_actions": _clips,
    "nan_actions": _nan,
    "says_success": _says_success,
    "no_motion": lambda p: _without_skill(p.noop, "without motion"),
    "random_actions": lambda p: _without_skill(p.random, "with random actions"),
    "starts_unsolved": _starts_unsolved,
    "reward": _reward,
    "finite_rewards": _finite,
    "keeps_success": _keeps_success,
    "ends": _ends,
    "time_limit": _limit,
    "closes": _closes,
    "instructions": _words,
    "words_needed": _words_needed,
    "replay": _replay,
    "scene_matters": _scene_matters,
}
"""Name of a check to the check, in the order of the report."""
