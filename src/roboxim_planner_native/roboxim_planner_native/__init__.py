"""Collision checks of whole motions and inverse kinematics, compiled; for `roboxim_planner` and `roboxim_core`.

`World` answers whether states and paths of an `Arm` are free, also between the states looked at; `Arm.ik` is inverse
kinematics from many starts. Thread-safe across objects, not within one `World`.
"""

from roboxim_planner_native._native import (
    API,
    Arm,
    Item,
    Margins,
    Mesh,
    Obstacle,
    World,
    distinct,
    extremes,
    pose_matrices,
    sample_polynomial,
)

__all__ = [
    "API",
    "Arm",
    "Item",
    "Margins",
    "Mesh",
    "Obstacle",
    "World",
    "distinct",
    "extremes",
    "pose_matrices",
    "sample_polynomial",
]
