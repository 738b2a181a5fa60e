"""The interior of a container as the verdict of put_into sees it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from roboxim_core.errors import ConfigError
from roboxim_core.models.description import Region
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.rotation.quaternions import quat_about
from roboxim_core.specs import EntitySpec
from roboxim_tasks.config import task_config
from roboxim_tasks.meaning import asks_for_same, read_instruction
from roboxim_tasks.skills.put_into import interior_arguments


@pytest.mark.parametrize(("quarters", "half"), [(0, (0.15, 0.05)), (1, (0.05, 0.15)), (2, (0.15, 0.05))])
def test_a_turned_interior_keeps_its_sides(quarters, half):
    pose = Pose(quat_xyzw=quat_about("z", quarters * math.pi / 2))
    tray = replace(ModelLibrary().object("bowl"), regions=(Region(kind="interior", pose=pose, size=(0.3, 0.1, 0.05)),))
    found = interior_arguments(tray, "")
    assert (found["half_x_m"], found["half_y_m"]) == half
    slanted = replace(tray.regions[0], pose=Pose(quat_xyzw=quat_about("z", 0.3)))
    with pytest.raises(ConfigError, match="the interior '' is turned; its sides must be along x and y"):
        interior_arguments(replace(tray, regions=(slanted,)), "")


def test_a_drawer_that_only_the_instruction_names_is_recorded(generator, seed_path, library):
    config = task_config({"skill": "put_into", "objects": {"container": {"models": ["cabinet"]}}})
    task = generator.task(seed_path(0), config)
    assert task.instruction.endswith("into the top drawer of the cabinet")
    assert task.arguments["drawer"] == "top"
    entities = tuple(EntitySpec(name=role, model=thing.model) for role, thing in task.objects.items())
    (found,) = read_instruction(task.instruction, replace(config.base_scene(), entities=entities), library).tasks
    assert asks_for_same(found, task)
