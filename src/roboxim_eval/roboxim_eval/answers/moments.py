"""The moment that decides between two policies, in words, and a summary over scenes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from roboxim_core.errors import counted
from roboxim_core.state import StateRecord

CLOSED = 0.5
"""Commanded opening of a gripper below which it is closing, 0..1."""
LIFTED_M = 0.01
"""Height above its first one from which an object is lifted [m]."""
NEAR_TICKS = 4
"""Largest distance of a tick from an event that names it."""
Outcome = tuple[bool, bool]


@dataclass(frozen=True, kw_only=True)
class SceneComparison:
    """Two policies in one scene."""

    scene: int
    """Number of the scene."""
    outcome: Outcome
    """Whether the first and the second policy succeed."""
    diverge_at: int | None
    """First tick whose states differ; none: no tick differs."""
    decides_at: int | None = None
    """First tick from which the loser succeeds if the winner has acted until then; none: both end alike, or the loser
    succeeds from no tick."""
    rescued_until: int | None = None
    """Last tick from which the winner succeeds if the loser has acted until then; none: it never does."""
    phase: str = ""
    """What happens at the deciding tick in the winner's episode, e.g. ``the grasp``."""
    ticks: int = 0
    """Ticks of the winner's episode."""


def first_success(succeeds: Callable[[int], bool], low: int, high: int) -> int:
    """Return the first tick from which a policy succeeds, by bisection.

    Args:
        succeeds: Whether it succeeds from a tick; assumed to change once, from not to yes.
        low: A tick from which it does not.
        high: A tick from which it does.
    """
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if succeeds(middle) else (middle, high)
    return high


def events_of(states: Sequence[StateRecord]) -> dict[str, int]:
    """Return the first occurrence of each event of an episode: name of the event to its tick."""
    found: dict[str, int] = {}
    first = {entity.name: entity.pose.position[2] for entity in states[0].entities}
    for before, state in zip(states, states[1:], strict=False):
        touched = any("robot" in (c.body_a, c.body_b) and "table" not in (c.body_a, c.body_b) for c in state.contacts)
        if touched and any(c.body_a in first or c.body_b in first for c in state.contacts):
            found.setdefault("the first touch", state.seq)
        was_open, is_open = before.robot.gripper_command >= CLOSED, state.robot.gripper_command >= CLOSED
        if was_open and not is_open:
            found.setdefault("the grasp", state.seq)
        if "the grasp" in found and is_open and not was_open:
            found.setdefault("the release", state.seq)
        if any(entity.pose.position[2] - first[entity.name] > LIFTED_M for entity in state.entities):
            found.setdefault("the lift", state.seq)
    return found


def phase_at(states: Sequence[StateRecord], tick: int) -> str:
    """Return a description of a tick: the nearest event, or the phase between two events."""
    events = sorted(events_of(states).items(), key=lambda item: item[1])
    if not events:
        return "the approach"
    name, at = min(events, key=lambda item: abs(item[1] - tick))
    if abs(at - tick) <= NEAR_TICKS:
        return name
    before = [name for name, at in events if at < tick]
    return f"after {before[-1]}" if before else "the approach"


def summary(names: tuple[str, str], found: Sequence[SceneComparison]) -> tuple[str, ...]:
    """Return a summary of many scenes, in sentences.

    Args:
        names: Both policies.
        found: The scenes.
    """
    count = Counter(one.outcome for one in found)
    first, second = names
    sentences = [
        f"{counted(len(found), 'scene')}: both succeed in {count[True, True]}, {first} alone in {count[True, False]}, "
        f"{second} alone in {count[False, True]}, neither in {count[False, False]}."
    ]
    for winner, loser, outcome in ((first, second, (True, False)), (second, first, (False, True))):
        matching = [one for one in found if one.outcome == outcome]
        decided = [one for one in matching if one.decides_at is not None]
        if matching:
            phases = Counter(one.phase for one in decided).most_common()
            parts = [f"{name} in {many}" for name, many in phases]
            if len(decided) < len(matching):
                never = len(matching) - len(decided)
                parts.append(f"no moment in {never}, where {loser} fails even if it acts in the last tick alone")
            sentences.append(
                f"Of the scenes where {winner} succeeds and {loser} fails ({len(matching)}), what decides is: "
                f"{'; '.join(parts)}."
            )
    return tuple(sentences)
