"""RLDS as a registered format: finds, opens and writes datasets."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from roboxim_core.errors import InvalidRequestError
from roboxim_datasets.dataset import Dataset, Description, Features
from roboxim_datasets.episode import METADATA, OWN_FIELDS, SIGNAL_PREFIX, Episode, MetaValue
from roboxim_datasets.registry import FORMATS
from roboxim_datasets.rlds.episodes import EncodedSteps, read_steps, to_rlds
from roboxim_datasets.rlds.format import META_NAMES, SUBTASK, RldsFeatures, encode_episode
from roboxim_datasets.rlds.loader_files import loader_files, statistics_of
from roboxim_datasets.rlds.reader import RldsDataset, find_rlds
from roboxim_datasets.rlds.writer import RldsWriter

OWN = {key: kind for key, kind in METADATA.items() if key in OWN_FIELDS}
"""Metadata that every episode has as separate fields, key to type."""


@dataclass(frozen=True, kw_only=True)
class RldsOptions:
    """Options of an RLDS dataset."""

    name: str = "roboxim"
    """Name of the dataset, lower case with underscores; never one that loaders treat specially, as ``bridge_*``."""
    version: str = "1.0.0"
    """Version of the dataset."""
    encoding: Literal["jpeg", "png"] = "jpeg"
    """Image encoding: ``jpeg`` (quality 95) or ``png`` (lossless)."""
    shard_mib: int = 128
    """Size of a shard [MiB]."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidRequestError: On a size out of range, or a name of another dataset's family.
        """
        if self.shard_mib < 1:
            raise InvalidRequestError(f"shard_mib must be at least 1, got {self.shard_mib}")
        if self.name.startswith("bridge"):
            raise InvalidRequestError("loaders rewrite the actions of datasets called bridge*; choose another name")


@dataclass(frozen=True, kw_only=True)
class RldsEncoder:
    """Encodes episodes as records of a dataset, also in another process."""

    described: Features
    """What the dataset's steps consist of."""
    features: RldsFeatures
    """The same, as RLDS stores it."""

    def __call__(self, episode: Episode) -> bytes:
        """Return an episode's record."""
        with ThreadPoolExecutor(1) as pool:
            return encode_episode(
                to_rlds(read_steps(episode, self.described, self.features, pool), self.described, self.features),
                self.features,
            )


class RldsDatasetWriter:
    """Writes episodes to an RLDS dataset.

    Non-obvious: an episode is written when the next one has been read, so that threads encode its images meanwhile.
    """

    def __init__(self, writer: RldsWriter, options: RldsOptions, description: Description, pool: Executor) -> None:
        """Write with threads that encode images."""
        self._writer, self._options, self._description, self._pool = writer, options, description, pool
        self._pending: tuple[str, EncodedSteps] | None = None

    def resumed(self, split: str) -> int:
        """Count the episodes of a split that finished shards already hold."""
        return self._writer.resumed(split)

    def add(self, split: str, episode: Episode) -> None:
        """Append an episode."""
        read = read_steps(episode, self._description.features, self._writer.features, self._pool)
        self._write_pending()
        self._pending = split, read

    @property
    def encoder(self) -> RldsEncoder:
        """What encodes an episode in another process."""
        return RldsEncoder(described=self._description.features, features=self._writer.features)

    def add_encoded(self, split: str, data: bytes) -> None:
        """Append an episode that the encoder has encoded."""
        self._write_pending()
        self._writer.add_encoded(split, data)

    def _write_pending(self) -> None:
        if self._pending is not None:
            split, read = self._pending
            self._pending = None
            self._writer.add(split, to_rlds(read, self._description.features, self._writer.features))

    def complete(self, files: Mapping[str, str | bytes]) -> None:
        """Add the statistics and loader files, and move the dataset to its final place."""
        self._write_pending()
        self._writer.finish_shards()
        features = self._writer.features
        first = next(iter(self._writer.splits), "")
        statistics = statistics_of(self._writer.shard_files(first), features, self._description.features.action)
        own = loader_files(self._options.name, features, statistics)
        self._writer.complete({**own, **files})


@FORMATS.register("rlds")
class RldsFormat:
    """RLDS: TensorFlow Datasets, Octo, OpenVLA."""

    options = RldsOptions
    maps = False  # of depth and segmentation
    own_metadata = False  # of single episodes: all have the same keys
    copies_images = True  # of another dataset of the format, if both have the same encoding

    def find(self, path: Path) -> list[Path]:
        """Return the datasets that a path is or that the folder holds."""
        return find_rlds(path)

    def open(self, path: Path) -> Dataset:
        """Open a dataset."""
        return RldsDataset(path)

    def path(self, target: Path, options: RldsOptions) -> Path:
        """Return ``target/name/version``."""
        return target / options.name / options.version

    @contextmanager
    def create(
        self, target: Path, description: Description, options: RldsOptions, *, identity: str, overwrite: bool
    ) -> Iterator[RldsDatasetWriter]:
        """Start a dataset, or continue an interrupted one.

        Raises:
            InvalidRequestError: On features that RLDS does not hold: depth and segmentation images.
        """
        found = description.features
        if found.depth or found.segmentation:
            raise InvalidRequestError(
                "the RLDS export holds colour images only; leave depth and segmentation out, or export another format"
            )
        own: dict[str, type[MetaValue]] = dict(OWN)
        if not description.outcomes:
            del own["success"]
            own["outcome"] = str
        if description.fps and (description.semantics is None or description.semantics.rate_hz != description.fps):
            own["fps"] = float
        features = RldsFeatures(
            images={found.keys[camera]: (size.height, size.width) for camera, size in found.cameras.items()},
            encoding=options.encoding,
            metadata={key: META_NAMES[kind] for key, kind in {**description.metadata, **own}.items()},
            vectors={name: len(names) for name, names in found.vectors.items()},
            signals={name.removeprefix(SIGNAL_PREFIX): len(names) for name, names in found.signals.items()},
            action={"steps/action": len(found.action)},
            subtask=SUBTASK if found.subtasks else "",
        )
        writer = RldsWriter(
            target,
            features,
            name=options.name,
            version=options.version,
            description=description.text,
            names={**found.vectors, **{k.removeprefix(SIGNAL_PREFIX): names for k, names in found.signals.items()}},
            identity=identity,
            overwrite=overwrite,
            shard_bytes=options.shard_mib << 20,
        )
        with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:  # encoders release the interpreter's lock
            yield RldsDatasetWriter(writer, options, description, pool)
