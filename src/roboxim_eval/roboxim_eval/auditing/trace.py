"""Observations of an environment: episodes as digests, rewards and verdicts, independent of the environment."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np


def digest(value: Any) -> str:
    """Return a digest of an observation: arrays by type, shape and bytes, mappings by sorted keys."""
    found = hashlib.sha256()
    _feed(found, value)
    return found.hexdigest()[:16]


def _feed(found: Any, value: Any) -> None:
    if isinstance(value, Mapping):
        for key in sorted(value, key=str):
            found.update(f"{key}:".encode())
            _feed(found, value[key])
    elif isinstance(value, (list, tuple)):
        for item in value:
            _feed(found, item)
    elif isinstance(value, (np.ndarray, np.generic)):
        found.update(f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    else:
        found.update(repr(value).encode())


@dataclass(frozen=True, kw_only=True)
class Trace:
    """An episode, or its beginning."""

    observations: tuple[str, ...]
    """Digests of the observations, that of the reset first."""
    rewards: tuple[float, ...] = ()
    """Reward of each step."""
    successes: tuple[bool | None, ...] = ()
    """Success in the info of each step; none: the info does not state it."""
    start_success: bool | None = None
    """Success in the info of the reset."""
    terminated: bool = False
    """Whether the last step ended the episode."""
    truncated: bool = False
    """Whether the last step truncated the episode."""
    instruction: str | None = None
    """Instruction of the episode; none: the environment has none."""
    final: tuple[float, ...] = ()
    """Floating-point numbers of the last observation, for comparisons with a tolerance."""
    faults: tuple[str, ...] = ()
    """Faults of single values, in words, e.g. an observation outside of its space."""
    refused: str = ""
    """The error by which the environment refused an action; empty: none."""

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.rewards)

    @property
    def ended(self) -> bool:
        """Whether the episode is over."""
        return self.terminated or self.truncated

    @property
    def success(self) -> bool | None:
        """Success at the last step that states it; none: no step does."""
        known = [one for one in self.successes if one is not None]
        return known[-1] if known else None

    def first_difference(self, other: Trace) -> str:
        """Return the first difference of two traces of the same actions, in words; empty: none. NaN equals NaN."""
        if self.instruction != other.instruction:
            return f"the instruction: {self.instruction!r} and {other.instruction!r}"
        pairs = zip(self.observations, other.observations, strict=False)
        for step, (one, two) in enumerate(pairs):
            if one != two:
                return f"the observation of {f'step {step}' if step else 'the reset'}"
        if len(self.observations) != len(other.observations) or self.steps != other.steps:
            return "the number of steps"
        if not np.array_equal(self.rewards, other.rewards, equal_nan=True):
            return "rewards"
        named = ("successes", "start_success", "terminated", "truncated")
        return next((name for name in named if getattr(self, name) != getattr(other, name)), "")


@dataclass(frozen=True, kw_only=True)
class Probes:
    """All probes of an environment; probes with the same seed have the same actions unless stated otherwise."""

    first: Trace
    """A seed in a new environment, with random actions."""
    again: Trace
    """The same once more, directly afterwards."""
    other_instance: Trace
    """The same in another environment of the process."""
    after_others: Trace
    """The same after resets to other seeds."""
    after_episode: Trace
    """The same after an episode of other actions with another seed."""
    other_global_seed: Trace
    """The same after the global generators of `random` and NumPy were seeded otherwise."""
    touches_global_random: bool
    """Whether a reset and a step changed the state of these generators."""
    still: Trace
    """The same seed, without motion."""
    seeds: Mapping[int, Trace]
    """Seed to the reset."""
    unseeded: tuple[tuple[str, ...], tuple[str, ...]]
    """Digests of resets without a seed, after the same seeded one, twice."""
    beyond: Trace
    """The seed with actions of which one component is at twice its bounds; without steps: there are no such actions."""
    clipped: Trace
    """The same actions, clipped to the bounds."""
    not_a_number: Trace | None
    """A step with NaN; none: actions are whole numbers."""
    noop: Sequence[Trace]
    """Whole episodes without motion."""
    random: Sequence[Trace]
    """Whole episodes of random actions."""
    limit: int
    """Number of steps after which the auditor ended an episode."""
    unclosed: Sequence[str] = ()
    """Errors of the environments' ``close`` after all probes."""
    solved: Sequence[Trace] = ()
    """Whole episodes of a solver; empty: none was given."""
    wordless: Sequence[Trace] = ()
    """The same with an empty instruction."""
    replayed: Trace | None = None
    """The actions of a solved episode with its seed; none: no episode was solved."""
    replayed_elsewhere: Sequence[Trace] = ()
    """These actions with other seeds."""
    solved_trace: Trace | None = None
    """The episode that was replayed."""
    notes: tuple[str, ...] = field(default=())
    """Other observations of the auditor, e.g. that a step changed the caller's action."""
