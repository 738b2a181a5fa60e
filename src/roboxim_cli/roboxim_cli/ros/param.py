"""List, read and set parameters of nodes."""

from __future__ import annotations

from typing import Any

import click

from roboxim_bringup.attach import Peer, absolute, attach_options, attached, call_node, on_graph, parameter_names
from roboxim_cli import strict
from roboxim_cli.graph_names import complete


@strict.group()
def command() -> None:
    """List, read and set the parameters of running nodes."""


@command.command("list")
@click.argument("node", required=False, shell_complete=complete("nodes"))
@on_graph
def list_parameters(peer: Peer, node: str | None) -> None:
    """List the parameters of one node, or of all."""
    if node is None:
        peer.settle()
    ending = "/list_parameters"
    nodes = [name.removesuffix(ending) for name in peer.services() if name.endswith(ending)]
    for name in [absolute(node)] if node else nodes:
        click.echo(f"{name}:")
        for parameter in parameter_names(peer, name):
            click.echo(f"  {parameter}")


@command.command("get")
@click.argument("node", shell_complete=complete("nodes"))
@click.argument("name")
@on_graph
def get(peer: Peer, node: str, name: str) -> None:
    """Print the value of a parameter."""
    from roboxim_core.plain_data.yaml_text import dump

    _require(peer, node, name)
    value = _values(peer, node, [name])[0]
    click.echo(dump(value), nl=False)


@command.command("dump")
@click.argument("node", shell_complete=complete("nodes"))
@on_graph
def dump_parameters(peer: Peer, node: str) -> None:
    """Print all parameters of a node as a parameter file."""
    from roboxim_core.plain_data.yaml_text import dump

    names = parameter_names(peer, node)
    values = dict(zip(names, _values(peer, node, names), strict=True))
    click.echo(dump({absolute(node): {"ros__parameters": values}}), nl=False)


@command.command("set")
@click.argument("node", shell_complete=complete("nodes"))
@click.argument("name")
@click.argument("value")
@attach_options
def set_parameter(node: str, name: str, value: str, run_id: str | None, domain: int | None) -> None:
    """Set a parameter; the value is YAML."""
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    from roboxim_core.errors import ConfigError
    from roboxim_core.plain_data.yaml_text import parse

    try:
        parameter = Parameter(name, value=parse(value, source="value")).to_parameter_msg()
    except TypeError:
        raise ConfigError(
            f"'{value}' is not a parameter value; expected a scalar or a list of scalars of one type"
        ) from None
    with attached(run_id, domain) as peer:
        _require(peer, node, name)
        [result] = call_node(peer, node, SetParameters, "set_parameters", parameters=[parameter]).results
    if not result.successful:
        raise ConfigError(f"parameter '{name}' of {absolute(node)} was not set: {result.reason}")
    click.echo(f"{name} is now {value}")


@command.command("describe")
@click.argument("node", shell_complete=complete("nodes"))
@click.argument("names", nargs=-1)
@on_graph
def describe(peer: Peer, node: str, names: tuple[str, ...]) -> None:
    """Print type, range and description of parameters; default: of all."""
    from rcl_interfaces.srv import DescribeParameters
    from rclpy.parameter import Parameter

    for name in names:
        _require(peer, node, name)
    wanted = list(names) or parameter_names(peer, node)
    described = call_node(peer, node, DescribeParameters, "describe_parameters", names=wanted).descriptors
    values = _values(peer, node, wanted)
    for descriptor, value in zip(described, values, strict=True):
        kind = Parameter.Type(descriptor.type).name.lower().replace("_", " ")
        click.echo(f"{descriptor.name} ({kind}{', read-only' if descriptor.read_only else ''}): {value!r}")
        for limits in (*descriptor.integer_range, *descriptor.floating_point_range):
            click.echo(f"  from {limits.from_value:g} to {limits.to_value:g}")
        if descriptor.description:
            click.echo(f"  {descriptor.description}")


def _require(peer: Peer, node: str, name: str) -> None:
    from roboxim_core.errors import ConfigError, one_of

    names = parameter_names(peer, node)
    if name not in names:
        raise ConfigError(f"node {absolute(node)} has no parameter '{name}'; {one_of(names, name)}")


def _values(peer: Peer, node: str, names: list[str]) -> list[Any]:
    from rcl_interfaces.srv import GetParameters
    from rclpy.parameter import parameter_value_to_python

    values = call_node(peer, node, GetParameters, "get_parameters", names=names).values
    plain = [parameter_value_to_python(value) for value in values]
    return [list(value) if hasattr(value, "typecode") or isinstance(value, tuple) else value for value in plain]
