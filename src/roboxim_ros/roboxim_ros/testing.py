"""Pytest fixtures: nodes in this process, in their own domain. Import `graph_host` and `runtime` into a conftest."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import pytest

from roboxim_ros.host import NodeHost
from roboxim_ros.runs import free_domain

T = TypeVar("T")

PATIENCE_S = 300.0
"""Longest wait of a test for an event that must happen [s]. Only a hang reaches it, even on a busy machine."""


def eventually(condition: Callable[[], T], expected: str = "what the test waits for") -> T:
    """Wait until a condition holds, and return its value.

    For conditions without an event: a file, a process, a process's log.

    Args:
        condition: Returns a true value when it holds.
        expected: Description of the condition, for the error.

    Raises:
        AssertionError: When the condition does not hold in time.
    """
    deadline = time.monotonic() + PATIENCE_S
    while not (value := condition()):
        assert time.monotonic() < deadline, f"not within {PATIENCE_S:g} s: {expected}"
        time.sleep(0.02)
    return value


@pytest.fixture
def graph_host() -> Iterator[NodeHost]:
    """A `NodeHost` in a fresh domain: ``graph_host.add(lambda context: MyNode(context=context))``."""
    with free_domain() as domain, NodeHost(domain_id=domain) as host:
        yield host


@pytest.fixture
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Give the test its own registry of runs; restore the environment afterwards."""
    before = dict(os.environ)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("ROBOXIM_RUN", raising=False)
    yield tmp_path
    for name in set(os.environ) - set(before):
        del os.environ[name]
    os.environ.update(before)
