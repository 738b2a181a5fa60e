"""Generate this folder's URDF, SRDF and meshes: the UR5 of the `example-robot-data` wheel with the Panda's hand.

``make robot-visuals`` regenerates them.
"""

from __future__ import annotations

import itertools
import math
import re
import shutil
import sys
import tempfile
from pathlib import Path

import cmeel
import numpy as np
import pinocchio as pin
import trimesh

from roboxim_runs.robots.convex_parts import convex_parts
from roboxim_runs.robots.decimation import visual

HERE = Path(__file__).resolve().parent
PANDA = HERE.parent / "panda"
SOURCE = Path(cmeel.__path__[0]).parent / "cmeel.prefix/share/example-robot-data/robots/ur_description"
SAMPLES = 10_000
MIN_GAIN = 0.03
"""Fraction of a link's hull that another convex part must save. With one hull per link, links that do not touch appear
to collide in a quarter of all states."""
TRIANGLES, UPPERARM_TRIANGLES = 4500, 9000  # the caps are thin shells, which fewer triangles would tear

sys.path.append(str(HERE.parent))
from dae import read_collada  # noqa: E402 - in the parent folder


def main() -> None:
    """Write everything."""
    for folder in ("collision", "visual"):
        shutil.rmtree(HERE / folder, ignore_errors=True)
        (HERE / folder).mkdir()
    for source in sorted((SOURCE / "meshes/ur5/visual").glob("*.dae")):
        triangles = UPPERARM_TRIANGLES if source.stem == "upperarm" else TRIANGLES
        (HERE / "visual" / f"{source.stem}.glb").write_bytes(
            visual(read_collada(source, linear=True), triangles=triangles).export(file_type="glb", include_normals=True)
        )
    whole = arm()[: -len("</robot>")] + hand() + "</robot>\n"
    urdf = whole
    for source in sorted((SOURCE / "meshes/ur5/collision").glob("*.stl")):
        parts = convex_parts(trimesh.load_mesh(source), min_gain=MIN_GAIN, max_parts=8)
        names = [f"{source.stem}_{k}.stl" for k in range(1, len(parts) + 1)] if len(parts) > 1 else [source.name]
        for name, part in zip(names, parts, strict=True):
            part.export(HERE / "collision" / name)
        urdf = with_parts(urdf, source.name, names)
    for name in ("visual/hand.glb", "visual/finger.glb", "collision/hand.stl"):
        shutil.copy(PANDA / name, HERE / name)
    (HERE / "ur5.urdf").write_text(urdf)
    (HERE / "ur5.srdf").write_text(srdf(whole))


def arm() -> str:
    """Return the URDF of the arm up to its flange, ``ur5_tool0``."""
    text = (SOURCE / "urdf/ur5_joint_limited_robot.urdf").read_text()
    text = re.sub(r"<!--.*?-->", "", text, flags=re.S)
    text = re.sub(r"\s*<(gazebo|transmission)\b.*?</\1>", "", text, flags=re.S)
    for link, joint in (
        ("world", "world_joint"),
        ("ee_link", "ee_fixed_joint"),
        ("base", "base_link-base_fixed_joint"),
    ):
        text = re.sub(rf'\s*<link name="{link}"\s*(/>|>.*?</link>)', "", text, flags=re.S)
        text = re.sub(rf'\s*<joint name="{joint}".*?</joint>', "", text, flags=re.S)
    text = text.replace("package://example-robot-data/robots/ur_description/meshes/ur5/", "package://ur5/")
    text = text.replace(".dae", ".glb").replace(' xmlns:xacro="http://www.ros.org/wiki/xacro"', "")
    text = re.sub(r"<dynamics [^>]*/>", '<dynamics damping="0.003" friction="0.0"/>', text)
    text = re.sub(r'velocity="3\.[0-9]+"', f'velocity="{math.pi:.6f}"', text)  # 180 deg/s, as in the data sheet
    for name in set(re.findall(r'<(?:link|joint) name="([^"]+)"', text)):
        text = text.replace(f'"{name}"', f'"ur5_{name}"')
    return re.sub(r"\n\s*\n", "\n", text).strip()


def hand() -> str:
    """Return the Panda's hand, mounted on the flange with its fingers opening along the flange's y axis."""
    text = (PANDA / "panda.urdf").read_text()
    text = text[text.index('<link name="panda_hand">') : text.rindex("</robot>")]
    text = text.replace("package://panda/", "package://ur5/").replace('"panda_', '"ur5_')
    mount = """    <joint name="ur5_hand_joint" type="fixed">
        <parent link="ur5_tool0"/>
        <child link="ur5_hand"/>
        <origin rpy="0 0 0" xyz="0 0 0"/>
    </joint>
    """
    return mount + text


def with_parts(urdf: str, mesh: str, parts: list[str]) -> str:
    """Return a URDF with one collision mesh replaced by several."""
    found = re.search(rf'\s*<collision>(?:(?!</collision>).)*/{re.escape(mesh)}".*?</collision>', urdf, flags=re.S)
    assert found is not None
    return urdf.replace(found[0], "".join(found[0].replace(f"/{mesh}", f"/{part}") for part in parts))


def srdf(text: str) -> str:
    """Return the pairs of links to exclude from collision checks: adjacent links, and those that never or always touch.

    Args:
        text: The URDF with the original meshes, which the decision is based on.
    """
    with tempfile.TemporaryDirectory() as folder:
        urdf = str(Path(folder, "whole.urdf"))
        Path(urdf).write_text(text)
        model = pin.buildModelFromUrdf(urdf)
        meshes = Path(folder, "ur5", "collision")
        shutil.copytree(SOURCE / "meshes/ur5/collision", meshes)
        shutil.copy(HERE / "collision/hand.stl", meshes)
        geometry = pin.buildGeomFromUrdf(model, urdf, pin.GeometryType.COLLISION, package_dirs=[folder])
    geometry.addAllCollisionPairs()
    data, placed = model.createData(), geometry.createData()
    link = [model.frames[item.parentFrame].name for item in geometry.geometryObjects]
    hits: dict[tuple[str, str], int] = {pair: 0 for pair in itertools.combinations(sorted(set(link)), 2)}
    rng = np.random.default_rng(0)
    for q in rng.uniform(model.lowerPositionLimit, model.upperPositionLimit, (SAMPLES, model.nq)):
        pin.computeCollisions(model, data, geometry, placed, q, False)
        touching = {
            tuple(sorted((link[pair.first], link[pair.second])))
            for k, pair in enumerate(geometry.collisionPairs)
            if placed.collisionResults[k].isCollision()
        }
        for pair in touching:
            if pair in hits:
                hits[pair] += 1
    adjacent = _adjacent(model, set(link))
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<robot name="ur5">']
    for pair, count in sorted(hits.items()):
        reason = "Adjacent" if pair in adjacent else {0: "Never", SAMPLES: "Default"}.get(count)
        if reason:
            lines.append(f'    <disable_collisions link1="{pair[0]}" link2="{pair[1]}" reason="{reason}"/>')
    return "\n".join([*lines, "</robot>", ""])


def _adjacent(model: pin.Model, links: set[str]) -> set[tuple[str, str]]:
    """Return the pairs of links with geometry that a joint or a mount connects."""

    def above(frame: pin.Frame) -> str:
        parent = model.frames[frame.parentFrame]
        return parent.name if parent.type == pin.FrameType.BODY and parent.name in links else above(parent)

    bodies = [frame for frame in model.frames if frame.type == pin.FrameType.BODY and frame.name in links]
    return {tuple(sorted((frame.name, above(frame)))) for frame in bodies if frame.name != "ur5_base_link"}


if __name__ == "__main__":
    main()
