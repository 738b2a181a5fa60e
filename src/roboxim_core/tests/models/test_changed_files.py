"""Objects of a library that lives on, whose files change."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from roboxim_core.models.check import check_object
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import visual_parts


def write(folder: Path, name: str, side: float) -> None:
    """Write a box; of glTF the JSON file stays, and only its buffer changes."""
    mesh = trimesh.creation.box((side, side, side))
    if name.endswith(".gltf"):
        files = mesh.export(file_type="gltf")
        for buffer in (key for key in files if key.endswith(".bin")):
            (folder / buffer).write_bytes(files[buffer])
        if not (folder / name).exists():
            (folder / name).write_bytes(files["model.gltf"])
    else:
        mesh.export(folder / name)


@pytest.mark.parametrize("name", ["a.stl", "a.gltf"])
def test_a_changed_mesh_is_read_again(name: str, tmp_path: Path) -> None:
    (tmp_path / "objects").mkdir()
    (tmp_path / "objects" / "it.yaml").write_text(f"name: it\nmesh: {name}\nmass: 0.1\n")
    library, found, digests = ModelLibrary(tmp_path), [], set()
    for side in (0.05, 0.0625):
        write(tmp_path / "objects", name, side)
        model = library.object("it")
        ((visual,),) = (link.visual for link in model.links)
        (part,) = visual_parts(visual)
        hull = trimesh.load_mesh(model.links[0].collision[0].mesh)
        found.append((model.size[0], hull.extents.max(), np.ptp(part.mesh.vertices)))
        digests.add(library.digest("it"))
    assert np.array(found) == pytest.approx(np.array([[0.05] * 3, [0.0625] * 3]))
    assert len(digests) == 2


def test_a_changed_yaml_file_is_read_again_and_an_unchanged_one_is_not(tmp_path: Path) -> None:
    (tmp_path / "objects").mkdir()
    file = tmp_path / "objects" / "it.yaml"
    text = "name: it\nlinks: [{mass: 0.1, collision: [{kind: box, size: [0.05, 0.05, 0.05]}]}]\n"
    file.write_text(text)
    library = ModelLibrary(tmp_path)
    first = library.object("it")
    assert library.object("it") is first
    file.write_text(text.replace("0.1", "0.25"))
    assert library.object("it").links[0].mass == 0.25


def test_a_missing_buffer_or_image_of_gltf_is_named(tmp_path: Path) -> None:
    write(tmp_path, "a.gltf", 0.05)
    for file in tmp_path.glob("*.bin"):
        file.unlink()
    (tmp_path / "it.yaml").write_text("name: it\nmesh: a.gltf\nmass: 0.1\n")
    assert "a.gltf needs the buffer" in check_object(tmp_path / "it.yaml")[0][0].message
