"""The planner's verdicts on the arm alone against the meshes that the robots' makers published."""

from __future__ import annotations

import re
from pathlib import Path

import cmeel
import coal
import numpy as np
import pinocchio as pin
import pytest

from roboxim_core.models.library import ModelLibrary
from roboxim_planner.collisions.checker import CollisionWorld
from roboxim_planner.robot import PlannerRobot
from roboxim_planner.scene import AllowedContact, PlanningScene

LIBRARY = ModelLibrary()
PUBLISHED = Path(cmeel.__path__[0]).parent / "cmeel.prefix/share/example-robot-data/robots"
FOLDERS = {
    "panda": (PUBLISHED / "panda_description/meshes/collision",),
    "ur5": (PUBLISHED / "ur_description/meshes/ur5/collision", PUBLISHED / "panda_description/meshes/collision"),
}
STATES = 20_000
WRONGLY_REFUSED = {"panda": 0.002, "ur5": 0.01}
"""Largest share of states that are refused though the meshes do not touch."""


class Published:
    """A robot with its published collision meshes; collisions are coal's on the triangles."""

    def __init__(self, robot_id: str) -> None:
        robot = LIBRARY.robot(robot_id)
        self._model = pin.buildModelFromUrdf(str(robot.urdf))
        self._data = self._model.createData()
        folders = [str(folder) for folder in robot.urdf.resolve().parents]
        ours = pin.buildGeomFromUrdf(self._model, str(robot.urdf), pin.GeometryType.COLLISION, package_dirs=folders)
        geometry, seen = pin.GeometryModel(), set()
        for item in ours.geometryObjects:
            mesh = re.fullmatch(r".*/collision/(\w+?)(_\d+)?\.stl", item.meshPath)
            if mesh:
                if (item.parentFrame, mesh[1]) in seen:  # another part of the same mesh
                    continue
                seen.add((item.parentFrame, mesh[1]))
                file = next(
                    folder / f"{mesh[1]}.stl" for folder in FOLDERS[robot_id] if (folder / f"{mesh[1]}.stl").exists()
                )
                item.geometry = coal.MeshLoader(coal.BV_OBBRSS).load(str(file), np.ones(3))
            geometry.addGeometryObject(item)
        geometry.addAllCollisionPairs()
        pin.removeCollisionPairs(self._model, geometry, str(robot.srdf))
        self._geometry, placed = geometry, geometry.createData()
        self._broad = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(self._model, geometry, placed)

    def collides(self, full: np.ndarray) -> bool:
        return bool(pin.computeCollisions(self._model, self._data, self._broad, full, True))


@pytest.mark.thorough
@pytest.mark.parametrize("robot_id", FOLDERS)
def test_self_collision_is_that_of_the_published_meshes(robot_id: str) -> None:
    """No state that touches is called free, and hardly one that touches nothing is refused; close pairs apart."""
    robot, published = PlannerRobot(LIBRARY.robot(robot_id)), Published(robot_id)
    apart = tuple(AllowedContact(body_a=pair.link, body_b=pair.other) for pair in robot.description.close_pairs)
    rng = np.random.default_rng(0)
    states = rng.uniform(robot.lower, robot.upper, (STATES, robot.dof))
    missed, refused = [], 0
    for opening, some in zip((0.0, 1.0), np.array_split(states, 2), strict=True):
        world = CollisionWorld(robot, PlanningScene(gripper_opening=opening, allowed=apart))
        for q, full in zip(some, robot.full(some, opening), strict=True):
            free, touches = world.is_free(q), published.collides(full)
            if free and touches:
                missed.append(q.tolist())
            refused += not free and not touches
    assert missed == []
    assert refused / STATES < WRONGLY_REFUSED[robot_id]


def test_the_hand_never_passes_through_the_bent_forearm() -> None:
    """The SRDF disables that pair, and the forearm's collision mesh fills the hollow that the hand folds into.

    Where the two are to each other depends on the last two joints alone; the drawn meshes are the truth.
    """
    robot = PlannerRobot(LIBRARY.robot("panda"))
    world = CollisionWorld(robot, PlanningScene())
    urdf = PUBLISHED / "panda_description/urdf/panda.urdf"
    model = pin.buildModelFromUrdf(str(urdf))
    drawn = pin.buildGeomFromUrdf(model, str(urdf), pin.GeometryType.VISUAL, package_dirs=[str(PUBLISHED.parents[1])])
    link, hand = drawn.getGeometryId("panda_link5_0"), drawn.getGeometryId("panda_hand_0")
    drawn.addCollisionPair(pin.CollisionPair(link, hand))
    data, placed = model.createData(), drawn.createData()
    refused = touching = 0
    for bend in np.linspace(robot.lower[5], 1.0, 40):
        for turn in np.linspace(robot.lower[6], robot.upper[6], 40):
            q = np.array([0.0, 0.0, 0.0, -1.5, 0.0, bend, turn])
            pin.updateGeometryPlacements(model, data, drawn, placed, robot.full(q))
            touches, free = pin.computeCollision(drawn, placed, 0), world.is_free(q)
            assert not (touches and free), q
            touching += touches
            refused += not free and not touches
            if touches:
                assert {"panda_hand", "panda_link5"} in [{c.body_a, c.body_b} for c in world.contacts(q)]
    assert touching > 100
    assert refused < 100
