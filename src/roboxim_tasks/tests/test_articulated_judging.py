"""When buttons, drawers, turns and pushes count, over made-up ticks."""

import math
from dataclasses import replace

import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.poses import Pose
from roboxim_core.specs import PhysicalObject, TaskSpec
from roboxim_core.state import Contact, EntityState, RobotState, StateRecord
from roboxim_tasks.judging import Judge
from roboxim_tasks.sequences.steps import arguments_of

ROBOT = RobotState(
    joint_names=(), joint_positions=(), joint_velocities=(), joint_commands=(), pose_tcp_measured=Pose(),
    pose_tcp_commanded=Pose(), gripper_opening=0.5, gripper_command=0.0,
)  # fmt: skip
ON_TABLE = Contact(body_a="table", link_a="", body_b="target", link_b="", force_last=1.0, force_max=1.0)
TOUCHED = Contact(body_a="robot", link_a="panda_hand", body_b="target", link_b="", force_last=1.0, force_max=1.0)
BY_FINGER = Contact(body_a="robot", link_a="finger", body_b="target", link_b="cap", force_last=4.0, force_max=4.0)


def task(skill, **arguments):
    target = PhysicalObject(entity="target", model="cube", name="cube")
    return TaskSpec(skill=skill, objects={"target": target}, arguments=arguments, instruction=skill)


def tick(seq, *entities, contacts=(ON_TABLE,)):
    return StateRecord(
        episode_id="e", seq=seq, stamp_ns=seq * 100_000_000, robot=ROBOT, contacts=contacts, entities=entities
    )


def fold(of, records):
    judge = Judge(of)
    return [judge.start(records[0]), *(judge.step(record) for record in records[1:])]


def turned(seq, degrees, x=0.5, **kwargs):
    pose = Pose.from_arrays((x, 0.0, 0.02), Rotation.from_euler("z", degrees, degrees=True))
    return tick(seq, EntityState(name="target", pose=pose), **kwargs)


@pytest.mark.parametrize(
    ("direction", "degrees", "success"),
    [("clockwise", -90, True), ("counter-clockwise", 90, True), ("clockwise", 270, False), ("clockwise", -84, False),
     ("counter-clockwise", 450, False), ("clockwise", 90, False)],
)  # fmt: skip
def test_a_rotation_counts_by_its_way_and_not_by_where_it_ends(direction, degrees, success):
    of = task("rotate", direction=direction, angle_deg=90.0, tolerance_deg=5.0)
    records = [turned(k, degrees * min(k / 20, 1.0)) for k in range(27)]
    verdict = fold(of, records)[-1]
    assert verdict.success is success
    assert abs(verdict.predicates["turned_deg"]) == pytest.approx(abs(degrees), abs=0.1)


def test_a_rotation_needs_the_object_let_go_and_where_it_was():
    of = task("rotate", direction="clockwise", angle_deg=90.0, tolerance_deg=5.0)
    turn = [turned(k, -90 * k / 20) for k in range(20)]
    held = [turned(20 + k, -90, contacts=(ON_TABLE, TOUCHED)) for k in range(6)]
    assert fold(of, [*turn, *held])[-1].reason == "not_released"
    away = [turned(20 + k, -90, x=0.56) for k in range(6)]
    assert fold(of, [*turn, *away])[-1].reason == "moved_away"


def button(seq, now, highest, other=0.0, contacts=(BY_FINGER,), other_now=0.0):
    return tick(
        seq,
        EntityState(name="target", joint_names=("press",), joint_positions=(now,), joint_lowest=(0.0,),
                    joint_highest=(highest,)),
        EntityState(name="distractor_1", joint_names=("press",), joint_positions=(other_now,), joint_lowest=(0.0,),
                    joint_highest=(other,)),
        contacts=contacts,
    )  # fmt: skip


def test_a_press_within_a_tick_counts_for_good():
    of = task("push_button", travel_m=0.006, joint="press", fingers="finger other_finger")
    verdicts = fold(of, [button(0, 0.0, 0.0), button(1, 0.0, 0.004), button(2, 0.0, 0.011), button(3, 0.0, 0.0)])
    assert [verdict.success for verdict in verdicts] == [False, False, True, True]
    assert verdicts[1].reason == "not_pressed"


@pytest.mark.parametrize("contacts", [(TOUCHED,), (BY_FINGER, TOUCHED), (ON_TABLE,)], ids=["hand", "both", "nothing"])
def test_what_is_not_a_finger_does_not_push_a_button(contacts):
    of = task("push_button", travel_m=0.006, joint="press", fingers="finger other_finger")
    pressed = [button(0, 0.0, 0.0), button(1, 0.0, 0.011, contacts=contacts)]
    verdict = fold(of, pressed)[-1]
    assert (verdict.success, verdict.failed, verdict.reason) == (False, False, "not_by_finger")
    assert fold(of, [*pressed, button(2, 0.0, 0.011)])[-1].success


def test_pressing_another_button_fails_for_good():
    of = task("push_button", travel_m=0.006, joint="press")
    verdict = fold(of, [button(0, 0.0, 0.0), button(1, 0.0, 0.0, other=0.01), button(2, 0.0, 0.011)])[-1]
    assert (verdict.success, verdict.failed, verdict.reason) == (False, True, "pressed_other_button")


def switch(seq, angle, contacts=()):
    return tick(seq, EntityState(name="target", joint_names=("flip",), joint_positions=(angle,)), contacts=contacts)


@pytest.mark.parametrize(
    ("start", "goal", "contacts", "reason"),
    [(0.0, 0.8, (BY_FINGER,), ""), (0.8, 0.0, (BY_FINGER,), ""), (0.0, 0.4, (BY_FINGER,), "not_flipped"),
     (0.0, 0.8, (BY_FINGER, TOUCHED), "not_by_finger_alone")],
    ids=["up", "down", "half_way", "by_the_hand"],
)  # fmt: skip
def test_a_switch_counts_on_its_other_side_by_fingers_alone_and_let_go(start, goal, contacts, reason):
    of = task("flip_switch", flip_rad=0.6, joint="flip", fingers="finger other_finger")
    way = [switch(k, start + (goal - start) * k / 8, contacts if k else ()) for k in range(9)]
    left = [switch(9 + k, goal) for k in range(6)]
    assert fold(of, [*way, *left])[-1].reason == reason
    held = [switch(9 + k, goal, (BY_FINGER,)) for k in range(6)]
    assert not fold(of, [*way, *held])[-1].success


@pytest.mark.parametrize(
    ("goal", "contacts", "reason"),
    [(2.4, (BY_FINGER,), ""), (2.2, (BY_FINGER,), "not_turned"), (0.6, (BY_FINGER,), "not_turned"),
     (2.4, (BY_FINGER, TOUCHED), "not_by_finger_alone")],
    ids=["turned", "too_little", "the_other_way", "by_the_hand"],
)  # fmt: skip
def test_a_knob_counts_in_its_direction_by_fingers_alone_and_let_go(goal, contacts, reason):
    of = task("turn_knob", direction="counter-clockwise", turn_rad=0.8, joint="turn", fingers="finger other_finger")

    def knob(seq, angle, touched=()):
        state = EntityState(name="target", joint_names=("turn",), joint_positions=(angle,))
        return tick(seq, state, contacts=touched)

    way = [knob(k, 1.5 + (goal - 1.5) * k / 8, contacts if k else ()) for k in range(9)]
    assert fold(of, [*way, *(knob(9 + k, goal) for k in range(6))])[-1].reason == reason
    assert not fold(of, [*way, *(knob(9 + k, goal, (BY_FINGER,)) for k in range(6))])[-1].success


def test_a_door_must_be_open_still_and_let_go():
    of = task("open_door", open_rad=0.7, joint="hinge")

    def door(seq, angle, touched=()):
        state = EntityState(name="target", joint_names=("hinge",), joint_positions=(angle,))
        return tick(seq, state, contacts=touched)

    opening = [door(k, 0.1 * k) for k in range(8)]
    assert fold(of, [*opening, *(door(8 + k, 0.8) for k in range(6))])[-1].success
    assert fold(of, [*opening, door(8, 0.8)])[-1].reason == "not_at_rest"
    assert fold(of, [*opening, *(door(8 + k, 0.8, (TOUCHED,)) for k in range(6))])[-1].reason == "not_released"


def drawers(seq, top, middle=0.0, contacts=()):
    state = EntityState(name="target", joint_names=("top", "middle"), joint_positions=(top, middle))
    return tick(seq, state, contacts=contacts)


def test_a_drawer_must_be_open_still_let_go_and_the_others_shut():
    of = task("open_drawer", drawer="top", open_m=0.1, joint="top")
    opening = [drawers(k, 0.012 * k) for k in range(10)]
    assert fold(of, [*opening, *(drawers(10 + k, 0.12) for k in range(6))])[-1].success
    assert fold(of, [*opening, drawers(10, 0.12)])[-1].reason == "not_at_rest"
    held = [drawers(10 + k, 0.12, contacts=(TOUCHED,)) for k in range(6)]
    assert fold(of, [*opening, *held])[-1].reason == "not_released"
    both = [drawers(10 + k, 0.12, 0.03) for k in range(6)]
    assert fold(of, [*opening, *both])[-1].reason == "moved_other_drawer"


def test_a_drawer_is_shut_within_a_centimetre():
    of = task("close_drawer", drawer="top", shut_m=0.01, joint="top")
    for end, success in ((0.009, True), (0.011, False)):
        closing = [drawers(k, max(end, 0.14 - 0.02 * k)) for k in range(14)]
        assert fold(of, closing)[-1].success is success


def pushed(seq, x, y, z=0.02, roll_deg=0.0):
    pose = Pose.from_arrays((x, y, z), Rotation.from_euler("x", roll_deg, degrees=True))
    return tick(seq, EntityState(name="target", pose=pose))


@pytest.mark.parametrize(
    ("end", "lifted", "roll_deg", "reason"),
    [((0.5, 0.1), 0.0, 0, ""), ((0.5, 0.05), 0.0, 0, "not_pushed"), ((0.45, 0.1), 0.0, 0, "not_straight"),
     ((0.5, -0.1), 0.0, 0, "not_pushed"), ((0.5, 0.1), 0.05, 0, "lifted"), ((0.5, 0.1), 0.0, 90, "toppled")],
)  # fmt: skip
def test_a_push_goes_far_enough_straight_and_over_the_table(end, lifted, roll_deg, reason):
    of = task("push_object", direction="to the left", direction_x=0.0, direction_y=1.0)
    way = [
        pushed(k, 0.5 + (end[0] - 0.5) * k / 10, end[1] * k / 10, 0.02 + lifted * math.sin(math.pi * k / 10))
        for k in range(10)
    ]
    verdict = fold(of, [*way, *(pushed(10 + k, *end, roll_deg=roll_deg) for k in range(6))])[-1]
    assert (verdict.success, verdict.reason) == (not reason, reason)


@pytest.mark.parametrize(("tilt_deg", "success"), [(0, True), (8, True), (15, False), (90, False), (180, False)])
def test_upright_is_the_right_way_up(tilt_deg, success):
    of = task("turn_upright", tilt_deg=10.0)
    records = [pushed(0, 0.5, 0.0, roll_deg=90), *(pushed(k, 0.5, 0.0, roll_deg=tilt_deg) for k in range(1, 8))]
    assert fold(of, records)[-1].success is success


def both_buttons(order):
    """Return the task to push the target, then the distractor of `button`, here a named object."""
    things = {
        role: PhysicalObject(entity=entity, model="button", name="button")
        for role, entity in (("first", "target"), ("second", "distractor_1"))
    }
    step = {"travel_m": 0.006, "joint": "press", "fingers": "finger other_finger"}
    pairs = [
        (TaskSpec(skill="push_button", objects={"target": thing}, arguments=step, instruction="push"), {"target": role})
        for role, thing in things.items()
    ]
    return TaskSpec(
        skill="push_button+push_button", objects=things, arguments=arguments_of(pairs, order), instruction="push both"
    )


@pytest.mark.parametrize("order", ["fixed", "any"])
def test_two_buttons_of_one_task_may_both_be_pressed(order):
    on_other = replace(BY_FINGER, body_a="distractor_1", link_a="cap", body_b="robot", link_b="finger")
    first = [button(0, 0.0, 0.0), button(1, 0.011, 0.011), button(2, 0.011, 0.011), button(3, 0.0, 0.011, contacts=())]
    verdicts = fold(both_buttons(order), [*first, button(4, 0.0, 0.0, other=0.011, contacts=(on_other,))])
    assert [verdict.success for verdict in verdicts] == [False] * 4 + [True]
    assert verdicts[2].predicates["steps_done"] == 1


def test_a_button_to_be_pushed_twice_must_come_up_in_between():
    whole = both_buttons("fixed")
    roles = {"step_1.roles": "target=first", "step_2.roles": "target=first"}
    twice = replace(whole, objects={"first": whole.objects["first"]}, arguments=whole.arguments | roles)
    held = [button(0, 0.0, 0.0), *(button(k, 0.011, 0.011) for k in (1, 2, 3))]
    up = button(4, 0.0, 0.011, contacts=())
    verdicts = fold(twice, [*held, up, button(5, 0.011, 0.011)])
    assert [verdict.success for verdict in verdicts] == [False] * 5 + [True]
    assert verdicts[4].reason == "step_2_not_pressed"


def test_a_press_counts_from_the_first_tick_of_its_turn_and_never_before():
    on_other = (replace(BY_FINGER, body_a="distractor_1", link_a="cap", body_b="robot", link_b="finger"),)
    first = [button(0, 0.0, 0.0), button(1, 0.011, 0.011)]
    at_once = fold(both_buttons("fixed"), [*first, button(2, 0.0, 0.0, other=0.011, contacts=on_other)])
    assert at_once[-1].success, "its turn began with the tick before"
    early = [button(0, 0.0, 0.0), button(1, 0.011, 0.011, other=0.011, other_now=0.011)]
    held = button(2, 0.0, 0.0, other=0.011, contacts=on_other, other_now=0.011)
    up, again = button(3, 0.0, 0.0), button(4, 0.0, 0.0, other=0.011, contacts=on_other)
    verdicts = fold(both_buttons("fixed"), [*early, held, up, again])
    assert [verdict.success for verdict in verdicts] == [False] * 4 + [True]
    assert verdicts[2].reason == "step_2_not_pressed"
