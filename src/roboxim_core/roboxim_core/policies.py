"""The policy boundary: what a policy says of itself, what it gets, what it returns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ActionArray, ActionSemantics
from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord

RGBImage = npt.NDArray[np.uint8]
FREE = "free"
"""Phase of an action whose way does not matter: noise may be injected."""
RECOVERY = "recovery"
"""Phase of an action of another try, after the first went wrong: the episode is no first-try success."""


@dataclass(frozen=True, kw_only=True)
class CameraRequirement:
    """A camera that a policy wants."""

    name: str
    """Name of the camera, e.g. ``workspace``."""
    width: int = 0
    """Wanted width [px]; 0: as the scene has it."""
    height: int = 0
    """Wanted height [px]; 0: as the scene has it."""


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
        """Check the ranges.

        Raises:
            InvalidRequestError: On a window or horizon below 1.
        """
        if self.window < 1 or self.horizon < 1:
            raise InvalidRequestError(
                f"policy '{self.name}': window and horizon must be >= 1, got {self.window} and {self.horizon}"
            )


def proprio_of(state: StateRecord, pose_base_in_world: Pose = IDENTITY) -> ActionArray:
    """Return a policy's proprioception of a state; what an export stores and what `Act` carries are this one.

    Args:
        state: The state record.
        pose_base_in_world: Pose of the robot's base.

    Returns:
        float32, shape (8,): measured TCP position in the base frame [m], its quaternion xyzw, gripper opening.
    """
    tcp = state.robot.pose_tcp_measured
    if pose_base_in_world != IDENTITY:
        tcp = pose_base_in_world.inverse() @ tcp
    return np.array([*tcp.position, *tcp.quat_xyzw, state.robot.gripper_opening], dtype=np.float32)


@dataclass(frozen=True, kw_only=True)
class Observation:
    """What a policy sees at one tick."""

    seq: int
    """Tick."""
    stamp_ns: int
    """Simulated time [ns]."""
    images: Mapping[str, RGBImage] = field(default_factory=dict)
    """Camera name to RGB image, uint8, shape (height, width, 3), read-only."""
    proprio: ActionArray = field(default_factory=lambda: np.zeros(8, np.float32))
    """float32, shape (8,): measured TCP in the base, position [m] (3), quaternion xyzw (4); gripper opening (1)."""
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
    """float32, shape (horizon, 7)."""
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
        """Return the next actions, shape (horizon, 7) or (7,), or an `ActionChunk`."""
        ...
