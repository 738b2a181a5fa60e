"""Process that encodes, joins and decodes videos: ``python -m roboxim_datasets.video.worker``.

It reads messages (`roboxim_datasets.video.messages`) from its standard input, answers on its standard output, and ends
with its input. This is the only module that imports PyAV.

Non-obvious: times are frame numbers. A frame's presentation time is ``number / rate`` exactly, so neither joining files
nor many episodes in one file accumulate rounding errors.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import struct
import sys
from collections.abc import Iterator
from fractions import Fraction
from typing import Any, BinaryIO

import av
import numpy as np
import numpy.typing as npt
from av.video.reformatter import VideoReformatter

from roboxim_datasets.video.codecs import CODECS
from roboxim_datasets.video.messages import Header, read_message, write_message

_MP4 = {"fflags": "+bitexact"}  # without the version of the library
_MAX_PIXELS = 2**26
_PADDING = 128  # codecs round sizes up to whole blocks
_STREAMS = 8
_DEEP = ("gray9", "gray1")  # FFmpeg's names of grey frames of more than 8 bits
_BT601, _LIMITED = 6, 1  # FFmpeg's numbers of the matrix and range that its RGB conversion uses


class Encoding:
    """A video that is being written."""

    def __init__(self, path: str, *, codec: str, rate: Fraction, height: int, width: int) -> None:
        settings = CODECS[codec]
        self.path, self.frames, self._rate, self._shape = path, 0, rate, (height, width, 3)
        self._container = av.open(path, "w", format="mp4", container_options=_MP4)
        stream: Any = self._container.add_stream(settings.encoder, rate=rate, options=dict(settings.options))
        stream.width, stream.height, stream.pix_fmt = width, height, settings.pixel_format
        stream.time_base = stream.codec_context.time_base = 1 / rate
        stream.codec_context.gop_size, stream.codec_context.max_b_frames = settings.key_interval, 0
        stream.codec_context.thread_count = 1
        stream.codec_context.colorspace, stream.codec_context.color_range = _BT601, _LIMITED
        self._stream, self._convert = stream, VideoReformatter()

    def add(self, data: bytearray) -> None:
        """Append RGB frames."""
        for image in np.frombuffer(data, np.uint8).reshape(-1, *self._shape):
            frame = self._convert.reformat(
                av.VideoFrame.from_ndarray(image, format="rgb24"),
                format=self._stream.pix_fmt,
                interpolation="BICUBIC",
                threads=1,
            )
            frame.pts, frame.time_base = self.frames, 1 / self._rate
            self._write(self._stream.encode(frame))
            if not self.frames:
                give_up_priority()
            self.frames += 1

    def close(self) -> Header:
        """Finish the file."""
        self._write(self._stream.encode(None))
        self._container.close()
        return {"frames": self.frames, "size": os.path.getsize(self.path)}

    def _write(self, packets: list[Any]) -> None:
        for packet in packets:
            packet.duration = 1
            self._container.mux(packet)


def give_up_priority() -> None:
    """Make every thread of this process an ordinary one again.

    The AV1 encoder makes the thread that calls it a real-time one, with its own threads, where it may: for root, as in
    a container. They would keep everything else from the cores.
    """
    for thread in os.listdir("/proc/self/task"):
        with contextlib.suppress(OSError):  # e.g. it has ended
            os.sched_setscheduler(int(thread), os.SCHED_OTHER, os.sched_param(0))


def opened(path: str, max_pixels: int = _MAX_PIXELS) -> Any:
    """Open an MP4 file; no other format, since some of FFmpeg's (playlists, concat) open further files.

    Args:
        path: The file.
        max_pixels: Largest number of pixels of a frame, for which FFmpeg takes memory.

    Raises:
        ValueError: When it has more frames than bytes.
    """
    with open(path, "rb") as file:
        _require_frames(file, 0, os.fstat(file.fileno()).st_size)
    bound: Any = [{"max_pixels": str(max_pixels)}] * _STREAMS
    return av.open(path, format="mp4", stream_options=bound)


def _require_frames(file: BinaryIO, start: int, end: int) -> None:
    """Refuse a table of frames of equal sizes that are more than the file's bytes: FFmpeg takes 75 bytes for each.

    It bounds other tables itself. Source: ISO/IEC 14496-12, 8.7.3 (sample size box).
    """
    while start + 16 <= end:
        file.seek(start)
        size, kind = struct.unpack(">I4s", file.read(8))
        head = 8
        if size == 1:
            (size,), head = struct.unpack(">Q", file.read(8)), 16
        size = size or end - start
        if kind in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
            _require_frames(file, start + head, min(start + size, end))
        elif kind == b"stsz" and head + 12 <= size:
            file.seek(start + head + 4)
            each, count = struct.unpack(">II", file.read(8))
            if each * count > (held := os.fstat(file.fileno()).st_size):
                raise ValueError(f"{count} frames of {each} bytes are declared, the file has {held} bytes")
        start += max(size, head)


class Decoding:
    """Frames of a video, one for each step of a dataset from a given time on."""

    def __init__(
        self,
        path: str,
        *,
        rate: Fraction,
        first: Fraction,
        count: int,
        height: int = 0,
        width: int = 0,
        deep: bool = False,
    ) -> None:
        limit = (height + _PADDING) * (width + _PADDING) if height and width else _MAX_PIXELS
        self._container = opened(path, limit)
        if not self._container.streams.video:
            raise ValueError("no video in the file")
        self._video: Any = self._container.streams.video[0]
        codec = self._video.codec_context
        codec.options = {"max_pixels": str(limit)}
        if height and (codec.height, codec.width) != (height, width):
            found = f"{codec.width} x {codec.height} pixels" if codec.width else f"more than {limit} pixels"
            raise ValueError(f"frames of {found}, expected {width} x {height}")
        if codec.width * codec.height > _MAX_PIXELS:
            raise ValueError(f"frames of {codec.width} x {codec.height} pixels; at most {_MAX_PIXELS} are read")
        if str(codec.pix_fmt).startswith(_DEEP) and not deep:
            raise ValueError(
                f"depth frames ({codec.pix_fmt}), expected colour; the dataset does not say that it is depth"
            )
        if deep and not (str(codec.pix_fmt).startswith(_DEEP) and str(codec.pix_fmt).endswith("le")):
            raise ValueError(f"frames of {codec.pix_fmt}, expected depth: grey frames of 9 to 16 bits")
        self._rate, self._left, self._convert = rate, count, None if deep else VideoReformatter()
        base: Any = self._video.time_base
        self._base = base
        if first:
            # Half a frame early: a file's times are rounded to its time base.
            at = int((first - Fraction(1, 2)) / rate / self._base)
            self._container.seek(max(at, 0), stream=self._video, backward=True)
        self._frames = self._from(first)

    def read(self, count: int) -> list[npt.NDArray[Any]]:
        """Return the next frames, fewer at the end."""
        found: list[npt.NDArray[Any]] = []
        while self._left and len(found) < count:
            frame = next(self._frames, None)
            if frame is None:
                break
            found.append(_rgb(frame, self._convert) if self._convert else _deep(frame))
            self._left -= 1
        return found

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def _from(self, first: Fraction) -> Iterator[Any]:
        """Yield the frame nearest to each step, the earlier of two, as lerobot's loader does.

        Raises:
            ValueError: When it is more than half a step off.
        """
        decoded = self._container.decode(self._video)
        frame, following = next(decoded, None), next(decoded, None)
        for number in itertools.count():
            wanted = first + number
            while following is not None and abs(self._step(following) - wanted) < abs(self._step(frame) - wanted):
                frame, following = following, next(decoded, None)
            if frame is None or (following is None and self._step(frame) < wanted - Fraction(1, 2)):
                return
            if abs(self._step(frame) - wanted) > Fraction(1, 2):
                second, nearest = (float(step / self._rate) for step in (wanted, self._step(frame)))
                raise ValueError(f"the frame at {second:.4g} s is missing; the nearest one is at {nearest:.4g} s")
            yield frame

    def _step(self, frame: Any) -> Fraction:
        """Return the time of a frame in steps of the dataset."""
        if frame.pts is None:
            raise ValueError("a frame has no time")
        return Fraction(frame.pts * self._base * self._rate)


def _rgb(frame: Any, convert: VideoReformatter) -> npt.NDArray[np.uint8]:
    return np.ascontiguousarray(convert.reformat(frame, format="rgb24", threads=1).to_ndarray(), np.uint8)


def _deep(frame: Any) -> npt.NDArray[np.uint16]:
    """Return the numbers of a grey frame, whose rows in memory are longer than the picture's."""
    plane = frame.planes[0]
    rows = np.frombuffer(plane, "<u2").reshape(-1, plane.line_size // 2)
    return np.ascontiguousarray(rows[: frame.height, : frame.width], np.uint16)


def join(pieces: list[str], path: str, rate: Fraction) -> Header:
    """Write the frames of several files, one after another, into one file, without encoding them again."""
    count = 0
    with av.open(path, "w", format="mp4", container_options=_MP4) as target:
        stream: Any = None
        for piece in pieces:
            with av.open(piece) as source:
                if stream is None:
                    stream = target.add_stream_from_template(source.streams.video[0], opaque=True)
                    stream.time_base = 1 / rate
                for packet in source.demux(video=0):
                    if packet.dts is None:  # the end of the file
                        continue
                    packet.stream, packet.time_base = stream, 1 / rate
                    packet.pts = packet.dts = count
                    packet.duration = 1
                    target.mux(packet)
                    count += 1
    return {"frames": count, "size": os.path.getsize(path)}


def probe(path: str) -> Header:
    """Return the properties of a video."""
    with opened(path) as source:
        video = source.streams.video[0]
        return {
            "codec": video.codec_context.name,
            "height": video.height,
            "width": video.width,
            "rate": str(video.average_rate),
            "pixel_format": video.codec_context.pix_fmt,
            "frames": video.frames,
        }


class Worker:
    """Handles messages; keeps the open videos by number."""

    def __init__(self) -> None:
        self._encoding: dict[int, Encoding] = {}
        self._decoding: dict[int, Decoding] = {}
        self._failed: dict[int, str] = {}

    def answer(self, header: Header, data: bytearray) -> tuple[Header, list[Any]] | None:
        """Handle a message; return an answer if the client waits for one.

        A failure while a video is written is reported when the client closes it.
        """
        operation, number = header.pop("op"), header.pop("video", 0)
        try:
            if number not in self._failed:
                return self._handle(operation, number, header, data)
        except (av.FFmpegError, OSError, ValueError, LookupError) as error:
            self._failed[number] = f"{type(error).__name__}: {error}"
        if operation in ("open", "frames", "abort"):
            return None
        return {"error": self._failed.pop(number)}, []

    def _handle(self, operation: str, number: int, header: Header, data: bytearray) -> tuple[Header, list[Any]] | None:
        rate = Fraction(header.pop("rate", "1"))
        if operation == "open":
            self._encoding[number] = Encoding(rate=rate, **_without_bytes(header))
        elif operation == "frames":
            self._encoding[number].add(data)
        elif operation == "close":
            return self._encoding.pop(number).close(), []
        elif operation == "join":
            return join(header["pieces"], header["path"], rate), []
        elif operation == "probe":
            return probe(header["path"]), []
        elif operation == "start":
            first = Fraction(header.pop("first"))
            self._decoding[number] = Decoding(rate=rate, first=first, **_without_bytes(header))
            return {}, []
        elif operation == "read":
            frames = self._decoding[number].read(header["count"])
            return {"shapes": [frame.shape for frame in frames]}, frames
        elif operation == "stop":
            if number in self._decoding:
                self._decoding.pop(number).close()
            return {}, []
        return None


def _without_bytes(header: Header) -> Header:
    return {key: value for key, value in header.items() if key != "bytes"}


def main() -> int:
    """Serve until the input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the client, which closes the input
    os.environ.setdefault("SVT_LOG", "1")
    av.logging.set_level(av.logging.ERROR)
    source, target = sys.stdin.buffer, os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what an encoder prints must not get between the answers
    worker = Worker()
    with contextlib.suppress(BrokenPipeError, EOFError):  # the client was killed
        while (message := read_message(source)) is not None:
            answer = worker.answer(*message)
            if answer is not None:
                write_message(target, *answer)
    return 0


if __name__ == "__main__":
    sys.exit(main())
