"""RoboPlan as a contender: its inverse kinematics, RRTConnect, shortcuts and toppra.

Settings:

- The collision check steps are RoboPlan's defaults.
- The spline fitting mode is `Adaptive`: on 120 tabletop problems it gave no collision, where `Hermite` (a third faster)
  and `LinearBlend` gave four each. Half the step changed nothing but the time.
- Obstacles are enlarged by the problem's padding.
- ``ms`` covers inverse kinematics, search, shortcuts and time law at RoboPlan's default sampling; the samples for the
  referee are taken afterwards.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from _serve import Answer, pack, sample_times, serve
from roboplan import core, rrt, simple_ik, toppra

GROUP = "arm"
ACCELERATION = [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]
FINGER = 0.04  # the second follows it
TOUCHING = ("panda_hand", "panda_leftfinger", "panda_rightfinger")
COLOR = np.ones(4)
ATTEMPTS = 4


def make() -> Callable[[dict[str, Any]], Answer]:
    """Load the robot."""
    folder = Path(sys.argv[1])
    (folder / "limits.yaml").write_text(
        "joint_limits:\n"
        + "".join(
            f"  panda_joint{i}:\n    max_acceleration: [{a}]\n    max_jerk: [{500 * a}]\n"
            for i, a in enumerate(ACCELERATION, 1)
        )
    )
    description = core.loadUrdfSceneDescription(str(folder / "panda.urdf"), [str(folder)])
    scene = core.Scene("panda", description)
    scene.importSrdf((folder / "panda.srdf").read_text())
    scene.importJointLimitsFromConfig(core.loadJointLimitsConfig(str(folder / "limits.yaml")))
    names = list(scene.getJointGroupInfo(GROUP).joint_names)
    placed: list[str] = []
    # RoboPlan places a geometry in the joint frame; use the link whose origin is that of the joint
    tcp_in_flange = scene.forwardKinematics(np.array([0.0] * 7 + [FINGER]), "panda_hand_tcp", "panda_link7")

    def set_up(problem: dict[str, Any]) -> None:
        while placed:
            scene.removeGeometry(placed.pop())
        for i, solid in enumerate(problem["solids"]):
            _add(scene, f"solid{i}", "universe", solid, problem["padding_m"])
            placed.append(f"solid{i}")
        pairs = [("panda_link0", name) for name in placed]
        pairs += [(a, b) for i, a in enumerate(placed) for b in placed[:i]]
        if problem["held"]:
            pairs += [("held", link) for link in TOUCHING]
            _add(scene, "held", "panda_link7", problem["held"], 0.0, tcp_in_flange)
            placed.append("held")
        scene.setCollisions(pairs, False)

    def handle(request: dict[str, Any]) -> Answer:
        problem = request["problem"]
        begun = time.perf_counter()
        set_up(problem)
        setup_ms = 1e3 * (time.perf_counter() - begun)
        begun = time.perf_counter()
        try:
            path, error = _plan(scene, names, request)
            if path is None:
                return {"ms": 1e3 * (time.perf_counter() - begun), "setup_ms": setup_ms, "error": error}
            timing = toppra.PathParameterizerTOPPRA(scene, GROUP)
            options = toppra.TOPPRAOptions(mode=toppra.SplineFittingMode.Adaptive)
            timing.generate(path, options)
            ms = 1e3 * (time.perf_counter() - begun)
            options.dt = 0.001
            motion = timing.generate(path, options)
        except RuntimeError as error:
            return {"ms": 1e3 * (time.perf_counter() - begun), "setup_ms": setup_ms, "error": str(error)}
        times, positions = np.array(motion.times), np.array(motion.positions)
        at = sample_times(float(times[-1]))
        samples = np.stack([np.interp(at, times, column) for column in positions.T], axis=1)
        return {"ms": ms, "setup_ms": setup_ms, "error": "", "positions": pack(samples), "duration_s": float(times[-1])}

    return handle


def _plan(scene: Any, names: list[str], request: dict[str, Any]) -> tuple[Any, str]:
    """Return a shortcut path, or none and the reason; try a few goal configurations and seeds."""
    problem, deadline = request["problem"], time.perf_counter() + request["limit_s"]
    start = core.JointConfiguration(names, np.array(problem["start"]))
    scene.setJointPositions(np.array([*problem["start"], FINGER]))
    error = ""
    for attempt in range(ATTEMPTS):
        left = deadline - time.perf_counter()
        if left <= 0.0:
            return None, f"time out; {error}"
        seed = 1 + request["seed"] + 7919 * attempt
        goal, error = _goal(scene, names, problem, start, seed)
        if goal is None:
            continue
        options = rrt.RRTOptions(
            group_name=GROUP,
            max_nodes=100_000,
            collision_check_step_size=0.05,
            max_planning_time=left,
            rrt_connect=True,
        )
        search = rrt.RRT(scene, options)
        search.setRngSeed(seed)
        try:
            path = search.plan(start, goal)
        except RuntimeError as failure:
            error = str(failure)
            continue
        shortcuts = core.PathShortcuttingOptions(group_name=GROUP, max_step_size=0.05, max_iters=100, seed=seed)
        return core.PathShortcutter(scene, shortcuts).shortcut(path), ""
    return None, error


def _goal(scene: Any, names: list[str], problem: dict[str, Any], start: Any, seed: int) -> tuple[Any, str]:
    if problem["goal_is_joints"]:
        return core.JointConfiguration(names, np.array(problem["goal"])), ""
    target = pin.XYZQUATToSE3(np.array(problem["goal"])).homogeneous
    solver = simple_ik.SimpleIk(
        scene,
        simple_ik.SimpleIkOptions(
            group_name=GROUP, max_iters=100, max_time=0.1, max_restarts=50,
            max_linear_error_norm=5e-4, max_angular_error_norm=5e-4, check_collisions=True,
        ),
    )  # fmt: skip
    solver.setRngSeed(seed)
    solution = core.JointConfiguration(names, np.array(problem["start"]))
    goal = core.CartesianConfiguration("panda_link0", "panda_hand_tcp", target)
    found = solver.solveIk(goal, start, solution)
    return (solution, "") if found else (None, "no inverse kinematics")


def _add(
    scene: Any, name: str, frame: str, solid: dict[str, Any], padding: float, offset: np.ndarray | None = None
) -> None:
    pose = (np.eye(4) if offset is None else offset) @ pin.XYZQUATToSE3(
        np.array([*solid["position"], *solid["quat_xyzw"]])
    ).homogeneous
    grown = [value + 2.0 * padding for value in solid["size"]]
    if solid["kind"] == "box":
        scene.addBoxGeometry(name, frame, core.Box(*grown), pose, COLOR)
    elif solid["kind"] == "sphere":
        scene.addSphereGeometry(name, frame, core.Sphere(solid["size"][0] + padding), pose, COLOR)
    else:
        cylinder = core.Cylinder(solid["size"][0] + padding, grown[1])
        scene.addCylinderGeometry(name, frame, cylinder, pose, COLOR)


if __name__ == "__main__":
    serve(make)
