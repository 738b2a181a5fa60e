"""Tasks, scenes and bags are seen before anything runs."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from roboxim_cli.main import group
from roboxim_core.config import load_config, load_yaml, named_config
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_core.vision.looks import LookSet
from roboxim_runs.episodes.task_choice import mix_of, task_text
from roboxim_runs.evaluation.results import EvaluationResult, PolicyResult
from roboxim_runs.evaluation.run import EvaluationConfig
from roboxim_runs.scenes.pictures import MARK, picture_of
from roboxim_tasks.config import parse_task_config
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.skills import SKILLS


def run(*words):
    return CliRunner().invoke(group, [str(word) for word in words], standalone_mode=False, catch_exceptions=False)


@pytest.mark.thorough
def test_sampled_tasks_are_drawn_from_all_cameras_with_marks(tmp_path):
    file = tmp_path / "stack.png"
    result = run(
        "tasks", "sample", "--skill", "stack", "--episodes", 2, "--picture", "--out", file, "--renderer", "tiny"
    )
    assert f"a picture: {file}" in result.output
    picture = np.asarray(Image.open(file))
    assert picture.shape[1] > 2 * 384
    assert (picture == MARK).all(axis=2).sum() > 100
    with pytest.raises(ConfigError, match=r"as \.png"):
        run("tasks", "sample", "--episodes", 1, "--picture", "--out", tmp_path / "x.gif", "--renderer", "tiny")


def test_a_task_is_described_in_words():
    said = run("tasks", "show", "pick_cube_randomised").output
    assert "target        cube (color red, green, blue, yellow; scale 0.9 to 1.1)" in said
    assert "varies        lights: intensity 1.6 to 3" in said
    assert "lift_m 0.05" in said
    assert "cells, " in run("tasks", "show", "camera_skill_baseline").output
    assert "arguments     direction clockwise, counter-clockwise" in run("tasks", "show", "rotate").output
    assert "drawer top, open_m 0.12" in run("tasks", "show", "drawer_chain").output


def test_a_scene_and_a_misspelt_name(tmp_path):
    picture, text = picture_of("kitchen", renderer="tiny")
    assert picture.size == (384, 384)
    assert text == "scene kitchen: 3 objects"
    with pytest.raises(ConfigError, match="did you mean 'kitchen'"):
        picture_of("kitchn", renderer="tiny")


def test_looks_lights_textures_and_cameras_are_options_of_every_task(library):
    text = task_text(
        "pick_cube", cameras=["workspace=whole", "wrist"], lights=["evening"], textures=["table=marble"], look="varied"
    )
    seeds = [SeedPath(run_seed=1, purpose="demo", index=index) for index in range(12)]
    draws = [EpisodeGenerator(library).draw(seed, parse_task_config(text)) for seed in seeds]
    assert len({draw.scene.look.wall for draw in draws}) > 4
    assert {draw.scene.look.table.texture for draw in draws} == {"marble"}
    assert {draw.scene.look.lights[0].intensity for draw in draws} == {2.8}
    assert {draw.scene.cameras[0].pose for draw in draws} == {draws[0].scene.cameras[0].pose}
    assert "drawn" not in text
    free = EpisodeGenerator(library).draw(seeds[0], parse_task_config(task_text("pick_cube", look="varied")))
    look = load_config(named_config("looks", "varied"), LookSet).looks[free.task.drawn["look"]]
    assert free.scene.look == look.look
    one = EpisodeGenerator(library).draw(seeds[0], parse_task_config(task_text("pick_cube", look="varied/steel_bench")))
    assert one.scene.look == load_config(named_config("looks", "varied"), LookSet).looks["steel_bench"].look
    with pytest.raises(ConfigError, match="no look 'steal_bench' in set 'varied'"):
        parse_task_config(task_text("pick_cube", look="varied/steal_bench"))
    with pytest.raises(ConfigError, match="SURFACE=NAME"):
        task_text(textures=["marble"])


def test_the_look_changes_no_object_and_no_start(library):
    seed = SeedPath(run_seed=1, purpose="demo", index=4)
    plain, varied = (
        EpisodeGenerator(library).draw(seed, parse_task_config(task_text("pick_cube", look=look))).scene
        for look in ("", "varied")
    )
    assert (plain.entities, plain.robot) == (varied.entities, varied.robot)


def test_a_single_value_stands_for_a_list(library):
    text = "{skill: pick_up, objects: {target: {models: apple}}, reset: {lights: {intensity: 0.6}}}"
    scene = EpisodeGenerator(library).draw(SeedPath(run_seed=0, purpose="demo", index=0), parse_task_config(text)).scene
    assert scene.look.lights[0].intensity == 0.6
    assert scene.entities[0].model == "apple"
    with pytest.raises(ConfigError, match="intensity must be a number"):
        parse_task_config(text.replace("0.6", "bright"))


def test_a_tasks_images_are_found_by_processes_in_other_folders(tmp_path):
    (tmp_path / "photo.png").touch()
    file = tmp_path / "own.yaml"
    file.write_text("skill: pick_up  # mine\nreset: {surfaces: {wall: {texture: ./photo.png}}}\n")
    assert f"texture: {tmp_path / 'photo.png'}" in task_text(str(file))
    file.write_text("skill: pick_up  # mine\nreset: {surfaces: {wall: {texture: marble}}}\n")
    assert task_text(str(file)) == file.read_text()


def test_suites_are_versioned_and_balanced():
    for name, version, episodes, cells in (("core", 1, 70, 14), ("language", 2, 70, 16), ("clutter", 1, 70, 14)):
        config = EvaluationConfig(policies="zero", suite=name)
        mix = mix_of(config.task_text())
        assert config.task_name == f"suite {name}, version {version}"
        assert (sum(mix.counts), len(mix.cells)) == (episodes, cells)
        later = {"flip_switch", "turn_knob", "open_door", "close_door"}
        assert {cell.skill for cell in mix.cells} == set(SKILLS) - later, "came after version 1"
        assert mix.seed_by == "cell"
    core = run("tasks", "show", "core").output
    assert "14 cells, 70 episodes" in core
    assert "cell          pick_up\nskill" in core, "which of a skill's cells is described"
    with pytest.raises(ConfigError, match="a suite has tasks of its own"):
        task_text("stack", suite="core")
    with pytest.raises(ConfigError, match="did you mean 'clutter'"):
        run("tasks", "show", "cluter")


def test_the_suite_objects_lacks_the_pairs_that_its_experiments_hold_out_and_turns_tools_twice_as_often():
    mix = mix_of(task_text(suite="objects"))
    shown: Counter[tuple[str, str]] = Counter()
    for cell, count in zip(mix.cells, mix.counts, strict=True):
        models = cell.objects["target"].models.values
        assert count % len(models) == 0, "each object of a cell is demonstrated equally often"
        shown += {(cell.skill, str(model)): count // len(models) for model in models}
    for experiment in ("skill_object", "breadth"):
        held_out = load_yaml(named_config("experiments", experiment))["unseen"]
        assert not {(pair["task"], pair["target"]) for pair in held_out} & set(shown)
    tools = {"magnifying_glass", "paintbrush", "screwdriver", "spatula"}
    assert tools <= set(ModelLibrary().object_sets["tools"])
    for skill, usual, of_tools in (("pick_up", 4, 4), ("place_on", 5, 5), ("rotate", 6, 12)):
        assert {shown[skill, tool] for tool in tools} == {of_tools}
        assert {n for (s, model), n in shown.items() if s == skill and model not in tools} == {usual}


def test_an_evaluation_of_several_skills_has_a_table_by_skill():
    results = {
        name: PolicyResult(
            name=name, folder=Path(name),
            results=tuple(
                EpisodeResult(episode_id=f"e{i}", index=i, skill=skill, outcome=outcome)
                for i, (skill, outcome) in enumerate(zip(["stack", "pick_up", "stack"], outcomes, strict=True))
            ),
        )
        for name, outcomes in {"a": ["success", "failure", "success"], "b": ["failure"] * 3}.items()
    }  # fmt: skip
    table = EvaluationResult(policies=results, report=None, comparison="", privileged=()).by_skill
    assert [" ".join(row.split()) for row in table] == ["a b", "pick_up 0 of 1 0 of 1", "stack 2 of 2 0 of 2"]


@pytest.mark.thorough
def test_a_task_is_viewed_with_its_options(tmp_path):
    file = tmp_path / "view.png"
    said = run("view", "pick_up", "--object", "lemon", "--distractors", 0, "--out", file, "--renderer", "tiny").output
    assert "Pick up the lemon" in said
    with pytest.raises(ConfigError, match="kitchen is a scene, and look changes a task"):
        run("view", "kitchen", "--look", "varied", "--out", file, "--renderer", "tiny")
