"""The command line's task options, and ``roboxim tasks``."""

import json

import pytest
import yaml
from click.testing import CliRunner

from roboxim_cli.main import group
from roboxim_core.config import from_json
from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import TaskSpec
from roboxim_runs.episodes.task_choice import task_text
from roboxim_tasks.config import load_task_config, parse_task_config
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.skills import SKILLS


def roboxim(*arguments):
    return CliRunner().invoke(group, ["tasks", *arguments], catch_exceptions=False).output


def test_a_skill_with_chosen_objects():
    text = task_text(skill="place_on", objects=("apple,knife", "support=tray"), distractors="2")
    config = parse_task_config(text)
    assert config.objects["target"].models.values == ("apple", "knife")
    assert config.objects["support"].models.values == ("tray",)
    assert (config.distractors.minimum, config.distractors.maximum) == (2, 2)


@pytest.mark.parametrize("content", ["", "# a comment only\n", "---\n"])
def test_an_empty_task_file_is_no_default_task(tmp_path, content):
    (tmp_path / "own.yaml").write_text(content)
    for read in (task_text, load_task_config):
        with pytest.raises(ConfigError, match=r"own.yaml is empty; expected a task, at least 'skill: NAME'"):
            read(str(tmp_path / "own.yaml"))


def test_options_keep_the_numbers_of_a_task_file_as_yaml_1_2_has_them(tmp_path):
    (tmp_path / "own.yaml").write_text("skill: pick_up\ndistractors: {minimum: 0, maximum: 0o7}\n")  # text in YAML 1.1
    for colors in ("", "red"):
        assert parse_task_config(task_text(str(tmp_path / "own.yaml"), colors=colors)).distractors.maximum == 7


def test_modifiers_that_no_model_takes_are_dropped_and_the_default_is_the_main_job_s():
    data = yaml.safe_load(task_text(objects=("cucumber",)))
    assert data["objects"]["target"]["modifiers"] == {}
    stack = parse_task_config(task_text(skill="stack", objects=("apple",)))  # apples are never blue
    assert stack.objects["target"].modifiers["color"].values == ("red", "green", "yellow")
    assert set(stack.objects["support"].modifiers["color"].values) > {"blue"}
    assert parse_task_config(task_text()).skill == "pick_up"
    assert parse_task_config(task_text("skill_object_baseline", distractors="3")).cells[0].distractors.minimum == 3


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"skill": "place_onn"}, ["place_onn", "place_on"]),
        ({"skill": "place_on", "task": "pick_cube"}, ["either", "--task", "--skill"]),
        ({"objects": ("aple",)}, ["aple", "apple"]),
        ({"objects": ("support=plate",)}, ["support", "target"]),
        ({"objects": ("plate",)}, ["plate", "graspable"]),
        ({"task": "skill_object_baseline", "objects": ("cube",)}, ["mix", "--object"]),
        ({"distractors": "many"}, ["--distractors", "1-3"]),
        ({"skill": "put_into", "objects": ("banana",)}, ["objects", "the banana is too long for the bowl"]),
        ({"skill": "put_into", "objects": ("bottle",)}, ["the bottle sticks out of the bowl"]),
        ({"skill": "stack", "objects": ("tray",)}, ["the tray is too long to lie on the cube", "on the block"]),
    ],
)
def test_impossible_tasks_are_refused_with_the_reason(given, said):
    with pytest.raises(ConfigError) as error:
        task_text(**given)
    for part in said:
        assert part in str(error.value)


def test_list_names_every_skill_and_its_suitable_objects():
    listed = json.loads(roboxim("list", "--json"))
    assert set(listed["skills"]) == set(SKILLS)
    assert "plate" in listed["skills"]["place_on"]["roles"]["support"]
    assert "plate" not in listed["skills"]["pick_up"]["roles"]["target"]
    assert listed["tasks"]["skill_object_leave_out"]["episodes"] == 324
    put_into = listed["skills"]["put_into"]["roles"]
    assert "banana" not in put_into["target"] or "tray" in put_into["container"]
    assert "mug" not in put_into["container"]  # no object fits into it
    text = roboxim("list")
    assert all(name in text for name in SKILLS)


def test_a_sample_equals_the_generated_tasks():
    lines = roboxim(
        "sample", "--skill", "stack", "--seed", "7", "--episodes", "3", "--first", "2", "--json"
    ).splitlines()
    generator = EpisodeGenerator(ModelLibrary())
    config = parse_task_config(task_text(skill="stack"))
    for index, line in zip((2, 3, 4), lines, strict=True):
        seed = SeedPath(run_seed=7, purpose="demo", index=index)
        assert from_json(line, TaskSpec) == generator.sample(seed, config)
    assert "Stack the" in roboxim("sample", "--skill", "stack", "--episodes", "1")
