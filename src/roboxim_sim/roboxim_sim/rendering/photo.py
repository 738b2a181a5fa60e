"""The `photo` renderer: Blender's path tracer Cycles, for re-rendering recorded episodes.

Non-obvious behaviours:
- Blender runs in a separate process, `photo_worker`, with a separate environment (`make photo`), because it is under
  the GPL and needs an older numpy.
- Images use few samples and a denoiser: the lighting is correct, fine detail is estimated. Sampling starts from the
  same seed in every frame.
- Depth and segmentation come from a second pass with one sample through the centre of each pixel.
- The tone curve is that of `raster`, so that both renderers have the same whites.
- The light of the surroundings passes through floor and walls, as in `raster`. The light of the sun and the lamps does
  not pass through the floor.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, SimError
from roboxim_core.poses import Pose, look_at
from roboxim_core.specs import CameraSpec, LightSpec
from roboxim_core.vision.renderer import CameraImages, RenderWorld
from roboxim_core.vision.srgb import to_srgb
from roboxim_sim.rendering import photo_worker, textures
from roboxim_sim.rendering.geometry import SURROUNDINGS, check_mesh, check_request, linear, textured
from roboxim_sim.rendering.owner import Owner

SAMPLES = 6
"""Paths per pixel."""
PYTHON_VARIABLE = "ROBOXIM_PHOTO_PYTHON"
"""Environment variable with the path of another Python that has bpy."""
THREADS_VARIABLE = "ROBOXIM_PHOTO_THREADS"
"""Environment variable with the number of threads; the images do not depend on it."""
OPTICAL_TO_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])
"""Blender's camera looks along -z with y upwards."""


def photo_python() -> Path:
    """Return the Python that has Blender.

    Raises:
        SimError: RENDERER_UNAVAILABLE, saying how to install it.
    """
    given = os.environ.get(PYTHON_VARIABLE)
    places = [parent / ".tools" / "photo-env" / "bin" / "python" for parent in Path(__file__).resolve().parents]
    for python in [Path(given)] if given else places:
        if python.is_file():
            return python
    raise SimError(
        "renderer 'photo' needs Blender, which is not installed: run 'make photo' in the checkout, or let "
        f"{PYTHON_VARIABLE} name a Python 3.11 that has bpy",
        ErrorCode.RENDERER_UNAVAILABLE,
    )


class PhotoRenderer:
    """Path-tracing renderer, see the module; implements `roboxim_core.vision.renderer.Renderer`."""

    name = "photo"

    def __init__(self, samples: int = SAMPLES, threads: int = 0) -> None:
        """Start Blender.

        Args:
            samples: Paths per pixel.
            threads: Number of threads; 0: the value of `THREADS_VARIABLE`, or one per core if that is unset.

        Raises:
            SimError: RENDERER_UNAVAILABLE when Blender is not installed or does not start.
        """
        self._owner = Owner()
        python = photo_python()
        threads = threads or int(os.environ.get(THREADS_VARIABLE) or 0)
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
        self._process = subprocess.Popen(
            [python, photo_worker.__file__, str(samples), str(threads)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log, env=_foreign_environment(),
        )  # fmt: skip
        self._keys: tuple[str, ...] | None = None
        self.cpu_s = 0.0
        """Processor time of the last `render` [s]."""
        try:
            version = self._receive()[0]["version"]
        except SimError as error:
            raise SimError(f"renderer 'photo' does not start: {error}", ErrorCode.RENDERER_UNAVAILABLE) from None
        self.device = f"Blender {version} Cycles, CPU, {samples} samples, denoised"

    def load(self, world: RenderWorld) -> None:
        """Replace the world.

        Raises:
            ConfigError: On an unknown texture.
            InvalidRequestError: On a malformed world.
            SimError: When called from another thread or process, after `close`, or when Blender fails.
        """
        self._owner.check()
        entities = {name: index + 1 for index, name in enumerate(world.entity_names)}
        parts: list[dict[str, Any]] = []
        arrays: dict[str, npt.NDArray[Any]] = {}
        for body in world.bodies:
            for part in body.parts:
                check_mesh(part.mesh, body.key)
                material, number = part.material, len(parts)
                mesh = textured(part.mesh) if material.texture else part.mesh
                arrays |= {f"{number}/vertices": mesh.vertices, f"{number}/faces": mesh.faces}
                arrays[f"{number}/normals"] = mesh.normals
                if mesh.uv is not None:
                    arrays[f"{number}/uv"] = mesh.uv
                if material.texture:
                    pixels = textures.pixels(material.texture).astype(np.float32) / 255
                    arrays[f"texture/{material.texture}"] = pixels**2
                parts.append(
                    {
                        "key": body.key,
                        "entity_id": entities[body.entity],
                        "surroundings": body.entity in SURROUNDINGS,
                        "material": {
                            "color": linear(material.color).tolist(),
                            "metallic": material.metallic,
                            "roughness": material.roughness,
                            "texture": material.texture,
                        },
                    }
                )
        look, ambient = world.look, np.asarray(world.look.ambient)
        self._send(
            {
                "do": "load",
                "parts": parts,
                "lights": [_light(light) for light in look.lights],
                "sky": (1.25 * ambient).tolist(),
                "ground": (ambient * (0.72, 0.66, 0.6)).tolist(),
                "backdrop": linear(look.backdrop).tolist(),
            },
            arrays,
        )
        self._receive()
        self._keys = tuple(body.key for body in world.bodies)

    def render(
        self, poses: Mapping[str, Pose], cameras: Sequence[tuple[CameraSpec, Pose]], *, colour: bool = True
    ) -> dict[str, CameraImages]:
        """Draw all cameras of a tick; see `roboxim_core.vision.renderer.Renderer`.

        Raises:
            InvalidRequestError: On a pose of an unknown body, or two cameras with the same name.
            SimError: When called from another thread or process, before `load`, after `close`, or when Blender fails.
        """
        self._owner.check(loaded=self._keys is not None)
        assert self._keys is not None
        check_request(self._keys, poses, cameras)
        self._send(
            {
                "do": "render",
                "poses": {key: pose.matrix.tolist() for key, pose in poses.items()},
                "cameras": [_camera(camera, pose) for camera, pose in cameras],
            }
        )
        answer, arrays = self._receive()
        self.cpu_s = answer["cpu_s"]
        return {
            camera.name: CameraImages(
                rgb=_developed(arrays[f"{camera.name}/rgb"]),
                depth=arrays[f"{camera.name}/depth"] if camera.depth else None,
                segmentation=arrays[f"{camera.name}/segmentation"] if camera.segmentation else None,
            )
            for camera, _ in cameras
        }

    def close(self) -> None:
        """Stop Blender. Closing twice is harmless."""
        if not self._owner.end():
            return
        assert self._process.stdin
        assert self._process.stdout
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._log.close()

    def _send(self, message: dict[str, Any], arrays: dict[str, npt.NDArray[Any]] | None = None) -> None:
        assert self._process.stdin
        with contextlib.suppress(BrokenPipeError):  # `_receive` reports the reason
            photo_worker.send(self._process.stdin, message, arrays)

    def _receive(self) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
        assert self._process.stdout
        try:
            message, arrays = photo_worker.receive(self._process.stdout)
        except (EOFError, ValueError):
            status = self._process.wait(10.0)
            self._log.seek(0)
            tail = self._log.read().decode(errors="replace").strip()[-400:]
            raise SimError(f"Blender ended with status {status}: {tail or 'it printed nothing'}") from None
        if "error" in message:
            raise SimError(f"Blender failed: {message['error']}")
        return message, arrays


def _camera(camera: CameraSpec, pose: Pose) -> dict[str, Any]:
    return {
        "name": camera.name, "width": camera.width, "height": camera.height, "matrix": camera.matrix,
        "near": camera.near, "far": camera.far, "geometry": camera.depth or camera.segmentation,
        "pose": (pose.matrix @ OPTICAL_TO_BLENDER).tolist(),
    }  # fmt: skip


def _light(light: LightSpec) -> dict[str, Any]:
    """Return a light in Blender's units: a sun's irradiance [W/m^2], a lamp's power [W]; both shine along -z."""
    if light.kind == "lamp":
        pose = Pose(position=light.position)
        energy = light.intensity * 4 * np.pi * max(float(np.dot(light.position, light.position)), 0.01)
    else:
        steep = abs(light.direction[2]) > 0.9 * float(np.linalg.norm(light.direction))
        pose = look_at((0, 0, 0), light.direction, up=(1.0, 0.0, 0.0) if steep else (0.0, 0.0, 1.0))
        energy = light.intensity
    return {
        "kind": light.kind, "color": linear(light.color).tolist(), "energy": energy, "radius": light.radius,
        "shadow": light.shadow, "matrix": (pose.matrix @ OPTICAL_TO_BLENDER).tolist(),
    }  # fmt: skip


def _developed(light: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Return linear light as 8-bit sRGB, with a soft shoulder above 0.6."""
    over = np.maximum(light - 0.6, 0.0)
    light = np.clip(np.minimum(light, 0.6) + over / (1 + 2.5 * over), 0.0, 1.0)
    return np.asarray(np.rint(255 * to_srgb(light)), dtype=np.uint8)


def _foreign_environment() -> dict[str, str]:
    """Return the environment variables for a foreign Python, without the paths of ROS and of RoboXim's packages."""
    drop = {"PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    return {name: value for name, value in os.environ.items() if name not in drop}
