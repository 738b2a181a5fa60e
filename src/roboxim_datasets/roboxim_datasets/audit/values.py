"""Inputs and findings of an audit, as plain values.

An audited episode is an `Episode` with its place in the dataset and, if available, its ground truth. The arrays are
read once; images are read once more for their summaries, and never kept.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from roboxim_core.poses import Pose
from roboxim_core.proprioception import ProprioField, component_names
from roboxim_datasets.audit.images import ImageTrack, image_tracks
from roboxim_datasets.episode import Episode, Floats, Step

Ticks = tuple[int, ...]
Values = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.floating[Any]]
Flags = npt.NDArray[np.bool_]

NO_TRUTH = "the dataset holds no state of the scene; name the bags that it was exported from (--bags)"
"""Why a check that needs ground truth cannot run on a dataset alone."""
NO_EXPECTED = "its expected values are unknown; name its bags (--bags) or another dataset of it (--against)"
"""Why a dataset alone is not compared value by value."""
NOT_FINITE = "a number of the episode is not finite, see the check 'statistics'"
"""Why a check that computes with numbers is not made of an episode."""


class CannotCheckError(Exception):
    """A check cannot be made of an episode; the text is the reason, which the report shows."""


class Severity(StrEnum):
    """How much a finding matters."""

    FAULT = "fault"
    """Training data that teach something wrong."""
    WARNING = "warning"
    """Worth a look."""


@dataclass(frozen=True, kw_only=True)
class Approach:
    """How the hand came to an object of the task: from the beginning of a step to the touch that counted."""

    begin: int = 0
    """Tick at which it begins."""
    distance_m: tuple[float, ...]
    """Distance of the tool centre point to its place at the touch that counted [m], one per tick up to that touch."""
    path_m: float
    """Length of the path of the tool centre point [m]."""
    closings: int
    """How often the gripper was commanded to close."""
    recovered: bool = False
    """Whether the actor itself says that it needed another attempt."""


@dataclass(frozen=True, kw_only=True)
class Meaning:
    """Meaning of the instruction, judged on the recorded states."""

    ever: bool
    """Whether the instruction's predicate was true at any tick."""
    detail: str = ""
    """What is known about the rest: which other task was solved, which named object is absent or was never neared."""


@dataclass(frozen=True, kw_only=True)
class Sighting:
    """How a camera sees an object of the task at a tick."""

    camera: str
    """The camera."""
    fixed: bool
    """Whether the camera is fixed in the world."""
    thing: str
    """The object as the instruction describes it."""
    tick: int
    """The tick."""
    pixels: float
    """Visible pixels, in an image whose longer side has 256 pixels."""
    share: float
    """Visible share of the silhouette that the object would have without occlusion, 0..1."""


@dataclass(frozen=True, kw_only=True)
class ColorPair:
    """Two objects that only their colour distinguishes, in one image."""

    camera: str
    """The camera."""
    named: str
    """The object that the instruction names."""
    other: str
    """The other object."""
    difference: float
    """Colour difference CIEDE2000 of their pixels."""


@dataclass(frozen=True, kw_only=True)
class Touch:
    """A contact that no demonstration should have."""

    tick: int
    """The tick."""
    bodies: str
    """The two bodies, e.g. ``robot and table``."""
    force_n: float
    """Largest normal force in the tick [N]."""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """Ground truth of an episode, measured from its recorded states, scene and task."""

    solved: tuple[bool, ...]
    """Whether the recorded task counted as solved at each tick, from tick 0 to the last one, settling included."""
    approaches: tuple[Approach, ...] = ()
    """How the hand came to the object, for each step of the task; steps at which it touched none are left out."""
    meaning: Meaning | None = None
    """Meaning of the instruction; none: its text is of no known template."""
    sightings: tuple[Sighting, ...] | None = None
    """Visibility of the named objects at tick 0, and of the one that is touched first at some ticks until then; none:
    no renderer."""
    pairs: tuple[ColorPair, ...] | None = None
    """Objects that only their colour distinguishes from a named one; none: no renderer."""
    touches: tuple[Touch, ...] = ()
    """Contacts of the robot with the table, or with objects that the task does not name."""
    replay_error_m: tuple[float, ...] | None = None
    """Distance of the replayed from the recorded tool centre point at each tick [m]; none: not replayed."""


class Arm(Protocol):
    """An arm's kinematics and limits; `roboxim_core.kinematics.ArmKinematics` is one."""

    lower: Values
    """Lower joint limits [rad]."""
    upper: Values
    """Upper joint limits [rad]."""
    velocity: Values
    """Velocity limits of the joints [rad/s]."""

    def fk(self, joints: npt.ArrayLike) -> Pose:
        """Return the pose of the tool centre point in the base."""
        ...


@dataclass(kw_only=True, eq=False)
class AuditEpisode:
    """An episode under audit."""

    name: str
    """Name in the report, unique in the audit."""
    split: str
    """Split, e.g. ``train``."""
    episode: Episode
    """The episode."""
    truth: Truth | None = None
    """Ground truth; none: there is none, for `no_truth`."""
    no_truth: str = NO_TRUTH
    """Why there is no ground truth."""
    arm: Arm | None = None
    """The arm, if its joints are those of the state in the same order; none: unknown."""
    source: str = ""
    """Where to find it, e.g. its bag."""
    relabelled: str = ""
    """Instruction that the dataset says to have given it; empty: the recorded one."""
    prompt: Callable[[str], str] = str
    """Returns an instruction as the convention of the dataset's export words it."""
    expected: Episode | None = None
    """What it should be, value by value: an export of its bag, or the episode of another dataset; none: unknown."""
    no_expected: str = NO_EXPECTED
    """Why nothing says what it should be."""
    unexpected: str = ""
    """Why it should not exist; empty: it should."""
    lossless: bool = True
    """Whether its images should be equal to the expected ones, pixel by pixel."""
    exact_images: bool = False
    """Whether its images are stored without loss, so that one that is repeated is equal pixel by pixel."""

    @cached_property
    def steps(self) -> tuple[Step, ...]:
        """All steps, without images."""
        return tuple(self.episode.steps(()))

    @cached_property
    def stamps_s(self) -> Values | None:
        """Time of each observation [s], shape (T,); none: the dataset stores none."""
        stamps = [step.stamp_s for step in self.steps if step.stamp_s is not None]
        return np.array(stamps) if len(stamps) == len(self.steps) else None

    @cached_property
    def actions(self) -> Floats:
        """All actions, float32, shape (T, D)."""
        return np.stack([step.action for step in self.steps])

    @cached_property
    def executed(self) -> Floats | None:
        """All executed actions, float32, shape (T, D); None: the dataset stores none."""
        rows = [step.action_executed for step in self.steps]
        there = [row for row in rows if row is not None]
        return np.stack(there) if there and len(there) == len(rows) else None

    @cached_property
    def proprio(self) -> dict[str, Floats]:
        """All of the proprioception: field to float32, shape (T, size).

        A field is a `roboxim_core.proprioception.ProprioField` if the names of the components identify it, in any
        vector of the dataset; a vector of unknown components keeps its name.
        """
        found: dict[str, Floats] = {}
        for vector in self.steps[0].proprio:
            values = np.stack([step.proprio[vector] for step in self.steps])
            names = self.episode.vectors.get(vector, ())
            fields = _fields(names, self.episode.joint_names) if len(names) == values.shape[1] else {}
            if not fields:
                found[vector] = values
            for field_name, components in fields.items():
                found.setdefault(field_name, values[:, components])
        return found

    @cached_property
    def numbers(self) -> dict[str, Numbers]:
        """All numbers that checks compute with: name to shape (T, size)."""
        found: dict[str, Numbers] = {"action": self.actions}
        if self.executed is not None:
            found["executed action"] = self.executed
        if self.stamps_s is not None:
            found["time"] = self.stamps_s[:, None]
        found.update(self.proprio)
        return found

    @cached_property
    def finite(self) -> bool:
        """Whether all of them are finite."""
        return all(np.isfinite(values).all() for values in self.numbers.values())

    @cached_property
    def tracks(self) -> dict[str, ImageTrack]:
        """Summaries of each camera's images."""
        return image_tracks(self.episode)

    @property
    def rate_hz(self) -> float:
        """Control rate [Hz].

        Raises:
            CannotCheckError: When the dataset does not say.
        """
        semantics = self.episode.semantics
        rate = self.episode.fps or (semantics.rate_hz if semantics else 0.0)
        if not rate:
            raise CannotCheckError("the dataset does not say at which rate it was recorded")
        return rate

    @property
    def robot(self) -> str:
        """Id of the robot; empty: unknown."""
        return self.episode.robot

    @property
    def simulated(self) -> bool:
        """Whether RoboXim's simulator recorded it, whose arms follow commands to fractions of a millimetre."""
        return "final_state_hash" in self.episode.metadata

    @property
    def planned(self) -> bool:
        """Whether RoboXim's expert acted, whose labels follow a planned course."""
        return self.simulated and self.episode.metadata.get("actor") == "expert"

    def rate_or(self, default: float) -> float:
        """Return the control rate, or a default where the dataset does not say it [Hz]."""
        try:
            return self.rate_hz
        except CannotCheckError:
            return default

    def field(self, *names: str) -> Floats:
        """Return the first of some fields of the proprioception that the dataset has.

        Raises:
            CannotCheckError: When it has none of them.
        """
        for name in names:
            if name in self.proprio:
                return self.proprio[name]
        raise CannotCheckError(f"the dataset names no {' or '.join(names)} in its state")

    def require_truth(self) -> Truth:
        """Return the ground truth.

        Raises:
            CannotCheckError: When there is none.
        """
        if self.truth is None:
            raise CannotCheckError(self.no_truth)
        return self.truth

    def finding(self, text: str, **more: Any) -> Finding:
        """Return a finding in this episode.

        Args:
            text: What was found.
            **more: Other fields of `Finding`.
        """
        return Finding(text=text, episodes=(self.name,), **more)


def _fields(names: Sequence[str], joint_names: tuple[str, ...]) -> dict[str, list[int]]:
    """Return the fields of proprioception whose components are all among the names, with their places."""
    at = {name: place for place, name in enumerate(names)}
    return {
        str(field_name): [at[component] for component in components]
        for field_name in ProprioField
        if (components := component_names((field_name,), joint_names)) and all(c in at for c in components)
    }


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that is wrong with one episode, or with the dataset."""

    text: str
    """What was found, with its figures, in a sentence."""
    episodes: tuple[str, ...] = ()
    """Episodes that it is about; empty: the whole dataset."""
    ticks: Ticks = ()
    """Ticks that show it, in order."""
    cameras: tuple[str, ...] = ()
    """Cameras that show it; empty: all."""
    severity: Severity = Severity.FAULT
    """How much it matters."""
    series: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Curves that show it: name to one value per tick."""


@dataclass(frozen=True, kw_only=True)
class CheckResult:
    """Result of one check on a dataset."""

    name: str
    """Registered name of the check."""
    title: str
    """What it looks for."""
    reason: str
    """Why a trainer cares."""
    threshold: str
    """What counts as a finding."""
    checked: int
    """Episodes that were checked."""
    unchecked: Mapping[str, int]
    """Reason to the number of episodes that could not be checked for it."""
    findings: tuple[Finding, ...]
    """What was found."""

    @property
    def faults(self) -> tuple[Finding, ...]:
        """The findings that are faults."""
        return tuple(finding for finding in self.findings if finding.severity == Severity.FAULT)

    @property
    def faulty_episodes(self) -> tuple[str, ...]:
        """Episodes with a fault, in order of finding."""
        return tuple(dict.fromkeys(name for finding in self.faults for name in finding.episodes))

    @property
    def rate(self) -> float:
        """Share of the checked episodes that have a fault, 0..1."""
        return len(self.faulty_episodes) / self.checked if self.checked else 0.0

    @property
    def status(self) -> str:
        """``faults``, ``warnings``, ``clean`` or ``unchecked``."""
        if self.faults:
            return "faults"
        if self.findings:
            return "warnings"
        return "clean" if self.checked else "unchecked"


@dataclass(frozen=True, kw_only=True)
class AuditResult:
    """Result of an audit."""

    episodes: int
    """Episodes read."""
    steps: int
    """Their steps."""
    checks: tuple[CheckResult, ...]
    """Results of the checks, in the order of the report."""
    unreadable: Mapping[str, str] = field(default_factory=dict)
    """Episode to why it could not be read."""

    @property
    def clean(self) -> bool:
        """Whether no check found a fault and every episode could be read."""
        return not self.unreadable and not any(check.faults for check in self.checks)

    @property
    def counts(self) -> Counter[str]:
        """Number of checks by status."""
        return Counter(check.status for check in self.checks)

    def check(self, name: str) -> CheckResult:
        """Return the result of a check.

        Raises:
            KeyError: When the check was not made.
        """
        for check in self.checks:
            if check.name == name:
                return check
        raise KeyError(name)

    def findings(self) -> Iterator[tuple[CheckResult, Finding]]:
        """Yield every finding with its check."""
        for check in self.checks:
            for finding in check.findings:
                yield check, finding
