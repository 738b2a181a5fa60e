"""Writes a dataset in the RLDS format: sharded, atomic, resumable, the same bytes for the same episodes.

A dataset is built beside its final place (`roboxim_datasets.build`). An interrupted build continues after its last
finished shard.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from roboxim_core.errors import InvalidRequestError
from roboxim_datasets.build import ResumableBuild, link, write_files
from roboxim_datasets.dataset import in_order
from roboxim_datasets.rlds.format import (
    FEATURES_FILE,
    INFO_FILE,
    RldsEpisode,
    RldsFeatures,
    encode_episode,
    features_to_json,
)
from roboxim_datasets.rlds.tfrecord import write_record

_SHARD = "records"


class RldsWriter:
    """Writes a dataset; a context manager that completes it on a clean exit, else leaves it resumable.

    Non-obvious: after an interruption the next writer of the same ``identity`` keeps the finished shards; the
    caller skips the first ``resumed(split)`` episodes of each split. Another identity starts afresh.
    """

    def __init__(
        self,
        folder: Path,
        features: RldsFeatures,
        *,
        name: str,
        version: str,
        description: str,
        names: Mapping[str, tuple[str, ...]] | None = None,
        identity: str = "",
        overwrite: bool = False,
        shard_bytes: int = 128 << 20,
    ) -> None:
        """Start a dataset, or continue an interrupted one of the same identity.

        Args:
            folder: Data directory; the dataset is written to ``folder/name/version``.
            features: Features of the episodes.
            name: Name of the dataset, lower case with underscores.
            version: ``major.minor.patch``.
            description: For ``dataset_info.json``.
            names: Observed vector or signal to the names of its components, for ``features.json``.
            identity: Distinguishes this build from others; empty: never resumed.
            overwrite: Whether an existing dataset of this name and version is replaced at the end.
            shard_bytes: Size at which a shard is finished [B].

        Raises:
            InvalidRequestError: On a name or version that TensorFlow Datasets does not accept.
            RecorderError: With code ``EXPORT_REFUSED`` when the dataset exists.
        """
        if not name.isidentifier() or name != name.lower():
            raise InvalidRequestError(f"a dataset's name must be lower case with underscores, got '{name}'")
        if [part for part in version.split(".") if part.isdigit()] != version.split(".") or version.count(".") != 2:
            raise InvalidRequestError(f"a dataset's version must be like 1.0.0, got '{version}'")
        self.path = folder / name / version
        self.features, self.name, self.version, self.description = features, name, version, description
        self._names = dict(names or {})
        self._shard_bytes = shard_bytes
        self._build = ResumableBuild(self.path, identity=identity, overwrite=overwrite, marker=INFO_FILE)
        self._pending: dict[str, list[bytes]] = {}
        self._complete = False

    def resumed(self, split: str) -> int:
        """Return the number of episodes of a split in the finished shards of an interrupted build."""
        return self._build.resumed(split)

    def add(self, split: str, episode: RldsEpisode) -> None:
        """Append an episode to a split (``train`` or ``val``: the names that loaders look for).

        Raises:
            InvalidRequestError: When the episode does not fit the features.
            OSError: When the disk is full.
        """
        self.add_encoded(split, encode_episode(episode, self.features))

    def add_encoded(self, split: str, payload: bytes) -> None:
        """Append an episode that `roboxim_datasets.rlds.format.encode_episode` has serialised.

        Raises:
            OSError: When the disk is full.
        """
        pending = self._pending.setdefault(split, [])
        pending.append(payload)
        if sum(map(len, pending)) >= self._shard_bytes:
            self._finish_shard(split)

    def _finish_shard(self, split: str) -> None:
        payloads = self._pending.pop(split, [])
        if not payloads:
            return
        number = sum(entry["split"] == split for entry in self._build.entries)
        with self._build.piece(split, number, _SHARD).open("wb") as file:
            for payload in payloads:
                write_record(file, payload)
        self._build.commit(
            {"split": split, "number": number, "episodes": len(payloads), "bytes": sum(map(len, payloads))}
        )

    def finish_shards(self) -> None:
        """Write the pending records, so that the shards can be read back before the dataset is completed."""
        for split in list(self._pending):
            self._finish_shard(split)

    @property
    def splits(self) -> list[str]:
        """The splits that have a finished shard, in the order in which the dataset lists them."""
        return in_order({of["split"] for of in self._build.entries})

    def shard_files(self, split: str) -> list[Path]:
        """Return the finished shards of a split."""
        entries = self._build.entries
        return [self._build.piece(split, of["number"], _SHARD) for of in entries if of["split"] == split]

    def complete(self, files: Mapping[str, str | bytes] | None = None) -> Path:
        """Finish the dataset and move it to its final place.

        Args:
            files: Further files by name, e.g. a README.

        Returns:
            The dataset's folder.
        """
        self.finish_shards()
        build = self._build
        found = build.split_entries()
        build.staged.mkdir()
        splits = []
        for split in self.splits:
            shards = found[split]
            for index, file in enumerate(self.shard_files(split)):
                link(file, build.staged / f"{self.name}-{split}.tfrecord-{index:05d}-of-{len(shards):05d}")
            splits.append(
                {
                    "filepathTemplate": "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}",
                    "name": split,
                    "numBytes": str(sum(shard["bytes"] for shard in shards)),
                    "shardLengths": [str(shard["episodes"]) for shard in shards],
                }
            )
        info = {
            "description": self.description,
            "fileFormat": "tfrecord",
            "name": self.name,
            "releaseNotes": {self.version: "Exported by RoboXim."},
            "splits": splits,
            "version": self.version,
        }
        described = {FEATURES_FILE: features_to_json(self.features, self._names), INFO_FILE: info}
        texts = {name: json.dumps(data, indent=2) + "\n" for name, data in described.items()}
        write_files(build.staged, {**texts, **(files or {})})
        build.finish()
        self._complete = True
        return self.path

    def __enter__(self) -> RldsWriter:
        """Return the writer."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """Complete the dataset, unless an exception is propagating or it is complete."""
        if kind is None and not self._complete:
            self.complete()
