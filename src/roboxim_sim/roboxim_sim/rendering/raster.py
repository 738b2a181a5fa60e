"""The `raster` renderer: physically based rasterisation with OpenGL, on a GPU or in software.

Features: metallic-roughness shading (GGX); one main light with soft shadows; further lights without shadows; an
analytic studio as image-based light; ambient occlusion by the body itself (`occlusion`) and under objects on the table;
sRGB; FXAA. One pass writes colour, depth and segmentation, and all cameras of a tick share the shadow map.

Non-obvious behaviours:
- A lamp's intensity is the light that arrives at the world's origin; it grows towards the lamp (inverse square).
- A pixel (column, row) looks along ``((column + 0.5 - width / 2) / f, (row + 0.5 - height / 2) / f, 1)`` in the
  optical frame, ``f = height / 2 / tan(fov_y / 2)``. Depth and segmentation follow that ray; FXAA changes colour only.
- A camera's images depend on the world, the poses and that camera only, bit for bit: not on other cameras, earlier
  worlds and frames, the process or the number of threads. For this each camera has its own framebuffer, because the
  position of a viewport within a shared framebuffer changes the rounding.
- Entities ``floor`` and ``wall`` receive shadows and cast none; the table casts the shadow of a rectangle.
- Robot links and bodies with many faces are drawn with coarse shapes where they are small in an image (at most a few
  millimetres off); they always cast the shadows of the coarse shapes.
- A shadow's edge has the same width everywhere: the one that the light's size gives for a caster 10 cm away, limited
  to 4 to 10 mm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import moderngl
import numpy as np

from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import Pose
from roboxim_core.specs import CameraSpec, LookSpec
from roboxim_core.vision.renderer import CameraImages, RenderWorld
from roboxim_sim.rendering.draw_lists import CONTACT_REACH_M, MAX_LIGHTS, Frame
from roboxim_sim.rendering.geometry import Packer, check_request, check_world, texture_names
from roboxim_sim.rendering.gl import Buffer, GpuWorld, Shader, TextureStore, create_context, wait_for_drawing
from roboxim_sim.rendering.occlusion import OcclusionBaker
from roboxim_sim.rendering.owner import Owner

CONTACT_SIZE = 96
"""Width and height of the contact map [texel]."""
VIEW_BYTES = 512
"""Size of a camera's uniform block, rounded up to an alignment that suits every driver."""
SAMPLERS = {"shadow_map": 0, "contact_map": 1, "textures": 2, "image": 3, "Poses": 0, "View": 1}
"""Texture units of the shaders' samplers, and bindings of their uniform blocks."""

Cameras = Sequence[tuple[CameraSpec, Pose]]


class RasterRenderer:
    """OpenGL renderer, see the module; implements `roboxim_core.vision.renderer.Renderer`."""

    name = "raster"

    def __init__(self) -> None:
        """Create the context.

        Raises:
            SimError: RENDERER_UNAVAILABLE when this machine has no working EGL.
        """
        self._owner = Owner()
        self._context = ctx = create_context()
        self.device = str(ctx.info["GL_RENDERER"])
        self._max_bodies = min(1024, ctx.info["GL_MAX_UNIFORM_BLOCK_SIZE"] // 48)
        self._defines = {
            "MAX_BODIES": str(self._max_bodies),
            "MAX_LIGHTS": str(MAX_LIGHTS),
            "CONTACT_REACH": str(CONTACT_REACH_M),
        }
        self._shaders: dict[tuple[str, ...], Shader] = {}
        self._screens: dict[tuple[str, ...], moderngl.VertexArray] = {}
        self._poses = ctx.buffer(reserve=48 * self._max_bodies, dynamic=True)
        self._corners = ctx.buffer(np.array([[-1, -1], [-1, 3], [3, -1]], dtype=np.float32).tobytes())
        self._views = ctx.buffer(reserve=4 * VIEW_BYTES, dynamic=True)
        self._shadow: Buffer | None = None
        self._cover = Buffer(ctx, (CONTACT_SIZE, CONTACT_SIZE), [(2, "f4")], smooth=False)
        self._contact = Buffer(ctx, (CONTACT_SIZE, CONTACT_SIZE), [(1, "f1")])
        self._occlusion, self._textures = OcclusionBaker(ctx), TextureStore(ctx)
        self._packer = Packer(self._occlusion.openness)
        self._world: tuple[GpuWorld, LookSpec] | None = None
        self._targets: list[_Target] = []

    def load(self, world: RenderWorld) -> None:
        """Replace the world.

        Raises:
            ConfigError: On an unknown texture.
            InvalidRequestError: On a malformed world.
            SimError: When called from another thread or process, or after `close`.
        """
        self._owner.check()
        check_world(world)
        with self._context:
            self._textures.hold(texture_names(world))
            packed = self._packer.pack(world, self._textures.names)
        if len(packed.bodies) > self._max_bodies or len(world.look.lights) > MAX_LIGHTS:
            raise InvalidRequestError(
                f"renderer 'raster' draws at most {self._max_bodies} bodies and {MAX_LIGHTS} lights, got "
                f"{len(packed.bodies)} and {len(world.look.lights)}"
            )
        with self._context as ctx:
            self._world = GpuWorld(ctx, packed), world.look

    def render(self, poses: Mapping[str, Pose], cameras: Cameras, *, colour: bool = True) -> dict[str, CameraImages]:
        """Draw all cameras of a tick; see `roboxim_core.vision.renderer.Renderer`.

        Raises:
            InvalidRequestError: On a pose of an unknown body, or two cameras with the same name.
            SimError: When called from another thread or process, before `load` or after `close`.
        """
        self._owner.check(loaded=self._world is not None)
        assert self._world
        world, look = self._world
        check_request(world.packed.keys, poses, cameras)
        images: dict[str, CameraImages] = {}
        with self._context as ctx:
            ctx.gc()
            frame = Frame(world.packed, look, poses)
            self._upload(frame, cameras)
            ctx.front_face, ctx.depth_func = "cw", "<="
            if colour:
                self._cast_shadows(world, frame)
                self._find_contacts(world, frame)
                self._textures.use(SAMPLERS["textures"])
            targets = self._targets_of(cameras)
            for i, ((camera, pose), target) in enumerate(zip(cameras, targets, strict=True)):
                self._views.bind_to_uniform_block(SAMPLERS["View"], offset=i * VIEW_BYTES, size=VIEW_BYTES)
                self._shade(world, frame, target, camera, pose, colour=colour)
            # Smooth and read last: the driver rasterises one image while the next one's vertices are processed.
            wait_for_drawing()
            for target in targets if colour else ():
                self._smooth(target)
            wait_for_drawing()
            for (camera, _), target in zip(cameras, targets, strict=True):
                images[camera.name] = _read(camera, target, colour=colour)
        return images

    def close(self) -> None:
        """Free the context. Closing twice is harmless."""
        if self._owner.end():
            self._context.release()

    def _upload(self, frame: Frame, cameras: Cameras) -> None:
        """Upload poses and views."""
        self._poses.write(frame.matrices[:, :3].astype(np.float32).tobytes())
        self._poses.bind_to_uniform_block(SAMPLERS["Poses"])
        if self._views.size < len(cameras) * VIEW_BYTES:
            self._views = self._context.buffer(reserve=len(cameras) * VIEW_BYTES, dynamic=True)
        if cameras:
            self._views.write(b"".join(frame.view(*view).ljust(VIEW_BYTES, b"\0") for view in cameras))

    def _cast_shadows(self, world: GpuWorld, frame: Frame) -> None:
        """Draw the shadow map."""
        if not frame.shadowed:
            return
        size = frame.light.size
        if self._shadow is None or self._shadow.size[0] != size:
            self._shadow = Buffer(self._context, (size, size), depth="texture")
        shader = self._shader("shadow_vertex", "shadow_fragment")
        shader.set(clip_from_world=tuple(frame.light.matrix.T.ravel()))
        self._context.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        self._shadow.fbo.use()
        self._shadow.fbo.clear(depth=1.0)
        self._context.polygon_offset = 1.5, 2.0
        world.draw(shader, frame.shadow_ranges())
        self._context.polygon_offset = 0.0, 0.0
        if self._shadow.depth:
            self._shadow.depth.use(SAMPLERS["shadow_map"])

    def _find_contacts(self, world: GpuWorld, frame: Frame) -> None:
        """Draw a height map of the objects above the table, and from it the occlusion of the table's points."""
        if not frame.touching.any():
            return
        ctx, box = self._context, frame.contact_box
        shader = self._shader("contact_vertex", "contact_fragment")
        shader.set(contact_box=box)
        ctx.enable_only(moderngl.BLEND)
        ctx.blend_equation = moderngl.MAX, moderngl.MAX
        self._cover.fbo.use()
        self._cover.fbo.clear()
        world.draw(shader, frame.contact_ranges())
        ctx.enable_only(moderngl.NOTHING)
        self._contact.fbo.use()
        self._cover.colors[0].use(SAMPLERS["image"])
        self._fill("contact_shade_fragment", texels=CONTACT_SIZE * box[2])
        self._contact.colors[0].use(SAMPLERS["contact_map"])

    def _shade(
        self, world: GpuWorld, frame: Frame, target: _Target, camera: CameraSpec, pose: Pose, *, colour: bool
    ) -> None:
        """Draw the scene as a camera sees it."""
        geometry = ("GEOMETRY",) if target.geometry else ()
        lights = (*(["LAMP"] if frame.lights[:1] and frame.lights[0].kind == "lamp" else []),)
        lights = (*lights, *(["MORE_LIGHTS"] if len(frame.lights) > 1 else []))
        target.raw.fbo.use()
        target.raw.fbo.clear(depth=1.0)
        self._context.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        for batch in frame.batches(camera, pose):
            flags = (*lights, *batch.flags) if colour else ("COLOURLESS",)
            world.draw(self._shader("scene_vertex", "scene_fragment", *geometry, *flags), batch.ranges)
        self._fill("backdrop_fragment", *geometry, color=frame.backdrop)

    def _smooth(self, target: _Target) -> None:
        """Anti-alias the colour: copy it and redraw the edges only, because most pixels have none."""
        self._context.enable_only(moderngl.NOTHING)
        self._context.copy_framebuffer(target.final.fbo, target.colour)
        target.final.fbo.use()
        target.raw.colors[0].use(SAMPLERS["image"])
        self._fill("fxaa_fragment")

    def _fill(self, fragment: str, *flags: str, **values: object) -> None:
        """Draw a triangle over the whole viewport, at the far plane."""
        shader = self._shader("screen_vertex", fragment, *flags)
        shader.set(**values)
        key = (fragment, *flags)
        if key not in self._screens:
            content = [(self._corners, "2f", "in_corner")]
            self._screens[key] = self._context.vertex_array(shader.program, content)
        self._screens[key].render(vertices=3)

    def _shader(self, vertex: str, fragment: str, *flags: str) -> Shader:
        """Return a shader by the names of its sources; compile it on first use."""
        key = (vertex, fragment, *flags)
        if key not in self._shaders:
            defines = {**self._defines, **dict.fromkeys(flags, "1")}
            self._shaders[key] = Shader(self._context, vertex, fragment, defines)
            self._shaders[key].set(**SAMPLERS)
        return self._shaders[key]

    def _targets_of(self, cameras: Cameras) -> list[_Target]:
        """Return a target for each camera; reuse those of the last call where they fit."""
        old, self._targets = self._targets, []
        for i, (camera, _) in enumerate(cameras):
            size, geometry = (camera.width, camera.height), camera.depth or camera.segmentation
            if i < len(old) and (old[i].raw.size, old[i].geometry) == (size, geometry):
                self._targets.append(old[i])
            else:
                self._targets.append(_Target(self._context, size, geometry))
        return self._targets


class _Target:
    """The framebuffers of one camera."""

    def __init__(self, context: moderngl.Context, size: tuple[int, int], geometry: bool) -> None:
        colors = [(4, "f1"), *([(2, "f4")] if geometry else [])]
        self.geometry = geometry
        self.raw = Buffer(context, size, colors, depth="buffer")
        self.final = Buffer(context, size, [(4, "f1")])
        self.colour = context.framebuffer([self.raw.colors[0]])
        """A framebuffer with the colour of `raw` only, as the source of copies."""


def _read(camera: CameraSpec, target: _Target, *, colour: bool) -> CameraImages:
    """Read a camera's images."""
    depth = segmentation = None
    black = (camera.height, camera.width, 3)
    rgb = target.final.read(0, 3, np.uint8).copy() if colour else np.zeros(black, np.uint8)
    if target.geometry:
        geometry = target.raw.read(1, 2, np.float32)
        depth = geometry[..., 0].copy() if camera.depth else None
        segmentation = geometry[..., 1].astype(np.uint16) if camera.segmentation else None
    return CameraImages(rgb=rgb, depth=depth, segmentation=segmentation)
