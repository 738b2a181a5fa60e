"""Every registered export format does what a plug-in's must."""

import pytest

from roboxim_core.registry import check_plugin
from roboxim_recorder.export import EXPORTERS


@pytest.mark.parametrize("name", EXPORTERS)
def test_exporters_conform(name):
    check_plugin(EXPORTERS, name)
