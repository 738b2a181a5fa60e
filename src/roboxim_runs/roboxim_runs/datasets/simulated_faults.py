"""Faults that the simulator plants: the episode is executed again with another scene or other actions."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from roboxim_core.poses import Pose
from roboxim_core.registry import Registry
from roboxim_core.specs import CameraSpec, EntitySpec, SceneSpec
from roboxim_runs.episodes.reenactment import Act, Recorded, Reenactor
from roboxim_tasks.roles import task_objects

ROBOT = "robot"
TRIES = 6
Vector = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What to execute instead."""

    scene: SceneSpec
    """The scene."""
    acts: tuple[Act, ...]
    """The actions."""
    text: str
    """What is planted, in a phrase."""


class SimulatedFault(ABC):
    """A fault that needs the simulator; it can be planted in bags only."""

    title: ClassVar[str] = ""
    """What is planted, as a short phrase."""
    found_by: ClassVar[str] = ""
    """Name of the check that must find it."""

    @abstractmethod
    def plans(self, recorded: Recorded, sim: Reenactor, rng: np.random.Generator) -> Iterator[Plan]:
        """Yield ways to plant the fault, the first of which that `suits` is recorded."""

    def suits(self, recorded: Recorded, plan: Plan, sim: Reenactor) -> bool:
        """Return whether a plan plants this fault and no other: the task is still solved at the end."""
        return sim.execute(recorded, plan.scene, plan.acts)[0][-1]


SIMULATED_FAULTS: Registry[type[SimulatedFault]] = Registry("simulated fault")
"""Classes of faults by name; they take no arguments."""


def _split(recorded: Recorded) -> tuple[list[Act], list[Act]]:
    """Return the actions that are trained on, and the settling ones."""
    steps = recorded.result.steps
    return list(recorded.acts[:steps]), list(recorded.acts[steps:])


def _act(delta: Vector, gripper: float) -> Act:
    action = tuple(float(value) for value in np.array([*delta, 0.0, 0.0, 0.0, gripper], np.float32))
    return Act(executed=action, label=action)


def _moves(vector: Vector, ticks: int, gripper: float) -> list[Act]:
    return [_act(vector / ticks, gripper)] * ticks


def _tcp(recorded: Recorded) -> Vector:
    return np.array([state.robot.pose_tcp_measured.position for state in recorded.states])


def _touch(recorded: Recorded) -> int | None:
    """Return the first tick at which the robot touches an object of the task."""
    named = {thing.entity for thing in task_objects(recorded.info.task)}
    for state in recorded.states:
        for contact in state.contacts:
            bodies = {contact.body_a, contact.body_b}
            if ROBOT in bodies and bodies & named:
                return state.seq
    return None


# ------------------------------------------------------------------ other actions


@SIMULATED_FAULTS.register("continues_after_done")
class ContinuesAfterDone(SimulatedFault):
    """The arm keeps moving after the success (thesis 6.1.2, issue 1)."""

    title = "fifteen more ticks, in which the hand rises"
    found_by = "continues_after_done"

    def plans(self, recorded: Recorded, sim: Reenactor, rng: np.random.Generator) -> Iterator[Plan]:
        """Rise, in some direction."""
        acting, settling = _split(recorded)
        gripper = acting[-1].executed[-1]
        for side in rng.permutation([-0.004, 0.0, 0.004]):
            more = _moves(15 * np.array([-0.004, side, 0.012]), 15, gripper)
            yield Plan(scene=recorded.info.scene, acts=(*acting, *more, *settling), text="15 more ticks at the end")


@SIMULATED_FAULTS.register("success_undone")
class SuccessUndone(SimulatedFault):
    """The success is lost again (thesis 6.1.2, issue 1)."""

    title = "the held object is dropped at the end"
    found_by = "continues_after_done"

    def plans(self, recorded: Recorded, sim: Reenactor, rng: np.random.Generator) -> Iterator[Plan]:
        """Open the gripper where it holds the object at the end."""
        acting, settling = _split(recorded)
        if acting[-1].executed[-1] < 0.5:
            dropped = [replace(act, executed=(*act.executed[:-1], 1.0)) for act in settling]
            more = _moves(np.zeros(3), 8, 1.0)
            yield Plan(scene=recorded.info.scene, acts=(*acting, *more, *dropped), text="the object is dropped")

    def suits(self, recorded: Recorded, plan: Plan, sim: Reenactor) -> bool:
        """Return whether the success is lost."""
        return not sim.execute(recorded, plan.scene, plan.acts)[0][-1]


@SIMULATED_FAULTS.register("inaccurate_control")
class InaccurateControl(SimulatedFault):
    """A miss and its correction (thesis 6.1.2, issue 2)."""

    title = "a grasp or touch 3 cm next to the object, and a retreat"
    found_by = "inaccurate_control"

    def plans(self, recorded: Recorded, sim: Reenactor, rng: np.random.Generator) -> Iterator[Plan]:
        """Leave the approach a little before the touch, miss, come back."""
        acting, settling = _split(recorded)
        touch, tcp = _touch(recorded), _tcp(recorded)
        if touch is None or touch < 3:
            return
        distance = np.linalg.norm(tcp[: touch + 1] - tcp[touch], axis=1)
        for height in (0.03, 0.04):
            far = np.flatnonzero(distance >= height)
            if not len(far) or distance[far[-1]] > 0.048:
                continue
            tick = int(far[-1])
            onward = (tcp[touch] - tcp[tick]) / distance[tick]
            for sideways in _across(onward, rng):
                gripper = recorded.states[tick].robot.gripper_command
                opens = gripper >= 0.5
                miss = [
                    *_moves(0.03 * sideways, 2, gripper),
                    *(_moves(np.zeros(3), 5, 0.0) if opens else ()),
                    *(_moves(np.zeros(3), 5, gripper) if opens else ()),
                    *_moves(-0.05 * onward, 3, gripper),
                    *_moves(0.05 * onward, 3, gripper),
                    *_moves(-0.03 * sideways, 2, gripper),
                ]
                acts = (*acting[:tick], *miss, *acting[tick:], *settling)
                yield Plan(scene=recorded.info.scene, acts=acts, text=f"a miss at tick {tick}")


def _across(direction: Vector, rng: np.random.Generator) -> Iterator[Vector]:
    """Yield horizontal directions across another one, then upwards."""
    side = np.cross(direction, [0.0, 0.0, 1.0])
    if np.linalg.norm(side) < 0.3:
        side = np.array([0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    sign = 1.0 if rng.random() < 0.5 else -1.0
    yield from (sign * side, -sign * side)
    if abs(direction[2]) < 0.7:
        up = np.array([0.0, 0.0, 1.0]) - direction[2] * direction
        yield up / np.linalg.norm(up)


@SIMULATED_FAULTS.register("rest")
class Rest(SimulatedFault):
    """Ticks in which nothing moves."""

    title = "two seconds of rest in the middle"
    found_by = "idle"

    def plans(self, recorded: Recorded, sim: Reenactor, rng: np.random.Generator) -> Iterator[Plan]:
        """Hold the pose for two seconds."""
        acting, settling = _split(recorded)
        count = round(2 * recorded.info.semantics.rate_hz)
        for _ in range(TRIES):
            tick = int(rng.integers(len(acting) // 4, max(len(acting) // 4 + 1, 3 * len(acting) // 4)))
            rest = _moves(np.zeros(3), count, acting[tick - 1].executed[-1])
            acts = (*acting[:tick], *rest, *acting[tick:], *settling)
            yield Plan(scene=recorded.info.scene, acts=acts, text=f"{count} ticks of rest from tick {tick}")


# ------------------------------------------------------------------ other scenes


def _with_camera(scene: SceneSpec, camera: CameraSpec) -> SceneSpec:
    return replace(scene, cameras=tuple(camera if c.name == camera.name else c for c in scene.cameras))


def _fixed_cameras(scene: SceneSpec) -> list[CameraSpec]:
    return [camera for camera in scene.cameras if camera.parent == "world"]


@SIMULATED_FAULTS.register("camera_turned")
class CameraTurned(SimulatedFault):
    """A camera that looks past the scene (thesis 6.1.2, issue 3)."""

    title = "a fixed camera turned by 60 degrees"
    found_by = "hidden_object"

    def plans(self, recorded: Recorded, sim: Reenactor, rng: np.random.Generator) -> Iterator[Plan]:
        """Turn a camera about its vertical."""
        for camera in _fixed_cameras(recorded.info.scene):
            turn = Rotation.from_euler("y", math.radians(60.0 if rng.random() < 0.5 else -60.0))
            pose = camera.pose @ Pose.from_arrays((0.0, 0.0, 0.0), turn)
            scene = _with_camera(recorded.info.scene, replace(camera, pose=pose))
            yield Plan(scene=scene, acts=recorded.acts, text=f"{camera.name} turned by 60 degrees")


@SIMULATED_FAULTS.register("camera_blocked")
class CameraBlocked(SimulatedFault):
    """An object in front of a camera (thesis 6.1.2, issue 3)."""

    title = "a cube in front of a fixed camera"
    found_by = "hidden_object"

    def plans(self, recorded: Recorded, sim: Reenactor, rng: np.random.Generator) -> Iterator[Plan]:
        """Fix a cube between the camera and the object that is touched."""
        named = task_objects(recorded.info.task)
        for camera in _fixed_cameras(recorded.info.scene):
            eye = np.array(camera.pose.position)
            thing = named[int(rng.integers(len(named)))]
            goal = np.array(recorded.states[0].entity(thing.entity).pose.position)
            place = eye + 0.1 * (goal - eye) / np.linalg.norm(goal - eye)
            cube = EntitySpec(
                name="blocking_cube", model="cube", modifiers={"scale": 1.4, "color": "black"},
                pose=Pose(position=(float(place[0]), float(place[1]), float(place[2]))), fixed=True,
            )  # fmt: skip
            scene = recorded.info.scene
            yield Plan(
                scene=replace(scene, entities=(*scene.entities, cube)), acts=recorded.acts,
                text=f"a cube before {camera.name}",
            )  # fmt: skip


@SIMULATED_FAULTS.register("indistinguishable")
class Twin(SimulatedFault):
    """A second object that looks like the named one (thesis 6.1.2, issue 5)."""

    title = "a twin of the named object"
    found_by = "indistinguishable"
    gap_m = 0.10

    def plans(self, recorded: Recorded, sim: Reenactor, rng: np.random.Generator) -> Iterator[Plan]:
        """Put a copy of the object where it obstructs nothing."""
        scene, target = recorded.info.scene, recorded.info.task.objects.get("target")
        if target is None or scene.entity(target.entity).joint_positions or "twin" in {e.name for e in scene.entities}:
            return
        spec = scene.entity(target.entity)
        taken = [np.array(entity.pose.position[:2]) for entity in scene.entities]
        taken += list(_tcp(recorded)[:, :2])
        taken += [np.array(s.entity(target.entity).pose.position[:2]) for s in recorded.states]
        found = 0
        for _ in range(400):
            place = rng.uniform([0.36, -0.22], [0.64, 0.22])
            if min(float(np.linalg.norm(place - other)) for other in taken) > self.gap_m:
                x, y = place.tolist()
                twin = replace(spec, name="twin", pose=replace(spec.pose, position=(x, y, spec.pose.position[2])))
                entities = (*scene.entities, twin)
                yield Plan(
                    scene=replace(scene, entities=entities), acts=recorded.acts, text=f"a twin at ({x:.2f}, {y:.2f}) m"
                )
                found += 1
                if found == TRIES:
                    return


@SIMULATED_FAULTS.register("collision")
class Obstacle(SimulatedFault):
    """Something in the hand's way."""

    title = "a fixed cube in the hand's way"
    found_by = "collision"
    force_n = 8.0

    def plans(self, recorded: Recorded, sim: Reenactor, rng: np.random.Generator) -> Iterator[Plan]:
        """Fix a small cube beside the path of the hand."""
        touch, tcp, scene = _touch(recorded), _tcp(recorded), recorded.info.scene
        last = touch if touch is not None else len(tcp) - 1
        for _ in range(4 * TRIES):
            tick = int(rng.integers(last // 3, max(last // 3 + 1, 4 * last // 5)))
            offset = rng.uniform([-0.05, -0.08, -0.02], [0.05, 0.08, 0.05])
            x, y, z = (tcp[tick] + offset).tolist()
            cube = EntitySpec(
                name="obstacle", model="cube", modifiers={"scale": 0.6}, pose=Pose(position=(x, y, z)), fixed=True
            )
            yield Plan(
                scene=replace(scene, entities=(*scene.entities, cube)), acts=recorded.acts,
                text=f"a cube in the way at tick {tick}",
            )  # fmt: skip

    def suits(self, recorded: Recorded, plan: Plan, sim: Reenactor) -> bool:
        """Return whether the hand hits the cube, and the task is solved all the same, and not before the end."""
        solved, states = sim.execute(recorded, plan.scene, plan.acts)
        early = any(solved[: recorded.result.steps - 1])
        hits = (c.force_max for s in states for c in s.contacts_between("obstacle", ROBOT))
        return solved[-1] and not early and max(hits, default=0.0) > self.force_n
