"""The `raster` renderer: physically based rasterisation with OpenGL, on a GPU or, as fast as it goes, without one.

Metallic-roughness shading (GGX) under one shadowed main light, further lights without shadows and an analytic studio
as image-based light; soft shadow edges; darkened contacts; sRGB; FXAA. Colour, depth and segmentation leave one pass,
and all cameras of a tick share the shadow map and the framebuffer.

Non-obvious behaviours:
- A lamp's intensity is what arrives at the world's origin; nearer to the lamp it is brighter (inverse square).
- A pixel (column, row) looks along ``((column + 0.5 - width / 2) / f, (row + 0.5 - height / 2) / f, 1)`` in the
  optical frame, ``f = height / 2 / tan(fov_y / 2)``. Depth and segmentation are of that ray; FXAA moves colour only.
- Images depend on the arguments alone: not on earlier worlds, frames, processes or the number of threads.
- GL calls from a foreign thread or a forked child fail silently in drivers, so they are refused here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, InvalidRequestError, SimError
from roboxim_core.poses import Pose
from roboxim_core.rendering import CameraImages, RenderWorld
from roboxim_core.specs import CameraSpec, LookSpec
from roboxim_sim.rendering import shaders, textures
from roboxim_sim.rendering.frame import Frame
from roboxim_sim.rendering.geometry import VERTEX, VERTEX_FORMAT, VERTEX_NAMES, PackedWorld, check_request, pack
from roboxim_sim.rendering.owner import Owner
from roboxim_sim.rendering.views import clip_from_world

MAX_LIGHTS = 4
SHADOW_SIZE = 1024
CONTACT_SIZE = 96
CONTACT_HEIGHTS_M = (-0.5, 2.0)
PACKAGES = "libegl1 libgl1-mesa-dri"
"""Packages of Debian and Ubuntu that give software GL."""

Array = npt.NDArray[np.float64]
_Cameras = Sequence[tuple[CameraSpec, Pose]]


def create_context() -> moderngl.Context:
    """Create a GL context without a window.

    Raises:
        SimError: RENDERER_UNAVAILABLE when this machine has no working EGL.
    """
    try:
        # libEGL dispatches core GL too, so libGL and its X11 dependencies are not needed.
        return moderngl.create_context(
            standalone=True, backend="egl", require=330, libgl="libEGL.so.1", libegl="libEGL.so.1"
        )
    except Exception as error:  # moderngl and its loader raise plain Exception
        raise SimError(
            f"renderer 'raster' needs OpenGL 3.3 through EGL, and this machine gives none ({error}). On Debian or "
            f"Ubuntu: apt-get install {PACKAGES}. Without GL choose renderer 'tiny'.",
            ErrorCode.RENDERER_UNAVAILABLE,
        ) from error


@dataclass(frozen=True, eq=False)
class _Target:
    """Framebuffers for one set of camera sizes."""

    size: tuple[int, int]
    geometry: bool
    scene: moderngl.Framebuffer
    final: moderngl.Framebuffer

    def release(self) -> None:
        for buffer in (self.scene, self.final):
            for attachment in (*buffer.color_attachments, buffer.depth_attachment):
                if attachment is not None:
                    attachment.release()
            buffer.release()


@dataclass(frozen=True, eq=False)
class _Loaded:
    """A world on the GPU."""

    packed: PackedWorld
    look: LookSpec
    vertices: moderngl.Buffer
    indices: moderngl.Buffer
    arrays: dict[str, moderngl.VertexArray]
    textures: moderngl.TextureArray

    def draw(self, program: str, bodies: npt.NDArray[np.intp]) -> None:
        """Draw bodies by index."""
        array = self.arrays[program]
        for index in bodies.tolist():
            body = self.packed.bodies[index]
            array.render(vertices=body.count, first=body.first)

    def release(self) -> None:
        for item in (*self.arrays.values(), self.vertices, self.indices, self.textures):
            item.release()


class RasterRenderer:
    """See the module; implements `roboxim_core.rendering.Renderer`."""

    name = "raster"

    def __init__(self) -> None:
        """Create the context and compile the shaders.

        Raises:
            SimError: RENDERER_UNAVAILABLE when this machine has no working EGL.
        """
        self._owner = Owner()
        self._context = create_context()
        self._world: _Loaded | None = None
        self._target: _Target | None = None
        ctx = self._context
        self.device = str(ctx.info["GL_RENDERER"])
        self._max_bodies = min(1024, ctx.info["GL_MAX_UNIFORM_BLOCK_SIZE"] // 48)
        defines = {"MAX_BODIES": str(self._max_bodies), "MAX_LIGHTS": str(MAX_LIGHTS)}
        self._programs = {
            "shadow": self._program(shaders.SHADOW_VERTEX, shaders.SHADOW_FRAGMENT, defines),
            "contact": self._program(shaders.CONTACT_VERTEX, shaders.CONTACT_FRAGMENT, defines),
            "contact_blur": self._program(shaders.SCREEN_VERTEX, shaders.CONTACT_BLUR_FRAGMENT, defines),
            "color": self._program(shaders.SCENE_VERTEX, shaders.SCENE_FRAGMENT, defines),
            "geometry": self._program(shaders.SCENE_VERTEX, shaders.SCENE_FRAGMENT, defines, "GEOMETRY"),
            "backdrop_color": self._program(shaders.SCREEN_VERTEX, shaders.BACKDROP_FRAGMENT, defines),
            "backdrop_geometry": self._program(shaders.SCREEN_VERTEX, shaders.BACKDROP_FRAGMENT, defines, "GEOMETRY"),
            "fxaa": self._program(shaders.SCREEN_VERTEX, shaders.FXAA_FRAGMENT, defines),
        }
        self._poses = ctx.buffer(reserve=48 * self._max_bodies, dynamic=True)
        corners = ctx.buffer(np.array([[-1, -1], [-1, 3], [3, -1]], dtype=np.float32).tobytes())
        self._screen = {
            name: ctx.vertex_array(self._programs[name], [(corners, "2f", "in_corner")])
            for name in ("fxaa", "contact_blur", "backdrop_color", "backdrop_geometry")
        }
        shadow_map = ctx.depth_texture((SHADOW_SIZE, SHADOW_SIZE))
        shadow_map.compare_func = "<="
        shadow_map.repeat_x = shadow_map.repeat_y = False
        self._shadow = ctx.framebuffer(depth_attachment=shadow_map)
        self._contact = tuple(self._contact_buffer(depth) for depth in (True, False))

    def load(self, world: RenderWorld) -> None:
        """Replace the world.

        Raises:
            InvalidRequestError: On a malformed world.
            SimError: When called from another thread or process, or after `close`.
        """
        self._owner.check()
        packed = pack(world)
        if len(packed.bodies) > self._max_bodies or len(world.look.lights) > MAX_LIGHTS:
            raise InvalidRequestError(
                f"renderer 'raster' draws at most {self._max_bodies} bodies and {MAX_LIGHTS} lights, got "
                f"{len(packed.bodies)} and {len(world.look.lights)}"
            )
        layers = b"".join(textures.pixels(name).tobytes() for name in packed.textures)
        with self._context as ctx:
            if self._world:
                self._world.release()
            vertices = ctx.buffer(packed.vertices.tobytes() or bytes(VERTEX.itemsize))
            indices = ctx.buffer(packed.indices.tobytes() or bytes(12))
            arrays = {
                name: ctx.vertex_array(self._programs[name], [_attributes(self._programs[name], vertices)], indices)
                for name in ("shadow", "contact", "color", "geometry")
            }
            images = ctx.texture_array((textures.SIZE, textures.SIZE, len(packed.textures)), 3, layers)
            images.build_mipmaps()
            images.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
            self._world = _Loaded(packed, world.look, vertices, indices, arrays, images)

    def render(self, poses: Mapping[str, Pose], cameras: Sequence[tuple[CameraSpec, Pose]]) -> dict[str, CameraImages]:
        """Draw all cameras of a tick; see `roboxim_core.rendering.Renderer`.

        Raises:
            InvalidRequestError: On a pose of an unknown body, or two cameras of one name.
            SimError: When called from another thread or process, before `load` or after `close`.
        """
        self._owner.check()
        if self._world is None:
            raise SimError("the renderer has no world yet: call load() first", ErrorCode.NO_SCENE)
        check_request(self._world.packed.keys, poses, cameras)
        images: dict[str, CameraImages] = {}
        with self._context:
            frame = Frame(self._world.packed, self._world.look, poses, SHADOW_SIZE)
            self._prepare(self._world, frame)
            for group in _groups(cameras, self._context.info["GL_MAX_TEXTURE_SIZE"]):
                images.update(self._draw(self._world, frame, group))
        return images

    def close(self) -> None:
        """Free the context. Closing twice is harmless."""
        if self._owner.closed:
            return
        self._owner.check()
        self._owner.closed = True
        with self._context:
            if self._world:
                self._world.release()
            if self._target:
                self._target.release()
        self._context.release()

    def _program(self, vertex: str, fragment: str, values: Mapping[str, str], *flags: str) -> moderngl.Program:
        head = "#version 330\n" + "".join(f"#define {key} {value}\n" for key, value in values.items())
        head += "".join(f"#define {flag}\n" for flag in flags)
        program = self._context.program(
            vertex_shader=vertex.replace("#version 330\n", head, 1),
            fragment_shader=fragment.replace("#version 330\n", head, 1),
        )
        for unit, sampler in enumerate(("shadow_map", "contact_map", "textures")):
            _set(program, sampler, unit)
        return program

    def _contact_buffer(self, depth: bool) -> moderngl.Framebuffer:
        size = (CONTACT_SIZE, CONTACT_SIZE)
        image = self._context.texture(size, 2, dtype="f4")
        image.repeat_x = image.repeat_y = False
        image.filter = (moderngl.LINEAR, moderngl.LINEAR)
        return self._context.framebuffer([image], self._context.depth_renderbuffer(size) if depth else None)

    def _prepare(self, world: _Loaded, frame: Frame) -> None:
        """Upload the poses; draw what all cameras share: the shadow map and the contact map."""
        ctx = self._context
        self._poses.write(frame.matrices[:, :3].astype(np.float32).tobytes())
        self._poses.bind_to_uniform_block(0)
        ctx.front_face = "cw"
        ctx.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        if frame.shadowed:
            _write(self._programs["shadow"], "light_from_world", frame.light.matrix)
            self._shadow.use()
            self._shadow.clear(depth=1.0)
            ctx.polygon_offset = 1.5, 2.0
            world.draw("shadow", np.flatnonzero(frame.casters))
            ctx.polygon_offset = 0.0, 0.0
        raw, blurred = self._contact
        for buffer in self._contact:
            buffer.use()
            buffer.clear(0.0, 0.0, 0.0, 0.0)
        if not frame.objects.any():
            return
        program, (low, high) = self._programs["contact"], CONTACT_HEIGHTS_M
        _set(program, "contact_box", frame.contact_box)
        _set(program, "heights", (low, 1 / (high - low)))
        ctx.disable(moderngl.CULL_FACE)
        raw.use()
        world.draw("contact", np.flatnonzero(frame.objects))
        ctx.enable_only(moderngl.NOTHING)
        blurred.use()
        raw.color_attachments[0].use(0)
        _set(self._programs["contact_blur"], "texel", 1 / CONTACT_SIZE)
        self._screen["contact_blur"].render(vertices=3)

    def _draw(self, world: _Loaded, frame: Frame, cameras: _Cameras) -> Iterator[tuple[str, CameraImages]]:
        """Draw cameras side by side and cut their images out."""
        size = sum(camera.width for camera, _ in cameras), max(camera.height for camera, _ in cameras)
        target = self._target_of(size, any(camera.depth or camera.segmentation for camera, _ in cameras))
        self._shade(world, frame, target, cameras)
        self._smooth(target, cameras)
        color = np.frombuffer(target.final.read(components=4), np.uint8).reshape(size[1], size[0], 4)
        geometry = None
        if target.geometry:
            raw = target.scene.read(components=2, attachment=1, dtype="f4")
            geometry = np.frombuffer(raw, np.float32).reshape(size[1], size[0], 2)
        for (camera, _), left in zip(cameras, _lefts(cameras), strict=True):
            cut = (slice(0, camera.height), slice(left, left + camera.width))
            depth = segmentation = None
            if geometry is not None and camera.depth:
                depth = geometry[(*cut, 0)].copy()
            if geometry is not None and camera.segmentation:
                segmentation = geometry[(*cut, 1)].astype(np.uint16)
            rgb = np.ascontiguousarray(color[(*cut, slice(0, 3))])
            yield camera.name, CameraImages(rgb=rgb, depth=depth, segmentation=segmentation)

    def _shade(self, world: _Loaded, frame: Frame, target: _Target, cameras: _Cameras) -> None:
        name = "geometry" if target.geometry else "color"
        program, backdrop = self._programs[name], f"backdrop_{name}"
        self._light(program, world, frame)
        _set(self._programs[backdrop], "color", _displayed(world.look.ambient))
        target.scene.use()
        target.scene.clear(depth=1.0)
        self._context.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        for (camera, pose), left in zip(cameras, _lefts(cameras), strict=True):
            target.scene.viewport = (left, 0, camera.width, camera.height)
            matrix = clip_from_world(camera, pose)
            _write(program, "clip_from_world", matrix)
            _set(program, "eye", pose.position)
            world.draw(name, frame.order(matrix, np.asarray(pose.position)))
            self._screen[backdrop].render(vertices=3)

    def _light(self, program: moderngl.Program, world: _Loaded, frame: Frame) -> None:
        """Set what the scene's shader knows of light."""
        self._shadow.depth_attachment.use(0)
        self._contact[1].color_attachments[0].use(1)
        world.textures.use(2)
        vectors, colors = frame.light_vectors()
        _set(program, "light_count", len(frame.lights))
        _write_array(program, "light_vectors", vectors, MAX_LIGHTS)
        _write_array(program, "light_colors", colors, MAX_LIGHTS)
        ambient = np.asarray(world.look.ambient)
        _set(program, "sky", tuple(ambient * 1.25))
        _set(program, "ground", tuple(ambient * (0.72, 0.66, 0.6)))
        _set(program, "contact_box", frame.contact_box)
        _set(program, "shadow_texel", 1 / SHADOW_SIZE if frame.shadowed else 0.0)
        if frame.shadowed:
            _write(program, "light_from_world", frame.light.matrix)
            _set(program, "normal_offset", 1.5 * frame.light.texel_m)

    def _smooth(self, target: _Target, cameras: _Cameras) -> None:
        program = self._programs["fxaa"]
        target.scene.color_attachments[0].use(0)
        target.final.use()
        self._context.enable_only(moderngl.NOTHING)
        _set(program, "texel", (1 / target.size[0], 1 / target.size[1]))
        for (camera, _), left in zip(cameras, _lefts(cameras), strict=True):
            target.final.viewport = (left, 0, camera.width, camera.height)
            _set(program, "rect", (left, 0, left + camera.width - 1, camera.height - 1))
            self._screen["fxaa"].render(vertices=3)

    def _target_of(self, size: tuple[int, int], geometry: bool) -> _Target:
        if self._target and (self._target.size, self._target.geometry) == (size, geometry):
            return self._target
        if self._target:
            self._target.release()
        ctx = self._context
        color = ctx.texture(size, 4)
        color.repeat_x = color.repeat_y = False
        attachments = [color, *([ctx.texture(size, 2, dtype="f4")] if geometry else [])]
        scene = ctx.framebuffer(attachments, ctx.depth_renderbuffer(size))
        self._target = _Target(size, geometry, scene, ctx.framebuffer([ctx.renderbuffer(size, 4)]))
        return self._target


def _lefts(cameras: _Cameras) -> list[int]:
    """Return the left edge of each camera in the shared framebuffer."""
    return np.cumsum([0, *(camera.width for camera, _ in cameras)]).tolist()[:-1]


def _groups(cameras: _Cameras, limit: int) -> Iterator[_Cameras]:
    """Split cameras into runs that fit side by side into a framebuffer."""
    group: list[tuple[CameraSpec, Pose]] = []
    for item in cameras:
        if group and sum(camera.width for camera, _ in group) + item[0].width > limit:
            yield group
            group = []
        group.append(item)
    if group:
        yield group


def _displayed(color: tuple[float, float, float]) -> tuple[float, ...]:
    """Convert linear radiance to what the screen shows of it (without the shoulder)."""
    value = np.clip(color, 0.0, 1.0)
    return tuple(np.where(value < 0.0031308, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055).tolist())


def _attributes(program: moderngl.Program, buffer: moderngl.Buffer) -> tuple[Any, ...]:
    """Describe the vertices to a program; what it does not read is skipped."""
    pieces = VERTEX_FORMAT.split()
    used = [name in program for name in VERTEX_NAMES]
    sizes = [VERTEX[field].itemsize for field in VERTEX.names or ()]
    layout = " ".join(piece if use else f"{size}x" for piece, use, size in zip(pieces, used, sizes, strict=True))
    return buffer, layout, *(name for name, use in zip(VERTEX_NAMES, used, strict=True) if use)


def _set(program: moderngl.Program, name: str, value: Any) -> None:
    """Set a uniform; one that the compiler has removed is skipped."""
    if name in program:
        program[name].value = value


def _write(program: moderngl.Program, name: str, matrix: Array) -> None:
    """Set a matrix uniform from a row-major matrix."""
    if name in program:
        program[name].write(matrix.T.astype(np.float32).tobytes())


def _write_array(program: moderngl.Program, name: str, rows: Array, length: int) -> None:
    """Set a uniform array of vectors, padded with zeros."""
    if name in program:
        padded = np.zeros((length, rows.shape[1]), np.float32)
        padded[: len(rows)] = rows
        program[name].write(padded.tobytes())
