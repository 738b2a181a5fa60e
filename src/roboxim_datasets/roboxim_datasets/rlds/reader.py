"""Reads a dataset in the RLDS format, without TensorFlow."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, RecorderError, one_of, printable
from roboxim_core.plain_data.documents import read_json_object
from roboxim_datasets.account import Account, Kind
from roboxim_datasets.dataset import Dataset, Description, Features
from roboxim_datasets.episode import BETWEEN_ROBOTS, Episode, ImageSize, Step, Wanted
from roboxim_datasets.files import file_in, reading
from roboxim_datasets.pictures import head_of
from roboxim_datasets.rlds.episodes import camera_keys, component_names_of, from_rlds, is_own, not_understood
from roboxim_datasets.rlds.format import (
    FEATURES_FILE,
    INFO_FILE,
    RldsEpisode,
    RldsFeatures,
    decode_episode,
    features_from_json,
    leaves_of,
    paths_of,
    reason_not_read,
)
from roboxim_datasets.rlds.loader_files import STATISTICS_FILE, loading_text
from roboxim_datasets.rlds.tfrecord import (
    SMALLEST,
    decode_example,
    example_keys,
    read_record,
    read_records,
    record_positions,
)

_LEVELS = 4


def find_rlds(path: Path) -> list[Path]:
    """Return the RLDS datasets that a path is, or that the folder holds.

    They may lie four levels below: an export is a folder of another's that has the folders of name and version.
    """
    files = sorted(file for level in range(_LEVELS + 1) for file in path.glob("*/" * level + INFO_FILE))
    hidden = [file for file in files if any(part.startswith(".") for part in file.relative_to(path).parts)]
    return [file.parent for file in files if file not in hidden]


class RldsReader:
    """Reads the records of a dataset, images still encoded; `RldsDataset` reads it as episodes."""

    def __init__(self, path: Path | str) -> None:
        """Open a dataset.

        Args:
            path: The folder that holds ``dataset_info.json``, or one above it that holds a single dataset.

        Raises:
            RecorderError: When there is no dataset or its description is damaged.
        """
        found = find_rlds(Path(path))
        if len(found) != 1:
            raise RecorderError(
                f"{path} holds {len(found)} datasets in RLDS; name the folder of one, which holds {INFO_FILE}"
            )
        self.path = found[0]
        try:
            info = read_json_object(file_in(self.path, INFO_FILE))
            described = read_json_object(file_in(self.path, FEATURES_FILE))
            self.leaves = leaves_of(described)
            """Path to description of every feature that holds values."""
            self.features: RldsFeatures = features_from_json(described)
            self.name: str = str(info["name"])
            self.version: str = str(info["version"])
            self.splits = {str(s["name"]): [int(n) for n in s.get("shardLengths", [])] for s in info["splits"]}
            """Split to the number of episodes in each of its shards."""
            self.text = str(info.get("description", ""))
            """Description of the dataset."""
            templates = {str(s["name"]): s.get("filepathTemplate") or _TEMPLATE for s in info["splits"]}
            self._templates = {split: _template(text) for split, text in templates.items()}
            kinds = {str(s.get("fileFormat", info.get("fileFormat", "tfrecord"))) for s in (info, *info["splits"])}
        except (ConfigError, InvalidRequestError) as error:
            raise RecorderError(f"{self.path}: the dataset's description cannot be read: {error}") from None
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise RecorderError(f"{self.path} is not a dataset that this reader knows: {error!r}") from None
        if kinds != {"tfrecord"}:
            raise RecorderError(f"{self.path}: files of the kind {', '.join(sorted(kinds))}; only tfrecord is read")
        self._require_shards()

    def _require_shards(self) -> None:
        """Refuse numbers of episodes that the files cannot hold."""
        for split, lengths in self.splits.items():
            for index, length in enumerate(lengths):
                path = self.shard(split, index)
                max_records = path.stat().st_size // SMALLEST
                if not 0 <= length <= max_records:
                    raise RecorderError(
                        f"{self.path / INFO_FILE} says that {path.name} holds {length} episodes; its size allows 0 to "
                        f"{max_records}",
                        ErrorCode.BAG_DAMAGED,
                    )

    def count(self, split: str) -> int:
        """Count the episodes of a split; 0 when there is none of that name."""
        return sum(self.splits.get(split, []))

    def shard(self, split: str, index: int) -> Path:
        """Return a shard's file, which the template of its split names.

        Raises:
            RecorderError: With code ``BAG_DAMAGED`` when there is no such file in the dataset's folder.
        """
        number, count = f"{index:05d}", f"{len(self.splits[split]):05d}"
        words = {
            "DATASET": self.name, "SPLIT": split, "FILEFORMAT": "tfrecord", "SHARD_INDEX": number, "NUM_SHARDS": count,
            "SHARD_X_OF_Y": f"{number}-of-{count}",
        }  # fmt: skip
        return file_in(self.path, _WORD.sub(lambda found: words[found[1]], self._templates[split]))

    def episodes(self, split: str) -> Iterator[RldsEpisode]:
        """Yield the episodes of a split in order.

        Raises:
            InvalidRequestError: When there is no such split.
            RecorderError: With code ``BAG_DAMAGED``, naming the file.
        """
        if split not in self.splits:
            raise InvalidRequestError(f"{self.path}: no split '{split}'; {one_of(self.splits, split)}")
        for index, length in enumerate(self.splits[split]):
            path = self.shard(split, index)
            count = 0
            for payload in _records(path):
                yield self._decoded(payload, path)
                count += 1
            if count != length:
                raise RecorderError(f"{path} holds {count} episodes, expected {length}", ErrorCode.BAG_DAMAGED)

    def record(self, split: str, index: int) -> RldsEpisode:
        """Read one episode of a split.

        Raises:
            RecorderError: With code ``BAG_DAMAGED``, naming the file.
        """
        for shard, length in enumerate(self.splits[split]):
            if index < length:
                path = self.shard(split, shard)
                try:
                    positions = self._positions(path)
                    if len(positions) != length:
                        raise RecorderError(
                            f"{path} holds {len(positions)} episodes, expected {length}", ErrorCode.BAG_DAMAGED
                        )
                    return self._decoded(read_record(path, positions[index], index), path)
                except OSError as error:
                    raise _unreadable(path, error) from None
            index -= length
        raise InvalidRequestError(f"{self.path}: split '{split}' has no such episode; it has {self.count(split)}")

    def _positions(self, path: Path) -> list[int]:
        if path not in self._known_positions:
            self._known_positions[path] = record_positions(path)
        return self._known_positions[path]

    @cached_property
    def _known_positions(self) -> dict[Path, list[int]]:
        return {}

    def _decoded(self, payload: bytes, path: Path) -> RldsEpisode:
        try:
            return decode_episode(payload, self.features)
        except (ValueError, IndexError, TypeError, OverflowError) as error:
            raise RecorderError(f"{path} holds a record that cannot be read: {error}", ErrorCode.BAG_DAMAGED) from None

    def payloads(self, split: str) -> Iterator[bytes]:
        """Yield the records of a split as they are stored."""
        for index in range(len(self.splits[split])):
            yield from _records(self.shard(split, index))


class RldsDataset(Dataset):
    """An RLDS dataset, written by RoboXim or not, as episodes."""

    format = "rlds"

    def __init__(self, path: Path) -> None:
        """Open a dataset; see `RldsReader`."""
        self.reader = RldsReader(path)
        super().__init__(self.reader.path)

    @property
    def splits(self) -> Mapping[str, int]:
        """Split to its number of episodes."""
        return {split: sum(lengths) for split, lengths in self.reader.splits.items() if sum(lengths)}

    def read(self, split: str, index: int) -> Episode:
        """Read an episode of a split."""
        where = f"{self.path}, {split}[{index}]"
        with reading(where):
            episode = from_rlds(self.reader.record(split, index), self._features)

        def steps(wanted: Wanted) -> Iterator[Step]:
            try:
                yield from episode.read(wanted)
            except RecorderError as error:
                raise RecorderError(f"{where}, {error}", error.code) from None

        return replace(episode, read=steps)

    @cached_property
    def _features(self) -> RldsFeatures:
        """The features; images of any size have that of the first one."""
        features = self.reader.features
        free = [key for key, size in features.images.items() if not all(size)]
        if not free:
            return features
        first = self.reader.record(self._first_split, 0)
        with reading(f"{self.path}, {self._first_split}[0]"):
            sizes = {key: head_of(first.images[key][0]).size for key in free}
        return replace(features, images={**features.images, **{k: (s.height, s.width) for k, s in sizes.items()}})

    @property
    def _first_split(self) -> str:
        split = next(iter(self.splits), None)
        if split is None:
            raise RecorderError(f"{self.path} has no episodes")
        return split

    def summaries(self) -> Mapping[str, Mapping[str, Sequence[float]]]:
        """Return the statistics of actions and state, as OpenVLA and Octo cache them."""
        try:
            stored = read_json_object(file_in(self.path, STATISTICS_FILE))
        except (ConfigError, RecorderError):
            return {}
        names = {"action": "action", "proprio": "state"}
        return {names[key]: value for key, value in stored.items() if key in names and isinstance(value, dict)}

    @property
    def options(self) -> Mapping[str, Any]:
        """Options with which a dataset like this one is written."""
        named = {} if self.reader.name.startswith("bridge") else {"name": self.reader.name}  # no name for a new dataset
        return {**named, "version": self.reader.version, "encoding": self.reader.features.encoding}

    @property
    def usage(self) -> str:
        """How the dataset is loaded."""
        return loading_text(self.reader.name, self.reader.version, self.reader.features, self.features.action)

    @cached_property
    def description(self) -> Description:
        """What the features and the first episode say."""
        features = self._features
        first = self.reader.record(self._first_split, 0)
        episode = from_rlds(first, features)
        keys = camera_keys(first)
        names = component_names_of(first, features)
        return Description(
            features=Features(
                cameras={camera: ImageSize(height=h, width=w) for camera, (h, w) in _sizes(keys, features).items()},
                keys=keys,
                lossless=features.encoding == "png",
                action=names.action,
                vectors=names.vectors,
                signals=names.signals,
                subtasks=bool(features.subtask),
            ),
            fps=episode.fps,
            robot=BETWEEN_ROBOTS.join(self.facts.get("robots", ())) or episode.robot,
            joint_names=episode.joint_names,
            semantics=episode.semantics,
            text=self.reader.text,
            outcomes=features.metadata.get("success")
            == "bool",  # another type can hold a value other than true and false
        )

    # -- what the files hold

    def _take_stock(self, account: Account) -> None:
        features, leaves = self.reader.features, self.reader.leaves
        own = is_own(features.metadata)
        read = set(paths_of(features))
        ids: Counter[str] = Counter()
        for split in self.reader.splits:
            account.holds("split", split)
            if split in self.splits:
                account.reads("split", split)
            account.leaves_out("split", split, "it has no episodes", 1)
            for index, payload in enumerate(self.reader.payloads(split)):
                with reading(f"{self.path}, {split}[{index}]"):
                    episode = decode_episode(payload, features)
                    keys = example_keys(payload)
                    wrong = [key for key in _IMPLIED if key in keys and not _in_order(key, payload, len(episode))]
                    broken = any("\ufffd" in text for text in (episode.instruction, *episode.instructions))
                    foreign = {f"episode_metadata/{key}" for key in not_understood(episode.metadata)}
                ids[str(episode.metadata.get("episode_id", ""))] += 1
                account.holds("episode", f"{split}[{index}]")
                for key in keys:
                    kind: Kind = "key" if key.startswith("steps/") else "metadata"
                    count = len(episode) if kind == "key" else 1
                    account.holds(kind, key, count)
                    if key in wrong:
                        last = key.removeprefix("steps/is_")
                        account.leaves_out(kind, key, f"it is not true at the {last} step alone", count)
                    elif key in foreign:
                        account.leaves_out(kind, key, "RoboXim uses this name, and the value is not of its form", count)
                    elif key in read:
                        how = "" if own or kind != "key" else _changed(leaves.get(key, {}))
                        if key == features.instruction and broken:
                            how = "bytes that are no UTF-8, read as \ufffd"
                        account.reads(kind, key, count, how)
                    elif key in _IMPLIED or (own and key in _OWN_IMPLIED):
                        account.implies(kind, key, "the order of the steps", count)
                    else:
                        why = reason_not_read(key, leaves[key]) if key in leaves else "features.json does not name it"
                        account.leaves_out(kind, key, why, count)
                repeated = (
                    "its id is that of an earlier episode too"
                    if ids[str(episode.metadata.get("episode_id", ""))] > 1 and episode.metadata.get("episode_id") != ""
                    else ""
                )
                account.reads("episode", f"{split}[{index}]", changed=repeated * ("episode_id" in episode.metadata))


def _in_order(key: str, payload: bytes, count: int) -> bool:
    """Return whether a flag is true only at the step that its name states."""
    values = np.asarray(decode_example(payload, (key,)).get(key, ()))
    return values.shape == (count,) and np.flatnonzero(values).tolist() == [0 if key.endswith("first") else count - 1]


def _changed(leaf: Mapping[str, Any]) -> str:
    dtype = str(leaf.get("tensor", {}).get("dtype", "float32"))
    return "" if dtype in ("float32", "string") else f"{dtype}, read as float32"


_IMPLIED = ("steps/is_first", "steps/is_last")
_OWN_IMPLIED = ("steps/is_terminal", "steps/discount")
_TEMPLATE = "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}"
_WORD = re.compile(r"\{(DATASET|SPLIT|FILEFORMAT|SHARD_INDEX|NUM_SHARDS|SHARD_X_OF_Y)\}")


def _template(text: Any) -> str:
    """Return a template of file names of TensorFlow Datasets.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it names something else.
    """
    rest = _WORD.sub("", str(text))
    if "{" in rest or "}" in rest:
        raise RecorderError(
            f"unknown template of file names '{printable(text, 200)}'; expected words as in {_TEMPLATE}",
            ErrorCode.BAG_DAMAGED,
        )
    return str(text)


def _sizes(keys: Mapping[str, str], features: RldsFeatures) -> dict[str, tuple[int, int]]:
    return {camera: features.images[key] for camera, key in keys.items()}


def _records(path: Path) -> Iterator[bytes]:
    try:
        yield from read_records(path)
    except OSError as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: OSError) -> RecorderError:
    return RecorderError(f"cannot read {path}: {error.strerror or error}", ErrorCode.BAG_DAMAGED)
