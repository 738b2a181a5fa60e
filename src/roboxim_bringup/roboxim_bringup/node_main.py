"""One node as an executable, for ``ros2 run`` and ``ros2 launch``: ``ros2 run roboxim_bringup sim --ros-args ...``.

`roboxim up` does not use this module: it starts, supervises and registers a whole graph. Without an installed ROS 2,
run ``python -m roboxim_bringup.node_main sim --ros-args ...``.

The domain is that of ``ROS_DOMAIN_ID``. As with every node that is started by ``ros2``, all hosts that reach this host
can reach the node; ``ROBOXIM_TRANSPORT=user`` restricts it to this user's processes, which then need the same variable.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from roboxim_bringup.graph import NODES, GraphConfig
from roboxim_bringup.parameters import merge, parse_assignments, read_params_files
from roboxim_core.errors import ConfigError, RoboximError, one_of

USAGE = "NODE [--ros-args] [-p NAME:=VALUE] [--params-file FILE] [-r __ns:=NAMESPACE]"


def parse(arguments: Sequence[str]) -> GraphConfig:
    """Parse a node's name and ROS arguments.

    Args:
        arguments: The name, one of `graph.NODES`, and ROS 2's arguments: parameters, parameter files, namespace.

    Raises:
        ConfigError: When the name is unknown or an argument is not among these.
    """
    name, *rest = arguments or [""]
    if name not in NODES:
        raise ConfigError(f"no node '{name}'; {one_of(NODES, name)}; usage: {USAGE}")
    words = iter(rest)
    assigned: list[str] = []
    files: list[Path] = []
    namespace = ""
    for word in words:
        if word in ("--ros-args", "--"):
            continue
        value = next(words, None)
        if value is None:
            raise ConfigError(f"{word} needs a value; usage: {USAGE}")
        if word in ("-p", "--param"):
            assigned.append(value)
        elif word == "--params-file":
            files.append(Path(value))
        elif word in ("-r", "--remap") and value.startswith("__ns:="):
            namespace = value.removeprefix("__ns:=")
        elif word in ("-r", "--remap") and value.startswith("__node:="):
            if value != f"__node:={name}":
                raise ConfigError(f"the node is called '{name}', because the other nodes look for it by this name")
        else:
            raise ConfigError(f"'{word} {value}' is not supported; usage: {USAGE}")
    given = merge(read_params_files(files, namespace=namespace), parse_assignments(assigned, node=name))
    parameters = {node: values for node, values in given.items() if node in ("", name)}
    return GraphConfig(nodes=(name,), namespace=namespace, parameters=parameters, check_common=False)


def main(name: str | None = None) -> int:
    """Run the node that the command line names, or ``name``, until SIGINT or SIGTERM; return the exit code."""
    from roboxim_ros.environment import start_clean

    start_clean()
    os.environ.setdefault("ROBOXIM_TRANSPORT", "network")
    from roboxim_bringup.graph import start_graph
    from roboxim_ros.host import NodeHost, wait_for_stop

    try:
        config = parse([name, *sys.argv[1:]] if name else sys.argv[1:])
        with NodeHost() as host:
            start_graph(host, **vars(config))
            wait_for_stop(lambda: not host.alive())
            if not host.alive():
                raise RoboximError(f"node {', '.join(host.dead())} has died; see the traceback above")
    except RoboximError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2 if isinstance(error, ConfigError) else 1
    return 0


def sim() -> int:
    """Run the sim node."""
    return main("sim")


def planner() -> int:
    """Run the planner node."""
    return main("planner")


def tasks() -> int:
    """Run the tasks node."""
    return main("tasks")


def recorder() -> int:
    """Run the recorder node."""
    return main("recorder")


def evaluator() -> int:
    """Run the evaluator node."""
    return main("evaluator")


if __name__ == "__main__":
    sys.exit(main())
