"""Every registered renderer does what a plug-in's must."""

import pytest

from roboxim_core.registry import check_plugin
from roboxim_sim.rendering import RENDERERS


@pytest.mark.parametrize("name", RENDERERS)
def test_renderers_conform(name):
    check_plugin(RENDERERS, name)
