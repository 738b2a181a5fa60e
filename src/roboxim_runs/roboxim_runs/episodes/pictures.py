"""Pictures of recorded episodes: films and contact sheets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from roboxim_recorder.bag import BagReader
from roboxim_runs.episodes.caption import captioned


def film(bag: Path, every: int = 2) -> list[npt.NDArray[np.uint8]]:
    """Return a bag's frames, cameras side by side.

    Args:
        bag: The bag.
        every: Read every n-th tick, and the last.

    Returns:
        Frames of shape (height, sum of widths, 3); none when the episode has no cameras.
    """
    reader = BagReader(bag)
    if not reader.info.scene.cameras:
        return []
    last = len(reader) - 1
    frames = []
    for tick in reader.ticks():
        if tick.seq % every == 0 or tick.seq == last:
            images = [tick.images[name] for name in sorted(tick.images)]
            height = min(image.shape[0] for image in images)
            frames.append(np.concatenate([image[:height] for image in images], axis=1))
    return frames


def _strip(frames: Sequence[npt.NDArray[np.uint8]], columns: int = 6) -> npt.NDArray[np.uint8]:
    """Return frames of a film side by side, from its start to its end."""
    picks = np.linspace(0, len(frames) - 1, columns).round().astype(int)
    return np.concatenate([frames[i] for i in picks], axis=1)


def write_contact_sheet(bags: Sequence[Path], picture: Path) -> bool:
    """Write a picture with a strip of frames of each bag, under its instruction and a compass.

    Returns:
        Whether it was written: bags of episodes without cameras show nothing.
    """
    strips = []
    for bag in bags:
        info = BagReader(bag).info
        if not info.scene.cameras:
            continue
        cameras = {camera.name: camera for camera in info.scene.cameras}
        first = cameras.get("workspace") or next(iter(cameras.values()), None)
        strips.append(captioned(_strip(film(bag)), info.task.instruction, first))
    if strips:
        Image.fromarray(np.concatenate(strips, axis=0)).save(picture)
    return bool(strips)
