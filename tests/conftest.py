"""Fixtures for tests that cross rooms."""

from roboxim_bringup.testing import graph, graph_parameters  # noqa: F401
