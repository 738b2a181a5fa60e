"""Surfaces of revolution."""

from __future__ import annotations

import numpy as np
import pytest

from roboxim_core.models.turned import lathe, smooth_lathe


@pytest.mark.parametrize("generator", [lathe, smooth_lathe])
def test_a_profile_that_turns_back_on_itself_has_normals(generator):
    mesh = generator((0.03, 0.0, 0.03, 0.05, 0.03, 0.02))
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1.0)
