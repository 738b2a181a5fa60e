"""Whether actions, labels, joints and measured motion belong together: relations that hold in any dataset.

None of these checks knows a fault by name. They compare two measurements of the same quantity and report where these
differ. The edit that explains the difference best is only a hint for the reader.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from roboxim_datasets.audit.chains import Chain, chains_of
from roboxim_datasets.audit.check import AUDIT_CHECKS, AuditCheck
from roboxim_datasets.audit.fitting import likeliest, predicted, response, runs_of
from roboxim_datasets.audit.values import AuditEpisode, CannotCheckError, Finding, Flags, Severity, Values

TYPICAL = 5.0
"""Times the typical residual of the other episodes that is a finding where the dataset is not a simulation's."""
DRIFT = 3.0
"""Times the tolerance that the sum of an episode's residuals may reach."""
FOLLOWS = 0.8
"""Least share of the variance of measured motion that actions explain where they are what they are declared to be."""
AT_LIMIT = 0.9
"""Share of a joint's velocity limit, as a mean of a tick, from which its controller may have shortened an action."""
AT_END_RAD = 0.003
"""Distance from a joint's position limit [rad] at which it cannot follow an action, and the others compensate."""
BEYOND = 1.15
"""Share of it that measured joints reach while they catch up."""
ROUGH = 0.4
"""Share of the tolerance by which a planned course may zigzag."""
NOISE_WINDOW = 6
NOISE_RATIO = 0.5
LEG = 4
"""Fewest ticks in a row in which labels differ by noise; two, where all of the action differs."""
PUSHED = 5.0
"""Times the tolerance by which a contact may push the arm aside for a tick or two."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Seen:
    """What the check keeps of an episode."""

    name: str
    chain: Chain
    simulated: bool
    failed: bool
    limited: Flags
    """Steps in which a joint moved as fast as it can, and those after each, in which the arm catches up; shape
    (T - 1,)."""
    at_end: Flags
    """Steps that begin or end with a joint at its position limit, and those after each; shape (T - 1,)."""


@AUDIT_CHECKS.register("motion")
class Motion(AuditCheck):
    """Measured motion that the executed actions do not explain, or actions without their motion."""

    title = "The measured motion does not follow from the actions"
    reason = "The pairs of observation and action are wrong: shifted, scaled, of other axes, or of another episode."
    threshold = (
        "measured motion, as increments, differs from the response that all episodes share by more than 1 mm or 0.5 "
        f"degrees in a tick, or {DRIFT:g} times as much in sum; in data that is not simulated, also by more than "
        f"{TYPICAL:g} times what is typical; or all actions explain less than {100 * FOLLOWS:.0f} % of the motion, "
        "lead to the motion of another tick, or have another scale; ticks at a joint's velocity limit and the next "
        f"aside, and a warning alone where a joint is at its position limit, or the arm is up to {PUSHED:g} times as "
        "far aside for a single tick, as after a contact"
    )
    needs = "the declared meaning of the actions, and the measured pose or joints that they command"
    order = 7

    def __init__(self) -> None:
        """Remember the episodes: the response is that of all of them."""
        self._seen: dict[str, list[_Seen]] = {}

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Keep what is compared."""
        for chain in chains_of(episode):
            seen = _Seen(
                name=episode.name, chain=chain, simulated=episode.simulated, limited=_caught_up(_limited(episode)),
                at_end=_caught_up(_at_end(episode)), failed=episode.episode.success is False,
            )  # fmt: skip
            self._seen.setdefault(f"{chain.name} {episode.robot} {episode.rate_or(0):g}", []).append(seen)
        yield from ()

    def conclude(self) -> Iterator[Finding]:
        """Compare each episode with the response of all."""
        for group in self._seen.values():
            first = group[0].chain
            weights = response([(s.chain.commanded, s.chain.measured) for s in group], first.tolerance / 20)
            yield from _of_all(group, weights)
            residuals = [seen.chain.measured - predicted(seen.chain.commanded, weights) for seen in group]
            for seen, rows in zip(group, residuals, strict=True):
                rows[seen.limited & _shortened(seen.chain, weights)] = 0.0
            lengths = [np.linalg.norm(rows, axis=1) for rows in residuals]
            typical = float(np.median([np.quantile(values, 0.99) for values in lengths]))
            for seen, rows, values in zip(group, residuals, lengths, strict=True):
                tolerance = max(first.tolerance, 0.0 if seen.simulated else TYPICAL * typical)
                yield from _of_one(seen, rows, values, tolerance, weights)


def _limited(episode: AuditEpisode) -> Flags:
    """Return in which steps a joint moved as fast as it can, shape (T - 1,)."""
    steps = len(episode.actions) - 1
    arm, rate = episode.arm, episode.rate_or(0)
    if arm is None or not rate or "joint_positions" not in episode.proprio:
        return np.zeros(steps, bool)
    speeds = np.abs(np.diff(episode.proprio["joint_positions"].astype(float), axis=0)) * rate
    fast = (speeds >= AT_LIMIT * arm.velocity).any(axis=1) & (speeds <= BEYOND * arm.velocity).all(axis=1)
    return np.asarray(fast)


def _at_end(episode: AuditEpisode) -> Flags:
    """Return in which steps a joint was at its position limit, before or after, shape (T - 1,)."""
    arm = episode.arm
    if arm is None or "joint_positions" not in episode.proprio:
        return np.zeros(len(episode.actions) - 1, bool)
    joints = episode.proprio["joint_positions"].astype(float)
    beyond = np.asarray((joints <= arm.lower + AT_END_RAD) | (joints >= arm.upper - AT_END_RAD))
    there = np.asarray(beyond.any(axis=1))
    return np.asarray(there[:-1] | there[1:])


def _caught_up(limited: Flags) -> Flags:
    """Return flags of steps, and those of the step after each."""
    return np.asarray(limited | np.r_[False, limited[:-1]])


def _shortened(chain: Chain, weights: Values) -> Flags:
    """Return the steps in which the arm did not move much farther than commanded."""
    commanded = np.linalg.norm(predicted(chain.commanded, weights), axis=1)
    return np.asarray(np.linalg.norm(chain.measured, axis=1) <= 2 * commanded + 5 * chain.tolerance)


def _of_all(group: list[_Seen], weights: Values) -> Iterator[Finding]:
    """Say what is wrong with all actions at once."""
    chain = group[0].chain
    moved = np.concatenate([seen.chain.measured for seen in group])
    left = moved - np.concatenate([predicted(seen.chain.commanded, weights) for seen in group])
    if float(np.abs(moved).max(initial=0.0)) < chain.tolerance:
        return
    explained = 1 - float(np.square(left).sum() / np.square(moved).sum())
    severity = Severity.FAULT if any(seen.simulated for seen in group) else Severity.WARNING
    if explained < FOLLOWS:
        yield Finding(
            text=f"{chain.name}: all actions together explain {100 * max(explained, 0):.0f} % of the measured motion: "
            "they do not mean what the dataset declares",
            severity=severity,
        )
        return
    early, now, later = float(weights[0]), float(weights[1]), float(weights[2:].sum())
    if max(early, later) > now:
        what = "before its action: the actions are late" if early > later else "after its action: they are early"
        yield Finding(text=f"{chain.name}: the motion comes a tick or more {what}", severity=severity)
    elif abs(weights.sum() - 1) > 0.05:
        yield Finding(
            text=f"{chain.name}: the motion is {weights.sum():.2f} times what the actions ask for", severity=severity
        )


def _of_one(seen: _Seen, rows: Values, values: Values, tolerance: float, weights: Values) -> Iterator[Finding]:
    """Say what is wrong with one episode."""
    chain = seen.chain
    drift = np.linalg.norm(np.cumsum(rows, axis=0), axis=1)
    bad = np.flatnonzero(values > tolerance)
    pushed = bool(len(bad)) and values.max() <= PUSHED * tolerance and _returns(drift > tolerance)
    at_end = bool(len(bad)) and bool(seen.at_end[bad].all())
    if not len(bad) and float(drift.max(initial=0.0)) <= DRIFT * tolerance:
        return
    unit, per = chain.unit, chain.per_unit
    if len(bad):
        worst = int(values.argmax())
        text = (
            f"{values[worst] / per:.1f} {unit} at tick {worst}, more than expected in {len(bad)} of {len(values)} ticks"
        )
        ticks = (int(bad[0]), int(bad[-1]) + 1)
    else:
        worst = int(drift.argmax())
        text, ticks = f"{drift[worst] / per:.1f} {unit} in sum until tick {worst}", (0, worst)
    yield Finding(
        text=f"{chain.name}: measured motion and actions differ by {text}"
        + (
            "; a joint is at its position limit there"
            if at_end
            else "; the arm is back at the next tick, as after a contact"
            if pushed
            else _guess(chain, weights, values > tolerance)
        ),
        episodes=(seen.name,),
        ticks=tuple(dict.fromkeys(ticks)),
        severity=Severity.WARNING if seen.failed or pushed or at_end else Severity.FAULT,
        series={f"difference [{unit}]": tuple(values / per), f"in sum [{unit}]": tuple(drift / per)},
    )


def _returns(off: Flags) -> bool:
    """Return whether the arm is away from where its actions lead in single ticks only."""
    return all(end == start for start, end in runs_of(off))


def _guess(chain: Chain, weights: Values, bad: Flags) -> str:
    """Return which edit of the actions explains an episode best, as the end of a sentence."""
    if not bad.any():
        return ""
    places = np.flatnonzero(bad)
    if len(places) <= 2 and places[-1] - places[0] <= 1:
        return "; likeliest: the state jumps there, as where ticks were left out, repeated or taken from elsewhere"
    window = slice(int(places[0]), int(places[-1]) + 1)
    commanded = predicted(chain.commanded, weights)[window]
    words = likeliest(commanded, chain.measured[window], _names(chain))
    where = "" if len(places) > 0.7 * len(bad) else f" from tick {places[0]} to {places[-1] + 1}"
    return f"; likeliest: the actions are edited ({words}){where}" if words else ""


def _names(chain: Chain) -> tuple[str, ...]:
    count = chain.commanded.shape[1]
    return ("x", "y", "z") if count == 3 else tuple(f"joint {i + 1}" for i in range(count))


@AUDIT_CHECKS.register("labels")
class Labels(AuditCheck):
    """Labels that are not what a demonstrator meant where noise moved the arm."""

    title = "The labels do not fit the executed actions"
    reason = "The policy learns the label; without injected noise it equals the executed action."
    threshold = (
        "gripper labels that are not the executed ones; a difference for fewer than "
        f"{LEG} ticks in a row (2 where position and rotation differ), or without the roughness that noise has; labels "
        f"that ask for a course which zigzags by more than {ROUGH:g} mm or {ROUGH / 2:g} degrees"
    )
    needs = "executed actions beside the labels, as in RoboXim's exports; the declared meaning of the actions"
    order = 8

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Compare labels and executed actions."""
        if episode.executed is None:
            raise CannotCheckError("the dataset stores no executed actions beside the labels")
        chains = chains_of(episode)
        gripper = np.abs(episode.actions[:, -1] - episode.executed[:, -1]) > 1e-4
        if gripper.any():
            start, end = runs_of(gripper)[0]
            yield episode.finding(
                f"the gripper's labels are not what was executed in {int(gripper.sum())} of {len(gripper)} ticks, "
                f"from tick {start} on",
                ticks=(start, end),
                series={"label": tuple(episode.actions[:, -1]), "executed": tuple(episode.executed[:, -1])},
            )
        everywhere = np.all([_differs(chain) for chain in chains], axis=0) & (len(chains) > 1)
        for chain in chains:
            problem, bad = _label_problem(chain, _near(_limited(episode)), everywhere, planned=episode.planned)
            if problem:
                first, last = int(np.flatnonzero(bad)[0]), int(np.flatnonzero(bad)[-1])
                yield episode.finding(
                    f"{chain.name}: {problem}{_edit(chain, bad)}",
                    ticks=tuple(dict.fromkeys((first, last))),
                    series={
                        f"label and executed action differ [{chain.unit}]": tuple(
                            np.linalg.norm(chain.apart, axis=1) / chain.per_unit
                        )
                    },
                )


def _near(flags: Flags) -> Flags:
    """Return flags of T - 1 steps for T ticks, and those after each: labels correct a shortened action there."""
    found = np.r_[flags, False]
    for ticks in (1, 2, 3):
        found[ticks:] |= np.r_[flags, False][:-ticks]
    found[:-1] |= flags
    found[:-2] |= flags[1:]
    return np.asarray(found, bool)


def _differs(chain: Chain) -> Flags:
    """Return in which ticks label and executed action differ, shape (T,)."""
    return np.asarray(np.linalg.norm(chain.apart, axis=1) > 1e-2 * chain.per_unit)


def _label_problem(chain: Chain, limited: Flags, everywhere: Flags, *, planned: bool) -> tuple[str, Flags]:
    """Return what is wrong with the labels of a chain, and where; empty: nothing.

    Args:
        chain: Positions, rotations or joints.
        limited: Ticks near a joint's velocity limit, shape (T,).
        everywhere: Ticks in which all chains of the action differ, as noise makes them, shape (T,).
        planned: Whether the labels are a planner's.
    """
    apart = np.linalg.norm(chain.apart, axis=1)
    differs = _differs(chain)
    short = [
        (start, end)
        for start, end in runs_of(differs)
        if end - start + 1 < (2 if everywhere[start : end + 1].all() else LEG)
        and apart[start : end + 1].max() > chain.tolerance
    ]
    if short:
        start, end = short[0]
        bad = np.zeros(len(apart), bool)
        bad[start : end + 1] = True
        size = apart[start : end + 1].max() / chain.per_unit
        return (
            f"the label of tick {start} is {size:.1f} {chain.unit} from the executed action, its neighbours are not",
            bad,
        )
    zigzag = np.where(limited, 0.0, _zigzag(chain.labelled))
    if planned and zigzag.max(initial=0.0) > ROUGH * chain.tolerance and differs.any():
        bad = zigzag > ROUGH * chain.tolerance
        return (
            f"without the noise that they correct, the labels zigzag by up to {zigzag.max() / chain.per_unit:.1f} "
            f"{chain.unit} in {int(bad.sum())} ticks",
            bad,
        )
    rough = np.linalg.norm(np.diff(chain.commanded, axis=0, append=chain.commanded[-1:]), axis=1)
    bad = np.zeros(len(apart), bool)
    for start in range(len(apart) - NOISE_WINDOW + 1):
        window = slice(start, start + NOISE_WINDOW)
        enough = apart[window] > 0.3 * chain.tolerance
        if enough.all() and np.median(rough[window]) < NOISE_RATIO * np.median(apart[window]):
            bad[window] = True
    if bad.any():
        return f"labels differ from the executed actions in {int(bad.sum())} ticks whose motion shows no noise", bad
    return "", bad


def _edit(chain: Chain, bad: Flags) -> str:
    places = np.flatnonzero(bad)
    window = slice(max(int(places[0]) - 1, 0), int(places[-1]) + 2)
    if window.stop - window.start < 4:
        return ""
    words = likeliest(chain.commanded[window] - chain.apart[window], chain.commanded[window], _names(chain))
    return f"; likeliest: edited ({words})" if words else ""


def _zigzag(rows: Values) -> Values:
    """Return by how much each tick goes up and the next one down again, or the reverse, beyond their neighbours."""
    if len(rows) < 4:
        return np.zeros(len(rows))
    high, low = np.maximum(rows[:-2], rows[2:]), np.minimum(rows[:-2], rows[2:])
    up, down = np.maximum(0, rows[1:-1] - high), np.maximum(0, low - rows[1:-1])
    both = np.maximum(np.minimum(up[:-1], down[1:]), np.minimum(down[:-1], up[1:])).max(axis=1)
    return np.pad(both, (1, len(rows) - 1 - len(both)))


@AUDIT_CHECKS.register("kinematics")
class Joints(AuditCheck):
    """Joints that do not lead to the measured pose, or that the robot does not have."""

    title = "Joints and tool pose do not belong together"
    reason = "Units, order or signs of the joints are wrong, or joints and pose are of different times."
    threshold = (
        "the arm's kinematics place the tool over 1 mm from its recorded position; a joint 10 mrad beyond a limit"
    )
    needs = "joint positions of a robot that RoboXim knows; for the pose, the position of the tool in its base"
    order = 9

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Compare the joints with the pose and the limits."""
        joints = episode.field("joint_positions").astype(float)
        if episode.arm is None:
            raise CannotCheckError("the robot, or the order of its joints, is not known")
        arm = episode.arm
        beyond = np.maximum(arm.lower - joints, joints - arm.upper).max(axis=1)
        worst = int(beyond.argmax())
        if beyond[worst] > 0.01:
            yield episode.finding(
                f"a joint is up to {beyond[worst]:.3f} rad beyond its limit, in {int((beyond > 0.01).sum())} of "
                f"{len(beyond)} ticks",
                ticks=(worst,),
            )
        if "tcp_position" not in episode.proprio:
            return
        place = episode.proprio["tcp_position"].astype(float)
        off = np.linalg.norm(np.array([arm.fk(row).position for row in joints]) - place, axis=1)
        bad = np.flatnonzero(off > 1e-3)
        if len(bad):
            yield episode.finding(
                f"the joints place the tool up to {1000 * off.max():.1f} mm from its recorded position, in "
                f"{len(bad)} "
                f"of {len(off)} ticks, from tick {bad[0]} on",
                ticks=tuple(dict.fromkeys((int(bad[0]), int(bad[-1])))),
                series={"joints and position differ [mm]": tuple(1000 * off)},
            )
