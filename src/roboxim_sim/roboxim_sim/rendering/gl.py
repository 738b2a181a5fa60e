"""Thin layer over moderngl for the `raster` renderer: context, shaders, framebuffers, a world on the GPU."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, SimError
from roboxim_sim.rendering import textures
from roboxim_sim.rendering.geometry import (
    COARSE_FORMAT,
    COARSE_NAMES,
    COARSE_VERTEX,
    VERTEX,
    VERTEX_FORMAT,
    VERTEX_NAMES,
    PackedWorld,
)

Array = npt.NDArray[np.float64]

PACKAGES = "libegl1 libgl1-mesa-dri"
"""Packages of Debian and Ubuntu that give software GL."""


def create_context() -> moderngl.Context:
    """Create a GL context without a window and make it the thread's current one.

    Raises:
        SimError: RENDERER_UNAVAILABLE when this machine has no working EGL.
    """
    # libEGL dispatches core GL too, so libGL and the X11 libraries it needs are not needed.
    options: dict[str, Any] = {"backend": "egl", "libgl": "libEGL.so.1", "libegl": "libEGL.so.1"}
    try:
        return moderngl.create_context(require=330, standalone=True, **options)
    except Exception as error:  # moderngl and its loader raise plain Exception
        raise SimError(
            f"renderer 'raster' needs OpenGL 3.3 through EGL, and this machine gives none ({error}). On Debian or "
            f"Ubuntu: apt-get install {PACKAGES}. Without GL choose renderer 'tiny'.",
            ErrorCode.RENDERER_UNAVAILABLE,
        ) from error


class Shader:
    """A program whose uniforms are set by name; those that the compiler has removed are skipped."""

    def __init__(self, context: moderngl.Context, vertex: str, fragment: str, defines: Mapping[str, str]) -> None:
        """Compile.

        Args:
            context: The context.
            vertex: GLSL without its version line.
            fragment: GLSL without its version line.
            defines: Preprocessor names to values.
        """
        head = "#version 330\n" + "".join(f"#define {key} {value}\n" for key, value in defines.items())
        self.program = context.program(vertex_shader=head + vertex, fragment_shader=head + fragment)

    def set(self, **values: Any) -> None:
        """Set uniforms: numbers or tuples; for a uniform block or a sampler its binding."""
        for name, value in values.items():
            member = self.program.get(name, None)
            if isinstance(member, moderngl.Uniform | moderngl.UniformBlock):
                member.value = value

    def write(self, name: str, array: Array) -> None:
        """Set a matrix (column-major: pass the transposed) or an array of vectors."""
        member = self.program.get(name, None)
        if isinstance(member, moderngl.Uniform):
            member.write(np.ascontiguousarray(array, dtype=np.float32).tobytes())


class Buffer:
    """A framebuffer with textures or, where nothing samples it, renderbuffers as its attachments."""

    def __init__(
        self,
        context: moderngl.Context,
        size: tuple[int, int],
        colors: Iterable[tuple[int, str]] = (),
        depth: str = "",
        smooth: bool = True,
    ) -> None:
        """Create it.

        Args:
            context: The context.
            size: Width and height [px].
            colors: Components and moderngl dtype of each colour texture.
            depth: ``texture`` for one to compare with, ``buffer`` for one that only hides, or empty for none.
            smooth: Whether the colour textures are filtered.
        """
        self.size = size
        self.colors = tuple(context.texture(size, components, dtype=dtype) for components, dtype in colors)
        kind = moderngl.LINEAR if smooth else moderngl.NEAREST
        for image in self.colors:
            image.repeat_x = image.repeat_y = False
            image.filter = kind, kind
        self.depth: moderngl.Texture | None = None
        attachment: Any = None
        if depth == "texture":
            self.depth = attachment = context.depth_texture(size)
            self.depth.compare_func = "<="
            self.depth.repeat_x = self.depth.repeat_y = False
        elif depth:
            attachment = context.depth_renderbuffer(size)
        self._depth_attachment = attachment
        self.fbo = context.framebuffer(self.colors, attachment)

    def read(self, attachment: int, components: int, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        """Read a colour texture; row 0 first; shape (height, width, components)."""
        kind = np.dtype(dtype)
        raw = self.fbo.read(components=components, attachment=attachment, dtype=f"f{kind.itemsize}", alignment=1)
        return np.frombuffer(raw, kind).reshape(self.size[1], self.size[0], components)

    def release(self) -> None:
        """Free it."""
        for item in (self.fbo, *self.colors, self._depth_attachment):
            if item is not None:
                item.release()


@dataclass(frozen=True, eq=False)
class _Arrays:
    vertices: moderngl.Buffer
    indices: moderngl.Buffer
    layout: str
    names: tuple[str, ...]


class GpuWorld:
    """A packed world on the GPU."""

    def __init__(self, context: moderngl.Context, packed: PackedWorld) -> None:
        """Upload it."""
        self.packed = packed
        self._context = context

        def arrays(vertices: Any, indices: Any, item: int, layout: str, names: tuple[str, ...]) -> _Arrays:
            data = vertices.tobytes() or bytes(item)  # GL knows no empty buffers
            return _Arrays(context.buffer(data), context.buffer(indices.tobytes() or bytes(12)), layout, names)

        self._fine = arrays(packed.vertices, packed.indices, VERTEX.itemsize, VERTEX_FORMAT, VERTEX_NAMES)
        self._coarse = arrays(
            packed.coarse_vertices, packed.coarse_indices, COARSE_VERTEX.itemsize, COARSE_FORMAT, COARSE_NAMES
        )
        layers = b"".join(textures.pixels(name).tobytes() for name in packed.textures)
        self.textures = context.texture_array((textures.SIZE, textures.SIZE, len(packed.textures)), 3, layers)
        self.textures.build_mipmaps()
        self.textures.filter = moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR
        self._bound: dict[int, moderngl.VertexArray] = {}

    def draw(self, shader: Shader, bodies: npt.NDArray[np.intp]) -> None:
        """Draw bodies by index."""
        array = self._array(shader, self._fine)
        for index in bodies.tolist():
            shape = self.packed.bodies[index].shape
            array.render(vertices=len(shape), first=shape.start)

    def draw_coarse(self, shader: Shader, bodies: npt.NDArray[np.intp]) -> None:
        """Draw the simplified shapes of bodies by index."""
        array = self._array(shader, self._coarse)
        for index in bodies.tolist():
            shape = self.packed.bodies[index].shadow
            array.render(vertices=len(shape), first=shape.start)

    def release(self) -> None:
        """Free it."""
        self.textures.release()
        for item in self._bound.values():
            item.release()
        for arrays in (self._fine, self._coarse):
            arrays.vertices.release()
            arrays.indices.release()

    def _array(self, shader: Shader, arrays: _Arrays) -> moderngl.VertexArray:
        """Return the vertex array of a shader, made once; attributes that it does not read are skipped."""
        glo = shader.program.glo
        if glo not in self._bound:
            self._bound[glo] = self._context.vertex_array(
                shader.program, [(arrays.vertices, arrays.layout, *arrays.names)], arrays.indices, skip_errors=True
            )
        return self._bound[glo]
