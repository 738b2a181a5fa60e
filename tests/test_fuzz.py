"""No request crashes a node, hangs, or changes the result of an episode; see `fuzzer` for the requests."""

import sys
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from fuzzer import Fuzzer, episode_hash, live_graph  # noqa: E402

pytestmark = pytest.mark.ros
GROWTH_MIB = 500.0
"""Memory that a graph may take during the fuzzing: renderers, a second robot's planner, what the allocator keeps."""


def fuzz(folder, *, rounds, seconds, seed):
    with live_graph(folder) as live:
        before = episode_hash(live)
        fuzzer = Fuzzer(live, seed)
        fuzzer.heal()
        warm = live.rss_mib()
        report = fuzzer.run(rounds, until=time.monotonic() + seconds)
        assert live.process.poll() is None
        assert episode_hash(live) == before
        assert report.internal == []
        assert live.rss_mib() - warm < GROWTH_MIB
        return report


@pytest.mark.thorough
def test_requests_at_random_are_answered(tmp_path):
    report = fuzz(tmp_path, rounds=1, seconds=5.0, seed=1)
    assert sum(sum(answers.values()) for answers in report.answers.values()) > 0


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", [11, 12])
def test_many_requests_at_random_are_answered(tmp_path, seed):
    report = fuzz(tmp_path, rounds=10, seconds=600.0, seed=seed)
    answers = sum(report.answers.values(), start=type(next(iter(report.answers.values())))())
    assert answers["accepted"] > 20
    assert answers["INVALID_REQUEST"] > 20
