"""Maps the parts of an `Episode` to a LeRobot dataset, and the file that stores this mapping."""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from roboxim_core.actions import ActionSemantics
from roboxim_core.config import from_plain, to_plain
from roboxim_core.errors import InvalidRequestError
from roboxim_datasets.dataset import Description
from roboxim_datasets.episode import SIGNAL_PREFIX
from roboxim_datasets.lerobot.layout import NAMES, Column, LeRobotLayout, LeRobotNames, Version
from roboxim_datasets.rlds.episodes import USUAL_KEYS

Codec = Literal["h264", "h264-444", "hevc", "av1"]


@dataclass(frozen=True, kw_only=True)
class LeRobotOptions:
    """Options of a LeRobot dataset."""

    version: Version = "3.0"
    """Version of the format: 3.0 for lerobot 0.4 and newer, 2.1 for openpi and GR00T."""
    columns: Literal["lerobot", "groot", "openpi"] = "lerobot"
    """Trainer whose column names are used: observation.state, observation.images.CAMERA and action; openpi: state,
    image, wrist_image and actions."""
    codec: Codec = "h264"
    """Video codec; every trainer reads h264."""
    images: bool = False
    """Store PNG images in the data files instead of videos: lossless, about ten times larger."""
    data_file_mib: int = 100
    """Size at which a data file is finished [MiB]; only for version 3.0."""
    video_file_mib: int = 200
    """Size at which a video file is finished [MiB]; only for version 3.0."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidRequestError: On a size out of range, or options that GR00T cannot read.
        """
        if min(self.data_file_mib, self.video_file_mib) < 1:
            raise InvalidRequestError("data_file_mib and video_file_mib must be at least 1")
        if self.columns == "groot" and (self.version != "2.1" or self.images):
            raise InvalidRequestError("GR00T reads version 2.1 with videos; give --version 2.1, and no --images")


@dataclass(frozen=True, kw_only=True)
class LeRobotContent:
    """Where the parts of an `Episode` are."""

    names: LeRobotNames = LeRobotNames()
    """Names of state, action, reward and end."""
    cameras: Mapping[str, str]
    """Column of a camera's images to the camera."""
    depth: Mapping[str, str]
    """Column of a camera's depth images to the camera."""
    segmentation: Mapping[str, str]
    """Column of a camera's segmentation images to the camera."""
    vectors: Mapping[str, str]
    """Column to the observed vector (`Step.proprio`) that it holds."""
    signals: Mapping[str, str]
    """Column to the signal (`Step.signals`) that it holds; `EXECUTED` is among them."""
    outcomes: bool = True
    """Whether every episode says if it solved its task."""
    semantics: ActionSemantics | None = None
    """Meaning of the actions; None: unknown."""
    joint_names: tuple[str, ...] = ()
    """Arm joints of the robot."""
    parts: Mapping[str, Mapping[str, tuple[int, int]]] = field(default_factory=dict)
    """``state`` and ``action`` to names of ranges of their components (start, end); empty: they have no names."""
    views: Mapping[str, str] = field(default_factory=dict)
    """Column of a camera's images to the name of the view in GR00T's modality file; empty: the camera."""

    def to_json(self) -> dict[str, Any]:
        """Return the content of ``meta/roboxim.json``."""
        plain: dict[str, Any] = to_plain(self)
        return {"format": 1, **plain}

    @staticmethod
    def from_json(data: Mapping[str, Any], source: str) -> LeRobotContent:
        """Read the content of ``meta/roboxim.json``.

        Raises:
            ConfigError: When it cannot be read.
        """
        return from_plain({k: v for k, v in data.items() if k != "format"}, LeRobotContent, source=source)


def content_of(description: Description, options: LeRobotOptions) -> LeRobotContent:
    """Return where the parts of a dataset's episodes go.

    Beside a vector ``state`` the other observed vectors go to ``sim.``..., because policies take every column that
    starts with ``observation`` as an input.
    """
    features, names = description.features, NAMES[options.columns]
    return LeRobotContent(
        names=names,
        cameras={_camera_column(names, camera, features.keys[camera]): camera for camera in features.cameras},
        depth={f"{SIGNAL_PREFIX}depth.{camera}": camera for camera in features.depth},
        segmentation={f"{SIGNAL_PREFIX}segmentation.{camera}": camera for camera in features.segmentation},
        vectors={_vector_column(names, name, features.vectors): name for name in features.vectors},
        signals={name: name for name in features.signals},
        outcomes=description.outcomes,
        semantics=description.semantics,
        joint_names=description.joint_names,
        parts=description.parts,
        views={_camera_column(names, camera, key): key for camera, key in features.keys.items() if description.parts},
    )


def _vector_column(names: LeRobotNames, name: str, vectors: Container[str]) -> str:
    if name == "state":
        return names.state
    if "state" in vectors:
        return f"{SIGNAL_PREFIX}{name}"
    return names.state.replace("state", name)


def _camera_column(names: LeRobotNames, camera: str, key: str) -> str:
    """Return the column of a camera: as the trainer's names say, unless the user chose another key.

    The format forbids slashes, which the keys of a policy's requests may have.
    """
    key = key.replace("/", ".")
    if "." in key or "{camera}" not in names.camera:
        return key
    return names.camera.format(camera=camera if key == USUAL_KEYS.get(camera, camera) else key)


def layout_of(description: Description, content: LeRobotContent, options: LeRobotOptions) -> LeRobotLayout:
    """Return the layout of a dataset.

    Raises:
        InvalidRequestError: On a rate that is not a whole number, or images that the codec does not support.
    """
    features, fps = description.features, round(description.fps)
    if not description.fps:
        raise InvalidRequestError(
            "the steps per second of the episodes are unknown, but a LeRobot dataset needs them: give e.g. --fps 10"
        )
    if fps < 1 or fps != description.fps:
        raise InvalidRequestError(
            f"a LeRobot dataset has a whole number of steps per second, got {description.fps:g}; export at another rate"
        )
    names = content.names
    return LeRobotLayout(
        version=options.version,
        fps=fps,
        robot_type=description.robot,
        cameras={key: features.cameras[camera] for key, camera in content.cameras.items()},
        depth={key: features.cameras[camera] for key, camera in {**content.depth, **content.segmentation}.items()},
        columns={
            **{key: Column(names=features.vectors[vector]) for key, vector in content.vectors.items()},
            names.action: Column(names=features.action),
            names.reward: Column(),
            names.done: Column(dtype="bool"),
            **{key: Column(names=features.signals[signal]) for key, signal in content.signals.items()},
        },
        subtasks=features.subtasks,
        codec="" if options.images else options.codec,
        data_file_bytes=options.data_file_mib << 20,
        video_file_bytes=options.video_file_mib << 20,
    )
