"""PyBullet's copy of a robot: fingers of few parts weigh and collide as before, and Panda is untouched."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest

from roboxim_core.models.library import ModelLibrary
from roboxim_sim.bullet import BulletClient
from roboxim_sim.physics_urdf import physics_urdf

LIBRARY = ModelLibrary()


def test_sliding_fingers_stay_as_they_are() -> None:
    model = LIBRARY.robot("panda")
    made = physics_urdf(model.urdf, model.gripper)
    assert made.part_of == {}
    assert pin.buildModelFromUrdf(str(made.file)).nframes == pin.buildModelFromUrdf(str(model.urdf)).nframes


@pytest.mark.parametrize("name", ["panda_2f85", "ur5e"])
def test_a_mechanism_has_fewer_links_and_the_same_mass_and_shapes(name: str) -> None:
    model = LIBRARY.robot(name)
    made = physics_urdf(model.urdf, model.gripper)
    assert made.part_of == {
        f"{name}_gripper_{side}_outer_finger": f"{name}_gripper_{side}_outer_knuckle" for side in ("left", "right")
    }
    whole, small = (pin.buildModelFromUrdf(str(file)) for file in (model.urdf, made.file))
    positions = {follower.name: 0.3 * follower.ratio for follower in model.gripper.followers}
    positions |= dict.fromkeys(model.gripper.joint_names, 0.3) | dict(zip(model.joint_names, model.home, strict=True))
    found = []
    for robot, file in ((whole, model.urdf), (small, made.file)):
        q = pin.neutral(robot)
        for joint, value in positions.items():
            item = robot.joints[robot.getJointId(joint)]
            q[item.idx_q] = value
        data = robot.createData()
        mass = pin.crba(robot, data, q)
        order = [robot.joints[robot.getJointId(joint)].idx_v for joint in positions]
        shapes = pin.buildGeomFromUrdf(
            robot, str(file), pin.GeometryType.COLLISION, package_dirs=[str(model.urdf.parents[1])]
        )
        placed = shapes.createData()
        pin.updateGeometryPlacements(robot, data, shapes, placed, q)
        where = sorted(
            (item.meshPath.rsplit("/", 1)[-1], *pose.translation.round(6), *pose.rotation.ravel().round(6))
            for item, pose in zip(shapes.geometryObjects, placed.oMg, strict=True)
        )
        found.append((mass[np.ix_(order, order)], where))
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-6)
    assert [row[0] for row in found[0][1]] == [row[0] for row in found[1][1]]
    np.testing.assert_allclose([row[1:] for row in found[0][1]], [row[1:] for row in found[1][1]], atol=2e-6)


def test_a_finger_with_a_long_axis_slides_alike_in_both_engines(tmp_path: Path) -> None:
    model = LIBRARY.robot("panda")
    text = model.urdf.read_text()
    axis = '<axis xyz="0 1 0"/>' if '<axis xyz="0 1 0"/>' in text else '<axis xyz="0 1 0" />'
    assert axis in text
    urdf = tmp_path / "panda.urdf"
    urdf.write_text(text.replace(axis, '<axis xyz="0 7 0"/>').replace("<visual>", '<visual name="seen">'))
    made = physics_urdf(urdf, model.gripper).file
    assert "<visual" not in made.read_text()
    assert physics_urdf(urdf, model.gripper).file == made
    robot = pin.buildModelFromUrdf(str(urdf))
    data, q = robot.createData(), pin.neutral(robot)
    (finger, _), tip = model.gripper.joint_names, model.gripper.links[1]
    q[robot.joints[robot.getJointId(finger)].idx_q] = 0.03
    pin.framesForwardKinematics(robot, data, q)
    client = BulletClient()
    try:
        body = client.loadURDF(str(_without_meshes(made)), useFixedBase=True)
        infos = [client.getJointInfo(body, k) for k in range(client.getNumJoints(body))]
        (joint,) = (info[0] for info in infos if info[1].decode() == finger)
        (link,) = (info[0] for info in infos if info[12].decode() == tip)
        client.resetJointState(body, joint, 0.03)
        place = client.getLinkState(body, link, computeForwardKinematics=True)[4]
    finally:
        client.disconnect()
    assert place == pytest.approx(data.oMf[robot.getFrameId(tip)].translation, abs=1e-5)


def _without_meshes(urdf: Path) -> Path:
    """Return a copy of a URDF without shapes, whose files are elsewhere."""
    root = ElementTree.parse(urdf).getroot()
    for link in root.findall("link"):
        for shape in link.findall("collision"):
            link.remove(shape)
    bare = urdf.with_name("bare.urdf")
    ElementTree.ElementTree(root).write(bare)
    return bare


def test_a_changed_urdf_is_copied_again(tmp_path: Path) -> None:
    model = LIBRARY.robot("panda")
    urdf = tmp_path / "panda.urdf"
    urdf.write_text(model.urdf.read_text())
    before = physics_urdf(urdf, model.gripper).file
    urdf.write_text(model.urdf.read_text() + "<!-- changed -->")
    assert physics_urdf(urdf, model.gripper).file != before
