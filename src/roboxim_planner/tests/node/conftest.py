"""A running planner node for the tests of its services and actions."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from roboxim_ros.host import NodeHost
from roboxim_ros.runs import free_domain

sys.path.insert(0, str(Path(__file__).parent))
from planner_graph import Graph  # noqa: E402


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Graph]:
    with free_domain() as domain, NodeHost(domain_id=domain) as host:
        graph = Graph(host, tmp_path_factory.mktemp("dumps"))
        yield graph
        graph.clients.close()
