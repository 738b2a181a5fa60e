"""A pre-training packs a named checkpoint that says what its demonstrations contained."""

import json
import re
from dataclasses import replace

import pytest

from roboxim_cli.commands.stages.pretrain import command
from roboxim_core.actions import ActionSemantics
from roboxim_core.episode import EpisodeInfo
from roboxim_core.errors import ConfigError
from roboxim_core.specs import EntitySpec, PhysicalObject, SceneSpec, TaskSpec
from roboxim_policies.bc.config import BCConfig
from roboxim_policies.learning.checkpoint import load_checkpoint
from roboxim_runs.episodes.generation import GenerationConfig
from roboxim_runs.episodes.task_choice import shares_text
from roboxim_runs.storage.folder import locked
from roboxim_runs.training.pretraining import SUITE, PretrainConfig, exposure_of, pretrain
from roboxim_runs.training.run import read_config, train_policy
from roboxim_tasks.config import parse_task_config


def info(number, model, skill="pick_up", look="bench"):
    task = TaskSpec(
        skill=skill, objects={"target": PhysicalObject(entity="target", model=model, name=model)},
        instruction=f"Pick up the {model}", drawn={"look": look},
    )  # fmt: skip
    scene = SceneSpec(entities=(EntitySpec(name="target", model=model), EntitySpec(name="distractor_1", model="mug")))
    return EpisodeInfo(
        episode_id=f"demo-0-{number}-0",
        run_seed=0,
        purpose="demo",
        index=number,
        attempt=0,
        task=task,
        scene=scene,
        semantics=ActionSemantics(),
        actor="expert",
    )


def test_the_exposure_is_counted_in_the_episodes():
    found = exposure_of([info(0, "cube"), info(1, "cube", look="kitchen"), info(2, "apple", skill="rotate")])
    assert found["episodes"] == 3
    assert found["skills"] == {"pick_up": 2, "rotate": 1}
    assert found["objects"] == {"apple": 1, "cube": 2, "mug": 3}  # distractors are seen, too
    assert found["pairs"] == {"pick_up cube": 2, "rotate apple": 1}
    assert found["looks"] == {"bench": 2, "kitchen": 1}
    assert found["instructions"] == 2


def test_a_pair_names_what_is_handled_not_what_it_is_put_on():
    one = info(0, "apple", skill="place_on")
    plate = PhysicalObject(entity="support", model="plate", name="plate")
    objects = {"support": plate, **one.task.objects}
    found = exposure_of([replace(one, task=replace(one.task, objects=objects))])
    assert found["pairs"] == {"place_on apple": 1}


def test_a_name_is_a_files_name():
    assert PretrainConfig(learning=BCConfig(), out="runs/broad").checkpoint_name == "broad"
    with pytest.raises(ConfigError, match="without folders"):
        _ = PretrainConfig(learning=BCConfig(), name="a/b").checkpoint_name


def test_the_example_of_the_command_gives_every_skill_its_share():
    (given,) = re.findall(r"--episodes (\d+)", command.help)
    mix = parse_task_config(GenerationConfig(suite=SUITE).task_text())
    assert "a multiple of" not in shares_text(mix, int(given))
    assert "a multiple of 16 gives" in shares_text(mix, 276)


def test_a_folder_that_trains_already_takes_no_more_demonstrations(tmp_path):
    (tmp_path / "broad" / "rlds" / "roboxim").mkdir(parents=True)
    (tmp_path / "broad" / "rlds" / "roboxim" / "export.json").write_text("{}")
    config = PretrainConfig(learning=BCConfig(), out=tmp_path / "broad", episodes=46)
    with pytest.raises(ConfigError, match=r"a pre-training on 0 demonstrations, got --episodes 46: give 0, or another"):
        pretrain(config)
    assert not (tmp_path / "broad" / "demos").exists()


@pytest.mark.slow
def test_it_is_packed_continued_and_fine_tuned(tmp_path):
    learning = BCConfig(steps=3, batch=8, image_sizes={"workspace": 32, "wrist": 32})
    suite = tmp_path / "uneven.yaml"  # as the shipped one, which demonstrates some skills twice as often
    suite.write_text("cells: [{tasks: [pick_up], episodes: 2}, {tasks: [push_button], episodes: 1}]\n")
    config = PretrainConfig(learning=learning, out=tmp_path / "broad", suite=str(suite), size=64, workers=1)
    result = pretrain(config)
    assert result.checkpoint == tmp_path / "broad" / "broad.npz"
    packed = load_checkpoint(result.checkpoint)
    assert packed.original_sha256
    assert packed.pretraining["name"] == "broad"
    assert packed.pretraining["exposure"]["skills"] == {"pick_up": 2, "push_button": 1}
    assert json.loads((tmp_path / "broad" / "exposure.json").read_text()) == packed.pretraining
    before = result.checkpoint.stat().st_mtime_ns
    assert pretrain(config).training.steps_now == 0
    assert result.checkpoint.stat().st_mtime_ns == before
    settings = read_config("", None, {"steps": 2}, start=result.checkpoint)
    (tmp_path / "tuned").mkdir()
    with locked(tmp_path / "tuned"), pytest.raises(ConfigError, match="another command is running"):
        train_policy(tmp_path / "broad" / "rlds", tmp_path / "tuned", settings, start=result.checkpoint)
    tuned = train_policy(tmp_path / "broad" / "rlds", tmp_path / "tuned", settings, start=result.checkpoint)
    assert load_checkpoint(tuned.checkpoint).started_from["pretraining"]["name"] == "broad"
    with pytest.raises(ConfigError, match="is a checkpoint of 'bc', not of 'act': roboxim train bc"):
        read_config("act", None, start=result.checkpoint)
