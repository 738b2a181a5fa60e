"""Generate the SO-101 and its gripper, a part of its own, from the URDF of the `example-robot-data` wheel.

In the source, the gripper's body with its fixed jaw is the arm's last link. Here flange, body, fixed jaw and moving jaw
are links of their own, so that contacts tell the jaws apart. ``make robot-visuals`` regenerates everything.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from roboxim_core.models.urdf import mesh_path, origin_pose
from roboxim_core.poses import Pose
from roboxim_runs.robots.derivation import derive
from roboxim_runs.robots.gripper_derivation import GripperRecipe, derive_gripper
from roboxim_runs.robots.link_meshes import coloured
from roboxim_runs.robots.recipe import RobotRecipe, source_file
from roboxim_runs.robots.urdf_files import expanded

HERE = Path(__file__).resolve().parent
CONFIG = HERE.parents[1]
URDF = "package:example-robot-data/cmeel.prefix/share/example-robot-data/robots/so_arm_description/urdf/so101.urdf"
LAST, MOVING, FLANGE, FIXED = "gripper_link", "moving_jaw_so101_v1_link", "flange", "fixed_jaw"
BODY_MESH, JAW_MESH = "wrist_roll_follower_so101_v1.stl", "moving_jaw_so101_v1.stl"
FACE_X_M = -0.0079
"""Where the inner face of the fixed jaw's tip is, in the last link [m]; the source's tool frame is on it, too."""
HAND = Pose.from_arrays((FACE_X_M, 0.0, 0.0), Rotation.from_euler("xyz", (math.pi, 0.0, math.pi / 2)))
"""The gripper in the last link: z out of the flange, y from the fixed jaw to the moving one, which is along x there."""
BODY_ENDS_M, BLADE_BEGINS_M = -0.042, -0.027
"""z in the last link where the body ends and the fixed jaw begins, and y in the moving jaw's link where its blade
begins, which above is as wide as the motor [m]."""
OPEN_RAD = 1.0
"""Position of the jaw at which it counts as open [rad], of 1.75. A wide object slips from a jaw that leans: it presses
an apple of 70 mm down onto the table and lets go of it."""
FLANGE_KG, FLANGE_KG_M2 = 0.02, 2e-5
FIXED_KG = 0.02
"""Shares of the last link's mass that flange and fixed jaw have, and the flange's moment of inertia."""
FAR = 1.0
QUARTER_RAD = 1e-5
"""Angles that differ by less from a quarter turn become one: the source writes 1.5708."""
SOURCE = "so_arm_description (Apache-2.0), in example-robot-data 6.0.0"
GRIPPER = GripperRecipe(
    name="so101_gripper",
    title="Gripper of the SO-101, one jaw that turns against a fixed one",
    source=SOURCE,
    urdf="of the wheel",
    root=LAST,
    joints=("gripper",),
    tips=(FIXED, MOVING),
    force_n=20.0,  # of 38: the servo stalls at 30 kg cm, the tip is 8 cm from its axis
    speed_m_s=0.15,  # of 0.37: 45 turns a minute
    triangles=1500,
)
ARM = RobotRecipe(
    name="so101",
    title="SO-ARM 101",
    source=SOURCE,
    urdf="of the wheel",
    base="base_link",
    base_xyz=(0.27, 0.0, 0.17),  # its tool points down from 18 cm below its base to 6 cm above
    flange=FLANGE,
    mount_xyz=HAND.position,
    mount_rpy=(math.pi, 0.0, math.pi / 2),  # as HAND
    gripper="so101_gripper",
    home=(0.0546, -0.3076, 0.8475, 1.0309, -1.4675),  # tool down at (0.45, 0, 0.18)
    start=(0.41, -0.08, 0.16, 0.49, 0.08, 0.20),
    velocity=(4.7,),  # 45 turns a minute without load, the servo's data sheet; the source has 10
    acceleration=(15.0,),  # nobody publishes one
    triangles=1500,
)

Element = ElementTree.Element


def main() -> None:
    """Write everything."""
    source = source_file(URDF, HERE)
    with tempfile.TemporaryDirectory() as folder:
        urdf = Path(folder) / "so101.urdf"
        ElementTree.ElementTree(with_flange(expanded(source), source, Path(folder))).write(urdf)
        derive_gripper(replace(GRIPPER, urdf=str(urdf)), CONFIG / "grippers")
        derive(replace(ARM, urdf=str(urdf)), HERE.parent)


def with_flange(root: Element, source: Path, folder: Path) -> Element:
    """Give flange and fixed jaw links of their own, and the jaws shapes of convex parts; write these into a folder."""
    links = {str(link.get("name")): link for link in root.findall("link")}
    for element in root.iter():
        if element.tag == "mesh":
            element.set("filename", f"file://{mesh_path(str(element.get('filename')), source)}")
        elif element.tag == "origin" and element.get("rpy"):
            element.set("rpy", " ".join(_quarter(float(word)) for word in str(element.get("rpy")).split()))
    for joint in root.findall("joint"):
        child, limit = joint.find("child"), joint.find("limit")
        assert child is not None
        if child.get("link") == LAST:
            child.set("link", FLANGE)
        if child.get("link") == MOVING:
            assert limit is not None
            limit.set("upper", f"{OPEN_RAD}")
        if child.get("link") == "gripper_frame_link":
            root.remove(joint)
    root.remove(links["gripper_frame_link"])
    solids: dict[str, trimesh.Trimesh] = {}
    for name, link in links.items():
        for shape in link.findall("collision"):
            ((_, solid),) = coloured(shape, source, {})
            link.remove(shape)
            if _mesh(shape) in (BODY_MESH, JAW_MESH):
                solids[name] = solid
            else:
                _add(link, _part(solid, 0, -FAR, FAR), folder)
    whole, lever = solids[LAST], solids[MOVING]
    fixed = ElementTree.SubElement(root, "link", {"name": FIXED})
    flange = ElementTree.SubElement(root, "link", {"name": FLANGE})
    tip = _part(whole, 2, -FAR, BODY_ENDS_M)
    _add(links[LAST], _part(whole, 2, BODY_ENDS_M, FAR), folder)
    _add(fixed, tip, folder)
    _add(links[MOVING], _part(lever, 1, -FAR, BLADE_BEGINS_M), folder)
    _add(links[MOVING], _part(lever, 1, BLADE_BEGINS_M, FAR), folder)
    _inertial(fixed, FIXED_KG, 0.0, tip.vertices.mean(axis=0))
    _inertial(flange, FLANGE_KG, FLANGE_KG_M2, np.zeros(3))
    mass = links[LAST].find("inertial/mass")
    assert mass is not None
    mass.set("value", f"{float(str(mass.get('value'))) - FLANGE_KG - FIXED_KG:.6g}")
    for name, parent, child in (("mount", FLANGE, LAST), ("fixed_jaw_joint", LAST, FIXED)):
        made = ElementTree.SubElement(root, "joint", {"name": name, "type": "fixed"})
        ElementTree.SubElement(made, "parent", {"link": parent})
        ElementTree.SubElement(made, "child", {"link": child})
    in_hand = [joint for joint in root.findall("joint") if joint.find("parent").get("link") == LAST]  # type: ignore
    for element in (*links[LAST], *in_hand):
        _to_hand(element)
    return root


def _quarter(angle: float) -> str:
    """Return an angle [rad], exact if it is a rounded quarter turn."""
    exact = round(angle / (math.pi / 2)) * math.pi / 2
    return repr(exact if abs(angle - exact) < QUARTER_RAD else angle)


def _mesh(shape: Element) -> str:
    """Return the file name of a shape's mesh."""
    mesh = shape.find("geometry/mesh")
    assert mesh is not None
    return Path(str(mesh.get("filename"))).name


def _to_hand(element: Element) -> None:
    """Express an element's pose in the hand, given its pose in the last link."""
    pose = HAND.inverse() @ origin_pose(element, URDF)
    origin = element.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(element, "origin")
    origin.set("xyz", " ".join(f"{x:.10g}" for x in pose.position))
    origin.set("rpy", " ".join(_quarter(x) for x in pose.rotation.as_euler("xyz")))


def _part(mesh: trimesh.Trimesh, axis: int, begin: float, end: float) -> trimesh.Trimesh:
    """Return the convex hull of what a mesh has between two places on an axis [m]."""
    along = mesh.vertices[:, axis]
    points = [mesh.vertices[(along >= begin) & (along <= end)]]
    for place in (begin, end):
        first, second = (mesh.vertices[mesh.edges_unique[:, k]] for k in (0, 1))
        cut = (first[:, axis] < place) != (second[:, axis] < place)
        share = (place - first[cut, axis : axis + 1]) / (second[cut, axis : axis + 1] - first[cut, axis : axis + 1])
        points.append(first[cut] + share * (second[cut] - first[cut]))
    return trimesh.convex.convex_hull(np.concatenate(points))


def _add(link: Element, part: trimesh.Trimesh, folder: Path) -> None:
    """Give a link a collision shape."""
    file = folder / f"{link.get('name')}_{len(link)}.stl"
    part.export(file)
    geometry = ElementTree.SubElement(ElementTree.SubElement(link, "collision"), "geometry")
    ElementTree.SubElement(geometry, "mesh", {"filename": f"file://{file}"})


def _inertial(link: Element, mass_kg: float, moment_kg_m2: float, centre: np.ndarray) -> None:
    """Give a link a mass."""
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", {"xyz": " ".join(f"{x:.6g}" for x in centre), "rpy": "0 0 0"})
    ElementTree.SubElement(inertial, "mass", {"value": f"{mass_kg:g}"})
    moments = dict.fromkeys(("ixx", "iyy", "izz"), f"{moment_kg_m2:g}") | dict.fromkeys(("ixy", "ixz", "iyz"), "0")
    ElementTree.SubElement(inertial, "inertia", moments)


if __name__ == "__main__":
    main()
