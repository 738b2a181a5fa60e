"""Generate the WidowX AI and its gripper, a part of its own, from the MJCF of the `trossen-arm-sim` wheel.

In the source, the gripper's body is the arm's last link. Here it is a part on a flange, so that the arm takes other
grippers and other arms take this one. ``make robot-visuals`` regenerates everything.
"""

from __future__ import annotations

import copy
import math
import shutil
import tempfile
import warnings
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from roboxim_runs.robots.derivation import derive
from roboxim_runs.robots.gripper_derivation import GripperRecipe, derive_gripper
from roboxim_runs.robots.recipe import RobotRecipe
from roboxim_runs.robots.urdf_files import expanded

HERE = Path(__file__).resolve().parent
CONFIG = HERE.parents[1]
LAST, FLANGE, HAND = "link_6", "flange", "gripper_body"
FINGERS = {"carriage_left": "gripper_left.stl", "carriage_right": "gripper_right.stl"}
"""Links of the fingers, and the mesh that holds objects."""
CAMERA = ("camera_mount_d405.stl", "d405.stl")
"""Meshes of the follower's wrist camera, which is left out with its box: RoboXim places cameras itself."""
TURN = Rotation.from_euler("YZ", (90, 180), degrees=True)
"""The flange in the last link: its z axis points out of the arm, which in the source is x, and with the last joint at 0
a tool that points down has the x axis forward, as at the start of most tasks."""
FLANGE_KG, FLANGE_KG_M2 = 0.05, 5e-5
"""Share of the last link's mass that the flange keeps, and its moment of inertia."""
FINGER_M_S = "0.5"
BODY = {"body_wrist.stl": (0.006, 0.05), "body_rail.stl": (0.05, 1.0)}
"""Collision meshes of the gripper's body: parts of the last link's mesh between two x [m]. The first 6 mm turn between
the prongs of the fourth link, which are closer than convex parts tell."""
SOURCE = "trossen-arm-sim 0.2.3 (Apache-2.0)"
GRIPPER = GripperRecipe(
    name="widowx_ai_gripper",
    title="Gripper of the Trossen WidowX AI",
    source=SOURCE,
    urdf="of the wheel",
    root=HAND,
    joints=("left_carriage_joint", "right_carriage_joint"),
    tips=("carriage_left", "carriage_right"),
    force_n=20.0,  # as the Franka hand
    speed_m_s=0.1,  # of 0.5
    triangles=3000,  # the rail is thin
)
ARM = RobotRecipe(
    name="widowx_ai",
    title="Trossen WidowX AI",
    source=SOURCE,
    urdf="of the wheel",
    base="base_link",
    base_xyz=(0.2, 0.0, 0.25),
    flange=FLANGE,
    mount_rpy=(math.pi, -math.pi / 2, 0.0),  # TURN
    gripper="widowx_ai_gripper",
    velocity=(3.14,),  # as the controller of the wheel states
    acceleration=(10.0,),  # Trossen publishes none
    collision_m=0.0005,  # a small arm
)

Element = ElementTree.Element


def main() -> None:
    """Write everything."""
    source = Path(str(metadata.distribution("trossen-arm-sim").locate_file("trossen_arm_sim/assets/wxai_follower.xml")))
    with tempfile.TemporaryDirectory() as folder:
        for mesh in source.parent.glob("*.stl"):
            shutil.copy(mesh, folder)
        whole = trimesh.load_mesh(source.parent / f"{LAST}.stl")
        for name, (begin, end) in BODY.items():
            _between(whole, begin, end).export(Path(folder) / name)
        urdf = Path(folder) / "wxai.urdf"
        ElementTree.ElementTree(with_flange(expanded(source))).write(urdf)
        derive_gripper(replace(GRIPPER, urdf=str(urdf)), CONFIG / "grippers")
        derive(replace(ARM, urdf=str(urdf)), HERE.parent)


def with_flange(root: Element) -> Element:
    """Split the last link into a flange and the gripper's body, and give links the shapes that they have."""
    links = {str(link.get("name")): link for link in root.findall("link")}
    for name, link in links.items():
        _cover(link, FINGERS.get(name, ""))
    links[LAST].set("name", HAND)
    for joint in root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        assert parent is not None
        assert child is not None
        if child.get("link") == LAST:
            child.set("link", FLANGE)
        if parent.get("link") == LAST:
            parent.set("link", HAND)
            _turn_back(joint)
            limit = joint.find("limit")
            assert limit is not None
            limit.set("velocity", FINGER_M_S)
    for part in links[LAST]:
        _turn_back(part)
    mass = links[LAST].find("inertial/mass")
    assert mass is not None
    mass.set("value", f"{float(str(mass.get('value'))) - FLANGE_KG:.6g}")
    flange = ElementTree.SubElement(root, "link", {"name": FLANGE})
    inertial = ElementTree.SubElement(flange, "inertial")
    ElementTree.SubElement(inertial, "mass", {"value": f"{FLANGE_KG:g}"})
    moments = dict.fromkeys(("ixx", "iyy", "izz"), f"{FLANGE_KG_M2:g}") | dict.fromkeys(("ixy", "ixz", "iyz"), "0")
    ElementTree.SubElement(inertial, "inertia", moments)
    mount = ElementTree.SubElement(root, "joint", {"name": "mount", "type": "fixed"})
    ElementTree.SubElement(mount, "parent", {"link": FLANGE})
    ElementTree.SubElement(mount, "child", {"link": HAND})
    ElementTree.SubElement(mount, "origin", {"xyz": "0 0 0", "rpy": _angles(TURN)})
    return root


def _cover(link: Element, finger: str) -> None:
    """Leave out the camera, and take the visual meshes for the collision shapes, which are coarse boxes."""
    for shape in link.findall("collision"):
        link.remove(shape)
    for shape in link.findall("visual"):
        mesh = shape.find("geometry/mesh")
        file = "" if mesh is None else str(mesh.get("filename"))
        if mesh is None or file in CAMERA:
            link.remove(shape)
        elif not finger or file == finger:
            for part in BODY if link.get("name") == LAST else (file,):
                collision = copy.deepcopy(shape)
                collision.tag = "collision"
                geometry = collision.find("geometry/mesh")
                assert geometry is not None
                geometry.set("filename", part)
                link.append(collision)


def _between(mesh: trimesh.Trimesh, begin: float, end: float) -> trimesh.Trimesh:
    """Return the convex hull of what a mesh has between two x [m]."""
    points = [mesh.vertices[(mesh.vertices[:, 0] >= begin) & (mesh.vertices[:, 0] <= end)]]
    for x in (begin, end):
        first, second = (mesh.vertices[mesh.edges_unique[:, k]] for k in (0, 1))
        cut = (first[:, 0] < x) != (second[:, 0] < x)
        share = (x - first[cut, :1]) / (second[cut, :1] - first[cut, :1])
        points.append(first[cut] + share * (second[cut] - first[cut]))
    return trimesh.convex.convex_hull(np.concatenate(points))


def _turn_back(element: Element) -> None:
    """Express an element's pose in the flange, given its pose in the last link."""
    origin = element.find("origin")
    assert origin is not None
    place, turn = (np.array([float(word) for word in origin.get(key, "0 0 0").split()]) for key in ("xyz", "rpy"))
    back = TURN.inv()
    origin.set("xyz", " ".join(f"{x:.10g}" for x in back.apply(place)))
    origin.set("rpy", _angles(back * Rotation.from_euler("xyz", turn)))


def _angles(turn: Rotation) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a quarter turn about y has many triples of angles; any will do
        return " ".join(f"{angle:.10g}" for angle in turn.as_euler("xyz"))


if __name__ == "__main__":
    main()
