"""Correctness of `raster`: depth and segmentation against PyBullet's ray tests, and isolation between renderers."""

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
import pybullet
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from roboxim_core.errors import ErrorCode, SimError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import ScenePoses, render_world
from roboxim_core.poses import IDENTITY, Pose, look_at
from roboxim_core.specs import CameraSpec, EntitySpec, LightSpec, LookSpec, MaterialSpec, SceneSpec
from roboxim_core.state import RobotState
from roboxim_core.vision.renderer import CameraImages, RenderBody, RenderWorld, TriangleMesh, VisualPart
from roboxim_sim.rendering.gl import create_context
from roboxim_sim.rendering.lod import coarse_meshes
from roboxim_sim.rendering.raster import RasterRenderer

EVERY = 7
"""Only every n-th row and column is compared, because rays are slow."""
EYE = look_at((0.9, 0.5, 0.6), (0.0, 0.05, 0.0))
CAMERA = CameraSpec(name="eye", width=160, height=120, depth=True, segmentation=True)


@pytest.fixture(scope="module")
def raster() -> Iterator[RasterRenderer]:
    made = make_or_skip()
    yield made
    made.close()


def make_or_skip() -> RasterRenderer:
    try:
        return RasterRenderer()
    except SimError as error:
        if error.code != ErrorCode.RENDERER_UNAVAILABLE:
            raise
        pytest.skip(str(error))


def random_scene(seed: int) -> tuple[SceneSpec, dict[str, Pose], RenderWorld]:
    """Objects at random poses above the table, and the arm in a random pose."""
    rng = np.random.default_rng(seed)
    library = ModelLibrary()
    models = rng.choice(["apple", "soda_can", "knife", "plate", "mug", "bowl", "cube", "sponge"], 6, replace=False)
    entities = []
    for name in models.tolist():
        position = rng.uniform([0.25, -0.4, 0.1], [0.75, 0.4, 0.35])
        pose = Pose.from_arrays(position, Rotation.random(rng=rng))
        entities.append(EntitySpec(name=name, model=name, pose=pose))
    scene = SceneSpec(entities=tuple(entities))
    arm = tuple((np.array([0.1, 0.2, 0.0, -2.1, 0.0, 2.3, 0.8]) + rng.uniform(-0.4, 0.4, 7)).tolist())
    state = RobotState(
        joint_names=library.robot("panda").joint_names,
        joint_positions=arm,
        joint_velocities=(0.0,) * 7,
        joint_commands=arm,
        pose_tcp_measured=IDENTITY,
        pose_tcp_commanded=IDENTITY,
        gripper_opening=1.0,
        gripper_command=1.0,
        finger_positions=(0.04, 0.04),
    )
    world = render_world(scene, library)
    poses = {f"robot/{link}": pose for link, pose in ScenePoses(scene, library).link_poses(state).items()}
    poses |= {entity.name: entity.pose for entity in scene.entities}
    keys = {body.key for body in world.bodies}
    return scene, {key: pose for key, pose in poses.items() if key in keys}, world


def cast(world: RenderWorld, poses: dict[str, Pose], camera: CameraSpec, eye: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Return PyBullet's entity ids and depths along the rays of every few pixels."""
    client = pybullet.connect(pybullet.DIRECT)
    entity_of = {}
    for body in world.bodies:
        pose = poses.get(body.key, IDENTITY)
        for part in body.parts:
            shape = pybullet.createCollisionShape(
                pybullet.GEOM_MESH,
                vertices=part.mesh.vertices.tolist(),
                indices=part.mesh.faces.reshape(-1).tolist(),
                flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
                physicsClientId=client,
            )
            uid = pybullet.createMultiBody(0, shape, -1, pose.position, pose.quat_xyzw, physicsClientId=client)
            entity_of[uid] = world.entity_names.index(body.entity) + 1
    fx, fy, cx, cy = camera.matrix
    rows, columns = np.mgrid[EVERY // 2 : camera.height : EVERY, EVERY // 2 : camera.width : EVERY]
    rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones(rows.shape)], axis=-1).reshape(-1, 3)
    starts, ends = eye.apply(camera.near * rays), eye.apply(camera.far * rays)
    hits = []
    for i in range(0, len(rays), 4000):
        hits += pybullet.rayTestBatch(
            starts[i : i + 4000].tolist(), ends[i : i + 4000].tolist(), physicsClientId=client
        )
    pybullet.disconnect(physicsClientId=client)
    ids = np.array([entity_of.get(hit[0], 0) for hit in hits]).reshape(rows.shape)
    share = np.array([hit[2] for hit in hits]).reshape(rows.shape)
    depth = np.where(ids > 0, camera.near + share * (camera.far - camera.near), np.inf)
    return ids, depth


@pytest.mark.parametrize("seed", [1, 2])
def test_depth_and_segmentation_agree_with_pybullets_rays(raster: RasterRenderer, seed: int) -> None:
    _, poses, world = random_scene(seed)
    raster.load(world)
    camera = replace(CAMERA, width=640, height=480, fov_y_rad=0.8)
    eye = look_at((1.3, 0.5, 0.7), (0.4, 0.0, 0.2))
    images = raster.render(poses, [(camera, eye)])["eye"]
    at = (slice(EVERY // 2, None, EVERY), slice(EVERY // 2, None, EVERY))
    ids, depth = cast(world, poses, camera, eye)
    same = images.segmentation[at] == ids
    assert len(np.unique(ids)) >= 7
    assert same.mean() > 0.995
    error = np.abs(images.depth[at] - depth)[same & np.isfinite(depth)]
    assert np.median(error) < 2e-4
    assert np.quantile(error, 0.99) < 3e-3


def test_small_images_show_coarse_shapes_in_the_same_place(raster: RasterRenderer) -> None:
    _, poses, world = random_scene(3)
    raster.load(world)
    eye = look_at((1.3, 0.5, 0.7), (0.4, 0.0, 0.2))
    small = replace(CAMERA, name="small", width=160, height=120)
    large = replace(CAMERA, name="large", width=1120, height=840)
    images = raster.render(poses, [(small, eye), (large, eye)])
    fine, coarse = images["large"], images["small"]
    same = fine.segmentation[3::7, 3::7] == coarse.segmentation
    assert same.mean() > 0.985
    assert np.quantile(np.abs(fine.depth[3::7, 3::7] - coarse.depth)[same], 0.98) < 0.01


def test_simplified_meshes_keep_their_place_and_colours() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    upper = ball.triangles_center[:, 2] > 0
    halves = [
        TriangleMesh(
            vertices=np.asarray(ball.vertices, np.float32),
            normals=np.asarray(ball.vertex_normals, np.float32),
            faces=np.asarray(ball.faces[chosen], np.uint32),
            uv=np.asarray(ball.vertices[:, :2] * 5, np.float32),
        )
        for chosen in (upper, ~upper)
    ]
    coarse = coarse_meshes(halves, 600)
    assert sum(len(mesh.faces) for mesh in coarse) <= 620
    for mesh, sign in zip(coarse, (1, -1), strict=True):
        corners = mesh.vertices[mesh.faces]
        assert (sign * corners.mean(axis=1)[:, 2] > -0.02).all()
        assert np.linalg.norm(mesh.vertices, axis=1) == pytest.approx(0.1, abs=0.004)
        assert np.abs(mesh.normals - mesh.vertices / 0.1).max() < 0.35
        assert np.abs(mesh.uv - mesh.vertices[:, :2] * 5).max() < 0.1


def box_world(color: tuple[float, float, float], look: LookSpec | None = None) -> RenderWorld:
    solid = trimesh.creation.box((0.3, 0.3, 0.3))
    flat = TriangleMesh(
        vertices=solid.triangles.reshape(-1, 3).astype(np.float32),
        normals=solid.face_normals.repeat(3, axis=0).astype(np.float32),
        faces=np.arange(36, dtype=np.uint32).reshape(-1, 3),
    )
    part = VisualPart(mesh=flat, material=MaterialSpec(color=color))
    return RenderWorld(bodies=(RenderBody(key="box", entity="box", parts=(part,)),), look=look or LookSpec())


def digest(images: dict[str, CameraImages]) -> str:
    sha = hashlib.sha256()
    for name in sorted(images):
        for array in (images[name].rgb, images[name].depth, images[name].segmentation):
            sha.update(array.tobytes())
    return sha.hexdigest()


def turned(i: int) -> dict[str, Pose]:
    return {"box": Pose(quat_xyzw=(0.0, 0.0, math.sin(0.1 * i), math.cos(0.1 * i)))}


def drawn(world: RenderWorld, count: int) -> list[str]:
    """Digests of a few images, drawn by a renderer of the calling thread."""
    renderer = RasterRenderer()
    renderer.load(world)
    digests = [digest(renderer.render(turned(i), [(CAMERA, EYE)])) for i in range(count)]
    renderer.close()
    return digests


@pytest.mark.thorough
def test_concurrent_renderers_never_return_foreign_or_stale_images(raster: RasterRenderer) -> None:
    worlds = [box_world((0.8, 0.1, 0.1)), box_world((0.1, 0.1, 0.8))]
    expected = [drawn(world, 6) for world in worlds]
    assert len({*expected[0], *expected[1]}) == 12
    both = [RasterRenderer(), RasterRenderer()]
    for renderer, world in zip(both, worlds, strict=True):
        renderer.load(world)
    in_turns = [[digest(r.render(turned(i), [(CAMERA, EYE)])) for r in both] for i in range(6)]
    assert [list(row) for row in zip(*in_turns, strict=True)] == expected
    for renderer in both:
        renderer.close()

    results: list[list[str]] = [[], []]

    def work(k: int) -> None:
        for _ in range(3):
            results[k] = drawn(worlds[k], 6)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == expected


FORKED = """
import os, sys
sys.path.insert(0, sys.argv[1])
import test_raster_truth as t
renderer = t.RasterRenderer()
renderer.load(t.box_world((0.5, 0.5, 0.5)))
renderer.render(t.turned(0), [(t.CAMERA, t.EYE)])
child = os.fork()
if child == 0:
    try:
        renderer.render(t.turned(1), [(t.CAMERA, t.EYE)])
    except t.SimError as error:
        os.write(1, str(error).encode())
        os._exit(7)
    os._exit(0)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.thorough
def test_a_forked_child_is_refused_instead_of_hanging(raster: RasterRenderer) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FORKED, str(Path(__file__).parent)],
        capture_output=True,
        text=True,
        timeout=300,
        env=dict(os.environ),
        check=False,
    )
    assert done.returncode == 7, done.stderr
    assert "bound to the thread that created it" in done.stdout


def _body(key: str, solid: trimesh.Trimesh) -> RenderBody:
    mesh = TriangleMesh(
        vertices=solid.triangles.reshape(-1, 3).astype(np.float32),
        normals=solid.face_normals.repeat(3, axis=0).astype(np.float32),
        faces=np.arange(3 * len(solid.faces), dtype=np.uint32).reshape(-1, 3),
    )
    return RenderBody(key=key, entity=key, parts=(VisualPart(mesh=mesh, material=MaterialSpec()),))


def test_standing_objects_darken_the_table_and_high_objects_do_not(raster: RasterRenderer) -> None:
    bodies = (
        _body("ball", trimesh.creation.icosphere(subdivisions=2, radius=0.04)),
        _body("table", trimesh.creation.box((1.5, 1.5, 0.02))),
    )
    raster.load(RenderWorld(bodies=bodies, look=LookSpec(lights=())))
    above = look_at((0.0, 0.0, 1.5), (0.0, 1e-4, 0.0), up=(1.0, 0.0, 0.0))
    camera = replace(CAMERA, width=200, height=200, fov_y_rad=0.2)  # 1.5 mm a pixel

    def around(height: float, distance: int) -> list[float]:
        poses = {"ball": Pose(position=(0.0, 0.0, height)), "table": Pose(position=(0.0, 0.0, -0.01))}
        rgb = raster.render(poses, [(camera, above)])["eye"].rgb.astype(float).mean(axis=2)
        steps = ((0, distance), (0, -distance), (distance, 0), (-distance, 0))
        return [rgb[100 + y, 100 + x] for x, y in steps]

    beside, away, high = around(0.04, 32), around(0.04, 95), around(0.5, 95)
    assert max(beside) < 0.93 * min(away)
    assert np.ptp(beside) < 8.0
    assert np.ptp(high) < 2.0
    assert high == pytest.approx(away, abs=3.0)


@pytest.mark.parametrize(("kind", "edge"), [("sun", 0.35), ("lamp", 0.467)])
def test_a_larger_light_makes_softer_edges(raster: RasterRenderer, kind: str, edge: float) -> None:
    plate = trimesh.creation.box((0.2, 0.2, 0.01))
    bodies = [_body("plate", plate), _body("table", trimesh.creation.box((1.5, 1.5, 0.02)))]
    widths = []
    for radius in (0.01, 0.06):
        light = LightSpec(kind=kind, direction=(0.0, 1.0, -1.0), position=(0.0, -1.0, 1.0), radius=radius)
        raster.load(RenderWorld(bodies=tuple(bodies), look=LookSpec(lights=(light,))))
        poses = {"plate": Pose(position=(0.0, 0.0, 0.25)), "table": Pose(position=(0.0, 0.0, -0.01))}
        above = look_at((0.0, edge, 1.2), (0.0, edge + 1e-3, 0.0), up=(1.0, 0.0, 0.0))
        rgb = raster.render(poses, [(replace(CAMERA, width=400, height=400, fov_y_rad=0.2), above)])["eye"].rgb
        line = rgb[200].astype(float).sum(axis=1)
        widths.append(np.ptp(line) / np.abs(np.diff(line)).max())
    assert widths[1] > 1.5 * widths[0]


def test_a_lamp_casts_no_shadow_behind_itself(raster: RasterRenderer) -> None:
    wall = _body("wall", trimesh.creation.box((0.02, 1.5, 1.5)))
    poses = {"cube": Pose(position=(0.0, 0.0, 0.0)), "wall": Pose(position=(0.6, 0.0, 1.0))}
    images = []
    for shadow in (True, False):
        light = LightSpec(kind="lamp", position=(0.3, 0.0, 0.5), shadow=shadow)
        bodies = (_body("cube", trimesh.creation.box((0.1, 0.1, 0.1))), wall)
        raster.load(RenderWorld(bodies=bodies, look=LookSpec(lights=(light,))))
        images.append(raster.render(poses, [(CAMERA, look_at((-0.3, 0.0, 1.0), (0.6, 0.0, 1.0)))])["eye"].rgb)
    assert np.array_equal(*images)


def test_a_gpu_is_preferred_over_software(monkeypatch: pytest.MonkeyPatch) -> None:
    released: list[str] = []

    class Context:
        def __init__(self, name: str) -> None:
            self.info = {"GL_RENDERER": name}

        def release(self) -> None:
            released.append(self.info["GL_RENDERER"])

    def devices(*names: str) -> None:
        def create(device_index: int, **_: object) -> Context:
            if device_index >= len(names) or not names[device_index]:
                raise Exception("no such device")  # as the real one does
            return Context(names[device_index])

        monkeypatch.setattr("roboxim_sim.rendering.gl.moderngl.create_context", create)

    monkeypatch.delenv("GLCONTEXT_DEVICE_INDEX", raising=False)
    devices("", "llvmpipe (LLVM 15)", "NVIDIA H100/PCIe/SSE2")
    assert create_context().info["GL_RENDERER"] == "NVIDIA H100/PCIe/SSE2"
    devices("llvmpipe (LLVM 15)", "llvmpipe (LLVM 19)", "")
    assert create_context().info["GL_RENDERER"] == "llvmpipe (LLVM 15)"
    assert released == ["llvmpipe (LLVM 15)", "llvmpipe (LLVM 19)"]
    devices()
    with pytest.raises(SimError, match="libegl1"):
        create_context()
