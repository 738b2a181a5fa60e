from __future__ import annotations

from roboxim_bringup.testing import graph, graph_parameters
from roboxim_ros.testing import runtime

__all__ = ["graph", "graph_parameters", "runtime"]
