"""Per-tick rendering data besides geometry, computed once for all cameras. Plain numpy, no GL."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.specs import CameraSpec, LightSpec, LookSpec
from roboxim_sim.rendering.geometry import OBJECTS_LAYER, SURROUNDINGS_LAYER, TABLE_LAYER, PackedWorld, linear
from roboxim_sim.rendering.views import LightView, clip_from_world, light_view, visible

Array = npt.NDArray[np.float64]

MAX_LIGHTS = 4
CONTACT_REACH_M = 0.17
"""Height above the table up to which an object darkens the table."""
PIXELS_PER_FACE = 6.0
"""A body with fewer visible pixels per face is drawn with its coarse shape: a software rasteriser shades a whole block
of pixels for each face that touches it."""
TO_TEXTURE = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1]])


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Index ranges that one draw call draws."""

    flags: tuple[str, ...]
    """Features that the shader needs: ``TEXTURE``, ``SHADOW``, ``CONTACT``, ``OVERHANG``."""
    ranges: tuple[range, ...]
    """Ranges of the indices, in drawing order."""


class Frame:
    """One tick of a packed world."""

    def __init__(self, packed: PackedWorld, look: LookSpec, poses: Mapping[str, Pose]) -> None:
        """Place the bodies.

        Args:
            packed: The world.
            look: The world's lights.
            poses: Poses in the world by body key; missing ones are the identity.
        """
        self._packed, self._look = packed, look
        bodies = packed.bodies
        self._clips: dict[str, Array] = {}
        self.matrices = _matrices([poses.get(body.key, IDENTITY) for body in bodies])
        self.centers: Array = (self.matrices[:, :3, :3] @ packed.centers[:, :, None])[:, :, 0] + self.matrices[:, :3, 3]
        self.radii = packed.radii
        self._slab = None if packed.slab is None else self._box(packed.slab)
        # The shadow map holds the objects on the table; the shader computes the table's shadow, a rectangle.
        self.casters = packed.layers != SURROUNDINGS_LAYER
        if packed.slab is not None:
            self.casters[packed.slab] = False
        top = self._slab[1][2] if self._slab else -np.inf
        self.touching = (packed.layers == OBJECTS_LAYER) & (self.centers[:, 2] - self.radii < top + CONTACT_REACH_M)
        self.touching[packed.tables] = False
        """Bodies that may darken the table below them."""
        main = next((light for light in look.lights if light.shadow), None)
        self.lights: tuple[LightSpec, ...] = look.lights
        if main is not None:
            self.lights = (main, *(light for light in look.lights if light is not main))
        self.backdrop = look.backdrop
        self.shadowed = main is not None and bool(self.casters.any())

    @cached_property
    def light(self) -> LightView:
        """The main light's view; valid only when `shadowed`."""
        return light_view(self.lights[0], self.centers[self.casters], self.radii[self.casters])

    @cached_property
    def contact_box(self) -> tuple[float, float, float, float]:
        """Square around the contact bodies: lower corner x, y [m], 1 / extent [1/m], height of the table's top [m]."""
        centers, radii = self.centers[self.touching, :2], self.radii[self.touching, None]
        low, high = (centers - radii).min(axis=0), (centers + radii).max(axis=0)
        extent = float(np.ceil((high - low).max() / 0.2 + 0.7) * 0.2)
        x, y = (np.round((low + high) / 2 / 0.01) * 0.01 - extent / 2).tolist()
        return x, y, 1 / extent, float(self._slab[1][2]) if self._slab else 0.0

    def shadow_ranges(self) -> tuple[range, ...]:
        """Return the index ranges of all shadow casters."""
        return tuple(self._packed.bodies[i].shadow for i in np.flatnonzero(self.casters))

    def contact_ranges(self) -> tuple[range, ...]:
        """Return the index ranges of the bodies that may darken the table."""
        return tuple(self._packed.bodies[i].shadow for i in np.flatnonzero(self.touching))

    def batches(self, camera: CameraSpec, pose: Pose) -> list[Batch]:
        """Return what a camera may see, in drawing order: near bodies first, table and surroundings last.

        Bodies with the same shader features form a batch, so that no body pays for features that it does not use.
        """
        seen = np.flatnonzero(visible(self.clip(camera, pose), self.centers, self.radii))
        distances = np.linalg.norm(self.centers[seen] - np.asarray(pose.position), axis=1)
        pixels = max(camera.matrix[:2]) * self.radii[seen] / np.maximum(distances, camera.near)
        fine = 2 * np.pi * pixels**2 > PIXELS_PER_FACE * self._packed.faces[seen]
        order = np.argsort(distances - self.radii[seen], kind="stable")
        kinds: dict[tuple[int, bool], list[range]] = {}
        shadowed = self._reached if self.shadowed else np.zeros(len(self.radii), dtype=bool)
        codes = (2 * self._packed.layers + shadowed)[seen]
        for i, code, whole in zip(seen[order].tolist(), codes[order].tolist(), fine[order].tolist(), strict=True):
            body = self._packed.bodies[i]
            if body.plain:
                kinds.setdefault((code, False), []).append(body.plain if whole else body.plain_coarse)
            if body.textured:
                kinds.setdefault((code, True), []).append(body.textured if whole else body.textured_coarse)
        return [Batch(flags=self._flags(*kind), ranges=tuple(kinds[kind])) for kind in sorted(kinds)]

    def _flags(self, code: int, texture: bool) -> tuple[str, ...]:
        layer, shadow = divmod(code, 2)
        return (
            *(["TEXTURE"] if texture else []),
            *(["SHADOW"] if shadow else []),
            *(["CONTACT"] if layer == TABLE_LAYER and self.touching.any() else []),
            *(["OVERHANG"] if layer == SURROUNDINGS_LAYER and shadow and self._slab else []),
        )

    def clip(self, camera: CameraSpec, pose: Pose) -> Array:
        """Return a camera's projection from the world, computed once."""
        if camera.name not in self._clips:
            self._clips[camera.name] = clip_from_world(camera, pose)
        return self._clips[camera.name]

    def view(self, camera: CameraSpec, pose: Pose) -> bytes:
        """Return the shaders' uniform block ``View`` for a camera."""
        own = np.concatenate([self.clip(camera, pose).T.ravel(), self._light_matrix.T.ravel(), pose.position])
        return own.astype(np.float32).tobytes() + self._common

    @cached_property
    def _light_matrix(self) -> Array:
        return TO_TEXTURE @ self.light.matrix if self.shadowed else np.eye(4)

    @cached_property
    def _common(self) -> bytes:
        """Return the part of the uniform block ``View`` that all cameras share."""
        vectors, colors = self._light_vectors()
        size, offset = (self.light.size, 1.5 * self.light.texel_m) if self.shadowed else (1, 0.0)
        ambient = np.asarray(self._look.ambient, dtype=float)
        rows = [
            [offset],
            [*(1.1 * ambient), len(self.lights) - 1],
            [*(ambient * (0.5, 0.45, 0.4)), size],
            vectors[0],
            colors[0],
            self.contact_box if self.touching.any() else [0.0, 0.0, 1.0, 0.0],
            *self._overhang(),
            vectors[1:].ravel(),
            colors[1:].ravel(),
        ]
        return np.concatenate(rows).astype(np.float32).tobytes()

    def _overhang(self) -> tuple[Array, Array]:
        """Return the table's shadow: (centre x, y, top z, 1), (half extent x, y, width of the edge over height, 0)."""
        if self._slab is None:
            return np.zeros(4), np.ones(4)
        low, high = self._slab
        middle, half = (low + high) / 2, (high - low) / 2
        softness = self.light.softness if self.shadowed else 0.0
        return np.array([*middle[:2], high[2], 1.0]), np.array([*half[:2], softness, 0.0])

    @cached_property
    def _reached(self) -> npt.NDArray[np.bool_]:
        """Return which bodies a shadow may fall on, by their bounding boxes in the light's view."""
        corners = self._packed.corners @ self.matrices[:, :3, :3].transpose(0, 2, 1) + self.matrices[:, None, :3, 3]
        clip = corners @ self.light.matrix[:, :3].T + self.light.matrix[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = clip[..., :2] / clip[..., 3:]
        low, high = flat.min(axis=1), flat.max(axis=1)
        of_casters, of_slab = np.array([[-1.0, -1.0], [1.0, 1.0]]), low[:0]
        if self._slab is not None:
            of_slab = np.stack([low[self._packed.slab], high[self._packed.slab]])
        bounds = np.concatenate([of_casters, of_slab])
        missed = (low > bounds.max(axis=0)).any(axis=1) | (high < bounds.min(axis=0)).any(axis=1)
        return np.asarray(~missed | (clip[..., 3] <= 0).any(axis=1))

    def _box(self, i: int) -> tuple[Array, Array]:
        """Return the lower and upper corner of a body's bounding box in the world."""
        reach = np.abs(self.matrices[i, :3, :3]) @ self._packed.bodies[i].half
        return self.centers[i] - reach, self.centers[i] + reach

    def _light_vectors(self) -> tuple[Array, Array]:
        """Return all lights for the shader: vectors (N, 4) (w: 0 sun, else a lamp's range squared), colours (N, 4)."""
        vectors, colors = np.zeros((MAX_LIGHTS, 4)), np.zeros((MAX_LIGHTS, 4))
        vectors[:, 2] = 1.0
        for i, light in enumerate(self.lights):
            colors[i, :3] = linear(light.color) * light.intensity / np.pi
            if light.kind == "lamp":
                vectors[i] = *light.position, max(float(np.dot(light.position, light.position)), 0.01)
            else:
                vectors[i, :3] = -np.asarray(light.direction) / np.linalg.norm(light.direction)
        return vectors, colors


def _matrices(poses: Sequence[Pose]) -> Array:
    """Return homogeneous matrices, shape (N, 4, 4), vectorised: a scipy rotation per pose would take a millisecond."""
    from scipy.spatial.transform import Rotation

    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    if poses:
        matrices[:, :3, :3] = Rotation.from_quat([pose.quat_xyzw for pose in poses]).as_matrix()
        matrices[:, :3, 3] = [pose.position for pose in poses]
    return matrices
