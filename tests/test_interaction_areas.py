"""The shipped interaction areas are within the robot's reach, to their corners."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
from scipy.spatial.transform import Rotation

from roboxim_bringup.cores import CorePlanner
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.seeds import SeedPath
from roboxim_tasks.components.interaction_area import AREAS
from roboxim_tasks.config import load_task_config
from roboxim_tasks.demonstration.solvable import Solvability
from roboxim_tasks.sampling.episodes import EpisodeGenerator


@pytest.fixture(scope="module")
def library():
    return ModelLibrary()


@pytest.fixture(scope="module")
def solvability(library):
    return Solvability(library, CorePlanner(library))


@pytest.mark.parametrize("name", AREAS)
def test_the_expert_has_a_plan_for_a_cube_at_every_corner_and_in_the_middle(name, library, solvability):
    config = load_task_config("pick_cube_areas")
    seed = SeedPath(run_seed=0, purpose="test", index=list(AREAS).index(name))
    drawn = EpisodeGenerator(library).draw(seed, config)
    (x0, y0), (x1, y1) = AREAS[name].lower, AREAS[name].upper
    places = [*itertools.product((x0, x1), (y0, y1)), ((x0 + x1) / 2, (y0 + y1) / 2)]
    for (x, y), yaw in zip(places, (0.0, 0.4, 0.8, 1.2, 1.5), strict=True):
        cube = drawn.scene.entity("target")
        pose = Pose.from_arrays((x, y, cube.pose.position[2]), Rotation.from_euler("z", yaw))
        scene = replace(drawn.scene, entities=(replace(cube, pose=pose),))
        assert solvability.holds(drawn.task, scene, 0), (x, y, yaw)
