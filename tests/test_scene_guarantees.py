"""The guarantees of a drawn scene hold in the simulator at tick 0, for every skill, object and task file."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from roboxim_bringup.core_graph import CoreGraph, CoreTasks
from roboxim_core.actions import hold_action
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose, distance
from roboxim_core.specs import EntitySpec, RobotSpec, SceneSpec
from roboxim_runs.assets.check import check
from roboxim_sim.world import World
from roboxim_tasks.measures import Conditions, stayed
from roboxim_tasks.sampling.placement import turned
from roboxim_tasks.skills import SKILLS
from roboxim_tasks.skills.base import register

LIBRARY = ModelLibrary()
POSES = [
    pytest.param(model, pose, id=f"{model}-{'upright' if number == 0 else f'toppled-{number}'}")
    for model in LIBRARY.object_ids
    for number, pose in enumerate(
        (Pose(position=(0.0, 0.0, LIBRARY.object(model).rest_height)), *LIBRARY.object(model).toppled)
    )
]
MARGINAL = "toppled:\n  - {position: [0, 0, 0.036], rpy_deg: [90, 0, 0]}\n"
"""A mug on its wall, its handle in the air: it rolls, at most yaws."""


@pytest.fixture(scope="module")
def world():
    with World(LIBRARY) as made:
        yield made


@pytest.fixture(scope="module")
def cores(tmp_path_factory):
    with CoreGraph(tmp_path_factory.mktemp("guarantees"), renderer="tiny") as made:
        yield made


@pytest.mark.parametrize(("model", "pose"), POSES)
def test_placed_objects_rest_at_tick_0_and_later(model, pose, world):
    home = RobotSpec(joint_positions=tuple(LIBRARY.robot("panda").home))
    for yaw in (0.4, 2.9) if pose.quat_xyzw != Pose().quat_xyzw else (0.4,):
        entity = EntitySpec(name="it", model=model, pose=turned((0.5, 0.1, 0.0), yaw) @ pose)
        states = [world.load(SceneSpec(robot=home, entities=(entity,)))]
        states += [world.tick(seq, hold_action(1.0)) for seq in range(1, 16)]
        for state in (states[0], states[-1]):
            moved_m, turned_rad = distance(entity.pose, state.entity("it").pose)
            assert moved_m < 0.001
            assert turned_rad < math.radians(1.0)


@pytest.fixture
def marginal(tmp_path, monkeypatch):
    """A library with a user's mug whose toppled pose is no rest."""
    built_in = LIBRARY.path("objects", "mug").read_text()
    (tmp_path / "objects").mkdir()
    file = tmp_path / "objects" / "cup.yaml"
    begin, end = built_in.index("toppled:"), built_in.index("modifiers:")
    file.write_text(built_in[:begin].replace("name: mug", "name: cup") + MARGINAL + built_in[end:])
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))
    return ModelLibrary()


def test_the_object_check_finds_an_unstable_toppled_pose(marginal):
    (found,) = check("cup", marginal)
    assert found.severity == "error"
    assert "toppled pose 1" in found.message


def test_an_episode_whose_scene_is_not_settled_does_not_begin_and_is_drawn_again(marginal, tmp_path):
    task = """
skill: turn_upright
objects: {target: {models: {values: [cup]}}}
reset: {cameras: {names: []}, toppled: {yaw_rad: {values: [0.4]}}}
"""
    with CoreGraph(tmp_path, renderer="tiny") as cores:
        config = RunConfig(purpose="test", task_config=task, max_attempts=2, output_dir=str(tmp_path))
        result = EpisodeRunner(replace(cores.ports, scenes=CoreTasks(marginal)), config).run_index(0)
    assert (result.outcome, result.reason, result.attempt, result.bag) == ("error", "reset_infeasible", 1, "")
    assert "target_unsettled" in result.message
    assert not list(tmp_path.rglob("*.mcap"))


def test_an_episode_that_is_already_solved_does_not_begin(cores):
    class Leave(type(SKILLS["pick_up"])):
        name = "leave"
        templates = ("Leave the {target} where it is",)

        def evaluator(self, task, initial):
            return Conditions((stayed("target", initial, 0.01),), hold_s=5.0)

    register(Leave)
    try:
        task = "skill: leave\nreset: {cameras: {names: []}}"
        config = RunConfig(purpose="test", task_config=task, keep="none")
        result = EpisodeRunner(cores.ports, config).run_index(0)
    finally:
        SKILLS._items.pop("leave")
    assert (result.outcome, result.reason) == ("error", "reset_infeasible")
    assert "not_solved_already" in result.message


def test_a_scene_that_begins_in_motion_declares_it(cores, tmp_path):
    ball = "{name: ball, model: apple, pose: {position: [0.3, 0.4, 0.5]}}"

    def run(settle_steps):
        scene = tmp_path / f"falling_{settle_steps}.yaml"
        scene.write_text(f"entities: [{ball}]\nsettle_steps: {settle_steps}\n")
        task = f"scene: {scene}\nskill: pick_up\nreset: {{cameras: {{names: []}}}}\n"
        config = RunConfig(purpose="test", task_config=task, keep="none", max_steps=2)
        return EpisodeRunner(cores.ports, config).run_index(0)

    assert "ball_unsettled" in run(60).message
    assert run(0).outcome == "failure"
