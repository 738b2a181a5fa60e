from collections.abc import Callable, Sequence
from typing import overload

import numpy as np
import numpy.typing as npt

API: int
_Array = npt.NDArray[np.float64]

def distinct(solutions: npt.ArrayLike, reference: npt.ArrayLike, same: float) -> _Array: ...
def extremes(values: npt.ArrayLike) -> _Array: ...
def pose_matrices(poses: npt.ArrayLike) -> _Array: ...
def sample_polynomial(breaks: npt.ArrayLike, coefficients: npt.ArrayLike, times: npt.ArrayLike) -> _Array: ...

class Arm:
    def __init__(
        self,
        *,
        parents: list[int],
        placements: npt.ArrayLike,
        axes: npt.ArrayLike,
        prismatic: list[bool],
        lower: npt.ArrayLike,
        upper: npt.ArrayLike,
        tcp_joint: int,
        tcp: npt.ArrayLike,
    ) -> None: ...
    def tcp_poses(self, joints: npt.ArrayLike) -> _Array: ...
    def tcp_speeds(self, joints: npt.ArrayLike, velocities: npt.ArrayLike) -> _Array: ...
    def follow(
        self,
        position: Sequence[float],
        quaternion: Sequence[float],
        start: Sequence[float],
        *,
        pull: Sequence[float],
        largest_change: Sequence[float],
        iterations: int,
        position_tolerance: float,
        rotation_tolerance: float,
    ) -> tuple[list[float], float, float]: ...
    def ik(
        self,
        target: npt.ArrayLike,
        reference: npt.ArrayLike,
        *,
        seed: int,
        starts: int,
        enough: int,
        iterations: int,
        position_tolerance: float,
        rotation_tolerance: float,
    ) -> tuple[_Array, float, float]: ...

class Item:
    def __init__(
        self, joint: int, kind: str, size: npt.ArrayLike, pose: npt.ArrayLike, spheres: npt.ArrayLike
    ) -> None: ...

class Mesh:
    def __init__(self, corners: npt.ArrayLike) -> None: ...

class Obstacle:
    @overload
    def __init__(self, kind: str, size: npt.ArrayLike, pose: npt.ArrayLike) -> None: ...
    @overload
    def __init__(self, mesh: Mesh, pose: npt.ArrayLike) -> None: ...

class Margins:
    @overload
    def __init__(self, margin: float, self_margin: float, resolution: float) -> None: ...
    @overload
    def __init__(self, pairs: npt.ArrayLike, resolution: float) -> None: ...

class World:
    def __init__(
        self,
        arm: Arm,
        items: list[Item],
        obstacles: list[Obstacle],
        item_pairs: list[int],
        obstacle_pairs: list[int],
    ) -> None: ...
    def set_upright(self, axis: npt.ArrayLike, direction: npt.ArrayLike, tolerance: float) -> None: ...
    def path_is_free(self, path: npt.ArrayLike, margins: Margins) -> bool: ...
    def first_hit(self, path: npt.ArrayLike, margins: Margins) -> float: ...
    def shorten(
        self,
        path: npt.ArrayLike,
        seed: int,
        tries: int,
        weights: npt.ArrayLike,
        margins: Margins,
    ) -> _Array: ...
    def free_states(self, states: npt.ArrayLike, margins: Margins) -> npt.NDArray[np.bool_]: ...
    def free_edge(self, start: npt.ArrayLike, ends: npt.ArrayLike, margins: Margins) -> int: ...
    def blends(self, path: npt.ArrayLike, largest: float, halvings: int, margins: Margins) -> _Array: ...
    def connect_upright(
        self,
        start: npt.ArrayLike,
        goals: npt.ArrayLike,
        seed: int,
        iterations: int,
        step: float,
        margins: Margins,
        watch: Callable[[int], None],
    ) -> _Array: ...
    def tilt(self, joints: npt.ArrayLike) -> float: ...
    def clearance(self, joints: npt.ArrayLike, cap: float) -> float: ...
    def clearances(self, states: npt.ArrayLike, cap: float) -> _Array: ...
    @property
    def states_checked(self) -> int: ...
