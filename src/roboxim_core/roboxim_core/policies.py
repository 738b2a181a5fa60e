"""The policy boundary: description, inputs and outputs of a policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ActionArray, ActionSemantics, Chunking, GripperRule
from roboxim_core.actions.lag import require_lag
from roboxim_core.errors import InvalidRequestError, printable
from roboxim_core.proprioception import Proprioception
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord

RGBImage = npt.NDArray[np.uint8]
FREE = "free"
"""Phase of actions whose exact path does not matter: noise may be injected."""
DESCENT = "descent"
"""Phase of a descent to a grasp or a place, before its last centimetres: noise may be injected if the run wants it."""
RECOVERY = "recovery"
"""Phase of actions of a further try, after the first one failed: the episode is not a first-try success."""

MAX_WINDOW = 1_000
"""Largest number of observations per request."""
MAX_HORIZON = 10_000
"""Largest number of actions per answer."""
LONGEST_TEXT = 1_000
"""Largest length of a name or version [characters]."""


@dataclass(frozen=True, kw_only=True)
class CameraRequirement:
    """A camera that a policy requires."""

    name: str
    """Name of the camera, e.g. ``workspace``."""
    width: int = 0
    """Required width [px]; 0: as in the scene."""
    height: int = 0
    """Required height [px]; 0: as in the scene."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            InvalidRequestError: On a name that is not a string, or a size that is not an integer from 0 to 65535.
        """
        _require_text("a camera's name", self.name)
        for name in ("width", "height"):
            _require_whole(f"camera '{self.name}': {name}", getattr(self, name), 0, 65_535)


@dataclass(frozen=True, kw_only=True)
class PolicyDescription:
    """Requirements and properties that a policy declares; checked before the first step."""

    name: str
    """Name for reports, e.g. ``bc``."""
    semantics: ActionSemantics = ActionSemantics()
    """Meaning of its actions."""
    cameras: tuple[CameraRequirement, ...] = ()
    """Cameras whose images the policy needs."""
    window: int = 1
    """Number of observations per request, newest last, >= 1."""
    horizon: int = 1
    """Largest number of actions per answer, >= 1."""
    privileged: bool = False
    """Whether the policy reads task, scene and state record (an expert does, a policy under test must not)."""
    version: str = ""
    """Version or checkpoint, for reports and bags."""
    chunking: Chunking = Chunking()
    """How its chunks are executed unless the run says otherwise."""
    gripper: GripperRule = GripperRule()
    """When the gripper opens and closes."""
    lag: tuple[float, ...] = ()
    """Lag of the arm that the policy was trained with, which its executed motions get, see `MotionLag`: one number for
    each of x, y, z and the rotations about them. Empty: none."""

    def __post_init__(self) -> None:
        """Check types and ranges, because the author of a policy writes them.

        Raises:
            InvalidRequestError: Naming the wrong field.
        """
        _require_text("a policy's name", self.name)
        _require_text(f"policy '{self.name}': version", self.version)
        _require_whole(f"policy '{self.name}': window", self.window, 1, MAX_WINDOW)
        _require_whole(f"policy '{self.name}': horizon", self.horizon, 1, MAX_HORIZON)
        for name, kind in (
            ("semantics", ActionSemantics),
            ("privileged", bool),
            ("cameras", tuple),
            ("chunking", Chunking),
            ("gripper", GripperRule),
        ):
            if not isinstance(getattr(self, name), kind):
                raise InvalidRequestError(
                    f"policy '{self.name}': {name} must be a {kind.__name__}, got {getattr(self, name)!r}"
                )
        require_lag(self.lag)
        if self.lag and not self.semantics.is_vector_delta:
            raise InvalidRequestError(
                f"policy '{self.name}': a lag needs end-effector deltas with three rotation numbers, not "
                f"'{self.semantics.control}' with '{self.semantics.rotation}'"
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


def _require_whole(what: str, value: Any, minimum: int, maximum: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not minimum <= value <= maximum:
        raise InvalidRequestError(
            f"{what} must be a whole number from {minimum} to {maximum}, got {printable(value, 100, form=repr)}"
        )


@dataclass(frozen=True, kw_only=True)
class Observation:
    """Input of a policy at one tick."""

    seq: int
    """Tick."""
    stamp_ns: int
    """Simulated time [ns]."""
    images: Mapping[str, RGBImage] = field(default_factory=dict)
    """Camera name to RGB image, uint8, shape (height, width, 3), read-only."""
    proprio: Proprioception = Proprioception()
    """The robot's own measurements; ``proprio.vector()`` returns one array."""
    state: StateRecord | None = None
    """State record; None unless the policy declares ``privileged``."""


@dataclass(frozen=True, kw_only=True)
class ObservationWindow:
    """A request to a policy: the instruction and the last observations."""

    instruction: str
    """Natural language instruction."""
    observations: Sequence[Observation]
    """``window`` observations, newest last; early ones repeat the first frame."""
    pad_mask: tuple[bool, ...]
    """For each observation, whether it is real (True) or padding (False)."""
    episode_id: str
    """Episode."""
    seq: int
    """Tick of the newest observation."""
    commanded_opening: float | None = None
    """Opening of the gripper that the last executed action commands, 1 = open, 0 = closed: what execution made of the
    answers, which may be late, cut or averaged. None: nothing was executed yet, or the caller does not know."""

    @property
    def newest(self) -> Observation:
        """The newest observation."""
        return self.observations[-1]


@dataclass(frozen=True, kw_only=True)
class EpisodeStart:
    """Input of a policy at the start of an episode."""

    episode_id: str
    """Episode."""
    instruction: str
    """Natural language instruction."""
    seed: int
    """Seed for the policy's own randomness."""
    task: TaskSpec | None = None
    """The task; None unless the policy is privileged."""
    scene: SceneSpec | None = None
    """The scene; None unless the policy is privileged."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ActionChunk:
    """Actions with extra information that only an expert gives; a learned policy returns a plain array."""

    actions: ActionArray
    """float32, shape (horizon, D); D is 7 by default."""
    done: bool = False
    """Whether the actor has finished after these actions; the episode then settles."""
    phases: tuple[str, ...] = ()
    """Name of each action's phase, chosen by the actor. Noise is injected only in phase ``free``; phase ``recovery``
    marks the episode as recovered. Empty: unknown."""
    received: tuple[str, ...] = ()
    """Instructions that the policy was given in this episode so far, each once; empty: unknown. The policy's guard sets
    it and overwrites what the policy wrote, see `PassesOn`."""


class Policy(Protocol):
    """A policy. `roboxim_policies.BasePolicy` implements every method except ``act``."""

    def describe(self) -> PolicyDescription:
        """Return what the policy requires and what its actions mean."""
        ...

    def reset(self, start: EpisodeStart) -> None:
        """Start an episode: forget the previous one."""
        ...

    def act(self, window: ObservationWindow) -> npt.ArrayLike | ActionChunk:
        """Return the next actions, shape (horizon, D) or (D,), or an `ActionChunk`."""
        ...


@runtime_checkable
class PassesOn(Protocol):
    """A policy that passes its requests on to another one, e.g. with a changed instruction or to another process."""

    def received_instructions(self) -> Sequence[str]:
        """Return the instructions that the other policy was given since the last reset, each once; empty: unknown."""
        ...
