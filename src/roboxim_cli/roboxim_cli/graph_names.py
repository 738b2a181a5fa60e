"""Names of a running graph's topics, services, actions and nodes: tab completion, and the commands that list them."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable
from typing import Any

import click

from roboxim_bringup.attach import Peer, on_graph
from roboxim_core.errors import RoboximError
from roboxim_core.whole_files import write_whole

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


def add_names(group: click.Group, kind: str, *, hidden: str = "") -> None:
    """Add the commands that list the names of a kind and print the type of one.

    Args:
        group: Receives them.
        kind: ``topic``, ``service`` or ``action``.
        hidden: Help of the option that includes hidden names; empty: there is no such option.
    """
    option: Callable[[Any], Any] = (
        click.option("-a", "--all", "hidden", is_flag=True, help=hidden) if hidden else lambda command: command
    )

    @group.command("list", help=f"List the {kind}s.")
    @click.option("-t", "--show-types", is_flag=True, help="Also print the types.")
    @option
    @on_graph
    def list_names(peer: Peer, show_types: bool, **which: bool) -> None:
        peer.settle()
        for name, types in getattr(peer, f"{kind}s")(**which).items():
            click.echo(f"{name} [{', '.join(types)}]" if show_types else name)

    @group.command("type", help=f"Print the type of {'an' if kind == 'action' else 'a'} {kind}.")
    @click.argument("name", shell_complete=complete(f"{kind}s"))
    @on_graph
    def print_type(peer: Peer, name: str) -> None:
        click.echo(peer.type_of(kind, name))


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
    write_whole(file, json.dumps(found))
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
