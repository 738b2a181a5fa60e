"""Import of the native kernel, with a check of its version.

The planner has no other way to check collisions. A missing or outdated kernel is an error; there is no slow fallback.
"""

from __future__ import annotations

try:
    from roboxim_planner_native import (
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
except ImportError as error:
    raise ImportError(f"the planner's native kernel cannot be loaded ({error}); run `make setup`") from error

EXPECTED_API = 5
if API != EXPECTED_API:
    raise ImportError(f"the planner needs version {EXPECTED_API} of its native kernel, found {API}; run `make setup`")

__all__ = [
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
