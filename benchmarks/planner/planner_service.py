"""Overhead of the planner's services: the same requests through the node and without it, interleaved.

The node runs in a separate thread of this process, as in every graph that `roboxim` starts in one process. The
benchmark also measures the cost of a scene change: a new snapshot with a moved or held body and its geometry, up to the
first check.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from statistics import median

from benchmarks._harness import Bench, time_ms
from geometry_msgs.msg import PoseStamped
from roboxim_interfaces.msg import CollisionObject
from roboxim_interfaces.srv import CheckState, ComputeIK, PlanCartesian, PlanToPose
from sensor_msgs.msg import JointState
from shape_msgs.msg import SolidPrimitive

from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_planner.collisions.checker import CollisionWorld
from roboxim_planner.node import PlannerNode
from roboxim_planner.pipeline import Planner
from roboxim_planner.scene import Body, PlanningScene, box, model_shapes
from roboxim_ros.clients import Clients
from roboxim_ros.host import NodeHost
from roboxim_ros.messages.conversions import fill_pose
from roboxim_ros.runs import activate_transport, free_domain

GOAL = Pose(position=(0.5, -0.3, 0.25), quat_xyzw=(1.0, 0.0, 0.0, 0.0))
RAISED = Pose(position=(0.5, 0.0, 0.45), quat_xyzw=(1.0, 0.0, 0.0, 0.0))
SIZE, AT = (0.1, 0.1, 0.2), Pose(position=(0.6, 0.3, 0.1))


def stamped(pose: Pose) -> PoseStamped:
    """Return a pose in the world as a message."""
    msg = PoseStamped()
    fill_pose(msg.pose, pose)
    return msg


def crowded() -> PlanningScene:
    """Return a table with ten boxes."""
    bodies = [box(f"box{k}", (0.05, 0.05, 0.05), Pose(position=(0.3 + 0.04 * k, 0.4, 0.03))) for k in range(10)]
    return PlanningScene(bodies=(box("table", (0.9, 1.4, 0.05), Pose(position=(0.5, 0.0, -0.03))), *bodies))


def moved(step: int) -> Callable[[], PlanningScene]:
    """Return a function that creates the scene with its first box moved."""
    scene = crowded()

    def change() -> PlanningScene:
        body = replace(scene.bodies[1], pose=Pose(position=(0.3, -0.3 + 1e-4 * step, 0.03)))
        return replace(scene, bodies=(scene.bodies[0], body, *scene.bodies[2:]))

    return change


def held(step: int) -> Callable[[], PlanningScene]:
    """Return a function that creates the scene with a mug of 20 parts in the gripper."""
    mug = Body(name="mug", shapes=model_shapes(ModelLibrary().object("mug"), {}), pose=Pose(position=(0.3, 0.0, 0.05)))
    scene = crowded().with_bodies([mug])
    tcp = Pose(position=(0.3, 0.0, 0.1 + 1e-4 * step), quat_xyzw=(1.0, 0.0, 0.0, 0.0))
    return lambda: scene.attach("mug", tcp)


def main() -> None:
    """Measure and print."""
    bench = Bench("planner_service", __doc__)
    repeats = 50 if bench.quick else 200
    activate_transport()
    planner = Planner(ModelLibrary().robot("panda"))
    home = planner.named_state("home")
    scene = PlanningScene(bodies=(box("block", SIZE, AT),))
    block = CollisionObject(name="block", primitives=[SolidPrimitive(type=SolidPrimitive.BOX, dimensions=list(SIZE))])
    fill_pose(block.pose, AT)
    state = JointState(position=home.tolist())
    pose, line = PlanToPose.Request(target=stamped(GOAL)), PlanCartesian.Request(waypoints=[stamped(RAISED)])
    check, ik = CheckState.Request(state=state), ComputeIK.Request(target=stamped(GOAL), seed_state=state)
    for request in (pose.request, line.request):
        request.start_state, request.scene.objects = state, [block]
    check.scene.objects = [block]
    ik.mode = ComputeIK.Request.ANY
    cases: list[tuple[str, object, object, Callable[[], object]]] = [
        ("plan_to_pose", PlanToPose, pose, lambda: planner.plan_to_pose(scene, home, [GOAL]).sample(0.01)),
        ("plan_cartesian", PlanCartesian, line, lambda: planner.plan_cartesian(scene, home, [RAISED]).sample(0.01)),
        ("check_state", CheckState, check, lambda: planner.check_state(scene, home)),
        ("compute_ik", ComputeIK, ik, lambda: planner.inverse_kinematics(GOAL, home)),
    ]
    for name, change in (("a body's pose changes", moved), ("a mug is attached", held)):
        snapshots = iter([change(k) for k in range(repeats + 3)])
        cost = time_ms(lambda made=snapshots: CollisionWorld(planner.robot, next(made)()).is_free(home), repeats)
        bench.row(what=name, core_ms=round(cost, 2))
    worst = 0.0
    with free_domain() as domain, NodeHost(domain_id=domain) as host:
        host.add(lambda context: PlannerNode(context=context, parameters={"dumps_kept": 0}))
        clients = Clients("planner_service", context=host.context)
        try:
            for name, kind, request, core in cases:
                client = clients.client(kind, f"planner/{name}")
                beyond, spent = [], []
                for index in range(repeats + 5):
                    begun = time.perf_counter()
                    core()
                    between = time.perf_counter()
                    client.call(request)
                    if index >= 5:  # the first requests warm up
                        spent.append(between - begun)
                        beyond.append(time.perf_counter() - between - spent[-1])
                overhead = 1e3 * median(beyond)
                worst = max(worst, overhead)
                bench.row(what=name, core_ms=round(1e3 * median(spent), 2), overhead_ms=round(overhead, 2))
        finally:
            clients.close()
    bench.finish("largest overhead of a service over the core call", worst, "ms", at_most=3.0)


if __name__ == "__main__":
    main()
