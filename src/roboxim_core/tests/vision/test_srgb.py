"""The transfer function of sRGB."""

from pathlib import Path

import numpy as np

from roboxim_core.vision.srgb import to_linear, to_srgb


def test_known_values():
    assert np.allclose(to_linear([0.0, 0.04045, 0.5, 1.0]), [0.0, 0.00313080, 0.21404114, 1.0], atol=1e-7)


def test_the_two_directions_are_inverse_and_keep_shape_and_precision():
    values = np.linspace(0.0, 1.0, 300, dtype=np.float32).reshape(100, 3)
    back = to_srgb(to_linear(values))
    assert (back.dtype, back.shape) == (np.float32, values.shape)
    assert np.allclose(back, values, atol=1e-5)


def test_the_formula_stands_in_one_place():
    files = (file for file in Path(__file__).parents[3].rglob("*.py") if "tests" not in file.parts)
    assert [file.name for file in files if any(n in file.read_text() for n in ("0.04045", "0.0031308"))] == ["srgb.py"]
