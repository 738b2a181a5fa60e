"""Matrices of the cameras and of the main light.

The y axis of clip space points down, so that row 0 of a framebuffer is the top row of the image and no image has to be
flipped after reading. Triangles that are counter-clockwise seen from outside are therefore clockwise for GL.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_core.poses import Pose
from roboxim_core.specs import CameraSpec, LightSpec

Array = npt.NDArray[np.float64]

CASTER_HEIGHT_M = 0.1
"""Typical distance between a shadow's caster and its receiver [m]."""
NOMINAL_EXTENT_M = 1.4
"""Typical extent of all shadow casters together [m]."""
SHADOW_MAP_SIZES = (448, 1024)
"""Minimum and maximum size of a shadow map [texel]; a coarser map would miss thin objects."""
EXTENT_STEP_M = 0.1
"""Step in which the shadow map's extent grows, so that shadow edges do not crawl while the robot moves."""


def clip_from_world(camera: CameraSpec, pose_optical_in_world: Pose) -> Array:
    """Return a pinhole camera's projection from the world to clip space; see `CameraSpec.matrix` for the image axes."""
    fx, fy, cx, cy = camera.matrix
    near, far = camera.near, camera.far
    projection = np.zeros((4, 4))
    projection[0, 0], projection[0, 2] = 2 * fx / camera.width, (2 * cx + 1) / camera.width - 1
    projection[1, 1], projection[1, 2] = 2 * fy / camera.height, (2 * cy + 1) / camera.height - 1
    projection[2, 2:] = (far + near) / (far - near), -2 * far * near / (far - near)
    projection[3, 2] = 1.0
    x, y, z, w = pose_optical_in_world.quat_xyzw
    view = np.eye(4)  # without scipy: its rotation costs as much as all other matrices of a tick
    view[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
        [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)],
        [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)],
    ]
    view[:3, 3] = -view[:3, :3] @ pose_optical_in_world.position
    return projection @ view


def visible(matrix: Array, centers: Array, radii: Array) -> npt.NDArray[np.bool_]:
    """Return which spheres touch a clip volume.

    Args:
        matrix: Clip from world, shape (4, 4).
        centers: Centres in the world, shape (N, 3) [m].
        radii: Radii, shape (N,) [m].
    """
    planes = np.concatenate([matrix[3] + matrix[:3], matrix[3] - matrix[:3]])
    planes /= np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
    return np.asarray((centers @ planes[:, :3].T + planes[:, 3] > -radii[:, None]).all(axis=1))


@dataclass(frozen=True, kw_only=True)
class LightView:
    """The main light's view of the shadow casters."""

    matrix: Array
    """Clip from world, shape (4, 4)."""
    size: int
    """Width and height of the shadow map [texel]."""
    texel_m: float
    """Size of a texel of the shadow map at the casters [m]."""
    softness: float
    """Width of a shadow's edge divided by the distance to its caster."""


def shadow_map_size(light: LightSpec) -> int:
    """Return the shadow map's width and height [texel]: a shadow's edge is as wide as the filter, 3 texels."""
    penumbra = softness(light) * CASTER_HEIGHT_M
    texels = NOMINAL_EXTENT_M / max(penumbra / 3, 1e-4)
    return int(np.clip(64 * round(texels / 64), *SHADOW_MAP_SIZES))


def softness(light: LightSpec) -> float:
    """Return the width of a shadow's edge divided by the distance to its caster."""
    distance = float(np.linalg.norm(light.position)) if light.kind == "lamp" else 1.0
    return 2 * light.radius / max(distance, 0.1)


def light_view(light: LightSpec, centers: Array, radii: Array) -> LightView:
    """Fit the light's view around the casters.

    Args:
        light: The light.
        centers: Centres of the casters' bounding spheres, shape (N, 3), N > 0 [m].
        radii: Radii of these spheres, shape (N,) [m].
    """
    size = shadow_map_size(light)
    if light.kind == "lamp":
        return _lamp_view(light, centers, radii, size)
    axes = _axes(np.asarray(light.direction))
    points = centers @ axes.T
    low, high = (points - radii[:, None]).min(axis=0), (points + radii[:, None]).max(axis=0)
    extent = math.ceil((high - low)[:2].max() / EXTENT_STEP_M + 0.5) * EXTENT_STEP_M
    extent = max(extent, NOMINAL_EXTENT_M)  # so that shadow edges are as soft when the casters are few and small
    texel = extent / size
    middle = np.round((low + high)[:2] / 2 / texel) * texel
    scale = np.array([2 / extent, 2 / extent, 2 / (high - low)[2]])
    matrix = np.eye(4)
    matrix[:3, :3] = scale[:, None] * axes
    matrix[:3, 3] = -scale * np.array([*middle, (low + high)[2] / 2])
    return LightView(matrix=matrix, size=size, texel_m=texel, softness=softness(light))


def _lamp_view(light: LightSpec, centers: Array, radii: Array, size: int) -> LightView:
    position = np.asarray(light.position)
    low, high = (centers - radii[:, None]).min(axis=0), (centers + radii[:, None]).max(axis=0)
    middle = (low + high) / 2
    radius = float((np.linalg.norm(centers - middle, axis=1) + radii).max())
    distance = max(float(np.linalg.norm(middle - position)), 1e-3)
    half_angle = math.asin(min(radius / distance, math.sin(math.radians(70.0))))
    half_angle = max(half_angle, math.atan(min(NOMINAL_EXTENT_M / 2 / distance, 2.0)))
    near, far = max(distance - radius, 0.05), distance + radius
    axes = _axes(middle - position)
    view = np.eye(4)
    view[:3, :3] = axes
    view[:3, 3] = -axes @ position
    projection = np.zeros((4, 4))
    projection[0, 0] = projection[1, 1] = 1 / math.tan(half_angle)
    projection[2, 2:] = (far + near) / (far - near), -2 * far * near / (far - near)
    projection[3, 2] = 1.0
    texel = 2 * distance * math.tan(half_angle) / size
    return LightView(matrix=projection @ view, size=size, texel_m=texel, softness=softness(light))


def _axes(forward: Array) -> Array:
    """Return the axes of an orthonormal right-handed frame as rows; the third is along ``forward``."""
    z = forward / max(float(np.linalg.norm(forward)), 1e-9)
    side = np.array([0.0, 1.0, 0.0]) if abs(z[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    x = np.cross(side, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
