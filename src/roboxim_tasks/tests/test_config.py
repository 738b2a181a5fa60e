from collections import Counter

import pytest

from roboxim_core.config import config_dir, to_plain
from roboxim_core.errors import ConfigError, TaskError
from roboxim_tasks.config import TaskMix, load_task_config, parse_task_config, task_config


@pytest.mark.parametrize("path", sorted((config_dir() / "tasks").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_shipped_task_loads_and_its_resolved_form_loads_again(path):
    config = load_task_config(str(path))
    for cell in config.cells if isinstance(config, TaskMix) else (config,):
        assert task_config(to_plain(cell)) == cell


TARGET = "objects:\n  target:\n    "
RESET = "skill: pick_up\nreset:\n  "
EXCLUDE = "skill: pick_up\nexclude:\n  - target: "
CELL = "cells:\n  - tasks: [pick_up, rotate]\n    models: {target: [cube, apple]}\n    "


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("skill: pick_upp", ["skill (line 1)", "'pick_upp'", "pick_up"]),
        ("rate_hz: 10\nmax_step: 3", ["max_step (line 2)", "did you mean 'max_steps'"]),
        ("rate_hz: 10\n3: a", ["3 (line 2)", "unknown key"]),
        ("max_steps: 3\nmax_draws: 0", ["max_draws (line 2)", ">= 1"]),
        ("skill: pick_up\nrate_hz: 7", ["rate_hz (line 2)", "divide", "for example 5, 8, 10"]),
        ("skill: pick_up\nscene: empty_tabel", ["scene (line 2)", "'empty_tabel'", "did you mean 'empty_table'"]),
        ("a: [", ["line 1", "YAML"]),
        ("- a\n- b", ["mapping"]),
        ("objects:\n  targett: {}", ["objects.targett (line 2)", "target"]),
        (TARGET + "modifiers:\n      color: {values: [red, blu]}", ["modifiers.color (line 4)", "'blu'", "blue"]),
        (TARGET + "modifiers:\n      color: {lower: 0, upper: 1}", ["modifiers.color (line 4)", "'0.0'", "blue"]),
        (TARGET + "modifiers: {colour: {values: [red]}}", ["modifiers.colour (line 3)", "color"]),
        (
            TARGET + "modifiers: {scale: {lower: 1.2,\n upper: 0.9}}",
            ["scale.lower (line 3)", "must not be above upper"],
        ),
        (TARGET + "models: {values: [cubes]}", ["objects.target.models (line 3)", "'cubes'", "cube"]),
        (TARGET + "models: {values: []}", ["objects.target.models.values (line 3)", "values (a list)", "a range"]),
        (TARGET + "models: {lower: 0, upper: 1}", ["objects.target.models (line 3)", "values", "not a range"]),
        (TARGET + "models: {values: [plate]}", ["objects.target.models (line 3)", "plate", "graspable", "cube"]),
        (TARGET + "models:\n      values: [cube]\n      order: inorder", ["models.order (line 5)", "in_order, random"]),
        (TARGET + "models:\n      values: [cube]\n      weights: [1, 2]", ["models.weights (line 5)", "the 1 values"]),
        ("distractors:\n  minimum: 3", ["distractors.minimum (line 2)", "minimum <= maximum <= 8"]),
        (RESET + "lightz: {}", ["reset.lightz (line 3)", "lights"]),
        (RESET + "robot: 3", ["reset.robot (line 3)", "a mapping", "position"]),
        (RESET + "objects:\n    gapp: 1", ["reset.objects.gapp (line 4)", "gap_m"]),
        (RESET + "objects:\n    area: {lower: [0.4], upper: [0.5]}", ["reset.objects.area (line 4)", "2 numbers"]),
        (RESET + "objects: {area: {values: [0.4, 0.5]}}", ["reset.objects.area.values.0 (line 3)", "a list, got 0.4"]),
        (RESET + "objects:\n    yaw_rad: {values: [north]}", ["reset.objects.yaw_rad (line 4)", "number", "'north'"]),
        (RESET + "objects:\n    roles:\n      targt: {}", ["reset.objects.roles.targt (line 5)", "target"]),
        (RESET + "interaction_area:\n    roles: [targt]", ["reset.interaction_area.roles (line 4)", "target"]),
        (RESET + "blocked_way:\n    between: [[tool, targt]]", ["reset.blocked_way.between (line 4)", "target, tool"]),
        (
            RESET + "robot: {position: {lower: [0.5, 0, 0.3], upper: [0.4, 0, 0.3]}}",
            ["reset.robot.position.lower (line 3)", "axis 0"],
        ),
        (RESET + "robot:\n    gripper_opening: {values: [2]}", ["gripper_opening (line 4)", "0 to 1, got 2"]),
        (
            RESET + "cameras: {names: [wrist], shift_m: {workspace: {values: [[0, 0, 0]]}}}",
            ["reset.cameras.shift_m (line 3)", "wrist"],
        ),
        (
            RESET + "surfaces:\n    table:\n      texture: {values: [wodd]}",
            ["reset.surfaces.table.texture (line 5)", "did you mean 'wood'"],
        ),
        (
            RESET + "surfaces:\n    floor:\n      color: {values: [[2, 0, 0]]}\n      roughness: {values: [dull]}",
            ["reset.surfaces.floor.color (line 5)", "from 0 to 1"],
        ),
        (RESET + "lights:\n    intensity: {values: [bright]}", ["reset.lights.intensity (line 4)", "a number >= 0"]),
        (
            RESET + "lights:\n    direction: [[0, 0, -1], [0, 0, 0]]",
            ["reset.lights.direction (line 4)", "length but 0"],
        ),
        (
            RESET + "lights:\n    direction: {lower: [0, 0, 0], upper: [0, 0, 0]}",
            ["reset.lights.direction (line 4)", "length but 0"],
        ),
        (
            RESET + "lights:\n    ambient: {lower: [-0.1, 0, 0], upper: [1, 1, 1]}",
            ["reset.lights.ambient (line 4)", "numbers >= 0, got [-0.1, 0.0, 0.0]"],
        ),
        ("parameters: {lift_m: high}", ["parameters.lift_m (line 1)", "number"]),
        ("parameters:\n  hold_s: -1", ["parameters.hold_s (line 2)", "hold_s >= 0"]),
        ("lenient:\n  lift_mm: 3", ["lenient.lift_mm (line 2)", "lift_m"]),
        ("lenient: [1]", ["lenient (line 1)", "a mapping", "lift_m"]),
        ("arguments:\n  lifted: {values: [1]}", ["arguments.lifted (line 2)", "lift_m"]),
        ("arguments:\n  lift_m: {values: [0.5]}", ["arguments.lift_m (line 2)", "lift_m <= 0.1"]),
        ("arguments:\n  lift_m: {values: [high]}", ["arguments.lift_m.values (line 2)", "a number"]),
        (
            "skill: rotate\narguments:\n  angle_deg: {values: [90]}\n  direction: {values: [left]}",
            ["arguments.direction (line 4)", "'left'", "clockwise"],
        ),
        (
            "skill: rotate\narguments:\n  angle_deg: {values: [90, 20]}\nlenient: {tolerance_deg: 30}",
            ["arguments.angle_deg (line 3)", "tolerance_deg < angle_deg"],
        ),
        (
            "skill: open_drawer\narguments:\n  drawer: {values: [top, lowest]}",
            ["arguments.drawer (line 3)", "'lowest'", "bottom, middle, top"],
        ),
        ("skill: open_drawer\nparameters:\n  drawer: lowest", ["parameters.drawer (line 3)", "bottom, middle, top"]),
        ("templates:\n  values: ['Lift {target}']\n  lower: 1", ["templates", "either values", "range"]),
        ("rate_hz: 10\ntemplates: {values: ['Lift the {thing}']}", ["templates (line 2)", "'thing'", "target"]),
        ("templates: {values: ['Lift the {target']}", ["templates (line 1)", "Lift the"]),
        ("templates: {lower: 0, upper: 1}", ["templates (line 1)", "not a range"]),
        ("skill: pick_up\nexclude:\n  - targett: {model: cube}", ["exclude.0.targett (line 3)", "target"]),
        ("skill: pick_up\nexclude: [{}]", ["exclude (line 2)", "excludes everything"]),
        (EXCLUDE + "apple", ["exclude.0.target (line 3)", "a mapping, got 'apple'"]),
        (EXCLUDE + "{modle: cube}", ["exclude.0.target.modle (line 3)", "did you mean 'model'"]),
        (EXCLUDE + "{model: appel}", ["exclude.0.target.model (line 3)", "did you mean 'apple'"]),
        (EXCLUDE + "{model: plate}", ["exclude.0.target.model (line 3)", "graspable", "cube"]),
        (EXCLUDE + "{model: apple, color: purple}", ["exclude.0.target.color (line 3)", "green, red, yellow"]),
        (EXCLUDE + "{color: purpel}", ["exclude.0.target.color (line 3)", "did you mean 'purple'"]),
        (EXCLUDE + "{scale: 9}", ["exclude.0.target.scale (line 3)", "from 0.6 to 1.4"]),
        (EXCLUDE + "{model: cube}", ["exclude (line 2)", "excludes everything"]),
        (EXCLUDE + "{color: red}", ["exclude (line 2)", "excludes everything"]),
        ("cells: [{tasks: [pick_up], epsiodes: 3}]", ["cells.0.epsiodes (line 1)", "episodes"]),
        ("cells:\n  - tasks: [rotate, pick_upp]", ["cells.0.tasks.1 (line 2)", "did you mean 'pick_up'"]),
        ("cells:\n  - tasks: [skill_object_baseline]", ["cells.0.tasks.0 (line 2)", "a mix itself"]),
        ("cells:\n  - tasks: []", ["cells.0.tasks (line 2)", "at least one"]),
        ("cells: []", ["cells (line 1)", "at least one"]),
        (CELL + "episodes: 0", ["cells.0.episodes (line 4)", "from 1 to"]),
        (CELL + "exclude:\n      - {taks: rotate}", ["cells.0.exclude.0.taks (line 5)", "did you mean 'task'"]),
        (CELL + "exclude:\n      - {task: rotat}", ["cells.0.exclude.0.task (line 5)", "pick_up, rotate"]),
        (CELL + "exclude:\n      - {target: appel}", ["cells.0.exclude.0.target (line 5)", "apple, cube"]),
        (CELL + "exclude:\n      - {}", ["cells (line 1)", "every cell is excluded"]),
        ("cells:\n  - tasks: [rotate]\n    models:\n      target: cube", ["cells.0.models.target (line 4)", "a list"]),
        (
            "cells:\n  - tasks: [rotate]\n    models:\n      target: []",
            ["cells.0.models.target (line 4)", "at least one"],
        ),
        (
            "cells:\n  - tasks: [pick_up]\n    models: {target: [plate]}",
            ["cells.0, task 'pick_up'", "objects.target.models (line 3)", "graspable", "cube"],
        ),
        (
            "cells:\n  - tasks: [pick_up]\n    models:\n      targt: [cube]",
            ["cells.0, task 'pick_up'", "objects.targt (line 4)", "target"],
        ),
        (CELL + "set: {reset: {cameras: {view: {}}}}", ["cells.0", "reset.cameras.view (line 4)", "views"]),
        (CELL + "\nset:\n  distractor: {}", ["cells.0", "distractor (line 6)", "distractors"]),
    ],
)
def test_wrong_yaml_is_refused_with_its_line_what_is_wrong_and_what_is_allowed(text, said):
    with pytest.raises(ConfigError) as error:
        parse_task_config(text)
    for part in said:
        assert part in str(error.value)


def test_a_mix_names_the_file_of_a_task_whose_key_does_not_suit_it(tmp_path):
    task, mix = tmp_path / "lift.yaml", tmp_path / "mix.yaml"
    task.write_text("skill: pick_up\ndistractors:\n  minimum: 2\n  maximum: 2\n")
    mix.write_text(f"cells:\n  - tasks: [{task}]\n    set: {{distractors: {{maximum: 1}}}}\n")
    with pytest.raises(ConfigError) as error:
        load_task_config(str(mix))
    assert f"distractors.minimum (line 3 of {task})" in str(error.value)
    assert str(error.value).startswith(f"{mix}: cells.0, task")
    mix.write_text(f"cells:\n  - tasks: [{task}]\n    set: {{distractors: {{minimum: two}}}}\n")
    with pytest.raises(ConfigError, match=r"distractors\.minimum \(line 3\): expected a whole number, got 'two'"):
        load_task_config(str(mix))


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


@pytest.mark.parametrize("purpose", ["eval", "train"])
def test_lenient_thresholds_are_for_policies_and_arguments_vary(draw, purpose):
    text = """
skill: pick_up
parameters: {lift_m: 0.06}
lenient: {lift_m: 0.03}
arguments: {hold_s: {values: [0.2, 0.4], order: in_order}}
"""
    config = parse_task_config(text)
    demo, policy = draw(0, config, purpose="demo").task, draw(1, config, purpose=purpose).task
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


def test_what_an_object_is_by_default_counts_for_exclusions(draw):
    text = """
skill: pick_up
objects: {target: {models: {values: [apple, cube]}, modifiers: {size: {values: [small]}}}}
exclude: [{target: {model: apple, color: red}}]
"""
    drawn = {draw(index, parse_task_config(text)).task.objects["target"].model for index in range(20)}
    assert drawn == {"cube"}
    with pytest.raises(ConfigError, match="excludes everything"):
        parse_task_config(text.replace("[apple, cube]", "[apple]"))
    parse_task_config(text.replace("[apple, cube]", "[apple]").replace("size: {", "color: {values: [green]}, size: {"))


def test_exclusions_that_leave_something_are_taken_whatever_else_they_name():
    text = "skill: pick_up\nobjects: {target: {models: {values: [cube, apple], weights: [1, 0]}}}\nexclude: "
    parse_task_config(text + "[{target: {model: apple}}]")  # which a mix, or the command line, may have taken out
    with pytest.raises(ConfigError, match="excludes everything"):
        parse_task_config(text + "[{target: {model: cube}}]")  # the apple's weight is 0


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


def test_a_mix_of_a_thousand_million_episodes_costs_nothing():
    mix = parse_task_config("cells: [{tasks: [pick_cube], episodes: 1000000000}, {tasks: [stack], episodes: 3}]")
    skills = [mix.at(index)[0].skill for index in (0, 1, 10**9 // 6, 10**9 // 6 + 1, 10**9 + 2)]
    assert skills.count("stack") == 1
    assert mix.at(10**9 + 3)[1] == mix.counts[0]
    with pytest.raises(ConfigError, match="episodes must be from 1 to"):
        parse_task_config("cells: [{tasks: [pick_cube], episodes: 10000000000000}]")


def test_the_order_of_a_mix_is_that_of_its_shares():
    mix = parse_task_config("cells: [{tasks: [pick_cube], episodes: 7}, {tasks: [stack, place_on], episodes: 4}]")
    places = sorted(((k + 0.5) / count, cell, k) for cell, count in enumerate(mix.counts) for k in range(count))
    assert list(mix.order) == [(cell, k) for _, cell, k in places]


@pytest.mark.parametrize(
    "text",
    ["{skill: open_drawer, parameters: {open_m: 0.15}}", "{skill: open_door, parameters: {open_rad: 2}}",
     "{skill: turn_knob, parameters: {turn_rad: 3}}", "{skill: flip_switch, lenient: {flip_rad: 0.8}}",
     "{skill: open_drawer, arguments: {open_m: {values: [0.1, 0.3]}}}"],
)  # fmt: skip
def test_a_goal_beyond_the_travel_of_a_joint_is_refused(text):
    with pytest.raises(ConfigError, match=r"needs more than the .* of the"):
        parse_task_config(text)


@pytest.mark.parametrize(
    "text",
    ["{skill: turn_knob, reset: {joints: {target: {values: [0.2]}}}}",
     "{skill: flip_switch, reset: {joints: {target: {values: [0.5]}}}}"],
)  # fmt: skip
def test_a_joint_that_stands_too_near_to_its_end_is_not_drawn(text, draw):
    with pytest.raises(TaskError, match=r"far_enough 100.*reset.joints"):
        draw(0, parse_task_config(text))
