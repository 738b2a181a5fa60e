"""Every registered skill and component does what a plug-in's must."""

import pytest

from roboxim_core.recorded import RECORDED_PARAMETERS
from roboxim_core.registry import check_plugin
from roboxim_tasks.components import COMPONENTS
from roboxim_tasks.skills import SKILLS


@pytest.mark.parametrize("name", SKILLS)
def test_skills_conform(name):
    check_plugin(SKILLS, name)


@pytest.mark.parametrize("name", COMPONENTS)
def test_components_conform(name):
    check_plugin(COMPONENTS, name)


@pytest.mark.parametrize("name", RECORDED_PARAMETERS)
def test_recorded_parameters_conform(name):
    check_plugin(RECORDED_PARAMETERS, name)
