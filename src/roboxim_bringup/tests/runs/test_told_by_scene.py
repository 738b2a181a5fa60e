"""What the scenes of shipped experiments tell without their words."""

import pytest

from roboxim_bringup.experiment_files import load_experiment
from roboxim_bringup.runs.told_by_scene import told_by_scene
from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_eval.experiments import design_of, mix_of
from roboxim_eval.testing import shipped
from roboxim_tasks.config import task_mix
from roboxim_tasks.episodes import EpisodeGenerator

OBJECT = "No scene has distractors, so that the scene alone tells which object is meant."
TASK = "Scenes of {} alone have the {}, so that the scene alone tells this task."
PLACES = (
    "Distractors of {} may lie outside the area of the objects that tasks name, so that the scene alone tells that "
    "some objects are not meant."
)
TOLD = {
    "skill_object": (OBJECT, TASK.format("place_on", "support plate")),
    "camera_object": (OBJECT,),
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
    assert told_by_scene(shipped(name)) == TOLD[name]


WORDED = ("skill_object_worded", "camera_object_worded", "camera_skill_worded")


@pytest.mark.parametrize("name", WORDED)
def test_scenes_tell_by_places_where_distractors_lie_farther_out(name):
    area = {"area": {"lower": [0.30, -0.30], "upper": [0.74, 0.30]}}
    (said,) = told_by_scene(design_of(load_experiment(name, changes={"set": {"reset": {"distractors": area}}})))
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
