"""Images that stand still or show nothing."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from roboxim_datasets.audit.check import AUDIT_CHECKS, AuditCheck
from roboxim_datasets.audit.checks.control import longest_run
from roboxim_datasets.audit.values import AuditEpisode, CannotCheckError, Finding, Flags, Values

EQUAL = 3.0
EQUAL_FRAMES = 3
NOISY_FRAMES = 6
"""Images in a row that are equal but for noise, where a dataset stores images without loss: they may have been stored
with loss before."""
MOVED_M = 0.005
BLANK = 2.0
CONSTANT = 0.5
PLAIN = 4.0
"""Standard deviation of the brightness below which an image cannot show that a camera stands still."""


@AUDIT_CHECKS.register("frozen_camera")
class FrozenCamera(AuditCheck):
    """A camera that repeats its image while the hand moves."""

    title = "A camera stands still"
    reason = "The images belong to other ticks than the actions: the policy learns to act on past images."
    threshold = (
        f"{EQUAL_FRAMES} or more images in a row that are equal, while the hand moves by more than {1000 * MOVED_M:g} "
        f"mm; where images are stored with loss, or in {NOISY_FRAMES} and more, equal means that no cell (1/32 of a "
        f"side) changes by more than {EQUAL:g} of 255; a camera at half the control rate passes, and one that shows "
        f"nothing but a plain surface (a standard deviation of the brightness below {PLAIN:g})"
    )
    needs = "images, and the position of the hand or a second camera"
    order = 14

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find repeated images."""
        if not episode.episode.cameras:
            raise CannotCheckError("the dataset has no images")
        for camera, track in episode.tracks.items():
            moved = _moved(episode, camera)
            plain = track.deviation < PLAIN
            seen = ~(plain[1:] & plain[:-1])
            if episode.exact_images:
                runs = list(_still((track.change == 0) & seen, EQUAL_FRAMES, moved))
                runs = runs or [
                    (start, frames)
                    for start, frames in _still((track.change < EQUAL) & seen, NOISY_FRAMES, moved)
                    if np.abs(track.cells[start + frames - 1] - track.cells[start]).max() < EQUAL
                ]
            else:
                runs = list(_still((track.change < EQUAL) & seen, EQUAL_FRAMES, moved))
            if runs:
                begin, frames = runs[0]
                yield episode.finding(
                    f"{camera}: {frames} equal images from tick {begin} on"
                    + (f", and {len(runs) - 1} more such runs" if len(runs) > 1 else ""),
                    ticks=(begin, begin + frames - 1),
                    cameras=(camera,),
                    series={f"{camera}: largest change of a cell": tuple(track.change)},
                )


def _still(equal: Flags, minimum: int, moved: Values) -> Iterator[tuple[int, int]]:
    """Yield the first tick and the number of images of each run of equal images while the hand moves, longest first.

    Args:
        equal: Whether an image equals the one before, shape (T - 1,).
        minimum: Fewest images of a run.
        moved: How far the hand moves between ticks [m], shape (T - 1,).
    """
    left = equal.copy()
    start, length = longest_run(left)
    while length + 1 >= minimum:
        if moved[start : start + length].sum() > MOVED_M:
            yield start, length + 1
        left[start : start + length] = False
        start, length = longest_run(left)


def _moved(episode: AuditEpisode, camera: str) -> Values:
    """Return how far the hand moves between ticks [m], or any number beyond `MOVED_M` where another camera changes."""
    if "tcp_position" in episode.proprio:
        return np.asarray(np.linalg.norm(np.diff(episode.proprio["tcp_position"], axis=0), axis=1), float)
    others = [track for name, track in episode.tracks.items() if name != camera]
    if not others:
        raise CannotCheckError("the hand's motion is unknown: no position, no second camera")
    return np.asarray(np.where(np.max([track.change for track in others], axis=0) > 4 * EQUAL, 1.0, 0.0), float)


@AUDIT_CHECKS.register("blank_camera")
class BlankCamera(AuditCheck):
    """Images of one brightness."""

    title = "A camera shows nothing"
    reason = "A policy cannot learn from an image without content, and its features get used to it."
    threshold = (
        f"a standard deviation of the brightness below {CONSTANT:g} of 255 in any image, or below {BLANK:g} in half of "
        "them; a wrist camera close to a plain surface passes"
    )
    needs = "images"
    order = 15

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find images without content."""
        if not episode.episode.cameras:
            raise CannotCheckError("the dataset has no images")
        for camera, track in episode.tracks.items():
            blank = np.flatnonzero(track.deviation < BLANK)
            if 2 * len(blank) < len(track.deviation):
                blank = np.flatnonzero(track.deviation < CONSTANT)
            if len(blank):
                yield episode.finding(
                    f"{camera}: {len(blank)} of {len(track.deviation)} images are blank, the first at tick {blank[0]}",
                    ticks=(int(blank[0]),),
                    cameras=(camera,),
                )
