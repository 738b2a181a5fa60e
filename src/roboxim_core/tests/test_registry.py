"""A broken plug-in is named and does not prevent loading others; authors can check their plug-ins."""

from __future__ import annotations

import pytest

from roboxim_core import registry as module
from roboxim_core.errors import ConfigError
from roboxim_core.registry import Registry, check_plugin


class Entry:
    def __init__(self, name, load):
        self.name, self.value, self.load = name, f"package.{name}", load


@pytest.fixture
def registry(monkeypatch):
    things: Registry[int] = Registry("thing")

    def broken():
        raise ImportError("no module named torch")

    def leaving():
        raise SystemExit(2)

    entries = [Entry("bad", broken), Entry("worse", leaving), Entry("good", lambda: things.register("good")(1))]
    monkeypatch.setattr(module, "entry_points", lambda group: entries if group == "roboxim.thing" else [])
    return things


def test_a_broken_plugin_takes_no_other_away(registry):
    assert registry["good"] == 1
    assert list(registry) == ["good"]
    assert set(registry.broken) == {"bad", "worse"}


def test_a_broken_plugin_is_named_when_it_is_asked_for(registry):
    with pytest.raises(ConfigError, match="'bad' is broken: package.bad raised ImportError: no module named torch"):
        registry["bad"]
    with pytest.raises(ConfigError, match="unknown thing 'god'.*could not be loaded: bad, worse"):
        registry["god"]


def test_conformance_names_everything_that_is_wrong(registry):
    @registry.conformance
    def is_even(name, item):
        assert item % 2 == 0, f"{item} is odd"

    @registry.conformance
    def is_small(name, item):
        raise ValueError("too large")

    with pytest.raises(ConfigError, match=r"(?s)is_even: AssertionError: 1 is odd.*is_small: ValueError: too large"):
        check_plugin(registry, "good")
    registry.register("Bad Name")(2)
    with pytest.raises(ConfigError, match="not lower case"):
        check_plugin(registry, "Bad Name")
