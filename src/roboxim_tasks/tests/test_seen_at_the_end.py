"""The state at the end is what the sentence means: nothing toppled, propped, tossed, pushed off or left open."""

from __future__ import annotations

from dataclasses import replace

import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.poses import Pose
from roboxim_core.specs import PhysicalObject, TaskSpec
from roboxim_core.state import Contact, EntityState, RobotState, StateRecord
from roboxim_tasks.handling import not_tossed
from roboxim_tasks.judging import Judge
from roboxim_tasks.measures import kept_upright, stands_alone

ROBOT = RobotState(
    joint_names=(), joint_positions=(), joint_velocities=(), joint_commands=(), pose_tcp_measured=Pose(),
    pose_tcp_commanded=Pose(), gripper_opening=0.5, gripper_command=0.0,
)  # fmt: skip
TASK = TaskSpec(
    skill="pick_up",
    objects={
        "target": PhysicalObject(entity="target", model="cube", name="cube"),
        "distractor_1": PhysicalObject(entity="distractor_1", model="bottle", name="bottle"),
    },
    arguments={"lift_m": 0.05, "finger_force_n": 0.05, "hold_s": 0.2},
    instruction="Pick up the cube",
)


def thing(name="target", *, at=(0.5, 0.0, 0.06), tilt_deg=0.0, joints=()):
    pose = Pose.from_arrays(at, Rotation.from_euler("x", tilt_deg, degrees=True))
    return EntityState(
        name=name, pose=pose, joint_names=tuple(f"j{i}" for i in range(len(joints))), joint_positions=tuple(joints)
    )


def touch(other, entity="target", force=1.0):
    first, second = sorted((other, entity))
    return Contact(body_a=first, link_a=f"l{force}", body_b=second, link_b="", force_last=force, force_max=force)


def record(seq, *entities, contacts=()):
    return StateRecord(
        episode_id="e", seq=seq, stamp_ns=seq * 100_000_000, robot=ROBOT, contacts=tuple(contacts), entities=entities
    )


def held(seq, other, *, more=()):
    """A tick in which the target is held 10 cm above its place."""
    fingers = [touch("robot", force=force) for force in (2.0, 2.5)]
    return record(seq, thing(at=(0.5, 0.0, 0.16)), other, contacts=(*fingers, *more))


@pytest.mark.parametrize(
    ("tilt_deg", "z", "kept"),
    [(0, 0.06, True), (20, 0.058, True), (90, 0.03, False), (45, 0.05, False), (90, 0.06, True)],
)
def test_what_has_toppled_lies_lower_and_what_rolls_does_not(tilt_deg, z, kept):
    condition = kept_upright("target", record(0, thing()))
    now = record(1, thing(at=(0.5, 0.0, z), tilt_deg=tilt_deg))
    assert condition.holds(condition.measure.of(now)) == kept


def test_what_leans_on_a_neighbour_does_not_stand_alone():
    condition = stands_alone("target")
    alone = record(1, thing(), contacts=(touch("table"), touch("robot")))
    leaning = record(1, thing(), contacts=(touch("table"), touch("distractor_1", force=0.3)))
    assert condition.holds(condition.measure.of(alone))
    assert not condition.holds(condition.measure.of(leaning))


@pytest.mark.parametrize(("x", "tossed"), [(0.505, False), (0.56, True)])
def test_what_flies_on_without_the_hand_was_tossed(x, tossed):
    condition = not_tossed("target")
    in_hand = record(0, thing(at=(0.5, 0.0, 0.1)), contacts=(touch("robot"),))
    condition.measure.of(in_hand)
    landed = record(1, thing(at=(x, 0.0, 0.06)), contacts=(touch("table"),))
    assert condition.holds(condition.measure.of(landed)) != tossed
    again = record(2, thing(at=(x, 0.0, 0.1)), contacts=(touch("robot"),))
    assert condition.holds(condition.measure.of(again)), "picked up again"


OTHER = thing("distractor_1", at=(0.5, 0.2, 0.1), joints=(0.0,))


@pytest.mark.parametrize(
    ("other", "more", "reason"),
    [
        (OTHER, (), ""),
        (OTHER, (touch("distractor_1", force=0.5),), "rests_on_something"),
        (thing("distractor_1", at=(0.5, 0.2, 0.03), tilt_deg=90, joints=(0.0,)), (), "toppled_other"),
        (thing("distractor_1", at=(0.5, 0.9, -0.4), joints=(0.0,)), (), "pushed_off_table"),
        (replace(OTHER, joint_positions=(0.1,)), (), "opened_other"),
    ],
)
def test_a_lift_counts_only_with_the_rest_as_it_was(other, more, reason):
    judge = Judge(TASK)
    judge.start(record(0, thing(), OTHER, contacts=(touch("table"),)))
    for seq in range(1, 6):
        verdict = judge.step(held(seq, other, more=more))
    assert (verdict.success, verdict.reason) == (not reason, reason)
