"""A button that the task does not name may be of another model, whose joint has another name."""

import pytest
import yaml

from roboxim_core.config import named_config, to_plain
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.seeds import SeedPath
from roboxim_core.state import EntityState, RobotState, StateRecord
from roboxim_tasks.config import parse_task_config
from roboxim_tasks.judging import Judge
from roboxim_tasks.sampling.episodes import EpisodeGenerator

SINGLE = """
skill: push_button
objects: {target: {models: [button]}}
distractors: {minimum: 1, maximum: 1, models: [bell]}
"""
STEPS = """
steps: [{skill: rotate, roles: {target: cube}}, {skill: push_button}]
objects: {cube: {models: [cube]}, target: {models: [button]}}
distractors: {minimum: 1, maximum: 1, models: [bell]}
"""
SEED = SeedPath(run_seed=3, purpose="demo", index=0)


@pytest.fixture
def generator(tmp_path, monkeypatch):
    """A generator with the object ``bell``, a button whose joint is called ``ring``."""
    (tmp_path / "objects").mkdir()
    text = named_config("objects", "button").read_text()
    (tmp_path / "objects" / "bell.yaml").write_text(
        text.replace("name: button", "name: bell").replace("press\n", "ring\n").replace("joint: press,", "joint: ring,")
    )
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))
    return EpisodeGenerator(ModelLibrary())


def states(task, pressed):
    """Yield tick 0, and a tick within which a button was pressed."""
    joints = {"button": "press", "bell": "ring"}
    for seq in range(2):
        entities = []
        for n, thing in enumerate(task.objects.values()):
            known = {"joint_names": (joints[thing.model],)} if thing.model in joints else {}
            depth = 0.01 if seq and thing.entity == pressed else 0.0
            known |= dict.fromkeys(("joint_positions", "joint_lowest"), (0.0,)) if known else {}
            known |= {"joint_highest": (depth,)} if known else {}
            entities.append(EntityState(name=thing.entity, pose=Pose(position=(0.4, 0.2 * n, 0.02)), **known))
        robot = RobotState(
            joint_names=(), joint_positions=(), joint_velocities=(), joint_commands=(), pose_tcp_measured=Pose(),
            pose_tcp_commanded=Pose(), gripper_opening=0.5, gripper_command=0.0,
        )  # fmt: skip
        yield StateRecord(
            episode_id="e", seq=seq, stamp_ns=seq * 10**8, robot=robot, contacts=(), entities=tuple(entities)
        )


@pytest.mark.parametrize(
    "text", [SINGLE, SINGLE.replace("[button]", "[bell]").replace("models: [bell]}\n", "models: [button]}\n")]
)
def test_pressing_a_button_of_another_model_fails(generator, text):
    task = generator.task(SEED, parse_task_config(text))
    first, second = states(task, "distractor_1")
    judge = Judge(task)
    judge.start(first)
    verdict = judge.step(second)
    assert (verdict.failed, verdict.reason) == (True, "pressed_other_button")


def test_a_step_and_a_given_scene_know_other_buttons_too(generator):
    task = generator.task(SEED, parse_task_config(STEPS))
    assert task.arguments["step_2.others"] == "ring"
    drawn = generator.draw(SEED, parse_task_config(SINGLE))
    fixed = {"instruction": "Push the button", "roles": {"target": "target"}, "scene": to_plain(drawn.scene)}
    given = parse_task_config(yaml.safe_dump({"skill": "push_button", "fixed": fixed}))
    assert given.task("demo", generator._library).arguments == drawn.task.arguments
    assert drawn.task.arguments["others"] == "ring"


def test_tasks_whose_buttons_are_alike_record_what_they_did(generator):
    text = SINGLE.replace("[bell]", "[button], modifiers: {color: [green]}").replace(
        "[button]}}", "[button], modifiers: {color: [red]}}}"
    )
    assert "others" not in generator.task(SEED, parse_task_config(text)).arguments
