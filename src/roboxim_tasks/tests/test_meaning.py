"""The meaning of an instruction: read from its text, in a scene."""

from __future__ import annotations

from dataclasses import replace

import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import EntitySpec, SceneSpec, TaskSpec
from roboxim_tasks.config import load_task_config, parse_task_config
from roboxim_tasks.meaning import asks_for_same, read_instruction
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.skills import SKILLS

HALF_TURN = Rotation.from_euler("z", 180, degrees=True)


@pytest.fixture(scope="module")
def library() -> ModelLibrary:
    return ModelLibrary()


@pytest.fixture(scope="module")
def draw(library: ModelLibrary):
    generator = EpisodeGenerator(library, None, None)

    def drawn(task: str, index: int = 0) -> tuple[TaskSpec, SceneSpec]:
        made = generator.draw(SeedPath(run_seed=3, purpose="test", index=index), load_task_config(task))
        return made.task, made.scene

    return drawn


@pytest.mark.parametrize("skill", SKILLS)
def test_the_instruction_of_every_skill_is_read_as_its_task(skill: str, draw, library: ModelLibrary) -> None:
    for index in range(2):
        task, scene = draw(skill, index)
        reading = read_instruction(task.instruction, scene, library)
        assert reading.understood
        assert any(asks_for_same(found, task) for found in reading.tasks), task.instruction
        same = next(found for found in reading.tasks if asks_for_same(found, task))
        assert same.arguments == task.arguments


def test_an_instruction_is_read_for_the_arm_of_the_scene(library: ModelLibrary) -> None:
    config = parse_task_config("{skill: push_button, robot: xarm7}")
    made = EpisodeGenerator(library).draw(SeedPath(run_seed=3, purpose="test", index=0), config)
    (found,) = read_instruction(made.task.instruction, made.scene, library).tasks
    assert asks_for_same(found, made.task)
    turned = replace(made.scene, robot=replace(made.scene.robot, pose=Pose.from_arrays((0, 0, 0), HALF_TURN)))
    cube = EntitySpec(name="target", model="cube")
    (found,) = read_instruction("Push the cube forward", replace(turned, entities=(cube,)), library).tasks
    assert found.arguments["direction_x"] == pytest.approx(-1.0)


def test_a_drawer_is_named_beside_its_cabinet(draw, library: ModelLibrary) -> None:
    task, scene = draw("put_into_drawer")
    (found,) = read_instruction(task.instruction, scene, library).tasks
    assert (found.arguments["drawer"], found.objects["container"].entity) == ("top", "container")
    other = task.instruction.replace("top", "bottom")
    assert not any(asks_for_same(read, task) for read in read_instruction(other, scene, library).tasks)


def test_words_of_another_direction_are_another_task(draw, library: ModelLibrary) -> None:
    task, scene = draw("push_object")
    for direction in ("to the left", "to the right", "forward", "back"):
        thing = task.instruction.split("the ", 1)[1].split(" to ")[0].split(" back")[0].split(" forward")[0]
        (found,) = read_instruction(f"Push the {thing} {direction}", scene, library).tasks
        assert found.arguments["direction"] == direction
        assert asks_for_same(found, task) == (direction == task.arguments["direction"])


def test_what_the_scene_lacks_is_named(draw, library: ModelLibrary) -> None:
    _, scene = draw("pick_cube_distractors")
    reading = read_instruction("Pick up the wooden spoon", scene, library)
    assert (reading.understood, reading.tasks, reading.absent) == (True, (), ("wooden spoon",))
    assert not read_instruction("Dance", scene, library).understood


def test_colours_choose_the_object(draw, library: ModelLibrary) -> None:
    task, scene = draw("pick_cube_distractors")
    for entity in scene.entities:
        (found,) = read_instruction(f"pick up the {entity.modifiers['color']} cube.", scene, library).tasks
        assert found.objects["target"].entity == entity.name
    unspecific = read_instruction("Pick up the cube", scene, library).tasks
    assert {found.objects["target"].entity for found in unspecific} == {entity.name for entity in scene.entities}
    assert not asks_for_same(replace(task, skill="rotate"), task)


def test_a_users_template_is_read(draw, library: ModelLibrary) -> None:
    task, scene = draw("pick_up")
    noun = task.objects["target"].name
    text = f"Would you lift that {noun} for me"
    assert not read_instruction(text, scene, library).understood
    (found,) = read_instruction(text, scene, library, {"pick_up": ["Would you lift that {target} for me"]}).tasks
    assert asks_for_same(found, task)
