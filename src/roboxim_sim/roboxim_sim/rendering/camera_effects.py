"""Camera models on top of a renderer's ideal pinhole images: lens distortion, sensor noise and frame rate.

A renderer draws pinhole cameras without distortion and noise. For each camera `CameraRig`:

1. requests a pinhole image that covers the lens' field of view,
2. distorts that image,
3. adds the sensor's noise,
4. holds the frame if the camera is slower than the tick.

Non-obvious behaviours:
- Every camera delivers an image at every tick, because an observation belongs to a tick. A slower camera takes frames
  at the times of the ticks 0, n, 2 n, ... and repeats the last one, bit for bit, in between, as a control loop that
  reads the newest frame sees it. Times count, not numbers of ticks: outside an episode a tick may last longer. When a
  restored snapshot loads the world between two frames, the camera starts with a new frame.
- Depth and segmentation are distorted with the nearest pixel, never blended; noise is added to colour and depth only.
- A frame's noise depends only on the camera's noise seed, its name and the tick, so a frame can be reproduced.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import Pose
from roboxim_core.specs import CameraNoise, CameraSpec, SceneSpec
from roboxim_core.vision.cameras import ideal_camera, rays_of_pixels
from roboxim_core.vision.renderer import CameraImages, Renderer, RenderWorld
from roboxim_core.vision.srgb import to_linear, to_srgb

MAX_SIZE = 4096
"""Maximum width and height of the pinhole image for a distorted one [px]."""
FINER = 2
"""Oversampling of the pinhole image, so that the nearest pixel is at most a quarter of a pixel away; an image that
would exceed `MAX_SIZE` by it has none."""
Views = Sequence[tuple[CameraSpec, Pose]]


class CameraRig:
    """The cameras of a scene on a renderer; use it from the renderer's thread only."""

    def __init__(self, renderer: Renderer) -> None:
        """Use a renderer; the caller keeps its ownership and closes it."""
        self.renderer = renderer
        self._periods_ns: dict[str, float] = {}
        """Time between two frames by camera [ns]; 0: a frame at every tick."""
        self._frames: dict[str, int] = {}
        self._held: dict[str, CameraImages] = {}

    def load(self, world: RenderWorld, scene: SceneSpec) -> None:
        """Replace the world and discard all held frames.

        Raises:
            InvalidRequestError: On a malformed world, or a camera with an impossible lens (see `Lens`).
            SimError: As the renderer's `load`.
        """
        for camera in scene.cameras:
            _lens(camera)
        self._held, self._frames = {}, {}
        ticks = {camera.name: camera.ticks_per_frame(scene.control_rate_hz) for camera in scene.cameras}
        self._periods_ns = {name: 1e9 * n / scene.control_rate_hz if n > 1 else 0.0 for name, n in ticks.items()}
        self.renderer.load(world)

    def capture(self, seq: int, stamp_ns: int, poses: Mapping[str, Pose], views: Views) -> dict[str, CameraImages]:
        """Return the images of every camera at a tick; a held frame is the same object as before.

        Args:
            seq: The tick, which the noise depends on.
            stamp_ns: Its time [ns].
            poses: Poses in the world by body key.
            views: Cameras of the loaded scene with the poses of their optical frames in the world.

        Raises:
            InvalidRequestError: On a pose of an unknown body, or two cameras with the same name.
            SimError: As the renderer's `render`.
        """
        due = [(camera, pose) for camera, pose in views if self._is_due(camera.name, stamp_ns)]
        if due:
            self._held |= draw_frames(self.renderer, seq, poses, due)
        return {camera.name: self._held[camera.name] for camera, _ in views}

    def _is_due(self, name: str, stamp_ns: int) -> bool:
        """Return whether a camera takes a frame, and note which."""
        period = self._periods_ns.get(name, 0.0)
        if not period:
            return True
        frame, past = divmod(stamp_ns + 1, period)  # stamps are rounded to 1 ns
        before, self._frames[name] = self._frames.get(name), int(frame)
        return frame != before or past <= 2  # at a frame's very time again, e.g. after an object was moved


def draw_frames(
    renderer: Renderer, seq: int, poses: Mapping[str, Pose], views: Views, *, colour: bool = True
) -> dict[str, CameraImages]:
    """Take a frame with every camera, regardless of its rate.

    Args:
        renderer: A renderer with the world loaded.
        seq: The tick, which the noise depends on.
        poses: Poses in the world by body key.
        views: Cameras with the poses of their optical frames in the world.
        colour: See `Renderer.render`.

    Raises:
        InvalidRequestError: On a pose of an unknown body, two cameras with the same name, or an impossible lens.
        SimError: As the renderer's `render`.
    """
    lenses = {camera.name: _lens(camera) for camera, _ in views}
    pinholes = [(lens.source if (lens := lenses[c.name]) else c, pose) for c, pose in views]
    images = renderer.render(poses, pinholes, colour=colour)
    frames = {}
    for camera, _ in views:
        frame, lens = images[camera.name], lenses[camera.name]
        frames[camera.name] = _expose(camera, seq, lens.bend(frame) if lens else frame)
    return frames


class Lens:
    """A distorting lens: the pinhole camera to draw, and the mapping that distorts its image."""

    def __init__(self, camera: CameraSpec) -> None:
        """Compute the pinhole camera and the mapping.

        Raises:
            InvalidRequestError: When the distortion folds the image or its field of view is too wide.
        """
        rays = rays_of_pixels(camera)
        fx, fy, _, _ = camera.matrix
        low, high = rays.min(axis=(0, 1)), rays.max(axis=(0, 1))
        # One pixel of margin for the interpolation; the same focal lengths keep the centre as sharp.
        cx, cy = (math.ceil(-low[0] * fx) + 1, math.ceil(-low[1] * fy) + 1)
        width = max(math.ceil(high[0] * fx) + 2 + cx, 16)
        height = max(math.ceil(high[1] * fy) + 2 + cy, 16)
        if max(width, height) > MAX_SIZE:
            raise InvalidRequestError(
                f"camera '{camera.name}': its distorted image needs a pinhole image of {width}x{height} px, more than "
                f"{MAX_SIZE}; choose a narrower field of view or a smaller image"
            )
        finer = self._finer = FINER if FINER * max(width, height) <= MAX_SIZE else 1
        coarse = replace(ideal_camera(camera), width=width, height=height, intrinsics=(fx, fy, cx, cy))
        self.source = coarse.resized(finer * width, finer * height)
        """The pinhole camera whose image covers the lens' field of view, at `FINER` times the resolution if it can."""
        at = rays * (fx, fy) + (cx, cy)
        self._linear = (at[..., 0].astype(np.float32), at[..., 1].astype(np.float32))
        fine = np.rint((at + 0.5) * finer - 0.5).astype(np.float32)
        self._nearest = (fine[..., 0].copy(), fine[..., 1].copy())

    def bend(self, images: CameraImages) -> CameraImages:
        """Return the distorted images, given the pinhole camera's images."""
        height, width, _ = images.rgb.shape
        rgb = cv2.resize(images.rgb, (width // self._finer, height // self._finer), interpolation=cv2.INTER_AREA)
        return CameraImages(
            rgb=np.asarray(cv2.remap(rgb, *self._linear, cv2.INTER_LINEAR), np.uint8),
            depth=None if images.depth is None else self._pick(images.depth),
            segmentation=None if images.segmentation is None else self._pick(images.segmentation),
        )

    def _pick(self, image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the nearest pixel of the pinhole image for each pixel of the distorted one."""
        return np.asarray(cv2.remap(image, *self._nearest, cv2.INTER_NEAREST), image.dtype)


def _lens(camera: CameraSpec) -> Lens | None:
    """Return a camera's lens, or none if the camera does not distort."""
    if not any(camera.distortion):
        return None
    # Clear the fields that move with the robot or change with the episode: the lens does not depend on them.
    return _cached_lens(replace(camera, pose=Pose(), parent="", noise=CameraNoise(), rate_hz=0.0))


@lru_cache(maxsize=16)
def _cached_lens(camera: CameraSpec) -> Lens:
    return Lens(camera)


def _expose(camera: CameraSpec, seq: int, images: CameraImages) -> CameraImages:
    """Apply the sensor's blur, exposure and noise."""
    noise = camera.noise
    if noise == CameraNoise(seed=noise.seed):
        return images
    rgb, depth = images.rgb, images.depth
    if noise.shot or noise.read or noise.blur_px or noise.exposure_ev:
        light = _LINEAR[rgb]
        if noise.blur_px:
            # OpenCV's kernel ends at 4 standard deviations if the image has floats.
            light = np.asarray(cv2.GaussianBlur(light, (0, 0), noise.blur_px, borderType=cv2.BORDER_REPLICATE))
        light *= np.float32(2.0**noise.exposure_ev)
        if noise.shot or noise.read:
            deviation = np.sqrt(np.float32(noise.shot**2) * light + np.float32(noise.read**2))
            light += deviation * _rng(camera, seq, "rgb").standard_normal(light.shape, dtype=np.float32)
        rgb = _to_srgb(light)
    if depth is not None and noise.depth:
        error = _rng(camera, seq, "depth").standard_normal(depth.shape, dtype=np.float32)
        seen = np.where(np.isfinite(depth), depth, np.float32(0))
        depth = np.maximum(depth + np.float32(noise.depth) * seen * seen * error, np.float32(0))
    return replace(images, rgb=rgb, depth=depth)


def _rng(camera: CameraSpec, seq: int, kind: str) -> np.random.Generator:
    name = int.from_bytes(hashlib.blake2s(f"{camera.name}/{kind}".encode(), digest_size=4).digest(), "little")
    return np.random.default_rng(np.random.SeedSequence(camera.noise.seed, spawn_key=(name, seq)))


def _linear_table() -> npt.NDArray[np.float32]:
    return to_linear(np.arange(256) / 255).astype(np.float32)


def _srgb_table() -> npt.NDArray[np.uint8]:
    return np.asarray(np.rint(255 * to_srgb(np.arange(_STEPS + 1) / _STEPS)), dtype=np.uint8)


_STEPS = 16384
_LINEAR, _SRGB = _linear_table(), _srgb_table()


def _to_srgb(light: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Return 8-bit sRGB of linear light 0..1 from a lookup table, which is ten times as fast as the power function."""
    return np.asarray(_SRGB[np.rint(np.clip(light, 0.0, 1.0) * _STEPS).astype(np.intp)])
