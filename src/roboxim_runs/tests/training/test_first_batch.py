"""A training shows its first samples."""

import numpy as np
from PIL import Image

from roboxim_runs.training.run import write_first_batch


def test_each_camera_has_a_row_of_recorded_pictures_above_one_of_what_the_network_sees(tmp_path):
    rng = np.random.default_rng(0)
    samples = {
        name: tuple(rng.uniform(size=(3, side, side, 3)) for _ in range(2)) for name, side in (("a", 8), ("b", 6))
    }
    write_first_batch(samples, tmp_path / "first.png")
    picture = np.asarray(Image.open(tmp_path / "first.png"))[::2, ::2]
    assert picture.shape == (8 + 8 + 6 + 6, 24, 3)
    row = 0
    for name, side in (("a", 8), ("b", 6)):
        for pictures in samples[name]:
            for i, one in enumerate(pictures):
                shown = picture[row : row + side, i * side : (i + 1) * side]
                assert np.abs(shown - 255 * one).max() <= 0.5 + 1e-6
            row += side
    assert (picture[16:, 18:] == 255).all(), "beside smaller pictures it is white"
