"""Lists in order never make an episode impossible: what may not be drawn is passed over."""

from collections import Counter

import pytest

from roboxim_core.errors import TaskError
from roboxim_tasks.config import parse_task_config


@pytest.fixture
def tasks(generator, seed_path):
    """Draw the tasks of the first episodes of a configuration."""
    return lambda text, count=6: [generator.task(seed_path(i), parse_task_config(text)) for i in range(count)]


def models(task):
    return [thing.model for role, thing in task.objects.items() if role.startswith("distractor")]


def test_distractors_of_an_episode_step_on_and_pass_over_what_the_instruction_means(tasks):
    text = """
skill: pick_up
objects: {target: {models: {values: [cube]}}}
distractors: {minimum: 2, maximum: 2, models: {values: [cube, apple, onion, lemon], order: in_order}}
"""
    assert [models(task) for task in tasks(text, 5)] == [
        ["apple", "onion"], ["apple", "onion"], ["onion", "lemon"], ["lemon", "apple"], ["apple", "onion"],
    ]  # fmt: skip


def test_what_is_at_random_is_drawn_again_before_a_list_steps_on(tasks):
    text = """
skill: pick_up
objects: {target: {models: {values: [cube]}, modifiers: {color: {values: [red]}}}}
distractors:
  minimum: 1
  maximum: 1
  models: {values: [cube, apple], order: in_order}
  modifiers: {color: {values: [red, green]}}
"""
    drawn = tasks(text, 20)
    assert [models(task) for task in drawn] == [["cube"], ["apple"]] * 10
    assert {task.objects["distractor_1"].modifiers["color"] for task in drawn[::2]} == {"green"}


def test_two_lists_of_distractors_find_the_one_pair_that_is_left(tasks):
    text = """
skill: stack
objects:
  support: {models: {values: [cube]}, modifiers: {color: {values: [red]}}}
  target: {models: {values: [apple]}, modifiers: {color: {values: [green]}}}
distractors:
  minimum: 1
  maximum: 1
  models: {values: [cube, apple], order: in_order}
  modifiers: {color: {values: [red, green], order: in_order}}
"""
    for task in tasks(text):
        other = task.objects["distractor_1"]
        assert (other.model, other.modifiers["color"]) in {("cube", "green"), ("apple", "red")}


def test_one_list_of_colours_for_both_roles_of_a_tower(tasks):
    colors = "models: {values: [cube]}, modifiers: {color: {values: [red, green, blue], order: in_order}}"
    drawn = tasks(f"skill: stack\nobjects: {{support: {{{colors}}}, target: {{{colors}}}}}")
    assert [task.instruction for task in drawn[:3]] == [
        "Stack the green cube on the red cube",
        "Stack the blue cube on the green cube",
        "Stack the red cube on the blue cube",
    ]
    assert Counter(task.instruction for task in drawn).most_common(1)[0][1] == 2


def test_an_ordered_role_keeps_its_turn_as_long_as_that_is_possible(tasks):
    text = """
skill: pick_up
objects:
  target:
    models: {values: [cube, apple, onion], order: in_order}
    modifiers: {color: {values: [red, green]}}
exclude: [{target: {model: apple, color: green}}, {target: {model: onion}}]
"""
    drawn = [task.objects["target"] for task in tasks(text, 12)]
    assert [thing.model for thing in drawn] == ["cube", "apple", "cube"] * 4
    assert all(thing.modifiers["color"] == "red" for thing in drawn if thing.model == "apple")


def test_one_list_of_positions_for_two_objects(draw):
    text = """
skill: stack
objects:
  support: {models: {values: [cube]}, modifiers: {color: {values: [red]}}}
  target: {models: {values: [cube]}, modifiers: {color: {values: [blue]}}}
reset: {objects: {area: {values: [[0.45, -0.1], [0.45, 0.1], [0.55, 0.0]], order: in_order}}}
"""
    scenes = [draw(index, parse_task_config(text)).scene for index in range(3)]
    placed = [[tuple(round(v, 3) for v in e.pose.position[:2]) for e in scene.entities] for scene in scenes]
    first, second, third = (0.45, -0.1), (0.45, 0.1), (0.55, 0.0)
    assert placed == [[first, second], [second, third], [third, first]]


def test_what_no_order_can_help_is_still_refused(tasks):
    color = "modifiers: {color: {values: [red], order: in_order}}"
    with pytest.raises(TaskError, match="objects_distinct refused most of 1 draws"):
        tasks(f"skill: stack\nobjects: {{support: {{models: {{values: [cube]}}, {color}}}, target: {{{color}}}}}", 1)
    everything = "models: {values: [cube, cube], order: in_order}, minimum: 1, maximum: 1"
    with pytest.raises(TaskError, match="distractor_distinct refused all of 2 draws"):
        tasks(f"skill: pick_up\ndistractors: {{{everything}}}", 1)


def test_what_is_too_large_for_its_role_is_not_drawn(tasks):
    """A tower stands on what is at most 10 cm wide, which a large block is not."""
    text = "{{skill: stack, objects: {{support: {{models: [wooden_block], modifiers: {{size: {}}}}}}}}}"
    assert {task.objects["support"].modifiers["size"] for task in tasks(text.format("[small, large]"), 12)} == {"small"}
    with pytest.raises(TaskError, match="role_suited refused most of .* a large block as support"):
        tasks(text.format("[large]"))
