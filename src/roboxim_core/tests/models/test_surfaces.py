"""Colours, surfaces, units and orientation of mesh files of other writers."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from roboxim_core.errors import ConfigError
from roboxim_core.models.check import check_object
from roboxim_core.models.description import Visual
from roboxim_core.models.hulls import hull_file, load_mesh
from roboxim_core.models.modifiers import PALETTE
from roboxim_core.models.surfaces import MOST_COLORS
from roboxim_core.models.visuals import robot_parts, visual_parts
from roboxim_core.vision.renderer import VisualPart
from roboxim_core.vision.srgb import to_linear
from roboxim_core.vision.textures import pixels


def box(**material: Any) -> trimesh.Trimesh:
    mesh = trimesh.creation.box((0.1, 0.2, 0.3))
    if material:
        uv = np.tile([0.25, 0.5], (len(mesh.vertices), 1))
        mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=PBRMaterial(**material))
    return mesh


def parts_of(file: Path, **changes: Any) -> tuple[VisualPart, ...]:
    return visual_parts(Visual(kind="mesh", mesh=str(file), **changes))


@pytest.mark.parametrize("word", PALETTE)
def test_a_colour_factor_of_gltf_is_linear(word, tmp_path):
    box(baseColorFactor=[*to_linear(PALETTE[word]), 1.0]).export(tmp_path / "a.glb")
    (part,) = parts_of(tmp_path / "a.glb")
    assert part.material.color == pytest.approx(PALETTE[word], abs=0.015)  # trimesh keeps 8 bits


def test_a_colour_of_collada_and_obj_is_srgb(tmp_path):
    mesh = box(baseColorFactor=[200, 100, 50, 255])
    for name in ("a.dae", "a.obj"):
        mesh.export(tmp_path / name)
        (part,) = parts_of(tmp_path / name)
        assert part.material.color == pytest.approx((200 / 255, 100 / 255, 50 / 255), abs=0.003)


def test_the_glb_files_of_a_robot_are_read_as_it_declares(tmp_path):
    box(baseColorFactor=[128, 128, 128, 255]).export(tmp_path / "a.glb")
    mesh = '<visual><geometry><mesh filename="a.glb" scale="2 2 2"/></geometry></visual>'
    (tmp_path / "r.urdf").write_text(f'<robot name="r"><link name="a">{mesh}</link></robot>')
    found = {how: robot_parts(tmp_path / "r.urdf", how)["a"][0] for how in ("srgb", "linear")}
    assert found["srgb"].material.color == pytest.approx([128 / 255] * 3)
    assert found["linear"].material.color == pytest.approx([0.736] * 3, abs=1e-3)
    assert np.ptp(found["srgb"].mesh.vertices, axis=0) == pytest.approx([0.2, 0.4, 0.6])


def test_textures_of_metalness_and_roughness_count(tmp_path):
    pixels = np.zeros((2, 4, 3), np.uint8)
    pixels[:, :, 1], pixels[:, 1, 2] = 204, 51  # the texture's column of the box's coordinates is metallic by 0.2
    box(metallicRoughnessTexture=Image.fromarray(pixels), roughnessFactor=0.5).export(tmp_path / "a.glb")
    (part,) = parts_of(tmp_path / "a.glb")
    assert (part.material.metallic, part.material.roughness) == pytest.approx((0.2, 0.4))


@pytest.mark.parametrize("name", ["a.ply", "a.glb"])
def test_colours_at_vertices_become_parts(name, tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=3)
    given = np.where(mesh.vertices[:, 2:] > 0.3, [200, 40, 30], [20, 60, 180])
    stored = np.rint(255 * to_linear(given / 255)) if name == "a.glb" else given
    mesh.visual.vertex_colors = stored.astype(np.uint8)
    mesh.export(tmp_path / name)
    parts = parts_of(tmp_path / name)
    assert sum(len(part.mesh.faces) for part in parts) == len(mesh.faces)
    large = sorted(parts, key=lambda part: len(part.mesh.faces))[-2:]
    expected = [(200 / 255, 40 / 255, 30 / 255), (20 / 255, 60 / 255, 180 / 255)]
    for part, color, side in zip(large, expected, (1, -1), strict=True):
        assert part.material.color == pytest.approx(color, abs=0.02)
        assert (side * (part.mesh.vertices[:, 2] - 0.3) > -1e-6).all()


def test_many_colours_become_few(tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=3)
    mesh.visual.vertex_colors = (127.5 * (mesh.vertices + 1)).astype(np.uint8)
    mesh.export(tmp_path / "a.ply")
    parts = parts_of(tmp_path / "a.ply")
    assert 8 < len(parts) <= MOST_COLORS
    for part in parts:
        middle = part.mesh.vertices[part.mesh.faces].mean(axis=(0, 1)) / 2 + 0.5
        assert part.material.color == pytest.approx(middle, abs=0.15)


@pytest.mark.parametrize("scale", [(1.0, -1.0, 1.0), (-0.5, -1.0, -2.0), (-1.0, -1.0, 1.0)])
def test_a_mirrored_mesh_is_not_inside_out(scale, tmp_path):
    box().export(tmp_path / "a.stl")
    (part,) = parts_of(tmp_path / "a.stl", scale=scale)
    solid = trimesh.Trimesh(part.mesh.vertices, part.mesh.faces, process=False)
    assert solid.volume == pytest.approx(0.006 * abs(np.prod(scale)), rel=1e-4)
    assert (np.einsum("ij,ij->i", part.mesh.normals, part.mesh.vertices) > 0).all()


def test_the_unit_of_a_collada_file_counts(tmp_path):
    box().export(tmp_path / "m.dae")
    text = (tmp_path / "m.dae").read_text()
    inch = re.sub(r"(<up_axis>)", r'<unit name="inch" meter="0.0254"/>\1', text)
    (tmp_path / "inch.dae").write_text(inch)
    assert load_mesh(tmp_path / "m.dae").extents == pytest.approx([0.1, 0.2, 0.3])
    assert load_mesh(tmp_path / "inch.dae").extents == pytest.approx([0.00254, 0.00508, 0.00762])
    (part,) = parts_of(tmp_path / "inch.dae")
    assert np.ptp(part.mesh.vertices, axis=0) == pytest.approx([0.00254, 0.00508, 0.00762])
    assert trimesh.load_mesh(hull_file(str(tmp_path / "inch.dae"))).extents.max() == pytest.approx(0.00762)


def test_colours_at_vertices_beside_a_material_multiply_it(tmp_path):
    """As Blender writes them, with 16 bits."""
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    mesh.visual.vertex_colors = np.tile([0, 255, 0, 255], (8, 1)).astype(np.uint8)
    files = mesh.export(file_type="gltf")
    content = json.loads(files["model.gltf"])
    (primitive,) = content["meshes"][0]["primitives"]
    primitive["material"] = 0
    color = content["accessors"][primitive["attributes"]["COLOR_0"]]
    color["componentType"] = 5123
    view = content["bufferViews"][color["bufferView"]]
    name = content["buffers"][view["buffer"]]["uri"]
    files[name] = np.tile([0, 65535, 0, 65535], (8, 1)).astype("<u2").tobytes()
    view["byteLength"] = content["buffers"][view["buffer"]]["byteLength"] = len(files[name])
    content["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [1.0, 0.5, 1.0, 1.0]}}]
    files["model.gltf"] = json.dumps(content).encode()
    for file, data in files.items():
        (tmp_path / file).write_bytes(data)
    (part,) = parts_of(tmp_path / "model.gltf")
    assert part.material.color == pytest.approx((0.0, 0.736, 0.0), abs=0.01)


def test_the_size_of_a_mirrored_mesh_is_checked_as_that_of_any(tmp_path):
    box().export(tmp_path / "a.stl")
    shape = "{kind: box, size: [0.1, 0.2, 0.3]}"
    visual = "{kind: mesh, mesh: a.stl, scale: [-1, -1, -1]}"
    (tmp_path / "it.yaml").write_text(f"name: it\nlinks: [{{mass: 2.0, collision: [{shape}], visual: [{visual}]}}]\n")
    assert [finding.message for finding in check_object(tmp_path / "it.yaml")[0] if finding.severity == "error"] == []


def test_an_image_in_a_folder_of_any_name_is_found(tmp_path):
    folder = tmp_path / "C# ä"
    folder.mkdir()
    box(baseColorTexture=Image.new("RGB", (4, 4), (255, 0, 0))).export(folder / "a b.glb")
    (part,) = parts_of(folder / "a b.glb")
    assert (pixels(part.material.texture) == [255, 0, 0]).all()


@pytest.mark.parametrize(
    ("value", "drawn"),
    [
        ("wood.png", True), ("-s 1 1 1 wood.png", True), ("-blendu on -clamp off -bm 1.0 wood.png", True),
        ("-o 0 0 0 -s 1 1 a wood.png", True), ("..\\up.png", True), ("../up.png", True),
        ("-s 2 2 1 wood.png", False), ("-o 0.5 0 wood.png", False), ("-t 0 0.1 0 wood.png", False),
    ],
)  # fmt: skip
def test_options_of_an_obj_materials_image_are_read_or_refused(value, drawn, tmp_path):
    folder = tmp_path / "meshes"
    folder.mkdir()
    for file in (folder / "wood.png", folder / "a wood.png", tmp_path / "up.png"):
        Image.new("RGB", (2, 2), (255, 0, 0)).save(file)
    (folder / "a.mtl").write_text(f"newmtl m\nKd 0 1 0\nmap_Kd {value}\n")
    (folder / "a.obj").write_text("mtllib a.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n")
    if not drawn:
        with pytest.raises(
            ConfigError, match=r"a\.obj places an image by map_Kd -\w .*, which is not drawn; apply this"
        ):
            parts_of(folder / "a.obj")
        return
    (part,) = parts_of(folder / "a.obj")
    assert (pixels(part.material.texture) == [255, 0, 0]).all()
    (folder / "it.yaml").write_text("name: it\nmesh: a.obj\nmass: 0.1\n")
    assert not [found for found in check_object(folder / "it.yaml")[0] if "no such file" in found.message]


@pytest.mark.parametrize("suffix", ["glb", "gltf"])
@pytest.mark.parametrize(
    ("texture", "said"),
    [
        ({}, ""),
        ({"extensions": {"KHR_texture_transform": {"offset": [0, 0], "scale": [1.0, 1.0]}}}, ""),
        ({"extensions": {"KHR_texture_transform": {"scale": [2, 1]}}}, "'wood' that moves its baseColorTexture"),
        ({"extensions": {"KHR_texture_transform": {"rotation": 0.5}}}, "'wood' that moves its baseColorTexture"),
        ({"texCoord": 1}, "'wood' whose baseColorTexture has coordinates of its own"),
    ],
)
def test_a_texture_that_gltf_moves_is_refused(suffix, texture, said, tmp_path):
    def change(tree):
        tree["materials"][0]["name"] = "wood"
        tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] |= texture

    scene = box(baseColorTexture=Image.new("RGB", (4, 4), (255, 0, 0))).scene()
    written = scene.export(file_type=suffix, tree_postprocessor=change)
    for name, data in ({f"model.{suffix}": written} if suffix == "glb" else written).items():
        (tmp_path / name).write_bytes(data)
    if said:
        with pytest.raises(ConfigError, match=f"a material {said}"):
            parts_of(tmp_path / f"model.{suffix}")
    else:
        assert parts_of(tmp_path / f"model.{suffix}")[0].material.texture


@pytest.mark.parametrize(
    ("material", "transparent"),
    [
        ({"alphaMode": "BLEND", "baseColorFactor": [255, 0, 0, 128]}, True),
        ({"alphaMode": "MASK", "baseColorTexture": Image.new("RGBA", (2, 2), (255, 0, 0, 0))}, True),
        ({"alphaMode": "BLEND", "baseColorFactor": [255, 0, 0, 255]}, False),
        ({"alphaMode": "BLEND", "baseColorTexture": Image.new("RGBA", (2, 2), (255, 0, 0, 255))}, False),
        ({"baseColorFactor": [255, 0, 0, 128]}, False),
    ],
)
def test_what_is_transparent_is_refused(material, transparent, tmp_path):
    box(name="glass", **material).export(tmp_path / "a.glb")
    if transparent:
        with pytest.raises(ConfigError, match=r"a\.glb has a transparent material 'glass' .*make it OPAQUE"):
            parts_of(tmp_path / "a.glb")
    else:
        assert len(parts_of(tmp_path / "a.glb")) == 1
