"""Make this folder's URDF, SRDF and meshes from the `example-robot-data` wheel; run it only to renew them.

Needs ``example-robot-data``, ``fast-simplification`` and ``pycollada``::

    python config/robots/panda/derive.py
"""

from __future__ import annotations

import re
import shutil
from collections import defaultdict
from pathlib import Path

import cmeel
import fast_simplification
import numpy as np
import trimesh

HERE = Path(__file__).resolve().parent
SOURCE = Path(cmeel.__path__[0]).parent / "cmeel.prefix/share/example-robot-data/robots/panda_description"
TRIANGLES = 1600
CREASE_RAD = np.radians(32.0)
WHITE = (233, 234, 236)  # the files say 255, which no painted surface reflects
GLOSS = {255: 0.32, 230: 0.42, 64: 0.55}


def decimated(mesh: trimesh.Trimesh, triangles: int) -> trimesh.Trimesh:
    """Return a coarser mesh with vertices split at creases."""
    mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=5)
    if len(mesh.faces) > triangles:
        points, faces = fast_simplification.simplify(
            mesh.vertices.astype(np.float32), mesh.faces, target_count=triangles, agg=4.0
        )
        mesh = trimesh.Trimesh(points, faces, process=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    return trimesh.graph.smooth_shade(mesh, angle=CREASE_RAD)


def visual(source: Path) -> trimesh.Scene:
    """Group a COLLADA file's meshes by colour and decimate each group to its share of the triangles."""
    scene = trimesh.load_scene(source)
    groups: dict[tuple[int, ...], list[trimesh.Trimesh]] = defaultdict(list)
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name].copy()
        color = tuple(int(c) for c in mesh.visual.material.main_color[:3])
        mesh.apply_transform(transform)
        groups[(230, 235, 237) if color == (229, 234, 237) else color].append(
            trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        )
    total = sum(len(m.faces) for group in groups.values() for m in group)
    result = trimesh.Scene()
    for color, meshes in sorted(groups.items(), reverse=True):
        merged = trimesh.util.concatenate(meshes)
        part = decimated(merged, max(60, round(TRIANGLES * len(merged.faces) / total)))
        part.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(
                baseColorFactor=[*(WHITE if color == (255, 255, 255) else color), 255],
                metallicFactor=0.0,
                roughnessFactor=GLOSS.get(color[0], 0.5),
            )
        )
        _ = part.vertex_normals  # computed now so that the file carries them
        result.add_geometry(part, geom_name="color_{:02x}{:02x}{:02x}".format(*color))
    return result


def main() -> None:
    """Write everything."""
    for folder in ("collision", "visual"):
        shutil.rmtree(HERE / folder, ignore_errors=True)
        (HERE / folder).mkdir()
    for source in sorted((SOURCE / "meshes/visual").glob("*.dae")):
        (HERE / "visual" / f"{source.stem}.glb").write_bytes(
            visual(source).export(file_type="glb", include_normals=True)
        )
    for source in sorted((SOURCE / "meshes/collision").glob("*.stl")):
        if source.stem != "finger":  # the fingers are boxes
            trimesh.load_mesh(source).convex_hull.export(HERE / "collision" / source.name)

    urdf = (SOURCE / "urdf/panda.urdf").read_text()
    urdf = urdf.replace("package://example-robot-data/robots/panda_description/meshes/", "package://panda/")
    urdf = urdf.replace(".dae", ".glb").replace("\t", "        ")
    urdf = re.sub(r"\s*<safety_controller[^>]*/>", "", urdf)
    urdf = re.sub(r"<dynamics D=[^>]*/>", '<dynamics damping="0.003" friction="0.0"/>', urdf)
    urdf = re.sub(r"\s*<mimic [^>]*/>", "", urdf)  # the two fingers are coupled by the simulator
    urdf = re.sub(r"<!-- [=|].*?-->\n", "", urdf).replace(' xmlns:xacro="http://www.ros.org/wiki/xacro"', "")
    (HERE / "panda.urdf").write_text(urdf)
    shutil.copy(SOURCE / "srdf/panda.srdf", HERE / "panda.srdf")
    shutil.copy(SOURCE / "LICENSE", HERE / "LICENSE")


if __name__ == "__main__":
    main()
