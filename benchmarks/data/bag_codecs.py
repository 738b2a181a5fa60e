"""Lossless codecs for camera images in bags: size, time to write and time to read, of the images of recorded episodes.

Today's bags store raw images in chunks of 16 MiB that zstd compresses (level 3). The codecs below see the same images:
one by one, or in chunks of the same size where the codec says so. Times are processor time of one thread per image, as
CPU time hardly depends on what else the machine does. Every image is compared after reading.

JPEG XL is measured if the plug-in ``pillow-jxl-plugin`` of Pillow is installed.

``standard`` says whether a ``sensor_msgs/CompressedImage`` of the codec is read by ROS's and Foxglove's own tools.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import zstandard
from benchmarks._harness import Bench
from benchmarks.data.export import generated
from PIL import Image

from roboxim_recorder.bag import BagReader
from roboxim_recorder.run_bags import list_bags

Images = Sequence[npt.NDArray[np.uint8]]
Filter = Callable[[npt.NDArray[np.uint8]], npt.NDArray[np.uint8]]
"""Turns a stack of images into another one of the same shape."""
CHUNK_BYTES = 16 << 20


@dataclass(frozen=True, kw_only=True)
class Codec:
    """Encodes the images of one camera topic in their order, and decodes them."""

    name: str
    encode: Callable[[Images], list[bytes]]
    decode: Callable[[list[bytes], Images], list[npt.NDArray[np.uint8]]]
    """The second argument has images of the right shapes only."""
    standard: bool = False
    random_access: bool = True
    """Whether an image can be read without the images before it in its chunk."""


def chunked(images: Images, filtered: Filter, level: int, window_log: int) -> list[bytes]:
    """Compress filtered images in chunks as the bag's writer does."""
    per_chunk = max(1, CHUNK_BYTES // images[0].nbytes)
    parameters = zstandard.ZstdCompressionParameters.from_level(level, window_log=window_log, enable_ldm=window_log > 0)
    compressor = zstandard.ZstdCompressor(compression_params=parameters)
    stacks = (np.stack(images[i : i + per_chunk]) for i in range(0, len(images), per_chunk))
    return [compressor.compress(np.ascontiguousarray(filtered(stack)).tobytes()) for stack in stacks]


def unchunked(data: list[bytes], like: Images, restored: Filter) -> list[npt.NDArray[np.uint8]]:
    """Undo `chunked`."""
    decompressor = zstandard.ZstdDecompressor()
    found: list[npt.NDArray[np.uint8]] = []
    for chunk in data:
        flat = np.frombuffer(decompressor.decompress(chunk), np.uint8)
        found.extend(restored(flat.reshape(-1, *like[0].shape)))
    return found


def left(stack: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return each pixel's difference from its left neighbour."""
    return np.diff(stack, axis=2, prepend=np.zeros_like(stack[:, :, :1]))


def unleft(stack: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Undo `left`."""
    return np.cumsum(stack, axis=2, dtype=np.uint8)


def before(stack: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return each image's difference from the one before it in the chunk."""
    return np.diff(stack, axis=0, prepend=np.zeros_like(stack[:1]))


def unbefore(stack: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Undo `before`."""
    return np.cumsum(stack, axis=0, dtype=np.uint8)


def same(stack: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return the images."""
    return stack


def zstd(
    name: str, level: int, forth: Filter = same, back: Filter = same, *, random_access: bool = True, window_log: int = 0
) -> Codec:  # fmt: skip
    """Return a codec of whole chunks; a window of 2 ** ``window_log`` bytes, 0: the level's."""
    return Codec(
        name=name, encode=lambda images: chunked(images, forth, level, window_log),
        decode=lambda data, like: unchunked(data, like, back), random_access=random_access,
    )  # fmt: skip


def cv2_codec(name: str, ending: str, options: list[int]) -> Codec:
    """Return a codec of OpenCV's."""
    return Codec(
        name=name,
        encode=lambda images: [cv2.imencode(ending, image, options)[1].tobytes() for image in images],
        decode=lambda data, _: [cv2.imdecode(np.frombuffer(one, np.uint8), cv2.IMREAD_UNCHANGED) for one in data],
        standard=True,
    )


def pillow_codec(name: str, kind: str, *, standard: bool = True, **options: Any) -> Codec:
    """Return a codec of Pillow's, or of a plug-in of it."""

    def encode(images: Images) -> list[bytes]:
        found = []
        for image in images:
            buffer = BytesIO()
            Image.fromarray(image).save(buffer, kind, **options)
            found.append(buffer.getvalue())
        return found

    return Codec(
        name=name, encode=encode, standard=standard,
        decode=lambda data, _: [np.asarray(Image.open(BytesIO(one))) for one in data],
    )  # fmt: skip


def codecs() -> list[Codec]:
    """Return the codecs of this installation."""
    found = [
        zstd("raw, zstd 3 (today)", 3),
        zstd("raw, zstd 9", 9),
        zstd("raw, zstd 3, window of 16 MiB", 3, window_log=24),
        zstd("left neighbour, zstd 3", 3, left, unleft),
        zstd("left neighbour, zstd 9", 9, left, unleft),
        zstd("image before, zstd 3", 3, before, unbefore, random_access=False),
        zstd("image before, zstd 1", 1, before, unbefore, random_access=False),
        cv2_codec("PNG 1", ".png", [cv2.IMWRITE_PNG_COMPRESSION, 1]),
        cv2_codec("PNG 6", ".png", [cv2.IMWRITE_PNG_COMPRESSION, 6]),
        pillow_codec("WebP lossless, method 0", "WEBP", lossless=True, quality=0, method=0),
        pillow_codec("WebP lossless, method 4", "WEBP", lossless=True, quality=50, method=4),
    ]
    try:
        import pillow_jxl  # noqa: F401 (registers itself)
    except ImportError:
        return found
    jpeg_xl: dict[str, Any] = {"kind": "JXL", "standard": False, "lossless": True, "num_threads": 1}
    return [*found, *(pillow_codec(f"JPEG XL, effort {effort}", effort=effort, **jpeg_xl) for effort in (1, 3))]


def main() -> None:
    """Measure and print."""
    bench = Bench("bag_codecs", __doc__, add_options)
    with tempfile.TemporaryDirectory() as folder:
        run = bench.options.bags or generated(Path(folder) / "run", 2 if bench.quick else 10)
        cameras = read_images(list_bags(run)[: 2 if bench.quick else 10])
    sizes: list[int] = []
    count = sum(map(len, cameras))
    for codec in codecs():
        size, write_s, read_s = measure(codec, cameras)
        sizes.append(size)
        bench.row(
            codec=codec.name, kib_per_image=round(size / count / 1024, 1), of_today=round(size / sizes[0], 2),
            write_ms=round(1e3 * write_s / count, 2), read_ms=round(1e3 * read_s / count, 2),
            standard="yes" if codec.standard else "no", random_access="yes" if codec.random_access else "no",
        )  # fmt: skip
    pixels = "x".join(map(str, cameras[0][0].shape[1::-1]))
    bench.finish(f"the smallest codec's size over today's, {pixels} px", min(sizes) / sizes[0], "", at_most=0.7)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the benchmark's own options."""
    parser.add_argument("--bags", type=Path, metavar="RUN", help="use this run's bags instead of generating some")


def read_images(bags: Sequence[Path]) -> list[Images]:
    """Return the images of each camera of each bag, in their order."""
    found: list[Images] = []
    for bag in bags:
        by_camera: dict[str, list[npt.NDArray[np.uint8]]] = {}
        for tick in BagReader(bag).ticks():
            for name, image in tick.images.items():
                by_camera.setdefault(name, []).append(np.ascontiguousarray(image))
        found.extend(by_camera.values())
    return found


def measure(codec: Codec, cameras: Sequence[Images]) -> tuple[int, float, float]:
    """Return the bytes of all images, and the processor time to encode and to decode them [s]."""
    size, write_s, read_s = 0, 0.0, 0.0
    for images in cameras:
        begun = time.thread_time()
        data = codec.encode(images)
        written = time.thread_time()
        back = codec.decode(data, images)
        read_s += time.thread_time() - written
        write_s += written - begun
        size += sum(map(len, data))
        if not all(np.array_equal(one, other) for one, other in zip(images, back, strict=True)):
            raise SystemExit(f"{codec.name} does not give the images back")
    return size, write_s, read_s


if __name__ == "__main__":
    main()
