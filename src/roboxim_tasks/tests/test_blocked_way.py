"""Scenes whose way is blocked: rows across it, what the direct expert is, and that distractors have to stay."""

from dataclasses import replace

import numpy as np
import pytest

from roboxim_core.errors import ConfigError, ErrorCode, TaskError
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.poses import Pose
from roboxim_core.seeds import SeedPath
from roboxim_core.state import StateRecord
from roboxim_tasks.components import COMPONENTS
from roboxim_tasks.config import load_task_config, parse_task_config
from roboxim_tasks.demonstration.solvable import Solvability, state_at_rest
from roboxim_tasks.demonstration.solver import Solver
from roboxim_tasks.judging import Judge
from roboxim_tasks.motion import ExpertScene
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.skills import SKILLS

TASKS = ("pick_up_blocked", "place_on_blocked")


class NoPlanner:
    """Everything is free, nothing can be planned."""

    def __init__(self, problem=""):
        self.problem = problem
        self.asked = 0

    def plan_to_pose(self, *_):
        raise AssertionError("a direct expert asks for no detour")

    def check_path(self, path, period_s, around):
        self.asked += 1
        return self.problem if any(e.name.startswith("distractor") for e in around.scene.entities) else ""


@pytest.mark.parametrize("task", TASKS)
def test_a_row_of_distractors_stands_across_the_way(task, draw, library):
    config = load_task_config(task)
    begin, end = config.reset["blocked_way"].between[0]
    arm = ArmKinematics(library.robot("panda"))
    for index in range(8):
        scene = draw(index, config).scene
        where = {entity.name: np.array(entity.pose.position[:2]) for entity in scene.entities}
        where["tool"] = np.array(arm.fk(scene.robot.joint_positions).position[:2])
        row = np.array([where[f"distractor_{number}"] for number in (1, 2, 3)])
        way = where[end] - where[begin]
        along, across = way / np.linalg.norm(way), np.array([-way[1], way[0]]) / np.linalg.norm(way)
        assert np.all((row - where[begin]) @ along > 0.06)
        assert np.all((where[end] - row) @ along > 0.06)
        assert np.ptp((row - where[begin]) @ along) < 1e-6, "they stand in a line"
        sides = np.sort((row - where[begin]) @ across)
        assert sides[0] < -0.03 < 0.03 < sides[-1], "on both sides of the way"
        assert np.diff(sides).max() < 0.08, "too close for the hand to pass"
        assert [entity.name for entity in scene.entities][-3:] == ["distractor_1", "distractor_2", "distractor_3"]


@pytest.mark.parametrize(("problem", "drawn"), [("hand touches distractor_1", True), ("", False)])
def test_a_scene_whose_direct_way_is_free_is_refused(problem, drawn, library):
    planner = NoPlanner(problem)
    planner.plan_to_pose = lambda *_: np.zeros((2, 7))
    solvability = Solvability(library, planner)
    solvability.refusal = lambda *_: None
    generator = EpisodeGenerator(library, solvability)
    config = replace(load_task_config("pick_up_blocked"), max_draws=5)
    seed = SeedPath(run_seed=3, purpose="test", index=1)
    if drawn:
        assert generator.draw(seed, config).scene
    else:
        with pytest.raises(TaskError, match="way_blocked") as caught:
            generator.draw(seed, config)
        assert caught.value.code == ErrorCode.RESET_INFEASIBLE
    assert planner.asked


def test_the_direct_solver_goes_straight_from_stage_to_stage(draw, library):
    drawn = draw(0, load_task_config("place_on_blocked"))
    arm = ArmKinematics(library.robot("panda"))
    state = state_at_rest(drawn.scene, arm)
    view = ExpertScene(task=drawn.task, scene=drawn.scene, state=state, library=library, direct=True)
    planner = NoPlanner("hand touches distractor_1")
    solver = Solver(library, planner, direct=True)
    solution = solver.solve(view, SKILLS["place_on"].stages(view), 0)
    assert planner.asked == 0
    names = [stage.name for stage in solution.stages]
    assert "rise" not in names, "it does not rise over what stands in the way"
    assert solver.obstruction(view, solution).startswith("approach: hand touches distractor_1")


def test_an_episode_has_failed_once_a_distractor_was_moved(draw, library):
    drawn = draw(0, load_task_config("pick_up_blocked"))
    assert drawn.task.arguments["distractors_stay_m"] == 0.01
    state = replace(state_at_rest(drawn.scene, ArmKinematics(library.robot("panda"))), episode_id="a")
    judge = Judge(drawn.task)
    assert not judge.start(state).failed

    def moved(state: StateRecord, seq: int, x_m: float) -> StateRecord:
        def shifted(entity):
            x, y, z = entity.pose.position
            return replace(entity, pose=Pose(position=(x + x_m, y, z), quat_xyzw=entity.pose.quat_xyzw))

        entities = tuple(shifted(e) if e.name == "distractor_2" else e for e in state.entities)
        return replace(state, seq=seq, entities=entities)

    nudged = judge.step(moved(state, 1, 0.008))
    assert not nudged.failed
    assert nudged.predicates["distractors_shift_m"] == pytest.approx(0.008)
    pushed = judge.step(moved(state, 2, 0.03))
    assert (pushed.failed, pushed.reason) == (True, "disturbed_distractor")
    assert judge.step(moved(state, 3, 0.0)).failed, "it cannot be made good"


def test_a_task_says_what_its_rows_lack(draw):
    text = (
        "skill: pick_up\n"
        "distractors: {{minimum: {0}, maximum: {0}, models: {{values: [lemon]}}}}\n"
        "reset: {{blocked_way: {1}}}"
    )
    with pytest.raises(ConfigError, match="needs 2 distractors"):
        draw(0, parse_task_config(text.format(1, "{}")))
    with pytest.raises(ConfigError, match="no role 'plate'"):
        draw(0, parse_task_config(text.format(2, "{between: [[tool, plate]]}")))
    for role in ("distractor_2", "distractor_4"):
        some = text.format(3, f"{{between: [[tool, {role}]]}}").replace("maximum: 3", "maximum: 4")
        with pytest.raises(ConfigError, match=f"no role '{role}'.*distractor_3"):
            draw(0, parse_task_config(some))
    with pytest.raises(ConfigError, match="row >= 1"):
        COMPONENTS["blocked_way"].Config(row=0)
