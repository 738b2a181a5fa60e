"""For tests: fixtures of the whole graph in this process, in its own domain.

Import the fixture into your ``conftest.py``::

    from roboxim_bringup.testing import graph

    def test_cube_is_in_the_scene(graph):
        with graph.clients() as clients:
            response = clients.call(GetEntities, "sim/get_entities", GetEntities.Request())

Override ``graph_parameters`` for parameters other than the defaults.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from typing import Any

import pytest

from roboxim_bringup.graph import Graph, start_graph


@pytest.fixture
def graph_parameters() -> Mapping[str, Mapping[str, Any]]:
    """Return the parameters of the ``graph`` fixture, by node; override it to change them."""
    return {}


@pytest.fixture
def graph(graph_parameters: Mapping[str, Mapping[str, Any]]) -> Iterator[Graph]:
    """Start all nodes of the graph in this process. Bags may be written to the temporary folder, e.g. ``tmp_path``."""
    from roboxim_ros.host import NodeHost
    from roboxim_ros.runs import free_domain

    with free_domain() as domain, NodeHost(domain_id=domain) as host:
        recorder = {"output_root": tempfile.gettempdir(), **graph_parameters.get("recorder", {})}
        yield start_graph(host, parameters={**graph_parameters, "recorder": recorder})
