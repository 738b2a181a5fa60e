"""Scripts of executors that go on where another actor has left the object."""

import math
from dataclasses import replace

import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.kinematics import ArmKinematics
from roboxim_core.poses import Pose
from roboxim_tasks.config import parse_task_config
from roboxim_tasks.demonstration.solvable import state_at_rest
from roboxim_tasks.motion import ExpertScene
from roboxim_tasks.skills import SKILLS


@pytest.mark.parametrize("held", ["", "target"])
@pytest.mark.parametrize("direction", ["clockwise", "counter-clockwise"])
@pytest.mark.parametrize(
    ("asked", "done"),
    [(90, -80), (90, 0), (90, 80), (90, 100), (90, 200), (180, -60), (180, 170), (180, 190), (180, 260)],
)
def test_rotate_goes_on_from_where_the_object_is_turned_to(draw, library, direction, asked, done, held):
    text = (
        f"skill: rotate\nparameters: {{angle_deg: {asked}, direction: {direction}}}\nreset: {{cameras: {{names: []}}}}"
    )
    drawn = draw(0, parse_task_config(text))
    state = state_at_rest(drawn.scene, ArmKinematics(library.robot("panda")))
    sign = 1 if direction == "counter-clockwise" else -1
    entity = state.entity("target")
    turned = Rotation.from_euler("z", sign * done, degrees=True) * entity.pose.rotation
    there = replace(entity, pose=Pose.from_arrays(entity.pose.position, turned))
    state = replace(state, entities=tuple(there if e.name == "target" else e for e in state.entities))
    scene = ExpertScene(task=drawn.task, scene=drawn.scene, state=state, library=library, held=held)
    stages = next(iter(SKILLS["rotate"].stages(scene)))
    before, *turns = [stage.pose.rotation for stage in stages if stage.name in ("lift", "turn")]
    way = 0.0
    for after in turns:
        way += float((after * before.inv()).as_rotvec()[2])
        before = after
    assert math.degrees(way) == pytest.approx(sign * (asked - done), abs=1e-3)
