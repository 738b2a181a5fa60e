"""What counts in tasks of several steps, over made-up ticks: drops, towers, and other drawers."""

from dataclasses import replace

import pytest

from roboxim_core.config import parse_yaml
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.seeds import SeedPath
from roboxim_core.state import Contact, EntityState, RobotState, StateRecord
from roboxim_tasks.config import load_task_config, task_config
from roboxim_tasks.judging import Judge
from roboxim_tasks.sampling.episodes import EpisodeGenerator

AWAY = Pose(position=(0.3, 0.0, 0.9))
ROBOT = RobotState(
    joint_names=(), joint_positions=(), joint_velocities=(), joint_commands=(), pose_tcp_measured=AWAY,
    pose_tcp_commanded=AWAY, gripper_opening=0.5, gripper_command=0.0,
)  # fmt: skip
TIDY = """
steps:
  - {skill: put_into, roles: {target: first, container: container}}
  - {skill: put_into, roles: {target: second, container: container}}
order: %s
templates: {values: ["Put the {first} and the {second} into the {container}"]}
objects:
  container: {models: {values: [tray]}}
  first: {models: {values: [cube]}}
  second: {models: {values: [lemon]}}
"""
TOWER = """
steps: [{skill: stack, roles: {target: a, support: b}}, {skill: stack, roles: {target: c, support: a}}]
order: %s
objects:
  a: {models: {values: [cube]}, modifiers: {color: {values: [red]}}}
  b: {models: {values: [cube]}, modifiers: {color: {values: [blue]}}}
  c: {models: {values: [cube]}, modifiers: {color: {values: [green]}}}
"""


class Ticks:
    """Judges a task over states that consist of places of objects and of touching pairs."""

    def __init__(self, config):
        self.task = EpisodeGenerator(ModelLibrary()).task(SeedPath(run_seed=0, purpose="demo", index=0), config)
        self._judge, self._seq = Judge(self.task), 0

    def __call__(self, places, pairs, *, joints=None, times=1, fall=0.0, tcp=AWAY.position):
        """Judge a tick ``times`` times; returns the last verdict."""
        contacts = [
            Contact(body_a=a, link_a="finger" if a == "robot" else "", body_b=b, link_b="", force_last=1.0,
                    force_max=1.0, force_on_b=(0.0, 0.0, 1.0))
            for a, b in sorted(tuple(sorted(pair)) for pair in pairs)
        ]  # fmt: skip
        contacts = [replace(c, link_a="", link_b="finger") if c.body_b == "robot" else c for c in contacts]
        entities = tuple(
            EntityState(name=name, pose=Pose(position=place), fastest_fall=fall if name == "first" else 0.0,
                        **(joints or {}).get(name, {}))
            for name, place in places.items()
        )  # fmt: skip
        robot = replace(ROBOT, pose_tcp_measured=Pose(position=tcp))
        for _ in range(times):
            state = StateRecord(
                episode_id="e", seq=self._seq, stamp_ns=self._seq * 10**8, robot=robot, contacts=tuple(contacts),
                entities=entities,
            )  # fmt: skip
            verdict = self._judge.step(state) if self._seq else self._judge.start(state)
            self._seq += 1
        return verdict


@pytest.mark.parametrize("order", ["fixed", "any"])
def test_an_object_that_was_dropped_is_not_set_down_because_another_one_is(order):
    judged = Ticks(task_config(parse_yaml(TIDY % order)))
    start = {"container": (0.5, 0.0, 0.0175), "first": (0.4, 0.25, 0.0225), "second": (0.4, -0.25, 0.026)}
    on, inside, both = ("table", "second"), ("container", "first"), ("container", "second")
    judged(start, [("table", "first"), on])
    high = {**start, "first": (0.45, 0.0, 0.6)}
    judged(high, [("robot", "first"), on], tcp=(0.45, 0.0, 0.6))
    judged({**high, "first": (0.45, 0.0, 0.3)}, [on], fall=2.5, tcp=(0.45, 0.0, 0.6))
    lies = {**start, "first": (0.45, 0.0, 0.0285)}
    assert judged(lies, [inside, on], fall=3.3, times=20).reason == "step_1_dropped"
    judged({**lies, "second": (0.55, 0.0, 0.05)}, [inside, ("robot", "second")], tcp=(0.55, 0.0, 0.05))
    end = judged({**lies, "second": (0.55, 0.0, 0.032)}, [inside, both], times=20)
    assert (end.success, end.reason) == (False, "step_1_dropped")


@pytest.mark.parametrize("order", ["fixed", "any"])
def test_a_tower_must_still_stand_in_any_order(order):
    judged = Ticks(task_config(parse_yaml(TOWER % order)))
    ground = {"a": (0.4, 0.2, 0.0225), "b": (0.5, 0.0, 0.0225), "c": (0.6, -0.2, 0.0225)}
    judged(ground, [("table", name) for name in ground])
    two = {**ground, "a": (0.5, 0.0, 0.0675)}
    judged(two, [("a", "b"), ("table", "b"), ("table", "c")], times=6)
    assert judged({**two, "c": (0.5, 0.0, 0.1125)}, [("a", "b"), ("table", "b"), ("a", "c")], times=8).success
    end = judged(two, [("a", "b"), ("table", "b"), ("table", "c")], times=12)
    assert (end.success, end.reason) == (False, "step_2_undone")


@pytest.mark.parametrize(("middle", "reason"), [(0.0, ""), (0.15, "opened_other")])
def test_another_drawer_must_be_shut_also_when_the_first_step_is_done(middle, reason):
    judged = Ticks(load_task_config("drawer_chain"))
    given = judged.task.arguments
    floor, axis = ([float(given[f"step_2.{name}"]) for name in names] for names in (
        ("floor_x_m", "floor_y_m", "floor_z_m"), ("axis_x", "axis_y", "axis_z")))  # fmt: skip
    others = {
        thing.entity: (0.3, 0.3 + 0.1 * n, 0.03)
        for n, (role, thing) in enumerate(sorted(judged.task.objects.items()))
        if role.startswith("distractor")
    }

    def tick(top, other, place, pairs, times=8):
        drawers = {"joint_names": ("top", "middle", "bottom")}
        drawers |= dict.fromkeys(("joint_positions", "joint_lowest", "joint_highest"), (top, other, 0.0))
        places = {"cabinet": (0.75, 0.0, 0.18), "target": place, **others}
        return judged(places, [*pairs, *(("table", name) for name in others)], joints={"cabinet": drawers}, times=times)

    def inside(top):
        x, y, z = (f + top * a for f, a in zip(floor, axis, strict=True))
        return 0.75 + x, y, 0.18 + z + 0.03

    out = (0.45, 0.2, 0.0225)
    tick(0.0, 0.0, out, [("table", "target")], times=1)
    tick(0.13, 0.0, out, [("table", "target")])
    tick(0.13, middle, inside(0.13), [("cabinet", "target")])
    end = tick(0.0, middle, inside(0.0), [("cabinet", "target")])
    assert (end.success, end.reason) == (not middle, reason)
