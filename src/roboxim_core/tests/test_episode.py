"""The episode loop: when an episode begins, what it records, and how it ends."""

from dataclasses import replace

import numpy as np
import pytest
from plain_ports import Actor, World, run
from scipy.spatial.transform import Rotation

from roboxim_core.actions import ActionSemantics
from roboxim_core.episode import EpisodeRunner, Ports, RunConfig
from roboxim_core.errors import SimError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.policies import RECOVERY, ActionChunk
from roboxim_core.poses import Pose
from roboxim_core.seeds import CELL, CELL_NUMBER
from roboxim_core.specs import EntitySpec
from roboxim_core.state import EntityState
from roboxim_core.verdicts import Verdict


def test_success_is_judged_after_settling_and_every_tick_is_recorded():
    world = World()
    result = run(world, Actor()).run_index(0)
    assert (result.outcome, result.steps, result.last_seq) == ("success", 3, 5)
    assert [step.phase for step in world.steps] == ["start", "act", "act", "act", "settle", "settle"]
    assert [step.seq for step in world.steps] == list(range(6))
    assert world.executed[-1].tolist() == [0, 0, 0, 0, 0, 0, 0.25], "settling holds the commanded gripper"
    assert result.bag == "keep/eval-0-00000-0"


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 20.0])
def test_settling_takes_a_second_at_any_rate(rate_hz):
    world = World(goal=1.0)
    run(world, Actor(semantics=ActionSemantics(rate_hz=rate_hz)), rate_hz=rate_hz, settle_ticks=0).run_index(0)
    assert [step.phase for step in world.steps].count("settle") == rate_hz


def test_what_slides_away_while_settling_is_a_failure():
    result = run(World(slides_back=True), Actor(), keep="successful").run_index(0)
    assert (result.outcome, result.reason, result.success_ever) == ("failure", "not_there", True)
    assert result.bag.startswith("set_apart/")


@pytest.mark.parametrize(("keep", "outcome"), [("successful", "success"), ("first_try", "failure")])
def test_a_second_grasp_is_no_first_try(keep, outcome):
    action = np.array([[1.0, 0, 0, 0, 0, 0, 1.0]], np.float32)
    actor = Actor(lambda window: ActionChunk(actions=action, phases=(RECOVERY,)))
    result = run(World(), actor, keep=keep, max_attempts=3).run_index(0)
    assert (result.outcome, result.recovered) == (outcome, True)
    assert (result.attempt, result.reason) == ((0, "") if outcome == "success" else (2, "recovered"))
    assert result.bag.startswith("keep/" if outcome == "success" else "set_apart/")


def test_seeds_of_a_cell_are_those_of_its_number_at_any_index():
    class Mixed(World):
        def draw(self, seed, task_config):
            draw = super().draw(seed, task_config)
            return replace(draw, task=replace(draw.task, drawn={CELL: "a", CELL_NUMBER: "3"}))

    def policy_seed(world, index):
        actor = Actor()
        run(world, actor).run_index(index)
        return actor.starts[0].seed

    assert policy_seed(Mixed(), 0) == policy_seed(Mixed(), 5)
    assert policy_seed(World(), 0) != policy_seed(World(), 5)


def test_limit_of_steps():
    result = run(World(goal=100), Actor()).run_index(0)
    assert (result.outcome, result.reason, result.steps) == ("failure", "not_there", 8)


def test_a_simulators_fault_halts_and_drops_the_bag():
    world = World()
    world.tick = lambda *_: (_ for _ in ()).throw(SimError("exploded"))
    with pytest.raises(SimError, match="exploded"):
        run(world, Actor()).run_index(0)
    assert world.log == ["open", "abort", "release"]


def test_attempts_are_drawn_anew_until_one_is_kept():
    world = World()
    world.infeasible_attempts = 2
    result = run(world, Actor(), max_attempts=3).run_index(4)
    assert (result.outcome, result.attempt, result.episode_id) == ("success", 2, "eval-0-00004-2")
    result = run(world, Actor(), max_attempts=1).run_index(4)
    assert (result.outcome, result.reason) == ("error", "reset_infeasible")


def at(x=0.0, y=0.0, z=0.0, tilt_deg=0.0):
    return Pose.from_arrays((x, y, z), Rotation.from_euler("x", tilt_deg, degrees=True))


@pytest.mark.parametrize(
    ("now", "found"),
    [
        ({"pose": at(0.0015, 0.0, 0.0)}, ""),
        ({"pose": at(z=-0.008)}, ""),
        ({"pose": at(0.002, 0.002)}, "moved by 3 mm"),
        ({"pose": at(z=0.004)}, "moved by 4 mm"),
        ({"pose": at(z=-0.3)}, "moved by 300 mm"),
        ({"pose": at(tilt_deg=3.0)}, "3 deg"),
        ({"linear_velocity": (0.03, 0.0, 0.0)}, "30 mm/s"),
        ({"angular_velocity": (0.0, 0.0, 0.5)}, "0.50 rad/s"),
        ({"joint_names": ("lid",), "joint_positions": (0.3,)}, "'lid' at 0.300 instead of 0.500"),
    ],
)
def test_an_episode_begins_only_when_everything_rests_where_it_was_put(now, found):
    world = World()
    world.entities = (EntitySpec(name="can", model="soda_can", joint_positions={"lid": 0.5}),)
    world.settled = (EntityState(**{"name": "can", **now}),)
    result = run(world, Actor(), max_attempts=2).run_index(0)
    if not found:
        assert result.outcome == "success"
        return
    assert (result.outcome, result.reason, result.attempt) == ("error", "reset_infeasible", 1), "drawn again"
    assert "can_unsettled" in result.message
    assert found in result.message
    assert (result.skill, result.instruction, result.bag) == ("go", "go 0", "")
    assert world.log == ["open", "abort", "release"] * 2, "its bag is dropped"
    assert world.executed == []


@pytest.mark.parametrize("held", [True, False])
def test_an_episode_that_is_solved_already_does_not_begin_however_long_it_must_stay_so(held):
    world, actor = World(), Actor()
    world.begins_at, world.held = 3.0, held
    result = run(world, actor).run_index(0)
    assert (result.outcome, result.reason, result.success_ever) == ("error", "reset_infeasible", False)
    assert "not_solved_already" in result.message
    assert actor.starts == []


def test_an_episode_that_has_failed_already_does_not_begin():
    world = World()
    world.judge = lambda state: Verdict(failed=True, reason="fell_off_table")
    result = run(world, Actor()).run_index(0)
    assert (result.outcome, result.reason) == ("error", "reset_infeasible")
    assert "not_failed_already" in result.message
    assert "fell_off_table" in result.message


@pytest.mark.parametrize("leaves_at", [2, 3])
def test_leaving_the_workspace_is_no_success_whatever_settles_afterwards(leaves_at):
    world = World(goal=3.0)
    world.leaves_at = leaves_at
    world.tick, tick = lambda e, seq, action: tick(e, seq, np.array([1.0, *action[1:]])), world.tick
    result = run(world, Actor()).run_index(0)
    assert (result.outcome, result.reason, result.steps) == ("failure", "left_workspace", leaves_at)
    assert result.success_ever, "it came to rest where it should"


def test_leaving_the_workspace_with_the_last_action_counts():
    world = World(goal=100)
    world.leaves_at = 8
    assert run(world, Actor()).run_index(0).reason == "left_workspace"


def test_cancelling_drops_the_bag():
    world = World(goal=100)
    with pytest.raises(Exception, match="cancelled"):
        run(world, Actor()).run_index(0, cancelled=lambda: len(world.steps) > 3)
    assert "abort" in world.log


def test_the_hashes_of_robot_and_objects_are_in_every_episodes_record():
    world, library = World(), ModelLibrary()
    world.entities = tuple(EntitySpec(name=name, model="cube") for name in ("a", "b"))
    ports = Ports(scenes=world, sim=world, actor=Actor(), judge=world, recorder=world, clock=lambda: 0.0)
    runner = EpisodeRunner(
        ports, RunConfig(output_dir="/out", settle_ticks=2), versions={"numpy": "2"}, library=library
    )
    runner.run_index(0)
    models = world.info.models
    assert world.info.versions == {"numpy": "2"}
    assert models == {"panda": library.digest("panda"), "cube": library.digest("cube")}
    assert library.changed(models) == ()
    assert library.changed({**models, "cube": "another", "gone": "1"}) == ("cube", "gone")
