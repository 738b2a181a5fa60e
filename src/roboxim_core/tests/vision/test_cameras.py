"""The camera model: files, image coordinates, distortion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roboxim_core.config import config_dir, from_plain
from roboxim_core.errors import ConfigError, InvalidRequestError
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import CameraNoise, CameraSpec, SceneSpec
from roboxim_core.vision.cameras import CameraConfig, load_camera, project, rays_of_pixels, with_noise_seed

BENT = CameraSpec(
    name="bent", width=160, height=120, intrinsics=(110.0, 108.0, 83.0, 57.5), distortion=(-0.2, 0.04, 1e-3, -5e-4, 0.0)
)


@pytest.mark.parametrize("path", sorted((config_dir() / "cameras").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_shipped_camera_loads_and_makes_an_image(path) -> None:
    camera = load_camera(path.stem)
    assert camera.name == path.stem
    assert np.isfinite(rays_of_pixels(camera)).all()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({}, "either eye and target, or pose"),
        ({"eye": [1, 0, 1]}, "either eye and target, or pose"),
        ({"eye": [1, 0, 1], "target": [0, 0, 0], "pose": {}}, "either eye and target, or pose"),
        ({"eye": [1, 0, 1], "target": [0, 0, 0], "noise": {"shott": 0.1}}, "shot"),
        ({"eye": [1, 0, 1], "target": [0, 0, 0], "noise": {"read": 2.0}}, "read must be 0..1"),
    ],
)
def test_a_wrong_file_says_what_is_wrong(data, message) -> None:
    with pytest.raises(ConfigError, match=message):
        from_plain(data, CameraConfig)


@pytest.mark.parametrize(
    "wrong",
    [{"intrinsics": (1.0, 2.0)}, {"intrinsics": (-1.0, 1.0, 0.0, 0.0)}, {"distortion": (0.1,)}, {"rate_hz": -1.0}],
)
def test_a_camera_that_makes_no_image_is_refused(wrong) -> None:
    with pytest.raises(InvalidRequestError, match="camera 'x'"):
        CameraSpec(name="x", **wrong)


def test_a_field_of_view_and_the_same_intrinsics_are_one_camera() -> None:
    plain = CameraSpec(name="a", width=320, height=200, fov_y_rad=0.9)
    points = np.random.default_rng(0).uniform((-0.4, -0.3, 0.8), (0.4, 0.3, 2.0), (20, 3))
    assert np.allclose(project(plain, points), project(replace(plain, intrinsics=plain.matrix), points))
    assert project(plain, [[0.0, 0.0, 1.0]])[0] == pytest.approx([159.5, 99.5])


@given(st.integers(16, 1024), st.integers(16, 1024))
def test_another_resolution_sees_the_same_field(width: int, height: int) -> None:
    other = BENT.resized(width, height)
    point = [[0.2, -0.1, 1.0]]
    scale = (width / BENT.width, height / BENT.height)
    assert project(other, point)[0] + 0.5 == pytest.approx((project(BENT, point)[0] + 0.5) * scale, abs=1e-6)


def test_the_ray_of_a_pixel_projects_onto_it() -> None:
    rays = rays_of_pixels(BENT).reshape(-1, 2)
    pixels = project(BENT, np.column_stack([rays, np.ones(len(rays))]))
    rows, columns = np.divmod(np.arange(len(rays)), BENT.width)
    assert np.abs(pixels - np.column_stack([columns, rows])).max() < 0.02


def test_a_distortion_that_folds_the_image_is_refused() -> None:
    with pytest.raises(InvalidRequestError, match="folds the image"):
        rays_of_pixels(replace(BENT, distortion=(-0.9, 0.0, 0.0, 0.0, 0.0)))


def test_a_rate_must_divide_the_control_rate() -> None:
    slow = CameraSpec(name="slow", rate_hz=2.5)
    assert slow.ticks_per_frame(10.0) == 4
    assert CameraSpec(name="full").ticks_per_frame(10.0) == 1
    with pytest.raises(InvalidRequestError, match="'slow'.*10 Hz divided by a whole number"):
        SceneSpec(cameras=(replace(slow, rate_hz=4.0),))


def test_the_noise_seed_is_the_episodes() -> None:
    seed = SeedPath(run_seed=1, purpose="test", index=0)
    noisy = CameraSpec(name="a", noise=CameraNoise(read=0.01))
    assert with_noise_seed(CameraSpec(name="a"), seed) == CameraSpec(name="a")
    assert with_noise_seed(noisy, seed) == with_noise_seed(noisy, seed)
    others = {
        with_noise_seed(noisy, replace(seed, index=1)).noise.seed,
        with_noise_seed(replace(noisy, name="b"), seed).noise.seed,
        with_noise_seed(noisy, seed).noise.seed,
    }
    assert len(others) == 3
