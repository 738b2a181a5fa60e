"""Predicates over state records, the parts of evaluators.

- A `Measure` computes a number per tick and has a name with a unit.
- A `Condition` bounds a measure and has the reason to report while it does not hold.
- `Conditions` is the evaluator of several conditions. It reports every measure and every condition at every tick.

All of them read only state records, so the same code judges live and from a bag.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np

from roboxim_core.episode.start import SPEED_M_S, SPIN_RAD_S
from roboxim_core.poses import Array, distance
from roboxim_core.state import StateRecord
from roboxim_tasks.motion import FLOOR, ROBOT, TABLE

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

FALLEN_M = 0.1
"""Drop in height since tick 0 beyond which an object has fallen off the table [m]."""
TOPPLED_DEG = 30.0
"""Angle from which an object has toppled, or leans on something [degrees]."""
TOPPLED_M = 0.005
"""Change of an object's height from which it may have toppled; what only rolls keeps its height [m]."""
PROP_N = 0.02
"""Largest force of a neighbour on an object that stands by itself [N]; not 0, because contacts chatter."""
OPENED = 0.02
"""Largest motion of a joint of an object that the task does not name, as of drawers [m or rad]."""


@dataclass(frozen=True, kw_only=True)
class Assessment:
    """Result of an evaluator at one tick; `roboxim_tasks.judging.Judge` turns it into a verdict."""

    solved: bool
    """Whether all conditions of the skill hold at this tick."""
    failed: bool = False
    """Whether the task can no longer be solved."""
    reason: str = ""
    """Reason why the task is not solved or has failed, in snake case; empty when solved."""
    predicates: dict[str, float] = field(default_factory=dict)
    """Predicate name to 0 or 1, and measure name with its unit to the value."""


class Evaluator(Protocol):
    """A fold over the state records of an episode's ticks."""

    hold_s: float
    """Time that the task must stay solved without a break to count as solved [s]."""

    def assess(self, state: StateRecord) -> Assessment:
        """Assess the next tick."""
        ...


@dataclass(frozen=True, kw_only=True)
class Measure:
    """A number per tick."""

    name: str
    """Name with the unit, e.g. ``lift_m``, under which the value is reported."""
    of: Callable[[StateRecord], float]
    """Return the value. Called exactly once per tick, in order, so it may accumulate."""


@dataclass(frozen=True, kw_only=True)
class Condition:
    """A measure within bounds."""

    name: str
    """Name of the condition, e.g. ``lifted``; reported as 0 or 1."""
    measure: Measure
    """What is bounded."""
    least: float = -math.inf
    """Smallest value at which the condition holds."""
    most: float = math.inf
    """Largest value at which the condition holds."""
    reason: str = ""
    """Reason to report while the condition does not hold; empty: ``not_<name>``."""
    fatal: bool = False
    """Whether the task can no longer be solved once the condition has not held."""

    def holds(self, value: float) -> bool:
        """Return whether a value of the measure is within the bounds."""
        return self.least <= value <= self.most


class Conditions:
    """An evaluator: solved while all conditions hold. The first one that does not hold gives the reason.

    Non-obvious: a measure that several conditions share is computed once per tick, so it may accumulate.
    """

    def __init__(self, conditions: Sequence[Condition], *, hold_s: float) -> None:
        """Compose conditions.

        Args:
            conditions: Conditions in the order of their precedence for the reason; fatal ones first.
            hold_s: Time that all must hold without a break to count as solved [s].
        """
        self.hold_s = hold_s
        self._conditions = tuple(conditions)

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """The conditions, in the order of their precedence."""
        return self._conditions

    def assess(self, state: StateRecord) -> Assessment:
        """Assess the next tick."""
        values: dict[int, float] = {}
        predicates: dict[str, float] = {}
        broken: list[Condition] = []
        for condition in self._conditions:
            measure = condition.measure
            if id(measure) not in values:
                values[id(measure)] = predicates[measure.name] = float(measure.of(state))
            holds = condition.holds(values[id(measure)])
            predicates[condition.name] = float(holds)
            if not holds:
                broken.append(condition)
        return Assessment(
            solved=not broken,
            failed=any(condition.fatal for condition in broken),
            reason=(broken[0].reason or f"not_{broken[0].name}") if broken else "",
            predicates=predicates,
        )


def above(value: float) -> float:
    """Return the next float above a value: the bound of a condition that demands more than the value."""
    return math.nextafter(value, math.inf)


# Conditions that many skills share


def fallen_off(height_gain: Measure, name: str = "not_fallen") -> Condition:
    """Return the fatal condition that an object has not fallen off the table, given its `lowest_lift`."""
    return Condition(
        name=name, measure=height_gain, least=-FALLEN_M,
        reason="fell_off_table", fatal=True,
    )  # fmt: skip


def at_rest(entity: str, *, speed_m_s: float = SPEED_M_S, spin_rad_s: float = SPIN_RAD_S) -> tuple[Condition, ...]:
    """Return the conditions that an object lies still."""
    return (
        Condition(name="at_rest", measure=speed(entity), most=speed_m_s),
        Condition(name="not_rolling", measure=spin(entity), most=spin_rad_s, reason="not_at_rest"),
    )


def released(entity: str) -> Condition:
    """Return the condition that the robot does not touch an object."""
    return Condition(name="released", measure=force(ROBOT, entity, "robot_force_n"), most=0.0)


def stands_alone(entity: str) -> Condition:
    """Return the condition that nothing but the table carries or props an object."""
    return Condition(
        name="stands_alone", measure=others_force(entity, "props_force_n", but=(TABLE, ROBOT)), most=PROP_N,
        reason="leans_on_something",
    )  # fmt: skip


def stayed(entity: str, initial: StateRecord, most_m: float, name: str = "") -> Condition:
    """Return the condition that an object has not been moved far from where it was at tick 0."""
    label = name or entity
    return Condition(
        name=f"{label}_stayed", measure=shift(entity, initial, f"{label}_shift_m"), most=most_m, reason=f"moved_{label}"
    )


# Measures


def lift(entity: str, initial: StateRecord, name: str = "lift_m") -> Measure:
    """Measure the height of an object above its height at tick 0 [m]."""
    start = initial.entity(entity).pose.position[2]
    return Measure(name=name, of=lambda state: state.entity(entity).pose.position[2] - start)


def highest_lift(entities: Iterable[str], initial: StateRecord, name: str = "other_lift_m") -> Measure:
    """Measure the largest height gain of several objects since tick 0 [m]; 0 if there are none."""
    starts = {entity: initial.entity(entity).pose.position[2] for entity in entities}
    return Measure(
        name=name,
        of=lambda state: max((state.entity(n).pose.position[2] - z for n, z in starts.items()), default=0.0),
    )


def lowest_lift(entities: Iterable[str], initial: StateRecord, name: str = "lift_m") -> Measure:
    """Measure the smallest height gain of several objects since tick 0 [m]; 0 if there are none.

    An object that did not stand on the table at tick 0, e.g. on a shelf or in the hand, may be taken down: its gain is
    at least -`FALLEN_M` until it touches the floor.
    """
    starts = {entity: (initial.entity(entity).pose.position[2], _is_up(initial, entity)) for entity in entities}

    def gain(state: StateRecord, entity: str) -> float:
        height, up = starts[entity]
        found = state.entity(entity).pose.position[2] - height
        return max(found, -FALLEN_M) if up and not state.contacts_between(entity, FLOOR) else found

    return Measure(name=name, of=lambda state: min((gain(state, entity) for entity in starts), default=0.0))


def _is_up(state: StateRecord, entity: str) -> bool:
    """Return whether an object touches something, and not the table."""
    touched = {body for c in state.contacts if entity in (c.body_a, c.body_b) for body in (c.body_a, c.body_b)}
    return bool(touched) and TABLE not in touched


def pressing_links(entity: str, force_n: float) -> Measure:
    """Count the robot's links that press an object with more than a force [N] at the end of the tick."""

    def count(state: StateRecord) -> float:
        return float(sum(value > force_n for value in robot_forces(state, entity).values()))

    return Measure(name="pressing_links", of=count)


def robot_forces(state: StateRecord, entity: str) -> dict[str, float]:
    """Return the normal force of each robot link on an object at the end of a tick [N]."""
    forces: dict[str, float] = {}
    for contact in state.contacts_between(ROBOT, entity):
        link = contact.link_a if contact.body_a == ROBOT else contact.link_b
        forces[link] = max(forces.get(link, 0.0), contact.force_last)
    return forces


def force(body_a: str, body_b: str, name: str) -> Measure:
    """Measure the normal force between two bodies at the end of the tick [N]."""
    return Measure(
        name=name, of=lambda state: max((c.force_last for c in state.contacts_between(body_a, body_b)), default=0.0)
    )


def table_force(entity: str) -> Measure:
    """Measure the normal force of the table on an object at the end of the tick [N]."""
    return force(TABLE, entity, "table_force_n")


def speed(entity: str) -> Measure:
    """Measure the mean speed of an object over the last tick [m/s]; at the first tick, its momentary speed."""

    def of(state: StateRecord, before: StateRecord | None) -> float:
        now = state.entity(entity)
        if before is None:
            return math.hypot(*now.linear_velocity)
        return math.dist(now.pose.position, before.entity(entity).pose.position) / seconds_between(before, state)

    return Measure(name="speed_m_s", of=with_last(of))


def spin(entity: str) -> Measure:
    """Measure the mean angular speed of an object over the last tick [rad/s]; at the first tick, its momentary one.

    The mean is used because contacts of a light object on a thin edge chatter within a tick without turning it.
    """

    def of(state: StateRecord, before: StateRecord | None) -> float:
        now = state.entity(entity)
        if before is None:
            return math.hypot(*now.angular_velocity)
        return distance(now.pose, before.entity(entity).pose)[1] / seconds_between(before, state)

    return Measure(name="spin_rad_s", of=with_last(of))


def with_last(of: Callable[[StateRecord, StateRecord | None], float]) -> Callable[[StateRecord], float]:
    """Turn a function of a state and its predecessor into a measure's function; the first predecessor is none."""
    last: list[StateRecord | None] = [None]

    def measured(state: StateRecord) -> float:
        before, last[0] = last[0], state
        return of(state, before)

    return measured


def seconds_between(before: StateRecord, after: StateRecord) -> float:
    """Return the time from one state to the next [s], never zero."""
    return max((after.stamp_ns - before.stamp_ns) / 1e9, 1e-9)


def shift(entity: str, initial: StateRecord, name: str = "shift_m") -> Measure:
    """Measure the distance of an object from its position at tick 0 [m]."""
    start = np.array(initial.entity(entity).pose.position)
    return Measure(
        name=name, of=lambda state: float(np.linalg.norm(np.subtract(state.entity(entity).pose.position, start)))
    )


def largest_shift(entities: Iterable[str], initial: StateRecord, name: str = "largest_shift_m") -> Measure:
    """Measure the largest distance of several objects from their positions at tick 0 [m]; 0 if there are none."""
    shifts = [shift(entity, initial) for entity in entities]
    return Measure(name=name, of=lambda state: max((each.of(state) for each in shifts), default=0.0))


def offset(state: StateRecord, entity: str, reference: str) -> Array:
    """Return the vector from a reference to an object in the world, shape (3,) [m]."""
    return np.subtract(state.entity(entity).pose.position, state.entity(reference).pose.position)


def toppled(entities: Iterable[str], initial: StateRecord, name: str = "toppled_deg") -> Measure:
    """Measure how far the most toppled of several objects has tipped over since tick 0 [degrees]; 0 if none has.

    It is the angle between the vertical and the axis that was vertical at tick 0. An object whose origin is as high as
    at tick 0 does not count: a ball or a lying bottle rolls, a cube tips onto another side, and neither topples.
    """
    starts = {entity: initial.entity(entity).pose for entity in entities}
    axes = {entity: pose.rotation.inv().apply((0.0, 0.0, 1.0)) for entity, pose in starts.items()}

    def of(state: StateRecord) -> float:
        worst = 0.0
        for entity, start in starts.items():
            now = state.entity(entity).pose
            if abs(now.position[2] - start.position[2]) > TOPPLED_M:
                up = float(now.rotation.apply(axes[entity])[2])
                worst = max(worst, math.degrees(math.acos(min(1.0, max(-1.0, up)))))
        return worst

    return Measure(name=name, of=of)


def others_force(entity: str, name: str, but: Iterable[str] = (ROBOT,)) -> Measure:
    """Measure the largest normal force of any other body on an object at the end of the tick [N].

    Args:
        entity: The object.
        name: Name of the measure.
        but: Bodies that do not count.
    """
    left_out = {entity, *but}

    def of(state: StateRecord) -> float:
        found = 0.0
        for contact in state.contacts:
            others = {contact.body_a, contact.body_b} - {entity}
            if len(others) == 1 and entity in (contact.body_a, contact.body_b) and not others & left_out:
                found = max(found, contact.force_last)
        return found

    return Measure(name=name, of=of)


def joints_moved(
    entities: Iterable[str], initial: StateRecord, name: str, but: Iterable[tuple[str, str]] = ()
) -> Measure:
    """Measure the largest distance of a joint of several objects from its position at tick 0 [m or rad].

    Args:
        entities: The objects.
        initial: State of tick 0.
        name: Name of the measure.
        but: Objects with the joints that do not count.
    """
    starts = {entity: initial.entity(entity) for entity in entities}
    left_out = set(but)

    def of(state: StateRecord) -> float:
        return max(
            (
                abs(now - before)
                for entity, start in starts.items()
                for joint, now, before in zip(
                    start.joint_names, state.entity(entity).joint_positions, start.joint_positions, strict=True
                )
                if (entity, joint) not in left_out
            ),
            default=0.0,
        )

    return Measure(name=name, of=of)


def tilt(entity: str, axis: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Measure:
    """Measure the angle between an axis of an object and the vertical [rad]."""

    def angle(state: StateRecord) -> float:
        up = state.entity(entity).pose.rotation.apply(axis)[2] / math.hypot(*axis)
        return math.acos(min(1.0, max(-1.0, float(up))))

    return Measure(name="tilt_rad", of=angle)


def turned(entity: str, initial: StateRecord) -> Measure:
    """Measure the rotation of an object about the vertical since tick 0, accumulated and therefore without jumps [rad].

    Positive is counter-clockwise from above. Each tick adds the rotation's component about the vertical.
    """
    last: list[Rotation] = [initial.entity(entity).pose.rotation]
    total = [0.0]

    def angle(state: StateRecord) -> float:
        rotation = state.entity(entity).pose.rotation
        total[0] += float((rotation * last[0].inv()).as_rotvec()[2])
        last[0] = rotation
        return total[0]

    return Measure(name="turned_rad", of=angle)


def joint_position(entity: str, joint: str, name: str = "joint_position") -> Measure:
    """Measure the position of an object's joint [m or rad]."""
    return Measure(name=name, of=lambda state: joint_value(state, entity, joint, "joint_positions"))


def joint_highest_ever(entity: str, joint: str, name: str = "joint_highest") -> Measure:
    """Measure the highest position of a joint in any physics step so far [m or rad]."""
    best = [-math.inf]

    def value(state: StateRecord) -> float:
        best[0] = max(best[0], joint_value(state, entity, joint, "joint_highest"))
        return best[0]

    return Measure(name=name, of=value)


def joint_value(state: StateRecord, entity: str, joint: str, field: str) -> float:
    """Return an object's joint value from ``joint_positions``, ``joint_lowest`` or ``joint_highest`` [m or rad]."""
    found = state.entity(entity)
    return float(getattr(found, field)[found.joint_names.index(joint)])
