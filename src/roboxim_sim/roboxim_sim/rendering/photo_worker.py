"""Worker process of the `photo` renderer, which renders with Blender's Cycles. Imports numpy, but nothing of RoboXim.

The worker runs with the Python of a separate environment that has `bpy` and an older numpy. It reads requests from
stdin and writes responses to stdout, each a line of JSON followed by the raw bytes of its arrays (`send`, `receive`).
Blender prints to stdout too, so the worker first moves the pipe to another file descriptor.

`bpy` is under the GPL and RoboXim is not: only this file uses both, and it talks to RoboXim over a pipe.
"""

from __future__ import annotations

import contextlib
import json
import os
import struct
import sys
import tempfile
import time
from pathlib import Path
from typing import IO, Any

import numpy as np

PIXEL_TYPES = {0: np.uint32, 1: np.float16, 2: np.float32}
"""OpenEXR's pixel types."""
MARGIN = 4
"""Width of the margin that is rendered around the image and cropped, because the denoiser errs at the edges [px]."""
FAR_M = 1e9
"""Depths from this value on mean that the ray hit nothing."""


def send(stream: IO[bytes], message: dict[str, Any], arrays: dict[str, Any] | None = None) -> None:
    """Write a message and its arrays to the pipe."""
    contiguous = {name: np.ascontiguousarray(array) for name, array in (arrays or {}).items()}
    layout = [[name, array.dtype.str, array.shape] for name, array in contiguous.items()]
    stream.write(json.dumps({**message, "arrays": layout}).encode() + b"\n")
    for array in contiguous.values():
        stream.write(array.tobytes())
    stream.flush()


def receive(stream: IO[bytes]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a message and its arrays from the pipe.

    Raises:
        EOFError: When the other side has closed the pipe.
    """
    line = stream.readline()
    if not line:
        raise EOFError
    message = json.loads(line)
    arrays = {}
    for name, kind, shape in message.pop("arrays"):
        dtype = np.dtype(kind)
        data = stream.read(int(np.prod(shape)) * dtype.itemsize)
        arrays[name] = np.frombuffer(data, dtype).reshape(shape)
    return message, arrays


class Studio:
    """A Blender scene that mirrors a `RenderWorld`."""

    def __init__(self, samples: int, threads: int) -> None:
        """Configure Cycles; ``threads`` 0: one per core."""
        import bpy  # type: ignore[import-not-found]

        self._bpy = bpy
        self._samples, self._threads = samples, threads
        memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
        self._folder = Path(tempfile.mkdtemp(prefix="roboxim-photo-", dir=memory))
        self.version = bpy.app.version_string
        self._bodies: dict[str, list[Any]] = {}

    def close(self) -> None:
        """Remove the temporary files."""
        for path in self._folder.glob("*"):
            path.unlink()
        self._folder.rmdir()

    # ------------------------------------------------------------------ the world

    def load(self, message: dict[str, Any], arrays: dict[str, Any]) -> None:
        """Build the scene."""
        bpy = self._bpy
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self._scene = bpy.context.scene
        self._configure()
        self._materials: dict[str, Any] = {}
        self._textures: dict[str, Any] = {}
        self._bodies = {}
        for number, part in enumerate(message["parts"]):
            mesh = self._mesh(number, arrays)
            mesh.materials.append(self._material(part["material"], arrays))
            body = bpy.data.objects.new(f"part{number}", mesh)
            body.pass_index = part["entity_id"]
            body.rotation_mode = "QUATERNION"
            if part["surroundings"]:  # the light of the surroundings passes through the walls
                body.visible_diffuse = body.visible_shadow = False
            self._scene.collection.objects.link(body)
            self._bodies.setdefault(part["key"], []).append(body)
        for light in message["lights"]:
            self._light(light)
        self._surroundings(message["sky"], message["ground"], message["backdrop"])
        self._camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        self._scene.collection.objects.link(self._camera)
        self._scene.camera = self._camera

    def _configure(self) -> None:
        scene = self._scene
        scene.render.engine = "CYCLES"
        scene.render.use_persistent_data = True
        scene.render.threads_mode = "FIXED" if self._threads else "AUTO"
        if self._threads:
            scene.render.threads = self._threads
        scene.render.image_settings.media_type = "MULTI_LAYER_IMAGE"
        scene.render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
        scene.render.image_settings.color_depth = "32"
        scene.render.image_settings.exr_codec = "NONE"
        scene.render.image_settings.use_exr_interleave = True  # one part
        scene.render.use_compositing = scene.render.use_sequencer = False
        scene.view_settings.view_transform = "Raw"
        cycles = scene.cycles
        cycles.device = "CPU"
        cycles.seed = 0
        cycles.use_adaptive_sampling = False
        cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 3, 2, 2
        cycles.caustics_reflective = cycles.caustics_refractive = False
        cycles.sample_clamp_indirect = 4.0
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
        cycles.denoising_prefilter = "FAST"
        layer = self._scene.view_layers[0]
        layer.use_pass_z = layer.use_pass_object_index = True

    def _mesh(self, number: int, arrays: dict[str, Any]) -> Any:
        points, faces = arrays[f"{number}/vertices"], arrays[f"{number}/faces"]
        mesh = self._bpy.data.meshes.new(f"part{number}")
        mesh.from_pydata(points, [], faces.tolist())
        if f"{number}/uv" in arrays:
            layer = mesh.uv_layers.new(name="uv")
            layer.data.foreach_set("uv", arrays[f"{number}/uv"][faces.reshape(-1)].astype(np.float32).reshape(-1))
        mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), dtype=bool))
        mesh.normals_split_custom_set_from_vertices(arrays[f"{number}/normals"].tolist())
        return mesh

    def _material(self, values: dict[str, Any], arrays: dict[str, Any]) -> Any:
        key = json.dumps(values, sort_keys=True)
        if key not in self._materials:
            material = self._bpy.data.materials.new("material")
            material.use_nodes = True
            tree = material.node_tree
            surface = tree.nodes["Principled BSDF"]
            surface.inputs["Metallic"].default_value = values["metallic"]
            surface.inputs["Roughness"].default_value = values["roughness"]
            color = (*values["color"], 1.0)
            surface.inputs["Base Color"].default_value = color
            if values["texture"]:
                image = tree.nodes.new("ShaderNodeTexImage")
                image.image = self._texture(values["texture"], arrays)
                mix = tree.nodes.new("ShaderNodeMix")
                mix.data_type, mix.blend_type = "RGBA", "MULTIPLY"
                mix.inputs["Factor"].default_value = 1.0
                colors = [socket for socket in mix.inputs if socket.type == "RGBA"]
                colors[1].default_value = color
                tree.links.new(image.outputs["Color"], colors[0])
                result = next(socket for socket in mix.outputs if socket.type == "RGBA")
                tree.links.new(result, surface.inputs["Base Color"])
            self._materials[key] = material
        return self._materials[key]

    def _texture(self, name: str, arrays: dict[str, Any]) -> Any:
        if name not in self._textures:
            pixels = arrays[f"texture/{name}"]
            height, width = pixels.shape[:2]
            image = self._bpy.data.images.new(name, width, height, float_buffer=True, is_data=True)
            rgba = np.ones((height, width, 4), np.float32)
            rgba[..., :3] = pixels
            image.pixels.foreach_set(rgba.reshape(-1))  # the first row is at v = 0, as in GL
            image.pack()
            self._textures[name] = image
        return self._textures[name]

    def _light(self, values: dict[str, Any]) -> None:
        bpy, sun = self._bpy, values["kind"] == "sun"
        light = bpy.data.lights.new("light", "SUN" if sun else "POINT")
        light.color = values["color"]
        light.energy = values["energy"]
        light.use_shadow = values["shadow"]
        if sun:
            light.angle = 2 * values["radius"]
        else:
            light.shadow_soft_size = values["radius"]
        holder = bpy.data.objects.new("light", light)
        holder.matrix_world = _matrix(values["matrix"])
        self._scene.collection.objects.link(holder)

    def _surroundings(self, sky: list[float], ground: list[float], backdrop: list[float]) -> None:
        """Set the light of the surroundings, from ground colour below to sky above; the camera sees the backdrop."""
        world = self._bpy.data.worlds.new("world")
        self._scene.world = world
        world.use_nodes = True
        tree = world.node_tree
        background = tree.nodes["Background"]
        direction, split = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeSeparateXYZ")
        tree.links.new(direction.outputs["Generated"], split.inputs[0])
        height = tree.nodes.new("ShaderNodeMapRange")
        height.inputs["From Min"].default_value = -1.0
        tree.links.new(split.outputs["Z"], height.inputs["Value"])
        around = self._mixed(tree, height.outputs["Result"], ground, sky)
        path = tree.nodes.new("ShaderNodeLightPath")
        seen = self._mixed(tree, path.outputs["Is Camera Ray"], around, backdrop)
        tree.links.new(seen, background.inputs["Color"])

    @staticmethod
    def _mixed(tree: Any, factor: Any, a: Any, b: Any) -> Any:
        mix = tree.nodes.new("ShaderNodeMix")
        mix.data_type = "RGBA"
        tree.links.new(factor, mix.inputs["Factor"])
        colors = [socket for socket in mix.inputs if socket.type == "RGBA"]
        for socket, value in zip(colors, (a, b), strict=True):
            if isinstance(value, list):
                socket.default_value = (*value, 1.0)
            else:
                tree.links.new(value, socket)
        return next(socket for socket in mix.outputs if socket.type == "RGBA")

    # ------------------------------------------------------------------ images

    def render(self, message: dict[str, Any]) -> dict[str, Any]:
        """Place the bodies and render an image with every camera."""
        for key, parts in self._bodies.items():
            matrix = _matrix(message["poses"].get(key, np.eye(4).tolist()))
            for part in parts:
                part.matrix_world = matrix
        arrays = {}
        for camera in message["cameras"]:
            name = camera["name"]
            self._aim(camera)
            color = self._take(self._samples, denoise=True)
            arrays[f"{name}/rgb"] = np.stack([_channel(color, "Combined", c) for c in "RGB"], axis=-1)
            if camera["geometry"]:
                geometry = self._take(1, denoise=False)
                depth = _channel(geometry, "Depth", "V", "Z").astype(np.float32)
                arrays[f"{name}/depth"] = np.where(depth >= min(camera["far"], FAR_M), np.inf, depth).astype(np.float32)
                ids = _channel(geometry, "Object Index", "X", "V")
                arrays[f"{name}/segmentation"] = np.rint(ids).astype(np.uint16)
        return arrays

    def _aim(self, values: dict[str, Any]) -> None:
        fx, fy, cx, cy = values["matrix"]
        width, height = values["width"] + 2 * MARGIN, values["height"] + 2 * MARGIN
        cx, cy = cx + MARGIN, cy + MARGIN
        render, camera = self._scene.render, self._camera.data
        render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
        render.pixel_aspect_x, render.pixel_aspect_y = max(fy / fx, 1.0), max(fx / fy, 1.0)
        camera.sensor_fit, camera.sensor_width = "HORIZONTAL", 36.0
        camera.lens = fx * camera.sensor_width / width
        camera.shift_x = -(cx + 0.5 - width / 2) / width
        camera.shift_y = (cy + 0.5 - height / 2) * (fx / fy) / width
        camera.clip_start, camera.clip_end = values["near"], values["far"]
        self._camera.matrix_world = _matrix(values["pose"])

    def _take(self, samples: int, *, denoise: bool) -> dict[str, Any]:
        cycles = self._scene.cycles
        cycles.samples, cycles.use_denoising = samples, denoise
        # One sample through the centre of each pixel: depth and ids must not come from a neighbour.
        cycles.filter_width = 1.1 if denoise else 0.01
        path = self._folder / "image.exr"
        self._scene.render.filepath = str(path)
        self._bpy.ops.render.render(write_still=True)
        inner = slice(MARGIN, -MARGIN)
        return {name: pixels[inner, inner] for name, pixels in read_exr(path).items()}


def _matrix(rows: Any) -> Any:
    from mathutils import Matrix  # type: ignore[import-not-found]

    return Matrix(rows)


def _channel(channels: dict[str, Any], render_pass: str, *endings: str) -> Any:
    """Return a channel of a render pass, e.g. ``ViewLayer.Combined.R``."""
    for ending in endings:
        for name, pixels in channels.items():
            if name.endswith(f"{render_pass}.{ending}"):
                return pixels
    raise KeyError(f"Blender wrote no channel {render_pass}.{endings}, only {sorted(channels)}")


def read_exr(path: Path) -> dict[str, Any]:
    """Read an uncompressed scan-line OpenEXR file: pixels by channel, shape (height, width).

    Raises:
        ValueError: When the file is of another kind.

    Source: "OpenEXR File Layout" of the OpenEXR project.
    """
    data = path.read_bytes()
    if struct.unpack_from("<I", data)[0] != 20000630 or struct.unpack_from("<I", data, 4)[0] & 0x1A00:
        raise ValueError(f"{path} is not a single-part OpenEXR file of scan lines")
    at, attributes = 8, {}
    while data[at]:
        name, at = _text(data, at)
        _, at = _text(data, at)
        (size,) = struct.unpack_from("<i", data, at)
        attributes[name] = data[at + 4 : at + 4 + size]
        at += 4 + size
    if attributes["compression"] != b"\0":
        raise ValueError(f"{path} is compressed")
    x0, y0, x1, y1 = struct.unpack("<4i", attributes["dataWindow"])
    width, height = x1 - x0 + 1, y1 - y0 + 1
    channels = list(_channels(attributes["channels"]))
    row = np.dtype([("y", "<i4"), ("size", "<i4"), *((name, (kind, (width,))) for name, kind in channels)])
    lines = np.frombuffer(data, row, count=height, offset=at + 1 + 8 * height)
    return {name: lines[name] for name, _ in channels}


def _channels(data: bytes) -> Any:
    at = 0
    while data[at]:
        name, at = _text(data, at)
        yield name, np.dtype(PIXEL_TYPES[struct.unpack_from("<i", data, at)[0]]).newbyteorder("<")
        at += 16


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode(), end + 1


def main(samples: str, threads: str) -> None:
    """Serve requests until stdin ends."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    requests = sys.stdin.buffer
    studio = Studio(int(samples), int(threads))
    send(answers, {"version": studio.version})
    with contextlib.suppress(EOFError):
        while True:
            message, arrays = receive(requests)
            try:
                if message["do"] == "load":
                    studio.load(message, arrays)
                    send(answers, {})
                else:
                    before = time.process_time()
                    arrays = studio.render(message)
                    send(answers, {"cpu_s": time.process_time() - before}, arrays)
            except Exception as error:  # the parent process reports it
                send(answers, {"error": f"{type(error).__name__}: {error}"})
    studio.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
