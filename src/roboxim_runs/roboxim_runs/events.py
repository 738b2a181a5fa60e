"""Events of a run: frozen values, passed to its ``on_event`` in the thread that called it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from roboxim_runs.executors.protocol import Cancellation, CancelledError

if TYPE_CHECKING:
    from roboxim_core.episode import EpisodeResult


@dataclass(frozen=True, kw_only=True)
class StageStarted:
    """A countable stage of work begins; it ends with `StageFinished`, or with an error."""

    title: str
    """Title of the stage, a few words."""
    total: int
    """Total number of units; 1 while it is unknown."""
    done: int = 0
    """Units done before."""
    unit: str = ""
    """Unit of the count; empty: as the title names."""
    name: str = ""
    """Name of a stage that runs in parallel with others; its progress and its end have the same. Empty: it is the only
    one."""


@dataclass(frozen=True, kw_only=True)
class StageProgress:
    """Progress of a stage."""

    done: int
    """Units done."""
    total: int
    """Units in all."""
    note: str = ""
    """A short note on the progress."""
    name: str = ""
    """Name of the stage, see `StageStarted`."""


@dataclass(frozen=True, kw_only=True)
class StageFinished:
    """The stage is done."""

    name: str = ""
    """Name of the stage, see `StageStarted`."""


@dataclass(frozen=True, kw_only=True)
class EpisodeFinished:
    """An episode has finished; its result is on the disk."""

    folder: Path
    """The run's folder."""
    result: EpisodeResult
    """The result."""


@dataclass(frozen=True, kw_only=True)
class PolicyResumed:
    """An earlier call has run some episodes of a policy."""

    policy: str
    """Name of the policy."""
    there: int
    """Finished episodes."""
    episodes: int
    """Requested episodes."""
    since: str
    """When the last of them ended, local time, ``YYYY-MM-DD HH:MM``."""


@dataclass(frozen=True, kw_only=True)
class PolicyMeasured:
    """All episodes of a policy are finished."""

    policy: str
    """Name of the policy."""
    results: Sequence[EpisodeResult]
    """Its results."""


@dataclass(frozen=True, kw_only=True)
class PictureWritten:
    """A picture has been written."""

    path: Path
    """The picture."""


@dataclass(frozen=True, kw_only=True)
class Notice:
    """A message for the user."""

    text: str
    """One sentence."""


@dataclass(frozen=True, kw_only=True)
class Interrupted:
    """The run ends early, by Ctrl-C or by its cancellation; the same call continues with the missing parts."""

    text: str
    """Finished work, e.g. ``3 episodes are done in runs/demos``."""


Event = (
    StageStarted
    | StageProgress
    | StageFinished
    | EpisodeFinished
    | PolicyResumed
    | PolicyMeasured
    | PictureWritten
    | Notice
    | Interrupted
)
"""Any of them."""

OnEvent = Callable[[Event], None]


def ignore(_: Event) -> None:
    """Ignore an event."""


class ReportProgress(Protocol):
    """Reports the progress of a stage."""

    def __call__(self, done: int, total: int = 0, note: str = "") -> None:
        """Report progress.

        Args:
            done: Units done.
            total: Units in all; 0: as the stage began.
            note: A short note.

        Raises:
            CancelledError: When the run was cancelled.
        """
        ...


@dataclass(frozen=True)
class Reporter:
    """Reports the stages of a run, and ends the run when it is cancelled."""

    on_event: OnEvent = ignore
    """Receives the events."""
    cancellation: Cancellation | None = None
    """Ends the run when it is set."""

    def require_wanted(self) -> None:
        """Raise when the run was cancelled.

        Raises:
            CancelledError: When it was.
        """
        if self.cancellation is not None and self.cancellation.is_set():
            raise CancelledError("the run was cancelled")

    def notice(self, text: str) -> None:
        """Report a message for the user; an empty text reports nothing."""
        if text:
            self.on_event(Notice(text=text))

    @contextmanager
    def stage(self, title: str, total: int = 1, unit: str = "", done: int = 0) -> Iterator[ReportProgress]:
        """Report the start of a stage, and its end when the block ends without an error.

        Args:
            title: Title of the stage, a few words.
            total: Total number of units; 1 while it is unknown.
            unit: Unit of the count; empty: as the title names.
            done: Units done before.

        Yields:
            Reports progress.
        """

        def progress(done: int, total: int = total, note: str = "") -> None:
            self.on_event(StageProgress(done=done, total=total, note=note))
            self.require_wanted()

        self.on_event(StageStarted(title=title, total=total, done=done, unit=unit))
        yield progress
        self.on_event(StageFinished())

    @contextmanager
    def resumable(self, state: str | Callable[[], str]) -> Iterator[None]:
        """Report `Interrupted` when Ctrl-C or a cancellation ends the block; the exception still propagates.

        Args:
            state: Description of the finished work, or how to continue; a function is called when the block ends.
        """
        try:
            yield
        except (KeyboardInterrupt, CancelledError):
            self.on_event(Interrupted(text=state if isinstance(state, str) else state()))
            raise
