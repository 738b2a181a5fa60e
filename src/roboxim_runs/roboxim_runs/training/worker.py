"""A worker that runs trainings of an experiment, for an executor: on another machine, or in another process.

The machines share the experiment's folder. When a worker is lost, another one continues its training from the last
checkpoint in the folder.

Non-obvious: the worker that was lost may still live, on a node that is cut off from the cluster but not from the
folder. Each worker therefore writes its name into a file beside the training's folder, waits for a moment if there was
another name, and ends its training when the name has changed.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from roboxim_core.config import from_plain, to_plain
from roboxim_core.errors import ConfigError
from roboxim_core.whole_files import write_whole
from roboxim_eval.experiments import Stage
from roboxim_runs.events import Event
from roboxim_runs.executors.protocol import WorkerBrokenError
from roboxim_runs.experiments.provenance import Origin
from roboxim_runs.training.commands import REPORTED, Trained, train

LOOK_S = 1.0
"""Period at which a worker checks whether a training is still its own [s]."""
SAVE_S = 3.0
"""Longest time for an interrupted training to save its checkpoint [s]: its whole process group ends before this worker
is killed, and before another worker that has taken it over begins."""
YIELD_S = 8.0
"""Time that a worker before has for ending its training [s]; more than `LOOK_S` and `SAVE_S`."""
ALIVE_S = 20.0
"""Longest silence of a worker [s]."""


class TrainingWorker:
    """Runs trainings one after the other; a `roboxim_runs.executors.protocol.Worker`."""

    def __init__(self, settings: Mapping[str, Any], number: int) -> None:
        """Store where the experiment is.

        Args:
            settings: ``out``, the absolute path of the experiment's folder.
            number: The worker's number.
        """
        self._out = Path(settings["out"])

    def run(self, job: Any, note: Callable[[Any], None]) -> dict[str, Any]:
        """Run a training.

        Args:
            job: Its `Stage`, as plain data.
            note: Receives its events; see `roboxim_runs.training.commands.event_of`.

        Returns:
            ``wall_s``, ``continued`` and ``origin``, see `Trained`.

        Raises:
            ConfigError: When this machine does not see the training's dataset, or lacks the command.
            RoboximError: When the training fails; the message has the end of its log.
            WorkerBrokenError: When another worker has taken the training over.
        """
        stage, found = from_plain(job, Stage), list[Trained]()
        for need in stage.needs:
            if not (self._out / need).is_dir():
                raise ConfigError(
                    f"{stage.name}: the machine {socket.gethostname()} does not see {self._out / need}; trainings on "
                    "several machines need an output folder (--out) that all of them share under the same path"
                )

        def forward(event: Event) -> None:
            if type(event).__name__ in REPORTED:
                note({"event": type(event).__name__, "fields": to_plain(event)})

        with _Ownership(self._out / stage.name, lambda: note(None)) as ownership:
            train(
                (stage,),
                self._out,
                at_once=1,
                on_event=forward,
                on_trained=found.append,
                cancellation=ownership,
                end_s=SAVE_S,
            )
        (one,) = found
        return {"wall_s": one.wall_s, "continued": one.continued, "origin": to_plain(Origin.here())}

    def close(self) -> None:
        """Do nothing: a training ends with `run`."""


class _Ownership:
    """The right to a training's folder; a `Cancellation` that raises when another worker has it."""

    def __init__(self, folder: Path, alive: Callable[[], None]) -> None:
        self._file = folder.with_name(f".{folder.name}.worker")
        self._name = f"{socket.gethostname()} {os.getpid()} {uuid.uuid4().hex}"
        self._alive = alive
        self._checked = self._reported = time.monotonic()

    def __enter__(self) -> _Ownership:
        self._file.parent.mkdir(exist_ok=True)
        others = self._file.exists()
        write_whole(self._file, self._name)
        if others:
            time.sleep(YIELD_S)
            self._require()
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            if self._file.read_text() == self._name:
                self._file.unlink()

    def is_set(self) -> bool:
        """Return False; report now and then that the worker lives.

        Raises:
            WorkerBrokenError: When another worker has taken the training over.
        """
        now = time.monotonic()
        if now - self._checked >= LOOK_S:
            self._checked = now
            self._require()
        if now - self._reported >= ALIVE_S:
            self._reported = now
            self._alive()
        return False

    def _require(self) -> None:
        try:
            owner = self._file.read_text()
        except OSError as error:
            raise WorkerBrokenError(f"{self._file} cannot be read: {error}") from None
        if owner != self._name:
            raise WorkerBrokenError(f"the worker {owner} has taken the training over")
