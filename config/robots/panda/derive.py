"""Make this folder's URDF, SRDF and meshes from the `example-robot-data` wheel: ``make robot-visuals``.

``--check`` writes nothing and says which visual meshes are not what would be made.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from collections import defaultdict
from pathlib import Path

import cmeel
import fast_simplification
import numpy as np
import trimesh

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from collada import read_collada  # noqa: E402

SOURCE = Path(cmeel.__path__[0]).parent / "cmeel.prefix/share/example-robot-data/robots/panda_description"
TRIANGLES, FINGER_TRIANGLES = 1130, 400
"""Of a link; 11,000 in all, so that a renderer without a GPU has time for other things."""
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
    groups: dict[tuple[int, ...], list[trimesh.Trimesh]] = defaultdict(list)
    for color, mesh in read_collada(source):
        groups[(230, 235, 237) if color == (229, 234, 237) else color].append(mesh)
    target = FINGER_TRIANGLES if source.stem == "finger" else TRIANGLES
    total = sum(len(m.faces) for group in groups.values() for m in group)
    result = trimesh.Scene()
    for color, meshes in sorted(groups.items(), reverse=True):
        merged = trimesh.util.concatenate(meshes)
        part = decimated(merged, max(60, round(target * len(merged.faces) / total)))
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


def stale() -> list[str]:
    """Return the visual meshes whose triangles are not those that would be made."""

    def count(scene: trimesh.Scene) -> dict[str, int]:
        return {name: len(mesh.faces) for name, mesh in scene.geometry.items()}

    files = {
        source: HERE / "visual" / f"{source.stem}.glb" for source in sorted((SOURCE / "meshes/visual").glob("*.dae"))
    }
    return [
        file.name
        for source, file in files.items()
        if not file.is_file() or count(visual(source)) != count(trimesh.load_scene(file, process=False))
    ]


def main() -> int:
    """Write everything, or check."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 when a visual mesh is stale")
    if parser.parse_args().check:
        print("stale:", *(names := stale() or ["none"]))  # noqa: T201
        return int(names != ["none"])
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
    return 0


if __name__ == "__main__":
    sys.exit(main())
