"""Ambient occlusion of each vertex by its own body (openness), computed once when the body is loaded.

The body's depth is drawn from many sides into one image, in which each vertex is then looked up. Darkness inside a
mug, under a plate's rim and between the robot's covers thus adds no cost to a tick.
"""

from __future__ import annotations

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import moderngl
import numpy as np
import numpy.typing as npt

from roboxim_core.vision.renderer import TriangleMesh
from roboxim_sim.rendering.gl import Buffer, Shader
from roboxim_sim.rendering.lod import same

Array = npt.NDArray[np.float64]

COLUMNS, ROWS = 8, 4
"""Columns and rows of the image in which the views from all sides are laid out."""
CELL = 96
"""Width and height of the view from one side [px]."""
BIAS = 0.03
"""Surfaces nearer than this fraction of the body's radius do not occlude."""
FLOOR = 0.25
"""Fraction of the light that reaches fully occluded points by reflection between walls."""
MAX_FACES = 20_000
"""Bodies with more faces are assumed open: drawing them from all sides would take too long."""

_Known = WeakKeyDictionary[TriangleMesh, tuple[list[TriangleMesh], list[npt.NDArray[np.uint8]]]]
_KNOWN: dict[str, _Known] = {}
"""By device, openness by a body's first mesh, with its other meshes: all renderers of a process share it."""


class OcclusionBaker:
    """Computes openness on the GL context that created it."""

    def __init__(self, context: moderngl.Context) -> None:
        """Create the shader and the framebuffer."""
        self._context = context
        self._axes = _sides(COLUMNS * ROWS)
        self._target: Buffer | None = None
        self._shader: Shader | None = None
        self._known = _KNOWN.setdefault(str(context.info["GL_RENDERER"]), WeakKeyDictionary())

    def openness(self, meshes: Sequence[TriangleMesh], seen: Sequence[TriangleMesh]) -> list[npt.NDArray[np.uint8]]:
        """Return the openness of vertices, from 0 to 255 = not occluded.

        Args:
            meshes: A body's meshes; at least one.
            seen: Meshes of the same body whose vertices are evaluated.
        """
        # Leave out the first mesh: a reference to it would keep the cache entry alive forever.
        others = [mesh for mesh in (*meshes, *seen) if mesh is not meshes[0]]
        known = self._known.get(meshes[0])
        if known is None or not same(known[0], others):
            self._known[meshes[0]] = known = others, self._bake(meshes, seen)
        return known[1]

    def _bake(self, meshes: Sequence[TriangleMesh], seen: Sequence[TriangleMesh]) -> list[npt.NDArray[np.uint8]]:
        if sum(len(mesh.faces) for mesh in meshes) > MAX_FACES:
            return [np.full(len(mesh.vertices), 255, np.uint8) for mesh in seen]
        points = np.concatenate([mesh.vertices for mesh in meshes]).astype(float)
        center = (points.min(axis=0) + points.max(axis=0)) / 2
        radius = max(1.05 * float(np.linalg.norm(points - center, axis=1).max()), 1e-6)
        depth = self._draw(meshes, center, radius)
        result = []
        for mesh in seen:
            unit = (mesh.vertices.astype(float) - center) / radius + 1.5 * BIAS * mesh.normals
            local = np.einsum("kij,nj->kni", self._axes, unit)  # (sides, vertices, xyz)
            facing = np.clip(np.einsum("kj,nj->kn", -self._axes[:, 2], mesh.normals.astype(float)), 0.0, None)
            pixels = np.clip((local[..., :2] * 0.5 + 0.5) * CELL, 0, CELL - 1).astype(np.intp)
            side = np.arange(len(self._axes))[:, None]
            nearest = depth[side // COLUMNS, pixels[..., 1], side % COLUMNS, pixels[..., 0]] * 2 - 1
            visible = local[..., 2] <= nearest + BIAS
            share = (facing * visible).sum(axis=0) / np.maximum(facing.sum(axis=0), 1e-9)
            result.append(np.rint(255 * (FLOOR + (1 - FLOOR) * share)).astype(np.uint8))
        return result

    def _draw(self, meshes: Sequence[TriangleMesh], center: Array, radius: float) -> npt.NDArray[np.float32]:
        """Draw the depth from all sides and return it, shape (rows, cell, columns, cell), 0..1 from near to far."""
        ctx = self._context
        if self._target is None or self._shader is None:
            self._target = Buffer(ctx, (COLUMNS * CELL, ROWS * CELL), depth="texture")
            defines = {"SIDES": str(len(self._axes)), "COLUMNS": str(COLUMNS), "ROWS": str(ROWS)}
            self._shader = Shader(ctx, "occlusion_vertex", "shadow_fragment", defines)
            self._shader.set(axes=[tuple(axes.T.ravel()) for axes in self._axes])
        corners = np.concatenate([mesh.vertices[mesh.faces].reshape(-1, 3) for mesh in meshes])
        vertices = ctx.buffer(((corners - center) / radius).astype(np.float32))
        array = ctx.vertex_array(self._shader.program, [(vertices, "3f", "in_position")])
        self._target.fbo.use()
        self._target.fbo.clear(depth=1.0)
        ctx.enable_only(moderngl.DEPTH_TEST)
        ctx.depth_func = "<="
        array.render(instances=len(self._axes))
        raw = self._target.fbo.read(attachment=-1, components=1, dtype="f4")
        return np.frombuffer(raw, np.float32).reshape(ROWS, CELL, COLUMNS, CELL)


def _sides(count: int) -> Array:
    """Return view axes that look inwards from a Fibonacci sphere, shape (count, 3, 3): rows x, y, forward."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    forward = -np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    side = np.where(np.abs(forward[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    x = np.cross(side, forward)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(forward, x), forward], axis=1)
