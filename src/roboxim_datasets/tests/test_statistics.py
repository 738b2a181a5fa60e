"""Statistics of a dataset are those of all its values."""

from __future__ import annotations

import numpy as np
import pytest

from roboxim_core.errors import InvalidRequestError
from roboxim_datasets.statistics import QUANTILES, ImageStatistics, VectorStatistics, dead_components


def test_the_statistics_of_uneven_batches_are_those_of_all_values():
    rng = np.random.default_rng(0)
    batches = [rng.normal(i, 1 + i, size=(3 + 40 * i, 4)).astype(np.float32) for i in range(5)]
    statistics = VectorStatistics(4)
    for batch in batches:
        statistics.add(batch)
    values = np.concatenate(batches).astype(np.float64)
    found = statistics.summary()
    assert statistics.count == len(values)
    for name, expected in (("min", values.min(0)), ("max", values.max(0)), ("mean", values.mean(0))):
        np.testing.assert_array_equal(found[name], expected, err_msg=name)
    np.testing.assert_allclose(found["std"], values.std(0), rtol=1e-12)
    for name, probability in QUANTILES.items():
        np.testing.assert_allclose(found[name], np.quantile(values, probability, axis=0), rtol=1e-12, err_msg=name)
    means_of_quantiles = np.mean([np.quantile(batch, 0.99, axis=0) for batch in batches], axis=0)
    assert np.abs(found["q99"] - means_of_quantiles).max() > 1.0


@pytest.mark.parametrize("count", [1, 2, 7])
def test_the_statistics_of_images_are_those_of_their_pixels(count):
    images = np.random.default_rng(count).integers(0, 256, size=(count, 20, 30, 3), dtype=np.uint8)
    whole, parts = ImageStatistics(), ImageStatistics()
    whole.add(images)
    for image in images:
        one = ImageStatistics()
        one.add(image[None])
        parts.merge(one.histogram.tolist(), one.count)
    pixels = images.reshape(-1, 3) / 255
    for statistics in (whole, parts):
        found = statistics.summary()
        assert statistics.count == count
        for name, expected in (("min", pixels.min(0)), ("max", pixels.max(0)), ("mean", pixels.mean(0))):
            np.testing.assert_allclose(found[name], expected, err_msg=name)
        np.testing.assert_allclose(found["std"], pixels.std(0))
        for name, probability in QUANTILES.items():
            np.testing.assert_allclose(found[name], np.quantile(pixels, probability, axis=0), err_msg=name)


def test_values_that_cannot_be_summarised_are_refused():
    statistics = VectorStatistics(2)
    with pytest.raises(InvalidRequestError, match="no values"):
        statistics.summary()
    with pytest.raises(InvalidRequestError, match=r"shape \(N, 2\)"):
        statistics.add(np.zeros((3, 3)))
    with pytest.raises(InvalidRequestError, match="1 values that are not finite"):
        statistics.add([[1.0, np.nan]])


def test_dead_components_are_named():
    assert dead_components(("dx", "droll", "gripper"), (0.1, 1e-9, 0.4)) == ("droll",)
