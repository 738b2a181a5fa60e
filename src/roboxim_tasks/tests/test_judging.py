from dataclasses import replace

import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.errors import ErrorCode, TaskError
from roboxim_core.poses import Pose
from roboxim_core.specs import PhysicalObject, TaskSpec
from roboxim_core.state import Contact, EntityState, RobotState, StateRecord
from roboxim_tasks.judging import Judge
from roboxim_tasks.measures import at_rest

TASK = TaskSpec(
    skill="pick_up",
    objects={
        "target": PhysicalObject(entity="target", model="cube", name="cube", modifiers={"color": "red"}),
        "distractor_1": PhysicalObject(entity="distractor_1", model="cube", name="cube", modifiers={"color": "blue"}),
    },
    arguments={"lift_m": 0.05, "finger_force_n": 0.05, "hold_s": 0.5},
    instruction="Pick up the red cube",
)
ROBOT = RobotState(
    joint_names=(), joint_positions=(), joint_velocities=(), joint_commands=(), pose_tcp_measured=Pose(),
    pose_tcp_commanded=Pose(), gripper_opening=0.5, gripper_command=0.0,
)  # fmt: skip


def record(seq, target_z=0.0225, *, other_z=0.0225, fingers=(), on_table=None):
    """A tick at 10 Hz; ``fingers`` are the forces on the target."""
    contacts = [
        Contact(body_a="robot", link_a=f"finger_{i}", body_b="target", link_b="", force_last=force, force_max=9.0)
        for i, force in enumerate(fingers)
    ]
    if on_table if on_table is not None else target_z < 0.03:
        contacts.append(Contact(body_a="table", link_a="", body_b="target", link_b="", force_last=0.8, force_max=0.8))
    contacts = [c if c.body_a < c.body_b else replace(c, body_a=c.body_b, link_a="", body_b=c.body_a) for c in contacts]
    return StateRecord(
        episode_id="e", seq=seq, stamp_ns=seq * 100_000_000, robot=ROBOT, contacts=tuple(contacts),
        entities=(
            EntityState(name="target", pose=Pose(position=(0.5, 0.0, target_z))),
            EntityState(name="distractor_1", pose=Pose(position=(0.5, 0.2, other_z))),
        ),
    )  # fmt: skip


def fold(records):
    judge = Judge(TASK)
    return [judge.start(records[0]), *(judge.step(state) for state in records[1:])]


def test_a_lift_counts_when_it_was_held():
    lifted = [record(seq, 0.1, fingers=(2.0, 2.0)) for seq in range(1, 9)]
    verdicts = fold([record(0), *lifted])
    assert [v.success for v in verdicts] == [False] * 6 + [True] * 3
    assert [v.reason for v in verdicts[:6]] == ["not_grasped", *["not_held"] * 5]
    assert verdicts[-1].reason == ""
    assert verdicts[-1].predicates["lift_m"] == pytest.approx(0.0775)
    assert verdicts[-1].predicates["held_s"] == pytest.approx(0.7)


def test_a_success_that_slips_is_lost_again_but_remembered():
    records = [record(0), *(record(seq, 0.1, fingers=(2.0, 2.0)) for seq in range(1, 8)), record(8), record(9)]
    verdicts = fold(records)
    assert verdicts[7].success
    assert not verdicts[9].success
    assert verdicts[9].success_ever
    assert not verdicts[9].failed
    assert verdicts[9].reason == "not_grasped"


@pytest.mark.parametrize(
    ("tick", "reason"),
    [
        (record(1, 0.1, fingers=(2.0,)), "not_grasped"),
        (record(1, 0.1, fingers=(2.0, 0.01)), "not_grasped"),
        (record(1, 0.06, fingers=(2.0, 2.0)), "not_lifted"),
        (record(1, 0.1, fingers=(2.0, 2.0), on_table=True), "touches_table"),
        (record(1, other_z=0.1), "wrong_object_lifted"),
        (record(1, 0.1, fingers=(2.0, 2.0), other_z=0.1), "wrong_object_lifted"),
    ],
)
def test_each_predicate_can_refuse(tick, reason):
    verdict = fold([record(0), tick])[-1]
    assert verdict.reason == reason
    assert not verdict.success
    assert not verdict.failed


def test_what_chatters_is_at_rest_and_what_rolls_or_slides_is_not():
    def at(seq, x=0.5, yaw=0.0, spin=0.0):
        state = record(seq)
        pose = Pose.from_arrays((x, 0.0, 0.0225), Rotation.from_euler("z", yaw))
        thing = EntityState(name="target", pose=pose, angular_velocity=(0.0, spin, 0.0))
        return replace(state, entities=(thing, *state.entities[1:]))

    def still(states):
        speeds = [condition.measure.of for condition in at_rest("target")]
        limits = [condition.most for condition in at_rest("target")]
        return [all(of(state) <= most for of, most in zip(speeds, limits, strict=True)) for state in states]

    assert still([at(0, spin=0.5), at(1, spin=0.5), at(2)]) == [False, True, True]  # tick 0 knows of no motion before
    assert still([at(0), at(1, x=0.5005), at(2, x=0.503)]) == [True, True, False]  # 5 mm/s, 25 mm/s
    assert still([at(0), at(1, yaw=0.01), at(2, yaw=0.04)]) == [True, True, False]  # 0.1 rad/s, 0.3 rad/s


def test_a_target_that_fell_off_the_table_is_final():
    lifted = [record(seq, 0.1, fingers=(2.0, 2.0)) for seq in range(2, 12)]
    verdicts = fold([record(0), record(1, -0.4), *lifted])
    assert all(v.failed and v.reason == "fell_off_table" and not v.success for v in verdicts[1:])


def test_a_gap_a_foreign_tick_and_an_unknown_skill_are_refused():
    judge = Judge(TASK)
    with pytest.raises(TaskError) as error:
        judge.step(record(1))
    assert error.value.code == ErrorCode.UNKNOWN_EPISODE
    with pytest.raises(TaskError, match="tick 0"):
        judge.start(record(3))
    judge.start(record(0))
    with pytest.raises(TaskError, match="expected tick 1"):
        judge.step(record(2))
    with pytest.raises(TaskError, match="expected tick 1"):
        judge.step(replace(record(1), episode_id="other"))
    with pytest.raises(TaskError, match="lacks"):
        Judge(TASK).start(replace(record(0), entities=()))
    with pytest.raises(TaskError) as error:
        Judge(replace(TASK, skill="juggle"))
    assert error.value.code == ErrorCode.UNKNOWN_SKILL
