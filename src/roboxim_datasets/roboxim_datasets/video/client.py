"""Client of the video workers: `VideoWriters` encodes in several processes, `VideoDecoder` decodes in one."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import queue
import subprocess
import sys
import threading
import weakref
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.closing import Closing
from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError
from roboxim_datasets.video.codecs import video_codec
from roboxim_datasets.video.messages import Header, read_message, write_message

RGBImage = npt.NDArray[np.uint8]
_FRAMES_PER_MESSAGE = 8
_QUEUED_MESSAGES = 6
_PIPE_BYTES = 1 << 20


@dataclass(frozen=True, kw_only=True)
class VideoFile:
    """A written video."""

    frames: int
    """Number of frames."""
    size: int
    """Size of the file [B]."""


class _Process:
    """A video worker."""

    def __init__(self) -> None:
        if find_spec("av") is None:
            raise ModuleNotFoundError("videos need PyAV", name="av")
        self._process = subprocess.Popen(
            [sys.executable, "-m", "roboxim_datasets.video.worker"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input, self._output = self._process.stdin, self._process.stdout
        if hasattr(fcntl, "F_SETPIPE_SZ"):
            with contextlib.suppress(OSError):
                fcntl.fcntl(self._input, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    def send(self, header: Header, parts: Sequence[Any] = ()) -> None:
        """Send a message that has no answer."""
        try:
            write_message(self._input, header, parts)
        except OSError:
            raise self._died() from None

    def ask(self, header: Header) -> tuple[Header, bytearray]:
        """Send a message and return its answer."""
        self.send(header)
        try:
            message = read_message(self._output)
        except EOFError:
            message = None
        if message is None:
            raise self._died()
        if "error" in message[0]:
            raise RecorderError(
                f"video {header.get('path', '')}: {message[0]['error']}",
                ErrorCode.DISK if "No space" in message[0]["error"] else ErrorCode.BAG_DAMAGED,
            )
        return message

    def close(self) -> None:
        """End the worker."""
        with contextlib.suppress(OSError):
            self._input.close()
        self._output.close()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _died(self) -> RecorderError:
        return RecorderError(
            f"the video worker ended unexpectedly (status {self._process.wait()}); run the same command again",
            ErrorCode.UNAVAILABLE,
        )


class VideoWriters(Closing):
    """Encodes videos in worker processes; a context manager.

    Non-obvious: `VideoWriting.add` blocks while its worker is behind, so memory does not grow with the videos' length.
    """

    def __init__(self, workers: int = 2) -> None:
        """Prepare workers; the processes start when they are first needed."""
        self._lanes: list[_Lane] = []
        self._count, self._next, self._numbers = max(1, workers), 0, itertools.count(1)

    def open(self, path: Path, *, codec: str, rate: Fraction, height: int, width: int) -> VideoWriting:
        """Start a video.

        Args:
            path: File to write.
            codec: One of `roboxim_datasets.video.codecs.CODECS`.
            rate: Frames per second.
            height: Height of the frames [px].
            width: Width of the frames [px].

        Raises:
            InvalidRequestError: On an unknown codec or a size that it does not support.
        """
        video_codec(codec, height=height, width=width)
        number, lane = next(self._numbers), self._lane()
        shape = {"height": height, "width": width}
        lane.put({"op": "open", "video": number, "path": str(path), "codec": codec, "rate": str(rate), **shape})
        return VideoWriting(lane, number, path, (height, width, 3))

    def join(self, pieces: Sequence[Path], path: Path, rate: Fraction) -> Future[VideoFile]:
        """Write several videos of equal settings into one file, one after another, without encoding them again."""
        found: Future[VideoFile] = Future()
        header = {"op": "join", "pieces": [str(piece) for piece in pieces], "path": str(path), "rate": str(rate)}
        self._lane().put(header, answer=found)
        return found

    def _lane(self) -> _Lane:
        if len(self._lanes) < self._count:
            self._lanes.append(_Lane())
        self._next = (self._next + 1) % self._count
        return self._lanes[min(self._next, len(self._lanes) - 1)]

    def close(self) -> None:
        """End the workers."""
        for lane in self._lanes:
            lane.close()
        self._lanes.clear()


class VideoWriting:
    """A video that is being encoded."""

    def __init__(self, lane: _Lane, number: int, path: Path, shape: tuple[int, int, int]) -> None:
        self._lane, self._number, self._path, self._shape = lane, number, path, shape
        self._pending: list[RGBImage] = []

    def add(self, image: RGBImage) -> None:
        """Append an RGB image, uint8, of the video's size.

        Raises:
            InvalidRequestError: On another type or shape.
            RecorderError: With code ``UNAVAILABLE`` when the worker has died.
        """
        if image.dtype != np.uint8 or image.shape != self._shape:
            raise InvalidRequestError(
                f"video {self._path}: expected images of uint8 and shape {self._shape}, got {image.dtype} of shape "
                f"{image.shape}"
            )
        self._pending.append(np.ascontiguousarray(image))
        if len(self._pending) == _FRAMES_PER_MESSAGE:
            self._send()

    def _send(self) -> None:
        if self._pending:
            self._lane.put({"op": "frames", "video": self._number}, self._pending)
            self._pending = []

    def close(self) -> Future[VideoFile]:
        """Finish the video; the result comes when the file is written."""
        self._send()
        found: Future[VideoFile] = Future()
        self._lane.put({"op": "close", "video": self._number, "path": str(self._path)}, answer=found)
        return found


class _Lane:
    """A worker with the thread that feeds it."""

    def __init__(self) -> None:
        self._process = _Process()
        self._queue: queue.Queue[tuple[Header, Sequence[Any], Future[VideoFile] | None] | None] = queue.Queue(
            _QUEUED_MESSAGES
        )
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._serve, name="video worker", daemon=True)
        self._thread.start()

    def put(self, header: Header, parts: Sequence[Any] = (), answer: Future[VideoFile] | None = None) -> None:
        if self._error is not None:
            raise self._error
        self._queue.put((header, parts, answer))

    def close(self) -> None:
        self._queue.put(None)
        self._thread.join()
        self._process.close()

    def _serve(self) -> None:
        while (item := self._queue.get()) is not None:
            header, parts, future = item
            try:
                if self._error is not None:
                    raise self._error
                if future is None:
                    self._process.send(header, parts)
                else:
                    reply = self._process.ask(header)[0]
                    future.set_result(VideoFile(frames=reply["frames"], size=reply["size"]))
            except Exception as error:  # whatever it is, `put` must not wait for this thread for ever
                if not isinstance(error, RecorderError) or error.code == ErrorCode.UNAVAILABLE:
                    self._error = error
                if future is not None:
                    future.set_exception(error)


class VideoDecoder:
    """Decodes videos in a worker process, which starts when it is first needed and ends with this object."""

    def __init__(self) -> None:
        self._running: list[_Process] = []
        self._lock, self._numbers = threading.Lock(), itertools.count(1)
        weakref.finalize(self, _end, self._running)  # also at the interpreter's exit, while modules still exist

    def frames(
        self,
        path: Path,
        *,
        rate: Fraction,
        first: Fraction,
        count: int,
        height: int = 0,
        width: int = 0,
        deep: bool = False,
    ) -> Iterator[npt.NDArray[Any]]:
        """Yield ``count`` frames, one for each step of the dataset: RGB, uint8, shape (height, width, 3).

        Args:
            path: Video file.
            rate: Steps per second of the dataset.
            first: Time of the first step [steps]. The video may have another rate: a step has the nearest frame.
            count: Number of steps.
            height: Expected height of the frames [px]; 0: any.
            width: Expected width of the frames [px]; 0: any.
            deep: Whether frames are grey ones of 9 to 16 bits, which are yielded as uint16, shape (height, width).

        Raises:
            RecorderError: With code ``BAG_DAMAGED`` when the file cannot be read, has too few frames, or frames of
                another size, which are not decoded.
        """
        number = next(self._numbers)
        self._ask({"op": "start", "video": number, "path": str(path), "rate": str(rate), "first": str(first),
                   "count": count, "height": height, "width": width, "deep": deep})  # fmt: skip
        try:
            left = count
            while left:
                header, data = self._ask(
                    {"op": "read", "video": number, "count": _FRAMES_PER_MESSAGE, "path": str(path)}
                )
                if not header["shapes"]:
                    raise RecorderError(
                        f"video {path} ends {left} frames early, expected {count} from {float(first / rate):.4g} s on",
                        ErrorCode.BAG_DAMAGED,
                    )
                at = 0
                for shape in header["shapes"]:
                    kind = np.dtype(np.uint16 if deep else np.uint8)
                    image = np.frombuffer(data, kind, int(np.prod(shape)), at).reshape(shape)
                    image.setflags(write=False)
                    at += image.nbytes
                    left -= 1
                    yield image
        finally:
            self._ask({"op": "stop", "video": number})

    def probe(self, path: Path) -> Header:
        """Return codec, height, width, rate, pixel format and number of frames of a video.

        Raises:
            RecorderError: With code ``BAG_DAMAGED`` when the file cannot be read.
        """
        return self._ask({"op": "probe", "path": str(path)})[0]

    def _ask(self, header: Header) -> tuple[Header, bytearray]:
        with self._lock:
            if not self._running:
                self._running.append(_Process())
            return self._running[0].ask(header)

    def close(self) -> None:
        """End the worker; a later call starts another one."""
        with self._lock:
            _end(self._running)


def _end(running: list[_Process]) -> None:
    while running:
        running.pop().close()
