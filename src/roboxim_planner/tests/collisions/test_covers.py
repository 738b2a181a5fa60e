import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay

from roboxim_planner.collisions.covers import SPHERES, cover_box, cover_hull, cover_round


def covered(points: np.ndarray, spheres: np.ndarray) -> bool:
    """Tell whether every point is in some sphere."""
    apart = np.linalg.norm(points[:, None] - spheres[None, :, :3], axis=2) - spheres[None, :, 3]
    return bool((apart.min(axis=1) <= 1e-9).all())


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(5))
def test_spheres_cover_a_hull_and_do_not_bulge(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(60, 3)) * rng.uniform(0.02, 0.2, 3)
    spheres = cover_hull(points)
    inside = rng.uniform(points.min(axis=0), points.max(axis=0), (20000, 3))
    inside = inside[Delaunay(points[ConvexHull(points).vertices]).find_simplex(inside) >= 0]
    assert len(spheres) == SPHERES
    assert covered(inside, spheres)
    assert covered(points, spheres)
    assert (np.abs(spheres[:, :3]) + spheres[:, 3:]).max() < 1.5 * np.abs(points).max()


def test_spheres_cover_boxes_and_round_shapes() -> None:
    rng = np.random.default_rng(0)
    size = np.array([0.3, 0.02, 0.1])
    assert covered(rng.uniform(-size / 2, size / 2, (5000, 3)), cover_box(size))
    for radius, length in ((0.03, 0.2), (0.1, 0.02)):
        angle, away = rng.uniform(0, 2 * np.pi, 5000), radius * np.sqrt(rng.uniform(0, 1, 5000))
        height = rng.uniform(-length / 2, length / 2, 5000)
        points = np.column_stack([away * np.cos(angle), away * np.sin(angle), height])
        assert covered(points, cover_round(radius, length, capped=False))
        ball = rng.normal(size=(5000, 3))
        ball *= radius / np.linalg.norm(ball, axis=1, keepdims=True)
        assert covered(ball + [0, 0, length / 2], cover_round(radius, length, capped=True))
