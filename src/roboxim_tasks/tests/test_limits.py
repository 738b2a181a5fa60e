"""Measures beside success: what they are, and that success changes by them only where the task says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from roboxim_core.errors import ConfigError
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import PhysicalObject, TaskSpec
from roboxim_core.state import Contact, EntityState, Pose, RobotState, StateRecord
from roboxim_tasks.config import parse_task_config
from roboxim_tasks.limits import KeepOut, Limits, LimitsConfig, course_of, limits_of, log_dimensionless_jerk
from roboxim_tasks.sampling.episodes import EpisodeGenerator

TICK_S = 0.1
CUBE = PhysicalObject(entity="cube", model="cube", name="cube")
TASK = TaskSpec(
    skill="pick_up", instruction="Pick up the cube",
    objects={"target": CUBE, "distractor_1": replace(CUBE, entity="other")},
)  # fmt: skip


def minimum_jerk(ticks: int, length_m: float = 0.4) -> np.ndarray:
    s = np.linspace(0.0, 1.0, ticks)[:, None]
    return (10 * s**3 - 15 * s**4 + 6 * s**5) * np.array([[length_m, 0.0, 0.0]])


def state(seq: int, x: float, *contacts: tuple[str, float]) -> StateRecord:
    pose = Pose(position=(x, 0.0, 0.3))
    robot = RobotState(
        joint_names=(), joint_positions=(), joint_velocities=(), joint_commands=(), pose_tcp_measured=pose,
        pose_tcp_commanded=pose, gripper_opening=1.0, gripper_command=1.0,
    )  # fmt: skip
    touched = tuple(
        Contact(body_a=name, link_a="", body_b="robot", link_b="finger", force_last=force, force_max=force)
        for name, force in contacts
    )
    entities = tuple(EntityState(name=name, pose=Pose(position=(0.9, 0.0, 0.05))) for name in ("cube", "other"))
    return StateRecord(
        episode_id="e", seq=seq, stamp_ns=round(seq * TICK_S * 1e9), robot=robot, entities=entities, contacts=touched
    )


def measured(limits: LimitsConfig, *states: StateRecord):
    fold = Limits(limits, TASK)
    return [fold.assess(one) for one in states][-1]


STATES = (state(0, 0.0), state(1, 0.05), state(2, 0.08, ("cube", 12.0)), state(3, 0.08, ("other", 3.0), ("cube", 1.0)))


def test_measures_are_of_the_whole_episode():
    found = measured(LimitsConfig(keep_out=(KeepOut(lower=(0.06, -1, 0), upper=(0.5, 1, 1)),)), *STATES)
    assert found.solved
    assert found.predicates["limits.force_max_n"] == 12.0
    assert found.predicates["limits.speed_max_m_s"] == pytest.approx(0.5)
    assert found.predicates["limits.path_m"] == pytest.approx(0.08)
    assert found.predicates["limits.distractors_touched"] == 1.0
    assert found.predicates["limits.keep_out_s"] == pytest.approx(0.2)
    assert found.predicates["limits.crossed"] == 1.0


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        ({"force_n": 11.0}, "too_much_force"),
        ({"speed_m_s": 0.4}, "too_fast"),
        ({"path_m": 0.07}, "path_too_long"),
        ({"distractors": 0}, "touched_distractors"),
        ({"keep_out": (KeepOut(lower=(0.8, -1, 0), upper=(1, 1, 0.1)),)}, "in_keep_out"),  # the touched cube's place
    ],
)
def test_a_crossed_limit_fails_only_where_the_task_says_so(limits, reason):
    only_measured = measured(LimitsConfig(**limits), *STATES)
    assert (only_measured.solved, only_measured.failed, only_measured.reason) == (True, False, "")
    assert only_measured.predicates["limits.crossed"] == 1.0
    failed = measured(LimitsConfig(**limits, fail=True), *STATES)
    assert (failed.solved, failed.failed, failed.reason) == (False, True, reason)


def test_an_elbow_in_a_volume_counts_while_the_tool_is_outside():
    arm = ArmKinematics(ModelLibrary().robot("panda"))
    home, base = arm.model.home, Pose(position=(0.1, 0.2, 0.0))
    elbow, tcp = (base @ pose for pose in (arm.link_poses(home)["panda_link4"], arm.fk(home)))
    around = KeepOut(lower=tuple(np.subtract(elbow.position, 0.05)), upper=tuple(np.add(elbow.position, 0.05)))
    above = KeepOut(lower=(-1.0, -1.0, 1.2), upper=(1.0, 1.0, 1.4))

    def at(seq: int) -> StateRecord:
        robot = replace(STATES[0].robot, joint_positions=home, finger_positions=(0.04, 0.04), pose_tcp_measured=tcp)
        return replace(STATES[0], seq=seq, stamp_ns=round(seq * TICK_S * 1e9), robot=robot)

    for box, robot, inside_s in ((around, "panda", 0.1), (around, "", 0.0), (above, "panda", 0.0)):
        found = measured(LimitsConfig(keep_out=(box,), robot=robot), at(0), at(1))
        assert found.predicates["limits.keep_out_s"] == pytest.approx(inside_s)


def test_a_task_that_keeps_out_names_its_arm():
    drawn = SeedPath(run_seed=1, purpose="eval", index=0)
    text = "skill: pick_up\nrobot: fr3\nlimits: {keep_out: [{lower: [0, 0, 0.4], upper: [1, 1, 1]}]}"
    limits = limits_of(EpisodeGenerator(ModelLibrary()).task(drawn, parse_task_config(text)))
    assert limits is not None
    assert limits.robot == "fr3"


def test_smoothness_of_a_minimum_jerk_motion_is_known():
    """Test against the closed form: of the whole motion it is -ln(720 / 1.875^2) = -5.32, of its faster part less."""
    s = np.linspace(0.0, 1.0, 100_001)
    speed, jerk = 30 * s**2 - 60 * s**3 + 30 * s**4, 60 - 360 * s + 360 * s**2
    fast = speed > 0.05 * speed.max()
    of_fast = fast.mean() ** 3 / 1.875**2 * (jerk[fast] ** 2).mean() * fast.mean()
    assert log_dimensionless_jerk(minimum_jerk(2001), 0.001) == pytest.approx(-np.log(of_fast), abs=0.02)
    assert -np.log((jerk**2).mean() / 1.875**2) == pytest.approx(-np.log(720 / 1.875**2), abs=0.001)


def test_smoothness_does_not_depend_on_speed_and_size_and_falls_with_tremor():
    smooth = minimum_jerk(101)
    assert log_dimensionless_jerk(3 * smooth, 0.02) == pytest.approx(log_dimensionless_jerk(smooth, 0.01))
    tremor = smooth + 0.002 * np.sin(np.arange(101))[:, None]
    assert log_dimensionless_jerk(tremor, 0.01) < log_dimensionless_jerk(smooth, 0.01) - 2


def test_nothing_that_moves_has_no_smoothness():
    assert course_of(np.zeros((9, 3)), np.arange(9) * TICK_S).smoothness == 0.0
    assert course_of(np.zeros((1, 3)), np.zeros(1)).path_m == 0.0


def test_limits_of_a_file_reach_the_task_and_others_have_none():
    drawn = SeedPath(run_seed=1, purpose="eval", index=0)
    plain, limited = (
        EpisodeGenerator(ModelLibrary()).task(drawn, parse_task_config(f"skill: pick_up{more}"))
        for more in ("", "\nlimits: {force_n: 20, fail: true}")
    )
    assert limits_of(plain) is None
    assert limits_of(limited) == LimitsConfig(force_n=20.0, fail=True)
    assert replace(limited, arguments=plain.arguments) == plain


@pytest.mark.parametrize(
    "wrong", ["{fail: true}", "{force_n: -1}", "{forces: 3}", "{keep_out: [{lower: [0, 0, 0], upper: [1, 0, 1]}]}"]
)
def test_wrong_limits_are_refused(wrong):
    with pytest.raises(ConfigError, match="limits|keep_out"):
        parse_task_config(f"skill: pick_up\nlimits: {wrong}")
