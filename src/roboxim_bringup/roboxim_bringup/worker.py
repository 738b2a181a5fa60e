"""A process with a graph, or a part of one: ``python -m roboxim_bringup.worker CONFIG_JSON``.

Its run (domain, transport) comes from the environment. It ends on SIGTERM, with its parent, or when a node dies.
"""

from __future__ import annotations

import os
import sys

from roboxim_bringup.process import die_with_parent, report_ready


def main() -> int:
    """Run the graph of the configuration in the first argument; return the exit code."""
    parent = os.environ.pop("ROBOXIM_PARENT", None)
    if parent is not None:
        die_with_parent(int(parent))
    from roboxim_bringup.graph import GraphConfig, start_graph
    from roboxim_core.config import from_json
    from roboxim_core.errors import RoboximError
    from roboxim_ros.host import NodeHost, wait_for_stop

    config = from_json(sys.argv[1], GraphConfig, source="worker configuration")
    try:
        with NodeHost() as host:
            start_graph(host, **vars(config))
            report_ready()
            wait_for_stop(lambda: not host.alive())
            if not host.alive():
                raise RoboximError(f"node {', '.join(host.dead())} has died; see the traceback above")
    except RoboximError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
