"""Start all nodes of the graph."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import click

from roboxim_bringup.attach import graph_namespace
from roboxim_bringup.graph import NODES
from roboxim_cli import strict
from roboxim_cli.named import Named
from roboxim_cli.ros.node import membership_options, namespace_option


@strict.command(begins="starting the graph")
@click.option("--processes", is_flag=True, help="One process per node; default: all nodes in this process.")
@click.option(
    "--only", "nodes", multiple=True, type=click.Choice(list(NODES)), help="Start only this node; may be repeated."
)
@click.option(
    "--policy", "policy_specs", type=Named("policy"), multiple=True, metavar="[NAMESPACE=]SPEC",
    help="Also serve a policy, e.g. random or mine=my_module:MyPolicy; may be repeated.",
)  # fmt: skip
@click.option("--id", "run_id", metavar="ID", help="Name of the run; default: a new one.")
@click.option("--domain", type=click.IntRange(0, 232), help="ROS domain; default: one that is unused on this machine.")
@click.option("--detach", is_flag=True, help="Return when the graph is ready; end it with: roboxim down.")
@namespace_option
@membership_options
def command(
    processes: bool,
    nodes: tuple[str, ...],
    policy_specs: tuple[str, ...],
    run_id: str | None,
    domain: int | None,
    detach: bool,
    namespace: str,
    params_files: tuple[str, ...],
    assignments: tuple[str, ...],
    open_network: bool,
) -> None:
    r"""Start all nodes of the graph and keep them running until Ctrl-C.

    \b
    roboxim up
    roboxim up --processes -p sim:renderer:=tiny -p tasks:visible_renderer:=tiny

    The run registers itself, so that every other roboxim command on this machine finds it.
    """
    if detach:
        from roboxim_cli.detach import start_detached
        from roboxim_ros.runs import check_run_id

        check_run_id(run_id)
        start_detached(run_id)
        return
    from roboxim_bringup.parameters import merge, parse_assignments, parse_policy, read_params_files
    from roboxim_ros.runs import activate_transport, extend_run, free_domain, register_run

    namespace = graph_namespace(namespace)
    parameters = merge(read_params_files(params_files, namespace=namespace), parse_assignments(assignments))
    policies = [parse_policy(word) for word in policy_specs]
    activate_transport(open_network=open_network)
    reservation = free_domain() if domain is None else contextlib.nullcontext(domain)
    with (
        reservation as own_domain,
        register_run("up", domain=own_domain, namespaces=[namespace], run_id=run_id) as run,
    ):
        run.join()
        start = _in_processes if processes else _in_process
        with start(nodes or tuple(NODES), policies, namespace, parameters) as (node_names, supervise):
            extend_run(run.id, nodes=node_names)
            reach = (
                ": every host and user that reaches this machine can control it"
                if open_network
                else "; only you can reach it"
            )
            text = f"run {run.id} is up in domain {run.domain}{reach}\n"
            text += "try in another terminal: roboxim service list; Ctrl-C ends the run"
            from roboxim_ros.host import wait_for_stop

            wait_for_stop(supervise, on_waiting=lambda: click.echo(text))  # whoever reads it may end the run at once
            click.echo("ending the run")


@contextlib.contextmanager
def _in_process(
    nodes: Sequence[str], policies: Sequence[Any], namespace: str, parameters: dict[str, dict[str, Any]]
) -> Iterator[tuple[list[str], Callable[[], bool]]]:
    from roboxim_bringup.graph import start_graph
    from roboxim_core.errors import RoboximError
    from roboxim_ros.host import NodeHost

    with NodeHost() as host:
        graph = start_graph(host, namespace=namespace, parameters=parameters, nodes=nodes, policies=policies)

        def supervise() -> bool:
            if not host.alive():
                raise RoboximError(f"node {', '.join(host.dead())} has died; see the traceback above")
            return False

        yield graph.node_names(), supervise


@contextlib.contextmanager
def _in_processes(
    nodes: Sequence[str], policies: Sequence[Any], namespace: str, parameters: dict[str, dict[str, Any]]
) -> Iterator[tuple[list[str], Callable[[], bool]]]:
    from roboxim_bringup.supervisor import Supervisor

    with Supervisor(nodes, policies, namespace=namespace, parameters=parameters) as supervisor:
        started = time.monotonic()
        supervisor.wait_until_ready()
        click.echo(f"{len(supervisor.children)} processes ready after {time.monotonic() - started:.1f} s")
        yield supervisor.node_names(), supervisor.supervise
