"""How an object was handled, over made-up ticks: dropped, carried, let go; and what is on a surface."""

import math

import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.specs import PhysicalObject, TaskSpec
from roboxim_core.state import Contact, EntityState, RobotState, StateRecord
from roboxim_tasks.handling import carried_way, drop, hand_away, squeeze_n
from roboxim_tasks.judging import Judge
from roboxim_tasks.skills.place_on import surface_arguments


def finger(link="left", force=(0.0, 5.0, 0.0), last=5.0):
    return Contact(
        body_a="robot", link_a=link, body_b="target", link_b="", force_last=last, force_max=5.0, force_on_b=force
    )


GRIP = (finger(), finger("right", (0.0, -5.0, 0.0)))
LYING = (Contact(body_a="table", link_a="", body_b="target", link_b="", force_last=1.0, force_max=1.0),)


def tick(seq, xyz=(0.5, 0.0, 0.02), contacts=LYING, *, fall=0.0, tool=(0.5, 0.0, 0.02), others=()):
    robot = RobotState(
        joint_names=(), joint_positions=(), joint_velocities=(), joint_commands=(),
        pose_tcp_measured=Pose(position=tool), pose_tcp_commanded=Pose(), gripper_opening=0.5, gripper_command=0.0,
    )  # fmt: skip
    target = EntityState(name="target", pose=Pose(position=xyz), fastest_fall=fall)
    return StateRecord(
        episode_id="e", seq=seq, stamp_ns=seq * 100_000_000, robot=robot, contacts=tuple(contacts),
        entities=(target, *others),
    )  # fmt: skip


def test_a_drop_is_the_height_of_the_fall_since_the_object_was_last_held():
    measure = drop("target")
    lowered = [tick(1, contacts=GRIP, fall=0.3), tick(2, contacts=(*GRIP, *LYING), fall=0.1), tick(3, fall=0.2)]
    values = [measure.of(state) for state in [tick(0, fall=0.5), *lowered]]
    assert values == pytest.approx([0.0, 0.0, 0.1**2 / 19.62, 0.2**2 / 19.62])
    fall = math.sqrt(2 * 9.81 * 0.2)
    assert measure.of(tick(4, contacts=(), fall=fall)) == pytest.approx(0.2)
    assert measure.of(tick(5)) == pytest.approx(0.2)  # and it stays so
    assert measure.of(tick(6, contacts=(*GRIP, *LYING))) == pytest.approx(0.2)  # until it is picked up again
    assert measure.of(tick(7, contacts=GRIP)) == 0.0
    assert measure.of(tick(8)) == 0.0


def test_a_finger_that_brushes_what_falls_does_not_make_it_held():
    measure = drop("target")
    falling = [tick(1, contacts=GRIP), tick(2, contacts=(finger(last=0.0),), fall=1.0), tick(3, fall=1.5)]
    assert [measure.of(state) for state in falling][-1] == pytest.approx(1.5**2 / 19.62)


def test_the_hand_is_away_when_it_has_left_where_it_let_go():
    measure = hand_away("target")
    assert measure.of(tick(0)) == 1.0
    assert measure.of(tick(1, contacts=GRIP)) == 0.0
    assert measure.of(tick(2)) == 0.0  # open, but still round the object
    assert measure.of(tick(3, tool=(0.5, 0.0, 0.05))) == pytest.approx(0.03)
    assert measure.of(tick(4, tool=(0.5, 0.0, 0.10))) == pytest.approx(0.08)
    assert measure.of(tick(5)) == 0.0  # and back


def test_forces_from_opposite_sides_squeeze_and_those_from_one_side_push():
    assert squeeze_n(tick(0, contacts=GRIP), "target") == 5.0
    assert squeeze_n(tick(0, contacts=(finger(), finger("right", (0.0, -1.0, 0.0)))), "target") == 1.0
    assert squeeze_n(tick(0, contacts=(finger(), finger("right"))), "target") == 0.0
    either_side = (finger(force=(3.0, 3.0, 0.0)), finger("right", (3.0, -3.0, 0.0)))
    assert squeeze_n(tick(0, contacts=either_side), "target") == 0.0
    assert squeeze_n(tick(0, contacts=(finger(),)), "target") == 0.0


@pytest.mark.parametrize(
    ("contacts", "carried"),
    [(LYING, False), ((*LYING, finger()), False), ((*LYING, *GRIP), True), (GRIP, True), ((), True)],
    ids=["slides", "pushed", "dragged", "carried", "thrown"],
)
def test_what_moves_while_it_is_gripped_or_off_its_support_is_carried(contacts, carried):
    measure = carried_way("target", tick(0))
    values = [measure.of(tick(k, (0.5, 0.02 * k, 0.02), contacts)) for k in range(6)]
    assert values[-1] == pytest.approx(0.1 if carried else 0.0)
    assert measure.of(tick(6, (0.5, 0.2, 0.02))) == values[-1]


def test_a_grip_without_a_way_is_not_carrying():
    measure = carried_way("target", tick(0))
    assert [measure.of(tick(k, contacts=GRIP)) for k in range(4)] == [0.0] * 4


def placed(model, x, y, yaw_deg=0.0):
    """Return the verdict on a target at a place in its support's frame, the support turned by a yaw."""
    base = Pose.from_arrays((0.5, 0.1, 0.02), Rotation.from_euler("z", yaw_deg, degrees=True))
    support = EntityState(name="support", pose=base)
    of = TaskSpec(
        skill="place_on", instruction="", arguments=surface_arguments(ModelLibrary().object(model)),
        objects={role: PhysicalObject(entity=role, model="cube", name="cube") for role in ("support", "target")},
    )  # fmt: skip
    on = (Contact(body_a="support", link_a="", body_b="target", link_b="", force_last=1.0, force_max=1.0),)
    place = tuple(base.apply((x, y, 0.03)).tolist())
    judge = Judge(of)
    verdict = judge.start(tick(0, others=(support,)))
    for seq in range(1, 6):
        verdict = judge.step(tick(seq, place, on, tool=(0.5, 0.0, 0.5), others=(support,)))
    return verdict


@pytest.mark.parametrize(
    ("model", "x", "y", "reason"),
    [("tray", 0.095, 0.0, ""), ("tray", 0.0, 0.075, ""), ("tray", 0.0, 0.095, "not_centred"),
     ("tray", 0.125, 0.0, "not_centred"), ("plate", 0.05, 0.0, ""), ("plate", 0.05, 0.05, "not_centred"),
     ("cabinet", -0.1, 0.0, ""), ("cabinet", 0.1, 0.0, "not_centred")],
)  # fmt: skip
@pytest.mark.parametrize("yaw_deg", [0.0, 70.0])
def test_what_is_on_a_surface_is_judged_by_the_surface_s_shape(model, x, y, reason, yaw_deg):
    verdict = placed(model, x, y, yaw_deg)
    assert (verdict.success, verdict.reason) == (not reason, reason), verdict
