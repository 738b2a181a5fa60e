"""What the scenes of shipped experiments tell without their words."""

import pytest
from planted_cards import shipped

from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_eval.experiments import design_of, mix_of
from roboxim_runs.experiments.files import load_experiment
from roboxim_runs.experiments.scenes.leakage import scene_leakage
from roboxim_tasks.config import task_mix
from roboxim_tasks.meaning import read_instruction
from roboxim_tasks.sampling.episodes import EpisodeGenerator

OBJECT = "No scene has distractors, so the scene alone reveals which object is meant."
TASK = "Only scenes of {} have the {}, so the scene alone reveals this task."
PLACES = (
    "Distractors of {} may lie outside the area of the objects that tasks name, so the scene alone reveals that "
    "some objects are not meant."
)
NEVER = (
    "No held-out scene allows another instruction of the training to be carried out, so substitution cannot happen "
    "here and its 0 has no meaning."
)
SOME = (
    "Only {} of {} held-out cells have scenes that allow another instruction of the training to be carried out; in the "
    "others substitution cannot happen."
)
TOLD = {
    "skill_object": (OBJECT, TASK.format("place_on", "support plate")),
    "camera_object": (OBJECT, NEVER),
    "camera_object_workspace_only": (OBJECT, NEVER),
    "camera_skill": (TASK.format("place_on", "support plate"),),  # one object, so that none is to be told
    "skills": (
        PLACES.format("pick_up and place_on and rotate and push_button and open_drawer"),
        TASK.format("open_drawer", "target cabinet"),  # a button is a distractor of the others
    ),
    "skill_object_worded": (),
    "camera_object_worded": (),
    "camera_skill_worded": (),
    "objects": (PLACES.format("pick_up"),),
    "robustness": (),
}


@pytest.mark.parametrize("name", TOLD)
def test_scenes_tell_object_and_task_where_words_are_not_needed(name):
    assert scene_leakage(shipped(name)) == TOLD[name]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "scale", "said"),
    [
        ("camera_object", "smoke", NEVER),
        ("skill_object", "smoke", SOME.format(1, 2)),  # no plate where the cube is to be picked up
        ("camera_skill_objects", "smoke", SOME.format(2, 4)),
        ("skill_object", "night", ""),
        ("camera_skill", "night", ""),
        ("camera_object_worded", "night", ""),
    ],
)
def test_where_no_other_instruction_can_be_carried_out_substitution_says_nothing(name, scale, said):
    design = design_of(load_experiment(name, scale))
    assert [one for one in scene_leakage(design) if "substitution" in one] == ([said] if said else [])
    # as episodes are judged again: training instructions are read in scenes of held-out cells
    generator, library = EpisodeGenerator(ModelLibrary()), ModelLibrary()

    def draws(cells):
        mix = task_mix(mix_of(design.config, dict.fromkeys(cells, 1)))
        return [generator.draw(SeedPath(run_seed=4, purpose="eval", index=index), mix) for index in range(len(cells))]

    trained = {draw.task.instruction for draw in draws(design.datasets["leave_out"])}
    scenes = draws([cell.key for cell in design.cells if cell.unseen])
    allowing = sum(
        any(read_instruction(text, draw.scene, library).tasks for text in trained - {draw.task.instruction})
        for draw in scenes
    )
    assert said == {0: NEVER, len(scenes): ""}.get(allowing, SOME.format(allowing, len(scenes)))


def test_other_arguments_of_the_same_task_are_another_instruction():
    task = {"rotate": {"arguments": {"direction": {"values": ["clockwise"]}}}}
    one = {"factors": {"task": task}, "set": {"distractors": {"minimum": 0, "maximum": 0}}}
    assert NEVER in scene_leakage(design_of(load_experiment("camera_object", changes=one)))
    directions = {"values": ["clockwise", "counter-clockwise"]}
    both = {"factors": {"task": {"rotate": {"arguments": {"direction": directions}}}}}
    assert NEVER not in scene_leakage(design_of(load_experiment("camera_object", changes=both)))


def test_a_distractor_may_be_what_another_instruction_names():
    some = {"set": {"distractors": {"minimum": 1, "maximum": 1}}}
    said = scene_leakage(design_of(load_experiment("camera_object", changes=some)))
    assert not any("substitution" in one for one in said)


WORDED = ("skill_object_worded", "camera_object_worded", "camera_skill_worded")


@pytest.mark.parametrize("name", WORDED)
def test_scenes_tell_by_places_where_distractors_lie_farther_out(name):
    area = {"area": {"lower": [0.30, -0.30], "upper": [0.74, 0.30]}}
    (said,) = scene_leakage(design_of(load_experiment(name, changes={"set": {"reset": {"distractors": area}}})))
    assert "may lie outside the area of the objects that tasks name" in said


@pytest.mark.parametrize("name", WORDED)
def test_every_object_of_a_worded_scene_lies_where_the_named_one_could(name):
    design = shipped(name)
    mix = task_mix(mix_of(design.config, {cell.key: 4 for cell in design.cells}))
    generator = EpisodeGenerator(ModelLibrary())
    rivals = 0
    for index in range(0, 4 * len(design.cells), 2):
        drawn = generator.draw(SeedPath(run_seed=3, purpose="eval", index=index), mix)
        for entity in drawn.scene.entities:
            if entity.name in drawn.task.objects:
                x, y, _ = entity.pose.position
                assert 0.32 <= x <= 0.72, entity
                assert -0.25 <= y <= 0.25, entity
                rivals += entity.name not in ("target", "support")
    assert rivals >= len(design.cells)
