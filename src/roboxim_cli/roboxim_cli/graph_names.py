"""Tab completion of a running graph's topics, services, actions and nodes."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from roboxim_core.errors import RoboximError

FRESH_S = 20.0
"""Time for which a completion's names are reused [s]."""


def complete(kind: str) -> Callable[[click.Context, click.Parameter, str], list[str]]:
    """Return a completion for click.

    Args:
        kind: ``topics``, ``services``, ``actions`` or ``nodes``.
    """

    def names(ctx: click.Context, _: click.Parameter, incomplete: str) -> list[str]:
        # A failed look-up completes to nothing; the command itself reports the error.
        with contextlib.suppress(RoboximError, OSError):
            found = _graph(ctx.params.get("run_id"))[kind]
            slash = "" if incomplete.startswith("/") else "/"
            return [name for name in found if name.startswith(slash + incomplete)]
        return []

    return names


def _graph(run_id: str | None) -> dict[str, list[str]]:
    """Return the names in a run's graph, by kind.

    Raises:
        ConfigError: When there is no such run.
    """
    from roboxim_ros.runs import find_run, runtime_dir

    file = runtime_dir() / f"{find_run(run_id).id}.names"
    if time.time() - (file.stat().st_mtime if file.exists() else 0.0) < FRESH_S:
        return dict(json.loads(file.read_text()))
    found = _look(run_id)
    _keep(file, found)
    return found


def _look(run_id: str | None) -> dict[str, list[str]]:
    from roboxim_bringup.attach import attached, is_own_service

    with attached(run_id, None) as peer:
        peer.settle()
        return {
            "topics": list(peer.topics()),
            "services": [name for name in peer.services() if is_own_service(name)],
            "actions": list(peer.actions()),
            "nodes": peer.nodes(),
        }


def _keep(file: Path, found: Any) -> None:
    temporary = file.with_suffix(".names.new")
    temporary.write_text(json.dumps(found))
    temporary.replace(file)
