"""Time, size and quality of x264's presets on rendered frames, the basis of the choice of the default video codec.

Two cameras of 256 x 256 of one demonstration are encoded with a key frame every second frame, in one thread.
``cpu_ms`` is processor time of a frame, without the conversion from RGB.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from fractions import Fraction
from pathlib import Path

import numpy as np
import numpy.typing as npt
from benchmarks._harness import Bench

from roboxim_datasets.video.codecs import CODECS
from roboxim_recorder.bag import BagReader
from roboxim_runs.episodes.generation import GenerationConfig, generate

SETTINGS = (("veryfast", 18), ("superfast", 18), ("ultrafast", 18), ("ultrafast", 16))
FRAMES = 45


def main() -> None:
    """Measure and print."""
    bench = Bench("codecs", __doc__, add_options)
    with tempfile.TemporaryDirectory() as folder:
        bag = bench.options.bag
        if bag is None:
            found = generate(GenerationConfig(out=Path(folder) / "run", episodes=1))
            bag = found.out / str(found.kept[0].bag)
        films = pictures(bag, 20 if bench.quick else FRAMES)
        default = 0.0
        for preset, crf in SETTINGS:
            row = measure(films, preset, crf, Path(folder))
            bench.row(preset=preset, crf=crf, **row)
            if (CODECS["h264"].options["preset"], CODECS["h264"].options["crf"]) == (preset, str(crf)):
                default = float(row["psnr_db"])
    bench.finish("quality of the default codec", default, "dB", at_least=38)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the benchmark's own options."""
    parser.add_argument("--bag", type=Path, metavar="BAG", help="take the images of this bag instead of generating one")


def pictures(bag: Path, count: int) -> list[npt.NDArray[np.uint8]]:
    """Return the first images of each camera, shape (count, height, width, 3)."""
    ticks = [tick for _, tick in zip(range(count), BagReader(bag).ticks(), strict=False)]
    return [np.stack([tick.images[camera] for tick in ticks]) for camera in ticks[0].images]


def measure(films: list[npt.NDArray[np.uint8]], preset: str, crf: int, folder: Path) -> dict[str, float]:
    """Encode and decode every film."""
    import av
    from av.video.reformatter import VideoReformatter

    codec, spent, size, errors = CODECS["h264"], 0.0, 0, []
    for film in films:
        path, convert = folder / "film.mp4", VideoReformatter()
        frames = [
            convert.reformat(av.VideoFrame.from_ndarray(image, format="rgb24"), format="yuv420p", threads=1)
            for image in film
        ]
        with av.open(str(path), "w") as target:
            stream = target.add_stream("libx264", rate=10, options={"preset": preset, "crf": str(crf)})
            stream.height, stream.width, stream.pix_fmt = *film.shape[1:3], codec.pixel_format
            context = stream.codec_context
            context.gop_size, context.max_b_frames, context.thread_count = codec.key_interval, 0, 1
            begun = time.process_time()
            for number, frame in enumerate(frames):
                frame.pts, frame.time_base = number, Fraction(1, 10)
                target.mux(stream.encode(frame))
            target.mux(stream.encode(None))
            spent += time.process_time() - begun
        size += path.stat().st_size
        with av.open(str(path)) as source:
            shown = [frame.to_rgb().to_ndarray() for frame in source.decode(video=0)]
        errors += [float(np.mean((a.astype(float) - b) ** 2)) for a, b in zip(shown, film, strict=True)]
    return {
        "cpu_ms": round(1e3 * spent / len(errors), 2),
        "bytes": round(size / len(errors)),
        "psnr_db": round(10 * np.log10(255**2 / np.mean(errors)), 2),
        "lowest_psnr_db": round(10 * np.log10(255**2 / np.max(errors)), 2),
    }


if __name__ == "__main__":
    main()
