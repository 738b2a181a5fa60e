"""The contract of every registered renderer, and the further guarantees of `raster`."""

from __future__ import annotations

import hashlib
import math
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, SimError
from roboxim_core.poses import Pose, look_at
from roboxim_core.specs import CameraSpec, LightSpec, LookSpec, MaterialSpec
from roboxim_core.vision import textures as core_textures
from roboxim_core.vision.renderer import CameraImages, RenderBody, Renderer, RenderWorld, TriangleMesh, VisualPart
from roboxim_core.vision.textures import ROOM_TEXTURES
from roboxim_sim.rendering import available_renderers, make_renderer, textures

CUBE_M = 0.06
EYE = look_at((0.9, 0.5, 0.6), (0.0, 0.05, 0.0))


def make_or_skip(name: str) -> Renderer:
    try:
        return make_renderer(name)
    except SimError as error:
        if error.code != ErrorCode.RENDERER_UNAVAILABLE:
            raise
        pytest.skip(str(error))


@pytest.fixture(scope="module", params=["raster", "tiny"])
def renderer(request: pytest.FixtureRequest) -> Iterator[Renderer]:
    made = make_or_skip(request.param)
    yield made
    made.close()


@pytest.fixture(scope="module")
def raster() -> Iterator[Renderer]:
    made = make_or_skip("raster")
    yield made
    made.close()


def mesh(shape: trimesh.Trimesh) -> TriangleMesh:
    """A mesh with flat faces."""
    return TriangleMesh(
        vertices=shape.triangles.reshape(-1, 3).astype(np.float32),
        normals=shape.face_normals.repeat(3, axis=0).astype(np.float32),
        faces=np.arange(3 * len(shape.faces), dtype=np.uint32).reshape(-1, 3),
    )


def body(key: str, shape: trimesh.Trimesh, entity: str = "", **material: object) -> RenderBody:
    part = VisualPart(mesh=mesh(shape), material=MaterialSpec(**material))
    return RenderBody(key=key, entity=entity or key, parts=(part,))


def box(*extents: float) -> trimesh.Trimesh:
    return trimesh.creation.box(extents)


def example(look: LookSpec | None = None, height: float = CUBE_M / 2) -> tuple[RenderWorld, dict[str, Pose]]:
    """A cube and a ball over a table, a floor and a wall behind."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.04)
    bodies = (
        body("table", box(1.0, 1.2, 0.05), texture="wood", color=(0.7, 0.6, 0.5)),
        body("floor", box(4.0, 4.0, 0.02)),
        body("wall", box(0.02, 4.0, 3.0)),
        body("cube", box(CUBE_M, CUBE_M, CUBE_M), color=(0.8, 0.1, 0.1)),
        body("robot/a", ball, "robot", metallic=1.0),
        body("robot/b", box(0.02, 0.02, 0.3), "robot"),
    )
    poses = {
        "table": Pose(position=(0.0, 0.0, -0.025)),
        "floor": Pose(position=(0.0, 0.0, -0.7)),
        "wall": Pose(position=(-1.5, 0.0, 0.5)),
        "cube": Pose(position=(0.1, 0.0, height), quat_xyzw=(0.0, 0.0, math.sin(0.2), math.cos(0.2))),
        "robot/a": Pose(position=(0.0, 0.2, 0.04)),
        "robot/b": Pose(position=(0.0, 0.2, 0.2)),
    }
    return RenderWorld(bodies=bodies, look=look or LookSpec()), poses


def camera(name: str = "eye", **options: object) -> CameraSpec:
    return CameraSpec(**{"name": name, "width": 128, "height": 96, "depth": True, "segmentation": True, **options})


def project(spec: CameraSpec, pose: Pose, points: np.ndarray) -> np.ndarray:
    """The pinhole model: continuous image coordinates, (0, 0) at the image's upper left corner."""
    x, y, z = pose.inverse().apply(points).T
    focal = spec.height / 2 / math.tan(spec.fov_y_rad / 2)
    return np.stack([focal * x / z + spec.width / 2, focal * y / z + spec.height / 2], axis=1)


def digest(images: dict[str, CameraImages]) -> str:
    """A hash of all pixels."""
    sha = hashlib.sha256()
    for name in sorted(images):
        for array in (images[name].rgb, images[name].depth, images[name].segmentation):
            sha.update(b"-" if array is None else array.tobytes())
    return sha.hexdigest()


@pytest.mark.parametrize(("width", "height"), [(320, 200), (150, 260)])
def test_known_points_project_within_half_a_pixel(renderer: Renderer, width: int, height: int) -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.25, 0.25, (12, 3))
    marker = trimesh.creation.icosphere(subdivisions=2, radius=0.012)
    bodies = tuple(body(f"p{i}", marker) for i in range(len(points)))
    spec = camera(width=width, height=height, fov_y_rad=0.8)
    renderer.load(RenderWorld(bodies=bodies, look=LookSpec()))
    for i, expected in enumerate(project(spec, EYE, points)):
        poses = {f"p{j}": Pose(position=(0.0, 0.0, -50.0)) for j in range(len(points))}
        poses[f"p{i}"] = Pose.from_arrays(points[i])
        seen = renderer.render(poses, [(spec, EYE)])["eye"].segmentation
        assert seen is not None
        rows, columns = np.nonzero(seen == i + 1)
        if len(rows) == 0:
            assert not (0 < expected[0] < width and 0 < expected[1] < height)
            continue
        assert [columns.mean() + 0.5, rows.mean() + 0.5] == pytest.approx(expected.tolist(), abs=0.5)


def test_depth_is_metric_along_the_optical_axis(renderer: Renderer) -> None:
    renderer.load(RenderWorld(bodies=(body("floor", box(8.0, 8.0, 0.02)),), look=LookSpec()))
    spec = camera(far=2.0)
    depth = renderer.render({"floor": Pose(position=(0.0, 0.0, -0.01))}, [(spec, EYE)])["eye"].depth
    assert depth is not None
    focal = spec.height / 2 / math.tan(spec.fov_y_rad / 2)
    column, row = np.meshgrid(np.arange(spec.width) + 0.5, np.arange(spec.height) + 0.5)
    rays = np.stack([(column - spec.width / 2) / focal, (row - spec.height / 2) / focal, np.ones_like(row)], axis=-1)
    downwards = (rays @ EYE.rotation.as_matrix().T)[..., 2]
    expected = np.where(downwards < 0, -EYE.position[2] / downwards, np.inf)
    near, beyond = expected < 1.95, expected > 2.05
    assert near.any()
    assert beyond.any()
    assert np.abs(depth - expected)[near].max() < 2e-4
    assert np.isinf(depth[beyond]).all()


def test_segmentation_names_entities_and_leaves_the_background_zero(renderer: Renderer) -> None:
    world, poses = example()
    renderer.load(world)
    images = renderer.render(poses, [(camera(far=1.6), EYE)])["eye"]
    assert world.entity_names == ("table", "floor", "wall", "cube", "robot")
    assert images.segmentation is not None
    assert images.depth is not None
    assert set(np.unique(images.segmentation)) >= {0, 1, 4, 5}
    assert np.array_equal(images.segmentation == 0, np.isinf(images.depth))
    column, row = project(camera(), EYE, np.array([poses["cube"].position]))[0].astype(int)
    assert images.segmentation[row, column] == 4
    red = images.rgb[row, column].astype(int)
    assert red[0] > 2 * red[1]


def test_geometry_is_the_same_without_colour(renderer: Renderer) -> None:
    world, poses = example()
    renderer.load(world)
    cameras = [(camera("a"), EYE), (camera("b", width=50, height=70, far=1.6), EYE)]
    whole, bare = renderer.render(poses, cameras), renderer.render(poses, cameras, colour=False)
    for name in ("a", "b"):
        assert np.array_equal(whole[name].segmentation, bare[name].segmentation)
        assert np.array_equal(whole[name].depth, bare[name].depth)
        assert whole[name].rgb.shape == bare[name].rgb.shape
    assert digest(renderer.render(poses, cameras)) == digest(whole)


def test_a_camera_returns_the_requested_images_and_owns_them(renderer: Renderer) -> None:
    world, poses = example()
    renderer.load(world)
    cameras = [(camera("a", depth=False, width=64), EYE), (camera("b", segmentation=False, width=40, height=200), EYE)]
    images = renderer.render(poses, cameras)
    assert images["a"].rgb.shape == (96, 64, 3)
    assert images["b"].rgb.shape == (200, 40, 3)
    assert images["a"].depth is None
    assert images["a"].segmentation is not None
    assert images["b"].segmentation is None
    assert images["b"].depth is not None
    before = images["a"].rgb.copy()
    assert images["a"].rgb.flags.c_contiguous
    assert images["a"].rgb.dtype == np.uint8
    renderer.render({**poses, "cube": Pose()}, cameras)
    assert np.array_equal(before, images["a"].rgb)


@pytest.mark.parametrize("kind", ["sun", "lamp"])
def test_an_object_casts_a_shadow_beside_it_and_only_there(renderer: Renderer, kind: str) -> None:
    light = LightSpec(kind=kind, direction=(0.0, 1.0, -1.0), position=(0.1, -0.9, 0.9))
    shades = []
    for shadow in (True, False):
        world, poses = example(LookSpec(lights=(replace(light, shadow=shadow),)))
        renderer.load(world)
        rgb = renderer.render(poses, [(camera(), EYE)])["eye"].rgb.astype(float)
        beside = np.array([[0.1, 0.05, 0.0], [0.1, -0.12, 0.0]])  # behind the cube as the light sees it, and before it
        column, row = project(camera(), EYE, beside).astype(int).T
        shades.append(rgb[row, column].sum(axis=1))
    (dark, lit), (unshadowed, _) = shades
    assert dark < (0.8 if renderer.name == "raster" else 0.95) * unshadowed
    assert dark < 0.95 * lit


def test_same_input_gives_the_same_bits_whatever_came_before(renderer: Renderer) -> None:
    world, poses = example()
    cameras = [(camera("a"), EYE), (camera("b", width=70, height=130), look_at((-0.5, -0.6, 0.4), (0, 0, 0)))]
    fresh = make_renderer(renderer.name)
    fresh.load(world)
    expected = digest(fresh.render(poses, cameras))
    fresh.close()
    lamp = LightSpec(kind="lamp", position=(1.0, 1.0, 1.0))
    other, _ = example(LookSpec(lights=(lamp, LightSpec(shadow=False)), table=MaterialSpec(texture="checker")))
    renderer.load(other)
    renderer.render(poses, [(camera("c", width=200, depth=False, segmentation=False), EYE)])
    renderer.load(world)
    renderer.render({**poses, "cube": Pose(position=(0.3, 0.3, 0.3))}, cameras)
    assert digest(renderer.render(poses, cameras)) == expected


def in_a_process(call: str, name: str) -> str:
    """Return the result of a function of this file in a separate process, given a renderer of the name."""
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import test_rendering as t\n"
        f"print('returned', t.{call}(t.make_renderer(sys.argv[2])))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(Path(__file__).parent), name],
        env={**os.environ, "LP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.rpartition("returned ")[2].strip()


def digest_of_the_example(renderer: Renderer) -> str:
    world, poses = example()
    renderer.load(world)
    return digest(renderer.render(poses, [(camera(), EYE)]))


@pytest.mark.thorough
def test_another_process_and_thread_count_give_the_same_bits(renderer: Renderer) -> None:
    assert in_a_process("digest_of_the_example", renderer.name) == digest_of_the_example(renderer)


def test_another_thread_is_refused(renderer: Renderer) -> None:
    world, poses = example()
    renderer.load(world)
    refused: list[str] = []

    def call() -> None:
        for attempt in (
            lambda: renderer.render(poses, [(camera(), EYE)]),
            lambda: renderer.load(world),
            renderer.close,
        ):
            try:
                attempt()
            except SimError as error:
                refused.append(str(error))

    thread = threading.Thread(target=call, name="intruder")
    thread.start()
    thread.join()
    assert len(refused) == 3
    assert all("intruder" in message for message in refused)
    assert renderer.render(poses, [(camera(), EYE)])["eye"].rgb.any()


def test_bad_input_is_named(renderer: Renderer) -> None:
    world, poses = example()
    renderer.load(world)
    with pytest.raises(InvalidRequestError, match="cuba"):
        renderer.render({"cuba": Pose()}, [(camera(), EYE)])
    with pytest.raises(InvalidRequestError, match="unique"):
        renderer.render(poses, [(camera(), EYE), (camera(), EYE)])
    with pytest.raises(ConfigError, match="did you mean 'wood'"):
        renderer.load(RenderWorld(bodies=(body("a", box(1, 1, 1), texture="woood"),), look=LookSpec()))
    torn = replace(mesh(box(1, 1, 1)), normals=np.zeros((2, 3), np.float32))
    part = VisualPart(mesh=torn, material=MaterialSpec())
    with pytest.raises(InvalidRequestError, match="body 'torn'"):
        renderer.load(RenderWorld(bodies=(RenderBody(key="torn", entity="torn", parts=(part,)),), look=LookSpec()))


def test_rendering_needs_a_world_and_an_open_renderer() -> None:
    tiny = make_renderer("tiny")
    with pytest.raises(SimError, match="load") as caught:
        tiny.render({}, [(camera(), EYE)])
    assert caught.value.code == ErrorCode.NO_SCENE
    tiny.close()
    tiny.close()
    with pytest.raises(SimError, match="closed"):
        tiny.load(example()[0])


def test_an_empty_world_shows_the_background(renderer: Renderer) -> None:
    renderer.load(RenderWorld(bodies=(), look=LookSpec(lights=())))
    images = renderer.render({}, [(camera(), EYE)])["eye"]
    assert images.depth is not None
    assert np.isinf(images.depth).all()
    assert (images.rgb == images.rgb[0, 0]).all()
    assert images.rgb.min() > 50


def test_renderers_agree_on_segmentation_and_depth(raster: Renderer) -> None:
    world, poses = example()
    tiny = make_renderer("tiny")
    images = []
    for each in (raster, tiny):
        each.load(world)
        images.append(each.render(poses, [(camera(width=256, height=256), EYE)])["eye"])
    tiny.close()
    same = (images[0].segmentation == images[1].segmentation) & np.isfinite(images[0].depth)
    assert (images[0].segmentation == images[1].segmentation).mean() > 0.97
    assert np.median(np.abs(images[0].depth - images[1].depth)[same]) < 1e-3


def test_many_wide_cameras_do_not_need_one_framebuffer(raster: Renderer) -> None:
    world, poses = example()
    raster.load(world)
    cameras = [(camera(f"c{i}", width=4096, height=16), EYE) for i in range(5)]
    images = raster.render(poses, cameras)
    assert len({digest({"x": image}) for image in images.values()}) == 1
    assert np.unique(images["c4"].segmentation).size > 1


def test_further_lights_brighten(raster: Renderer) -> None:
    means = []
    for extra in (0, 1, 3):
        lights = (LightSpec(), *[LightSpec(kind="lamp", position=(0.5, 0.5, 1.0), shadow=False)] * extra)
        world, poses = example(LookSpec(lights=lights))
        raster.load(world)
        means.append(raster.render(poses, [(camera(), EYE)])["eye"].rgb.mean())
    assert means[0] < means[1] < means[2]
    with pytest.raises(InvalidRequestError, match="lights"):
        raster.load(example(LookSpec(lights=(LightSpec(),) * 5))[0])


def rss_mib() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE") / 2**20


def growth_while_rendering(renderer: Renderer) -> float:
    cameras = [(camera("a", width=64, height=48), EYE), (camera("b", width=64, height=48), EYE)]

    def run(pairs: int) -> None:
        for i in range(pairs):
            if i % 10 == 0:
                world, poses = example()
                renderer.load(world)
            renderer.render(poses, cameras)

    count = 120 if renderer.name == "raster" else 30
    run(count // 2)
    before = rss_mib()
    run(count)
    return rss_mib() - before


def growth_while_reopening(renderer: Renderer) -> float:
    world, poses = example()

    def cycle() -> None:
        other = make_renderer(renderer.name)
        other.load(world)
        other.render(poses, [(camera(), EYE)])
        other.close()

    for _ in range(3):
        cycle()
    before = rss_mib()
    for _ in range(6):
        cycle()
    return rss_mib() - before


# In separate processes: memory that other tests' threads keep or free would be counted here.


@pytest.mark.thorough
def test_memory_stays_flat(renderer: Renderer) -> None:
    assert float(in_a_process("growth_while_rendering", renderer.name)) < 6.0


@pytest.mark.slow
def test_closing_frees(raster: Renderer) -> None:
    assert float(in_a_process("growth_while_reopening", raster.name)) < 6 * 3.0


def test_without_gl_raster_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GLCONTEXT_LINUX_LIBEGL", "libnothing.so")
    with pytest.raises(SimError, match="libegl1 libgl1-mesa-dri") as caught:
        make_renderer("raster")
    assert caught.value.code == ErrorCode.RENDERER_UNAVAILABLE
    found = available_renderers(["raster", "tiny"])
    assert not found["raster"].available
    assert "libegl1" in found["raster"].detail
    assert found["tiny"].available


def test_configurations_can_use_every_texture_of_the_room() -> None:
    names = textures.TEXTURES
    assert {name for name in names if names[name].__module__ == textures.__name__} == set(ROOM_TEXTURES)


@pytest.mark.thorough
@pytest.mark.parametrize("name", list(textures.TEXTURES))
def test_textures_are_deterministic(name: str) -> None:
    first = textures.pixels(name)
    core_textures._pixels.cache_clear()
    assert np.array_equal(first, textures.pixels(name))
    assert first.std() > 1.0


def test_a_changed_texture_is_read_again(raster: Renderer, tmp_path: Path) -> None:
    file, other = tmp_path / "print.png", tmp_path / "other.png"
    shades = []
    for shade in (40, 200):
        for image in (file, other):
            Image.new("RGB", (8 + shade, 8), (shade,) * 3).save(image)
        for image in (other, file):
            raster.load(RenderWorld(bodies=(body("table", box(1.0, 1.0, 0.05), texture=str(image)),), look=LookSpec()))
            image.unlink()  # a texture of an earlier world may be gone
        shades.append(raster.render({}, [(camera(), EYE)])["eye"].rgb.mean())
    assert shades[1] > 1.1 * shades[0]


@pytest.mark.parametrize("name", ["wood", "checker", "concrete", "fabric", "marble", "speckle"])
def test_the_rooms_textures_are_mostly_light(name: str) -> None:
    assert 0.5 < ((textures.pixels(name) / 255.0) ** 2).mean() < 1.0
