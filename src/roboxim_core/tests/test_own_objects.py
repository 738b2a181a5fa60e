"""Objects as others hand them in: URDFs of ROS packages, meshes of other formats and encodings."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from roboxim_core.errors import ConfigError
from roboxim_core.models.check import check_object
from roboxim_core.models.hulls import load_mesh
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import PALETTE
from roboxim_core.models.urdf import mesh_path, urdf_object
from roboxim_core.models.visuals import visual_parts
from roboxim_core.specs import MaterialSpec
from roboxim_core.vision.textures import pixels

URDF = """<?xml version="1.0"?>
<robot name="box" xmlns:xacro="http://www.ros.org/wiki/xacro"><link name="base">
<inertial><mass value="{mass}"/></inertial>
<visual><origin xyz="0 0 {z}"/><geometry><mesh filename="{mesh}"/></geometry></visual>
<collision><origin xyz="0 0 {z}"/><geometry><mesh filename="{mesh}"/></geometry></collision></link>{more}</robot>
"""
DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="1"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" count="24">{numbers}</float_array>
<technique_common><accessor source="#a" count="8" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/><p>{indices}</p></triangles></mesh></geometry>
</library_geometries>
<library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>
"""


def box() -> trimesh.Trimesh:
    return trimesh.creation.box((0.04, 0.04, 0.04))


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Return the folder of a ROS package with a mesh."""
    folder = tmp_path / "my_objects"
    (folder / "meshes").mkdir(parents=True)
    (folder / "urdf").mkdir()
    box().export(folder / "meshes" / "box.stl")
    return folder


def written(package: Path, *, mass="0.05", z="0", mesh="../meshes/box.stl", more="", yaml="") -> Path:
    (package / "urdf" / "box.urdf").write_text(URDF.format(mass=mass, z=z, mesh=mesh, more=more))
    (package / "urdf" / "box.yaml").write_text(f"name: box\nurdf: box.urdf\n{yaml}")
    return package / "urdf" / "box.yaml"


def errors(file: Path) -> list[str]:
    return [finding.message for finding in check_object(file)[0] if finding.severity == "error"]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"mass": "${mass}"}, r"a xacro that is not expanded, it has '\${mass}'; expand it: xacro box.urdf"),
        ({"z": "${height/2}"}, "a xacro that is not expanded"),
        ({"mesh": "$(find my_objects)/meshes/box.stl"}, "a xacro that is not expanded"),
        ({"more": '<xacro:include filename="a.xacro"/>'}, "it has 'xacro:include'"),
        ({"mass": "0,1"}, "<mass> must be a number, with a point for decimals, got '0,1'"),
        ({"mass": "nan"}, "<mass> must be a number of at most"),
        ({"mass": "-1"}, "<mass> must not be below 0"),
        ({"z": "0 0"}, "<origin> xyz must be three numbers"),
        ({"more": '<link name="base"/>'}, "several links of one name"),
        (
            {
                "more": '<link name="b"><visual><geometry><box size="1 1 1"/></geometry><material name="m">'
                '<color rgba="255 0 0 1"/></material></visual></link>'
            },
            "<color> rgba must be numbers from 0 to 1, got '255 0 0 1'",
        ),
    ],
)
def test_a_urdf_that_is_none_is_refused_by_name(package, change, complaint):
    [message] = errors(written(package, **change))
    assert re.search(complaint, message), message
    with pytest.raises(ConfigError, match=complaint):
        urdf_object(package / "urdf" / "box.urdf")


def test_a_namespace_of_xacro_alone_is_no_xacro(package):
    assert errors(written(package)) == []


def test_packages_are_found_in_the_folder_layout_of_ros(package, tmp_path, monkeypatch):
    urdf, mesh = package / "urdf" / "box.urdf", package / "meshes" / "box.stl"
    assert errors(written(package, mesh="package://my_objects/meshes/box.stl")) == []
    assert mesh_path(f"file://{mesh}", urdf) == mesh
    (package / "package.xml").write_text("<package><name>other_name</name></package>")
    assert mesh_path("package://other_name/meshes/box.stl", urdf) == mesh
    (tmp_path / "share").mkdir()
    (tmp_path / "share" / "installed").symlink_to(package)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    assert mesh_path("package://installed/meshes/box.stl", urdf) == mesh
    assert "no such file" in errors(written(package, mesh="package://absent/meshes/box.stl"))[0]


def test_mass_beside_a_urdf_is_used_or_refused(package):
    file = written(package, mass="0", yaml="mass: 0.05\n")
    assert errors(file) == []
    _, model = check_object(file)
    assert model.links[0].mass == 0.05
    assert "masses come from the urdf; leave `mass` out" in errors(written(package, yaml="mass: 0.06\n"))[0]
    assert "mesh_scale is the scale of `mesh`" in errors(written(package, yaml="mesh_scale: 3.0\n"))[0]
    assert "<inertial><mass" in errors(written(package, mass="0"))[0]


def test_a_collada_mesh_is_read(package):
    mesh = box()
    text = DAE.format(numbers=" ".join(map(str, mesh.vertices.ravel())), indices=" ".join(map(str, mesh.faces.ravel())))
    (package / "meshes" / "box.dae").write_text(text)
    assert load_mesh(package / "meshes" / "box.dae").volume == pytest.approx(0.04**3)
    assert errors(written(package, mesh="package://my_objects/meshes/box.dae")) == []


def test_an_obj_of_another_encoding_is_read(package):
    text = "# Würfel\no Größe\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in box().vertices)
    text += "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in box().faces)
    for encoding in ("latin-1", "cp1252", "utf-8"):
        file = package / "meshes" / f"{encoding}.obj"
        file.write_bytes(text.encode(encoding))
        assert np.allclose(np.ptp(load_mesh(file).bounds, axis=0), 0.04)


@pytest.mark.parametrize(
    ("vertices", "said"),
    [
        ("v 0\nv 1\nv 2\n", "vertices of 1 numbers, expected 3"),
        ("v 0 0 0\nv 0.05 0 0\nv 0.1 0 0\n", "no surface: all triangles are lines"),
    ],
)
def test_a_mesh_without_a_surface_is_a_finding(tmp_path: Path, vertices: str, said: str) -> None:
    (tmp_path / "own.obj").write_text(vertices + "f 1 2 3\n")
    (tmp_path / "own.yaml").write_text(
        "name: own\nlinks:\n- mass: 0.1\n  collision: [{kind: box, size: [0.1, 0.1, 0.1]}]\n"
        "  visual: [{kind: mesh, mesh: own.obj}]\n"
    )
    findings, _ = check_object(tmp_path / "own.yaml")
    assert any(said in finding.message for finding in findings), findings


def test_a_fixed_joint_needs_no_axis_and_a_link_names_the_material_of_another(package):
    """Exporters write the axis 0 0 0 for fixed joints; ROS takes a material that any link defines by its name."""
    shape = '<visual><geometry><box size="1 1 1"/></geometry><material name="mine">{}</material></visual>'
    one, other = shape.format('<color rgba="0.1 0.2 0.3 1"/>'), shape.format("")
    joint = '<joint name="f" type="fixed"><parent link="base"/><child link="b"/><axis xyz="0 0 0"/></joint>'
    written(package, more=f'<link name="b">{one}</link>{joint}<link name="c">{other}</link>' + joint.replace(
        'name="f"', 'name="g"').replace('"b"', '"c"'))  # fmt: skip
    ((link,), _) = urdf_object(package / "urdf" / "box.urdf")
    assert [visual.material.color for visual in link.visual[1:]] == [(0.1, 0.2, 0.3)] * 2


def test_the_image_of_a_material_is_its_texture_and_must_exist(package):
    """As in RViz, an image stands in place of the colour; `package://` names it, and a link may name the material."""
    mine = '<color rgba="1 0 0 1"/><texture filename="package://my_objects/meshes/print.png"/>'
    shape = '<visual><geometry><box size="1 1 1"/></geometry><material name="mine">{}</material></visual>'
    joint = '<joint name="f" type="fixed"><parent link="base"/><child link="b"/></joint>'
    written(package, more=f'<link name="b">{shape.format(mine)}{shape.format("")}</link>{joint}')
    file = package / "urdf" / "box.urdf"
    with pytest.raises(ConfigError, match=r"material 'mine' needs the <texture> .*print\.png: no such file"):
        urdf_object(file)
    Image.new("RGB", (4, 4), (0, 0, 255)).save(package / "meshes" / "print.png")
    ((link,), _) = urdf_object(file)
    for visual in link.visual[1:]:
        assert visual.material == MaterialSpec(color=(1, 1, 1), texture=str(package / "meshes" / "print.png"))
        assert pixels(visual.material.texture)[0, 0].tolist() == [0, 0, 255]


@pytest.mark.parametrize(
    ("shapes", "visual", "said"),
    [
        (17 * ["sphere, size: [0.02]"], "", "17 collision shapes other than boxes and rings, PyBullet takes 16"),
        ([*16 * ["sphere, size: [0.02]"], "box, size: [0.02, 0.02, 0.02]"], "", "16 collision shapes .* takes 15"),
        (["sphere, size: [0.02]"], "lathe, size: [0, -0.02, 0.02, 0, 0.02, 0, 0, 0.02]", "points 2 and 3 are the same"),
        (["sphere, size: [0.02]"], "tube, size: [0, 0, 0, 0.02, 0, 0, 0, 0.01]", "points 1 and 2 are the same"),
    ],
)
def test_shapes_that_cannot_be_simulated_or_drawn_are_errors(package, shapes, visual, said):
    file = package / "it.yaml"
    drawn = f", visual: [{{kind: {visual}}}]" if visual else ""
    collision = ", ".join(f"{{kind: {shape}}}" for shape in shapes)
    file.write_text(f"name: it\nlinks: [{{mass: 0.05, collision: [{collision}]{drawn}}}]\n")
    assert any(re.search(said, message) for message in errors(file)), errors(file)


@pytest.mark.parametrize("source", ["mesh: meshes/box.stl\nmass: 0.05", "urdf: urdf/box.urdf"])
def test_colors_and_materials_change_the_look_of_meshes_and_urdfs(package, source):
    written(package)
    (package / "objects").mkdir()
    text = source.replace(": ", ": ../", 1)
    (package / "objects" / "it.yaml").write_text(
        f"name: it\n{text}\nmodifiers: {{color: {{default: red}}, material: {{default: plastic}}}}\n"
    )
    library = ModelLibrary(package)

    def seen(**modifiers: str) -> MaterialSpec:
        [part] = visual_parts(library.object("it", modifiers).links[0].visual[0])
        return part.material

    assert seen().color == PALETTE["red"]
    assert seen(color="blue").color == PALETTE["blue"]
    assert seen(material="metal").metallic == 1.0


def test_a_material_modifier_keeps_a_meshs_own_look_by_default(package):
    mesh = box()
    mesh.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(metallicFactor=0.25))
    mesh.export(package / "meshes" / "box.glb")
    file = package / "it.yaml"
    file.write_text("name: it\nmesh: meshes/box.glb\nmass: 0.05\nmodifiers: {material: {default: plastic}}\n")
    _, model = check_object(file)
    assert visual_parts(model.links[0].visual[0])[0].material.metallic == 0.25


def test_a_color_modifier_without_a_tinted_visual_is_refused(package):
    file = package / "it.yaml"
    shape = "{kind: box, size: [0.04, 0.04, 0.04]}"
    file.write_text(
        f"name: it\nlinks: [{{mass: 0.05, collision: [{shape}], visual: [{shape}]}}]\n"
        "modifiers: {color: {default: red}}\n"
    )
    assert "no visual of `links` has it" in errors(file)[0]
