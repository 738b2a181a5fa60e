"""The camera model: YAML files of ``config/cameras``, and projection of points into the image.

Image coordinates are those of ``sensor_msgs/CameraInfo``: (0, 0) is the centre of the upper left pixel, u points
right, v down. Lens distortion follows the ``plumb_bob`` model of ROS and is computed by OpenCV.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from roboxim_core.config import load_config, named_config
from roboxim_core.errors import ConfigError, InvalidRequestError
from roboxim_core.poses import Array, Pose, Vec3, look_at
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import CameraNoise, CameraSpec

MAX_ERROR_PX = 0.01
"""Largest distance between a pixel and the projection of its ray [px]; above it, the distortion cannot be inverted."""


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """Parameters of a pinhole camera at the file's ``width`` and ``height``; other sizes scale them."""

    fx: float
    """Focal length along u [px]."""
    fy: float
    """Focal length along v [px]."""
    cx: float
    """Principal point, u [px]."""
    cy: float
    """Principal point, v [px]."""


@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """Content of a YAML file of ``config/cameras``."""

    parent: str = "world"
    """``world``, the robot link that it is mounted on, or ``gripper``, the hand of any robot."""
    eye: Vec3 | None = None
    """Position in the parent [m], together with ``target``."""
    target: Vec3 | None = None
    """Point in the parent that is on the optical axis [m]."""
    up: Vec3 = (0.0, 0.0, 1.0)
    """Direction in the parent that points up in the image."""
    pose: Pose | None = None
    """Pose of the optical frame in the parent, instead of ``eye`` and ``target``."""
    fov_y_deg: float = 45.0
    """Vertical field of view [deg]; ignored if ``intrinsics`` are given."""
    intrinsics: Intrinsics | None = None
    """Focal lengths and principal point, e.g. from a calibration."""
    distortion: tuple[float, ...] = ()
    """Distortion coefficients k1, k2, p1, p2, k3, e.g. from a calibration."""
    width: int = 256
    """Image width [px]."""
    height: int = 256
    """Image height [px]."""
    near: float = 0.02
    """Nearest visible distance [m]."""
    far: float = 6.0
    """Farthest visible distance [m]."""
    rate_hz: float = 0.0
    """Frames per simulated second; 0: one at every tick."""
    noise: CameraNoise = CameraNoise()
    """Noise of the sensor; its seed is drawn for each episode."""
    depth: bool = False
    """Whether the camera delivers metric depth."""
    segmentation: bool = False
    """Whether the camera delivers entity segmentation."""

    def __post_init__(self) -> None:
        """Check that exactly one pose is given.

        Raises:
            ConfigError: When none or two are given.
        """
        placed = self.eye is not None and self.target is not None
        if placed == (self.pose is not None) or (self.eye is None) != (self.target is None):
            raise ConfigError("a camera needs either eye and target, or pose")

    def spec(self, name: str) -> CameraSpec:
        """Return the camera's specification.

        Raises:
            InvalidRequestError: When no image can be made with these numbers.
        """
        pose = self.pose
        if self.eye is not None and self.target is not None:
            pose = look_at(self.eye, self.target, self.up)
        assert pose is not None
        k = self.intrinsics
        return CameraSpec(
            name=name, parent=self.parent, pose=pose, fov_y_rad=math.radians(self.fov_y_deg),
            intrinsics=(k.fx, k.fy, k.cx, k.cy) if k else (), distortion=self.distortion,
            width=self.width, height=self.height, near=self.near, far=self.far, rate_hz=self.rate_hz,
            noise=self.noise, depth=self.depth, segmentation=self.segmentation,
        )  # fmt: skip


def load_camera(name: str) -> CameraSpec:
    """Load a camera by its name in ``config/cameras``, or from the path of a YAML file, whose stem becomes the name.

    Raises:
        ConfigError: When no camera has that name, or its file is invalid.
    """
    path = named_config("cameras", name)
    try:
        return _load(path, path.stat().st_mtime_ns)
    except InvalidRequestError as error:
        raise ConfigError(f"{path}: {error}") from None


@lru_cache(maxsize=64)
def _load(path: Path, _mtime_ns: int) -> CameraSpec:
    return load_config(path, CameraConfig).spec(path.stem)


def with_noise_seed(camera: CameraSpec, seed: SeedPath) -> CameraSpec:
    """Return a noisy camera with the noise seed of an episode; return a camera without noise unchanged."""
    if camera.noise == CameraNoise(seed=camera.noise.seed):
        return camera
    return replace(camera, noise=replace(camera.noise, seed=seed.derived_seed(f"camera_noise/{camera.name}")))


def project(camera: CameraSpec, points: npt.ArrayLike) -> Array:
    """Project points into the image.

    Args:
        camera: The camera.
        points: Points in the optical frame (x right, y down, z forward), shape (N, 3), z > 0 [m].

    Returns:
        u, v of each point [px], shape (N, 2); pixel centres are at integers.
    """
    import cv2

    xyz = np.asarray(points, dtype=float).reshape(-1, 1, 3)
    pixels, _ = cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), *_calibration(camera))
    return np.asarray(pixels, dtype=float).reshape(-1, 2)


def rays_of_pixels(camera: CameraSpec) -> Array:
    """Return the ray through every pixel's centre as x / z, y / z in the optical frame, shape (height, width, 2).

    Raises:
        InvalidRequestError: When the distortion folds the image, so that a pixel shows no point or several points.
    """
    import cv2

    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    pixels = np.stack([u, v], axis=-1)
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-9)  # iterations, error [px]
    found = cv2.undistortPoints(pixels.reshape(-1, 1, 2), *_calibration(camera), criteria=until)
    rays: Array = np.asarray(found, dtype=float).reshape(-1, 2)
    error = project(camera, np.column_stack([rays, np.ones(len(rays))])) - pixels.reshape(-1, 2)
    if not np.abs(error).max() < MAX_ERROR_PX or (_radial_derivative(camera, rays) <= 0).any():
        raise InvalidRequestError(
            f"camera '{camera.name}': the distortion {camera.distortion} folds the image at its edges; "
            "it was calibrated for a narrower field of view"
        )
    shaped: Array = rays.reshape(camera.height, camera.width, 2)
    return shaped


def _calibration(camera: CameraSpec) -> tuple[Array, Array]:
    """Return a camera's matrix K, shape (3, 3) [px], and its distortion coefficients D, shape (5,), for OpenCV."""
    fx, fy, cx, cy = camera.matrix
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return matrix, np.array(camera.distortion or (0.0,) * 5)


def _radial_derivative(camera: CameraSpec, rays: Array) -> Array:
    """Return the derivative of the distorted radius with respect to the undistorted one at rays, shape (N,)."""
    k1, k2, _, _, k3 = camera.distortion or (0.0,) * 5
    r2 = (rays**2).sum(axis=1)
    derivative: Array = 1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3))
    return derivative


def ideal_camera(camera: CameraSpec) -> CameraSpec:
    """Return the camera without lens distortion and without noise."""
    return replace(camera, distortion=(), noise=CameraNoise())
