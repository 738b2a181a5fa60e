"""Meshes become objects: repaired, cut into convex parts, standing, with grasps that have held."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from click.testing import CliRunner

from roboxim_cli.main import group
from roboxim_core.errors import ConfigError
from roboxim_core.models.check import check_object
from roboxim_core.models.description import Visual
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import PALETTE
from roboxim_core.models.visuals import visual_parts
from roboxim_core.poses import Pose
from roboxim_core.vision.srgb import to_linear
from roboxim_runs.assets.check import simplify, turned
from roboxim_runs.assets.floating_gripper import floating
from roboxim_runs.assets.floating_hand import try_grasp
from roboxim_runs.assets.grasp_search import antipodal_pairs
from roboxim_runs.assets.importing import ImportOptions, guessed_unit, import_mesh, object_id_of
from roboxim_runs.assets.shape_affordances import regions_of
from roboxim_runs.assets.solids import EFFORTS, convex_parts, placed, repaired
from roboxim_sim.bullet import BulletClient

pytest.importorskip("coacd")


def bowl() -> trimesh.Trimesh:
    """Return an open bowl: 12 cm across, walls of 6 mm."""
    profile = [[0.0, 0.0], [0.04, 0.0], [0.06, 0.05], [0.054, 0.05], [0.037, 0.006], [0.0, 0.006]]
    return trimesh.creation.revolve(np.array(profile), sections=48)


def corner() -> trimesh.Trimesh:
    """Return an L of two boxes that overlap."""
    one, other = trimesh.creation.box((0.09, 0.03, 0.03)), trimesh.creation.box((0.03, 0.03, 0.07))
    other.apply_translation((0.03, 0.0, 0.02))
    return trimesh.util.concatenate([one, other])


def exported(mesh: trimesh.Trimesh, file: Path, scale: float = 1.0) -> Path:
    mesh.apply_scale(scale)
    mesh.export(file)
    return file


@pytest.mark.thorough
def test_a_mesh_in_millimetres_becomes_an_object_without_a_defect(tmp_path):
    file = exported(corner(), tmp_path / "Corner Piece.stl", 1000.0)
    made = import_mesh(file, tmp_path / "objects", ImportOptions(mass_kg=0.07, grasps=2))
    assert made.file == tmp_path / "objects" / "corner_piece.yaml"
    assert made.graspable
    found, model = check_object(made.file)
    assert found == ()
    assert np.allclose(sorted(model.size), [0.03, 0.07, 0.09], atol=2e-3)
    assert model.links[0].mass == 0.07
    assert len(model.links[0].collision) >= 2
    assert sorted(path.name for path in (tmp_path / "objects").iterdir()) == [
        "corner_piece.glb", "corner_piece.yaml", "corner_piece_parts",
    ]  # fmt: skip
    text = made.file.read_text()
    assert "unit: mm (guessed" in text
    assert "joined into one closed surface" in text


@pytest.mark.thorough
def test_an_object_that_cannot_stand_as_in_its_file_is_turned(tmp_path):
    leaning = trimesh.creation.box((0.04, 0.05, 0.12))
    leaning.apply_transform(trimesh.transformations.rotation_matrix(0.6, (1, 0, 0)))
    made = import_mesh(exported(leaning, tmp_path / "block.obj"), tmp_path / "objects", ImportOptions(grasps=1))
    assert any("does not stand as in the file" in line for line in made.report)
    assert check_object(made.file)[0] == ()
    assert np.allclose(sorted(made.size_m), [0.04, 0.05, 0.12], atol=1e-3)


@pytest.mark.thorough
def test_a_hollow_a_top_and_neither_are_told_apart():
    hollow = regions_of(convex_parts(bowl(), EFFORTS["thorough"]))
    assert [region.kind for region in hollow] == ["interior"]
    assert 0.05 < hollow[0].size[0] < 0.09
    assert 0.03 < hollow[0].size[2] < 0.05
    box, ball = trimesh.creation.box((0.08, 0.06, 0.03)), trimesh.creation.icosphere(radius=0.03)
    (top,) = regions_of([box])
    assert (top.kind, top.pose.position[2]) == ("surface", 0.015)
    assert 0.05 < top.size[0] < 0.06
    assert regions_of([ball]) == []


def test_the_materials_of_an_obj_file_are_those_of_its_glb(tmp_path):
    """Two materials and no metal: the factors of a GLB are linear, and metallic is 1 where a GLB states nothing."""
    given = {"red": (0.8, 0.1, 0.05), "grey": (0.25, 0.25, 0.25)}
    (tmp_path / "m.mtl").write_text("".join(f"newmtl {name}\nKd {r} {g} {b}\n" for name, (r, g, b) in given.items()))
    lines, first = ["mtllib m.mtl"], 1
    for name, x in zip(given, (0.0, 0.2), strict=True):
        box = trimesh.creation.box((0.1, 0.1, 0.1))
        box.apply_translation((x, 0, 0))
        lines += [f"usemtl {name}", *("v {} {} {}".format(*point) for point in box.vertices)]
        lines += ["f {} {} {}".format(*(face + first)) for face in box.faces]
        first += len(box.vertices)
    (tmp_path / "two.obj").write_text("\n".join(lines) + "\n")
    scene, _ = placed(tmp_path / "two.obj", 1.0, "z")
    (tmp_path / "placed.glb").write_bytes(scene.export(file_type="glb"))
    simplify(tmp_path / "two.obj", 12, tmp_path / "simple.glb")
    for file in ("two.obj", "placed.glb", "simple.glb", turned(tmp_path / "two.obj").name):
        parts = visual_parts(Visual(kind="mesh", mesh=str(tmp_path / file)))
        found = sorted(part.material.color for part in parts)
        assert found == [pytest.approx(color, abs=0.02) for color in sorted(given.values())], file
        assert {part.material.metallic for part in parts} == {0.0}, file


def test_a_simpler_mesh_keeps_the_colours_of_its_vertices(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=4)
    ball.visual.vertex_colors = np.where(ball.vertices[:, 2:] > 0, [200, 40, 30, 255], [20, 60, 180, 255]).astype(
        np.uint8
    )
    simplify(exported(ball, tmp_path / "ball.ply"), 300, tmp_path / "ball.glb")
    parts = visual_parts(Visual(kind="mesh", mesh=str(tmp_path / "ball.glb")))
    assert len(parts) > 1
    for part in parts:
        height = part.mesh.vertices[part.mesh.faces].mean(axis=1)[:, 2]
        if abs(height.mean()) > 0.1:
            assert (part.material.color[0] > part.material.color[2]) == (height.mean() > 0)


@pytest.mark.thorough
def test_the_colour_of_a_glb_file_becomes_its_word(tmp_path):
    box = trimesh.creation.box((0.05, 0.05, 0.05))
    color = [*to_linear(PALETTE["brown"]), 1.0]
    box.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(baseColorFactor=color))
    made = import_mesh(exported(box, tmp_path / "it.glb"), tmp_path / "objects", ImportOptions(grasps=1, tries=1))
    assert yaml.safe_load(made.file.read_text())["modifiers"] == {"color": {"default": "brown"}}


@pytest.mark.parametrize("broken", ["inside out", "hole", "whole"])
def test_a_surface_is_closed_and_points_outwards(broken):
    mesh = trimesh.creation.box((0.05, 0.04, 0.03))
    if broken == "inside out":
        mesh.invert()
    if broken == "hole":
        mesh.update_faces(np.arange(len(mesh.faces)) != 3)
    solid, said = repaired(mesh)
    assert solid.is_volume
    assert solid.volume == pytest.approx(6e-5)
    assert bool(said) == (broken != "whole")


def test_antipodal_pairs_of_a_plate_are_across_its_narrow_side():
    pairs = antipodal_pairs(trimesh.creation.box((0.2, 0.05, 0.03)), 0.07)
    way = np.abs(pairs[:, 1] - pairs[:, 0])
    assert len(pairs) > 50
    assert np.allclose(way[:, 1], 0.05, atol=1e-6)


def test_what_cannot_be_imported_is_named_and_leaves_nothing(tmp_path):
    flat = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], [[0, 1, 2]])
    with pytest.raises(ConfigError, match="flat"):
        import_mesh(exported(flat, tmp_path / "flat.stl"), tmp_path / "objects")
    (tmp_path / "broken.obj").write_text("nothing")
    with pytest.raises(ConfigError, match="cannot read the mesh|has no faces"):
        import_mesh(tmp_path / "broken.obj", tmp_path / "objects")
    assert list((tmp_path / "objects").iterdir()) == []
    assert object_id_of(Path("12 Käse.STL")) == "object_12_k_se"
    assert [guessed_unit(length) for length in (0.2, 12.0, 80.0, 3000.0)] == ["m", "cm", "mm", "mm"]


@pytest.mark.thorough
def test_the_command_imports_what_it_can_and_tells_of_the_rest(tmp_path):
    good = exported(trimesh.creation.cylinder(0.03, 0.05), tmp_path / "tin.stl")
    (tmp_path / "bad.obj").write_text("v 0 0 0\n")
    arguments = ["assets", "import", str(good), str(tmp_path / "bad.obj"), "--out", str(tmp_path / "mine")]
    done = CliRunner().invoke(group, arguments)
    assert done.exit_code != 0
    assert "bad: not imported" in done.output
    assert "grasps: 8 hold of" in done.output
    model = yaml.safe_load((tmp_path / "mine" / "objects" / "tin.yaml").read_text())
    assert model["name"] == "tin"
    assert set(model["affordances"]) >= {"graspable", "support"}
    again = CliRunner().invoke(group, arguments[:3] + arguments[4:])
    assert again.exit_code == 0
    assert "exists; --again" in again.output


@pytest.mark.thorough
def test_an_object_that_hides_a_built_in_one_says_so(tmp_path):
    file = exported(trimesh.creation.box((0.05, 0.05, 0.05)), tmp_path / "cube.stl")
    made = import_mesh(file, tmp_path / "objects", ImportOptions(grasps=1))
    assert made.report[0].startswith("name: it hides another object of the name 'cube'")


@pytest.mark.thorough
def test_grasps_are_sought_for_the_gripper_at_hand(tmp_path):
    """A board of 75 mm is too wide for the Franka hand, which opens to 80 mm with 8 to spare, not for the 2F-85."""
    board = exported(trimesh.creation.box((0.075, 0.12, 0.03)), tmp_path / "board.obj")
    made = {
        name: import_mesh(board, tmp_path / name, ImportOptions(unit="m", gripper=name, grasps=2))
        for name in ("franka_hand", "robotiq_2f85")
    }
    assert not made["franka_hand"].graspable
    assert any("within 80 mm" in line for line in made["franka_hand"].report)
    assert made["robotiq_2f85"].graspable
    assert any("floating robotiq 2f85" in line for line in made["robotiq_2f85"].report)
    with pytest.raises(ConfigError, match="robotiq_2f85"):
        import_mesh(board, tmp_path / "none", ImportOptions(gripper="robotiq_2f58"))


def test_a_floating_gripper_lifts_what_it_grasps_and_tells_what_is_in_its_way():
    library, client = ModelLibrary(), BulletClient()
    cube = library.object("cube")
    top = cube.grasps[0]
    shifted = replace(top, pose=Pose(position=(0.0, 0.045, 0.0), quat_xyzw=top.pose.quat_xyzw))
    beside = replace(top, pose=Pose(position=(0.0, 0.2, 0.1), quat_xyzw=top.pose.quat_xyzw))
    try:
        for name in ("franka_hand", "robotiq_2f85"):
            assert try_grasp(client, cube, top, floating(name)) == ""
            assert "is inside the object" in try_grasp(client, cube, shifted, floating(name))
            assert "0.000 m only" in try_grasp(client, cube, beside, floating(name))
    finally:
        client.disconnect()
