"""Video codecs and their settings. This module does not import PyAV."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from roboxim_core.errors import InvalidRequestError, one_of


@dataclass(frozen=True, kw_only=True)
class VideoCodec:
    """Settings of an encoder. With x264 equal frames give equal bytes: it runs in one thread, without `mbtree`."""

    encoder: str
    """FFmpeg's name of the encoder."""
    codec: str
    """FFmpeg's name of the format, as datasets state it."""
    pixel_format: str
    """Pixel format; ``yuv420p`` needs even widths and heights."""
    key_interval: int = 2
    """Frames from one key frame to the next; small, so that a random frame is decoded quickly."""
    options: Mapping[str, str] = field(default_factory=dict)
    """Further options of the encoder."""


# Beside veryfast on RoboXim's images: a third of the time, 1.5 times the bytes, 0.4 dB more (`make bench-codecs`).
# Without the macroblock tree, whose lookahead reads memory that was never written when images are small: with it 73 of
# 9,622 encodings of equal frames of 32 x 24 and 16 x 16 differed, without it none.
_X264 = {"preset": "ultrafast", "crf": "18", "x264-params": "mbtree=0"}
CODECS: Mapping[str, VideoCodec] = {
    "h264": VideoCodec(encoder="libx264", codec="h264", pixel_format="yuv420p", options=_X264),
    "h264-444": VideoCodec(encoder="libx264", codec="h264", pixel_format="yuv444p", options=_X264),
    "hevc": VideoCodec(
        encoder="libx265",
        codec="hevc",
        pixel_format="yuv420p",
        options={"preset": "veryfast", "crf": "20", "x265-params": "pools=none:frame-threads=1:log-level=error"},
    ),
    "av1": VideoCodec(
        encoder="libsvtav1",
        codec="av1",
        pixel_format="yuv420p",
        options={"preset": "12", "crf": "30", "svtav1-params": "lp=1"},
    ),
}
"""Name of a codec, as ``--codec`` takes it, to its settings."""


def video_codec(name: str, *, height: int, width: int) -> VideoCodec:
    """Return a codec for images of a size.

    Args:
        name: One of `CODECS`.
        height: Height of the images [px].
        width: Width of the images [px].

    Raises:
        InvalidRequestError: On an unknown codec, or an odd size that its pixel format does not support.
    """
    if name not in CODECS:
        raise InvalidRequestError(f"unknown video codec '{name}'; {one_of(CODECS, name)}")
    found = CODECS[name]
    if found.pixel_format == "yuv420p" and (height % 2 or width % 2):
        raise InvalidRequestError(
            f"codec '{name}' needs images of even width and height, got {width} x {height} px; resize them (--size), "
            "or store images instead of video (--images)"
        )
    return found
