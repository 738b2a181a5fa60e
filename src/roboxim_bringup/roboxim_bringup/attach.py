"""A short-lived participant in a running graph, for one command."""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import click

from roboxim_core.errors import ConfigError, UnavailableError, one_of

T = TypeVar("T")
LOOK_S = 3.0
"""Longest search for a name in a graph whose known nodes are all discovered [s]."""
PATIENCE_S = 60.0
"""Longest wait for the run's known nodes [s]; discovery is slow on a busy machine."""
LOOK_PERIOD_S = 0.01
"""Time between two queries of the graph [s]."""
QUIET_LOOKS = 25
"""Number of queries without a change after which the graph counts as known. Counted in queries because a busy machine
delays discovery and queries alike."""


def _complete_runs(*_: Any) -> list[str]:
    from roboxim_ros.runs import live_runs

    return [run.id for run in live_runs()]


run_option = click.option(
    "--run", "run_id", metavar="ID", help="Run to attach to (see: roboxim runs); default: the only one.",
    shell_complete=_complete_runs,
)  # fmt: skip


def attach_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add ``--run`` and ``--domain`` to a command; pass both to `attached`."""
    command = click.option("--domain", type=click.IntRange(0, 232), help="ROS domain, instead of a run's.")(command)
    return run_option(command)


def on_graph(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add ``--run`` and ``--domain`` to a command, and pass it a `Peer` of the graph as its first argument."""

    @functools.wraps(command)
    def attach(run_id: str | None, domain: int | None, **options: Any) -> Any:
        with attached(run_id, domain) as peer:
            return command(peer, **options)

    return attach_options(attach)


def join_run(run_id: str | None, domain: int | None) -> Sequence[str]:
    """Set the environment so that contexts of this process join a run or a domain.

    Returns:
        Full names of the run's known nodes.

    Raises:
        ConfigError: When there is no such run, or both are given.
    """
    from roboxim_ros.runs import activate_transport, find_run

    if domain is None:
        run = find_run(run_id)
        run.join()
        return run.nodes
    if run_id is not None:
        raise ConfigError("--run and --domain exclude each other")
    activate_transport()
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    os.environ.pop("ROBOXIM_RUN", None)
    return ()


class Peer:
    """A node in a running graph of another process."""

    def __init__(self, expected: Sequence[str] = ()) -> None:
        """Join the domain that the environment names.

        Args:
            expected: Full names of nodes that must be discovered before the graph counts as known.
        """
        from roboxim_ros.clients import Clients
        from roboxim_ros.host import NodeHost

        self.expected = set(expected)
        self._complete_since: float | None = None
        self.host = NodeHost()
        self.clients = Clients(f"_roboxim_cli_{os.getpid()}", context=self.host.context)
        self.node = self.clients.node

    def close(self) -> None:
        """Destroy the node properly; a peer that just disappears delays the answers to the next command."""
        self.clients.close()
        self.host.close()

    def wake(self) -> None:
        """Wake the peer's thread, so that it serves a new subscription or client of the node."""
        self.clients.wake()

    def look_for(self, find: Callable[[], T | None], missing: Callable[[], str]) -> T:
        """Wait until a search of the graph succeeds.

        Args:
            find: Returns the value, or None.
            missing: Returns the error's message.

        Raises:
            UnavailableError: With that message.
        """
        begun = time.monotonic()
        while (found := find()) is None:
            if self._search_is_over(begun):
                raise UnavailableError(missing())
            time.sleep(LOOK_PERIOD_S)
        return found

    def settle(self) -> None:
        """Wait until the graph no longer changes."""
        seen: Any = None
        quiet = 0
        begun = time.monotonic()
        while not self._search_is_over(begun) and quiet <= QUIET_LOOKS:
            now = (self.nodes(hidden=True), self.topics(hidden=True), self.services(hidden=True))
            known = now == seen and len(now[0]) > 1 and self._is_complete()
            seen, quiet = now, quiet + 1 if known else 0
            time.sleep(LOOK_PERIOD_S)

    def _is_complete(self) -> bool:
        """Return whether all of the run's known nodes have been discovered."""
        if self._complete_since is None and self.expected <= set(self.nodes(hidden=True)):
            self._complete_since = time.monotonic()
        return self._complete_since is not None

    def _search_is_over(self, begun: float) -> bool:
        """Return whether a search that began at a time [s] has lasted long enough to conclude absence."""
        now = time.monotonic()
        complete = self._is_complete() and now - max(begun, self._complete_since or 0.0) > LOOK_S
        return complete or now - begun > PATIENCE_S

    def nodes(self, *, hidden: bool = False) -> list[str]:
        """Return the full names of the nodes."""
        pairs = self.node.get_node_names_and_namespaces()
        names = {f"{namespace.rstrip('/')}/{name}" for name, namespace in pairs}
        return sorted(name for name in names if hidden or not _is_hidden(name))

    def topics(self, *, hidden: bool = False) -> dict[str, list[str]]:
        """Return the topics and their types."""
        return _named(self.node.get_topic_names_and_types(), hidden)

    def services(self, *, hidden: bool = False) -> dict[str, list[str]]:
        """Return the services and their types; those that implement actions are hidden."""
        return _named(self.node.get_service_names_and_types(), hidden)

    def actions(self) -> dict[str, list[str]]:
        """Return the actions and their types."""
        from rclpy.action import get_action_names_and_types

        return _named(get_action_names_and_types(self.node), hidden=False)

    def type_of(self, what: str, name: str) -> str:
        """Return the type of a service, topic or action.

        Args:
            what: ``service``, ``topic`` or ``action``.
            name: Its name.

        Raises:
            UnavailableError: When the graph has no such name; the message lists the known ones.
            ConfigError: When the name has several types.
        """
        name, listing = absolute(name), getattr(self, f"{what}s")
        types: list[str] = self.look_for(
            lambda: listing(**({} if what == "action" else {"hidden": True})).get(name),
            lambda: f"no {what} '{name}' in the graph; {one_of(filter(is_own_service, listing()), name)}",
        )
        if len(types) > 1:
            raise ConfigError(f"{what} '{name}' has several types ({', '.join(types)}); give one of them")
        return types[0]


def parameter_names(peer: Peer, node: str) -> list[str]:
    """Return the names of a node's parameters, sorted.

    Raises:
        UnavailableError: When the graph has no such node.
    """
    from rcl_interfaces.srv import ListParameters

    return sorted(call_node(peer, node, ListParameters, "list_parameters").result.names)


def call_node(peer: Peer, node: str, srv_type: Any, service: str, **fields: Any) -> Any:
    """Call one of a node's parameter services.

    Raises:
        UnavailableError: When the graph has no such node.
    """
    name = absolute(node)
    peer.look_for(
        lambda: peer.services().get(f"{name}/{service}"),
        lambda: f"no node '{name}' with parameters in the graph; {one_of(peer.nodes(), name)}",
    )
    return peer.clients.call(srv_type, f"{name}/{service}", srv_type.Request(**fields), timeout_s=60)


def absolute(name: str) -> str:
    """Return a name with its leading slash."""
    return name if name.startswith("/") else f"/{name}"


def graph_namespace(name: str) -> str:
    """Return a graph's namespace in the form ``/w0``; empty for the root, which may also be given as ``/``."""
    name = name.strip("/")
    return absolute(name) if name else ""


def is_own_service(name: str) -> bool:
    """Return whether a service is specific to its node, unlike the services that every node has."""
    return not name.endswith(("_parameters", "_parameter_types", "_parameters_atomically", "/get_type_description"))


def _is_hidden(name: str) -> bool:
    return any(part.startswith("_") for part in name.split("/"))


def _named(pairs: Any, hidden: bool) -> dict[str, list[str]]:
    return {name: sorted(types) for name, types in sorted(pairs) if hidden or not _is_hidden(name)}


@contextmanager
def attached(run_id: str | None, domain: int | None) -> Iterator[Peer]:
    """Join a run for as long as the block runs; see `attach_options`."""
    peer = Peer(join_run(run_id, domain))
    try:
        yield peer
    finally:
        peer.close()
