from __future__ import annotations

import pytest

from roboxim_bringup.testing import graph, graph_parameters
from roboxim_core.models.library import ModelLibrary
from roboxim_ros.testing import runtime

__all__ = ["graph", "graph_parameters", "runtime"]


@pytest.fixture(scope="session")
def library():
    """Return RoboXim's models."""
    return ModelLibrary()
