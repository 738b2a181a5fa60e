"""Start one node, or inspect running nodes."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import click

from roboxim_bringup.attach import Peer, absolute, attach_options, graph_namespace, on_graph
from roboxim_cli import strict
from roboxim_cli.graph_names import complete
from roboxim_cli.options import with_options


class _NodeGroup(strict.Group):
    """The group ``roboxim node``: ``node sim`` starts a node, ``node list`` lists the running ones."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        from roboxim_bringup.graph import NODES

        return [*super().list_commands(ctx), *NODES]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        from roboxim_bringup.graph import NODES

        return _starter(cmd_name) if cmd_name in NODES else super().get_command(ctx, cmd_name)


@strict.group(cls=_NodeGroup)
def command() -> None:
    """Start one node of the graph, or inspect running nodes."""


def _starter(name: str) -> click.Command:
    def start(**options: Any) -> None:
        run_node(name, **options)

    start.__doc__ = f"""Start the {name} node.

    The node joins the only live run (or --run). Without a live run, it starts its own.
    """
    return strict.command(name)(namespace_option(membership_options(attach_options(start))))


membership_options = with_options(
    click.option(
        "--params-file", "params_files", multiple=True, type=click.Path(exists=True, dir_okay=False),
        help="ROS 2 parameter file; may be repeated.",
    ),
    click.option(
        "-p", "--param", "assignments", multiple=True, metavar="[NODE:]NAME:=VALUE",
        help="A parameter; may be repeated.",
    ),
    click.option(
        "--open-network", is_flag=True,
        help="Let other hosts and users reach the graph of a new run; default: only you, on this machine.",
    ),
)  # fmt: skip
"""Adds the options that all commands that start nodes share."""


namespace_option = click.option("--namespace", default="", help="Namespace of the graph, e.g. /w0.")


def run_node(
    name: str,
    *,
    namespace: str,
    params_files: tuple[str, ...],
    assignments: tuple[str, ...],
    open_network: bool,
    run_id: str | None,
    domain: int | None,
    policies: tuple[Any, ...] = (),
) -> None:
    """Run one node until Ctrl-C, SIGTERM or its death.

    Args:
        name: One of ``graph.NODES``; empty: only the policies.
        namespace: Namespace of the graph.
        params_files: ROS 2 parameter files.
        assignments: ``name:=value`` words.
        open_network: Whether other hosts may reach it.
        run_id: Run to join.
        domain: ROS domain, instead of a run's.
        policies: Policies to run.

    Raises:
        ConfigError: When a parameter, the run or the policy is wrong.
        RoboximError: When the node died.
    """
    from roboxim_bringup.graph import start_graph
    from roboxim_bringup.parameters import merge, parse_assignments, read_params_files
    from roboxim_core.errors import RoboximError
    from roboxim_ros.host import NodeHost, wait_for_stop

    label = name or policies[0].namespace
    namespace = graph_namespace(namespace)
    from_files = read_params_files(params_files, namespace=namespace)
    own_values = {node: values for node, values in from_files.items() if node == label}
    common = from_files.get("", {})
    parameters = merge({label: dict(common)}, own_values, parse_assignments(assignments, node=label))
    with (
        membership("node" if name else "policy", run_id, domain, open_network, namespace) as member,
        NodeHost() as host,
    ):
        graph = start_graph(
            host, namespace=namespace, parameters=parameters, nodes=(name,) if name else (), policies=policies
        )
        names = graph.node_names()
        member.announce(names)
        text = f"{', '.join(names)} serves in {member.where}; Ctrl-C ends it"
        wait_for_stop(lambda: not host.alive(), on_waiting=lambda: click.echo(text))
        if not host.alive():
            raise RoboximError(f"node '{label}' has died; see the traceback above")


@dataclass
class Member:
    """A process in a run."""

    where: str
    """The run or domain, for messages."""
    run_id: str = ""
    """Name of the run; empty: a domain without a run."""
    nodes: tuple[str, ...] = ()
    """Full names of its announced nodes."""

    def announce(self, nodes: Sequence[str]) -> None:
        """Register this process and its nodes with the run."""
        from roboxim_ros.runs import extend_run

        self.nodes = tuple(nodes)
        if self.run_id:
            extend_run(self.run_id, pids=[os.getpid()], nodes=nodes)


@contextlib.contextmanager
def membership(
    kind: str, run_id: str | None, domain: int | None, open_network: bool, namespace: str
) -> Iterator[Member]:
    """Join a run, or start one when none is alive.

    Args:
        kind: Kind of a new run; its name begins with it.
        run_id: Run to join; none: the only one.
        domain: ROS domain, instead of a run's.
        open_network: Whether other hosts may reach a new run.
        namespace: Namespace of the graph in a new run.

    Raises:
        ConfigError: When there is no such run, or several to choose from.
    """
    from roboxim_bringup.attach import join_run
    from roboxim_ros.runs import JOINABLE, activate_transport, find_run, free_domain, leave_run, live_runs, register_run

    if domain is not None:
        join_run(run_id, domain)
        activate_transport(open_network or None)
        yield Member(f"domain {domain}")
    elif run_id or os.environ.get("ROBOXIM_RUN") or any(run.kind in JOINABLE for run in live_runs()):
        if open_network:
            raise click.UsageError("--open-network applies to a new run only; leave it out to join the live run")
        run = find_run(run_id)
        run.join()
        member = Member(f"run {run.id}", run.id)
        try:
            yield member
        finally:
            leave_run(run.id, os.getpid(), nodes=member.nodes)
    else:
        activate_transport(open_network)
        with free_domain() as own, register_run(kind, domain=own, namespaces=[namespace]) as run:
            run.join()
            yield Member(f"run {run.id}", run.id)


@command.command("list")
@click.option("-a", "--all", "hidden", is_flag=True, help="Include hidden nodes.")
@on_graph
def list_nodes(peer: Peer, hidden: bool) -> None:
    """List the nodes."""
    peer.settle()
    for name in peer.nodes(hidden=hidden):
        click.echo(name)


@command.command("info")
@click.argument("name", shell_complete=complete("nodes"))
@on_graph
def info(peer: Peer, name: str) -> None:
    """Print what a node publishes, subscribes to, serves and calls."""
    from roboxim_core.errors import one_of

    name = absolute(name)
    namespace, _, base = name.rpartition("/")
    peer.look_for(
        lambda: True if name in peer.nodes(hidden=True) else None,
        lambda: f"no node '{name}' in the graph; {one_of(peer.nodes(), name)}",
    )
    peer.settle()
    from rclpy.action import get_action_client_names_and_types_by_node, get_action_server_names_and_types_by_node

    node, where = peer.node, (base, namespace or "/")
    sections = {
        "Subscribers": node.get_subscriber_names_and_types_by_node(*where),
        "Publishers": node.get_publisher_names_and_types_by_node(*where),
        "Service Servers": node.get_service_names_and_types_by_node(*where),
        "Service Clients": node.get_client_names_and_types_by_node(*where),
        "Action Servers": get_action_server_names_and_types_by_node(node, *where),
        "Action Clients": get_action_client_names_and_types_by_node(node, *where),
    }
    click.echo(name)
    for title, entries in sections.items():
        click.echo(f"  {title}:")
        for entry, types in sorted(entries):
            if "/_action/" not in entry:
                click.echo(f"    {entry}: {', '.join(types)}")
