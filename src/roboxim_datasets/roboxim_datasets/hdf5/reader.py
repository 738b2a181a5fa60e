"""Reads HDF5 datasets in robomimic's layout, RoboXim's and others'."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from roboxim_core.documents import read_json_object
from roboxim_core.errors import ConfigError, ErrorCode, RecorderError
from roboxim_datasets.dataset import Dataset, Description, Features
from roboxim_datasets.episode import EXECUTED, Episode, Floats, ImageSize, Step, Wanted
from roboxim_datasets.hdf5.layout import ATTRIBUTE, MASKS, STATISTICS_FILE, Hdf5Content

_SPLITS = {mask: split for split, mask in MASKS.items()}


_LOADING = """```python
from robomimic.utils.dataset import SequenceDataset  # robomimic 0.3
dataset = SequenceDataset(
    "{file}", obs_keys={low} + {rgb}, dataset_keys=["actions"], filter_by_attribute="train"
)
```

`dataset_statistics.json` holds mean, std, min, max and exact quantiles of actions and vectors.
"""


class Hdf5Dataset(Dataset):
    """A dataset. The file is opened for each episode and closed behind it."""

    format = "hdf5"

    def __init__(self, path: Path) -> None:
        """Open a dataset.

        Args:
            path: The HDF5 file, or the folder that holds it and no other one.

        Raises:
            RecorderError: When there is no such file, or it is damaged or of another layout.
        """
        files = [path] if path.is_file() else sorted([*path.glob("*.hdf5"), *path.glob("*.h5")])
        if len(files) != 1:
            raise RecorderError(f"{path} holds {len(files)} HDF5 files, expected one; name the file")
        super().__init__(path)
        self.file = files[0]
        with self._open() as file:
            if "data" not in file or not len(file["data"]):
                raise RecorderError(f"{self.file} has no episodes 'data/demo_0', ...; it is of another layout")
            data = file["data"]
            self._attributes = {name: _text(value) for name, value in data.attrs.items()}
            self._demos = _demos(file)
            first = data[next(demo for demos in self._demos.values() for demo in demos)]
            self.content = self._content(first)
            self._compression = next((first[key].compression for key in self.content.cameras), None)
            self._shapes = {key: tuple(first[key].shape[1:]) for key in self._keys(first)}

    def _open(self) -> Any:
        import h5py

        try:
            return h5py.File(self.file, "r")
        except OSError as error:
            raise RecorderError(f"cannot read {self.file}: {error}", ErrorCode.BAG_DAMAGED) from None

    def _content(self, demo: Any) -> Hdf5Content:
        if ATTRIBUTE in self._attributes:
            try:
                return Hdf5Content.from_json(json.loads(self._attributes[ATTRIBUTE]), str(self.file))
            except (ValueError, ConfigError) as error:
                raise RecorderError(
                    f"{self.file}: its description is damaged: {error}", ErrorCode.BAG_DAMAGED
                ) from None
        if "actions" not in demo:
            raise RecorderError(f"{self.file}: its episodes have no 'actions'; it is of another layout")
        observed = {f"obs/{name}": values for name, values in demo.get("obs", {}).items()}
        images = [key for key, values in observed.items() if values.ndim == 4 and values.dtype == np.uint8]
        return Hdf5Content(
            cameras={key: key.removeprefix("obs/").removesuffix("_image").removesuffix("_rgb") for key in images},
            vectors={k: k.removeprefix("obs/") for k, values in observed.items() if values.ndim == 2},
            fps=float(self._env_args.get("env_kwargs", {}).get("control_freq", 0.0)),
        )

    def _keys(self, demo: Any) -> list[str]:
        content = self.content
        return [*content.cameras, *content.vectors, *content.signals, "actions"]

    @property
    def splits(self) -> Mapping[str, int]:
        """Split to its number of episodes."""
        return {name: len(demos) for name, demos in self._demos.items() if demos}

    @cached_property
    def statistics(self) -> dict[str, Any]:
        """Statistics of actions and vectors; empty when the dataset has none.

        Raises:
            RecorderError: When the file cannot be read.
        """
        file = self.file.with_name(STATISTICS_FILE)
        try:
            return read_json_object(file) if file.is_file() else {}
        except ConfigError as error:
            raise RecorderError(str(error), ErrorCode.BAG_DAMAGED) from None

    def summaries(self) -> Mapping[str, Mapping[str, Sequence[float]]]:
        """Return the statistics of actions and observed vectors."""
        columns = {"actions": "action", **self.content.vectors}
        stored = {name: self.statistics[key] for key, name in columns.items() if key in self.statistics}
        return {name: value for name, value in stored.items() if isinstance(value, dict)}

    @property
    def options(self) -> Mapping[str, Any]:
        """Options with which a dataset like this one is written."""
        return {"compression": self._compression} if self._compression in ("lzf", "gzip") else {}

    @property
    def usage(self) -> str:
        """How the dataset is loaded."""
        state = [key.removeprefix("obs/") for key, name in self.content.vectors.items() if name == "state"]
        images = [key.removeprefix("obs/") for key in self.content.cameras]
        return _LOADING.format(file=self.file.name, low=state, rgb=images)

    @cached_property
    def description(self) -> Description:
        """What the attributes and the first episode say."""
        content = self.content
        sizes = {camera: self._shapes[key] for key, camera in content.cameras.items()}
        return Description(
            features=Features(
                cameras={camera: ImageSize(height=shape[0], width=shape[1]) for camera, shape in sizes.items()},
                keys={camera: key.removeprefix("obs/") for key, camera in content.cameras.items()},
                lossless=True,
                depth=tuple(content.depth.values()),
                segmentation=tuple(content.segmentation.values()),
                action=self._names("actions"),
                vectors={name: self._names(key) for key, name in content.vectors.items()},
                signals={name: self._names(key) for key, name in content.signals.items()},
            ),
            fps=content.fps,
            robot=content.robot,
            joint_names=content.joint_names,
            semantics=content.semantics,
        )

    def _names(self, key: str) -> tuple[str, ...]:
        count = int(np.prod(self._shapes[key]))
        last = key.rpartition("/")[2]
        return self.content.components.get(key) or tuple(f"{last}.{index}" for index in range(count))

    @cached_property
    def _env_args(self) -> dict[str, Any]:
        return _object(self._attributes.get("env_args", ""))

    def read(self, split: str, index: int) -> Episode:
        """Read an episode of a split; its steps are read on demand."""
        demo = self._demos[split][index]
        with self._open() as file:
            group = file["data"][demo]
            attributes = {name: _text(value) for name, value in group.attrs.items()}
            length = len(group["actions"])
            rewarded = "rewards" in group and length > 0 and bool(group["rewards"][-1] > 0)
        return self.description.episode(
            length=length,
            instruction=self._instruction(attributes),
            success=rewarded,
            said=_object(attributes.get(ATTRIBUTE, "")),
            read=lambda wanted: self._steps(demo, wanted),
        )

    def _instruction(self, attributes: Mapping[str, str]) -> str:
        """Return the instruction: RoboXim's, else robocasa's (``ep_meta``), else LIBERO's (``problem_info``)."""
        places = (
            attributes.get("instruction"),
            _object(attributes.get("ep_meta", "")).get("lang"),
            _object(self._attributes.get("problem_info", "")).get("language_instruction"),
        )
        return next((str(text) for text in places if text), "")

    def _steps(self, demo: str, wanted: Wanted) -> Iterator[Step]:
        content = self.content
        with self._open() as file:
            group = file["data"][demo]
            try:
                yield from self._read_steps(group, content, wanted)
            except (OSError, KeyError) as error:
                raise RecorderError(f"cannot read {demo} of {self.file}: {error}", ErrorCode.BAG_DAMAGED) from None

    def _read_steps(self, group: Any, content: Hdf5Content, wanted: Wanted) -> Iterator[Step]:
        def chosen(names: Mapping[str, str], cameras: tuple[str, ...]) -> dict[str, Any]:
            by_camera = {camera: key for key, camera in names.items()}
            return {camera: group[by_camera[camera]] for camera in cameras}

        def numbers(key: str) -> Floats:
            values = np.asarray(group[key][:], np.float32)
            return values.reshape(len(values), -1)

        images, depth = chosen(content.cameras, wanted.cameras), chosen(content.depth, wanted.depth)
        masks = chosen(content.segmentation, wanted.segmentation)
        actions = numbers("actions")
        rewards = numbers("rewards")[:, 0] if "rewards" in group else np.zeros(len(actions), np.float32)
        vectors = {name: numbers(key) for key, name in content.vectors.items()}
        signals = {name: numbers(key) for key, name in content.signals.items()}
        executed = signals.pop(EXECUTED, None)
        for index, action in enumerate(actions):
            yield Step(
                index=index,
                images={camera: values[index] for camera, values in images.items()},
                depth={camera: values[index][..., 0] for camera, values in depth.items()},
                segmentation={camera: values[index][..., 0] for camera, values in masks.items()},
                proprio={name: values[index] for name, values in vectors.items()},
                action=action,
                action_executed=None if executed is None else executed[index],
                signals={name: values[index] for name, values in signals.items()},
                reward=float(rewards[index]),
            )


def _demos(file: Any) -> dict[str, list[str]]:
    """Return split to the names of its episodes; without masks all are in ``train``."""
    names = sorted(file["data"], key=lambda name: (len(name), name))
    masks = file.get("mask", {})
    found: dict[str, list[str]] = {}
    for mask in masks:
        members = {_text(name) for name in masks[mask][:]}
        split = _SPLITS.get(mask, mask)
        if split in ("train", "val", "test"):
            found[split] = [name for name in names if name in members]
    order = {name: found[name] for name in ("train", "val", "test") if found.get(name)}
    return order or {"train": names}


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def _object(text: str) -> dict[str, Any]:
    """Return a JSON object; an empty one when the text is none."""
    try:
        value = json.loads(text)
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}
