"""Coarser collision parts contain what they stand for, and reach little beyond it."""

import numpy as np
import pytest
import trimesh

from roboxim_runs.robots.convex_parts import coarser

SHAPES = {
    "long cylinder": trimesh.creation.cylinder(0.06, 0.4, sections=96),
    "ball": trimesh.creation.icosphere(subdivisions=3, radius=0.08),
    "turned box": trimesh.creation.box(
        (0.1, 0.02, 0.05), transform=trimesh.transformations.euler_matrix(0.3, 0.5, 0.7)
    ),
}


@pytest.mark.parametrize("within_m", [0.0, 0.004])
@pytest.mark.parametrize("name", SHAPES)
def test_a_coarser_part_contains_the_mesh_and_reaches_little_beyond_it(name: str, within_m: float) -> None:
    mesh = SHAPES[name]
    made = coarser(mesh, within_m)
    assert within_m > 0.0 or made is mesh
    in_front = mesh.vertices @ made.face_normals.T - np.einsum("ij,ij->i", made.face_normals, made.triangles[:, 0])
    assert in_front.max() < 1e-6, "a vertex of the mesh lies outside"
    beyond = trimesh.proximity.closest_point_naive(mesh, made.vertices)[1] if within_m else np.zeros(1)
    assert beyond.max() <= 1.1 * within_m + 1e-6
    if within_m and name != "turned box":
        assert len(made.faces) < 0.5 * len(mesh.faces), "fewer faces load faster"
