"""What the scenes of shipped experiments tell without their words."""

import pytest

from roboxim_bringup.runs.told_by_scene import told_by_scene
from roboxim_eval.testing import shipped

OBJECT = "No scene has distractors, so that the scene alone tells which object is meant."
TASK = "Scenes of {} alone have the {}, so that the scene alone tells this task."
TOLD = {
    "skill_object": (OBJECT, TASK.format("place_on", "support plate")),
    "camera_object": (OBJECT,),
    "camera_skill": (TASK.format("place_on", "support plate"),),  # one object, so that none is to be told
    "skills": (TASK.format("open_drawer", "target cabinet"),),  # a button is a distractor of the others
    "skill_object_worded": (),
    "camera_object_worded": (),
    "camera_skill_worded": (),
    "objects": (),
    "robustness": (),
}


@pytest.mark.parametrize("name", TOLD)
def test_scenes_tell_object_and_task_where_words_are_not_needed(name):
    assert told_by_scene(shipped(name)) == TOLD[name]
