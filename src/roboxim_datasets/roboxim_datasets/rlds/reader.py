"""Reads a dataset in the RLDS format, without TensorFlow."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from roboxim_core.documents import read_json_object
from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, RecorderError, one_of
from roboxim_datasets.rlds.format import RldsEpisode, decode_episode, features_from_json
from roboxim_datasets.rlds.tfrecord import read_records


class RldsReader:
    """Reads datasets that `RldsWriter` writes."""

    def __init__(self, path: Path | str) -> None:
        """Open a dataset.

        Args:
            path: The folder that holds ``dataset_info.json``, or one above it that holds a single dataset.

        Raises:
            RecorderError: When there is no dataset or its description is damaged.
        """
        found = sorted(p for p in Path(path).glob("**/dataset_info.json") if ".partial" not in str(p.parent))
        if len(found) != 1:
            raise RecorderError(_not_one(Path(path), [file.parent for file in found]))
        self.path = found[0].parent
        try:
            info = read_json_object(found[0])
            self.features = features_from_json(read_json_object(self.path / "features.json"))
            self.name: str = info["name"]
            self.version: str = info["version"]
            self.splits = {s["name"]: [int(n) for n in s["shardLengths"]] for s in info["splits"]}
            """Split to the number of episodes in each of its shards."""
        except ConfigError as error:
            raise RecorderError(f"the dataset's description cannot be read: {error}") from None
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise RecorderError(f"{self.path} is not a dataset that this reader knows: {error!r}") from None

    def count(self, split: str) -> int:
        """Count the episodes of a split; 0 when there is none of that name."""
        return sum(self.splits.get(split, []))

    def episodes(self, split: str) -> Iterator[RldsEpisode]:
        """Yield the episodes of a split in order, images still encoded.

        Raises:
            InvalidRequestError: When there is no such split.
            RecorderError: With code ``BAG_DAMAGED``, naming the file.
        """
        if split not in self.splits:
            raise InvalidRequestError(f"{self.path}: no split '{split}'; {one_of(self.splits, split)}")
        lengths = self.splits[split]
        for index, length in enumerate(lengths):
            path = self.path / f"{self.name}-{split}.tfrecord-{index:05d}-of-{len(lengths):05d}"
            count = 0
            for payload in _records(path):
                yield decode_episode(payload, self.features)
                count += 1
            if count != length:
                raise RecorderError(f"{path} holds {count} episodes, expected {length}", ErrorCode.BAG_DAMAGED)


def _not_one(path: Path, found: list[Path]) -> str:
    """Return the error message for a path that is not one dataset."""
    if found:
        names = ", ".join(map(str, found[:5])) + (", ..." if len(found) > 5 else "")
        return f"{path} holds {len(found)} datasets; name one of {names}"
    if not path.exists():
        return f"no such folder: {path}; expected a dataset, as 'roboxim export rlds' makes it"
    if any((path / name).exists() for name in ("episodes", "run.json")) or any(path.glob("**/*.mcap")):
        return f"{path} holds bags, not a dataset; export them first: roboxim export rlds {path} {path}-rlds"
    return f"{path} holds 0 datasets; name the folder of one, which holds dataset_info.json"


def _records(path: Path) -> Iterator[bytes]:
    try:
        yield from read_records(path)
    except OSError as error:
        raise RecorderError(f"cannot read {path}: {error.strerror or error}", ErrorCode.BAG_DAMAGED) from None
