"""Seeds by cell, recorded choices, and unset keys: what experiments need of a mix."""

from dataclasses import replace

import pytest

from roboxim_core.errors import ConfigError
from roboxim_core.seeds import CELL, CELL_NUMBER, SeedPath
from roboxim_tasks.config import load_task_config, parse_task_config

MIX = """
seed_by: cell
cells:
  - {tasks: [pick_up, rotate], models: {target: [cube, apple]}, exclude: EXCLUDE, episodes: 3}
"""


def by_cell(draw, config, indices):
    draws = [draw(index, config) for index in indices]
    return {(d.task.drawn[CELL], d.task.drawn[CELL_NUMBER]): (d.task, d.scene) for d in draws}


def test_mixes_share_the_episodes_of_the_cells_that_they_share(draw):
    all_cells = by_cell(draw, parse_task_config(MIX.replace("EXCLUDE", "[]")), range(12))
    fewer = parse_task_config(MIX.replace("EXCLUDE", "[{task: pick_up, target: cube}]").replace("s: 3", "s: 5"))
    some = by_cell(draw, fewer, range(15))
    shared = all_cells.keys() & some.keys()
    assert len(shared) == 9
    assert all(all_cells[key] == some[key] for key in shared)
    assert len({scene for _, scene in all_cells.values()}) == 12, "each episode has a scene of its own"


def test_a_retried_episode_stays_in_its_cell_with_another_scene(draw):
    mix = parse_task_config(MIX.replace("EXCLUDE", "[]"))
    first, again = draw(5, mix), draw(5, mix, attempt=1)
    assert first.task.drawn[CELL] == again.task.drawn[CELL]
    assert first.scene != again.scene


def test_seeds_of_a_cell_are_no_seeds_of_an_index():
    seed = SeedPath(run_seed=1, purpose="eval", index=7)
    assert seed.of_task({}) is seed
    assert seed.of_task({CELL: "pick_up target=cube"}) is seed, "a mix that is seeded by index also names its cells"
    in_cell = seed.of_task({CELL: "pick_up target=cube", CELL_NUMBER: "7"})
    assert in_cell == replace(seed, index=3).of_task({CELL: "pick_up target=cube", CELL_NUMBER: "7"})
    others = [seed, seed.in_cell("pick_up target=apple", 7), seed.in_cell("pick_up target=cube", 8)]
    assert in_cell.derived_seed("policy") not in [other.derived_seed("policy") for other in others]


def test_two_cells_with_the_same_scenes_are_refused():
    text = "seed_by: cell\ncells:\n" + 2 * "  - {tasks: [pick_up], models: {target: [cube]}}\n"
    with pytest.raises(ConfigError, match=r"cells.1 \(line 4\).*second cell 'pick_up target=cube'.*key"):
        parse_task_config(text)
    parse_task_config(text.replace("seed_by: cell", "seed_by: index"))
    keyed = parse_task_config(text.replace("[cube]}}", "[cube]}, key: left}", 1))
    assert keyed.keys == ("pick_up target=cube left", "pick_up target=cube")
    with pytest.raises(ConfigError, match="seed_by 'cel'.*did you mean 'cell'"):
        parse_task_config("seed_by: cel\ncells: [{tasks: [pick_up]}]")


def test_choices_are_recorded(draw):
    drawn = draw(0, "camera_skill_leave_out").task.drawn
    assert drawn["task"] in ("pick_up", "place_on", "rotate")
    assert drawn["camera.workspace"].startswith("workspace_")
    assert (drawn["target"], drawn["target.color"]) == ("cube", "blue")
    assert draw(0, "rotate").task.drawn["direction"] in ("clockwise", "counter-clockwise")
    assert draw(0, "rotate").task.drawn["distractors.near"] in ("yes", "no")
    drawn = draw(1, "pick_cube_randomised")
    assert float(drawn.task.drawn["light.intensity"]) == pytest.approx(drawn.scene.look.lights[0].intensity, rel=1e-3)
    assert drawn.task.drawn["table.texture"] == (drawn.scene.look.table.texture or "none")
    assert int(drawn.task.drawn["distractors"]) == len(drawn.task.objects) - 1
    assert "robot.position" not in drawn.task.drawn, "vectors of ranges are in the scene"


def test_a_sample_has_the_choices_of_the_episode(draw, generator, seed_path):
    config = load_task_config("pick_cube_randomised")
    sampled, drawn = generator.sample(seed_path(2), config).drawn, draw(2, config).task.drawn
    assert sampled.items() <= drawn.items()
    assert sampled["light.intensity"]


def test_a_null_unsets_a_key(draw):
    text = "cells: [{tasks: [pick_cube, place_on]}]\nset: {objects: {target: {modifiers: {color: null}}}}"
    mix = parse_task_config(text)
    assert draw(0, mix).task.instruction == "Pick up the cube"
    assert not draw(0, mix).task.objects["target"].modifiers


def test_the_cube_of_the_camera_and_skill_datasets_is_blue_and_not_called_so(draw):
    mix = load_task_config("camera_skill_baseline")
    tasks = [draw(index, mix).task for index in range(9)]
    assert {task.objects["target"].modifiers["color"] for task in tasks} == {"blue"}
    assert {task.instruction for task in tasks} == {
        "Pick up the cube", "Place the cube on the plate", "Rotate the cube clockwise by 90 degrees",
    }  # fmt: skip
