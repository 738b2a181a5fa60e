"""Writes an HDF5 dataset: atomic, resumable, the same bytes for the same episodes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from roboxim_core.errors import InvalidRequestError
from roboxim_datasets.build import ResumableBuild, write_files
from roboxim_datasets.dataset import Description
from roboxim_datasets.episode import Episode, Step
from roboxim_datasets.hdf5.disk import new_file
from roboxim_datasets.hdf5.layout import (
    ATTRIBUTE,
    FILE,
    INSTRUCTIONS,
    MASKS,
    STATISTICS_FILE,
    SUBTASKS,
    Hdf5Options,
    content_of,
)
from roboxim_datasets.statistics import VectorStatistics

_GYM = 2  # robomimic's number of the kind of environment


class Hdf5Writer:
    """Writes a dataset.

    Each episode is first written to its own file, so a killed export loses none; the files are joined at the end.
    """

    def __init__(
        self, path: Path, description: Description, options: Hdf5Options, *, identity: str = "", overwrite: bool = False
    ) -> None:
        """Start a dataset, or continue an interrupted one of the same identity.

        Args:
            path: Folder of the dataset.
            description: What its episodes have.
            options: Options.
            identity: Distinguishes this build from others; empty: never resumed.
            overwrite: Whether an existing dataset is replaced at the end.

        Raises:
            RecorderError: With code ``EXPORT_REFUSED`` when the folder exists and must stay.
        """
        self._description, self.content = description, content_of(description)
        self._compression = None if options.compression == "none" else options.compression
        self._build = ResumableBuild(path, identity=identity, overwrite=overwrite, marker=FILE)

    def resumed(self, split: str) -> int:
        """Return the number of episodes of a split that an interrupted build has written."""
        return self._build.resumed(split)

    def add(self, split: str, episode: Episode) -> None:
        """Append an episode to a split.

        Raises:
            InvalidRequestError: When the episode lacks what the description names.
            RecorderError: When it cannot be read.
            OSError: When the disk is full.
        """
        number = self.resumed(split)
        piece = self._build.piece(split, number, "demo.hdf5")
        with new_file(piece) as file:
            self._write(file.create_group("demo"), episode)
        self._build.commit({"split": split, "number": number, "length": episode.length})

    def _write(self, group: Any, episode: Episode) -> None:
        content, length = self.content, episode.length
        group.require_group("obs")  # also without any observation
        group.attrs["num_samples"] = length
        if "\0" in episode.instruction:
            raise InvalidRequestError(
                f"episode '{episode.episode_id}': the instruction {episode.instruction!r} has a NUL character, which "
                "an HDF5 text cannot hold; correct it in the source, or write another format"
            )
        group.attrs["instruction"] = episode.instruction
        group.attrs["ep_meta"] = json.dumps({"lang": episode.instruction})  # as robocasa says it
        attached: dict[str, Any] = {
            "episode_id": episode.episode_id, "success": episode.success, "metadata": dict(episode.metadata)
        }  # fmt: skip
        if episode.robot != self._description.robot:
            attached["robot"] = episode.robot
        if episode.instructions:
            attached["instructions"] = list(episode.instructions)
        subtasks = list(dict.fromkeys([*episode.subtasks, *(episode.instructions or [episode.instruction])]))
        if content.subtasks:
            attached["subtasks"] = subtasks
        group.attrs[ATTRIBUTE] = json.dumps(attached)
        if not length:
            raise InvalidRequestError(f"episode '{episode.episode_id}' has no steps; leave it out")
        images = {key: self._images(group, key, camera, length) for key, camera in content.cameras.items()}
        depth = {key: self._map(group, key, c, length, "float32") for key, c in content.depth.items()}
        masks = {key: self._map(group, key, c, length, "uint16") for key, c in content.segmentation.items()}
        rows: dict[str, list[Any]] = {key: [] for key in (*content.components, "rewards")}
        indices: list[int] = []
        at_hand: list[int] = []
        maps = {"depth": content.depth.values(), "segmentation": content.segmentation.values()}
        for step in episode.steps(content.cameras.values(), **maps):
            for key, values in self._numbers(step).items():
                rows[key].append(values)
            if episode.instructions:
                indices.append(episode.instructions.index(episode.words(step)))
            if content.subtasks:
                at_hand.append(subtasks.index(episode.subtask(step)))
            for key, dataset in images.items():
                dataset[step.index] = step.images[content.cameras[key]]
            for key, dataset in depth.items():
                dataset[step.index] = step.depth[content.depth[key]][..., None]
            for key, dataset in masks.items():
                dataset[step.index] = step.segmentation[content.segmentation[key]][..., None]
        for key, collected in rows.items():
            group.create_dataset(key, data=self._checked(key, np.array(collected, np.float32)))
        if indices:
            group.create_dataset(INSTRUCTIONS, data=np.array(indices, np.int64))
        if at_hand:
            group.create_dataset(SUBTASKS, data=np.array(at_hand, np.int64))
        group.create_dataset("dones", data=np.eye(length, dtype=np.int64)[-1])

    def _numbers(self, step: Step) -> dict[str, Any]:
        content = self.content
        found: dict[str, Any] = {"actions": step.action, "rewards": step.reward}
        found |= {key: step.vector(name) for key, name in content.vectors.items()}
        found |= {key: step.signal(name) for key, name in content.signals.items()}
        return found

    def _checked(self, key: str, values: Any) -> Any:
        names = self.content.components.get(key)
        if (names is not None and values.shape[1:] != (len(names),)) or not np.isfinite(values).all():
            raise InvalidRequestError(f"'{key}' must be finite numbers for {names}, got shape {values.shape}")
        return values

    def _images(self, group: Any, key: str, camera: str, length: int) -> Any:
        size = self._description.features.cameras[camera]
        return self._dataset(group, key, (length, size.height, size.width, 3), "uint8")

    def _map(self, group: Any, key: str, camera: str, length: int, dtype: str) -> Any:
        size = self._description.features.cameras[camera]
        return self._dataset(group, key, (length, size.height, size.width, 1), dtype)

    def _dataset(self, group: Any, key: str, shape: tuple[int, ...], dtype: str) -> Any:
        return group.create_dataset(key, shape, dtype, chunks=(1, *shape[1:]), compression=self._compression)

    def complete(self, files: Mapping[str, str | bytes]) -> None:
        """Join the episodes and move the dataset to its final place.

        Args:
            files: Further files by name, e.g. a README.

        Raises:
            RecorderError: ``EXPORT_REFUSED`` when there is no episode.
            OSError: When the disk is full.
        """
        import h5py

        build = self._build
        splits = build.split_entries()
        build.staged.mkdir()
        content = self.content
        statistics = {key: VectorStatistics(len(names)) for key, names in content.components.items()}
        total = 0
        with new_file(build.staged / FILE) as file:
            data = file.create_group("data")
            demo = 0
            for split, entries in splits.items():
                names = []
                for entry in entries:
                    names.append(f"demo_{demo}")
                    with h5py.File(build.piece(split, entry["number"], "demo.hdf5"), "r") as piece:
                        piece.copy("demo", data, names[-1])
                        _add_next_observations(data[names[-1]])
                        for key, of in statistics.items():
                            of.add(piece["demo"][key][:])
                    demo, total = demo + 1, total + entry["length"]
                file.create_dataset(f"mask/{MASKS.get(split, split)}", data=np.array(names, "S"))
            data.attrs["total"] = total
            data.attrs["env_args"] = json.dumps({"env_name": "roboxim", "type": _GYM, "env_kwargs": {}})
            data.attrs[ATTRIBUTE] = json.dumps(content.to_json())
        summary = {key: {n: v.tolist() for n, v in of.summary().items()} for key, of in statistics.items()}
        write_files(build.staged, {STATISTICS_FILE: json.dumps(summary, indent=2) + "\n", **files})
        build.finish()


def _add_next_observations(demo: Any) -> None:
    """Add ``next_obs``: ``obs`` one step ahead, the last one twice. It is a view, so no image is stored twice.

    Non-obvious: h5py's own function for views stores the time of writing, which differs between two exports.
    """
    import h5py

    views = demo.create_group("next_obs")
    for name, values in demo["obs"].items():
        count, shape = len(values), values.shape

        def rows(first: int, number: int, shape: tuple[int, ...] = shape) -> Any:
            space = h5py.h5s.create_simple(shape)
            space.select_hyperslab((first, *(0 for _ in shape[1:])), (number, *shape[1:]))
            return space

        settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        settings.set_obj_track_times(False)
        source = (b".", values.name.encode())  # in this file
        if count > 1:
            settings.set_virtual(rows(0, count - 1), *source, rows(1, count - 1))
        settings.set_virtual(rows(count - 1, 1), *source, rows(count - 1, 1))
        h5py.h5d.create(views.id, name.encode(), values.id.get_type(), h5py.h5s.create_simple(shape), settings)
