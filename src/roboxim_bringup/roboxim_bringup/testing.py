"""For tests: fixtures of the whole graph in this process, in its own domain, and comparisons of runs.

Import the fixture into your ``conftest.py``::

    from roboxim_bringup.testing import graph

    def test_cube_is_in_the_scene(graph):
        with graph.clients() as clients:
            response = clients.call(GetEntities, "sim/get_entities", GetEntities.Request())

Override ``graph_parameters`` for parameters other than the defaults.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
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


def recordings(run: Path) -> dict[str, str]:
    """Return the hash of every recording in a run's folder, by its path."""
    return {
        str(path.relative_to(run)): hashlib.sha256(path.read_bytes()).hexdigest() for path in run.rglob("*/*/*.mcap")
    }


def repeatable_results(run: Path) -> list[dict[str, Any]]:
    """Return a run's results without the times, which no two machines share."""
    from roboxim_bringup.runs.folder import RunFolder
    from roboxim_bringup.runs.merging import CLOCKED
    from roboxim_core.config import to_plain

    found = [to_plain(result) for result in RunFolder(run).results()]
    return [{name: value for name, value in result.items() if name not in CLOCKED} for result in found]
