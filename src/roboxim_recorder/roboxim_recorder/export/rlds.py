"""Exports bags as an RLDS dataset, without TensorFlow; `roboxim_datasets.rlds` writes the files."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from roboxim_core.config import digest as digest_of
from roboxim_core.errors import InvalidRequestError
from roboxim_datasets.episode import Episode
from roboxim_datasets.rlds import RldsFeatures, RldsReader, RldsWriter
from roboxim_datasets.rlds.episodes import METADATA, to_rlds
from roboxim_datasets.rlds.loader_files import action_statistics, dead_dimensions, loader_files, statistics_of
from roboxim_recorder.export.registry import EXPORTERS, DatasetContents
from roboxim_recorder.export.run import ExportReport, Progress, export_bags
from roboxim_recorder.export.selection import Selected, Selection


@dataclass(frozen=True, kw_only=True)
class ExportConfig(Selection):
    """Configuration of an RLDS export."""

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
            InvalidRequestError: On a fraction or size out of range, or a name of another dataset's family.
        """
        super().__post_init__()
        if self.shard_mib < 1:
            raise InvalidRequestError(f"shard_mib must be at least 1, got {self.shard_mib}")
        if self.name.startswith("bridge"):
            raise InvalidRequestError("loaders rewrite the actions of datasets called bridge*; choose another name")


class _Writer:
    """Writes episodes to an RLDS dataset."""

    def __init__(
        self, writer: RldsWriter, config: ExportConfig, selected: Selected, features: RldsFeatures, pool: Executor
    ) -> None:
        self._writer, self._config, self._selected = writer, config, selected
        self._features, self._pool = features, pool

    def resumed(self, split: str) -> int:
        """Count the episodes of a split that finished shards already hold."""
        return self._writer.resumed(split)

    def add(self, split: str, episode: Episode) -> None:
        """Append an episode."""
        resize = bool(self._config.image_height)
        self._writer.add(split, to_rlds(episode, self._selected.keys, self._features, self._pool, resize=resize))

    def complete(self, files: Mapping[str, str]) -> None:
        """Add the statistics and loader files, and move the dataset to its final place."""
        config = self._config
        self._writer.finish_shards()
        statistics = statistics_of(self._writer.shard_files("train"), self._features)
        own = loader_files(config.name, config.version, self._features, self._selected.semantics, statistics)
        self._writer.complete({**own, **files})


@EXPORTERS.register("rlds")
class RldsExporter:
    """Export the bags of a run as RLDS, loadable by TensorFlow Datasets, Octo and OpenVLA; needs no TensorFlow."""

    config = ExportConfig

    def path(self, target: Path, config: ExportConfig) -> Path:
        """Return ``target/name/version``."""
        return target / config.name / config.version

    @contextmanager
    def open(
        self, target: Path, config: ExportConfig, selected: Selected, *, identity: str, overwrite: bool
    ) -> Iterator[_Writer]:
        """Start a dataset, or continue an interrupted one."""
        sizes = {selected.keys[camera]: (size.height, size.width) for camera, size in selected.sizes.items()}
        features = RldsFeatures(
            images=sizes,
            encoding=config.encoding,
            metadata=METADATA,
            joints=len(selected.joint_names),
        )
        writer = RldsWriter(
            target,
            features,
            name=config.name,
            version=config.version,
            description=_describe(selected),
            identity=f"{identity} {digest_of(METADATA)}",
            overwrite=overwrite,
            shard_bytes=config.shard_mib << 20,
        )
        with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:  # encoders release the interpreter's lock
            yield _Writer(writer, config, selected, features, pool)

    def contents(self, path: Path) -> DatasetContents:
        """Read the description and the statistics of a dataset."""
        reader = RldsReader(path)
        statistics = action_statistics(path)
        return DatasetContents(
            splits={split: sum(lengths) for split, lengths in reader.splits.items()},
            dead_dimensions=dead_dimensions(statistics),
        )


def export_rlds(
    source: Path | str,
    target: Path | str,
    config: ExportConfig | None = None,
    *,
    if_exists: Literal["refuse", "overwrite", "keep"] = "refuse",
    progress: Progress = lambda done, total: None,
) -> ExportReport:
    """Export bags as RLDS; see `export_bags`."""
    return export_bags("rlds", source, target, config, if_exists=if_exists, progress=progress)


def _describe(selected: Selected) -> str:
    semantics = selected.semantics
    skills = ", ".join(sorted({source.info.task.skill for source in selected.sources}))
    return (
        f"{len(selected.sources)} simulated episodes recorded with RoboXim; robot: {selected.robot}; skills: {skills}; "
        f"{semantics.rate_hz:g} Hz; actions: {semantics.control} in {semantics.frame}, {semantics.rotation}, "
        f"gripper {semantics.gripper}."
    )
