"""The newest tick of a sim of this process, as it was published: a recorder of the same process takes it from here.

Everybody else gets the same messages from the middleware.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from dataclasses import dataclass

from rclpy.context import Context


@dataclass(frozen=True, kw_only=True)
class PublishedTick:
    """A tick's messages."""

    episode_id: str
    """Episode; empty: none."""
    seq: int
    """Number of the tick."""
    stamp_ns: int
    """Its stamp [ns]."""
    messages: Mapping[str, bytes]
    """Topic, relative to the graph's namespace, to the serialised message; the notice is last."""


_ticks: weakref.WeakKeyDictionary[Context, dict[str, PublishedTick]] = weakref.WeakKeyDictionary()


def show(context: Context, notices: str, tick: PublishedTick) -> None:
    """Replace the newest tick.

    Args:
        context: Context of the sim.
        notices: Full name of the topic of its notices.
        tick: The tick.
    """
    _ticks.setdefault(context, {})[notices] = tick


def shown(context: Context, notices: str) -> PublishedTick | None:
    """Return the newest tick; None: no sim of this process has published one.

    Args:
        context: Context of the caller.
        notices: See `show`.
    """
    return _ticks.get(context, {}).get(notices)
