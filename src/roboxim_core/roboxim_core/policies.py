"""The policy boundary: what a policy says of itself, what it gets, what it returns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ActionArray, ActionSemantics
from roboxim_core.errors import InvalidRequestError, printable
from roboxim_core.proprioception import Proprioception
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord

RGBImage = npt.NDArray[np.uint8]
FREE = "free"
"""Phase of an action whose way does not matter: noise may be injected."""
RECOVERY = "recovery"
"""Phase of an action of another try, after the first went wrong: the episode is no first-try success."""

MAX_WINDOW = 1_000
"""Most observations per request."""
MAX_HORIZON = 10_000
"""Most actions per answer."""
LONGEST_TEXT = 1_000
"""Longest name or version [characters]."""


@dataclass(frozen=True, kw_only=True)
class CameraRequirement:
    """A camera that a policy wants."""

    name: str
    """Name of the camera, e.g. ``workspace``."""
    width: int = 0
    """Wanted width [px]; 0: as the scene has it."""
    height: int = 0
    """Wanted height [px]; 0: as the scene has it."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            InvalidRequestError: On a name that is no string, or a size that is no whole number from 0 to 65535.
        """
        _require_text("a camera's name", self.name)
        for name in ("width", "height"):
            _require_whole(f"camera '{self.name}': {name}", getattr(self, name), 0, 65_535)


@dataclass(frozen=True, kw_only=True)
class PolicyDescription:
    """What a policy says of itself; checked before the first step."""

    name: str
    """Name for reports, e.g. ``bc``."""
    semantics: ActionSemantics = ActionSemantics()
    """Meaning of its actions."""
    cameras: tuple[CameraRequirement, ...] = ()
    """Cameras that it looks through."""
    window: int = 1
    """Number of observations it wants, newest last, >= 1."""
    horizon: int = 1
    """Number of actions that it returns per request, >= 1."""
    privileged: bool = False
    """Whether it reads the task, the scene and the state record (an expert does, a policy under test must not)."""
    version: str = ""
    """Version or checkpoint, for the record."""

    def __post_init__(self) -> None:
        """Check types and ranges: a policy's author writes them.

        Raises:
            InvalidRequestError: Naming what is wrong.
        """
        _require_text("a policy's name", self.name)
        _require_text(f"policy '{self.name}': version", self.version)
        _require_whole(f"policy '{self.name}': window", self.window, 1, MAX_WINDOW)
        _require_whole(f"policy '{self.name}': horizon", self.horizon, 1, MAX_HORIZON)
        for name, kind in (("semantics", ActionSemantics), ("privileged", bool), ("cameras", tuple)):
            if not isinstance(getattr(self, name), kind):
                raise InvalidRequestError(
                    f"policy '{self.name}': {name} must be a {kind.__name__}, got {getattr(self, name)!r}"
                )
        for camera in self.cameras:
            if not isinstance(camera, CameraRequirement):
                raise InvalidRequestError(f"policy '{self.name}': a camera must be a CameraRequirement, got {camera!r}")


def _require_text(what: str, value: Any) -> None:
    if not isinstance(value, str) or len(value) > LONGEST_TEXT or not value.isprintable():
        raise InvalidRequestError(
            f"{what} must be a printable string of at most {LONGEST_TEXT} characters, "
            f"got {printable(value, 100, form=repr)}"
        )


def _require_whole(what: str, value: Any, least: int, most: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise InvalidRequestError(
            f"{what} must be a whole number from {least} to {most}, got {printable(value, 100, form=repr)}"
        )


@dataclass(frozen=True, kw_only=True)
class Observation:
    """What a policy sees at one tick."""

    seq: int
    """Tick."""
    stamp_ns: int
    """Simulated time [ns]."""
    images: Mapping[str, RGBImage] = field(default_factory=dict)
    """Camera name to RGB image, uint8, shape (height, width, 3), read-only."""
    proprio: Proprioception = Proprioception()
    """What the robot measures of itself; ``proprio.vector()`` is one array."""
    state: StateRecord | None = None
    """State record; only for a policy that declares ``privileged``."""


@dataclass(frozen=True, kw_only=True)
class ObservationWindow:
    """The last observations and what is asked for."""

    instruction: str
    """Natural language instruction."""
    observations: Sequence[Observation]
    """``window`` observations, newest last; early ones repeat the first frame."""
    pad_mask: tuple[bool, ...]
    """For each observation whether it is real (True) or padding (False)."""
    episode_id: str
    """Episode."""
    seq: int
    """Tick of the newest observation."""

    @property
    def newest(self) -> Observation:
        """The newest observation."""
        return self.observations[-1]


@dataclass(frozen=True, kw_only=True)
class EpisodeStart:
    """What a policy is told when an episode starts."""

    episode_id: str
    """Episode."""
    instruction: str
    """Natural language instruction."""
    seed: int
    """Seed for the policy's own randomness."""
    task: TaskSpec | None = None
    """The task; only for a privileged policy."""
    scene: SceneSpec | None = None
    """The scene; only for a privileged policy."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ActionChunk:
    """Actions with what only an expert says of them; a learned policy returns the bare array."""

    actions: ActionArray
    """float32, shape (horizon, D); D is 7 by default."""
    done: bool = False
    """Whether the actor has nothing more to do after these; the episode then settles."""
    phases: tuple[str, ...] = ()
    """Per action the actor's own word for it: noise is only injected where it is ``free``; one that is ``recovery``
    marks the episode as recovered. Empty: unknown."""


class Policy(Protocol):
    """A policy. `roboxim_policies.BasePolicy` gives every method but ``act``."""

    def describe(self) -> PolicyDescription:
        """Say what the policy needs and what its actions mean."""
        ...

    def reset(self, start: EpisodeStart) -> None:
        """Forget the last episode."""
        ...

    def act(self, window: ObservationWindow) -> npt.ArrayLike | ActionChunk:
        """Return the next actions, shape (horizon, D) or (D,), or an `ActionChunk`."""
        ...
