"""Statistics of a dataset: exact values of the whole dataset, collected in one pass.

An exact quantile needs every value. `VectorStatistics` therefore keeps them in an unnamed temporary file, and its
memory does not grow with the dataset until `VectorStatistics.summary` loads one component after another. Means of the
quantiles of episodes or of batches, which are cheaper, are not quantiles of the dataset.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import InvalidRequestError

Numbers = npt.NDArray[np.float64]
Summary = dict[str, Numbers]
"""Name of a statistic (``min``, ``max``, ``mean``, ``std``, ``q01`` ...) to its values."""

QUANTILES: Mapping[str, float] = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
"""Name of a quantile to its probability."""
SAMPLED_SIDE = 64
"""Images are sampled on a grid of about this many pixels a side."""
DEAD = 1e-5
"""A component whose standard deviation is below this [m, rad or opening] counts as dead."""
_LEVELS = 256


def dead_components(names: Sequence[str], deviations: Sequence[float]) -> tuple[str, ...]:
    """Return the names of the components that (nearly) never change; a policy cannot learn them."""
    return tuple(name for name, deviation in zip(names, deviations, strict=False) if deviation < DEAD)


def summary_of(values: npt.ArrayLike, quantiles: Mapping[str, float] = QUANTILES) -> Summary:
    """Return the statistics of an array's columns: minimum, maximum, mean, population standard deviation, quantiles.

    Args:
        values: Shape (N, size), N at least 1.
        quantiles: Name to probability; quantiles between two values are interpolated linearly.

    Returns:
        Name to float64 values, shape (size,).
    """
    wide = np.asarray(values, np.float64)
    found = {"min": wide.min(axis=0), "max": wide.max(axis=0), "mean": wide.mean(axis=0), "std": wide.std(axis=0)}
    levels = np.quantile(wide, list(quantiles.values()), axis=0)
    return found | {name: np.asarray(level) for name, level in zip(quantiles, levels, strict=True)}


class VectorStatistics:
    """Collects vectors and returns the exact statistics of each component; see the module."""

    def __init__(self, size: int, dtype: npt.DTypeLike = np.float32) -> None:
        """Start without values.

        Args:
            size: Number of components.
            dtype: Type that the values are kept in; it must hold them exactly.
        """
        self._size, self._dtype = size, np.dtype(dtype)
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as this object
        self.count = 0
        """Number of vectors."""

    def add(self, vectors: npt.ArrayLike) -> None:
        """Add vectors, shape (N, size).

        Raises:
            InvalidRequestError: On another shape, or on values that are not finite.
        """
        rows = np.ascontiguousarray(vectors, self._dtype)
        if rows.ndim != 2 or rows.shape[1] != self._size or not np.isfinite(rows).all():
            raise InvalidRequestError(
                f"statistics need finite vectors of shape (N, {self._size}), got shape {rows.shape} "
                f"with {int(np.sum(~np.isfinite(rows)))} values that are not finite"
            )
        self._file.write(rows.tobytes())
        self.count += len(rows)

    def summary(self, quantiles: Mapping[str, float] = QUANTILES) -> Summary:
        """Return the statistics, see `summary_of`.

        Raises:
            InvalidRequestError: When no vector was added.
        """
        if not self.count:
            raise InvalidRequestError("there are no values to summarise")
        self._file.flush()
        values = np.memmap(self._file, self._dtype, "r", shape=(self.count, self._size))
        columns = [summary_of(values[:, [column]], quantiles) for column in range(self._size)]
        return {name: np.concatenate([column[name] for column in columns]) for name in columns[0]}


class ImageStatistics:
    """Collects images and returns the exact statistics of the sampled pixels' channels, from their histogram."""

    def __init__(self) -> None:
        """Start without images."""
        self.histogram = np.zeros((3, _LEVELS), np.int64)
        """Channel and level (0 to 255) to the number of sampled pixels."""
        self.count = 0
        """Number of images."""

    def add(self, images: npt.NDArray[np.uint8]) -> None:
        """Add RGB images, uint8, shape (N, height, width, 3); every k-th pixel of a row and column counts."""
        step = max(1, round(max(images.shape[1:3]) / SAMPLED_SIDE))
        sampled = images[:, ::step, ::step]
        for channel in range(3):
            self.histogram[channel] += np.bincount(sampled[..., channel].ravel(), minlength=_LEVELS)
        self.count += len(images)

    def merge(self, histogram: npt.ArrayLike, count: int) -> None:
        """Add the images of another histogram."""
        self.histogram += np.asarray(histogram, np.int64)
        self.count += count

    def summary(self, quantiles: Mapping[str, float] = QUANTILES) -> Summary:
        """Return the statistics of pixel values in 0..1, each of shape (3,).

        Raises:
            InvalidRequestError: When no image was added.
        """
        if not self.count:
            raise InvalidRequestError("there are no images to summarise")
        channels = [_histogram_summary(levels, quantiles) for levels in self.histogram]
        return {name: np.array([channel[name] for channel in channels]) for name in channels[0]}


def _histogram_summary(counts: npt.NDArray[np.int64], quantiles: Mapping[str, float]) -> dict[str, float]:
    levels = np.arange(_LEVELS) / (_LEVELS - 1)
    total, until = int(counts.sum()), np.cumsum(counts)
    present = np.flatnonzero(counts)
    mean = float(levels @ counts) / total
    found = {
        "min": float(levels[present[0]]),
        "max": float(levels[present[-1]]),
        "mean": mean,
        "std": float(np.sqrt(((levels - mean) ** 2) @ counts / total)),
    }
    for name, probability in quantiles.items():
        place = probability * (total - 1)
        low, high = (
            levels[np.searchsorted(until, min(index, total - 1), side="right")]
            for index in (int(place), int(place) + 1)
        )
        found[name] = float(low + (high - low) * (place - int(place)))
    return found
