"""The `tiny` renderer: PyBullet's built-in software rasteriser, which needs no GL.

It is slower and simpler than `raster`: no metals, no anti-aliasing, hard shadows, the main light only. Its pixels use
the same rays, and depth and segmentation have the same meaning.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from roboxim_core.errors import ErrorCode, InvalidRequestError, SimError
from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.specs import CameraSpec, LightSpec, LookSpec
from roboxim_core.vision.renderer import CameraImages, RenderWorld, TriangleMesh, VisualPart
from roboxim_sim.bullet import BulletClient, pybullet
from roboxim_sim.rendering import textures
from roboxim_sim.rendering.geometry import check_mesh, check_request, textured
from roboxim_sim.rendering.owner import Owner

MAX_VERTICES = 131_072
"""PyBullet's limit for one mesh."""
OPTICAL_TO_GL = np.diag([1.0, -1.0, -1.0, 1.0])
"""PyBullet's camera looks along -z with y upwards."""


@dataclass(frozen=True, kw_only=True)
class _Part:
    """A PyBullet body that displays one part."""

    uid: int
    key: str
    entity_id: int


class TinyRenderer:
    """PyBullet's software renderer, see the module; implements `roboxim_core.vision.renderer.Renderer`."""

    name = "tiny"
    device = "PyBullet TinyRenderer"

    def __init__(self) -> None:
        """Start a separate PyBullet client."""
        self._owner = Owner()
        self._client = BulletClient()
        if not self._client.isConnected():
            raise SimError("PyBullet provides no more clients; close some", ErrorCode.RENDERER_UNAVAILABLE)
        self._parts: tuple[_Part, ...] | None = None
        self._keys: tuple[str, ...] = ()
        self._look = LookSpec()

    def load(self, world: RenderWorld) -> None:
        """Replace the world.

        Raises:
            InvalidRequestError: On a malformed world.
            SimError: When called from another thread or process, or after `close`.
        """
        self._owner.check()
        self._client.resetSimulation()
        self._parts = None
        entities = {name: index + 1 for index, name in enumerate(world.entity_names)}
        parts, loaded = [], dict[str, int]()
        for body in world.bodies:
            for part in body.parts:
                uid = self._add(part, body.key, loaded)
                parts.append(_Part(uid=uid, key=body.key, entity_id=entities[body.entity]))
        self._keys = tuple(body.key for body in world.bodies)
        self._look = world.look
        self._parts = tuple(parts)

    def render(
        self, poses: Mapping[str, Pose], cameras: Sequence[tuple[CameraSpec, Pose]], *, colour: bool = True
    ) -> dict[str, CameraImages]:
        """Draw all cameras of a tick; see `roboxim_core.vision.renderer.Renderer`.

        Raises:
            InvalidRequestError: On a pose of an unknown body, or two cameras with the same name.
            SimError: When called from another thread or process, before `load` or after `close`.
        """
        self._owner.check(loaded=self._parts is not None)
        assert self._parts is not None
        check_request(self._keys, poses, cameras)
        for part in self._parts:
            pose = poses.get(part.key, IDENTITY)
            self._client.resetBasePositionAndOrientation(part.uid, pose.position, pose.quat_xyzw)
        return {camera.name: self._draw(camera, pose, self._parts) for camera, pose in cameras}

    def close(self) -> None:
        """Stop the client. Closing twice is harmless."""
        if self._owner.end():
            self._client.disconnect()

    def _add(self, part: VisualPart, key: str, loaded: dict[str, int]) -> int:
        """Add a part and return its PyBullet body."""
        check_mesh(part.mesh, key)
        name = part.material.texture
        mesh = textured(part.mesh) if name else part.mesh
        if max(len(mesh.vertices), mesh.faces.size) > MAX_VERTICES:
            raise InvalidRequestError(
                f"body '{key}': renderer 'tiny' takes at most {MAX_VERTICES} vertices and indices a part, got "
                f"{len(mesh.vertices)} and {mesh.faces.size}; use 'raster' or a simpler mesh"
            )
        shape = self._client.createVisualShape(
            pybullet.GEOM_MESH,
            **_lists(mesh),
            rgbaColor=(*part.material.color, 1.0),
            specularColor=[0.4 * (1.0 - part.material.roughness)] * 3,
        )
        uid = int(self._client.createMultiBody(baseVisualShapeIndex=shape))
        if name:
            if name not in loaded:
                loaded[name] = self._load_texture(name)
            self._client.changeVisualShape(uid, -1, textureUniqueId=loaded[name])
        return uid

    def _load_texture(self, name: str) -> int:
        with tempfile.TemporaryDirectory(prefix="roboxim-") as folder:
            path = Path(folder) / "texture.png"
            Image.fromarray(textures.pixels(name)[::-1]).save(path)  # its v runs downwards
            return int(self._client.loadTexture(str(path)))

    def _draw(self, camera: CameraSpec, pose: Pose, parts: tuple[_Part, ...]) -> CameraImages:
        near, far = camera.near, camera.far
        projection = list(pybullet.computeProjectionMatrixFOV(45.0, 1.0, near, far))
        fx, fy, cx, cy = camera.matrix
        projection[0], projection[5] = 2 * fx / camera.width, 2 * fy / camera.height
        # PyBullet samples pixels at a corner instead of the centre: shift by half a pixel.
        projection[8] = 1 - 2 * cx / camera.width
        projection[9] = (2 * cy + 2) / camera.height - 1
        view = OPTICAL_TO_GL @ pose.inverse().matrix
        _, _, rgba, depth, mask = self._client.getCameraImage(
            camera.width,
            camera.height,
            view.T.reshape(-1).tolist(),
            projection,
            renderer=pybullet.ER_TINY_RENDERER,
            **_light(self._look),
        )
        shape = (camera.height, camera.width)
        rgb = np.asarray(rgba, dtype=np.uint8).reshape(*shape, 4)[..., :3].copy()
        z_buffer = np.asarray(depth, dtype=np.float64).reshape(shape)
        uids = np.asarray(mask, dtype=np.int64).reshape(shape)
        metric = np.where(uids < 0, np.inf, far * near / (far - (far - near) * z_buffer)).astype(np.float32)
        ids = np.zeros(max(part.uid for part in parts) + 2 if parts else 1, np.uint16)
        for part in parts:
            ids[part.uid] = part.entity_id
        return CameraImages(
            rgb=_backdrop(rgb, uids < 0, self._look),
            depth=metric if camera.depth else None,
            segmentation=np.where(uids < 0, 0, ids[uids]).astype(np.uint16) if camera.segmentation else None,
        )


_LISTS: dict[bytes, dict[str, list[Any]]] = {}
"""PyBullet never frees the lists that it receives (7 MiB for each load of a scene), so equal meshes share theirs."""


def _lists(mesh: TriangleMesh) -> dict[str, list[Any]]:
    arrays = {"vertices": mesh.vertices, "indices": mesh.faces.reshape(-1), "normals": mesh.normals, "uvs": mesh.uv}
    sha = hashlib.sha256()
    for array in arrays.values():
        sha.update(b"none" if array is None else b"%d" % array.size + array.tobytes())
    key = sha.digest()
    if key not in _LISTS:
        _LISTS[key] = {name: [] if array is None else array.tolist() for name, array in arrays.items()}
    return _LISTS[key]


def _backdrop(rgb: npt.NDArray[np.uint8], nothing: npt.NDArray[np.bool_], look: LookSpec) -> npt.NDArray[np.uint8]:
    rgb[nothing] = np.rint(255 * np.clip(look.backdrop, 0.0, 1.0)).astype(np.uint8)
    return rgb


def _light(look: LookSpec) -> dict[str, object]:
    """Return PyBullet's light parameters for the main light and the surroundings."""
    main = next((light for light in look.lights if light.shadow), None) or next(iter(look.lights), None)
    if main is None:
        main = LightSpec(intensity=0.0, shadow=False)
    if main.kind == "lamp":
        towards, distance = np.asarray(main.position, dtype=float), float(np.linalg.norm(main.position))
    else:
        towards, distance = -np.asarray(main.direction, dtype=float), 3.0
    return {
        "lightDirection": (towards / max(float(np.linalg.norm(towards)), 1e-9)).tolist(),
        "lightDistance": max(distance, 0.1),
        "lightColor": list(main.color),
        "shadow": int(main.shadow),
        "lightAmbientCoeff": float(np.clip(0.85 * np.mean(look.ambient), 0.0, 1.0)),
        "lightDiffuseCoeff": float(np.clip(0.2 * main.intensity, 0.0, 1.0)),
        "lightSpecularCoeff": 0.1,
    }
