"""Make an object of a mesh: a visual, convex parts, a mass, rest poses, affordances and proven grasps."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml

from roboxim_core.config import load_config
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.description import GraspAnnotation, ObjectModel, Region
from roboxim_core.models.modifiers import PALETTE
from roboxim_core.models.object_config import ObjectConfig
from roboxim_core.models.surfaces import material_of
from roboxim_core.poses import Array, Pose
from roboxim_runs.assets.check import DENSITY, UNITS, check, simplify, stability
from roboxim_runs.assets.floating_gripper import FRANKA_HAND, floating
from roboxim_runs.assets.grasp_search import Search, find_grasps
from roboxim_runs.assets.resting import RestPose, rest_poses
from roboxim_runs.assets.shape_affordances import regions_of
from roboxim_runs.assets.solids import EFFORTS, convex_parts, placed, repaired, volume_of
from roboxim_runs.robots.grippers import gripper

TRIANGLES = 1500
"""Triangles of the visual; see `roboxim_core.models.check.MANY_TRIANGLES`."""
MASSES = (0.02, 1.0)
"""Least and largest guessed mass [kg]."""
HAND_SIZED_M = 0.12
"""Length by which the unit of a file is guessed: the one in which its longest side comes nearest to it [m]."""
NEAR_UPRIGHT_RAD = np.deg2rad(10)
"""Tilt up to which a rest pose counts as the one that the file has [rad]."""
LEVEL_RAD = np.deg2rad(0.1)
"""Tilt at which an object counts as turned to its rest pose [rad]."""
TURNS = 4
"""Most turns towards a rest pose."""
POSES_TRIED = 4
"""Rest poses that are tried."""
TALL = 1.3
"""Height over the wider side of the base from which a standing object can topple and be put upright."""
OFTEN = 0.1
"""Share of the drops from which a rest pose is listed."""


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """How a mesh is imported. What is empty or 0 is guessed, and the report says so."""

    unit: str = ""
    """Unit of the file, one of `check.UNITS`."""
    up: str = "z"
    """Axis of the file that points up: ``z`` or ``y``."""
    mass_kg: float = 0.0
    """Mass [kg]; else by a density of 400 kg/m^3."""
    name: str = ""
    """Noun in instructions; else the file's name."""
    effort: str = "fast"
    """One of `solids.EFFORTS`."""
    gripper: str = FRANKA_HAND
    """Gripper of ``config/grippers`` that shall grasp it."""
    grasps: int = 8
    """Grasps at which the search ends."""
    tries: int = 40
    """Most candidates of grasps that the floating hand tries."""


@dataclass(frozen=True, kw_only=True)
class Imported:
    """An imported object."""

    file: Path
    """Its YAML file."""
    report: tuple[str, ...]
    """What was guessed, mended, found and not found, one sentence each."""
    graspable: bool
    """Whether a grasp was found."""
    size_m: tuple[float, float, float]
    """Extents, as it stands [m]."""


def guessed_unit(longest: float) -> str:
    """Return the unit in which a mesh comes closest to the size of objects that a hand holds.

    Args:
        longest: Its longest side in the file's unit.
    """
    return min(("m", "cm", "mm"), key=lambda unit: abs(np.log(longest * UNITS[unit] / HAND_SIZED_M)))


def object_id_of(file: Path) -> str:
    """Return the id of the object that a mesh file becomes: its name in lower case, with underscores."""
    object_id = re.sub(r"[^a-z0-9]+", "_", file.stem.lower()).strip("_") or "object"
    return object_id if object_id[0].isalpha() else f"object_{object_id}"


def import_mesh(
    file: Path, out: Path, options: ImportOptions | None = None, on_step: Callable[[str], None] = lambda _: None
) -> Imported:
    """Import a mesh: write ``NAME.yaml``, ``NAME.glb`` and the convex parts into a folder; nothing if it fails.

    Args:
        file: Mesh file, of any format that trimesh reads.
        out: Folder ``objects`` of a configuration folder.
        options: How.
        on_step: Called with the name of each step that begins.

    Raises:
        ConfigError: When the mesh cannot be read, has no volume, or an option is wrong.
    """
    options = options or ImportOptions()
    if options.effort not in EFFORTS:
        raise ConfigError(f"unknown effort '{options.effort}'; {one_of(EFFORTS, options.effort)}")
    object_id = object_id_of(file)
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out, prefix=f".{object_id}-") as folder:
        work = _Import(file, object_id, Path(folder), options, on_step)
        made = work.run()
        # the YAML file last, since it names the others
        for path in sorted(made.file.parent.iterdir(), key=lambda path: path == made.file):
            target = out / path.name
            if target.is_dir():
                shutil.rmtree(target)
            os.replace(path, target)
    return replace(made, file=out / f"{object_id}.yaml")


class _Import:
    """One import; files are written into a separate folder until it has succeeded."""

    def __init__(
        self, file: Path, object_id: str, folder: Path, options: ImportOptions, on_step: Callable[[str], None]
    ) -> None:
        self.file, self.id, self.options, self._step = file, object_id, options, on_step
        self._base = self.folder = folder
        self._opening_m = gripper(options.gripper).gripper.max_opening_m
        self.report: list[str] = []
        self._stages = 0
        self._colour = ""

    def run(self) -> Imported:
        if self.id in _library().object_ids and not (self._base.parent / f"{self.id}.yaml").is_file():
            self.report.append(f"name: it hides another object of the name '{self.id}'; rename the file to keep both")
        self._step("reading and repairing")
        scene, solid = self._solid()
        self._step("cutting into convex parts")
        parts = convex_parts(solid, EFFORTS[self.options.effort])
        model = self._stage(scene, solid, parts)
        self._step("dropping it")
        scene, solid, parts, model = self._standing(scene, solid, parts, rest_poses(model))
        rests = rest_poses(model)
        regions = regions_of(parts)
        self._step("searching grasps")
        search = find_grasps(
            solid, model, max_opening_m=self._opening_m, enough=self.options.grasps, tries=self.options.tries,
            make=floating(self.options.gripper), on_try=lambda tried: self._step(f"searching grasps: {tried} tried"),
        )  # fmt: skip
        self._report(model, parts, search, regions)
        self._stage(scene, solid, parts, notes=self._notes(model, rests, regions, search))
        found = check(str(self.folder / f"{self.id}.yaml"), _library())
        self.report += [f"check: {finding.severity}: {finding.message}" for finding in found]
        x, y, z = (float(value) for value in solid.extents)
        return Imported(
            file=self.folder / f"{self.id}.yaml", report=tuple(self.report), graspable=bool(search.grasps),
            size_m=(x, y, z),
        )  # fmt: skip

    def _solid(self) -> tuple[Any, trimesh.Trimesh]:
        _, raw = placed(self.file, 1.0, self.options.up)
        longest = float(raw.extents.max())
        unit = self.options.unit or guessed_unit(longest)
        if unit not in UNITS:
            raise ConfigError(f"unknown unit '{unit}'; {one_of(UNITS, unit)}")
        scene, mesh = placed(self.file, UNITS[unit], self.options.up)
        solid, mended = repaired(mesh)
        how = "as given" if self.options.unit else "guessed; else give --unit"
        self.report.append(f"unit: {unit} ({how}); {self.options.up} up; {_extents(solid.extents)}")
        if mended:
            self.report.append(f"surface: {mended}")
        self._colour = "" if _textured(scene) else _nearest_colour(scene)
        if self._colour and solid.is_volume:
            scene = trimesh.Scene(solid.copy())  # what is seen is closed, too
        return scene, solid

    def _stage(
        self, scene: Any, solid: trimesh.Trimesh, parts: list[trimesh.Trimesh], notes: dict[str, Any] | None = None
    ) -> ObjectModel:
        """Write the object's files as far as they are known, into a new folder; return the object."""
        self._stages += 1
        self.folder = self._base / str(self._stages)  # readers of models cache them by path
        self.folder.mkdir()
        visual = self.folder / f"{self.id}.glb"
        visual.write_bytes(scene.export(file_type="glb"))
        if len(solid.faces) > TRIANGLES:
            simplify(visual, TRIANGLES, visual)
        pieces = self.folder / f"{self.id}_parts"
        pieces.mkdir(exist_ok=True)
        for number, part in enumerate(parts):
            part.export(pieces / f"{number}.obj", include_normals=False, header=None)
        low, high = MASSES
        mass = self.options.mass_kg or min(max(low, volume_of(solid, parts) * DENSITY), high)
        look: dict[str, Any] = {"kind": "mesh", "mesh": visual.name}
        content: dict[str, Any] = {
            "links": [
                {
                    "mass": float(f"{mass:.3g}"),
                    "collision": [{"kind": "hull", "mesh": f"{pieces.name}/{k}.obj"} for k in range(len(parts))],
                    "visual": [look | ({"tinted": True} if self._colour else {})],
                }
            ],
            **(notes or {}),
        }
        if self._colour:
            content["modifiers"] = {"color": {"default": self._colour}}
        noun = self.options.name or self.id.replace("_", " ")
        text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
        head = f"# Imported from {self.file.name} by: roboxim assets import {self.file.name}\n"
        path = self.folder / f"{self.id}.yaml"
        path.write_text(head + "".join(f"# {line}\n" for line in self.report) + f"name: {json.dumps(noun)}\n{text}")
        return load_config(path, ObjectConfig).model(self.id, self.folder)

    def _standing(
        self, scene: Any, solid: trimesh.Trimesh, parts: list[trimesh.Trimesh], rests: list[RestPose]
    ) -> tuple[Any, trimesh.Trimesh, list[trimesh.Trimesh], ObjectModel]:
        """Return the meshes turned so that the object stands: as in the file if it can, else as it rests most often."""
        near = [rest for rest in rests if rest.tilt_rad < NEAR_UPRIGHT_RAD]
        wanted = [*near, *(rest for rest in rests if rest not in near)][:POSES_TRIED]
        for rest in wanted:
            meshes = [mesh.copy() for mesh in (scene, solid, *parts)]
            model = self._turned(meshes, rest)
            if not stability(replace(model, toppled=())):
                if rest not in near:
                    self.report.append(
                        f"rest: it does not stand as in the file, so it was turned to a pose in which {rest.share:.0%} "
                        "of the drops ended"
                    )
                return meshes[0], meshes[1], meshes[2:], model
        self.report.append("rest: no pose was found in which it lies still (it rolls or rocks); scenes may refuse it")
        return scene, solid, parts, self._stage(scene, solid, parts)

    def _turned(self, meshes: list[Any], rest: RestPose) -> ObjectModel:
        """Turn meshes to a rest pose, more exactly with each turn; return the object."""
        for _ in range(TURNS):
            turn, shift = np.eye(4), np.eye(4)
            turn[:3, :3] = rest.pose.rotation.as_matrix()
            for mesh in meshes:
                mesh.apply_transform(turn)
            shift[:3, 3] = -meshes[1].bounds.mean(axis=0)
            for mesh in meshes:
                mesh.apply_transform(shift)
            model = self._stage(meshes[0], meshes[1], meshes[2:])
            now = rest_poses(model, drops=1)
            if not now or now[0].tilt_rad < LEVEL_RAD:
                break
            rest = now[0]
        return model

    def _notes(
        self, model: ObjectModel, rests: list[RestPose], regions: list[Region], search: Search
    ) -> dict[str, Any]:
        """Return the part of the YAML file that states what the object can do."""
        x, y, height = model.size
        toppled = [rest for rest in rests if rest.tilt_rad > np.deg2rad(60) and rest.share >= OFTEN]
        upright = bool(toppled) and height > TALL * max(x, y)
        affordances = ["graspable"] if search.grasps else []
        affordances += ["container" if region.kind == "interior" else "support" for region in regions]
        affordances += ["upright"] if upright else []
        affordances += ["pushable"] if height <= min(x, y) and rests else []
        notes: dict[str, Any] = {"affordances": affordances}
        if search.grasps:
            notes["grasps"] = [_plain_grasp(grasp) for grasp in search.grasps]
        if regions:
            notes["regions"] = [_plain_region(region) for region in regions]
        if upright:
            notes["toppled"] = [_plain_pose(rest.pose) for rest in toppled]
        return notes

    def _report(self, model: ObjectModel, parts: list[trimesh.Trimesh], search: Search, regions: list[Region]) -> None:
        mass = model.links[0].mass
        given = "as given" if self.options.mass_kg else f"a guess by {DENSITY:g} kg/m^3; weigh it"
        self.report.append(f"mass: {mass:.3g} kg ({given}); {len(parts)} convex part(s)")
        for region in regions:
            what = "a hollow" if region.kind == "interior" else "a flat top"
            self.report.append(f"shape: {what} of {1e3 * region.size[0]:.0f} mm across")
        if search.grasps:
            tool = self.options.gripper.replace("_", " ")
            self.report.append(f"grasps: {len(search.grasps)} hold of {search.tried} that a floating {tool} tried")
        elif not search.pairs:
            self.report.append(
                f"grasps: none; nowhere are two opposite sides within {1e3 * self._opening_m:.0f} mm, the "
                "gripper's opening"
            )
        else:
            reason = max(set(search.failures), key=search.failures.count) if search.failures else "all reach the table"
            self.report.append(f"grasps: none of {search.tried} tried holds; most often {reason}")


def _library() -> Any:
    from roboxim_core.models.library import ModelLibrary

    return ModelLibrary()


def _extents(extents: Array) -> str:
    x, y, z = 1e3 * np.asarray(extents)
    return f"{x:.0f} x {y:.0f} mm, {z:.0f} mm high"


def _textured(scene: Any) -> bool:
    """Tell whether a part of a scene has an image or colours of its own at its vertices."""
    for part in scene.geometry.values():
        material = getattr(part.visual, "material", None)
        if getattr(material, "baseColorTexture", None) is not None or getattr(material, "image", None) is not None:
            return True
        if part.visual.kind in ("vertex", "face"):
            return True
    return len(scene.geometry) > 1


def _nearest_colour(scene: Any) -> str:
    """Return the palette's word for the colour of a scene of one part, whose colours are those of a GLB file."""
    (part,) = scene.geometry.values()
    has_one = getattr(part.visual, "material", None) is not None
    colour = material_of(part, "", linear=True).color if has_one else PALETTE["gray"]
    return min(PALETTE, key=lambda word: float(np.abs(np.subtract(PALETTE[word], colour)).sum()))


def _plain_pose(pose: Pose) -> dict[str, list[float]]:
    roll, pitch, yaw = pose.rotation.as_euler("xyz", degrees=True)
    return {
        "position": [round(float(value), 4) for value in pose.position],
        "rpy_deg": [round(float(value), 2) for value in (roll, pitch, yaw)],
    }


def _plain_grasp(grasp: GraspAnnotation) -> dict[str, Any]:
    return {
        "name": grasp.name, "pose": _plain_pose(grasp.pose), "width_m": grasp.width_m, "opening_m": grasp.opening_m,
    }  # fmt: skip


def _plain_region(region: Region) -> dict[str, Any]:
    return {
        "kind": region.kind, "shape": region.shape, "pose": {"position": list(region.pose.position)},
        "size": list(region.size),
    }  # fmt: skip
