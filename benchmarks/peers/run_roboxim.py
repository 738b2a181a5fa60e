"""RoboXim's planner as a contender. ``ms`` includes setting up the scene, which is part of each request."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from _serve import Answer, pack, serve

from roboxim_core.errors import RoboximError
from roboxim_core.models.description import Shape
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_planner.pipeline import MotionOptions, Planner
from roboxim_planner.scene import Attached, Body, PlanningScene


def make() -> Callable[[dict[str, Any]], Answer]:
    """Load the robot."""
    planner = Planner(ModelLibrary().robot("panda"))
    planner.plan_to_joints(PlanningScene(), planner.named_state("home"), planner.named_state("ready"))

    def handle(request: dict[str, Any]) -> Answer:
        problem = request["problem"]
        options = MotionOptions(seed=request["seed"], padding_m=problem["padding_m"])
        begun = time.perf_counter()

        def watch(stage: str, iterations: int) -> None:
            if time.perf_counter() - begun > request["limit_s"]:
                raise TimeoutError(f"in stage {stage}")

        scene = scene_of(problem)
        try:
            if problem["goal_is_joints"]:
                plan = planner.plan_to_joints(scene, problem["start"], problem["goal"], options, watch)
            else:
                goal = pose_of(problem["goal"][:3], problem["goal"][3:])
                plan = planner.plan_to_pose(scene, problem["start"], [goal], options, watch)
        except RoboximError as error:
            return {"ms": 1e3 * (time.perf_counter() - begun), "error": f"{error.code.name}: {error}"}
        except TimeoutError as error:
            return {"ms": 1e3 * (time.perf_counter() - begun), "error": f"TIMEOUT: {error}"}
        ms = 1e3 * (time.perf_counter() - begun)
        return {
            "ms": ms,
            "error": "",
            "route": plan.route,
            "positions": pack(plan.sample(1e-3).positions),
            "duration_s": plan.duration,
        }

    return handle


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
