"""How a policy acts in the episode loop: what it is asked, and what is executed of its answers."""

import math
from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from plain_ports import ROBOT, Actor, World, run

from roboxim_core.actions import ActionSemantics, GripperRule
from roboxim_core.episode import EpisodeRunner, Ports, RunConfig
from roboxim_core.errors import ErrorCode, EvaluationError, InvalidRequestError, PolicyError
from roboxim_core.policies import ActionChunk, CameraRequirement, Observation


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"ensemble": "meen"}, "unknown value 'meen'.*mean"),
        ({"ensemble": "exponential"}, "needs a decay other than 0"),
        ({"ensemble_decay": 0.1}, "needs ensemble 'exponential'"),
        ({"late_rows": "skip"}, "late_rows|unknown value 'skip'"),
    ],
)
def test_a_runs_chunking_is_checked_before_anything_starts(values, message):
    with pytest.raises(InvalidRequestError, match=message):
        RunConfig(**values)


@pytest.mark.parametrize("rate_hz", [3.0, 15.0])
def test_a_policy_runs_at_its_own_rate_for_the_same_time(rate_hz):
    world = World(goal=100.0)
    result = run(world, Actor(semantics=ActionSemantics(rate_hz=rate_hz))).run_index(0)
    assert world.scene.control_rate_hz == world.info.semantics.rate_hz == rate_hz
    assert result.steps == math.ceil(0.8 * rate_hz), "8 steps at the task's 10 Hz"


def test_other_meanings_of_end_effector_actions_are_converted_tick_by_tick():
    rotation = [0.0, 0.0, 0.0, 1.0]
    semantics = ActionSemantics(
        control="end_effector_absolute", rotation="quaternion_xyzw", gripper="absolute_open_minus_1_closed_1"
    )
    actor = Actor(act=lambda window: np.array([[0.03, 0.0, 0.01, *rotation, 1.0]]), semantics=semantics)
    world = World(goal=0.02)
    assert run(world, actor).run_index(0).outcome == "success"
    np.testing.assert_allclose(world.executed[0], [0.03, 0, 0.01, 0, 0, 0, 0], atol=1e-7)
    assert world.info.semantics == world.semantics == ActionSemantics(), "the executed meaning is recorded"
    assert world.steps[1].action_label == tuple(world.executed[0].tolist())


def test_repeated_actions_are_executed_as_they_are_and_then_the_actor_acts():
    semantics = ActionSemantics(gripper="absolute_open_0_closed_1")
    actor = Actor(semantics=semantics, gripper=GripperRule(binary=True, band=0.2), lag=(0.5,) * 6, window=2)
    repeated = [(0.5, 0.0, 0.0, 0.0, 0.0, 0.0, opening) for opening in (0.45, 1.0)]
    world = World(goal=100.0)
    runner = run(world, actor, max_steps=4, latency_ticks=1, repeat=repeated)
    assert runner.run_index(0).steps == 4
    np.testing.assert_allclose(world.executed[:2], repeated, atol=1e-7)
    assert world.steps[1].action_label == pytest.approx(repeated[0])
    assert [window.seq for window in actor.windows] == [2, 3]
    assert [observation.seq for observation in actor.windows[0].observations] == [1, 2]
    assert world.executed[3][6] == 0.0, "the actor's own answers are converted"


def test_the_grippers_rule_applies_to_the_executed_opening_and_a_run_may_set_it():
    openings = iter([0.45, 0.3, 0.45, 0.3, 0.2, 0.1])
    act = lambda window: np.array([[0, 0, 0, 0, 0, 0, 1 - 2 * next(openings)]])  # noqa: E731
    semantics = ActionSemantics(gripper="absolute_open_minus_1_closed_1")
    world = World(goal=100.0)
    run(world, Actor(act=act, semantics=semantics), gripper_band=0.2, gripper_agree=2, max_steps=6).run_index(0)
    assert [row[6] for row in world.executed[:6]] == [0.25, 0.25, 0.25, 0.25, 0.0, 0.0]


def test_numbers_that_are_no_rotation_fail_the_episode():
    actor = Actor(act=lambda window: np.zeros((1, 8)), semantics=ActionSemantics(rotation="quaternion_wxyz"))
    result = run(World(), actor).run_index(0)
    assert (result.outcome, result.reason) == ("error", "invalid_action")


def test_latency_holds_until_the_first_answer_and_is_named_in_the_result():
    world = World(goal=100.0)
    rows = iter(range(1, 100))
    actor = Actor(act=lambda window: np.array([[next(rows), 0, 0, 0, 0, 0, 1.0]]))
    result = run(world, actor, latency_ticks=3, max_steps=6).run_index(0)
    assert [row[0] for row in world.executed[:6]] == [0, 0, 0, 1, 2, 3]
    assert (result.timing, result.held, result.delay_ticks) == ("lockstep, 3 ticks late", 3, 3.0)
    assert [window.seq for window in actor.windows] == list(range(6)), "the policy is asked at every tick"


class Gripping(World):
    """Its robot states the opening that it was commanded to."""

    def tick(self, episode_id, seq, action):
        state = super().tick(episode_id, seq, action)
        return replace(state, robot=replace(ROBOT, gripper_command=float(action[-1])))


@pytest.mark.parametrize(
    "changes", [{}, {"execute": 1}, {"ensemble": "mean"}, {"execute": 2, "latency_ticks": 1}, {"latency_ticks": 3}]
)
def test_a_request_names_the_gripper_command_that_was_executed_before_it(changes):
    """Whatever was executed of the answers: cut, averaged or late."""
    world, rng = Gripping(goal=100.0), np.random.default_rng(0)
    actor = Actor(act=lambda window: np.column_stack([np.zeros((4, 6)), rng.uniform(size=4)]), horizon=4)
    run(world, actor, max_steps=12, **changes).run_index(0)
    assert [window.commanded_opening for window in actor.windows] == [
        None if window.seq == 0 else world.executed[window.seq - 1][-1] for window in actor.windows
    ]
    assert len(actor.windows) > 2


def test_in_real_time_the_world_goes_on_while_the_policy_thinks():
    world, clock = World(goal=100.0), [0.0]

    def think(window):
        clock[0] += 0.25 if len(actor.windows) > 1 else 60.0
        return np.array([[window.seq + 1.0, 0, 0, 0, 0, 0, 1.0]] * 2)

    actor = Actor(act=think, horizon=2)
    ports = Ports(scenes=world, sim=world, actor=actor, judge=world, recorder=world, clock=lambda: clock[0])
    runner = EpisodeRunner(ports, RunConfig(output_dir="/out", settle_ticks=2, real_time=True, max_steps=9))
    result = runner.run_index(0)
    assert len(actor.starts) == 2, "a first request of 60 s, which loads the model, is not counted"
    assert [window.seq for window in actor.windows[1:]] == [0, 5]
    assert [row[0] for row in world.executed[:9]] == [0, 0, 0, 1, 1, 0, 0, 0, 6]
    assert (result.timing, result.held, result.delay_ticks) == ("real time", 6, 3.0)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (np.array([[np.nan] * 7]), "invalid_action"),
        (np.zeros((1, 6)), "invalid_action"),
        (PolicyError("late", ErrorCode.POLICY_LATE), "policy_late"),
    ],
)
def test_a_policys_fault_fails_that_episode_by_reason(bad, reason):
    def act(window):
        if isinstance(bad, Exception):
            raise bad
        return bad

    world = World()
    runner = run(world, Actor(act))
    result = runner.run_index(0)
    assert (result.outcome, result.reason) == ("error", reason)
    assert world.closed[0][0].reason == reason
    assert "release" in world.log


def test_window_is_padded_with_the_first_frame():
    actor = Actor(window=3, cameras=(CameraRequirement(name="workspace"),))
    run(World(), actor).run_index(0)
    first, second = actor.windows[:2]
    assert first.pad_mask == (False, False, True)
    assert [o.seq for o in first.observations] == [0, 0, 0]
    assert second.pad_mask == (False, True, True)
    assert [int(o.images["workspace"][0, 0, 0]) for o in second.observations] == [0, 0, 1]


def test_chunks_are_executed_as_configured():
    chunk = np.zeros((4, 7), np.float32)
    chunk[:, 0] = 0.5
    actor = Actor(lambda window: chunk, horizon=4)
    run(World(goal=2.0), actor, execute=2).run_index(0)
    assert [window.seq for window in actor.windows] == [0, 2]


def test_only_a_privileged_actor_sees_state_task_and_scene():
    blind, expert = Actor(), Actor(privileged=True)
    run(World(), blind).run_index(0)
    run(World(), expert).run_index(0)
    assert all(o.state is None for w in blind.windows for o in w.observations)
    assert (blind.starts[0].task, blind.starts[0].scene) == (None, None)
    assert all(o.state is not None for w in expert.windows for o in w.observations)
    assert expert.starts[0].task is not None


def test_noise_only_where_the_actor_is_free_and_the_label_stays_clean():
    action = np.array([[1.0, 0, 0, 0, 0, 0, 1.0]], np.float32)
    phases = deque(["free", "fine", "fine"])
    actor = Actor(lambda window: ActionChunk(actions=action, phases=(phases.popleft(),)))
    world = World(goal=2.5)
    run(world, actor, noise_translation_m=0.01).run_index(0)
    noisy, fine = world.steps[1], world.steps[2]
    assert noisy.disturbance
    assert noisy.action_label == tuple(action[0].tolist()) != noisy.action_executed
    assert noisy.action_executed[6] == 1.0
    assert not fine.disturbance
    assert fine.action_label == fine.action_executed


def test_noise_on_a_descent_is_the_share_that_the_run_wants():
    action = np.array([[1.0, 0, 0, 0, 0, 0, 1.0]], np.float32)

    def first(share: float):
        phases = deque(["descent", "fine", "fine"])
        actor = Actor(lambda window: ActionChunk(actions=action, phases=(phases.popleft(),)))
        world = World(goal=2.5)
        run(world, actor, noise_translation_m=0.01, noise_descents=share).run_index(0)
        return world.steps[1]

    none, half, whole = first(0.0), first(0.5), first(1.0)
    assert (none.disturbance, half.disturbance, whole.disturbance) == (False, True, True)
    assert none.action_executed == none.action_label
    offsets = [np.subtract(step.action_executed, step.action_label)[:6] for step in (half, whole)]
    np.testing.assert_allclose(2 * offsets[0], offsets[1], atol=1e-6)
    with pytest.raises(InvalidRequestError, match="noise_descents.*1"):
        first(1.5)


def test_size_that_a_policy_states_precedes_the_runs():
    world = World()
    stated = CameraRequirement(name="workspace", width=320, height=240)
    run(world, Actor(cameras=(stated, CameraRequirement(name="wrist"))), image_width=64, image_height=48).run_index(0)
    sizes = {camera.name: (camera.width, camera.height) for camera in world.info.scene.cameras}
    assert sizes == {"workspace": (320, 240), "wrist": (64, 48)}


def test_what_the_run_cannot_give_is_refused_before_the_first_step():
    with pytest.raises(InvalidRequestError, match="no camera 'ceiling'.*workspace"):
        run(World(), Actor(cameras=(CameraRequirement(name="ceiling"),))).run_index(0)
    with pytest.raises(EvaluationError, match="rate_hz: 15.0 against 10.0") as caught:
        run(World(), Actor(semantics=ActionSemantics(rate_hz=15.0)), rate_hz=10.0).run_index(0)
    assert caught.value.code == ErrorCode.SEMANTICS_MISMATCH
    joints = ActionSemantics(control="joint_velocity")
    with pytest.raises(InvalidRequestError, match="joint_velocity.*noise"):
        run(World(), Actor(semantics=joints), noise_translation_m=0.01)
    with pytest.raises(InvalidRequestError, match="'drop' would leave none"):
        run(World(), Actor(), latency_ticks=1, late_rows="drop")


@pytest.mark.parametrize(
    "answer",
    [
        ActionChunk(actions=np.zeros((1, 7), np.float32), phases=("free", "free")),
        ActionChunk(actions=np.zeros((1, 7), np.float32), done=None),
        ActionChunk(actions=[True] * 7),
    ],
)
def test_an_answer_that_no_guard_has_seen_is_checked_by_the_loop(answer):
    result = run(World(), Actor(act=lambda window: answer)).run_index(0)
    assert (result.outcome, result.reason, result.steps) == ("error", "invalid_action", 0)


def test_a_missing_image_is_an_error_by_name():
    world = World()
    world.observe = lambda state, cameras: Observation(seq=state.seq, stamp_ns=0)
    with pytest.raises(EvaluationError, match="wrist"):
        run(world, Actor(cameras=(CameraRequirement(name="wrist"),))).run_index(0)


def test_a_privileged_policy_is_marked_in_every_episode():
    infos = []

    class Noting(World):
        def open(self, info):
            infos.append(info)

    run(Noting(), Actor(version="7")).run_index(0)
    run(Noting(), Actor(version="7", privileged=True)).run_index(0)
    assert [(info.actor, info.actor_version, info.actor_privileged) for info in infos] == [
        ("test", "7", False),
        ("test", "7", True),
    ]
