"""What a run tells while it goes on: frozen values, given to its ``on_event`` in the thread that called it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from roboxim_bringup.executors.protocol import CancelledError
from roboxim_core.episode import EpisodeResult


@dataclass(frozen=True, kw_only=True)
class StageStarted:
    """A countable piece of work begins; it ends with `StageFinished`, or with an error."""

    title: str
    """What is done, a few words."""
    total: int
    """Units in all; 1 where that is not known yet."""
    done: int = 0
    """Units done before."""
    unit: str = ""
    """What is counted; empty: what the title names."""


@dataclass(frozen=True, kw_only=True)
class StageProgress:
    """How far the stage is."""

    done: int
    """Units done."""
    total: int
    """Units in all."""
    note: str = ""
    """What there is to say, short."""


@dataclass(frozen=True, kw_only=True)
class StageFinished:
    """The stage is done."""


@dataclass(frozen=True, kw_only=True)
class EpisodeFinished:
    """An episode was run; its result is on the disk."""

    folder: Path
    """The run's folder."""
    result: EpisodeResult
    """The result."""


@dataclass(frozen=True, kw_only=True)
class PolicyResumed:
    """Some episodes of a policy were run by an earlier call."""

    policy: str
    """Name of the policy."""
    there: int
    """Episodes that are there."""
    episodes: int
    """Episodes that are asked for."""
    since: str
    """When the last of them ended, local time, ``YYYY-MM-DD HH:MM``."""


@dataclass(frozen=True, kw_only=True)
class PolicyMeasured:
    """All episodes of a policy are done."""

    policy: str
    """Name of the policy."""
    results: Sequence[EpisodeResult]
    """Its results."""


@dataclass(frozen=True, kw_only=True)
class PictureWritten:
    """There is something to look at."""

    path: Path
    """The picture."""


@dataclass(frozen=True, kw_only=True)
class Notice:
    """Something that the user should know."""

    text: str
    """One sentence."""


@dataclass(frozen=True, kw_only=True)
class Interrupted:
    """The run ends early, by Ctrl-C or by its cancellation; the same call goes on with what is missing."""

    text: str
    """What is there, e.g. ``3 episodes are done in runs/demos``."""


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


@contextmanager
def telling_interruption(on_event: OnEvent, state: Callable[[], str]) -> Iterator[None]:
    """Tell `Interrupted` when the block is left by Ctrl-C or by a cancellation, and go on raising.

    Args:
        on_event: Who is told.
        state: Says what is there by then.
    """
    try:
        yield
    except (KeyboardInterrupt, CancelledError):
        on_event(Interrupted(text=state()))
        raise
