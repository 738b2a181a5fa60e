"""The stand of an arm that is too small to stand where the others do: it carries the arm's base to where it reaches.

The robot's base frame stays where that of every arm is, so that tasks, scenes and areas hold for all of them.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from roboxim_runs.robots.link_meshes import LinkMeshes
from roboxim_runs.robots.recipe import RobotRecipe
from roboxim_runs.robots.urdf_files import fixed_joint, massless

Element = ElementTree.Element
SIDE_M = 0.12
"""Length and width of the pillar below an arm's base [m]."""
COLOR = "0.62 0.64 0.66 1"


def root_link(recipe: RobotRecipe, base: str) -> str:
    """Return the name of a robot's root link: that of the stand, or else of the arm's base."""
    return f"{recipe.name}_stand" if any(recipe.base_xyz) else base


def covered(recipe: RobotRecipe) -> list[float]:
    """Return the rectangle that the stand covers, as `RobotModel.stand`; empty: there is none."""
    x, y, _ = recipe.base_xyz
    half = SIDE_M / 2
    return [x - half, y - half, x + half, y + half] if any(recipe.base_xyz) else []


def stand(recipe: RobotRecipe, folder: Path, base: str) -> list[Element]:
    """Return the links and joints of a stand; none: the arm needs none.

    Args:
        recipe: Has the place of the arm's base in the robot's base frame.
        folder: The robot's folder; receives the meshes.
        base: Link at the arm's base.
    """
    x, y, z = recipe.base_xyz
    if not any(recipe.base_xyz):
        return []
    link = ElementTree.Element("link", {"name": root_link(recipe, base)})
    if z > 0.0:
        for tag in ("visual", "collision"):
            shape = ElementTree.SubElement(link, tag)
            ElementTree.SubElement(shape, "origin", {"xyz": f"{x:g} {y:g} {z / 2:g}", "rpy": "0 0 0"})
            geometry = ElementTree.SubElement(shape, "geometry")
            ElementTree.SubElement(geometry, "box", {"size": f"{SIDE_M:g} {SIDE_M:g} {z:g}"})
            if tag == "visual":
                material = ElementTree.SubElement(shape, "material", {"name": ""})
                ElementTree.SubElement(material, "color", {"rgba": COLOR})
        meshes = LinkMeshes(recipe.name, folder, folder, {}, triangles=recipe.triangles, collision_m=recipe.collision_m)
        shapes = meshes.visual(link) + meshes.collision(link)
        for element in list(link):
            link.remove(element)
        link.extend(shapes)
    link.append(massless())
    name = f"{recipe.name}_stand_joint"
    return [link, fixed_joint(name, root_link(recipe, base), base, xyz=f"{x:g} {y:g} {z:g}")]
