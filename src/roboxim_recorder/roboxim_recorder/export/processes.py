"""Reads and encodes the episodes of an export in several processes.

In one process, the threads that decompress, convert and encode wait for the interpreter's lock, which processes do not
share. `make bench-export` compares both.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

from roboxim_core.errors import ErrorCode, RecorderError
from roboxim_datasets.dataset import EncodingWriter
from roboxim_datasets.episode import Episode
from roboxim_recorder.export.content import Content, content_of
from roboxim_recorder.export.episodes import exported_episode
from roboxim_recorder.export.selection import Selection
from roboxim_recorder.export.sources import Source

AHEAD = 2
"""Number of episodes per process that are read ahead of writing."""
Encoder = Callable[[Episode], bytes]


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def add_in_processes(
    writer: EncodingWriter,
    left: Sequence[tuple[str, Source]],
    firsts: Sequence[Source],
    config: Selection,
    workers: int,
) -> Iterator[None]:
    """Add episodes in their order; yield after each.

    Args:
        writer: Receives the encoded episodes.
        left: Split and bag of each.
        firsts: The first bag of each robot, beginning with the export's first bag: they determine the content of its
            steps.
        config: The export's configuration.
        workers: Number of processes.

    Raises:
        RecorderError: As reading and writing raise it; ``UNAVAILABLE`` when a process has died.
    """
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, spawn, _start, (firsts, config, writer.encoder))
    waiting: deque[tuple[str, Future[bytes]]] = deque()
    try:
        for split, source in left:
            waiting.append((split, pool.submit(_encoded, source)))
            if len(waiting) > AHEAD * workers:
                _write_next(writer, waiting)
                yield
        while waiting:
            _write_next(writer, waiting)
            yield
    except BrokenProcessPool:
        raise RecorderError(
            "a process of the export ended unexpectedly; run the same command again, it continues",
            ErrorCode.UNAVAILABLE,
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


def _write_next(writer: EncodingWriter, waiting: deque[tuple[str, Future[bytes]]]) -> None:
    split, future = waiting.popleft()
    writer.add_encoded(split, future.result())


# ------------------------------------------------------------------ in a process of the pool

_content: Content
_encoder: Encoder


def _start(firsts: Sequence[Source], config: Selection, encoder: Encoder) -> None:
    """Prepare a process: its parent handles Ctrl-C, and it ends when its parent does."""
    global _content, _encoder
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _content, _encoder = content_of(firsts, config), encoder


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


def _encoded(source: Source) -> bytes:
    return _encoder(exported_episode(source, _content))
