"""Features of a training's pictures by a frozen encoder, computed once and kept on disk by the hash of the pictures.

A file's name is the hash of the pictures and the encoder. Arrays are memory-mapped, so that a training takes no more
memory than the batches that it uses. An interrupted computation continues where it stopped.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import numpy as np
import numpy.typing as npt

from roboxim_core.user_folders import cache_dir
from roboxim_policies.encoders.efficientnet import CHANNELS, features, load_weights
from roboxim_policies.encoders.weights import EFFICIENTNET_LITE0

Images = npt.NDArray[np.uint8]
Features = npt.NDArray[np.float16]

STRIDES = (8, 16)
"""Features that networks see: one for each square of so many pixels."""
BATCH = 32
"""Pictures that are encoded at a time."""
FORMAT = 1


@jax.jit
def encode(pixels: jax.Array) -> dict[int, jax.Array]:
    """Return the features of pictures by stride, 16-bit floats, from colours 0..255 of shape (B, side, side, 3)."""
    found = features(load_weights(), pixels.astype(np.float32), STRIDES)
    return {stride: array.astype(np.float16) for stride, array in found.items()}


def shape_of(side: int, stride: int) -> tuple[int, int, int]:
    """Return the shape of a picture's features."""
    return (-(-side // stride), -(-side // stride), CHANNELS[stride])


def features_of(
    images: Mapping[str, Images], *, progress: Callable[[int, int], None] = lambda done, total: None
) -> dict[str, Features]:
    """Return the features of all pictures, from the cache if they are there.

    Args:
        images: Camera to pictures, shape (N, side, side, 3).
        progress: Called with (pictures done, pictures in all), of what had to be computed.

    Returns:
        ``CAMERA/STRIDE`` to memory-mapped features, shape (N, side / stride, side / stride, channels).

    Raises:
        OSError: When the disk is full.
        UnavailableError: When the encoder's package is not installed.
        ConfigError: When the encoder's file is damaged.
    """
    found: dict[str, Features] = {}
    total, before = sum(map(len, images.values())), 0
    for camera, pictures in sorted(images.items()):
        for stride, array in _features(pictures, lambda done, b=before: progress(b + done, total)).items():  # type: ignore[misc]
            found[f"{camera}/{stride}"] = array
        before += len(pictures)
    return found


def _features(pictures: Images, progress: Callable[[int], None]) -> dict[int, Features]:
    name = _name(pictures)
    folder = cache_dir() / "features"
    shapes = {stride: (len(pictures), *shape_of(pictures.shape[1], stride)) for stride in STRIDES}
    files = {stride: folder / f"{name}.{stride}.f16" for stride in STRIDES}
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # of several trainings on the same pictures, one computes and the others wait
        if not all(file.is_file() and file.stat().st_size == 2 * np.prod(shapes[s]) for s, file in files.items()):
            _compute(pictures, shapes, files, progress)
    return {stride: np.memmap(file, np.float16, "r", shape=shapes[stride]) for stride, file in files.items()}


def _compute(
    pictures: Images, shapes: Mapping[int, tuple[int, ...]], files: Mapping[int, Path], progress: Callable[[int], None]
) -> None:
    """Append to drafts of the files, which an earlier call may have begun; rename them when they are complete."""
    drafts = {stride: file.with_suffix(".part") for stride, file in files.items()}
    done = min(_complete(drafts[stride], shapes[stride]) for stride in shapes)
    with contextlib.ExitStack() as stack:
        streams = {stride: stack.enter_context(draft.open("ab")) for stride, draft in drafts.items()}
        for stride, stream in streams.items():
            stream.truncate(done * 2 * int(np.prod(shapes[stride][1:])))
        for begin in range(done, len(pictures), BATCH):
            part = pictures[begin : begin + BATCH]
            padded = np.concatenate([part, np.zeros((BATCH - len(part), *part.shape[1:]), np.uint8)])
            for stride, array in encode(padded).items():
                streams[stride].write(np.asarray(array)[: len(part)].tobytes())
            progress(begin + len(part))
    for stride, draft in drafts.items():
        draft.replace(files[stride])


def _complete(draft: Path, shape: tuple[int, ...]) -> int:
    return draft.stat().st_size // (2 * int(np.prod(shape[1:]))) if draft.exists() else 0


def _name(pictures: Images) -> str:
    content = hashlib.blake2b(digest_size=16)
    content.update(f"{FORMAT} {EFFICIENTNET_LITE0.sha256} {pictures.shape}".encode())
    for begin in range(0, len(pictures), 1024):
        content.update(np.ascontiguousarray(pictures[begin : begin + 1024]).tobytes())
    return content.hexdigest()
