"""Thin layer over moderngl for the `raster` renderer: context, shaders, framebuffers and a world's GPU buffers."""

from __future__ import annotations

import ctypes
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, SimError
from roboxim_core.models.mesh_files import Stamp
from roboxim_sim.rendering import textures
from roboxim_sim.rendering.geometry import VERTEX, VERTEX_FORMAT, VERTEX_NAMES, PackedWorld

PACKAGES = "libegl1 libgl1-mesa-dri"
"""Debian and Ubuntu packages that provide software GL."""
SOFTWARE = ("llvmpipe", "softpipe", "swrast", "software")
"""Words that identify software renderers in the GL renderer name."""
MAX_DEVICES = 16
"""Number of EGL devices to try."""
KEPT_TEXTURES = 24
"""Number of textures to keep, 1.3 MiB each, unless a world needs more."""


def create_context() -> moderngl.Context:
    """Create a GL context without a window: on a GPU if one works, otherwise in software.

    Call its `gc` from time to time: it frees the buffers, textures and programs that nothing refers to any more.

    The environment variable ``GLCONTEXT_DEVICE_INDEX`` selects an EGL device by index.

    Raises:
        SimError: RENDERER_UNAVAILABLE when this machine has no working EGL.
    """
    software: moderngl.Context | None = None
    problem: Exception | None = None
    for index in range(1 if "GLCONTEXT_DEVICE_INDEX" in os.environ else MAX_DEVICES):
        # libEGL also dispatches core GL, so libGL and its X11 dependencies are not needed.
        options: Any = {"backend": "egl", "libgl": "libEGL.so.1", "libegl": "libEGL.so.1", "device_index": index}
        try:
            context = moderngl.create_context(require=330, standalone=True, **options)
            context.gc_mode = "context_gc"
        except Exception as error:  # moderngl and its loader raise plain Exception, also beyond the last device
            problem = problem or error
            continue
        if not any(word in str(context.info["GL_RENDERER"]).lower() for word in SOFTWARE):
            if software is not None:
                software.release()
            return context
        if software is None:
            software = context
        else:
            context.release()
    if software is not None:
        return software
    raise SimError(
        f"renderer 'raster' needs OpenGL 3.3 through EGL, and this machine provides none ({problem}). On Debian or "
        f"Ubuntu: apt-get install {PACKAGES}. Without GL choose renderer 'tiny'.",
        ErrorCode.RENDERER_UNAVAILABLE,
    ) from problem


def wait_for_drawing() -> None:
    """Wait until the current context has drawn everything, while other threads may use Python.

    moderngl keeps Python's lock while it reads an image, and so while the driver draws it.
    """
    _gl_finish()()


@cache
def _gl_finish() -> Callable[[], None]:
    """Return ``glFinish``. If it is not found, return a function that does nothing; reading then waits."""
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype, egl.eglGetProcAddress.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    address = egl.eglGetProcAddress(b"glFinish")
    return ctypes.CFUNCTYPE(None)(address) if address else lambda: None


@cache
def source(name: str) -> str:
    """Return the text of ``glsl/NAME.glsl``, with the files that it includes."""
    text = (Path(__file__).parent / "glsl" / f"{name}.glsl").read_text()
    return re.sub(r'^#include "(\w+)"\n', lambda found: source(found[1]), text, flags=re.MULTILINE)


class Shader:
    """A program whose uniforms are set by name; uniforms that the compiler removed are skipped."""

    def __init__(self, context: moderngl.Context, vertex: str, fragment: str, defines: Mapping[str, str]) -> None:
        """Compile the program.

        Args:
            context: The context.
            vertex: Name of the vertex shader, see `source`.
            fragment: Name of the fragment shader.
            defines: Values by preprocessor name.
        """
        head = "#version 330\n" + "".join(f"#define {key} {value}\n" for key, value in defines.items())
        self.program = context.program(vertex_shader=head + source(vertex), fragment_shader=head + source(fragment))

    def set(self, **values: Any) -> None:
        """Set uniforms to numbers or tuples; for a uniform block or a sampler, set its binding."""
        for name, value in values.items():
            member = self.program.get(name, None)
            if isinstance(member, moderngl.Uniform | moderngl.UniformBlock):
                member.value = value


class Buffer:
    """A framebuffer whose attachments are textures, or renderbuffers where nothing samples them."""

    def __init__(
        self,
        context: moderngl.Context,
        size: tuple[int, int],
        colors: Iterable[tuple[int, str]] = (),
        depth: str = "",
        smooth: bool = True,
    ) -> None:
        """Create the framebuffer.

        Args:
            context: The context.
            size: Width and height [px].
            colors: Components and moderngl dtype of each colour texture.
            depth: ``texture`` for a depth texture to compare with, ``buffer`` for depth testing only, empty for none.
            smooth: Whether the colour textures are filtered linearly.
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
        self.fbo = context.framebuffer(self.colors, attachment)

    def read(self, attachment: int, components: int, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        """Read a colour texture; row 0 first; shape (height, width, components)."""
        kind = np.dtype(dtype)
        raw = self.fbo.read(components=components, attachment=attachment, dtype=f"f{kind.itemsize}", alignment=1)
        return np.frombuffer(raw, kind).reshape(self.size[1], self.size[0], components)


@dataclass(frozen=True, eq=False)
class _Bound:
    """A vertex array of a shader."""

    whole: moderngl.VertexArray
    """Vertex array over the world's own indices."""
    chosen: moderngl.VertexArray
    """Vertex array over the indices that a draw selects."""


class GpuWorld:
    """A packed world on the GPU."""

    def __init__(self, context: moderngl.Context, packed: PackedWorld) -> None:
        """Upload it."""
        self.packed = packed
        self._context = context
        # GL has no empty buffers.
        self._vertices = context.buffer(packed.vertices.tobytes() or bytes(VERTEX.itemsize))
        self._indices = context.buffer(packed.indices.tobytes() or bytes(12))
        self._chosen = context.buffer(reserve=max(packed.indices.nbytes, 12), dynamic=True)
        self._bound: dict[int, _Bound] = {}

    def draw(self, shader: Shader, ranges: Sequence[range]) -> None:
        """Draw ranges of the indices, in order, in one call."""
        ranges = [each for each in ranges if each]
        if not ranges:
            return
        bound = self._vertex_arrays(shader)
        if len(ranges) == 1:
            bound.whole.render(vertices=len(ranges[0]), first=ranges[0].start)
            return
        chosen = np.concatenate([self.packed.indices[each.start : each.stop] for each in ranges])
        self._chosen.write(chosen)
        bound.chosen.render(vertices=len(chosen))

    def _vertex_arrays(self, shader: Shader) -> _Bound:
        """Return the vertex arrays of a shader, created once; attributes that it does not read are skipped."""
        glo = shader.program.glo
        if glo not in self._bound:
            content = [(self._vertices, VERTEX_FORMAT, *VERTEX_NAMES)]
            self._bound[glo] = _Bound(
                *(
                    self._context.vertex_array(shader.program, content, indices, skip_errors=True)
                    for indices in (self._indices, self._chosen)
                )
            )
        return self._bound[glo]


class TextureStore:
    """Textures in one array. Textures of earlier worlds are kept, because episodes often share them."""

    def __init__(self, context: moderngl.Context) -> None:
        """Create an empty store."""
        self._context = context
        self._array: moderngl.TextureArray | None = None
        self.names: tuple[str, ...] = ()
        """Texture names by the number in the vertices: 0 means no texture, 1 is the array's first layer."""
        self._stamps: dict[str, Stamp] = {}

    def hold(self, names: Iterable[str]) -> None:
        """Ensure that the array holds the textures, as their files are now.

        Raises:
            ConfigError: On an unknown texture name.
        """
        wanted = {name: textures.texture_stamp(name) for name in names}
        if all(self._stamps.get(name) == stamp for name, stamp in wanted.items()):
            return
        same = {name: stamp for name, stamp in self._stamps.items() if textures.texture_stamp(name) == stamp}
        together = same | wanted
        stamps = together if len(together) <= KEPT_TEXTURES else wanted
        self._upload(tuple(stamps))
        self._stamps = stamps

    def use(self, unit: int) -> None:
        """Bind the array to a texture unit."""
        if self._array is not None:
            self._array.use(unit)

    def _upload(self, names: tuple[str, ...]) -> None:
        """Rebuild the array with mipmaps; it has four channels, because three are slower to read."""
        images = [textures.pixels(name) for name in names if name]
        size = textures.SIZE
        self._array = self._context.texture_array((size, size, max(len(images), 1)), 4)
        padded = np.full((size, size, 4), 255, np.uint8)
        for layer, image in enumerate(images):
            padded[..., :3] = image
            self._array.write(padded, viewport=(0, 0, layer, size, size, 1))
        self._array.build_mipmaps()
        self._array.filter = moderngl.LINEAR_MIPMAP_NEAREST, moderngl.LINEAR
        self.names = names
