"""Generate this folder's URDF, SRDF and meshes from the `example-robot-data` wheel: ``make robot-visuals``.

``--check`` writes nothing and lists the visual meshes that differ from the generated ones.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from pathlib import Path

import cmeel
import trimesh

from roboxim_runs.robots.convex_parts import around, convex_parts
from roboxim_runs.robots.decimation import visual

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from dae import read_collada  # noqa: E402 - in the parent folder

SOURCE = Path(cmeel.__path__[0]).parent / "cmeel.prefix/share/example-robot-data/robots/panda_description"
TRIANGLES, FINGER_TRIANGLES = 1130, 400
"""Triangles of a link; 11,000 in all, which a renderer without a GPU can draw in time."""


def drawn(source: Path) -> trimesh.Scene:
    """Return the decimated meshes of a link."""
    return visual(read_collada(source), triangles=FINGER_TRIANGLES if source.stem == "finger" else TRIANGLES)


def stale() -> list[str]:
    """Return the visual meshes whose triangles differ from the generated ones."""

    def count(scene: trimesh.Scene) -> dict[str, int]:
        return {name: len(mesh.faces) for name, mesh in scene.geometry.items()}

    sources = sorted((SOURCE / "meshes/visual").glob("*.dae"))
    files = {source: HERE / "visual" / f"{source.stem}.glb" for source in sources}
    return [
        file.name
        for source, file in files.items()
        if not file.is_file() or count(drawn(source)) != count(trimesh.load_scene(file, process=False))
    ]


def forearm_parts() -> list[trimesh.Trimesh]:
    """Return convex parts of the forearm's visual mesh: its collision mesh fills the hollow under the bend."""
    meshes = [mesh for _, mesh in read_collada(SOURCE / "meshes/visual/link5.dae")]
    drawn_one = trimesh.util.concatenate([trimesh.Trimesh(mesh.vertices, mesh.faces) for mesh in meshes])
    return [around(part.vertices) for part in convex_parts(drawn_one, min_gain=0.02, max_parts=4)]


def main() -> int:
    """Write all files, or check the visual meshes."""
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
            drawn(source).export(file_type="glb", include_normals=True)
        )
    for source in sorted((SOURCE / "meshes/collision").glob("*.stl")):
        if source.stem != "finger":  # the fingers are boxes
            trimesh.load_mesh(source).convex_hull.export(HERE / "collision" / source.name)
    for k, part in enumerate(forearm_parts(), start=1):
        part.export(HERE / "collision" / f"link5_{k}.stl")

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
