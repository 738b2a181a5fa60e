"""Finds the parts of an episode in an HDF5 file without a description: robomimic's, robosuite's, Isaac Lab's.

What most episodes have, with the same shape, is the layout. An episode that lacks a part of it is left out by name, and
a part that most episodes lack is left out too.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from roboxim_datasets.depth import camera_of, is_named_depth
from roboxim_datasets.episode import ImageSize
from roboxim_datasets.hdf5.tree import problem_of
from roboxim_datasets.pictures import MAX_PIXELS

_ACTIONS = "actions"
_MAX_NUMBERS = 1024  # of an observation that is read as a vector
Shape = tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class Array:
    """What is known of an array without reading it."""

    length: int
    """Number of its rows."""
    shape: Shape
    """Shape of a row."""
    dtype: str
    """Type of its values."""
    problem: str
    """Why its values cannot be read; empty: they can."""

    @property
    def size(self) -> int:
        """Number of values of a row."""
        return math.prod(self.shape)


def arrays(leaves: Mapping[str, Any]) -> dict[str, Array]:
    """Return what is known of the arrays of an episode, by path."""
    found = {}
    for path, item in leaves.items():
        shape = (item.shape or ()) if item is not None else ()
        found[path] = Array(
            length=shape[0] if shape else 1,
            shape=tuple(shape[1:]),
            dtype=str(item.dtype) if item is not None else "",
            problem=problem_of(item) or ("" if shape else "a single value"),
        )
    return found


def is_one_step_ahead(demo: Any, path: str, found: Mapping[str, Array]) -> bool:
    """Return whether an array such as ``next_obs/x`` has the rows of ``obs/x`` one step ahead.

    Vectors are compared row by row, images in three rows.

    Args:
        demo: The episode's group.
        path: Path of the array.
        found: The episode's arrays, by path.
    """
    other = path.removeprefix("next_")
    array, source = found[path], found.get(other)
    if source is None or array.problem or source.problem:
        return False
    if (array.length, array.shape, array.dtype) != (source.length, source.shape, source.dtype):
        return False
    last = array.length - 1
    try:
        if array.size <= _MAX_NUMBERS:
            return np.array_equal(demo[path][:-1], demo[other][1:], equal_nan=array.dtype.startswith("float"))
        rows = {0, last // 2, last - 1} if last else set()
        return all(np.array_equal(demo[path][row], demo[other][row + 1]) for row in rows)
    except OSError:  # a damaged chunk; the array is left out by name, and the episode is read
        return False


def reason_not_read(path: str, array: Array) -> str:
    """Return why an array cannot be a part of an episode's steps; empty: it is an image or a vector."""
    if array.problem:
        return array.problem
    if path == _ACTIONS:
        return "" if len(array.shape) <= 1 and 0 < array.size <= _MAX_NUMBERS else f"actions of shape {array.shape}"
    if not path.startswith("obs/"):
        return "not an observation"
    if is_depth(path, array):
        return _reason_no_depth(array)
    if len(array.shape) == 3:
        return _reason_no_image(array)
    if not 0 < array.size <= _MAX_NUMBERS:
        return f"{array.size} numbers a step; at most {_MAX_NUMBERS} are read as a vector"
    return ""


def is_depth(path: str, array: Array) -> bool:
    """Return whether an array holds depth images: by its name, its shape (H, W) or (H, W, 1), and a type of depth."""
    flat = len(array.shape) == 2 or (len(array.shape) == 3 and array.shape[2] == 1)
    return is_named_depth(path) and path.startswith("obs/") and flat and min(array.shape[:2]) > 4


def _reason_no_depth(array: Array) -> str:
    if not array.dtype.startswith(("float", "uint16", "int", "uint32")):
        return f"depth images of {array.dtype}"
    if not 0 < array.size <= MAX_PIXELS:
        return f"depth images of {array.size} pixels; 1 to {MAX_PIXELS} are read"
    return ""


def _reason_no_image(array: Array) -> str:
    height, width, channels = array.shape
    if array.dtype != "uint8":
        return f"images of {array.dtype}; only colour images of uint8 are read"
    if channels != 3:
        return f"images of shape {array.shape}; only (height, width, 3) is read"
    if not 0 < height * width <= MAX_PIXELS:
        return f"images of {width} x {height} pixels; 1 to {MAX_PIXELS} are read"
    return ""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """What most episodes of a file have."""

    shapes: Mapping[str, Shape]
    """Path of an array that is read to the shape of its rows; ``actions`` is among them."""
    depth: Mapping[str, str]
    """Path of depth images that are read to the camera."""

    @property
    def cameras(self) -> dict[str, str]:
        """Path of a camera's images to the camera."""
        return cameras_of(path for path, shape in self.shapes.items() if len(shape) == 3 and path not in self.depth)

    @property
    def vectors(self) -> dict[str, str]:
        """Path of an observed vector to its name."""
        others = {_ACTIONS, *self.depth}
        return _named([path for path, shape in self.shapes.items() if len(shape) < 3 and path not in others], ())

    def sizes(self) -> dict[str, ImageSize]:
        """Return the size of the images by path."""
        return {key: ImageSize(height=self.shapes[key][0], width=self.shapes[key][1]) for key in self.cameras}

    def problem_of(self, found: Mapping[str, Array]) -> str:
        """Return why an episode does not fit; empty: it does."""
        if _ACTIONS not in found:
            return "it has no 'actions'"
        length = found[_ACTIONS].length
        if not length:
            return "it has no steps"
        for path, shape in self.shapes.items():
            if path not in found:
                return f"it lacks '{path}', which most episodes have"
            array = found[path]
            if array.problem:
                return f"'{path}': {array.problem}"
            if array.shape != shape or reason_not_read(path, array):
                return f"'{path}' holds {array.dtype} of shape {array.shape}, expected {shape}"
            if array.length < length:
                return f"'{path}' has {array.length} rows for {length} actions"
        return ""


def cameras_of(paths: Iterable[str]) -> dict[str, str]:
    """Return the cameras of images by path."""
    return _named(list(paths), ("_image", "_rgb"))


def layout_of(episodes: Mapping[str, Mapping[str, Array]], *, depth: bool = False) -> Layout:
    """Return the layout of a file from the arrays of its episodes; without ``actions`` if none has any.

    Args:
        episodes: Name to the arrays.
        depth: Whether depth images are read, as their unit is known; only those of a colour camera of their size are.
    """
    usable = [found for found in episodes.values() if _ACTIONS in found and found[_ACTIONS].length]
    counts: Counter[tuple[str, Shape]] = Counter(
        (path, array.shape)
        for found in usable
        for path, array in found.items()
        if not reason_not_read(path, array) and array.length >= found[_ACTIONS].length
    )
    shapes: dict[str, Shape] = {}
    for (path, shape), count in counts.most_common():
        if 2 * count >= len(usable) or path == _ACTIONS:
            shapes.setdefault(path, shape)
    deep = {path for found in usable for path, array in found.items() if path in shapes and is_depth(path, array)}
    colours = cameras_of(path for path, shape in shapes.items() if len(shape) == 3 and path not in deep)
    sizes = {camera: shapes[path][:2] for path, camera in colours.items()}
    of = {path: camera_of(path.removeprefix("obs/"), colours.values()) for path in sorted(deep)} if depth else {}
    of = {path: camera for path, camera in of.items() if camera and shapes[path][:2] == sizes[camera]}
    of = {path: camera for path, camera in of.items() if list(of.values()).count(camera) == 1}
    order = [path for found in usable for path in found if path not in deep or path in of]
    return Layout(shapes={path: shapes[path] for path in dict.fromkeys(order) if path in shapes}, depth=of)


def changed(path: str, array: Array) -> str:
    """Return how the read values of an array differ from the stored ones; empty: it does not."""
    if path.startswith("obs/") and len(array.shape) == 3:
        return ""
    parts = [] if array.dtype == "float32" else [f"{array.dtype}, read as float32"]
    if len(array.shape) > 1:
        parts.append(f"rows of shape {array.shape}, read as {array.size} numbers")
    return "; ".join(parts)


def _named(paths: list[str], suffixes: tuple[str, ...]) -> dict[str, str]:
    """Return a name for each path: without what the layout puts around it, unless two would be called the same."""
    plain = {path: path.removeprefix("obs/").replace("/", ".") for path in paths}
    short = dict(plain)
    for suffix in suffixes:
        short = {path: name.removesuffix(suffix) or name for path, name in short.items()}
    twice = Counter(short.values())
    return {path: short[path] if twice[short[path]] == 1 else plain[path] for path in paths}


def finite_rate(value: Any) -> float:
    """Return a rate that a file states [1/s]; 0: it states none."""
    try:
        rate = float(value)
    except (TypeError, ValueError, OverflowError):
        return 0.0
    return rate if np.isfinite(rate) and rate > 0 else 0.0
