"""An episode as plain values, independent of its storage: the type that readers return and writers take.

Step k holds observation k and the action that leads from it to observation k + 1; T actions make T steps. The small
fields are loaded at once. Steps are read on demand, one after another, so an episode needs the memory of one step.

A step's numbers have three kinds. ``proprio`` is observed: a policy may read it. ``action`` is the label. ``signals``
are further values that no trainer reads; their names start with ``sim.``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ActionSemantics
from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, RecorderError, one_of

Floats = npt.NDArray[np.float32]
RGBImage = npt.NDArray[np.uint8]
DepthImage = npt.NDArray[np.float32]
Segmentation = npt.NDArray[np.uint16]
MetaValue = str | int | float | bool
SIGNAL_PREFIX = "sim."
"""Prefix of the names of `Step.signals`."""
PART = "-part"
"""Separator between an episode's id and the number of a stretch of one actor (``--acted-by``)."""
EXECUTED = "sim.action_executed"
"""Name under which datasets store `Step.action_executed`."""


METADATA: Mapping[str, type[MetaValue]] = {
    "episode_id": str,
    "file_path": str,
    "run_seed": int,
    "index": int,
    "attempt": int,
    "skill": str,
    "success": bool,
    "actor": str,
    "robot": str,
    "action_semantics": str,
    "cameras": str,
    "state_layout": str,
    "joint_names": str,
    "vectors": str,
    "task": str,
    "final_state_hash": str,
}
"""Metadata of an episode that RoboXim writes, key to type, in every format that has metadata.

``file_path`` is the bag below the run's folder, ``index`` and ``attempt`` are the episode's in its run, ``task`` is the
task's JSON, and ``final_state_hash`` is the hash of the bag's last state. An `Episode` has some as separate fields;
those are JSON if they are not plain values: ``cameras`` (image key to camera), ``state_layout`` (names of the
components of ``state``), ``vectors`` (vector or signal to the names of its components), ``action_semantics``,
``joint_names``."""
BETWEEN_ROBOTS = "+"
"""What stands between the robots of a dataset of several, e.g. ``fr3+panda``; each of its episodes names its own."""
OWN_FIELDS = frozenset(
    ("episode_id", "success", "robot", "action_semantics", "cameras", "state_layout", "joint_names", "vectors")
)
"""Metadata that an `Episode` has as separate fields, so that they are not in `Episode.metadata`."""


@dataclass(frozen=True, kw_only=True)
class ImageSize:
    """Size of a camera's images."""

    height: int
    """Height [px]."""
    width: int
    """Width [px]."""


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """Images to read of an episode's steps besides the small arrays."""

    cameras: tuple[str, ...] = ()
    """Cameras whose RGB images to read."""
    depth: tuple[str, ...] = ()
    """Cameras whose depth images to read."""
    segmentation: tuple[str, ...] = ()
    """Cameras whose segmentation images to read."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Step:
    """One step."""

    index: int
    """Number of the step, from 0."""
    images: Mapping[str, RGBImage] = field(default_factory=dict)
    """Camera to RGB image, uint8, shape (height, width, 3), read-only; only the requested cameras."""
    encoded: Mapping[str, tuple[str, bytes]] = field(default_factory=dict)
    """Camera to encoding (``jpeg``, ``png``) and bytes of its image, if the dataset stores single images; a writer of
    the same encoding stores them unchanged, so copies lose nothing."""
    depth: Mapping[str, DepthImage] = field(default_factory=dict)
    """Camera to distance along the optical axis [m], float32, shape (height, width); only the requested cameras."""
    segmentation: Mapping[str, Segmentation] = field(default_factory=dict)
    """Camera to entity ids, uint16, shape (height, width); only the requested cameras."""
    proprio: Mapping[str, Floats] = field(default_factory=dict)
    """Observed vector to its values, float32; `Episode.vectors` names the components. The vector that trainers read by
    default is called ``state``. An episode that comes from a bag has one vector for each
    `roboxim_core.proprioception.ProprioField` instead."""
    action: Floats
    """Action that an imitator should output, float32, shape (D,); its meaning is in `Episode.semantics`."""
    action_executed: Floats | None = None
    """Executed action, of the same meaning as ``action``; differs from it where noise was injected. None: not stored.
    Datasets store it as ``sim.action_executed``, which trainers ignore."""
    signals: Mapping[str, Floats] = field(default_factory=dict)
    """Further vectors that no trainer reads, float32, shape (n,), by name; the names start with ``sim.``."""
    reward: float = 0.0
    """1 on the last step of a success, else 0."""
    instruction: str | None = None
    """Instruction of this step, where an episode has several; None: the episode's."""
    subtask: str | None = None
    """What is to be done at this step of a longer task, e.g. ``Open the top drawer``; None: not stated."""
    stamp_s: float | None = None
    """Time of the observation [s]; None: the format stores none. Writers do not take it, they count steps."""

    def vector(self, name: str) -> Floats:
        """Return an observed vector.

        Raises:
            InvalidRequestError: When the step has none of this name.
        """
        return _one_of(self.proprio, name)

    def signal(self, name: str) -> Floats:
        """Return a signal, `EXECUTED` included: a step that states no executed action executed its label.

        Raises:
            InvalidRequestError: When the step has none of this name.
        """
        if name == EXECUTED:
            return self.action if self.action_executed is None else self.action_executed
        return _one_of(self.signals, name)


def solved(rewards: npt.ArrayLike) -> bool | None:
    """Return whether rewards say that a task was solved; None: they do not say.

    Only rewards that are 0 before the end and 1 at it are known to mean it. Rewards that are all 0 can be those of a
    dataset that has none, and others are no verdict.
    """
    values = np.asarray(rewards, np.float64).reshape(-1)
    return True if len(values) and values[-1] == 1 and np.isin(values, (0, 1)).all() else None


def _one_of(vectors: Mapping[str, Floats], name: str) -> Floats:
    if name not in vectors:
        raise InvalidRequestError(
            f"an episode has no '{name}', which the dataset's description names; it has {sorted(vectors)}"
        )
    return vectors[name]


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
    """Natural language instruction; of an episode with several, that of its first step."""
    instructions: tuple[str, ...] = ()
    """All instructions of its steps in the order in which they first occur; empty: only ``instruction``."""
    subtasks: tuple[str, ...] = ()
    """All subtasks that its steps state; empty: they state none."""
    semantics: ActionSemantics | None
    """Meaning of the actions; None: the dataset does not say."""
    cameras: Mapping[str, ImageSize]
    """Camera to the size of its images."""
    success: bool | None
    """Whether the task was solved at the end; None: the dataset does not say."""
    robot: str = ""
    """Id of the robot model; empty: the dataset does not say."""
    joint_names: tuple[str, ...] = ()
    """Arm joints in the order of ``joint_positions``; empty: the dataset does not say."""
    fps: float = 0.0
    """Steps per second; 0: the dataset does not say."""
    vectors: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Name of each vector in `Step.proprio` to the names of its components, e.g. ``tcp.x``."""
    signals: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Name of each vector in `Step.signals` to the names of its components."""
    depth: tuple[str, ...] = ()
    """Cameras that have depth images."""
    segmentation: tuple[str, ...] = ()
    """Cameras that have segmentation images."""
    metadata: Mapping[str, MetaValue] = field(default_factory=dict)
    """Further metadata of the episode, by name; `METADATA` lists those that RoboXim writes."""
    read: Callable[[Wanted], Iterator[Step]] = field(repr=False)
    """Reads the steps; `steps` calls it."""

    def __len__(self) -> int:
        """Count the steps."""
        return self.length

    def steps(
        self, cameras: Collection[str] | None = None, *, depth: Collection[str] = (), segmentation: Collection[str] = ()
    ) -> Iterator[Step]:
        """Yield the steps in order.

        Args:
            cameras: Cameras whose images to read; None: all.
            depth: Cameras whose depth images to read.
            segmentation: Cameras whose segmentation images to read.

        Raises:
            InvalidRequestError: On a camera that the episode does not have, or that has no such images.
            RecorderError: With code ``BAG_DAMAGED`` when it cannot be read, or has more or fewer steps than it says, or
                an image or vector of another size.
        """
        chosen = tuple(self.cameras if cameras is None else cameras)
        self._require(chosen, self.cameras, "camera")
        self._require(depth, self.depth, "depth images of camera")
        self._require(segmentation, self.segmentation, "segmentation images of camera")
        count = 0
        for step in self.read(Wanted(cameras=chosen, depth=tuple(depth), segmentation=tuple(segmentation))):
            self._require_sizes(step)
            yield step
            count += 1
        if count != self.length:
            raise RecorderError(
                f"episode '{self.episode_id}' has {count} steps, expected {self.length}", ErrorCode.BAG_DAMAGED
            )

    def _require_sizes(self, step: Step) -> None:
        """Refuse a step whose images or vectors are not of the size that the episode says."""
        for camera, image in step.images.items():
            size = self.cameras[camera]
            if image.shape != (size.height, size.width, 3):
                raise self._wrong(step, f"camera '{camera}'", image.shape, (size.height, size.width, 3))
        for vectors, described in ((step.proprio, self.vectors), (step.signals, self.signals)):
            for name, values in vectors.items():
                if name in described and values.shape != (len(described[name]),):
                    raise self._wrong(step, f"'{name}'", values.shape, (len(described[name]),))

    def _wrong(self, step: Step, what: str, found: tuple[int, ...], expected: tuple[int, ...]) -> RecorderError:
        return RecorderError(
            f"episode '{self.episode_id}', step {step.index}: {what} has the shape {found}, expected {expected} as in "
            "the dataset's description; leave the episode out, or correct it",
            ErrorCode.BAG_DAMAGED,
        )

    def _require(self, names: Iterable[str], have: Iterable[str], what: str) -> None:
        for name in names:
            if name not in have:
                raise InvalidRequestError(f"episode '{self.episode_id}' has no {what} '{name}'; {one_of(have, name)}")

    def words(self, step: Step) -> str:
        """Return the instruction of a step; empty where another tool's dataset has none there."""
        return self.instruction if step.instruction is None else step.instruction

    def subtask(self, step: Step) -> str:
        """Return the subtask of a step as datasets that have subtasks store it: without one it is the instruction."""
        return step.subtask or self.words(step)

    def actions(self) -> Floats:
        """Read all actions, float32, shape (T, D)."""
        return np.stack([step.action for step in self.steps(())])

    def proprio(self) -> dict[str, Floats]:
        """Read all of the proprioception: name of a vector to float32, shape (T, size)."""
        steps = [step.proprio for step in self.steps(())]
        return {name: np.stack([values[name] for values in steps]) for name in steps[0]}

    def picker(self, names: Sequence[str]) -> Callable[[Step], Floats]:
        """Return a function that takes components of the proprioception by name, whichever vectors hold them.

        Args:
            names: Names of components, e.g. `roboxim_core.proprioception.STATE_NAMES`.

        Returns:
            Function of a step to a float32 vector with the components in this order.

        Raises:
            ConfigError: On a component that no vector of the episode holds.
        """
        at: dict[str, tuple[str, int]] = {}
        for vector, components in self.vectors.items():
            for index, component in enumerate(components):
                at.setdefault(component, (vector, index))
        for name in names:
            if name not in at:
                raise ConfigError(
                    f"episode '{self.episode_id}' has no proprioception '{name}'; {one_of(at, name)}; an export "
                    "with other fields has it (--state)"
                )
        places = [at[name] for name in names]
        return lambda step: np.array([step.proprio[vector][index] for vector, index in places], np.float32)


def with_words(episode: Episode, words: Sequence[tuple[str, str | None]]) -> Episode:
    """Return an episode with the instructions and subtasks that its steps state.

    Args:
        episode: The episode.
        words: Instruction and subtask of each step; a subtask of None: not stated.
    """
    instructions = tuple(dict.fromkeys(instruction for instruction, _ in words))
    return replace(
        episode, instruction=instructions[0], instructions=instructions if len(instructions) > 1 else (),
        subtasks=tuple(dict.fromkeys(subtask for _, subtask in words if subtask is not None)),
    )  # fmt: skip


def whole_id(episode_id: str) -> str:
    """Return the id of the complete episode from which an episode of a dataset may be a stretch of one actor."""
    name, _, number = episode_id.rpartition(PART)
    return name if name and number.isdecimal() else episode_id
