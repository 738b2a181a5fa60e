"""Every registered policy does what a plug-in's must."""

import numpy as np
import pytest

from roboxim_core.errors import ConfigError
from roboxim_core.registry import Registry, check_plugin
from roboxim_policies.base import POLICIES, BasePolicy, find_policy
from roboxim_policies.wires import REFUSED, WIRES, find_wire

find_policy("random")  # which registers the shipped ones


@pytest.mark.parametrize("name", POLICIES)
def test_policies_conform(name):
    check_plugin(POLICIES, name)


class Unseeded(BasePolicy):
    def __init__(self, *, scale=0.5):
        self.rng = np.random.default_rng()

    def act(self, window):
        return self.rng.normal(size=7)


def test_what_does_not_conform_is_named():
    registry = Registry("policy")
    registry._checks = POLICIES._checks
    registry.register("unseeded")(Unseeded)
    registry.register("nothing")(lambda: None)
    with pytest.raises(ConfigError, match=r"argument 'scale' has no type.*different actions"):
        check_plugin(registry, "unseeded")
    with pytest.raises(ConfigError, match="no method describe, reset, act"):
        check_plugin(registry, "nothing")


@pytest.mark.parametrize("name", WIRES)
def test_wires_conform(name):
    check_plugin(WIRES, name)


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_a_protocol_of_pickles_is_refused_with_a_way_round(name):
    with pytest.raises(ConfigError, match=f"'{name}' is refused.*pickles.*use the wire"):
        find_wire(name)
