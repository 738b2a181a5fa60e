from collections import Counter

import pytest

from roboxim_core.config import config_dir, to_plain
from roboxim_core.errors import ConfigError
from roboxim_tasks.config import TaskMix, load_task_config, parse_task_config, task_config


@pytest.mark.parametrize("path", sorted((config_dir() / "tasks").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_shipped_task_loads_and_its_resolved_form_loads_again(path):
    config = load_task_config(str(path))
    for cell in config.cells if isinstance(config, TaskMix) else (config,):
        assert task_config(to_plain(cell)) == cell


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("skill: pick_upp", ["line 1", "skill", "'pick_upp'", "pick_up"]),
        ("rate_hz: 10\nmax_step: 3", ["line 2", "max_step", "did you mean 'max_steps'"]),
        ("objects:\n  targett: {}", ["line 2", "targett", "target"]),
        (
            "objects:\n  target:\n    modifiers:\n      color: {values: [red, blu]}",
            ["line 4", "color", "'blu'", "blue"],
        ),
        ("objects:\n  target:\n    modifiers: {colour: {values: [red]}}", ["line 3", "'colour'", "color"]),
        ("objects:\n  target:\n    models: {values: [cubes]}", ["line 3", "'cubes'", "cube"]),
        ("distractors:\n  minimum: 3", ["distractors", "minimum <= maximum"]),
        ("reset:\n  lightz: {}", ["line 2", "lightz", "lights"]),
        ("reset:\n  objects:\n    gapp: 1", ["line 3", "gapp", "gap_m"]),
        ("reset:\n  objects:\n    area: {lower: [0.4], upper: [0.5]}", ["reset.objects", "area", "2 numbers"]),
        ("reset: {robot: {position: {lower: [0.5, 0, 0.3], upper: [0.4, 0, 0.3]}}}", ["position", "lower", "axis 0"]),
        ("parameters: {lift_m: high}", ["parameters", "lift_m", "number"]),
        ("reset: {cameras: {names: [wrist], shift_m: {workspace: {values: [[0, 0, 0]]}}}}", ["workspace", "wrist"]),
        ("templates: {values: ['Pick up the {target}'], lower: 1}", ["either values", "range"]),
        ("rate_hz: 10\ntemplates: {values: ['Lift the {thing}']}", ["line 2", "templates", "'thing'", "target"]),
        ("templates: {values: ['Lift the {target']}", ["line 1", "templates", "Lift the"]),
        ("objects: {target: {models: {values: [plate]}}}", ["line 1", "plate", "graspable", "cube"]),
        ("lenient: {lift_mm: 3}", ["lenient", "lift_mm", "lift_m"]),
        ("arguments: {lifted: {values: [1]}}", ["arguments.lifted", "lift_m"]),
        ("arguments: {lift_m: {values: [0.5]}}", ["arguments.lift_m", "lift_m <= 0.1"]),
        ("exclude: [{targett: {model: cube}}]", ["exclude[0]", "targett", "target"]),
        ("objects: {target: {models: {values: [cube], weights: [1, 2]}}}", ["models", "weights"]),
        ("cells: [{tasks: [pick_up], epsiodes: 3}]", ["line 1", "epsiodes", "episodes"]),
        ("cells: [{tasks: [pick_upp]}]", ["pick_upp", "pick_up"]),
        ("cells: [{tasks: [pick_up], models: {target: [plate]}}]", ["cells[0]", "pick_up", "plate", "graspable"]),
        ("cells: [{tasks: [pick_up], exclude: [{task: pick_up}]}]", ["every cell is excluded"]),
        ("a: [", ["line 1", "YAML"]),
        ("- a\n- b", ["mapping"]),
    ],
)
def test_wrong_yaml_is_refused_with_what_is_wrong_and_what_is_allowed(text, said):
    with pytest.raises(ConfigError) as error:
        parse_task_config(text)
    for part in said:
        assert part in str(error.value)


def test_a_mix_has_exact_counts_and_its_beginnings_are_balanced(draw):
    text = """
cells:
  - tasks: [pick_up, place_on]
    models: {target: [cube, apple, onion]}
    exclude: [{task: pick_up, target: apple}]
    episodes: 4
  - {tasks: [stack], episodes: 2, set: {distractors: {minimum: 0, maximum: 0}}}
"""
    mix = parse_task_config(text)
    assert mix.counts == (4, 4, 4, 4, 4, 2)
    drawn = [mix.at(index) for index in range(22)]
    cells = Counter((cell.skill, str(cell.objects["target"].models.values)) for cell, _ in drawn)
    assert sorted(cells.values()) == [2, 4, 4, 4, 4, 4]
    assert ("pick_up", "('apple',)") not in cells
    assert {number for cell, number in drawn if cell.skill == "stack"} == {0, 1}
    assert len({id(cell) for cell, _ in drawn[:7]}) >= 5
    assert mix.at(22)[0] is drawn[0][0]
    assert mix.at(22)[1] == 4
    assert draw(0, mix).task.skill == drawn[0][0].skill
    assert mix.cells[-1].distractors.maximum == 0


def test_ordered_lists_go_by_the_number_in_the_cell(draw):
    text = """
cells:
  - tasks: [stack]
    episodes: 3
    set: {objects: {target: {modifiers: {color: {values: [red, green, blue], order: in_order}}}}}
  - {tasks: [pick_up], episodes: 3}
"""
    mix = parse_task_config(text)
    colors = [draw(i, mix).task.objects["target"].modifiers["color"] for i in range(6) if mix.at(i)[0].skill == "stack"]
    assert colors == ["red", "green", "blue"]


def test_lenient_thresholds_are_for_policies_and_arguments_vary(draw):
    text = """
skill: pick_up
parameters: {lift_m: 0.06}
lenient: {lift_m: 0.03}
arguments: {hold_s: {values: [0.2, 0.4], order: in_order}}
"""
    config = parse_task_config(text)
    demo, policy = draw(0, config, purpose="demo").task, draw(1, config, purpose="eval").task
    assert (demo.arguments["lift_m"], policy.arguments["lift_m"]) == (0.06, 0.03)
    assert (demo.arguments["hold_s"], policy.arguments["hold_s"]) == (0.2, 0.4)


def test_an_excluded_combination_is_never_drawn(draw):
    text = """
skill: pick_up
objects: {target: {models: {values: [cube, apple], weights: [1, 3]}, modifiers: {color: {values: [red, green]}}}}
exclude: [{target: {model: apple, color: green}}]
"""
    drawn = [draw(index, parse_task_config(text)).task.objects["target"] for index in range(60)]
    counts = Counter((thing.model, thing.modifiers["color"]) for thing in drawn)
    assert set(counts) == {("cube", "red"), ("cube", "green"), ("apple", "red")}
    assert counts["apple", "red"] > 25


@pytest.mark.parametrize(
    ("name", "total", "each"),
    [
        ("skill_object_baseline", 324, 18), ("skill_object_leave_out", 324, 27), ("camera_object_baseline", 324, 18),
        ("camera_object_leave_out", 324, 27), ("camera_skill_baseline", 306, 34), ("camera_skill_leave_out", 306, 51),
    ],
)  # fmt: skip
def test_the_leave_out_and_baseline_datasets_have_the_counts_that_they_should(name, total, each):
    mix = load_task_config(name)
    assert (sum(mix.counts), set(mix.counts)) == (total, {each})
    cells = {
        (cell.skill, cell.objects["target"].models.values, cell.reset["cameras"].views.get("workspace"))
        for cell in mix.cells
    }
    assert len(cells) == total // each
