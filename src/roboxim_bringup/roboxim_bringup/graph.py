"""The table of nodes, and how to start a graph of them in this process."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from roboxim_core.errors import ConfigError, one_of

NODES = {
    "sim": "roboxim_sim.node:SimNode",
    "planner": "roboxim_planner.node:PlannerNode",
    "tasks": "roboxim_tasks.node:TaskNode",
    "recorder": "roboxim_recorder.node:RecorderNode",
    "evaluator": "roboxim_eval.node:EvaluatorNode",
}
"""Name to ``module:class``; the evaluator is last, so that its services mean that the graph is complete."""

Parameters = Mapping[str, Mapping[str, Any]]
"""Node name to parameter name to value; the empty node name: every node that declares the parameter."""


@dataclass(frozen=True, kw_only=True)
class PolicyLaunch:
    """A policy that runs inside a graph."""

    spec: str
    """Registered name, ``module:Class`` or ``path/to/file.py:Class``."""
    namespace: str = "policy"
    """Namespace of its services, relative to the graph's."""
    options: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of its class."""


def node_class(name: str) -> Any:
    """Import a node's class.

    Raises:
        ConfigError: When no node has that name.
    """
    if name not in NODES:
        raise ConfigError(f"no node '{name}'; {one_of(NODES, name)}")
    module, _, cls = NODES[name].partition(":")
    return getattr(importlib.import_module(module), cls)


@dataclass(frozen=True, kw_only=True)
class GraphConfig:
    """Arguments of `start_graph`, as a value that can be sent to another process."""

    namespace: str = ""
    """Namespace of the whole graph."""
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Parameters by node; the empty name: every node that declares them."""
    nodes: tuple[str, ...] = tuple(NODES)
    """Which of `NODES`."""
    policies: tuple[PolicyLaunch, ...] = ()
    """Policies to run beside them."""
    check_common: bool = True
    """Refuse parameters for every node that no node declares."""


class Graph:
    """Nodes that run in this process; ``graph["sim"]`` is the node itself."""

    def __init__(self, host: Any, namespace: str = "") -> None:
        """Make a graph without nodes.

        Args:
            host: The `roboxim_ros.host.NodeHost` that spins them.
            namespace: Namespace of all nodes.
        """
        self.host = host
        self.namespace = namespace
        self.nodes: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        """Return a node."""
        return self.nodes[name]

    def node_names(self) -> list[str]:
        """Return the full names of the nodes."""
        return [node.get_fully_qualified_name() for node in self.nodes.values()]

    def clients(self) -> Any:
        """Return blocking clients in the graph's namespace; a context manager (`roboxim_ros.clients.Clients`)."""
        from roboxim_ros.clients import Clients

        return Clients("graph_clients", context=self.host.context, namespace=self.namespace)

    def start(self, name: str, parameters: Mapping[str, Any]) -> Any:
        """Start one of `NODES`."""
        cls = node_class(name)
        node = self.host.add(
            lambda context: cls(context=context, namespace=self.namespace, parameters=dict(parameters))
        )
        self.nodes[name] = node
        return node

    def start_policy(self, launch: PolicyLaunch, parameters: Mapping[str, Any]) -> Any:
        """Start a policy."""
        from roboxim_policies import load_policy
        from roboxim_policies.node import PolicyNode

        namespace = f"{self.namespace.rstrip('/')}/{launch.namespace.strip('/')}"
        node = self.host.add(
            lambda context: PolicyNode(
                load_policy(launch.spec, **launch.options),
                context=context,
                namespace=namespace,
                parameters=dict(parameters),
            )
        )
        self.nodes[launch.namespace] = node
        return node


def start_graph(
    host: Any,
    namespace: str = "",
    parameters: Parameters | None = None,
    *,
    nodes: Sequence[str] = tuple(NODES),
    policies: Sequence[PolicyLaunch] = (),
    check_common: bool = True,
) -> Graph:
    """Start nodes in this process; return when all of them serve.

    Args:
        host: A `roboxim_ros.host.NodeHost`.
        namespace: Namespace of the whole graph, e.g. ``/w0``.
        parameters: Parameters by node; the empty name: every node that declares them.
        nodes: Which of `NODES`.
        policies: Policies to run beside them.
        check_common: Refuse parameters for every node that no node declares.

    Raises:
        ConfigError: When a node or a parameter is unknown, or a value does not fit.
    """
    common, given = split_parameters(parameters, nodes, policies)
    graph = Graph(host, namespace)
    for launch in policies:
        graph.start_policy(launch, {**common, **given.get(launch.namespace, {})})
    for name in nodes:
        graph.start(name, {**common, **given.get(name, {})})
    for name, values in given.items():
        check_declared(values, {name: _declared(graph[name])})
    if check_common:
        check_declared(common, {name: _declared(node) for name, node in graph.nodes.items()})
    return graph


def split_parameters(
    parameters: Parameters | None, nodes: Sequence[str], policies: Sequence[PolicyLaunch]
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Split parameters into those for every node and those by node.

    Raises:
        ConfigError: When parameters are given for a node that is not started.
    """
    given = {name: dict(values) for name, values in (parameters or {}).items()}
    common = given.pop("", {})
    known = {*nodes, *(launch.namespace for launch in policies)}
    for name in given:
        if name not in known:
            raise ConfigError(f"parameters for node '{name}', which is not started; {one_of(known, name)}")
    return common, given


def check_declared(parameters: Iterable[str], declared: Mapping[str, set[str]]) -> None:
    """Refuse a parameter that no node declares; ROS would ignore it silently.

    Args:
        parameters: Names.
        declared: Node name to the parameters that it declares.

    Raises:
        ConfigError: When a name is unknown; the message lists the known names.
    """
    everything = set().union(*declared.values()) - {"use_sim_time", "start_type_description_service"}
    for name in parameters:
        if name not in everything:
            raise ConfigError(f"no parameter '{name}' of {', '.join(declared)}; {one_of(everything, name)}")


def _declared(node: Any) -> set[str]:
    return set(node.list_parameters([], 0).names)
