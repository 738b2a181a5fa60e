"""Checks of a user's object that need the simulator, and a draft YAML file for a mesh."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import fast_simplification
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from roboxim_core.episode.start import MOVED_M, TURNED_RAD
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.check import LARGEST_M, Finding, check_object
from roboxim_core.models.description import ObjectModel
from roboxim_core.models.hulls import hull_of, load_mesh, load_scene
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.surfaces import rewrite
from roboxim_core.poses import Pose, distance
from roboxim_core.specs import EntitySpec, TableSpec
from roboxim_runs.assets.floating_hand import CLEARANCE_M, TIP_BEYOND_TCP_M, lowest_tip
from roboxim_runs.assets.solids import UPS
from roboxim_sim.bodies import ObjectBody, build_table, configure
from roboxim_sim.bullet import BulletClient, bullet_client
from roboxim_sim.rendering import textures  # noqa: F401  (registers the room's, which an object may use too)

YAWS = (0.0, 0.4, 1.1, 2.0, 2.9, -1.0)
"""Turns about the vertical at which an object must stay at rest: a pose on an edge may hold at one of them [rad]."""
DENSITY = 400.0
"""Assumed density of a new object [kg/m^3]."""


def check(target: str, library: ModelLibrary) -> list[Finding]:
    """Check an object.

    Args:
        target: Id of an object, or path of its YAML file.
        library: Library that resolves ids and holds the gripper.

    Raises:
        ConfigError: When there is no such object or file.
    """
    path = Path(target) if re.search(r"[/\\]|\.ya?ml$", target) else library.path("objects", target)
    if not path.is_file():
        raise ConfigError(f"no such file: {path}")
    opening = max(library.robot(robot_id).gripper.max_opening_m for robot_id in library.robot_ids)
    found, model = check_object(path, opening)
    if model is None or any(finding.severity == "error" for finding in found):
        return list(found)
    return [*found, *clearance(model), *stability(model)]


def clearance(model: ObjectModel) -> list[Finding]:
    """Check that fingers at the grasps of an object that stands on a table stay above the table."""
    lows = {
        grasp.name: model.rest_height + lowest_tip(grasp.pose.position, grasp.pose.rotation.as_matrix())
        for grasp in model.grasps
    }
    inside = [name for name, low in lows.items() if low < 0]
    if not inside:
        return []
    depth = -1e3 * min(lows.values())
    return [
        Finding(
            severity="error" if len(inside) == len(lows) else "warning",
            message=f"at {', '.join(inside)} the Panda's fingertips would be up to {depth:.1f} mm in the table, so "
            "that it is never grasped there: move these grasps up",
        )
    ]


def stability(model: ObjectModel) -> list[Finding]:
    """Check that an object stays at rest on a table, upright and toppled."""
    found = []
    with bullet_client() as client:
        for k, start in enumerate((Pose(position=(0.0, 0.0, model.rest_height)), *model.toppled)):
            moved, turned = np.max([_motion(client, model, start, yaw) for yaw in YAWS], axis=0)
            if moved > MOVED_M or turned > TURNED_RAD:
                what = f"toppled pose {k}" if k else "upright at its rest_height"
                found.append(
                    Finding(
                        severity="error",
                        message=f"put on a table {what} it moves by up to {1e3 * moved:.0f} mm and turns by up to "
                        f"{math.degrees(turned):.0f} deg within a second, so scenes with it would not settle: give "
                        "it a pose or shapes that stand",
                    )
                )
    return found


def _motion(client: BulletClient, model: ObjectModel, start: Pose, yaw_rad: float) -> tuple[float, float]:
    """Return how far an object moves [m] and turns [rad] within a second on a table, turned about the vertical."""
    turn = Pose.from_arrays((0.5, 0.0, 0.0), Rotation.from_euler("z", yaw_rad))
    pose = turn @ replace(start, position=(0.0, 0.0, start.position[2]))
    configure(client, 240.0)
    build_table(client, TableSpec())
    body = ObjectBody(client, model, EntitySpec(name="it", model=model.id, pose=pose))
    for _ in range(240):
        client.stepSimulation()
    joints = body.read_joints()[0]
    return distance(pose, body.read(joints, joints)[0].pose)


UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Unit of a mesh to its length [m]."""


def guessed_unit(mesh: Path) -> str:
    """Return m if a mesh then fits on a table, else mm.

    Raises:
        ConfigError: When the mesh cannot be read or is flat.
    """
    longest = float(np.ptp(hull_of(mesh).bounds, axis=0).max())
    return "m" if longest <= LARGEST_M else "mm"


def size_text(mesh: Path, unit: str, up: str) -> str:
    """Return how large a mesh is with a unit and an up-axis, in words.

    Raises:
        ConfigError: When the mesh cannot be read, or a name is unknown.
    """
    for kind, name, known in (("unit", unit, tuple(UNITS)), ("up-axis", up, UPS)):
        if name not in known:
            raise ConfigError(f"unknown {kind} '{name}'; {one_of(known, name)}")
    x, y, z = 1000.0 * UNITS[unit] * np.ptp(hull_of(mesh).bounds, axis=0)
    wide, deep, high = (x, y, z) if up == "z" else (x, z, y)
    return f"unit {unit}, {up} up: {wide:.0f} x {deep:.0f} mm, {high:.0f} mm high"


def turned(mesh: Path) -> Path:
    """Write a copy of a mesh whose y axis points up, with z up, beside it; return the copy.

    Raises:
        ConfigError: When the mesh cannot be read.
    """
    scene: Any = load_scene(mesh)
    scene.apply_transform(Pose.from_arrays((0, 0, 0), Rotation.from_euler("x", math.pi / 2)).matrix)
    out = mesh.with_name(f"{mesh.stem}_z_up.glb")
    rewrite(scene, mesh, out)
    out.write_bytes(scene.export(file_type="glb"))
    return out


def starter(mesh: Path, unit: str = "", up: str = "z") -> str:
    """Return a draft YAML file for a mesh, with a mass, and a grasp from above if the mesh is narrow.

    Args:
        mesh: The mesh.
        unit: One of `UNITS`; empty: see `guessed_unit`.
        up: One of `UPS`; with y, a turned copy is written beside the mesh.

    Raises:
        ConfigError: When the mesh cannot be read or is flat, or a name is unknown.
    """
    chosen = unit or guessed_unit(mesh)
    text = size_text(mesh, chosen, up)
    file = turned(mesh) if up == "y" else mesh
    hull, scale = hull_of(file), UNITS[chosen]
    low, high = hull.bounds * scale
    x, y = (high - low)[:2]
    middle = (low + high) / 2
    middle[2] = max(middle[2], min(low[2] + TIP_BEYOND_TCP_M + CLEARANCE_M, high[2]))
    center = ", ".join(f"{value:.4f}" for value in middle)
    mass = max(0.01, hull.volume * scale**3 * DENSITY)
    lines = [
        f"# What it is. Checked by: roboxim assets check {mesh.stem}.yaml",
        f"# {text}; if that is wrong: roboxim assets new {mesh.name} --unit {'|'.join(UNITS)} --up {'|'.join(UPS)}",
        f"name: {mesh.stem.replace('_', ' ')}",
        f"mesh: {file.name}",
        f"mesh_scale: {scale:g}",
        f"mass: {mass:.2g}  # kg; a guess: weigh it",
    ]
    if min(x, y) < 0.07:
        yaw, width = (0, y) if y <= x else (90, x)
        lines += [
            "affordances: [graspable]",
            "grasps:",
            "  # From above at its middle, the fingers closing along y (along x if the last angle is 90).",
            f"  - {{name: top, pose: {{position: [{center}], rpy_deg: [180, 0, {yaw}]}}, width_m: {width:.3f}}}",
        ]
    return "\n".join(lines) + "\n"


def simplify(mesh: Path, triangles: int, out: Path) -> tuple[int, int]:
    """Write a mesh with fewer triangles, with the same parts and materials.

    Returns:
        Numbers of triangles before and after.

    Raises:
        ConfigError: When the mesh cannot be read.
    """
    before = len(load_mesh(mesh).faces)
    scene: Any = load_scene(mesh)
    rewrite(scene, mesh, out)
    after = 0
    for name, part in scene.geometry.items():
        share = max(20, round(triangles * len(part.faces) / before))
        fewer = part if len(part.faces) <= share else _simplified(part, share)
        after += len(fewer.faces)
        scene.geometry[name] = fewer
    out.write_bytes(scene.export(file_type=out.suffix.lstrip(".")))
    return before, after


def _simplified(part: Any, triangles: int) -> trimesh.Trimesh:
    """Collapse edges. Texture coordinates and colours come from the nearest original vertex."""
    welded = trimesh.Trimesh(part.vertices, part.faces, process=True)
    points, faces = fast_simplification.simplify(
        welded.vertices.astype(np.float32), welded.faces, target_count=triangles, agg=4.0
    )
    fewer = trimesh.Trimesh(points, faces, process=True)
    visuals: Any = trimesh.visual
    uv, material = getattr(part.visual, "uv", None), getattr(part.visual, "material", None)
    if material is not None:
        _, nearest = part.kdtree.query(fewer.vertices)
        fewer.visual = visuals.TextureVisuals(uv=None if uv is None else uv[nearest], material=material)
    elif part.visual.kind in ("vertex", "face"):
        _, nearest = part.kdtree.query(fewer.vertices)
        fewer.visual = visuals.ColorVisuals(fewer, vertex_colors=part.visual.vertex_colors[nearest])
    return fewer
