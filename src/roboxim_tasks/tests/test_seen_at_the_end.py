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
from roboxim_tasks.measures import stands_alone
from roboxim_tasks.standing import kept_upright, propped_share, rests_on, stays_upright

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


def touch(other, entity="target", force=1.0, up=None):
    """A contact in which another body presses an entity, by default upwards."""
    first, second = sorted((other, entity))
    on_b = (0.0, 0.0, (force if up is None else up) * (1.0 if second == entity else -1.0))
    return Contact(
        body_a=first, link_a=f"l{force}", body_b=second, link_b="", force_last=force, force_max=force, force_on_b=on_b
    )


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
    [(0, 0.06, True), (20, 0.058, True), (90, 0.03, False), (45, 0.05, False), (90, 0.06, False)],
)
def test_what_lies_on_another_side_has_not_kept_the_one_that_was_up(tilt_deg, z, kept):
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
        (OTHER, (touch("distractor_1", force=0.5, up=0.0),), ""),
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


@pytest.mark.parametrize(
    ("tilt_deg", "force", "up", "share"),
    [(0, 1.0, 0.0, 0.0), (0, 1.0, 1.0, 0.5), (2, 1.0, 0.0, 0.0), (20, 1.0, 0.2, 0.5), (90, 1.0, 0.0, 0.0)],
    ids=["level beside it", "level on it", "settled", "tilted", "on another side beside it"],
)
def test_what_is_tilted_leans_on_what_it_touches_and_what_is_level_does_not(tilt_deg, force, up, share):
    measure = propped_share("target", record(0, thing()), ("table",))
    contacts = (touch("table"), touch("distractor_1", force=force, up=up))
    now = record(1, thing(tilt_deg=tilt_deg), contacts=contacts)
    assert measure.of(now) == pytest.approx(share)
    assert (
        propped_share("target", record(0, thing()), ("distractor_1",)).of(record(1, thing(), contacts=contacts[1:]))
        == 0
    )


@pytest.mark.parametrize("tilt_deg", [0, 90, 180])
def test_a_thing_with_a_right_way_up_has_to_keep_it(tilt_deg):
    task = replace(TASK, skill="rotate", arguments={"target_upright": True})
    (condition,) = stays_upright(task, record(0, thing()))
    assert condition.holds(condition.measure.of(record(1, thing(tilt_deg=tilt_deg)))) == (tilt_deg == 0)
    assert stays_upright(replace(task, arguments={}), record(0, thing())) == ()


def test_what_touches_the_table_does_not_rest_on_the_support():
    on = record(1, thing(), OTHER, contacts=(touch("distractor_1"),))
    beside = record(1, thing(), OTHER, contacts=(touch("distractor_1"), touch("table")))
    assert [rests_on(state, "target", "distractor_1") for state in (on, beside)] == [True, False]


@pytest.mark.parametrize(("role", "reason"), [("target", "fell_off_table"), ("other", "pushed_off_table")])
@pytest.mark.parametrize("carrier", ["robot", "distractor_1"], ids=["in the hand", "on a shelf"])
def test_what_is_taken_down_has_not_fallen_off_the_table_until_it_lies_on_the_floor(carrier, role, reason):
    named = PhysicalObject(entity="target" if role == "target" else "distractor_1", model="cube", name="cube")
    judge = Judge(replace(TASK, objects={"target": named}))
    judge.start(record(0, thing(at=(0.5, 0.0, 0.4)), OTHER, contacts=(touch(carrier), touch("table", "distractor_1"))))
    for seq, below in enumerate(("robot", "table"), start=1):
        assert not judge.step(record(seq, thing(), OTHER, contacts=(touch(below),))).failed
    verdict = judge.step(record(3, thing(at=(0.5, 0.9, -0.7)), OTHER, contacts=(touch("floor"),)))
    assert (verdict.failed, verdict.reason) == (True, reason)
