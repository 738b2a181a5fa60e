"""Names in an HDF5 dataset, and the options for writing one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from roboxim_core.actions import ActionSemantics
from roboxim_core.config import from_plain, to_plain
from roboxim_datasets.dataset import Description
from roboxim_datasets.rlds.episodes import USUAL_KEYS

FILE = "dataset.hdf5"
"""The file in a dataset's folder."""
STATISTICS_FILE = "dataset_statistics.json"
"""File beside it with the statistics of actions and vectors."""
MASKS: Mapping[str, str] = {"train": "train", "val": "valid"}
"""Split to robomimic's name of its mask; other splits keep their names."""
INSTRUCTIONS = "instruction_index"
"""Number of each step's instruction in the episode's list, where it has several."""
SUBTASKS = "subtask_index"
"""Number of each step's subtask in the episode's list, in datasets whose steps state them."""
ATTRIBUTE = "roboxim"
"""Attribute of ``data`` and of each episode with facts that the layout has no place for, JSON."""


@dataclass(frozen=True, kw_only=True)
class Hdf5Options:
    """Options of an HDF5 dataset."""

    compression: Literal["lzf", "gzip", "none"] = "lzf"
    """Lossless compression of images: lzf is fast, gzip is smaller and read by every HDF5 library."""


@dataclass(frozen=True, kw_only=True)
class Hdf5Content:
    """Where the parts of an `Episode` are: names below ``data/demo_N``."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("subtasks",)

    cameras: Mapping[str, str]
    """Name of a camera's images to the camera."""
    depth: Mapping[str, str] = field(default_factory=dict)
    """Name of a camera's depth images to the camera."""
    segmentation: Mapping[str, str] = field(default_factory=dict)
    """Name of a camera's segmentation images to the camera."""
    vectors: Mapping[str, str]
    """Name to the observed vector that it holds."""
    signals: Mapping[str, str] = field(default_factory=dict)
    """Name to the signal that it holds."""
    components: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Name of a vector, or ``actions``, to the names of its components; without them they are numbered."""
    subtasks: bool = False
    """Whether each step states its subtask."""
    outcomes: bool = True
    """Whether every episode says if it solved its task."""
    fps: float = 0.0
    """Steps per second; 0: unknown."""
    robot: str = ""
    """Id of the robot model; empty: unknown."""
    joint_names: tuple[str, ...] = ()
    """Arm joints of the robot."""
    semantics: ActionSemantics | None = None
    """Meaning of the actions; None: unknown."""

    def to_json(self) -> dict[str, Any]:
        """Return plain data that `from_json` reads."""
        plain: dict[str, Any] = to_plain(self)
        return plain

    @staticmethod
    def from_json(data: Mapping[str, Any], source: str) -> Hdf5Content:
        """Read what `to_json` returned.

        Raises:
            ConfigError: When it cannot be read.
        """
        return from_plain(dict(data), Hdf5Content, source=source)


def content_of(description: Description) -> Hdf5Content:
    """Return where the parts of a dataset's episodes go."""
    features = description.features
    images = {f"obs/{_image_name(camera, features.keys[camera])}": camera for camera in features.cameras}
    vectors = {f"obs/{name.replace('/', '.')}": name for name in features.vectors}
    return Hdf5Content(
        cameras=images,
        depth={f"obs/{camera.replace('/', '.')}_depth": camera for camera in features.depth},
        segmentation={f"obs/{camera.replace('/', '.')}_segmentation": camera for camera in features.segmentation},
        vectors=vectors,
        signals={name: name for name in features.signals},
        components={
            "actions": features.action,
            **{key: features.vectors[name] for key, name in vectors.items()},
            **features.signals,
        },
        subtasks=features.subtasks,
        outcomes=description.outcomes,
        fps=description.fps,
        robot=description.robot,
        joint_names=description.joint_names,
        semantics=description.semantics,
    )


def _image_name(camera: str, key: str) -> str:
    """Return the name of a camera's images: as robosuite calls them, unless the user chose another key."""
    return f"{camera.replace('/', '.')}_image" if key == USUAL_KEYS.get(camera, camera) else key.replace("/", "_")
