"""Sets of objects: a name for many, known by id, no default anywhere, and members in place of the name in tasks."""

from __future__ import annotations

import pytest

from roboxim_core.config import config_dir
from roboxim_core.config_folders import config_sets
from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_runs.episodes.task_choice import task_text
from roboxim_tasks.config import parse_task_config
from roboxim_tasks.meaning import read_instruction

FORMS = {"red_wedge": "red wedge", "blue_wedge": "blue wedge", "small_blue_peg": "small blue peg"}


@pytest.fixture
def library(tmp_path, monkeypatch):
    folder = tmp_path / "objects" / "forms"
    folder.mkdir(parents=True)
    cube = (config_dir() / "objects" / "cube.yaml").read_text()
    for name, noun in FORMS.items():
        (folder / f"{name}.yaml").write_text(cube.replace("name: cube", f"name: {noun}"))
    (tmp_path / "objects" / "red_wedge_parts").mkdir()  # a folder without a YAML file is no set
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))
    return ModelLibrary()


def test_a_set_has_a_name_its_objects_have_ids_and_neither_is_a_default(library):
    assert library.object_sets["forms"] == tuple(sorted(FORMS))
    assert library.object("small_blue_peg").name == "small blue peg"
    assert set(FORMS) < set(library.known_objects)
    assert not set(FORMS) & set(library.object_ids)
    assert library.expanded(["cube", "forms"]) == ("cube", *sorted(FORMS))
    assert len(library.digest("red_wedge")) == 16
    assert library.changed({"red_wedge": library.digest("red_wedge")}) == ()
    with pytest.raises(ConfigError, match="did you mean 'small_blue_peg'"):
        library.object("smal_blue_peg")


def test_the_first_folder_of_the_search_path_gives_an_object_of_a_set(tmp_path):
    for part in ("one", "two"):
        (tmp_path / part / "objects" / "forms").mkdir(parents=True)
        (tmp_path / part / "objects" / "forms" / "it.yaml").touch()
    found = config_sets("objects", [tmp_path / "two", tmp_path / "one"])
    assert found == {"forms": {"it": tmp_path / "two" / "objects" / "forms" / "it.yaml"}}


def test_a_task_draws_from_a_set_whose_objects_share_its_weight(library):
    task = "skill: pick_up\nobjects: {target: {models: {values: [cube, forms], weights: [3, 6]}}}\n"
    models = parse_task_config(task).objects["target"].models
    assert models.values == ("cube", *sorted(FORMS))
    assert models.weights == (3, 2, 2, 2)
    text = task_text(skill="pick_up", objects=("forms",), distractors="1")
    assert parse_task_config(text).objects["target"].models.values == tuple(sorted(FORMS))
    with pytest.raises(ConfigError, match="did you mean 'forms'"):
        task_text(skill="pick_up", objects=("froms",))


def test_a_mix_has_a_cell_for_each_object_of_a_set(library):
    mix = parse_task_config("cells: [{tasks: [pick_up], models: {target: [forms, cube]}}]")
    assert mix.keys == tuple(f"pick_up target={name}" for name in (*sorted(FORMS), "cube"))


def test_an_instruction_about_a_set_s_object_is_understood(library):
    entities = tuple(EntitySpec(name=name, model=name) for name in FORMS)
    scene = SceneSpec(entities=entities)
    reading = read_instruction("Pick up the small blue peg", scene, library)
    assert [task.objects["target"].model for task in reading.tasks] == ["small_blue_peg"]
    assert read_instruction("Pick up the green peg", scene, library).absent == ("green peg",)
