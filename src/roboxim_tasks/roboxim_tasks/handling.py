"""How the robot handled an object: dropped or set down, carried or pushed, let go or still held.

The measures are folds over state records like those of `roboxim_tasks.measures`, so they judge live and from a bag.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator

import numpy as np

from roboxim_core.poses import Array, Pose
from roboxim_core.state import Contact, StateRecord
from roboxim_tasks.measures import Condition, Measure, joint_value, released, seconds_between, with_last
from roboxim_tasks.motion import ROBOT

GRAVITY_M_S2 = 9.81
DROP_M = 0.05
"""Largest free fall with which an object counts as set down and not as dropped [m].

An object that falls by 5 cm arrives at 1 m/s. That is twice the largest speed of the hand under the default action
limits (0.05 m per tick at 10 Hz), so an object that is lowered in the hand never reaches it. 5 cm is also the size of
the smaller objects: releasing a cube a whole cube above the table is dropping it.
"""
TOSS_M_S = 0.3
"""Largest horizontal speed of an object that was set down, once the robot has let go of it [m/s].

What is set down leaves the hand at rest, and rolls slowly at most. The hand moves by up to 0.5 m/s."""
HAND_AWAY_M = 0.05
"""Distance of the hand from its last contact with an object beyond which it no longer cages the object [m].

The widest object that the gripper takes is 8 cm wide, so the fingers reach at most 4 cm past its edge; they end 1 cm
beyond the tool centre point.
"""
SQUEEZE_N = 2.0
"""Smallest force of two links from opposite sides with which an object counts as gripped [N].

It is a tenth of the gripper's force. Fingers that push side by side press in one direction, so they do not grip."""
OPPOSITE = -0.5
"""Largest cosine between two forces that oppose each other: they are more than 120 degrees apart."""
CARRIED_M = 0.01
"""Largest way of a pushed object while it is gripped or off its support [m]; not 0, because contacts chatter."""
FAR_M = 1.0
"""Reported distance of a hand that has never touched the object [m]."""


def set_down(entity: str, most_m: float = DROP_M) -> Condition:
    """Return the condition that an object was set down at its present place, and not dropped there.

    Args:
        entity: The object.
        most_m: Largest free fall [m].
    """
    return Condition(name="set_down", measure=drop(entity), most=most_m, reason="dropped")


def not_tossed(entity: str, *, may_bounce: bool = False) -> Condition:
    """Return the condition that an object was not thrown to its present place.

    Args:
        entity: The object.
        may_bounce: Whether it may hit walls that make it fast: then only its flight up to there counts.
    """
    return Condition(
        name="not_tossed", measure=toss(entity, may_bounce=may_bounce), most=TOSS_M_S, reason="tossed"
    )  # fmt: skip


def let_go(entity: str) -> tuple[Condition, ...]:
    """Return the conditions that the robot does not touch an object, and that the hand has left it."""
    away = Condition(name="hand_away", measure=hand_away(entity), least=HAND_AWAY_M, reason="still_held")
    return released(entity), away


def not_carried(entity: str, initial: StateRecord) -> Condition:
    """Return the fatal condition that an object never moved while it was gripped or off its support."""
    return Condition(
        name="not_carried", measure=carried_way(entity, initial), most=CARRIED_M, reason="carried", fatal=True
    )


def drop(entity: str) -> Measure:
    """Measure the free fall that gives the largest downward speed of an object since it was last held [m].

    An object is held while the robot touches it and nothing else does. Picking up a dropped object resets the measure.
    """
    fastest = [0.0]

    def of(state: StateRecord) -> float:
        if state.seq == 0 or held_in_the_air(state, entity):
            fastest[0] = 0.0
        else:
            fastest[0] = max(fastest[0], state.entity(entity).fastest_fall)
        return fastest[0] ** 2 / (2 * GRAVITY_M_S2)

    return Measure(name="drop_m", of=of)


def toss(entity: str, *, may_bounce: bool = False) -> Measure:
    """Measure the largest horizontal speed of an object in a tick that ends without the robot at it [m/s].

    It is the highest of the mean speed over the tick, the speed at its end, and the speed with which the robot let go:
    a short flight begins and ends within a tick. It counts from when the object was last held: picking up a tossed
    object resets the measure. With ``may_bounce`` it counts up to the first tick in which something else touches the
    object.
    """
    fastest, handled, landed = [0.0], [False], [False]

    def of(state: StateRecord, before: StateRecord | None) -> float:
        touched = _touched(state, entity)
        if before is None or held_in_the_air(state, entity):
            fastest[0], landed[0] = 0.0, False
        elif handled[0] and not touched and not (may_bounce and landed[0]):
            here, there = state.entity(entity).pose.position, before.entity(entity).pose.position
            mean = float(np.hypot(*np.subtract(here, there)[:2])) / seconds_between(before, state)
            ends = (before, state) if _touched(before, entity) else (state,)
            fastest[0] = max(fastest[0], mean, *(math.hypot(*s.entity(entity).linear_velocity[:2]) for s in ends))
        if handled[0] and not held_in_the_air(state, entity):
            landed[0] = landed[0] or any(contact.force_max > 0.0 for contact, _ in _others(state, entity))
        handled[0] = handled[0] or touched
        return fastest[0]

    return Measure(name="toss_m_s", of=with_last(of))


def hand_away(entity: str) -> Measure:
    """Measure the distance of the tool centre point from its position at the robot's last contact with an object [m].

    Positions are in the object's frame. An open gripper that has released the object but not moved is 0 away.
    """
    last: list[Array | None] = [None]

    def of(state: StateRecord) -> float:
        tool = _tool_in(state, entity)
        if any(contact.force_max > 0.0 for contact in state.contacts_between(ROBOT, entity)):
            last[0] = tool
        return FAR_M if last[0] is None else min(FAR_M, float(np.linalg.norm(tool - last[0])))

    return Measure(name="hand_away_m", of=of)


def carried_way(entity: str, initial: StateRecord) -> Measure:
    """Measure the horizontal way of an object over the ticks in which it was gripped or touched only the robot [m]."""
    before = [np.array(initial.entity(entity).pose.position[:2])]
    total = [0.0]

    def of(state: StateRecord) -> float:
        here = np.array(state.entity(entity).pose.position[:2])
        unsupported = not any(contact.force_max > 0.0 for contact, _ in _others(state, entity))
        if state.seq > 0 and (unsupported or squeeze_n(state, entity) >= SQUEEZE_N):
            total[0] += float(np.linalg.norm(here - before[0]))
        before[0] = here
        return total[0]

    return Measure(name="carried_m", of=of)


def squeeze_n(state: StateRecord, entity: str) -> float:
    """Return the largest force with which two links of the robot press an object from opposite sides [N]."""
    forces = []
    for contact in state.contacts_between(ROBOT, entity):
        force = np.array(contact.force_on_b) * (1.0 if contact.body_b == entity else -1.0)
        size = float(np.linalg.norm(force))
        if size > 0.0:
            forces.append((size, force / size))
    pairs = itertools.combinations(forces, 2)
    return max((min(a, b) for (a, along), (b, other) in pairs if float(along @ other) < OPPOSITE), default=0.0)


def held_in_the_air(state: StateRecord, entity: str) -> bool:
    """Return whether the robot touches an object at the end of a tick and nothing else does."""
    return _touched(state, entity) and not any(contact.force_last > 0.0 for contact, _ in _others(state, entity))


def _touched(state: StateRecord, entity: str) -> bool:
    """Return whether the robot touches an object at the end of a tick."""
    return any(contact.force_last > 0.0 for contact in state.contacts_between(ROBOT, entity))


def touching_links(state: StateRecord, entity: str) -> set[str]:
    """Return the robot's links that touched an object in a tick."""
    return {
        contact.link_a if contact.body_a == ROBOT else contact.link_b
        for contact in state.contacts_between(ROBOT, entity)
        if contact.force_max > 0.0
    }


def way_by_fingers(
    entity: str, joint: str, fingers: Iterable[str], initial: StateRecord, direction: float = 0.0
) -> Measure:
    """Measure a joint's way since tick 0, less its ways while anything but fingers of the robot touched the object.

    Args:
        entity: The object.
        joint: Its joint.
        fingers: Names of the robot's finger links.
        initial: State of tick 0.
        direction: Direction in which the way counts, 1 or -1; 0: both.
    """
    allowed = set(fingers)
    start = joint_value(initial, entity, joint, "joint_positions")
    seen = [start, 0.0]

    def way(state: StateRecord) -> float:
        now = joint_value(state, entity, joint, "joint_positions")
        if not touching_links(state, entity) <= allowed:
            seen[1] += abs(now - seen[0])
        seen[0] = now
        return ((now - start) * direction if direction else abs(now - start)) - seen[1]

    return Measure(name="way_by_fingers", of=way)


def _others(state: StateRecord, entity: str) -> Iterator[tuple[Contact, str]]:
    """Yield an object's contacts with anything but the robot and itself, each with the other body's name."""
    for contact in state.contacts:
        bodies = {contact.body_a, contact.body_b}
        if entity in bodies and ROBOT not in bodies and len(bodies) == 2:
            yield contact, next(iter(bodies - {entity}))


def _tool_in(state: StateRecord, entity: str) -> Array:
    """Return the measured tool centre point in an object's frame, shape (3,) [m]."""
    pose: Pose = state.entity(entity).pose.inverse()
    return np.asarray(pose.apply(state.robot.pose_tcp_measured.position))
