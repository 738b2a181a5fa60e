"""Fixtures for tests that involve several packages."""

from roboxim_bringup.testing import graph, graph_parameters  # noqa: F401
