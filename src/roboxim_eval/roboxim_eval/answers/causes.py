"""Causes of a failed episode, found by running the same episode with one change.

An association over many episodes ("fails more often with distractors") may have other reasons. Here one episode is run
again with one change, several times: a change is a *single cause* if the episode fails without it and succeeds with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Kind = Literal["chance", "single", "several", "together", "none"]
ALPHA = 0.05
"""Probability of calling a change a cause if it has no effect, over all changes that were tried (Holm)."""


@dataclass(frozen=True, kw_only=True)
class Tally:
    """Outcomes of an episode with a change."""

    name: str
    """Name of the change, e.g. ``distractors``; for two changes, both names joined by ``+``; empty: no change."""
    words: str
    """The change in words, e.g. ``without the 2 distractors``."""
    successes: int
    """Runs that succeeded."""
    runs: int
    """Runs."""

    @property
    def sentence(self) -> str:
        """E.g. ``without the 2 distractors it succeeds 5 of 5``."""
        return f"{self.words} it succeeds {self.successes} of {self.runs}"


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """Findings about a failure."""

    kind: Kind
    """``chance``: it succeeds without a change. ``single``: one change is a cause. ``several``: each of several changes
    alone is one. ``together``: no single change is one, but a pair is. ``none``: no tried change is one."""
    causes: tuple[Tally, ...]
    """The changes with which it succeeds, the clearest first."""
    as_it_was: Tally
    """The episode without a change."""
    tried: tuple[Tally, ...]
    """Each change alone, then pairs."""
    doubts: tuple[str, ...] = ()
    """Why the runs may not be of the recorded failure, e.g. since another policy was given; a sentence each."""

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        as_was = f"as it was it succeeds {self.as_it_was.successes} of {self.as_it_was.runs}"
        if self.kind == "chance":
            return f"No cause is needed: {as_was}."
        if self.kind == "none" and not self.tried:
            return f"No cause was looked for: {as_was}, too often to show a cause in so few runs; try more repeats."
        if self.kind == "none":
            return f"No single cause: {as_was}, and no change that was tried makes it succeed reliably."
        named = "; ".join(cause.sentence for cause in self.causes)
        start = {"single": "", "several": "Each of these changes alone: ", "together": "No single cause, but two: "}
        text = f"{start[self.kind]}{named}; {as_was}."
        return text[0].upper() + text[1:]


def p_of_change(changed: Tally, as_it_was: Tally) -> float:
    """Return the one-sided p value of Fisher's exact test that a change has no effect or a bad one."""
    from scipy.stats import fisher_exact

    if not changed.runs or not as_it_was.runs:
        return 1.0
    table = [
        [changed.successes, changed.runs - changed.successes],
        [as_it_was.successes, as_it_was.runs - as_it_was.successes],
    ]
    return float(fisher_exact(table, alternative="greater").pvalue)


def may_become_cause(so_far: Tally, runs: int, as_it_was: Tally, left: int) -> bool:
    """Return whether a change can still be shown to be a cause if all remaining runs succeed.

    Args:
        so_far: Its runs so far.
        runs: Number of runs that it will have in all.
        as_it_was: The episode without a change.
        left: Number of changes that are no cause so far, this one included, see `not_yet_causes`.
    """
    best = Tally(name="", words="", successes=so_far.successes + runs - so_far.runs, runs=runs)
    return p_of_change(best, as_it_was) <= ALPHA / max(1, left)


def not_yet_causes(group: Sequence[Tally], as_it_was: Tally) -> int:
    """Return how many changes of a group are no cause so far: each cause lowers the number that Holm's test counts."""
    return len(group) - len(_causes(group, as_it_was))


def explanation(
    as_it_was: Tally, singles: Sequence[Tally], pairs: Sequence[Tally] = (), *, doubts: tuple[str, ...] = ()
) -> Explanation:
    """Return the conclusion from the runs of an episode.

    Args:
        as_it_was: The episode without a change.
        singles: Each change alone.
        pairs: A pair of changes, tried if no single change is a cause.
        doubts: Why the runs may not be of the recorded failure.
    """
    tried = (*singles, *pairs)
    if 2 * as_it_was.successes > as_it_was.runs:
        return Explanation(kind="chance", causes=(), as_it_was=as_it_was, tried=tried, doubts=doubts)
    for kind_of_one, kind_of_many, group in (("single", "several", singles), ("together", "together", pairs)):
        causes = _causes(group, as_it_was)
        if causes:
            kind: Kind = kind_of_one if len(causes) == 1 else kind_of_many  # type: ignore[assignment]
            return Explanation(kind=kind, causes=causes, as_it_was=as_it_was, tried=tried, doubts=doubts)
    return Explanation(kind="none", causes=(), as_it_was=as_it_was, tried=tried, doubts=doubts)


def _causes(group: Sequence[Tally], as_it_was: Tally) -> tuple[Tally, ...]:
    from roboxim_eval.statistics.multiple import holm

    adjusted = holm([p_of_change(one, as_it_was) for one in group]) if group else []
    found = [(p, one) for p, one in zip(adjusted, group, strict=True) if p <= ALPHA]
    return tuple(one for _, one in sorted(found, key=lambda item: item[0]))
