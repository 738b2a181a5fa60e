"""How much of its surroundings each vertex of a body sees past the body itself, worked out once when it is loaded.

A body's depth is drawn from many sides into one picture, and each vertex looked up there: darkness inside a mug, under
a plate's rim and between the robot's covers then costs a tick nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import moderngl
import numpy as np
import numpy.typing as npt

from roboxim_core.rendering import TriangleMesh
from roboxim_sim.rendering import shaders
from roboxim_sim.rendering.gl import Buffer, Shader
from roboxim_sim.rendering.lod import same

Array = npt.NDArray[np.float64]

COLUMNS, ROWS = 8, 4
"""Sides that a body is looked at from are laid out in so many columns and rows."""
CELL = 96
"""Width and height of one side's picture [px]."""
BIAS = 0.03
"""What is nearer than this share of the body's radius does not hide."""
FLOOR = 0.25
"""Share of the light that reaches what is wholly hidden, from one wall to another."""
MAX_FACES = 20_000
"""Bodies of more faces are taken for open: drawing them from all sides would take too long."""


class OcclusionBaker:
    """Works out openness, on the context that it was made on."""

    def __init__(self, context: moderngl.Context) -> None:
        """Make what it draws with."""
        self._context = context
        self._axes = _sides(COLUMNS * ROWS)
        self._target: Buffer | None = None
        self._shader: Shader | None = None
        self._known: WeakKeyDictionary[TriangleMesh, tuple[list[TriangleMesh], list[npt.NDArray[np.uint8]]]]
        self._known = WeakKeyDictionary()

    def openness(self, meshes: Sequence[TriangleMesh], seen: Sequence[TriangleMesh]) -> list[npt.NDArray[np.uint8]]:
        """Return the openness of vertices, 255 = nothing hides anything.

        Args:
            meshes: A body's meshes; at least one.
            seen: Meshes of the same body whose vertices are asked about.
        """
        # Not the first mesh, which would then never be forgotten.
        others = [mesh for mesh in (*meshes, *seen) if mesh is not meshes[0]]
        known = self._known.get(meshes[0])
        if known is None or not same(known[0], others):
            self._known[meshes[0]] = known = others, self._bake(meshes, seen)
        return known[1]

    def release(self) -> None:
        """Free what it drew with."""
        if self._target:
            self._target.release()
        if self._shader:
            self._shader.program.release()

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
        """Draw depth from all sides; shape (rows, cell, columns, cell), 0..1 from near to far."""
        ctx = self._context
        if self._target is None or self._shader is None:
            self._target = Buffer(ctx, (COLUMNS * CELL, ROWS * CELL), depth="texture")
            defines = {"SIDES": str(len(self._axes)), "COLUMNS": str(COLUMNS), "ROWS": str(ROWS)}
            self._shader = Shader(ctx, shaders.OCCLUSION_VERTEX, shaders.SHADOW_FRAGMENT, defines)
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
        array.release()
        vertices.release()
        return np.frombuffer(raw, np.float32).reshape(ROWS, CELL, COLUMNS, CELL)


def _sides(count: int) -> Array:
    """Return axes that look inwards from all around (a Fibonacci sphere), shape (count, 3, 3): rows x, y, forward."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    forward = -np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    side = np.where(np.abs(forward[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    x = np.cross(side, forward)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(forward, x), forward], axis=1)
