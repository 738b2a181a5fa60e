"""For pytest: nodes in this process, in a domain of their own. Users import `graph_host` into their conftest."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from roboxim_ros.host import NodeHost
from roboxim_ros.runs import free_domain


@pytest.fixture
def graph_host() -> Iterator[NodeHost]:
    """A `NodeHost` in a fresh domain: ``graph_host.add(lambda context: MyNode(context=context))``."""
    with free_domain() as domain, NodeHost(domain_id=domain) as host:
        yield host
