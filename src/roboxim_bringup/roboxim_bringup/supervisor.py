"""One process per node: starts them, restarts a dead one, ends them all."""

from __future__ import annotations

import os
import select
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import click

from roboxim_bringup.attach import graph_namespace
from roboxim_bringup.graph import GraphConfig, PolicyLaunch, check_declared, split_parameters
from roboxim_bringup.process import describe_exit, spawn, stop
from roboxim_core.errors import RoboximError, UnavailableError

READY_S = 300.0
QUICK_DEATH_S = 60.0
"""Time after its start within which a dying process counts as unable to start [s]."""
MAX_QUICK_DEATHS = 3


@dataclass
class Child:
    """A node's process."""

    name: str
    """Node, or the policy's namespace."""
    config: GraphConfig
    """Its node or policy, with parameters."""
    process: subprocess.Popen[bytes]
    """The process."""
    started: float
    """Time of the start, monotonic clock [s]."""
    pipe: int
    """Read end of the pipe that the process writes to when it has started completely."""
    quick_deaths: int = 0
    """Consecutive deaths soon after the start."""

    def ready(self) -> bool:
        """Return whether the process has reported a complete start.

        A node that is visible in the graph may still refuse its parameters.
        """
        if self.pipe >= 0 and select.select([self.pipe], [], [], 0)[0]:
            byte = os.read(self.pipe, 1)
            os.close(self.pipe)
            self.pipe = -1 if byte else -2
        return self.pipe == -1

    def restart(self) -> None:
        """Start the process again."""
        if self.pipe >= 0:
            os.close(self.pipe)
        self.process, self.pipe = _start(self.config)
        self.started = time.monotonic()


class Supervisor:
    """A graph of one process per node in the run that the environment names. A context manager.

    The processes die with the thread that makes the supervisor.
    """

    def __init__(
        self,
        nodes: Sequence[str],
        policies: Sequence[PolicyLaunch] = (),
        *,
        namespace: str = "",
        parameters: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        """Start the processes.

        Args:
            nodes: Which of `graph.NODES`.
            policies: Policies, each also in its own process.
            namespace: Namespace of the graph.
            parameters: Parameters by node; the empty name: every node that declares them.

        Raises:
            ConfigError: When parameters are given for a node that is not started.
        """
        self._common, given = split_parameters(parameters, nodes, policies)
        self.namespace = graph_namespace(namespace)
        self.children: list[Child] = []
        for launch in policies:
            self._add(launch.namespace, (), (launch,), given)
        for name in nodes:
            self._add(name, (name,), (), given)

    def _add(
        self,
        name: str,
        nodes: tuple[str, ...],
        policies: tuple[PolicyLaunch, ...],
        given: dict[str, dict[str, Any]],
    ) -> None:
        config = GraphConfig(
            namespace=self.namespace,
            nodes=nodes,
            policies=policies,
            parameters={"": self._common, name: given.get(name, {})},
            check_common=False,
        )
        process, pipe = _start(config)
        self.children.append(Child(name, config, process, time.monotonic(), pipe))

    def node_names(self) -> list[str]:
        """Return the full names of the nodes."""
        return [
            f"{self.namespace}/{child.name.strip('/')}{'' if child.config.nodes else '/policy'}"
            for child in self.children
        ]

    def wait_until_ready(self) -> None:
        """Wait until every node is in the graph.

        Raises:
            RoboximError: When a process ends early, or the start takes too long.
            ConfigError: When no node declares a parameter given for all nodes.
        """
        from roboxim_bringup.attach import Peer, parameter_names

        expected = self.node_names()
        deadline = time.monotonic() + READY_S
        peer = Peer()
        try:
            while missing := {
                name
                for name, child in zip(expected, self.children, strict=True)
                if not child.ready() or name not in peer.nodes(hidden=True)
            }:
                for child in self.children:
                    code = child.process.poll()
                    if code is not None:
                        raise RoboximError(f"node '{child.name}' could not start: {describe_exit(code)}; see above")
                if time.monotonic() > deadline:
                    raise UnavailableError(f"not in the graph after {READY_S:g} s: {', '.join(sorted(missing))}")
                time.sleep(0.05)
            if self._common:
                check_declared(self._common, {name: set(parameter_names(peer, name)) for name in expected})
        finally:
            peer.close()

    def supervise(self) -> bool:
        """Restart dead processes, with a message.

        Raises:
            RoboximError: When a process dies repeatedly right after its start.
        """
        for child in self.children:
            code = child.process.poll()
            if code is None:
                continue
            quick = time.monotonic() - child.started < QUICK_DEATH_S
            child.quick_deaths = child.quick_deaths + 1 if quick else 0
            click.echo(f"node '{child.name}' has died ({describe_exit(code)}); starting it again", err=True)
            if child.quick_deaths >= MAX_QUICK_DEATHS:
                raise RoboximError(f"node '{child.name}' died {child.quick_deaths} times right after its start")
            child.restart()
            _register([child])
        return False

    def __enter__(self) -> Supervisor:
        """Return itself."""
        _register(self.children)
        return self

    def __exit__(self, *_: object) -> None:
        """End all processes."""
        stop(child.process for child in self.children)


def _start(config: GraphConfig) -> tuple[subprocess.Popen[bytes], int]:
    """Start a process; return it and the read end of its ready pipe."""
    from roboxim_core.config import to_json

    read, write = os.pipe()
    try:
        return spawn("roboxim_bringup.worker", [to_json(config)], ready=write), read
    finally:
        os.close(write)


def _register(children: Sequence[Child]) -> None:
    from roboxim_ros.runs import extend_run

    run_id = os.environ.get("ROBOXIM_RUN")
    if run_id:
        extend_run(run_id, pids=[child.process.pid for child in children])
