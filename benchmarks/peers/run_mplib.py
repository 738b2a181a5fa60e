"""mplib as a contender: inverse kinematics, RRTConnect, simplification and toppra, with its defaults.

Obstacles are enlarged by the problem's padding. ``ms`` is the time of `plan_pose` or `plan_qpos` alone.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mplib
import numpy as np
from _serve import Answer, pack, sample_times, serve
from mplib.collision_detection import fcl

VELOCITY = [2.175] * 4 + [2.61] * 3
ACCELERATION = [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]
FINGERS = [0.04, 0.04]
TOUCHING = ["panda_hand", "panda_leftfinger", "panda_rightfinger", "panda_hand_tcp"]


def make() -> Callable[[dict[str, Any]], Answer]:
    """Load the robot."""
    folder = Path(sys.argv[1])
    planner = mplib.Planner(
        urdf=folder / "panda.urdf",
        srdf=folder / "panda.srdf",
        move_group="panda_hand_tcp",
        use_convex=True,
        joint_vel_limits=VELOCITY,
        joint_acc_limits=ACCELERATION,
    )
    world = planner.planning_world

    def handle(request: dict[str, Any]) -> Answer:
        problem = request["problem"]
        begun = time.perf_counter()
        mplib.set_global_seed(1 + request["seed"])
        for name in world.get_object_names():
            if world.is_object_attached(name):
                world.detach_object(name, also_remove=True)
            else:
                world.remove_object(name)
        for i, solid in enumerate(problem["solids"]):
            world.add_object(_object(f"solid{i}", _shape(solid, problem["padding_m"]), _pose(solid)))
            planner.acm.set_entry("panda_link0", f"solid{i}", True)  # neither of them moves
        if problem["held"]:
            tip = planner.link_name_2_idx["panda_hand_tcp"]
            held = problem["held"]
            robot = planner.robot.get_name()
            world.attach_object("held", _shape(held, 0.0), robot, tip, _pose(held), TOUCHING)
        setup_ms = 1e3 * (time.perf_counter() - begun)
        start = np.array([*problem["start"], *FINGERS])
        goal = problem["goal"]
        begun = time.perf_counter()
        try:
            # its own time law, sampled at a kilohertz; sampling takes a small part of the time
            options = {"time_step": 0.001, "planning_time": request["limit_s"]}
            if problem["goal_is_joints"]:
                found = planner.plan_qpos([np.array([*goal, *FINGERS])], start, **options)
            else:
                x, y, z, w = goal[3:]
                found = planner.plan_pose(mplib.Pose(goal[:3], [w, x, y, z]), start, **options)
        except Exception as error:  # any exception counts as no solution
            return {"ms": 1e3 * (time.perf_counter() - begun), "error": f"{type(error).__name__}: {error}"}
        ms = 1e3 * (time.perf_counter() - begun)
        if found["status"] != "Success":
            return {"ms": ms, "setup_ms": setup_ms, "error": str(found["status"])}
        positions, duration = _resampled(found)
        return {"ms": ms, "setup_ms": setup_ms, "error": "", "positions": pack(positions), "duration_s": duration}

    return handle


def _resampled(found: dict[str, Any]) -> tuple[np.ndarray, float]:
    """Return samples at whole milliseconds and at the end; mplib's are slightly more than a millisecond apart."""
    times, positions, duration = found["time"], found["position"], float(found["duration"])
    at = sample_times(duration)
    return np.stack([np.interp(at, times, column) for column in positions.T], axis=1), duration


def _shape(solid: dict[str, Any], padding: float) -> Any:
    grown = [value + 2.0 * padding for value in solid["size"]]
    if solid["kind"] == "box":
        return fcl.Box(grown)
    if solid["kind"] == "sphere":
        return fcl.Sphere(solid["size"][0] + padding)
    return fcl.Cylinder(solid["size"][0] + padding, grown[1])


def _object(name: str, shape: Any, pose: Any) -> Any:
    return fcl.FCLObject(name, pose, [fcl.CollisionObject(shape, mplib.Pose())], [mplib.Pose()])


def _pose(solid: dict[str, Any]) -> Any:
    x, y, z, w = solid["quat_xyzw"]
    return mplib.Pose(solid["position"], [w, x, y, z])


if __name__ == "__main__":
    serve(make)
