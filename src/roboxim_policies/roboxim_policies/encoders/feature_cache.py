"""Features of pictures by a frozen encoder, computed once for each picture and kept on disk by its hash.

All trainings on this machine share one store for each size of pictures, so that datasets that have episodes in common,
e.g. those of an experiment's conditions, compute these once. Trainings that begin together share the work. The store's
arrays are memory-mapped, so that a training takes no more memory than the batches that it uses. An interrupted
computation continues where it stopped.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import numpy.typing as npt

from roboxim_core.user_folders import cache_dir
from roboxim_policies.encoders.efficientnet import CHANNELS, features, load_weights
from roboxim_policies.encoders.weights import EFFICIENTNET_LITE0

Images = npt.NDArray[np.uint8]
Array = npt.NDArray[np.float16]

STRIDES = (8, 16)
"""Features that networks see: one for each square of so many pixels."""
BATCH = 32
"""Pictures that are encoded at a time."""
FORMAT = 2
HASH_BYTES = 16


@jax.jit
def encode(pixels: jax.Array) -> dict[int, jax.Array]:
    """Return the features of pictures by stride, 16-bit floats, from colours 0..255 of shape (B, side, side, 3)."""
    found = features(load_weights(), pixels.astype(np.float32), STRIDES)
    return {stride: array.astype(np.float16) for stride, array in found.items()}


def shape_of(side: int, stride: int) -> tuple[int, int, int]:
    """Return the shape of a picture's features."""
    return (-(-side // stride), -(-side // stride), CHANNELS[stride])


@dataclass(frozen=True)
class Features:
    """Features of a dataset's pictures, picture by picture, at their places in a store."""

    stored: Array
    """Memory-mapped features of all pictures of the store, shape (M, h, w, channels)."""
    rows: npt.NDArray[np.int64]
    """Row of each of the dataset's N pictures, shape (N,)."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the dataset's features, (N, h, w, channels)."""
        return (len(self.rows), *self.stored.shape[1:])

    def __getitem__(self, chosen: Any) -> Array:
        """Return the features of the chosen pictures: an index, a slice or an array of indices."""
        found: Array = self.stored[self.rows[chosen]]
        return found


def features_of(
    images: Mapping[str, Images], *, progress: Callable[[int, int], None] = lambda done, total: None
) -> dict[str, Features]:
    """Return the features of all pictures, from the store if they are there.

    Args:
        images: Camera to pictures, shape (N, side, side, 3).
        progress: Called with (pictures done, pictures in all), while some have to be computed.

    Returns:
        ``CAMERA/STRIDE`` to features, shape (N, side / stride, side / stride, channels).

    Raises:
        OSError: When the disk is full.
        UnavailableError: When the encoder's package is not installed.
        ConfigError: When the encoder's file is damaged.
    """
    found: dict[str, Features] = {}
    total, before = sum(map(len, images.values())), 0
    for camera, pictures in sorted(images.items()):
        store, hashes = _Store(pictures.shape[1]), [_hash(picture) for picture in pictures]
        for missing in store.fill(pictures, hashes):
            progress(before + len(pictures) - missing, total)
        for stride, stored in store.features(hashes).items():
            found[f"{camera}/{stride}"] = stored
        before += len(pictures)
    return found


class _Store:
    """Features of pictures of one size.

    Files that only grow: one for each stride, with a row for each picture, and ``index``, with the rows' hashes. A row
    belongs to the store as soon as the index has its hash, which is written last.
    """

    def __init__(self, side: int) -> None:
        folder = cache_dir() / "features" / f"{FORMAT}-{EFFICIENTNET_LITE0.sha256[:16]}-{side}"
        folder.mkdir(parents=True, exist_ok=True)
        self._index, self._lock = folder / "index", folder / "lock"
        self._shapes = {stride: shape_of(side, stride) for stride in STRIDES}
        self._files = {stride: folder / f"{stride}.f16" for stride in STRIDES}
        self._rows: dict[bytes, int] = {}

    def fill(self, pictures: Images, hashes: list[bytes]) -> Iterator[int]:
        """Compute what is missing, and yield the number of different pictures that still are after each batch.

        The order is random, so that processes with the same pictures each compute a part of them.
        """
        places = dict(zip(hashes, range(len(hashes)), strict=True))
        self._read()
        order = np.random.default_rng().permutation([place for each, place in places.items() if each not in self._rows])
        missing = list(map(int, order))
        while missing:
            chosen, missing = missing[:BATCH], missing[BATCH:]
            part = pictures[chosen]
            padded = np.concatenate([part, np.zeros((BATCH - len(part), *part.shape[1:]), np.uint8)])
            self._append([hashes[place] for place in chosen], encode(padded))
            missing = [place for place in missing if hashes[place] not in self._rows]
            yield len(missing)

    def features(self, hashes: list[bytes]) -> dict[int, Features]:
        """Return the features of pictures that are in the store, by stride."""
        rows = np.array([self._rows[each] for each in hashes], np.int64)
        count = len(self._rows)
        return {
            stride: Features(np.memmap(file, np.float16, "r", shape=(count, *self._shapes[stride])), rows)
            for stride, file in self._files.items()
        }

    def _append(self, hashes: list[bytes], features: Mapping[int, Any]) -> None:
        """Add pictures, without those that another process has added meanwhile."""
        with self._lock.open("w") as lock, contextlib.ExitStack() as stack:
            fcntl.flock(lock, fcntl.LOCK_EX)
            self._read()
            new = [place for place, each in enumerate(hashes) if each not in self._rows]
            for stride, file in self._files.items():
                stream = stack.enter_context(file.open("ab"))
                stream.truncate(len(self._rows) * self._bytes(stride))  # what an interrupted call has begun
                stream.write(np.asarray(features[stride])[new].tobytes())
            stack.pop_all().close()
            with self._index.open("ab") as index:
                index.truncate(len(self._rows) * HASH_BYTES)
                index.write(b"".join(hashes[place] for place in new))
            self._read()

    def _read(self) -> None:
        """Read the hashes of the rows that are complete."""
        count = len(self._rows)
        files = [(self._index, HASH_BYTES), *((file, self._bytes(stride)) for stride, file in self._files.items())]
        complete = min(file.stat().st_size // size if file.exists() else 0 for file, size in files)
        if complete > count:
            with self._index.open("rb") as index:
                index.seek(count * HASH_BYTES)
                content = index.read((complete - count) * HASH_BYTES)
            for row in range(complete - count):
                self._rows[content[row * HASH_BYTES : (row + 1) * HASH_BYTES]] = count + row

    def _bytes(self, stride: int) -> int:
        return 2 * int(np.prod(self._shapes[stride]))


def _hash(picture: Images) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(picture).tobytes(), digest_size=HASH_BYTES).digest()
