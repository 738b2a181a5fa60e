"""What a tick's pictures need to know besides geometry, computed once for all cameras. Plain numpy, no GL."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from roboxim_core.poses import IDENTITY, Pose, Vec3
from roboxim_core.specs import LightSpec, LookSpec
from roboxim_sim.rendering.geometry import SURROUNDINGS, PackedWorld, linear
from roboxim_sim.rendering.views import LightView, light_view, visible

Array = npt.NDArray[np.float64]

DRAWN_LAST = ("table", *SURROUNDINGS)
"""Large entities behind the others, so that what hides them is drawn first and they are not shaded in vain."""


class Frame:
    """One tick of a packed world."""

    def __init__(self, packed: PackedWorld, look: LookSpec, poses: Mapping[str, Pose], shadow_size: int) -> None:
        """Place the bodies.

        Args:
            packed: The world.
            look: Its lights.
            poses: Body key to pose in the world; left out: identity.
            shadow_size: Width and height of the shadow map [texel].
        """
        bodies = packed.bodies
        self.matrices = _matrices([poses.get(body.key, IDENTITY) for body in bodies])
        local = np.array([[*body.center, 1.0] for body in bodies]).reshape(-1, 4, 1)
        self.centers: Array = (self.matrices @ local)[:, :3, 0]
        self.radii: Array = np.array([body.radius for body in bodies], dtype=float)
        self.casters = np.array([body.entity not in SURROUNDINGS for body in bodies], dtype=bool)
        self.objects = np.array([body.entity not in DRAWN_LAST for body in bodies], dtype=bool)
        self._shadow_size = shadow_size
        ambient = np.asarray(look.ambient, dtype=float)
        self.sky: Vec3 = tuple((1.25 * ambient).tolist())
        self.ground: Vec3 = tuple((ambient * (0.72, 0.66, 0.6)).tolist())
        self.backdrop: Vec3 = look.backdrop
        main = next((light for light in look.lights if light.shadow), None)
        self.lights: tuple[LightSpec, ...] = look.lights
        if main is not None:
            self.lights = (main, *(light for light in look.lights if light is not main))
        self.shadowed = main is not None and bool(self.casters.any())

    @cached_property
    def light(self) -> LightView:
        """The main light's view; only where `shadowed`."""
        return light_view(self.lights[0], self.centers[self.casters], self.radii[self.casters], self._shadow_size)

    @cached_property
    def contact_box(self) -> tuple[float, float, float, float]:
        """Square around the objects seen from above: lower corner x, y [m], one over its extent, twice [1/m]."""
        if not self.objects.any():
            return 0.0, 0.0, 1.0, 1.0
        centers, radii = self.centers[self.objects, :2], self.radii[self.objects, None]
        low, high = (centers - radii).min(axis=0), (centers + radii).max(axis=0)
        extent = float(np.ceil((high - low).max() / 0.2 + 0.5) * 0.2)
        x, y = (np.round((low + high) / 2 / 0.01) * 0.01 - extent / 2).tolist()
        return x, y, 1 / extent, 1 / extent

    def order(self, clip_from_world: Array, eye: Array) -> npt.NDArray[np.intp]:
        """Return the indices of the bodies that a camera may see, in drawing order: near first, large ones last."""
        seen = np.flatnonzero(visible(clip_from_world, self.centers, self.radii))
        distance = np.linalg.norm(self.centers[seen] - eye, axis=1) - self.radii[seen]
        return seen[np.lexsort((distance, ~self.objects[seen]))]

    def light_vectors(self) -> tuple[Array, Array]:
        """Return the lights for the shader: vectors (N, 4) (w: 0 sun, else a lamp's range squared), colours (N, 3)."""
        count = max(len(self.lights), 1)  # no light at all: a black one
        vectors, colors = np.zeros((count, 4)), np.zeros((count, 3))
        vectors[:, 2] = 1.0
        for i, light in enumerate(self.lights):
            colors[i] = linear(light.color) * light.intensity / np.pi
            if light.kind == "lamp":
                vectors[i] = *light.position, max(float(np.dot(light.position, light.position)), 0.01)
            else:
                vectors[i, :3] = -np.asarray(light.direction) / np.linalg.norm(light.direction)
        return vectors, colors


def _matrices(poses: Sequence[Pose]) -> Array:
    """Return homogeneous matrices, shape (N, 4, 4), in one go: a scipy rotation for each would take a millisecond."""
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    if poses:
        matrices[:, :3, :3] = Rotation.from_quat([pose.quat_xyzw for pose in poses]).as_matrix()
        matrices[:, :3, 3] = [pose.position for pose in poses]
    return matrices
