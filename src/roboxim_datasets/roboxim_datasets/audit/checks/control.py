"""How the arm moves: missed approaches, ticks without motion, saturated actions, actions that do not replay."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from roboxim_core.actions import ActionSemantics
from roboxim_datasets.audit.check import AUDIT_CHECKS, AuditCheck
from roboxim_datasets.audit.values import Approach, AuditEpisode, CannotCheckError, Finding, Flags
from roboxim_datasets.episode import Floats

NEAR_M = 0.05
RETREAT_M = 0.02
DETOUR = 3.0
SHORT_M = 0.1
IDLE = 1e-4
GRIPPER_STILL = 0.01
IDLE_SHARE = 0.2
IDLE_S = 1.0
SATURATED_SHARE = 0.05
CLOSE_TO_LIMIT = 0.99
REPLAY_M = 1e-3


@AUDIT_CHECKS.register("inaccurate_control")
class InaccurateControl(AuditCheck):
    """A miss and its correction (thesis 6.1.2, issue 2)."""

    title = "Inaccurate control: the hand misses and corrects"
    reason = "Near the object the arm moves towards it and away from it for the same instruction; a policy learns both."
    threshold = (
        "in a step of the task the gripper closes more than once; or the hand comes within "
        f"{100 * NEAR_M:g} cm of where it finally touches the object and retreats by more than {100 * RETREAT_M:g} cm; "
        f"or its path there is more than {DETOUR:g} times the shortest"
    )
    needs = "ground truth: the recorded contacts and poses"
    order = 2

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find corrections."""
        approaches = episode.require_truth().approaches
        if not approaches:
            raise CannotCheckError("the robot touches no object of the task")
        for approach in approaches:
            yield from self._look(episode, approach)

    def _look(self, episode: AuditEpisode, approach: Approach) -> Iterator[Finding]:
        distance = np.array(approach.distance_m)
        nearest = np.minimum.accumulate(distance)
        retreat = np.where(nearest < NEAR_M, distance - nearest, 0.0)
        worst = int(retreat.argmax())
        problems, ticks = [], [approach.begin, approach.begin + len(distance) - 1]
        if approach.recovered:
            problems.append("the actor reports another attempt")
        if approach.closings > 1:
            problems.append(f"the gripper closes {approach.closings} times")
        if retreat[worst] > RETREAT_M:
            problems.append(f"at tick {approach.begin + worst} the hand has retreated by {100 * retreat[worst]:.1f} cm")
            places = (int(distance[: worst + 1].argmin()), worst, len(distance) - 1)
            ticks = [approach.begin + place for place in places]
        if distance[0] > SHORT_M and approach.path_m > DETOUR * distance[0]:
            problems.append(f"its path is {approach.path_m / distance[0]:.1f} times the shortest")
        if problems:
            yield episode.finding(
                "; ".join(problems),
                ticks=tuple(sorted(set(ticks))),
                series={"distance to the final touch [cm]": tuple(100 * distance)},
            )


@AUDIT_CHECKS.register("idle")
class Idle(AuditCheck):
    """Ticks without a command to the arm or the gripper."""

    title = "Ticks without motion"
    reason = "A policy that has learned to stand still never moves again: its next observation is the same."
    threshold = (
        f"every component of the motion below {IDLE:g} and the gripper at rest, for more than {100 * IDLE_SHARE:.0f} % "
        f"of the ticks or more than {IDLE_S:g} s in a row"
    )
    order = 11

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find long rests."""
        idle = _idle(episode)
        start, length = longest_run(idle)
        rate = episode.rate_or(10.0)
        if idle.mean() > IDLE_SHARE or length / rate > IDLE_S:
            yield episode.finding(
                f"{idle.sum()} of {len(idle)} ticks ({100 * idle.mean():.0f} %) are without motion; the longest "
                f"rest is {length} ticks ({length / rate:.1f} s) from tick {start}",
                ticks=(start, start + length - 1) if length > 1 else (start,),
                series={"without motion": tuple(idle.astype(float))},
            )


def _idle(episode: AuditEpisode) -> Flags:
    """Return whether each action commands no motion."""
    actions, semantics = episode.actions, episode.episode.semantics
    motion = actions[:, :-1]
    if semantics is not None and not semantics.control.is_relative:
        motion = np.diff(motion, axis=0, append=motion[-1:])  # the last one cannot be compared; it counts as the others
        motion[-1] = motion[-2] if len(motion) > 1 else 0.0
    still: Flags = np.abs(motion).max(axis=1) < IDLE
    command = actions[:, -1]
    still &= np.abs(np.diff(command, prepend=command[:1])) < GRIPPER_STILL
    if "gripper_opening" in episode.proprio:
        opening = episode.proprio["gripper_opening"][:, 0]
        still &= np.abs(np.diff(opening, append=opening[-1:])) < GRIPPER_STILL
    return still


@AUDIT_CHECKS.register("saturation")
class Saturation(AuditCheck):
    """Actions at their limit."""

    title = "Saturated actions"
    reason = "A clipped action is not what led to the next observation, and its statistics hide the real range."
    threshold = (
        f"more than {100 * SATURATED_SHARE:.0f} % of the ticks within {100 * (1 - CLOSE_TO_LIMIT):.0f} % of the "
        "declared limits or beyond; without a declaration, that often exactly at the extreme of a component"
    )
    needs = "motions, not absolute targets"
    order = 12

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find actions at the limit."""
        actions, semantics = episode.actions, episode.episode.semantics
        if semantics is not None and not semantics.control.is_relative:
            raise CannotCheckError("absolute targets have no limits per tick; one that is held looks clipped")
        if semantics is not None and semantics.control.is_joint_space:
            semantics = None
        at_limit = _at_limit(actions, semantics) if semantics else _at_extreme(actions)
        if at_limit.mean() > SATURATED_SHARE:
            yield episode.finding(
                f"{at_limit.sum()} of {len(at_limit)} actions ({100 * at_limit.mean():.0f} %) are saturated",
                ticks=tuple(np.flatnonzero(at_limit)[:3].tolist()),
                series={"saturated": tuple(at_limit.astype(float))},
            )


def _at_limit(actions: Floats, semantics: ActionSemantics) -> Flags:
    translation = np.linalg.norm(actions[:, :3], axis=1)
    rotation = np.linalg.norm(actions[:, 3:6], axis=1) if semantics.rotation.size == 3 else np.zeros(len(actions))
    return np.asarray(
        (translation >= CLOSE_TO_LIMIT * semantics.max_translation_m)
        | (rotation >= CLOSE_TO_LIMIT * semantics.max_rotation_rad)
    )


def _at_extreme(actions: Floats) -> Flags:
    """Return which actions have a component at its extreme, one that many actions share: a clip leaves that trace."""
    found = np.zeros(len(actions), bool)
    for component in actions.T[:-1]:
        if len(np.unique(component)) > max(5, len(component) // 4):
            for extreme in (component.min(), component.max()):
                same = component == extreme
                found |= same if same.sum() >= 3 and abs(extreme) > IDLE else False
    return found


@AUDIT_CHECKS.register("replay")
class Replay(AuditCheck):
    """Recorded actions that do not lead to the recorded states."""

    title = "The actions do not replay"
    reason = (
        "If the executed actions do not lead to the recorded observations, the pairs that a policy learns are wrong."
    )
    threshold = f"a tool centre point more than {1000 * REPLAY_M:g} mm from the recorded one"
    needs = "ground truth: the simulator executes the bag again (--replay)"
    order = 20

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find divergence."""
        error = episode.require_truth().replay_error_m
        if error is None:
            raise CannotCheckError(
                "the actions were not executed again (--replay), or the dataset holds none that can be"
            )
        beyond = np.flatnonzero(np.array(error) > REPLAY_M)
        if len(beyond):
            yield episode.finding(
                f"from tick {beyond[0]} the replay is off by up to {1000 * max(error):.1f} mm",
                ticks=(int(beyond[0]),),
                series={"error of the tool centre point [mm]": tuple(1000 * value for value in error)},
            )


def longest_run(flags: Flags) -> tuple[int, int]:
    """Return the start and the length of the longest run of true values; (0, 0) if there is none."""
    best, start = (0, 0), -1
    for index, flag in enumerate([*flags, False]):
        if flag and start < 0:
            start = index
        elif not flag and start >= 0:
            best, start = max(best, (start, index - start), key=lambda run: run[1]), -1
    return best
