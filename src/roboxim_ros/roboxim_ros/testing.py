"""For pytest: nodes in this process, in a domain of their own. Users import `graph_host` into their conftest."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import TypeVar

import pytest

from roboxim_ros.host import NodeHost
from roboxim_ros.runs import free_domain

T = TypeVar("T")

PATIENCE_S = 300.0
"""How long a test waits for what must happen [s]: only a hang reaches it, however busy the machine is."""


def eventually(condition: Callable[[], T], expected: str = "what the test waits for", wait_s: float = PATIENCE_S) -> T:
    """Wait until a condition holds, and return its value.

    For what has no event to wait for: a file, a process, the log of one.

    Args:
        condition: Returns something true when it holds.
        expected: What is waited for, for the error.
        wait_s: Longest wait [s].

    Raises:
        AssertionError: When the condition does not hold in time.
    """
    deadline = time.monotonic() + wait_s
    while not (value := condition()):
        assert time.monotonic() < deadline, f"not within {wait_s:g} s: {expected}"
        time.sleep(0.02)
    return value


@pytest.fixture
def graph_host() -> Iterator[NodeHost]:
    """A `NodeHost` in a fresh domain: ``graph_host.add(lambda context: MyNode(context=context))``."""
    with free_domain() as domain, NodeHost(domain_id=domain) as host:
        yield host
