"""List actions and send goals."""

from __future__ import annotations

from typing import Any

import click

from roboxim_bringup.attach import Peer, absolute, attach_options, attached, on_graph
from roboxim_cli import strict
from roboxim_cli.graph_names import add_names, complete
from roboxim_cli.options import POSITIVE


@strict.group()
def command() -> None:
    """List the actions of a running graph and send goals."""


add_names(command, "action")


@command.command("info")
@click.argument("name", shell_complete=complete("actions"))
@on_graph
def info(peer: Peer, name: str) -> None:
    """Print the type, servers and clients of an action."""
    from rclpy.action import get_action_client_names_and_types_by_node, get_action_server_names_and_types_by_node

    type_name = peer.type_of("action", name)
    peer.settle()
    nodes = peer.node.get_node_names_and_namespaces()
    sides = {
        "servers": get_action_server_names_and_types_by_node,
        "clients": get_action_client_names_and_types_by_node,
    }
    found = {
        side: [
            f"{namespace.rstrip('/')}/{base}"
            for base, namespace in nodes
            if any(action == absolute(name) for action, _ in ask(peer.node, base, namespace))
        ]
        for side, ask in sides.items()
    }
    click.echo(f"Action: {absolute(name)} [{type_name}]")
    for side, names in found.items():
        click.echo(f"Action {side}: {len(names)}")
        for node in names:
            click.echo(f"    {node}")


@command.command("send_goal")
@click.argument("name", shell_complete=complete("actions"))
@click.argument("words", nargs=-1, metavar="[TYPE] [YAML]")
@click.option("-f", "--feedback", is_flag=True, help="Print the feedback.")
@click.option(
    "--timeout",
    type=POSITIVE,
    default=600.0,
    show_default=True,
    help="Longest wait for the result [s].",
)
@click.option("--full", is_flag=True, help="Do not shorten long arrays.")
@attach_options
def send_goal(
    name: str,
    words: tuple[str, ...],
    feedback: bool,
    timeout: float,
    full: bool,
    run_id: str | None,
    domain: int | None,
) -> None:
    """Send a goal and print its result as YAML; Ctrl-C cancels the goal."""
    from roboxim_cli.messages import look_up, message_from_plain, message_to_plain
    from roboxim_cli.ros.service import split_type
    from roboxim_core.errors import ErrorCode, RoboximError
    from roboxim_core.plain_data.yaml_text import dump, parse

    type_name, text = split_type(words)
    data = parse(text, source="goal") if text else None

    def show(message: Any) -> None:
        click.echo("feedback:\n" + dump(message_to_plain(message.feedback, full=full)), nl=False)

    with attached(run_id, domain) as peer:
        cls = look_up(type_name or peer.type_of("action", name), "action")
        goal = message_from_plain(cls.Goal, data)
        from roboxim_ros.actions import ActionCall

        with ActionCall(peer.clients, cls, absolute(name)) as action:
            click.echo(f"sending a goal to {absolute(name)}", err=True)
            result = action.run(goal, feedback=show if feedback else None, timeout_s=timeout)
    click.echo(dump(message_to_plain(result.result, full=full)), nl=False)
    click.echo(f"goal ended: {result.status}", err=True)
    if result.status != "succeeded":
        code = getattr(result.result, "error_code", 0) or ErrorCode.INTERNAL
        known = code if code in list(ErrorCode) else ErrorCode.INTERNAL
        message = getattr(result.result, "error_msg", "") or getattr(result.result, "error_string", "")
        raise RoboximError(f"{absolute(name)}: {result.status}: {message}", known)
