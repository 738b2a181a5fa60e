"""The expert on the cores of planner and sim: it solves the scenes that resetters draw; doing nothing solves none."""

from dataclasses import replace

import numpy as np
import pytest

from roboxim_bringup.cores import CorePlanner
from roboxim_core.actions import hold_action
from roboxim_core.errors import ErrorCode, PolicyError, TaskError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.policies import EpisodeStart, Observation, ObservationWindow
from roboxim_core.poses import Pose
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import EntitySpec
from roboxim_sim.world import World
from roboxim_tasks.config import load_task_config, parse_task_config
from roboxim_tasks.demonstration.expert import Expert
from roboxim_tasks.demonstration.solvable import Solvability
from roboxim_tasks.judging import Judge
from roboxim_tasks.sampling.episodes import EpisodeGenerator

NOISE = np.array([0.004] * 3 + [0.01] * 3 + [0.0])


@pytest.fixture(scope="module")
def library():
    return ModelLibrary()


@pytest.fixture(scope="module")
def world(library):
    with World(library) as made:
        yield made


@pytest.fixture(scope="module")
def generator(library):
    return EpisodeGenerator(library)


class CountingPlanner(CorePlanner):
    """Counts the paths that it checks."""

    checks = 0

    def check_path(self, path, period_s, around):
        self.checks += 1
        return super().check_path(path, period_s, around)


@pytest.fixture(scope="module")
def expert(library):
    return Expert(library, CorePlanner(library))


def draw(generator, index, config="pick_cube_distractors"):
    seed = SeedPath(run_seed=11, purpose="test", index=index)
    return seed, generator.draw(seed, load_task_config(config))


def window(state):
    observation = Observation(seq=state.seq, stamp_ns=state.stamp_ns, state=state)
    return ObservationWindow(
        instruction="", observations=[observation], pad_mask=(True,), episode_id=state.episode_id, seq=state.seq
    )


def start(expert, drawn, episode_id):
    expert.reset(
        EpisodeStart(
            episode_id=episode_id, instruction=drawn.task.instruction, seed=5, task=drawn.task, scene=drawn.scene
        )
    )


def run(world, drawn, act, *, settle=10):
    """Run one episode; return its last verdict and its records."""
    records = [world.load(drawn.scene, "e")]
    judge = Judge(drawn.task)
    verdict = judge.start(records[0])
    try:
        for _ in range(drawn.max_steps):
            action, done = act(records[-1])
            records.append(world.tick(records[-1].seq + 1, action))
            verdict = judge.step(records[-1])
            if verdict.success or verdict.failed or done:
                break
        for _ in range(settle):
            records.append(world.tick(records[-1].seq + 1, hold_action(records[-1].robot.gripper_command)))
            verdict = judge.step(records[-1])
    finally:
        world.release("e")
    return verdict, records


def expert_act(expert, rng=None):
    def act(state):
        chunk = expert.act(window(state))
        noise = rng.normal(size=7) * NOISE if rng is not None and chunk.phases == ("free",) else 0.0
        return (chunk.actions[0] + noise).astype(np.float32), chunk.done

    return act


@pytest.mark.parametrize("noisy", [False, True], ids=["clean", "noisy"])
@pytest.mark.thorough
def test_the_expert_picks_every_cube_at_its_first_try(world, generator, expert, noisy):
    for index in range(10 * noisy, 10 * noisy + 10):
        seed, drawn = draw(generator, index)
        start(expert, drawn, "e")
        verdict, records = run(world, drawn, expert_act(expert, seed.rng("execution_noise") if noisy else None))
        assert verdict.success, (index, verdict)
        assert verdict.predicates["lift_m"] > 0.09
        assert 30 <= len(records) - 11 <= 60
        assert not any(record.clipped or record.left_workspace for record in records)
        for name in (entity.name for entity in drawn.scene.entities if entity.name != "target"):
            moved = np.subtract(records[-1].entity(name).pose.position, records[0].entity(name).pose.position)
            assert np.linalg.norm(moved) < 0.005


def test_a_scene_is_planned_once_and_the_expert_acts_the_same_without_the_resets_solution(world, library):
    planner = CountingPlanner(library)
    solvability = Solvability(library, planner)
    seed = SeedPath(run_seed=11, purpose="test", index=4)
    drawn = EpisodeGenerator(library, solvability).draw(seed, load_task_config("place_on"))
    state, answers, checks = world.load(drawn.scene, "e"), [], []
    for shared in (solvability, None):
        expert = Expert(library, planner, solvability=shared)
        expert.reset(
            EpisodeStart(
                episode_id="e", instruction="", seed=seed.derived_seed("policy"), task=drawn.task,
                scene=replace(drawn.scene, cameras=()),
            )
        )  # fmt: skip
        before = planner.checks
        answers.append(expert.act(window(state)).actions.tobytes())
        checks.append(planner.checks - before)
    world.release("e")
    assert answers[0] == answers[1]
    moving = sum(stage.pose is not None for stage in solvability.solution(*_asked(drawn, seed)).stages)
    assert 0 < checks[0] <= 2 * moving, "with and without clearance"
    assert checks[1] > checks[0]


def _asked(drawn, seed):
    return drawn.task, drawn.scene, seed.derived_seed("policy")


def test_a_scene_that_settles_differently_is_replanned(world, generator, expert):
    _, drawn = draw(generator, 5)
    start(expert, drawn, "e")
    state = world.load(drawn.scene, "e")
    world.release("e")
    target = state.entity("target").pose
    x, y, z = target.position
    elsewhere = replace(target, position=(x + 0.004, y, z))
    moved = replace(
        state, entities=tuple(replace(e, pose=elsewhere) if e.name == "target" else e for e in state.entities)
    )
    reached = []
    for at in (state, moved):
        start(expert, drawn, "e")
        expert.act(window(at))
        descend = next(stage for stage in expert._solution.stages if stage.name == "descend")
        reached.append(descend.pose.position[0])
    assert reached[1] - reached[0] == pytest.approx(0.004, abs=1e-4)


@pytest.mark.thorough
def test_the_expert_is_smooth_and_the_same_every_time(world, generator, expert):
    _, drawn = draw(generator, 3)
    hashes = []
    for _ in range(2):
        start(expert, drawn, "e")
        _, records = run(world, drawn, expert_act(expert))
        hashes.append([record.state_hash for record in records])
    assert hashes[0] == hashes[1]
    deltas = np.array([record.action_executed[:6] for record in records[1:-10]])
    assert np.abs(np.diff(deltas[:, :3], axis=0)).max() < 0.008
    assert np.linalg.norm(deltas[:, :3], axis=1).max() <= 0.0205
    assert np.linalg.norm(deltas[:, 3:], axis=1).max() <= 0.085


def test_doing_nothing_solves_nothing(world, generator):
    for index in range(3):
        _, drawn = draw(generator, index)
        verdict, _ = run(world, replace(drawn, max_steps=20), lambda state: (hold_action(1.0), False), settle=0)
        assert not verdict.success_ever
        assert verdict.reason == "not_grasped"


WALLED = """
reset:
  robot: {position: {values: [[0.5, 0.26, 0.15]]}}
  objects: {area: {values: [[0.5, -0.14]]}, yaw_rad: {values: [0.1]}}
"""


def test_the_expert_avoids_obstacles_on_its_path(world, generator, expert):
    drawn = generator.draw(SeedPath(run_seed=11, purpose="test", index=0), parse_task_config(WALLED))
    tower = tuple(
        EntitySpec(name=f"tower_{level}", model="cube", modifiers={"color": "white", "scale": 1.4}, fixed=True,
                   pose=Pose(position=(0.5, 0.06, 0.0315 + 0.063 * level)))
        for level in range(3)
    )  # fmt: skip
    blocked = replace(drawn, scene=replace(drawn.scene, entities=(*drawn.scene.entities, *tower)))
    start(expert, blocked, "e")
    verdict, records = run(world, blocked, expert_act(expert))
    assert verdict.success, verdict
    beside = [p for p in (r.robot.pose_tcp_measured.position for r in records) if abs(p[1] - 0.06) < 0.05]
    assert all(abs(x - 0.5) > 0.05 or z > 0.19 for x, _, z in beside)
    for record in records:
        assert not any("robot" in (c.body_a, c.body_b) and "tower" in c.body_a + c.body_b for c in record.contacts)


def test_unsolvable_scenes_fail_the_episode_with_a_reason(world, generator, expert):
    _, drawn = draw(generator, 0, "pick_cube")
    far = replace(drawn.scene.entities[0], pose=Pose(position=(0.9, 0.6, 0.0225)))
    unreachable = replace(drawn, scene=replace(drawn.scene, entities=(far,)))
    start(expert, unreachable, "e")
    with pytest.raises(PolicyError, match="no motion for 'Pick up the"):
        run(world, unreachable, expert_act(expert))
    with pytest.raises(TaskError) as error:
        expert.reset(EpisodeStart(episode_id="e", instruction="", seed=0))
    assert error.value.code == ErrorCode.NO_EXPERT
    start(expert, drawn, "another")
    with pytest.raises(TaskError, match="not reset for episode 'e'"):
        run(world, drawn, expert_act(expert))


HEAVY_TRAY = """
skill: place_left_of
objects:
  reference: {models: {values: [cube]}}
  target: {models: {values: [tray]}, modifiers: {mass: {values: [1.8]}}}
distractors: {minimum: 0, maximum: 0}
reset:
  objects:
    roles: {reference: {area: {values: [[0.48, 0.05]]}}, target: {area: {values: [[0.5, -0.2]]}}}
    yaw_rad: {values: [1.2]}
"""


@pytest.mark.thorough
def test_a_sagging_object_is_carried_as_it_hangs_and_put_down_level(world, generator, expert):
    seed = SeedPath(run_seed=11, purpose="test", index=0)
    drawn = generator.draw(seed, parse_task_config(HEAVY_TRAY))
    start(expert, drawn, "e")
    verdict, records = run(world, drawn, expert_act(expert))
    assert verdict.success, verdict
    tilts = [np.arccos(min(1.0, record.entity("target").pose.rotation.as_matrix()[2, 2])) for record in records]
    release = next(i for i in range(len(records) - 1, 0, -1) if records[i].robot.gripper_command < 0.1)
    assert max(tilts) > np.radians(6)
    assert tilts[release - 1] < np.radians(2)
    moved = np.subtract(records[-1].entity("reference").pose.position, records[0].entity("reference").pose.position)
    assert np.linalg.norm(moved) < 0.002
