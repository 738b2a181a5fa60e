"""The cameras of a scene on a real renderer: intrinsics, distortion, noise, rate, and `CameraInfo`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
import trimesh
from sensor_msgs.msg import CameraInfo

from roboxim_core.errors import ErrorCode, InvalidRequestError, SimError
from roboxim_core.poses import Pose, look_at
from roboxim_core.specs import CameraNoise, CameraSpec, LookSpec, MaterialSpec, SceneSpec
from roboxim_core.vision.cameras import project, rays_of_pixels
from roboxim_core.vision.renderer import CameraImages, RenderBody, Renderer, RenderWorld, TriangleMesh, VisualPart
from roboxim_sim.conversions import camera_info_msg
from roboxim_sim.rendering import make_renderer
from roboxim_sim.rendering.camera_effects import CameraRig, Lens, draw_frames

EYE = look_at((0.9, 0.5, 0.6), (0.0, 0.05, 0.0))
PLAIN = CameraSpec(name="eye", width=360, height=270, depth=True, segmentation=True)
CALIBRATED = replace(PLAIN, intrinsics=(330.0, 363.0, 157.0, 149.5))
BARREL = replace(CALIBRATED, distortion=(-0.25, 0.06, 2e-3, -1e-3, 0.0))
PINCUSHION = replace(PLAIN, distortion=(0.3, 0.1, 0.0, 0.0, 0.02))
NOISY = replace(PLAIN, noise=CameraNoise(shot=0.03, read=0.01, depth=0.01, seed=5))


@pytest.fixture(scope="module", params=["raster", "tiny"])
def renderer(request: pytest.FixtureRequest) -> Iterator[Renderer]:
    try:
        made = make_renderer(request.param)
    except SimError as error:
        if error.code != ErrorCode.RENDERER_UNAVAILABLE:
            raise
        pytest.skip(str(error))
    yield made
    made.close()


def body(key: str, shape: trimesh.Trimesh) -> RenderBody:
    mesh = TriangleMesh(
        vertices=shape.triangles.reshape(-1, 3).astype(np.float32),
        normals=shape.face_normals.repeat(3, axis=0).astype(np.float32),
        faces=np.arange(3 * len(shape.faces), dtype=np.uint32).reshape(-1, 3),
    )
    return RenderBody(key=key, entity=key, parts=(VisualPart(mesh=mesh, material=MaterialSpec(color=(0.5, 0.5, 0.5))),))


def world(count: int = 1) -> RenderWorld:
    """Small balls, and nothing around them."""
    marker = trimesh.creation.icosphere(subdivisions=2, radius=0.025)
    return RenderWorld(bodies=tuple(body(f"p{i}", marker) for i in range(count)), look=LookSpec())


def floor(renderer: Renderer) -> Renderer:
    """A wide grey floor is loaded."""
    box = trimesh.creation.box((6.0, 6.0, 0.02))
    renderer.load(RenderWorld(bodies=(body("ground", box),), look=LookSpec()))
    return renderer


def projected(info: CameraInfo, points: np.ndarray) -> np.ndarray:
    """Project points of the optical frame as a user of the message would."""
    matrix = np.array(info.k).reshape(3, 3)
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(info.d))[0].reshape(-1, 2)


@pytest.mark.parametrize(
    ("renderer", "camera"),
    [("raster", PLAIN), ("raster", CALIBRATED), ("raster", BARREL), ("raster", PINCUSHION), ("tiny", CALIBRATED)],
    ids=["raster-fov", "raster-k", "raster-barrel", "raster-pincushion", "tiny-k"],
    indirect=["renderer"],
)
def test_known_points_are_where_camera_info_says(renderer: Renderer, camera: CameraSpec) -> None:
    """Projected with the message's K and D alone, as a user would, within half a pixel."""
    info = camera_info_msg(0, camera)
    assert (info.width, info.height, info.distortion_model) == (camera.width, camera.height, "plumb_bob")
    points = np.random.default_rng(2).uniform(-0.24, 0.24, (8, 3))
    renderer.load(world(len(points)))
    optical = EYE.inverse().apply(points)
    seen = 0
    for i, expected in enumerate(projected(info, optical)):
        poses = {f"p{j}": Pose(position=(0.0, 0.0, -50.0)) for j in range(len(points))}
        poses[f"p{i}"] = Pose.from_arrays(points[i])
        ids = draw_frames(renderer, 0, poses, [(camera, EYE)])["eye"].segmentation
        assert ids is not None
        rows, columns = np.nonzero(ids == i + 1)
        inside = 15 < expected[0] < camera.width - 16 and 15 < expected[1] < camera.height - 16
        if inside:
            assert [columns.mean(), rows.mean()] == pytest.approx(expected.tolist(), abs=0.5)
            seen += 1
        elif not (-16 < expected[0] < camera.width + 15 and -16 < expected[1] < camera.height + 15):
            assert len(rows) == 0
    assert seen >= 6


def test_depth_stays_metric_with_distortion(renderer: Renderer) -> None:
    poses = {"ground": Pose(position=(0.0, 0.0, -0.01))}
    down = look_at((0.0, 0.0, 1.2), (0.0, 0.0, 0.0), up=(1.0, 0.0, 0.0))
    images = draw_frames(floor(renderer), 0, poses, [(BARREL, down)])["eye"]
    assert images.depth is not None
    assert np.abs(images.depth - 1.2).max() < 1e-3
    assert images.rgb.shape == (270, 360, 3)
    assert images.depth.shape == (270, 360)


def test_opencv_undistorts_the_image_to_that_of_a_pinhole(renderer: Renderer) -> None:
    """`cv2.undistort` with the message's K and D, as a user would rectify, gives what a perfect lens sees."""
    renderer.load(world(30))
    points = np.random.default_rng(2).uniform(-0.24, 0.24, (30, 3))
    poses = {f"p{i}": Pose.from_arrays(point) for i, point in enumerate(points)}
    near = look_at((0.6, 0.35, 0.4), (0.0, 0.05, 0.0))
    bent, straight = (draw_frames(renderer, 0, poses, [(camera, near)])["eye"].rgb for camera in (BARREL, CALIBRATED))
    info = camera_info_msg(0, BARREL)
    rectified = cv2.undistort(bent, np.array(info.k).reshape(3, 3), np.array(info.d))

    def error(image: np.ndarray) -> float:
        """Mean difference from the perfect lens' image, whose edges are sharper."""
        smooth, ideal = (cv2.GaussianBlur(each.astype(float), (0, 0), 1.5) for each in (image, straight))
        return float(np.abs(smooth - ideal)[30:-30, 30:-30].mean())

    assert error(bent) > 4 * error(rectified)


def test_noise_depends_on_seed_camera_and_tick_only(renderer: Renderer) -> None:
    poses = {"ground": Pose(position=(0.0, 0.0, -0.01))}

    def take(camera: CameraSpec, seq: int):
        images = draw_frames(floor(renderer), seq, poses, [(camera, EYE)])[camera.name]
        return images.rgb, images.depth

    rgb, depth = take(NOISY, 3)
    again, depth_again = take(NOISY, 3)
    assert np.array_equal(rgb, again)
    assert np.array_equal(depth, depth_again)
    assert not np.array_equal(rgb, take(NOISY, 4)[0])
    assert not np.array_equal(rgb, take(replace(NOISY, noise=replace(NOISY.noise, seed=6)), 3)[0])
    assert not np.array_equal(rgb, take(replace(NOISY, name="other"), 3)[0])
    assert np.array_equal(rgb, take(replace(NOISY, depth=False), 3)[0])
    ideal, ideal_depth = take(PLAIN, 3)
    assert not np.array_equal(ideal, rgb)
    near = ideal_depth < 2.0
    assert np.std((depth[near] - ideal_depth[near]) / ideal_depth[near] ** 2) == pytest.approx(0.01, rel=0.1)


def test_exposure_and_blur_take_effect(renderer: Renderer) -> None:
    poses = {"ground": Pose(position=(0.0, 0.0, -0.01))}

    def take(**noise: float) -> np.ndarray:
        camera = replace(PLAIN, noise=CameraNoise(**noise))
        return draw_frames(floor(renderer), 0, poses, [(camera, EYE)])["eye"].rgb.astype(float)

    ideal = take()
    assert take(exposure_ev=1.0).mean() > ideal.mean() + 20
    assert take(exposure_ev=-1.0).mean() < ideal.mean() - 20
    edges = np.abs(np.diff(ideal, axis=0)).max()
    assert np.abs(np.diff(take(blur_px=2.0), axis=0)).max() < 0.6 * edges


def test_a_slow_camera_repeats_its_frame_until_the_next(renderer: Renderer) -> None:
    slow, fast = replace(PLAIN, name="slow", rate_hz=2.5), replace(PLAIN, name="fast")
    scene = SceneSpec(cameras=(slow, fast))
    rig = CameraRig(renderer)
    rig.load(world(), scene)
    views = [(slow, EYE), (fast, EYE)]

    def take(seq: int, stamp_ns: int) -> dict[str, CameraImages]:
        return rig.capture(seq, stamp_ns, {"p0": Pose(position=(0.02 * seq, 0.0, 0.0))}, views)

    taken = [take(seq, seq * scene.tick_ns) for seq in range(9)]
    distinct = [not np.array_equal(a["slow"].rgb, b["slow"].rgb) for a, b in pairwise(taken)]
    assert distinct == [False, False, False, True, False, False, False, True]
    assert all(not np.array_equal(a["fast"].rgb, b["fast"].rgb) for a, b in pairwise(taken))
    assert np.array_equal(taken[4]["slow"].rgb, taken[4]["fast"].rgb)
    rig.load(world(), scene)
    restarted = take(1, scene.tick_ns)
    assert np.array_equal(restarted["slow"].rgb, restarted["fast"].rgb)
    times = (scene.tick_ns + 1, 3 * scene.tick_ns, 40 * scene.tick_ns, 40 * scene.tick_ns)
    free = [take(seq, stamp_ns) for seq, stamp_ns in enumerate(times, 2)]
    assert [one["slow"] is restarted["slow"] for one in free] == [True, True, False, False]
    assert np.array_equal(free[3]["slow"].rgb, free[3]["fast"].rgb), "an object was moved at the time of a frame"


def test_an_impossible_lens_is_refused_when_the_scene_is_loaded(renderer: Renderer) -> None:
    folded = replace(PLAIN, fov_y_rad=2.0, distortion=(-0.5, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(InvalidRequestError, match="'eye'.*folds"):
        CameraRig(renderer).load(world(), SceneSpec(cameras=(folded,)))


@pytest.mark.parametrize(("width", "px"), [(360, 0.3), (2592, 0.6)])
def test_a_lens_picks_the_pixels_of_its_rays_at_any_size(width: int, px: float) -> None:
    camera = replace(BARREL, width=width, height=64, intrinsics=(0.9 * width, 0.9 * width, width / 2, 32.0))
    lens = Lens(camera)
    fx, _, cx, _ = lens.source.matrix
    columns = np.broadcast_to((np.arange(lens.source.width) - cx) / fx, (lens.source.height, lens.source.width))
    plain = CameraImages(rgb=np.zeros((*columns.shape, 3), np.uint8), depth=columns.astype(np.float32))
    bent = lens.bend(plain)
    assert bent.rgb.shape == (64, width, 3)
    assert np.abs(bent.depth - rays_of_pixels(camera)[..., 0]).max() < px / camera.matrix[0]


def test_the_projection_agrees_with_the_core(renderer: Renderer) -> None:
    """`project` and the message agree, so that a user may take either."""
    point = np.array([[0.1, -0.05, 0.9]])
    info = camera_info_msg(0, BARREL)
    assert project(BARREL, point)[0] == pytest.approx(projected(info, point)[0])
