"""Compares two datasets of any formats: proves them equal, or names what differs.

Numbers are compared bit for bit as float32: actions, executed actions, observed vectors, signals, rewards. Images are
compared exactly where both formats are lossless. Where a codec lies between, every image must reach a peak
signal-to-noise ratio (PSNR). Episodes are compared by their place in their split, because their order is part of what a
trainer sees. Depth and segmentation are compared too, depth between formats within the rounding of LeRobot's unit.
Names of components are compared where both datasets state them. Metadata of episodes are not compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import InvalidRequestError, counted
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.episode import EXECUTED, Episode, RGBImage, Step
from roboxim_datasets.lerobot.layout import DEPTH_UNIT_M, MAX_DEPTH

Images = Literal["auto", "exact", "psnr", "skip"]
LOWEST_PSNR_DB = 30.0
"""Default of the lowest PSNR of an image [dB]. The exports' JPEG reaches 43 dB or more and their h264 34 to 41 dB. The
image of the next tick has 26 to 29 dB (median over demonstrations of picking up, images of 128 px)."""
LISTED = 20
"""Further differences are only counted."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """One difference."""

    episode: str
    """Episode, e.g. ``train[3] demo-0-00003-0``; empty: it concerns the whole dataset."""
    what: str
    """What differs, with both values."""

    def __str__(self) -> str:
        """Return it as a line."""
        return f"{self.episode}: {self.what}" if self.episode else self.what


@dataclass(kw_only=True)
class ImageComparison:
    """How the images of one camera compare."""

    count: int = 0
    """Number of images."""
    equal: int = 0
    """Number of images that are equal, pixel by pixel."""
    lowest_db: float = math.inf
    """Lowest PSNR of an image [dB]; infinite: all are equal."""
    total_squared: float = 0.0
    """Sum of the images' mean squared errors."""

    @property
    def mean_db(self) -> float:
        """PSNR of the mean squared error over all images [dB]."""
        return _psnr(self.total_squared / self.count) if self.count else math.inf


@dataclass(kw_only=True)
class Comparison:
    """Result of a comparison."""

    episodes: int = 0
    """Number of episodes that both have."""
    steps: int = 0
    """Number of steps that were compared."""
    differences: list[Difference] = field(default_factory=list)
    """The first differences."""
    count: int = 0
    """Number of differences in all."""
    compared: dict[str, str] = field(default_factory=dict)
    """What was compared, to how."""
    images: dict[str, ImageComparison] = field(default_factory=dict)
    """Camera to how its images compare."""

    @property
    def equal(self) -> bool:
        """Whether the datasets are equal."""
        return not self.count

    def add(self, what: str, episode: str = "") -> None:
        """Note a difference."""
        self.count += 1
        if len(self.differences) < LISTED:
            self.differences.append(Difference(episode=episode, what=what))


def compare(
    a: Dataset,
    b: Dataset,
    *,
    images: Images = "auto",
    lowest_psnr_db: float = LOWEST_PSNR_DB,
    ignore: Sequence[str] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Comparison:
    """Compare two datasets.

    Args:
        a: A dataset.
        b: Another, of any format.
        images: ``exact``, ``psnr``, ``skip``, or ``auto``: exact if both are lossless.
        lowest_psnr_db: Lowest PSNR of an image that counts as equal [dB].
        ignore: Names of cameras, vectors and signals that one of them may lack or that may differ.
        progress: Called with the episodes done and their total.

    Raises:
        InvalidRequestError: When the lowest PSNR is no number of at least 0.
        RecorderError: With code ``BAG_DAMAGED`` when a dataset cannot be read.
    """
    if not lowest_psnr_db >= 0:
        raise InvalidRequestError(f"the lowest PSNR must be a number of at least 0 dB, got {lowest_psnr_db:g}")
    found = Comparison()
    how = images if images != "auto" else "exact" if a.features.lossless and b.features.lossless else "psnr"
    names = _common_names(a, b, ignore, found, with_images=how != "skip")
    if dict(a.splits) != dict(b.splits):
        found.add(f"splits: {dict(a.splits)} against {dict(b.splits)}")
    shared = [(split, index) for split in a.splits for index in range(min(a.splits[split], b.splits.get(split, 0)))]
    shown = f"at least {lowest_psnr_db:g} dB in every image"
    found.compared["images"] = {"exact": "pixel by pixel", "psnr": shown, "skip": "not compared"}[how]
    ids: list[tuple[str, str]] = []
    for done, (split, index) in enumerate(shared, start=1):
        one, other = a.read(split, index), b.read(split, index)
        where = f"{split}[{index}] {one.episode_id}".rstrip()
        lowest = None if how == "exact" else lowest_psnr_db
        _compare_episode(one, other, where, names, found, lowest)
        ids.append((one.episode_id, other.episode_id))
        found.episodes += 1
        progress(done, len(shared))
    first, second = ([pair[side] for pair in ids] for side in (0, 1))
    if first != second and all(first) and sorted(first) == sorted(second):
        found.add("the episodes are the same, in another order or in other splits")
    return found


@dataclass(frozen=True, kw_only=True)
class _Names:
    vectors: tuple[str, ...]
    signals: tuple[str, ...]
    cameras: tuple[str, ...]
    depth: tuple[str, ...]
    segmentation: tuple[str, ...]
    depth_apart_m: float
    executed: bool
    subtasks: bool


def _common_names(a: Dataset, b: Dataset, ignore: Sequence[str], found: Comparison, *, with_images: bool) -> _Names:
    """Return the names of what both datasets have; what only one has is a difference."""

    def common(kind: str, first: Iterable[str], second: Iterable[str]) -> tuple[str, ...]:
        one, other = ({name for name in names if name not in ignore} for names in (first, second))
        for name in sorted(one ^ other):
            found.add(f"only {a.path if name in one else b.path} has {kind} '{name}'")
        return tuple(sorted(one & other))

    first, second = a.features, b.features
    vectors = common("the vector", first.vectors, second.vectors)
    signals = common("the signal", first.signals, second.signals)
    cameras = common("the camera", first.cameras, second.cameras) if with_images else ()
    depth = common("depth of camera", first.depth, second.depth) if with_images else ()
    segmentation = common("segmentation of camera", first.segmentation, second.segmentation) if with_images else ()
    _compare_components("action", first.action, second.action, found)
    for name in vectors:
        _compare_components(f"vector '{name}'", first.vectors[name], second.vectors[name], found)
    for name in signals:
        if name != EXECUTED:  # its components are the action's
            _compare_components(f"signal '{name}'", first.signals[name], second.signals[name], found)
    for camera in cameras:
        if first.cameras[camera] != second.cameras[camera]:
            found.add(f"camera '{camera}': {first.cameras[camera]} against {second.cameras[camera]}")
    for text, one, other in (
        ("steps per second", a.description.fps, b.description.fps),
        ("meaning of the actions", a.description.semantics, b.description.semantics),
        ("robot", a.description.robot, b.description.robot),
    ):
        if one != other:
            found.add(f"{text}: {one} against {other}")
    found.compared = {
        "numbers": ", ".join(["action", *vectors, *signals]) + ", bit for bit as float32",
        "texts": "instruction, " + "subtask, " * (first.subtasks or second.subtasks) + "episode id",
        "order": "by place in the split",
        "metadata": "not compared",
    }
    return _Names(
        vectors=vectors,
        signals=tuple(name for name in signals if name != EXECUTED),
        cameras=tuple(c for c in cameras if first.cameras[c] == second.cameras[c]),
        depth=depth,
        segmentation=segmentation,
        depth_apart_m=0.0 if a.format == b.format and bool(a.facts) == bool(b.facts) else 0.51 * DEPTH_UNIT_M,
        executed=EXECUTED in signals,
        subtasks=first.subtasks or second.subtasks,
    )


def _compare_components(what: str, first: tuple[str, ...], second: tuple[str, ...], found: Comparison) -> None:
    """Compare the names of components; a dataset that does not state them has numbered ones, which are not compared."""
    if len(first) != len(second):
        found.add(f"{what}: {len(first)} components against {len(second)}")
    elif first != second and not (_are_numbered(first) or _are_numbered(second)):
        found.add(f"{what}: components {', '.join(first)} against {', '.join(second)}")


def _are_numbered(names: tuple[str, ...]) -> bool:
    parts = [name.rpartition(".") for name in names]
    return len({part for part, _, _ in parts}) == 1 and [last for *_, last in parts] == [
        str(i) for i in range(len(names))
    ]


def _compare_episode(
    a: Episode, b: Episode, where: str, names: _Names, found: Comparison, lowest_psnr_db: float | None
) -> None:
    for text, one, other in (
        ("length", a.length, b.length),
        ("instruction", a.instruction, b.instruction),
        ("episode id", a.episode_id, b.episode_id),
        ("success", _outcome(a), _outcome(b)),
    ):
        if one != other and not (text == "episode id" and "" in (one, other)):
            found.add(f"{text}: {one!r} against {other!r}", where)
    if a.episode_id != b.episode_id and a.episode_id and b.episode_id:
        return  # another episode: its numbers differ anyway
    reported: set[str] = set()
    maps = {"depth": names.depth, "segmentation": names.segmentation}
    for one_step, other_step in zip(a.steps(names.cameras, **maps), b.steps(names.cameras, **maps), strict=False):
        found.steps += 1
        instructions = [e.words(step) for step, e in ((one_step, a), (other_step, b))]
        if instructions[0] != instructions[1] and "instruction" not in reported and a.instruction == b.instruction:
            reported.add("instruction")
            found.add(f"instruction from step {one_step.index}: {instructions[0]!r} against {instructions[1]!r}", where)
        at_hand = a.subtask(one_step), b.subtask(other_step)
        if names.subtasks and at_hand[0] != at_hand[1] and not reported & {"subtask", "instruction"}:
            reported.add("subtask")
            found.add(f"subtask from step {one_step.index}: {at_hand[0]!r} against {at_hand[1]!r}", where)
        for name, first, second in _numbers(one_step, other_step, names):
            if name not in reported and not same_bits(first, second):
                reported.add(name)
                found.add(f"{name} from step {one_step.index}: {_shown(first)} against {_shown(second)}", where)
        for camera in names.cameras:
            problem = _compare_images(one_step.images[camera], other_step.images[camera], camera, found, lowest_psnr_db)
            if problem and camera not in reported:
                reported.add(camera)
                found.add(f"camera '{camera}' from step {one_step.index}: {problem}", where)
        for name, problem in _different_maps(one_step, other_step, names):
            if name not in reported:
                reported.add(name)
                found.add(f"{name} from step {one_step.index}: {problem}", where)


def _different_maps(a: Step, b: Step, names: _Names) -> Iterator[tuple[str, str]]:
    """Yield depth and segmentation that differ, with what differs.

    Between formats depth may differ by the rounding of LeRobot's unit, and what that format cannot hold (0, not
    finite, beyond its range) is unknown in both.
    """
    for camera in names.depth:
        one, other = np.asarray(a.depth[camera], np.float64), np.asarray(b.depth[camera], np.float64)
        name = f"depth of camera '{camera}'"
        if one.shape != other.shape:
            yield name, f"shape {one.shape} against {other.shape}"
            continue
        known = [np.isfinite(rows) & (rows > 0) & (rows <= MAX_DEPTH * DEPTH_UNIT_M) for rows in (one, other)]
        if not names.depth_apart_m and not np.array_equal(one, other, equal_nan=True):
            yield name, f"{int((one != other).sum())} of {one.size} pixels differ"
        elif not np.array_equal(known[0], known[1]):
            yield name, f"{int((known[0] != known[1]).sum())} of {one.size} pixels are known in one alone"
        elif (apart := np.abs(one[known[0]] - other[known[0]]).max(initial=0)) > names.depth_apart_m:
            yield name, f"{1000 * apart:.3g} mm apart, expected at most {1000 * names.depth_apart_m:.3g}"
    for camera in names.segmentation:
        if not np.array_equal(a.segmentation[camera], b.segmentation[camera]):
            yield f"segmentation of camera '{camera}'", "other bodies"


def _outcome(episode: Episode) -> bool | str:
    return "unknown" if episode.success is None else episode.success


def _numbers(a: Step, b: Step, names: _Names) -> Iterator[tuple[str, npt.ArrayLike, npt.ArrayLike]]:
    """Yield name and both values of all numbers."""
    yield "action", a.action, b.action
    yield "reward", [a.reward], [b.reward]
    if names.executed and a.action_executed is not None and b.action_executed is not None:
        yield EXECUTED, a.action_executed, b.action_executed
    for name in names.vectors:
        yield name, a.proprio[name], b.proprio[name]
    for name in names.signals:
        yield name, a.signals[name], b.signals[name]


def same_bits(a: npt.ArrayLike, b: npt.ArrayLike) -> bool:
    """Return whether two arrays are equal as float32, bit for bit."""
    one, other = np.ascontiguousarray(a, np.float32), np.ascontiguousarray(b, np.float32)
    return one.shape == other.shape and one.tobytes() == other.tobytes()


def _compare_images(a: RGBImage, b: RGBImage, camera: str, found: Comparison, lowest_psnr_db: float | None) -> str:
    """Compare two images; return the problem, empty if there is none."""
    seen = found.images.setdefault(camera, ImageComparison())
    seen.count += 1
    if a.shape != b.shape:
        return f"image of shape {a.shape} against {b.shape}"
    if np.array_equal(a, b):
        seen.equal += 1
        return ""
    squared = float(np.mean((a.astype(np.int16) - b.astype(np.int16)).astype(np.float64) ** 2))
    level = _psnr(squared)
    seen.total_squared += squared
    seen.lowest_db = min(seen.lowest_db, level)
    if lowest_psnr_db is None:
        return f"images differ ({level:.1f} dB), expected equal pixels"
    return (
        "" if level >= lowest_psnr_db else f"images differ by {level:.1f} dB, expected at least {lowest_psnr_db:g} dB"
    )


def _psnr(squared: float) -> float:
    return math.inf if not squared else 10 * math.log10(255**2 / squared)


def _shown(values: npt.ArrayLike) -> str:
    return np.array2string(np.asarray(values, np.float32), precision=9, separator=", ", max_line_width=10_000)


def comparison_text(found: Comparison, names: Mapping[str, str]) -> str:
    """Return a comparison as text.

    Args:
        found: The comparison.
        names: ``a`` and ``b`` to how the datasets are called.
    """
    verdict = "EQUAL" if found.equal else f"DIFFERENT ({counted(found.count, 'difference')})"
    compared = f"{counted(found.episodes, 'episode')}, {counted(found.steps, 'step')} compared"
    lines = [f"{names['a']} and {names['b']}: {verdict}", f"  {compared}"]
    lines += [f"  {what:<9} {how}" for what, how in found.compared.items()]
    for camera, seen in sorted(found.images.items()):
        if seen.equal == seen.count:
            lines.append(f"  camera {camera}: all {seen.count} images equal")
        else:
            lines.append(
                f"  camera {camera}: {seen.equal} of {seen.count} images equal, PSNR lowest {seen.lowest_db:.1f} dB, "
                f"of the mean error {seen.mean_db:.1f} dB"
            )
    lines += [f"  - {difference}" for difference in found.differences]
    if found.count > len(found.differences):
        lines.append(f"  - and {found.count - len(found.differences)} more")
    return "\n".join(lines)
