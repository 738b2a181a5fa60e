"""A worker of an `Evaluator`: ``python -m roboxim_runs.evaluation.beside_worker FD RENDERER``.

It plays the episodes that the user's process names. Each request to the policy goes there, and the answer comes back.
"""

from __future__ import annotations

import contextlib
import os
import sys
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from roboxim_bringup.process import clean_environment, die_with_parent


class Elsewhere:
    """The policy of the user's process; a `roboxim_core.policies.Policy`."""

    any_thread = True

    def __init__(self, connection: Connection[Any, Any], description: Any) -> None:
        """Store where it is, and its description."""
        self._connection, self._description = connection, description

    def describe(self) -> Any:
        """Return the policy's description."""
        return self._description

    def reset(self, start: Any) -> None:
        """Begin an episode."""
        self._connection.send(("reset", start))
        self._connection.recv()

    def act(self, window: Any) -> Any:
        """Ask for the next actions."""
        self._connection.send(("act", window))
        answer = self._connection.recv()
        if isinstance(answer, Exception):
            raise answer
        return answer


def main() -> None:
    """Play episodes until the user's process closes the connection."""
    die_with_parent(int(os.environ.pop("ROBOXIM_PARENT")))
    connection: Connection[Any, Any] = Connection(int(sys.argv[1]))
    clean_environment()
    from roboxim_bringup.core_graph import CoreGraph
    from roboxim_core.episode import EpisodeRunner

    config, graph, known = connection.recv(), None, None
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            kind, value = connection.recv()
            if kind == "episode":
                assert graph is not None
                connection.send(("result", EpisodeRunner(graph.ports, config).run_index(value)))
            elif value != known:
                if graph is not None:
                    graph.close()
                graph = CoreGraph(Path(), renderer=sys.argv[2], policy=Elsewhere(connection, value))
                known = value
    if graph is not None:
        graph.close()


if __name__ == "__main__":
    main()
