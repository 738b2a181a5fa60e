"""RoboXim's planner as a contender, for the robot named by its argument.

``ms`` includes setting up the scene, which is part of each request.

In addition to the contenders' protocol it serves requests with an ``op``: ``ik``, ``retreat``, ``repeat``, ``digests``.
"""

from __future__ import annotations

import gc
import hashlib
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from _serve import Answer, pack, serve, unpack

from roboxim_core.errors import RoboximError
from roboxim_core.models.description import Shape
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_planner.pipeline import MotionOptions, Plan, Planner, no_watch
from roboxim_planner.scene import Attached, Body, PlanningScene
from roboxim_planner.sequence import Stage, StageGoal, plan_sequence


def make() -> Callable[[dict[str, Any]], Answer]:
    """Load the robot."""
    planner = Planner(ModelLibrary().robot(sys.argv[1] if len(sys.argv) > 1 else "panda"))
    home = planner.named_state("home")
    planner.plan_to_joints(PlanningScene(), home, np.asarray(home) + 0.05)
    answers = {"plan": plan, "ik": inverse_kinematics, "retreat": retreat, "repeat": repeat, "digests": digests}
    return lambda request: answers[request.get("op", "plan")](planner, request)


def plan(planner: Planner, request: dict[str, Any]) -> Answer:
    """Plan to the problem's goal."""
    begun = time.perf_counter()

    def watch(stage: str, iterations: int) -> None:
        if time.perf_counter() - begun > request["limit_s"]:
            raise TimeoutError(f"in stage {stage}")

    try:
        found = _plan(planner, request["problem"], request["seed"], watch)
    except RoboximError as error:
        return {"ms": 1e3 * (time.perf_counter() - begun), "error": f"{error.code.name}: {error}"}
    except TimeoutError as error:
        return {"ms": 1e3 * (time.perf_counter() - begun), "error": f"TIMEOUT: {error}"}
    ms = 1e3 * (time.perf_counter() - begun)
    positions = pack(found.sample(1e-3).positions)
    return {"ms": ms, "error": "", "route": found.route, "positions": positions, "duration_s": found.duration}


def _plan(planner: Planner, problem: dict[str, Any], seed: int, watch: Callable[[str, int], None]) -> Plan:
    scene = scene_of(problem)
    options = MotionOptions(seed=seed, padding_m=problem["padding_m"])
    if problem["goal_is_joints"]:
        return planner.plan_to_joints(scene, problem["start"], problem["goal"], options, watch)
    goal = pose_of(problem["goal"][:3], problem["goal"][3:])
    return planner.plan_to_pose(scene, problem["start"], [goal], options, watch)


def inverse_kinematics(planner: Planner, request: dict[str, Any]) -> Answer:
    """Solve poses (N, 7), position and quaternion; return joints (N, 7), NaN if unsolved, and times (N,)."""
    reference = planner.named_state("home")
    joints, times = [], []
    for row in unpack(request["poses"]).tolist():
        begun = time.perf_counter()
        try:
            found = planner.inverse_kinematics(pose_of(row[:3], row[3:]), reference)[0]
        except RoboximError:
            found = np.full(planner.robot.dof, np.nan)
        times.append(1e3 * (time.perf_counter() - begun))
        joints.append(found)
    return {"error": "", "joints": pack(np.array(joints)), "ms": pack(np.array(times))}


def retreat(planner: Planner, request: dict[str, Any]) -> Answer:
    """Plan to the problem's pose and straight back from there as one request; return whether both succeed."""
    problem = request["problem"]
    back = StageGoal(pose=Pose(position=(0.0, 0.0, -request["distance_m"])), frame="tcp")
    stages = (
        Stage(kind="pose", goals=(StageGoal(pose=pose_of(problem["goal"][:3], problem["goal"][3:])),)),
        Stage(kind="cartesian", goals=(back,)),
    )
    begun = time.perf_counter()
    try:
        found = plan_sequence(planner, scene_of(problem), problem["start"], stages)
    except RoboximError as error:
        return {"ms": 1e3 * (time.perf_counter() - begun), "error": f"{error.code.name}: {error}"}
    ms = 1e3 * (time.perf_counter() - begun)
    motions = [(pack(part.sample(1e-3).positions), part.duration) for part in found.plans]
    return {"ms": ms, "error": "", "motions": motions}


def repeat(planner: Planner, request: dict[str, Any]) -> Answer:
    """Plan a number of problems without keeping the plans; return the process's memory afterwards [MiB]."""
    for k, problem in enumerate(request["problems"]):
        try:
            _plan(planner, problem, request["seed"] + k, no_watch)
        except RoboximError:
            continue
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return {"error": "", "rss_mib": pages * os.sysconf("SC_PAGESIZE") / 2**20}


def digests(planner: Planner, request: dict[str, Any]) -> Answer:
    """Plan problems; return a hash of each motion's samples, or the error's code."""
    found = []
    for k, problem in enumerate(request["problems"]):
        try:
            samples = _plan(planner, problem, request["seed"] + k, no_watch).sample(1e-3)
            found.append(hashlib.sha256(samples.positions.tobytes()).hexdigest())
        except RoboximError as error:
            found.append(error.code.name)
    return {"error": "", "digests": found}


def scene_of(problem: dict[str, Any]) -> PlanningScene:
    """Return the planner's view of a problem."""
    bodies = tuple(_body(f"solid{i}", solid) for i, solid in enumerate(problem["solids"]))
    held = () if problem["held"] is None else (Attached(body=_body("held", problem["held"])),)
    return PlanningScene(bodies=bodies, attached=held)


def pose_of(position: list[float], quat_xyzw: list[float]) -> Pose:
    """Return a pose of plain numbers."""
    return Pose(position=tuple(position), quat_xyzw=tuple(quat_xyzw))


def _body(name: str, solid: dict[str, Any]) -> Body:
    shape = Shape(kind=solid["kind"], size=tuple(solid["size"]))
    return Body(name=name, shapes=(shape,), pose=pose_of(solid["position"], solid["quat_xyzw"]))


if __name__ == "__main__":
    serve(make)
