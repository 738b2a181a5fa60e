"""Derives a gripper's files from a URDF: `roboxim robot gripper`.

Joints with ``<mimic>`` become followers of the finger on their side. The map from opening to joint position is
measured: the distance between the two finger tips over the range of the driven joints.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import coal
import numpy as np
import pinocchio as pin
import yaml
from scipy.optimize import brentq

from roboxim_core.errors import ConfigError
from roboxim_core.models.description import FollowerJoint, GripperModel, RobotModel
from roboxim_core.models.urdf import urdf_materials
from roboxim_core.poses import Array
from roboxim_planner.collisions.geometry import convex_hull
from roboxim_planner.robot import PlannerRobot
from roboxim_runs.robots.grippers import below
from roboxim_runs.robots.link_meshes import LinkMeshes
from roboxim_runs.robots.recipe import source_file
from roboxim_runs.robots.urdf_files import expanded, fixed_joint, massless, replaced, write

Element = ElementTree.Element
HAND, TCP = "hand", "hand_tcp"
"""Names of a gripper's root link and of its tool centre point."""
ROWS = 9
"""Rows of the opening map."""
TIP_BEYOND_TCP_M = 0.0095
"""How far closed finger tips reach beyond the tool centre point, as the Franka hand's do: skills count on it [m]."""
TIP_M = 0.0002
"""How far a finger tip's collision shape may reach beyond its convex hull [m]: it is the surface that holds."""
LIGHT_KG, LIGHT_KG_M2 = 0.03, 2e-4
"""Least mass and moment of inertia of a link that moves with a finger. The physics engine does not hold lighter ones
against each other under 20 N; a geared motor adds as much to its joint."""


@dataclass(frozen=True, kw_only=True)
class GripperRecipe:
    """How a gripper is derived from somebody's URDF: a YAML file."""

    name: str
    """Its name."""
    urdf: str
    """URDF file; relative to the recipe, or ``package:DISTRIBUTION/PATH`` in an installed wheel."""
    title: str = ""
    """What it is, e.g. ``Robotiq 2F-85``."""
    source: str = ""
    """Where the URDF comes from, with version and licence."""
    root: str
    """Link that is mounted: z points out of the flange, the fingers open along y. What lies above it is left out."""
    joints: tuple[str, ...]
    """Driven joint of each finger; both move alike. One joint: a jaw that moves against a fixed one."""
    tips: tuple[str, str]
    """Link of each finger that holds an object; with one joint, the fixed jaw first."""
    force_n: float
    """Force of each finger [N]."""
    speed_m_s: float
    """Speed of each finger [m/s]."""
    triangles: int = 600
    """Triangles of a link's visual mesh."""
    weld_m: float = 0.0005
    """Detail of visual meshes that is dropped [m]."""
    collision_m: float = 0.001
    """How far a link's collision shape may reach beyond its convex hull [m]; that of a finger tip by `TIP_M`."""


def derive_gripper(
    recipe: GripperRecipe, out: Path, *, folder: Path | None = None, report: Callable[[str], None] = print
) -> Path:
    """Write a gripper's folder and its YAML file.

    Args:
        recipe: What to do.
        out: Folder ``grippers`` of a configuration folder; receives ``NAME/`` and ``NAME.yaml``.
        folder: Folder that the recipe's ``urdf`` is relative to; none: the working directory.
        report: Receives a line for each step.

    Returns:
        The YAML file.

    Raises:
        ConfigError: When the URDF lacks a link or joint that the recipe names, or its fingers do not close.
    """
    source = source_file(recipe.urdf, folder or Path.cwd())
    root = expanded(source)
    kept = below(root, recipe.root)
    links = {str(link.get("name")): link for link in kept if link.tag == "link"}
    joints = {str(joint.get("name")): joint for joint in kept if joint.tag == "joint"}
    for what, name, known in (
        ("root", recipe.root, links), *(("tips", name, links) for name in recipe.tips),
        *(("joints", name, joints) for name in recipe.joints),
    ):  # fmt: skip
        if name not in known:
            raise ConfigError(f"{source}: {what}: none is called '{name}'; there are {', '.join(known)}")
    recipe = _renamed(kept, recipe)
    links = {str(link.get("name")): link for link in links.values()}
    joints = {str(joint.get("name")): joint for joint in joints.values()}
    with replaced(out, "grippers", recipe.name) as inside:
        materials = urdf_materials(root)
        meshes = LinkMeshes(
            recipe.name,
            inside,
            source,
            materials,
            triangles=recipe.triangles,
            weld_m=recipe.weld_m,
            max_parts=1,
            collision_m=recipe.collision_m,
        )
        made = ElementTree.Element("robot", {"name": recipe.name})
        made.extend(_link(link, meshes, recipe.tips) for link in links.values())
        made.extend(_joint(joint) for joint in joints.values())
        urdf = inside / f"{recipe.name}.urdf"
        write(made, urdf)
        followers = tuple(_followers(joints, recipe))
        rows, reach_m, arm_m = _measured(urdf, recipe, followers)
        _tcp(made, recipe.root, reach_m - TIP_BEYOND_TCP_M)
        write(made, urdf)
        report(f"opens to {1e3 * rows[-1][0]:.1f} mm; finger tips reach {1e3 * reach_m:.1f} mm from the flange")
        moving = [name for name, link in links.items() if name not in (recipe.root, *recipe.tips)]
        tool = GripperModel(
            joint_names=recipe.joints, max_opening_m=rows[-1][0], force_n=recipe.force_n, speed_m_s=recipe.speed_m_s,
            keeps_speed=True, links=(recipe.root, *recipe.tips, *moving), followers=followers, opening_map=rows,
            arm_m=round(arm_m, 4),
        )  # fmt: skip
        values = {"urdf": f"{recipe.name}/{recipe.name}.urdf", "root": HAND, "tcp": TCP, "gripper": plain(tool)}
        text = f"# {recipe.title or recipe.name}. Source: {recipe.source}.\n# Written by `roboxim robot gripper`.\n"
        text += str(yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=120))
        (inside.parent / f"{recipe.name}.yaml").write_text(text)
    return out / f"{recipe.name}.yaml"


def _renamed(elements: list[Element], recipe: GripperRecipe) -> GripperRecipe:
    """Call the root `HAND` and give all other names a prefix, so that they differ from those of any arm."""

    def own(name: str) -> str:
        return HAND if name == recipe.root else f"gripper_{name}"

    for element in elements:
        for part in element.iter():
            for key in ("name", "link", "joint"):
                if part.get(key) and part.tag in ("link", "joint", "parent", "child", "mimic"):
                    part.set(key, own(str(part.get(key))))
    left, right = recipe.tips
    return replace(recipe, root=HAND, joints=tuple(map(own, recipe.joints)), tips=(own(left), own(right)))


def plain(tool: GripperModel) -> dict[str, Any]:
    """Return a gripper as values of YAML, without those that are the default."""
    values = asdict(tool)
    default = {"keeps_speed": False, "followers": (), "opening_map": (), "arm_m": 1.0}
    return {
        name: [list(row) if isinstance(row, tuple) else row for row in value] if isinstance(value, tuple) else value
        for name, value in values.items()
        if name not in default or value != default[name]
    }


def _link(link: Element, meshes: LinkMeshes, tips: tuple[str, str]) -> Element:
    name = str(link.get("name"))
    made = ElementTree.Element("link", {"name": name})
    made.extend(meshes.visual(link) + meshes.collision(link, TIP_M if name in tips else None))
    inertial = link.find("inertial")
    if inertial is None:
        inertial = massless()
    elif name != HAND:
        for part, keys, minimum in (("mass", ("value",), LIGHT_KG), ("inertia", ("ixx", "iyy", "izz"), LIGHT_KG_M2)):
            for key in keys:
                found = inertial.find(part)
                assert found is not None
                found.set(key, f"{max(minimum, float(found.get(key, '0'))):.6g}")
    made.append(inertial)
    return made


def _joint(joint: Element) -> Element:
    made = ElementTree.Element("joint", {"name": str(joint.get("name")), "type": str(joint.get("type"))})
    made.extend(part for tag in ("origin", "parent", "child", "axis", "limit") for part in joint.findall(tag))
    return made


def _tcp(root: Element, parent: str, z_m: float) -> None:
    link = ElementTree.SubElement(root, "link", {"name": TCP})
    link.append(massless())
    root.append(fixed_joint(f"{TCP}_joint", parent, TCP, xyz=f"0 0 {z_m:.6f}"))


def _followers(joints: dict[str, Element], recipe: GripperRecipe) -> list[FollowerJoint]:
    """Return the joints that follow a driven one: that above them, or the one on their side of the hand."""
    above = {str(joint.find("child").get("link")): name for name, joint in joints.items()}  # type: ignore[union-attr]
    found = []
    for name, joint in joints.items():
        if name in recipe.joints or joint.get("type") == "fixed":
            continue
        mimic = joint.find("mimic")
        if mimic is None or float(mimic.get("offset", "0")) != 0.0:
            raise ConfigError(
                f"joint '{name}' of the gripper is neither driven nor follows: expected it in joints, or <mimic> "
                "without offset"
            )
        at: str | None = name
        while at and at not in recipe.joints:
            at = above.get(str(joints[at].find("parent").get("link")))  # type: ignore[union-attr]
        leader = at or min(recipe.joints, key=lambda other: abs(_side(joints[other]) - _side(joint)))
        found.append(FollowerJoint(name=name, leader=leader, ratio=float(mimic.get("multiplier", "1"))))
    return found


def _side(joint: Element) -> float:
    origin = joint.find("origin")
    return 0.0 if origin is None else float(origin.get("xyz", "0 0 0").split()[1])


def _measured(
    urdf: Path, recipe: GripperRecipe, followers: tuple[FollowerJoint, ...]
) -> tuple[tuple[tuple[float, float], ...], float, float]:
    """Return the opening map, how far the closed finger tips reach along z [m], and the arm of the finger's force.

    A follower's motor presses on the link before it, so the whole force of a finger turns its driven joint, at the
    height of the tip above it.
    """
    model = pin.buildModelFromUrdf(str(urdf))
    geometry = pin.buildGeomFromUrdf(model, str(urdf), pin.GeometryType.COLLISION, package_dirs=[str(urdf.parents[1])])
    data = model.createData()
    items = [
        next(k for k, item in enumerate(geometry.geometryObjects) if model.frames[item.parentFrame].name == tip)
        for tip in recipe.tips
    ]
    shapes = []
    for k in items:
        shape = geometry.geometryObjects[k].geometry
        shape.buildConvexHull(True, "Qt")
        shapes.append(shape.convex)
    leaders = {name: model.joints[model.getJointId(name)].idx_q for name in recipe.joints}
    one_jaw = len(recipe.joints) == 1

    def placed(position: float) -> list[pin.SE3]:
        q = pin.neutral(model)
        for at in leaders.values():
            q[at] = position
        for follower in followers:
            q[model.joints[model.getJointId(follower.name)].idx_q] = follower.ratio * position
        pin.forwardKinematics(model, data, q)
        objects = [geometry.geometryObjects[k] for k in items]
        return [data.oMi[item.parentJoint] * item.placement for item in objects]

    def gap(position: float) -> float:
        first, second = placed(position)
        result = coal.DistanceResult()
        transforms = [coal.Transform3s(pose.rotation, pose.translation) for pose in (first, second)]
        coal.distance(shapes[0], transforms[0], shapes[1], transforms[1], coal.DistanceRequest(), result)
        return float(result.min_distance)

    lower, upper = (float(limit[leaders[recipe.joints[0]]]) for limit in (
        model.lowerPositionLimit, model.upperPositionLimit
    ))  # fmt: skip
    opened, closed = (lower, upper) if gap(lower) > gap(upper) else (upper, lower)
    for last, position in itertools.pairwise(np.linspace(opened, closed, 50)):
        if gap(position) < 0.0:
            closed = float(brentq(gap, last, position, xtol=1e-6))
            break
    positions = np.linspace(closed, opened, ROWS)
    if one_jaw:  # between the tips: nearer to its axis, a jaw that turns opens less
        turned = placed(closed)[1]
        end = _end(np.asarray(shapes[1].points()) @ turned.rotation.T + turned.translation)
        shapes[1] = coal.Convex(convex_hull((np.asarray(end.points()) - turned.translation) @ turned.rotation))
    rows = [(round(gap(q), 5), round(float(q), 5)) for q in positions]
    rows[0] = (max(rows[0][0], 0.0), rows[0][1])
    reach = max(
        float((pose.rotation @ np.asarray(shape.points()).T).T[:, 2].max() + pose.translation[2])
        for q in (positions if one_jaw else (closed,))
        for shape, pose in zip(shapes, placed(q), strict=True)
    )
    middle = placed((opened + closed) / 2)[-1 if one_jaw else 0]
    center = middle.act(np.asarray(shapes[-1 if one_jaw else 0].points()).mean(axis=0))
    driven = data.oMi[model.getJointId(recipe.joints[0])]
    slides = model.joints[model.getJointId(recipe.joints[0])].shortname().startswith("JointModelP")
    return tuple(rows), reach, 1.0 if slides else float(center[2] - driven.translation[2])


def _end(points: Array) -> coal.ConvexBase:
    """Return the part of a closed jaw that touches what it holds, its last two centimetres along the tool's z axis."""
    return coal.Convex(convex_hull(points[points[:, 2] > points[:, 2].max() - 2 * TIP_BEYOND_TCP_M]))


def jaw_gap(robot: RobotModel, opening: float) -> float:
    """Return the distance of a robot's fixed jaw from the end of its moving one [m].

    Args:
        robot: A robot whose gripper has one moving jaw.
        opening: 1 = open, 0 = closed.
    """
    planner = PlannerRobot(robot)
    data, fixed, moving = planner.model.createData(), *robot.gripper.links[1:3]

    def placed(at: float) -> tuple[list[pin.GeometryObject], list[pin.SE3]]:
        pin.framesForwardKinematics(planner.model, data, planner.full(np.array(robot.home), at))
        items = [planner.geometry.geometryObjects[planner.item_links.index(link)] for link in (fixed, moving)]
        tool = data.oMf[planner.tcp_frame]
        return items, [tool.actInv(data.oMi[item.parentJoint] * item.placement) for item in items]

    items, (_, closed) = placed(0.0)
    points = np.asarray(items[1].geometry.points())
    end = _end(points @ closed.rotation.T + closed.translation)
    _, (first, second) = placed(opening)
    moved = second * closed.inverse()
    result = coal.DistanceResult()
    poses = [coal.Transform3s(pose.rotation, pose.translation) for pose in (first, moved)]
    coal.distance(items[0].geometry, poses[0], end, poses[1], coal.DistanceRequest(), result)
    return float(result.min_distance)
