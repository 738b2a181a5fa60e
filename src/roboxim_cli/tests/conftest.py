from __future__ import annotations

import os

import pytest

from roboxim_bringup.testing import graph, graph_parameters
from roboxim_core.models.library import ModelLibrary

__all__ = ["graph", "graph_parameters"]


@pytest.fixture
def runtime(tmp_path, monkeypatch):
    """Give the test its own registry of runs; restore the environment afterwards."""
    before = dict(os.environ)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("ROBOXIM_RUN", raising=False)
    yield tmp_path
    for name in set(os.environ) - set(before):
        del os.environ[name]
    os.environ.update(before)


@pytest.fixture(scope="session")
def library():
    """Return RoboXim's models."""
    return ModelLibrary()
