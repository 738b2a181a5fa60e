"""User-defined objects: a mesh or a URDF and one YAML file, with a report of all errors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner
from PIL import Image
from scipy.spatial.transform import Rotation

from roboxim_cli.commands.assets import command
from roboxim_core.errors import ConfigError, RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import ScenePoses, render_world
from roboxim_core.poses import Pose, look_at
from roboxim_core.specs import CameraSpec, EntitySpec, SceneSpec
from roboxim_core.vision.renderer import CameraImages
from roboxim_planner.scene import PlanningScene
from roboxim_runs.assets.check import check, simplify, starter
from roboxim_sim.rendering import make_renderer
from roboxim_sim.world import World

GOOD = """
name: brick
mesh: brick.glb
mass: 0.2
affordances: [graspable]
grasps: [{name: top, pose: {rpy_deg: [180, 0, 0]}, width_m: 0.04}]
"""
URDF = """<robot name="bin">
  <link name="bin">
    <inertial><mass value="0.4"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual>
      <geometry><box size="0.1 0.1 0.1"/></geometry><material name="m"><color rgba="0.1 0.5 0.9 1"/></material>
    </visual>
    <collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>
  </link>
  <link name="rim">
    <inertial><mass value="0.05"/></inertial>
    <visual><geometry><box size="0.1 0.1 0.01"/></geometry></visual>
    <collision><geometry><box size="0.1 0.1 0.01"/></geometry></collision>
  </link>
  <link name="lid">
    <inertial><mass value="0.05"/></inertial>
    <visual><geometry><box size="0.1 0.1 0.01"/></geometry></visual>
    <collision><geometry><box size="0.1 0.1 0.01"/></geometry></collision>
  </link>
  <joint name="glue" type="fixed">
    <parent link="bin"/><child link="rim"/><origin xyz="0 0 0.055"/>
  </joint>
  <joint name="hinge" type="revolute">
    <parent link="rim"/><child link="lid"/><origin xyz="0 0 0.011"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="1.5"/><dynamics damping="0.01" friction="0.02"/>
  </joint>
</robot>
"""


def brick(extents: tuple[float, float, float] = (0.06, 0.04, 0.03), image: bool = True) -> trimesh.Trimesh:
    mesh: trimesh.Trimesh = trimesh.creation.box(extents=extents)
    if image:
        half = Image.new("RGB", (64, 64), (220, 30, 30))
        uv = mesh.vertices[:, :2] / mesh.extents[:2] + 0.5
        visuals: Any = trimesh.visual
        material = visuals.material.PBRMaterial(baseColorTexture=half, metallicFactor=0.0, roughnessFactor=0.7)
        mesh.visual = visuals.TextureVisuals(uv=uv, material=material)
    return mesh


@pytest.fixture
def library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModelLibrary:
    """The built-in models, after a user's folder that is empty so far."""
    (tmp_path / "objects").mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))
    return ModelLibrary()


@pytest.fixture
def say(library: ModelLibrary) -> Callable[[str], str]:
    """Write the user's YAML file and return all findings about it."""

    def written(text: str) -> str:
        file = library.search_path[0] / "objects" / "brick.yaml"
        file.write_text(text)
        return "\n".join(f"{finding.severity}: {finding.message}" for finding in check(str(file), library))

    return written


def folder(library: ModelLibrary) -> Path:
    return library.search_path[0] / "objects"


def seen_from_above(scene: SceneSpec, world: World, library: ModelLibrary) -> CameraImages:
    renderer = make_renderer("raster")
    try:
        renderer.load(render_world(scene, library))
        view = look_at((0.5, 0.35, 0.5), (0.5, 0.3, 0.0))
        camera = CameraSpec(name="top", width=128, height=128, fov_y_rad=0.35, depth=True, segmentation=True)
        return renderer.render(ScenePoses(scene, library).body_poses(world.record), [(camera, view)])["top"]
    finally:
        renderer.close()


@pytest.mark.parametrize("ending", ["glb", "obj"])
def test_a_mesh_with_a_texture_is_simulated_drawn_and_avoided(library: ModelLibrary, ending: str) -> None:
    brick().export(folder(library) / f"brick.{ending}")
    (folder(library) / "brick.yaml").write_text(GOOD.replace("brick.glb", f"brick.{ending}"))
    model = library.object("brick")
    assert model.size == pytest.approx((0.06, 0.04, 0.03))
    assert model.rest_height == pytest.approx(0.015)
    scene = SceneSpec(entities=(EntitySpec(name="it", model="brick", pose=Pose(position=(0.5, 0.3, 0.2))),))
    with World(library) as world:
        world.load(scene)
        world.step(240)
        rests = world.record.entity("it").pose
        assert rests.position == pytest.approx((0.5, 0.3, 0.015), abs=2e-3)
        images = seen_from_above(scene, world, library)
        planned = PlanningScene.from_state(scene, world.record, library)
    assert images.segmentation is not None
    it = images.segmentation == render_world(scene, library).entity_names.index("it") + 1
    assert it.sum() > 100
    red, green, blue = images.rgb[it].mean(axis=0)
    assert red > 2 * max(green, blue), "the texture of the file is not on it"
    body = next(body for body in planned.bodies if body.name == "it")
    assert [getattr(shape, "kind", "") for shape in body.shapes] == ["hull"]


def test_the_planner_collides_with_a_mesh_in_millimetres(library: ModelLibrary) -> None:
    import coal

    from roboxim_planner.collisions.geometry import make_shape

    brick((60.0, 40.0, 30.0), image=False).export(folder(library) / "brick.stl")
    text = GOOD.replace("brick.glb", "brick.stl").replace("mass:", "mesh_scale: 0.001\nmass:")
    (folder(library) / "brick.yaml").write_text(text)
    (shape,) = library.object("brick").links[0].collision
    made = make_shape(shape)
    assert made.aabb_local.width() == pytest.approx(0.06)
    assert made.aabb_local.height() == pytest.approx(0.04)
    assert isinstance(made, coal.ShapeBase)


def test_a_urdf_with_a_hinge_and_a_fixed_joint(library: ModelLibrary) -> None:
    (folder(library) / "bin.urdf").write_text(URDF)
    (folder(library) / "bin.yaml").write_text("name: bin\nurdf: bin.urdf\naffordances: [articulated, support]\n"
        "regions: [{kind: surface, link: lid, pose: {position: [0, 0, 0.005]}, size: [0.1, 0.1, 0]}]\n")  # fmt: skip
    model = library.object("bin")
    assert [link.name for link in model.links] == ["bin", "lid"]
    assert model.links[0].mass == pytest.approx(0.45)
    (hinge,) = model.joints
    assert (hinge.parent, hinge.resistance, hinge.damping) == ("bin", 0.02, 0.01)
    assert hinge.pose.position == pytest.approx((0.0, 0.0, 0.066))
    assert model.size == pytest.approx((0.1, 0.1, 0.121))
    scene = SceneSpec(
        entities=(
            EntitySpec(name="it", model="bin", pose=Pose(position=(0.5, 0.3, 0.05)), joint_positions={"hinge": 1.0}),
        )
    )
    with World(library) as world:
        world.load(scene)
        images = seen_from_above(scene, world, library)
    assert images.depth is not None
    assert check("bin", library) == []


def test_a_valid_object_has_no_findings(say: Callable[[str], str], library: ModelLibrary) -> None:
    brick().export(folder(library) / "brick.glb")
    assert say(GOOD) == ""
    assert [f.message for object_id in ("mug", "cabinet") for f in check(object_id, library)] == []


def test_a_missing_file_or_key_is_named(say: Callable[[str], str]) -> None:
    assert "brick.glb: no such file" in say(GOOD)
    assert "did you mean 'mesh'" in say(GOOD.replace("mesh:", "mehs:"))
    with pytest.raises(ConfigError, match="no such file"):
        check("./nothing.yaml", ModelLibrary())


def test_an_unreadable_mesh_is_named(say: Callable[[str], str], library: ModelLibrary) -> None:
    (folder(library) / "brick.glb").write_bytes(b"not a mesh")
    assert "cannot read the mesh" in say(GOOD)


def test_holes_units_and_many_triangles_are_found(say: Callable[[str], str], library: ModelLibrary) -> None:
    open_box = brick(image=False)
    open_box.update_faces(np.arange(len(open_box.faces)) > 1)
    open_box.export(folder(library) / "open.glb")
    assert "warning: open.glb is not watertight" in say(GOOD.replace("brick.glb", "open.glb"))
    brick((60.0, 40.0, 30.0)).export(folder(library) / "brick.glb")
    assert "error: brick.glb would be 60 x 40 x 30 m large: its units look like millimetres" in say(GOOD)
    assert say(GOOD.replace("mass:", "mesh_scale: 0.001\nmass:")) == ""
    fine = brick(image=False)
    for _ in range(5):
        fine = fine.subdivide()
    fine.export(folder(library) / "fine.glb")
    assert "warning: fine.glb has 12288 triangles" in say(GOOD.replace("brick.glb", "fine.glb"))
    before, after = simplify(folder(library) / "fine.glb", 500, folder(library) / "fewer.glb")
    assert (before, after <= 600) == (12288, True)


def test_a_wrong_mass_or_inertia_is_found(say: Callable[[str], str], library: ModelLibrary) -> None:
    brick().export(folder(library) / "brick.glb")
    assert "error: the object has no mass" in say(GOOD.replace("mass: 0.2", ""))
    assert "masses are in kilograms" in say(GOOD.replace("0.2", "200"))
    needle = "{name: needle, links: [{mass: 0.001, collision: [{kind: capsule, size: [0.001, 0.1]}]}]}"
    assert "will jitter" in say(needle)
    (folder(library) / "bin.urdf").write_text(URDF.replace('izz="1e-3"', 'izz="9e-3"'))
    assert "an impossible inertia" in say("name: bin\nurdf: bin.urdf")


def test_impossible_grasps_are_found(say: Callable[[str], str], library: ModelLibrary) -> None:
    brick().export(folder(library) / "brick.glb")
    assert "warning: no grasps" in say(GOOD[: GOOD.index("affordances")])
    assert "the gripper opens to 0.08" in say(GOOD.replace("width_m: 0.04", "width_m: 0.09"))
    assert "closes on nothing" in say(GOOD.replace("rpy_deg: [180, 0, 0]", "position: [0, 0, 0.1]"))
    assert "closes on something that reaches 20 mm" in say(GOOD.replace("width_m: 0.04", "width_m: 0.01"))
    brick((0.06, 0.04, 0.014)).export(folder(library) / "brick.glb")
    assert "error: at top the Panda's fingertips would be up to 2.5 mm in the table" in say(GOOD)
    assert say(GOOD.replace("rpy_deg: [180, 0, 0]", "position: [0, 0, 0.004], rpy_deg: [180, 0, 0]")) == ""


def test_a_hull_that_closes_a_cavity_is_found(say: Callable[[str], str], library: ModelLibrary) -> None:
    cup = trimesh.creation.annulus(r_min=0.03, r_max=0.034, height=0.08)
    cup.export(folder(library) / "brick.glb")
    assert "a hull fills every cavity" in say(GOOD.replace("0.04}", "0.068}"))


def test_a_missing_texture_is_found(say: Callable[[str], str], library: ModelLibrary) -> None:
    brick().export(folder(library) / "brick.obj")
    text = GOOD.replace("brick.glb", "brick.obj")
    assert say(text) == ""
    for image in folder(library).glob("*.png"):
        image.unlink()
    assert "needs the texture" in say(text)
    (folder(library) / "material.mtl").unlink()
    assert "needs the material file material.mtl" in say(text)
    plain = "{name: a, links: [{mass: 0.1, collision: [{kind: box, size: [0.05, 0.05, 0.05]}], visual: [{kind: box, "
    assert "did you mean 'wood_grain'" in say(plain + "size: [0.05, 0.05, 0.05], material: {texture: wood_gran}}]}]}")
    assert "label.png" in say(plain + "size: [0.05, 0.05, 0.05], material: {texture: label.png}}]}]}")


def test_floating_and_toppling_objects_are_found(say: Callable[[str], str], library: ModelLibrary) -> None:
    brick().export(folder(library) / "brick.glb")
    assert "would float or sink; leave rest_height out, or give 0.015" in say(GOOD + "rest_height: 0.03\n")
    assert "the shapes' is [0.06, 0.04, 0.03]" in say(GOOD + "size: [0.1, 0.04, 0.03]\n")
    cone = trimesh.creation.cone(radius=0.02, height=0.1)
    tilted = Pose.from_arrays((0, 0, 0), Rotation.from_euler("x", np.pi - 0.3))
    cone.apply_transform(tilted.matrix)
    cone.export(folder(library) / "cone.glb")
    text = GOOD[: GOOD.index("affordances")].replace("brick.glb", "cone.glb")
    assert "give it a pose or shapes that stand" in say(text)


@pytest.mark.parametrize("height_mm", [30.0, 14.0])
def test_a_mesh_gets_a_first_file_that_passes(library: ModelLibrary, height_mm: float) -> None:
    brick((60.0, 40.0, height_mm)).export(folder(library) / "brick.glb")
    text = starter(folder(library) / "brick.glb")
    assert "mesh_scale: 0.001" in text
    (folder(library) / "brick.yaml").write_text(text)
    assert check("brick", library) == []


@pytest.mark.parametrize("ending", ["glb", "obj"])
def test_the_hash_covers_the_files_that_the_yaml_names(library: ModelLibrary, ending: str) -> None:
    brick().export(folder(library) / f"brick.{ending}")
    (folder(library) / "brick.yaml").write_text(GOOD.replace("brick.glb", f"brick.{ending}"))
    before = library.digest("brick")
    for file in (f for f in folder(library).iterdir() if f.suffix != ".yaml"):
        kept = file.read_bytes()
        file.write_bytes(kept + b"#")
        assert library.digest("brick") != before, file.name
        file.write_bytes(kept)
    assert library.digest("brick") == before


@pytest.mark.thorough
def test_the_command_line_draws_checks_and_starts_objects(library: ModelLibrary, tmp_path: Path) -> None:
    run = CliRunner()
    out = tmp_path / "sheet.png"
    args = ["sheet", "cube", "plate", "--size", "48", "--columns", "2", "--out", str(out)]
    for more, height in (([], 78), (["--no-labels"], 56)):
        drawn = run.invoke(command, [*args, *more])
        assert drawn.exit_code == 0, drawn.output
        with Image.open(out) as picture:
            assert picture.size == (108, height)
            assert np.asarray(picture).std() > 10
    assert "2 pictures, drawn by raster" in drawn.output
    brick((60.0, 40.0, 30.0)).export(folder(library) / "brick.glb")
    (folder(library) / "brick.yaml").write_text(GOOD)
    failed = run.invoke(command, ["check", "mug", "brick"])
    assert isinstance(failed.exception, RoboximError)
    assert "mug: good" in failed.output
    assert "millimetres" in failed.output
    started = run.invoke(command, ["new", str(folder(library) / "brick.glb")])
    (folder(library) / "brick.yaml").write_text(started.stdout)
    assert run.invoke(command, ["check", "brick"]).exit_code == 0


def test_a_users_object_overrides_one_of_the_same_name(library: ModelLibrary) -> None:
    brick().export(folder(library) / "brick.glb")
    (folder(library) / "cube.yaml").write_text(GOOD)
    assert library.object("cube").name == "brick"
    assert ModelLibrary(library.search_path[-1]).object("cube").name == "cube"
