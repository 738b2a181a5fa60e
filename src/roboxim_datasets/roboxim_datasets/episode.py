"""An episode as plain values, independent of its storage: the type that readers return and writers take.

Step k holds observation k and the action that leads from it to observation k + 1; T actions make T steps. The small
fields are loaded at once. Steps are read on demand, one after another, so an episode needs the memory of one step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ActionSemantics
from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError, one_of

Floats = npt.NDArray[np.float32]
RGBImage = npt.NDArray[np.uint8]
MetaValue = str | int | float | bool


@dataclass(frozen=True, kw_only=True)
class ImageSize:
    """Size of a camera's images."""

    height: int
    """Height [px]."""
    width: int
    """Width [px]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Step:
    """One step."""

    index: int
    """Number of the step, from 0."""
    images: Mapping[str, RGBImage] = field(default_factory=dict)
    """Camera to RGB image, uint8, shape (height, width, 3), read-only; only the requested cameras."""
    proprio: Mapping[str, Floats] = field(default_factory=dict)
    """Field of `roboxim_core.proprioception.ProprioField` to float32 vector; a dataset that does not say what its state
    consists of has the one field ``state``."""
    action: Floats
    """Action that an imitator should output, float32, shape (D,); its meaning is in `Episode.semantics`."""
    action_executed: Floats | None = None
    """Executed action; differs from ``action`` where noise was injected. None: not stored."""
    reward: float = 0.0
    """1 on the last step of a success, else 0."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Episode:
    """An episode of T steps.

    Non-obvious: every call of `steps` reads again from the start; it fails if the file is gone by then.
    """

    episode_id: str
    """Unique id; empty: the dataset has none."""
    length: int
    """Number of steps."""
    instruction: str
    """Natural language instruction."""
    semantics: ActionSemantics | None
    """Meaning of the actions; None: the dataset does not say."""
    cameras: Mapping[str, ImageSize]
    """Camera to the size of its images."""
    success: bool
    """Whether the task was solved at the end."""
    robot: str = ""
    """Id of the robot model; empty: the dataset does not say."""
    joint_names: tuple[str, ...] = ()
    """Arm joints in the order of ``joint_positions``; empty: the dataset does not say."""
    metadata: Mapping[str, MetaValue] = field(default_factory=dict)
    """Further metadata of the episode, by name."""
    read: Callable[[Sequence[str]], Iterator[Step]] = field(repr=False)
    """Reads the steps with the images of the cameras given; `steps` calls it."""

    def __len__(self) -> int:
        """Count the steps."""
        return self.length

    def steps(self, cameras: Sequence[str] | None = None) -> Iterator[Step]:
        """Yield the steps in order.

        Args:
            cameras: Cameras whose images to read; None: all.

        Raises:
            InvalidRequestError: On a camera that the episode does not have.
            RecorderError: With code ``BAG_DAMAGED`` when it cannot be read, or has more or fewer steps than it says.
        """
        for name in cameras or ():
            if name not in self.cameras:
                raise InvalidRequestError(
                    f"episode '{self.episode_id}' has no camera '{name}'; {one_of(self.cameras, name)}"
                )
        count = 0
        for step in self.read(tuple(self.cameras if cameras is None else cameras)):
            yield step
            count += 1
        if count != self.length:
            raise RecorderError(
                f"episode '{self.episode_id}' has {count} steps, expected {self.length}", ErrorCode.BAG_DAMAGED
            )

    def actions(self) -> Floats:
        """Read all actions, float32, shape (T, D)."""
        return np.stack([step.action for step in self.steps(())])

    def proprio(self) -> dict[str, Floats]:
        """Read all of the proprioception: field to float32, shape (T, size)."""
        steps = [step.proprio for step in self.steps(())]
        return {name: np.stack([values[name] for values in steps]) for name in steps[0]}
