"""The newest tick of a sim of this process: nodes of the same process take it from here, as values.

All other nodes get the tick's messages from the middleware.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from rclpy.context import Context

from roboxim_core.state import StateRecord
from roboxim_core.vision.renderer import CameraImages


@dataclass(frozen=True, kw_only=True)
class LocalTick:
    """A tick of a sim of this process."""

    state: StateRecord
    """The state."""
    images: Mapping[str, CameraImages]
    """Images by camera name; the arrays are read-only."""
    messages: Callable[[], Mapping[str, memoryview]]
    """Returns topic, relative to the graph's namespace, to the serialised message; the notice is last. Any thread may
    call it. The first call makes the messages, so unused messages cost nothing."""


_ticks: weakref.WeakKeyDictionary[Context, dict[str, LocalTick | None]] = weakref.WeakKeyDictionary()


def announce(context: Context, notices: str) -> None:
    """Announce that a sim of this process will provide its ticks.

    Args:
        context: Context of the sim.
        notices: Full name of the topic of its notices.
    """
    _ticks.setdefault(context, {})[notices] = None


def show(context: Context, notices: str, tick: LocalTick) -> None:
    """Replace the newest tick; see `announce`."""
    _ticks.setdefault(context, {})[notices] = tick


def withdraw(context: Context, notices: str) -> None:
    """Report that the sim has ended; see `announce`."""
    _ticks.get(context, {}).pop(notices, None)


def announced(context: Context, notices: str) -> bool:
    """Return whether a sim of this process provides its ticks; see `announce`."""
    return notices in _ticks.get(context, {})


def newest(context: Context, notices: str) -> LocalTick | None:
    """Return the newest tick; None: no sim of this process has provided one.

    Args:
        context: Context of the caller.
        notices: See `announce`.
    """
    return _ticks.get(context, {}).get(notices)


def shown(context: Context, notices: str, episode_id: str, seq: int) -> LocalTick | None:
    """Return a tick if it is the newest one; see `newest`."""
    tick = newest(context, notices)
    return tick if tick is not None and (tick.state.episode_id, tick.state.seq) == (episode_id, seq) else None
