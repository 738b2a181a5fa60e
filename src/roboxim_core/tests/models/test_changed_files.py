"""Objects of a library that lives on, whose files change."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from roboxim_core.kinematics.volumes import link_volumes
from roboxim_core.models.check import check_object
from roboxim_core.models.description import Visual
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import robot_parts, visual_parts
from roboxim_core.vision.textures import pixels


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


def test_a_changed_image_or_robot_is_read_again(tmp_path: Path) -> None:
    """The image of a material, of a mesh file, and what is drawn of a robot."""
    shown = []
    for grey, side in ((40, 0.1), (200, 0.125)):
        write(tmp_path, "a.stl", side)
        Image.new("RGB", (2, 2), (grey,) * 3).save(tmp_path / "skin.png", compress_level=grey // 40)
        (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd skin.png\n")
        (tmp_path / "a.obj").write_text("mtllib a.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n")
        (tmp_path / "r.urdf").write_text(
            '<robot name="r"><link name="a"><visual><geometry><mesh filename="a.stl"/></geometry></visual></link>'
            f'<link name="{side}"/></robot>'
        )
        (part,) = visual_parts(Visual(kind="mesh", mesh=str(tmp_path / "a.obj")))
        (link,) = robot_parts(tmp_path / "r.urdf", "linear")["a"]
        images = [pixels(name)[0, 0, 0] for name in (str(tmp_path / "skin.png"), part.material.texture)]
        shown.append((*images, np.ptp(link.mesh.vertices, axis=0)[0]))
    assert all(before != after for before, after in zip(*shown, strict=True))
    assert shown[1][2] == pytest.approx(0.125)


def test_a_changed_robot_is_read_again_and_one_of_the_same_name_is_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = ModelLibrary().path("robots", "ur5e")
    (tmp_path / "robots").mkdir()
    file = tmp_path / "robots" / "ur5e.yaml"
    text = shipped.read_text().replace(": ur5e/", f": {shipped.parent}/ur5e/")
    file.write_text(text)
    library, first = ModelLibrary(tmp_path), link_volumes("ur5e")
    before = library.robot("ur5e")
    assert library.robot("ur5e") is before
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))
    own = link_volumes("ur5e")
    file.write_text(text.replace("position_gain: 0.3", "position_gain: 0.25"))
    assert (before.position_gain, library.robot("ur5e").position_gain) == (0.3, 0.25)
    assert len({first, own, link_volumes("ur5e")}) == 3
