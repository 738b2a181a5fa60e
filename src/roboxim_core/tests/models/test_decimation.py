"""Decimated triangles lie where the fine ones do, and each knows which one it was."""

import numpy as np
import pytest
import trimesh

from roboxim_core.models.decimation import decimated

BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
WITHOUT_AREA = np.repeat(BALL.faces[:, :1], 3, axis=1)


def test_each_triangle_that_is_left_is_near_the_one_it_was() -> None:
    points, faces, kept = decimated(BALL.vertices, BALL.faces, 400)
    assert 300 < len(faces) <= 400
    assert len(kept) == len(faces)
    assert np.linalg.norm(points[faces].mean(axis=1) - BALL.triangles_center[kept], axis=1).max() < 0.03


@pytest.mark.parametrize("count", [len(BALL.faces), len(BALL.faces) + 1, 2 * len(BALL.faces)])
def test_triangles_without_area_do_not_count(count: int) -> None:
    points, faces, kept = decimated(BALL.vertices, np.concatenate([WITHOUT_AREA, BALL.faces]), count)
    assert faces.tolist() == BALL.faces.tolist()
    assert kept.tolist() == list(range(len(BALL.faces), 2 * len(BALL.faces)))
    assert points == pytest.approx(BALL.vertices, abs=1e-7)
