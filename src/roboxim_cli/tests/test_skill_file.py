"""A skill is one file: ``--skill my_skill.py:Touch``."""

from __future__ import annotations

import json

import pytest
import trimesh
from click.testing import CliRunner

from roboxim_cli.main import group
from roboxim_core.errors import ConfigError, TaskError
from roboxim_core.models.check import check_object
from roboxim_core.seeds import SeedPath
from roboxim_runs.episodes.task_choice import cells_of, task_text
from roboxim_runs.scenes.definitions import definitions_of
from roboxim_tasks.config import parse_task_config
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.skills import SKILLS, from_file

SKILL = """
from __future__ import annotations

from dataclasses import dataclass

from roboxim_tasks.measures import Condition, Conditions, pressing_links
from roboxim_tasks.motion import grasps_of
from roboxim_tasks.reach import graspable, start_clear
from roboxim_tasks.script import Script
from roboxim_tasks.skills import Role, Skill


@dataclass(frozen=True, kw_only=True)
class TouchParameters:
    force_n: float = 0.05


class Touch(Skill):
    templates = ("Touch the {target}",)
    roles = {"target": Role(affordance="graspable", models=("cube",))}
    Parameters = TouchParameters

    def constraints(self, context):
        return graspable(context, "target"), start_clear(context)

    def stages(self, scene):
        for grasp in grasps_of(scene, "target"):
            script = Script(scene)
            script.pick("target", grasp)
            yield script.stages

    def evaluator(self, task, initial):
        return Conditions((Condition(name="touched", measure=pressing_links("target", 0.05), least=1),), hold_s=0.1)
"""


@pytest.fixture(autouse=True)
def same_skills_afterwards(monkeypatch):
    """Forget the skills of a test's files."""
    monkeypatch.setattr(SKILLS, "_items", dict(SKILLS._items))
    monkeypatch.setattr(from_file, "_loaded", {})


def test_a_skill_of_a_file_is_a_task_like_any_other(tmp_path, library):
    file = tmp_path / "touching.py"
    file.write_text(SKILL)
    text = task_text(skill=f"{file}:Touch", lights=["evening"])
    drawn = EpisodeGenerator(library).draw(SeedPath(run_seed=0, purpose="demo", index=0), parse_task_config(text))
    assert (drawn.task.skill, drawn.task.instruction) == ("touch", "Touch the cube")
    assert json.loads(drawn.config_json)["skill_file"] == f"{file}:Touch"
    assert parse_task_config(drawn.config_json).skill == "touch"
    mixed = CliRunner().invoke(group, ["tasks", "sample", "--skill", f"{file}:Touch,stack", "--episodes", "2"])
    assert "Touch the cube" in mixed.output
    assert "Stack" in mixed.output
    file.write_text(SKILL + "\n# changed\n")
    assert task_text(skill=f"{file}:Touch", lights=["evening"]) != text, "a changed file would continue another run"


def test_a_skill_in_the_users_folder_is_the_same_task_wherever_the_folder_lies(tmp_path, monkeypatch):
    texts, names = [], []
    for folder in (tmp_path / "a", tmp_path / "b"):
        (folder / "skills").mkdir(parents=True)
        (folder / "skills/touch.py").write_text(SKILL)
        monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(folder))
        monkeypatch.setattr(SKILLS, "_items", {name: one for name, one in SKILLS._items.items() if name != "touch"})
        monkeypatch.setattr(from_file, "_loaded", {})
        texts.append(task_text(skill=f"{folder}/skills/touch.py:Touch"))
        names.append(list(definitions_of(cells_of(texts[-1]))))
        (folder / "task.yaml").write_text("skill: config://skills/touch.py:Touch\n")
        names.append(list(definitions_of(cells_of(task_text(str(folder / "task.yaml"))))))
    assert texts[0] == texts[1]
    assert names[:2] == names[2:]
    assert all("file config://skills/touch.py" in one for one in names)


def test_distractors_of_a_skill_in_a_file_can_be_told_from_its_object(tmp_path):
    (tmp_path / "touch.py").write_text(SKILL)
    config = parse_task_config(task_text(skill=f"{tmp_path}/touch.py:Touch", distractors="2"))
    assert len(config.distractors.models.values) > 10
    own = parse_task_config(task_text("pick_cube", distractors="2"))
    assert own.distractors.models.values == ("cube",)  # as the task says, in other colours


def test_mistakes_in_a_skills_file_are_named(tmp_path):
    file = tmp_path / "wrong.py"
    for content, complaint in (
        ("1 / 0", "raises ZeroDivisionError: division by zero"),
        ("import math", "has no skill 'Touch'"),
        (SKILL.replace("class Touch(Skill):", "class Touched(Skill):"), "did you mean 'Touched'"),
        (SKILL.partition("    def stages")[0], "skill 'touch' of .*wrong.py has no evaluator, stages"),
        (SKILL.replace("    templates", "    name = 'stack'\n    templates"), "skill 'stack' is registered twice"),
    ):
        file.write_text(content)
        with pytest.raises(ConfigError, match=complaint):
            task_text(skill=f"{file}:Touch")
    with pytest.raises(ConfigError, match="no such file of a skill"):
        task_text(skill=f"{tmp_path}/missing.py:Touch")


@pytest.mark.parametrize(("area", "cause"), [("[0.88, -0.3]", r"the nearest of \d+ grasps stays \d+ mm short")])
def test_an_infeasible_reset_says_why_with_a_number(library, area, cause):
    objects = f"{{area: {{lower: {area}, upper: [0.93, 0.3]}}}}"
    text = f"{{skill: pick_up, objects: {{target: {{models: cube}}}}, reset: {{objects: {objects}}}}}"
    with pytest.raises(TaskError, match=f"target_reachable refused most.*{cause}"):
        EpisodeGenerator(library).draw(SeedPath(run_seed=1, purpose="demo", index=0), parse_task_config(text))


def test_a_draft_of_an_object_shows_its_size_and_turns_a_mesh(tmp_path):
    box = trimesh.creation.box((60.0, 90.0, 30.0))
    box.export(tmp_path / "box.stl")

    def new(*words):
        result = CliRunner().invoke(group, ["assets", "new", str(tmp_path / "box.stl"), *words])
        (tmp_path / "box.yaml").write_text(result.stdout)
        found, model = check_object(tmp_path / "box.yaml", 0.08)
        assert not [finding for finding in found if finding.severity == "error"], found
        return result, [round(1000 * length) for length in model.size]

    said, size = new()
    assert "unit mm, z up: 60 x 90 mm, 30 mm high" in said.stderr
    assert size == [60, 90, 30]
    said, size = new("--up", "y", "--unit", "mm")
    assert "60 x 30 mm, 90 mm high" in said.stdout
    assert size == [60, 30, 90]
    with pytest.raises(ConfigError, match="unknown unit 'ft'"):
        CliRunner().invoke(
            group,
            ["assets", "new", str(tmp_path / "box.stl"), "--unit", "ft"],
            standalone_mode=False,
            catch_exceptions=False,
        )
