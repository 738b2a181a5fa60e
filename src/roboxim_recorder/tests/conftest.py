"""Made-up episodes for the recorder's tests."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from made_up_episodes import FakeEpisode


@pytest.fixture(scope="session")
def fake() -> Callable[..., FakeEpisode]:
    """Makes made-up episodes: ``fake(index=3, steps=8)``."""
    return FakeEpisode
