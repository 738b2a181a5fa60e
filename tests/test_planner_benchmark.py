"""The referee detects planted faults, problems have the stated properties, and published files are read."""

from __future__ import annotations

import json
import sys
import tarfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
START = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.7, 0.8])
END = np.array([0.9, -0.2, 0.2, -2.0, 0.1, 1.9, 0.5])


@pytest.fixture(scope="module", autouse=True)
def _benchmarks_importable() -> Iterator[None]:
    paths = [str(ROOT), str(ROOT / "benchmarks" / "peers")]
    sys.path[:0] = paths
    yield
    for path in paths:
        sys.path.remove(path)


def quintic(start: np.ndarray, end: np.ndarray, duration: float = 2.0) -> np.ndarray:
    """A smooth motion along the joint line, a sample per millisecond."""
    s = np.arange(round(duration * 1000) + 1) / (duration * 1000)
    return start + (10 * s**3 - 15 * s**4 + 6 * s**5)[:, None] * (end - start)


def judge(positions, solids=(), held=None, goal=END, start=START):
    from benchmarks.planner._referee import Referee

    return Referee(solids, held).judge(positions, (len(positions) - 1) * 1e-3, start, goal)


def test_a_smooth_free_motion_is_valid() -> None:
    from benchmarks.planner._referee import Referee

    assert judge(quintic(START, END)).clean
    assert judge(quintic(START, END), goal=Referee([]).tcp(END)).clean


def test_a_thin_pole_on_the_way_is_hit() -> None:
    from benchmarks.planner._referee import Referee, Solid

    middle = Referee([]).tcp(0.5 * (START + END)).translation
    pole = Solid(kind="cylinder", size=(0.002, 0.05), position=tuple(middle))
    assert judge(quintic(START, END)).clean
    [fault] = judge(quintic(START, END, 0.9), [pole]).faults
    assert "collision" in fault
    assert "#0" in fault


def test_what_is_held_collides_with_obstacles_and_with_the_arm_but_not_with_the_fingers() -> None:
    from benchmarks.planner._referee import Referee, Solid

    tip = Referee([]).tcp(START)
    stick = Solid(kind="box", size=(0.02, 0.02, 0.3), position=(0.0, 0.0, 0.12))
    below = tip.act(np.array([0.0, 0.0, 0.2]))
    ball = Solid(kind="sphere", size=(0.03,), position=tuple(below))
    assert not Referee([ball]).collides(START)
    assert Referee([ball], stick).collides(START)
    assert not Referee([], stick).collides(START)
    long = Solid(kind="box", size=(0.02, 0.02, 0.9), position=(0.0, 0.0, -0.3))
    assert Referee([], long).collides(START)


def test_a_self_collision_is_found() -> None:
    folded = np.array([0.0, 1.7, 0.0, -3.05, 0.0, 0.0, 0.0])
    assert any("collision" in fault for fault in judge(quintic(START, folded, 4.0), goal=folded).faults)


def test_too_fast_is_a_violation() -> None:
    verdict = judge(quintic(START, END, 0.75))
    assert not verdict.faults
    assert any("velocity of joint 1" in line for line in verdict.violations)


def test_a_step_of_acceleration_within_its_limit_breaks_only_the_jerk_limit() -> None:
    times = np.arange(601) * 1e-3
    way = np.where(times < 0.3, times**2, 0.18 - (0.6 - times) ** 2) / 0.18
    for turn, broken in ((0.3, []), (0.4, ["jerk"])):  # at the switch the acceleration steps by turn / 0.09 in 1 ms
        end = START.copy()
        end[1] += turn
        verdict = judge(START + way[:, None] * (end - START), goal=end)
        assert not verdict.faults
        assert [line.split()[0] for line in verdict.violations] == broken


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda q: q + 2e-4, "start"),
        (lambda q: q[:-200], "goal"),
        (lambda q: q[:-200], "rest"),
        (lambda q: np.vstack([q[:500], np.full((1, 7), np.nan), q[501:]]), "not finite"),
    ],
)
def test_a_corrupted_motion_is_detected(spoil, said: str) -> None:
    assert any(said in fault for fault in judge(spoil(quintic(START, END))).faults)


def test_a_goal_missed_by_a_hair_is_caught() -> None:
    from benchmarks.planner._referee import Referee

    goal = Referee([]).tcp(END)
    for off in (pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.0012])), pin.SE3(pin.utils.rotate("x", 0.012), np.zeros(3))):
        assert any("goal" in fault for fault in judge(quintic(START, END), goal=goal * off).faults)


def test_joints_beyond_their_range_and_missing_samples_are_caught() -> None:
    from benchmarks.planner._referee import UPPER, Referee

    end = END.copy()
    end[6] = UPPER[6] + 0.01
    assert "joint range left by 0.01 rad" in judge(quintic(START, end), goal=end).faults
    thin = quintic(START, END)[::10]
    assert any("per millisecond" in fault for fault in Referee([]).judge(thin, 2.0, START, END).faults)


def test_skipping_what_cannot_collide_misses_nothing() -> None:
    from benchmarks.planner._problems import tabletop
    from benchmarks.planner._referee import LOWER, UPPER

    rng = np.random.default_rng(3)
    referee = tabletop(0).referee()
    for _ in range(6):
        ends = rng.uniform(LOWER, UPPER, (2, 7))
        path = ends[0] + np.linspace(0.0, 1.0, 400)[:, None] * (ends[1] - ends[0])
        expected = next((i for i, q in enumerate(path) if referee.collides(q)), -1)
        assert referee.first_collision(path) == expected


def test_tabletop_problems_have_the_stated_properties() -> None:
    from benchmarks.planner._problems import tabletop

    problems = [tabletop(seed) for seed in range(20)]
    assert sum(p.detour for p in problems) >= 10
    assert all(p.detour for p in problems[::2])
    assert {p.held is not None for p in problems} == {True, False}
    for p in problems:
        assert 3 <= len(p.solids) - 1 <= 10
        assert not p.referee().collides(np.array(p.start))
    assert tabletop(3) == problems[3]
    assert tabletop(3, salt=1) != problems[3]


def test_every_hard_family_gives_problems() -> None:
    from benchmarks.planner._problems_hard import FAMILIES, hard

    for family in FAMILIES:
        p = hard(family, 1)
        assert p.family == family
        assert p == hard(family, 1)
        assert not p.referee().collides(np.array(p.start))


def test_the_search_distinguishes_solvable_from_enclosed_goals() -> None:
    from benchmarks.planner._exhaustive import is_solvable
    from benchmarks.planner._problems import problem, tabletop
    from benchmarks.planner._referee import Referee, Solid

    assert is_solvable(tabletop(1), 10.0)
    # walls between here and there that begin close to the base, and a roof that keeps the arm from standing upright
    turn = (0.0, 0.0, np.sin(np.pi / 8), np.cos(np.pi / 8))
    walls = [
        Solid(kind="box", size=(2.0, 0.02, 3.0), position=(side * 0.792, side * 0.792, 1.5), quat_xyzw=turn)
        for side in (-1.0, 1.0)
    ]
    roof = Solid(kind="box", size=(3.0, 3.0, 0.02), position=(0.0, 0.0, 0.85))
    referee = Referee([*walls, roof])
    here = np.array([0.0, 0.6, 0.0, -1.5, 0.0, 2.0, 0.8])
    there = here + [np.pi / 2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert not referee.collides(here)
    assert not referee.collides(there)
    assert not is_solvable(problem("walled-0", referee, here, there, joints=True), 1.0)


SCENE = {
    "world": {
        "collision_objects": [
            {
                "header": {"frame_id": "panda_link0"},
                "id": "shelf",
                "primitives": [{"type": "box", "dimensions": [0.4, 0.6, 0.02]}],
                "primitive_poses": [{"position": [0.7, 0.0, 0.2], "orientation": [0, 0, 0, 1]}],
            },
            {
                "id": "can",
                "pose": {"position": {"x": 0.7, "y": 0.1, "z": 0.3}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}},
                "primitives": [
                    {"type": "cylinder", "dimensions": [0.14, 0.03]},
                    {"type": "sphere", "dimensions": [0.02]},
                ],
                "primitive_poses": [
                    {"position": [0, 0, 0], "orientation": [0, 0, 0, 1]},
                    {"position": [0, 0, 0.1], "orientation": [0, 0, 0, 1]},
                ],
            },
        ]
    }
}
NAMES = [f"panda_joint{i}" for i in range(1, 8)]
REQUEST = {
    "start_state": {
        "joint_state": {"name": ["panda_finger_joint1", *NAMES[::-1]], "position": [0.04, *START[::-1].tolist()]}
    },
    "goal_constraints": [
        {"joint_constraints": [{"joint_name": n, "position": float(q)} for n, q in zip(NAMES, END, strict=True)]}
    ],
}
COLLECTION = {
    "robot": "panda",
    "joints": NAMES,
    "problems": {
        "shelf_panda": [
            {
                "box": [{"name": "shelf", "half_extents": [0.2, 0.3, 0.01], "position": [0.7, 0.0, 0.2]}],
                "cylinder": [{"name": "can", "radius": 0.03, "length": 0.14, "position": [0.7, 0.1, 0.3]}],
                "sphere": [{"radius": 0.02, "position": [0.7, 0.1, 0.4]}],
                "start": START.tolist(),
                "goals": [END.tolist()],
                "index": 1,
            }
        ]
    },
}


def write_pairs(folder: Path) -> Path:
    pair = folder / "shelf_panda"
    pair.mkdir(parents=True)
    (pair / "scene0001.yaml").write_text(yaml.safe_dump(SCENE))
    (pair / "request0001.yaml").write_text(yaml.safe_dump(REQUEST))
    return pair


def test_published_formats_give_the_same_problems(tmp_path: Path) -> None:
    from benchmarks.planner._problem_files import load_problems

    pair = write_pairs(tmp_path / "set")
    archive = tmp_path / "problems.tar.bz2"
    with tarfile.open(archive, "w:bz2") as tar:
        tar.add(pair.parent, "panda")
    collection = tmp_path / "problems.json"
    collection.write_text(json.dumps(COLLECTION))
    found = [load_problems(p)[0] for p in (pair.parent, pair, pair / "scene0001.yaml", archive, collection)]
    assert [len(problems) for problems in found] == [1] * 5
    assert {problems[0] for problems in found} == {found[0][0]}
    problem = found[0][0]
    assert problem.name == "shelf_panda-1"
    assert problem.goal_is_joints
    assert problem.start == tuple(START)
    assert {(s.kind, s.size) for s in problem.solids} == {
        ("box", (0.4, 0.6, 0.02)),
        ("cylinder", (0.03, 0.14)),
        ("sphere", (0.02,)),
    }


def test_a_problem_that_begins_in_collision_is_left_out_by_name(tmp_path: Path) -> None:
    from benchmarks.planner._problem_files import load_problems

    content = json.loads(json.dumps(COLLECTION))
    content["problems"]["shelf_panda"][0]["sphere"][0] = {"radius": 0.2, "position": [0.4, 0.0, 0.5]}
    path = tmp_path / "problems.json"
    path.write_text(json.dumps(content))
    problems, left_out = load_problems(path)
    assert problems == []
    assert left_out == ["shelf_panda-1: start in collision"]


def test_an_unsolved_problem_counts_unless_it_is_proved_infeasible() -> None:
    from benchmarks.planner._contenders import OURS, Outcome
    from benchmarks.planner._motions import INFEASIBLE, Store, infeasible, summary
    from benchmarks.planner._problems import tabletop

    free = tabletop(1)
    blocked = replace(free, name="tabletop-2", solids=(*free.solids, _ball_at_the_start(free)))
    draws = [("tabletop-1", 1, lambda: free), ("tabletop-2", 2, lambda: blocked), ("tabletop-3", 3, lambda: free)]
    store = Store(None)
    store.put(Outcome(problem="tabletop-3", contender="search", ms=0.0, error=f"{INFEASIBLE}the goal collides"))
    outcomes = [Outcome(problem=name, contender=OURS, ms=1.0, error="no path") for name, _, _ in draws]
    proved = infeasible(outcomes, draws, store, search_s=0.0)
    assert proved == {"tabletop-2", "tabletop-3"}
    row = summary(outcomes, OURS, proved)
    assert (row["count"], row["unsolved"], row["infeasible"], row["valid_share"]) == (1, 1, 2, 0.0)


def _ball_at_the_start(problem: Any) -> Any:
    from benchmarks.planner._referee import Solid

    pose = problem.referee().tcp(np.array(problem.start))
    x, y, z = pose.translation.tolist()
    return Solid(kind="sphere", size=(0.05,), position=(x, y, z))


def test_infeasibility_is_proved_at_the_ends_only() -> None:
    from benchmarks.planner._exhaustive import why_infeasible
    from benchmarks.planner._problems import tabletop

    free = tabletop(1)
    assert why_infeasible(free) == ""
    assert "start collides" in why_infeasible(replace(free, solids=(_ball_at_the_start(free),)))
    away = replace(free, goal=(2.0, *free.goal[1:]))
    assert "no configuration reaches" in why_infeasible(away, attempts=50)


def test_a_scene_with_an_octomap_is_read_for_its_objects_only() -> None:
    from benchmarks.planner._problem_files import needed_of_scene

    octomap = {"origin": {}, "octomap": {"data": list(range(2_000))}}
    matrix = {"entry_names": ["a"], "entry_values": [[False]]}
    for world in ({"octomap": octomap, **SCENE["world"]}, {**SCENE["world"], "octomap": octomap}):
        whole = {"name": "s", "allowed_collision_matrix": matrix, "robot_state": {"is_diff": False}, "world": world}
        for indent in (2, 4):
            text = needed_of_scene(yaml.dump(whole, Dumper=yaml.CSafeDumper, sort_keys=False, indent=indent))
            assert len(text) < 3_000
            assert yaml.safe_load(text) == {"robot_state": {"is_diff": False}, **SCENE}
    flow = json.dumps(SCENE)
    assert needed_of_scene(flow) == flow


@pytest.mark.parametrize("damage", ["no folder", "empty", "no request", "mesh", "pose goal", "joints"])
def test_an_unreadable_file_is_reported_with_the_place(tmp_path: Path, damage: str) -> None:
    from benchmarks.planner._problem_files import ProblemFileError, load_problems

    pair = write_pairs(tmp_path / "set")
    path = pair
    scene, request = json.loads(json.dumps(SCENE)), json.loads(json.dumps(REQUEST))
    if damage == "no folder":
        path = tmp_path / "nothing"
    elif damage == "empty":
        path = tmp_path / "empty"
        path.mkdir()
    elif damage == "no request":
        (pair / "request0001.yaml").unlink()
    elif damage == "mesh":
        scene["world"]["collision_objects"][0]["meshes"] = [{}]
    elif damage == "pose goal":
        request["goal_constraints"][0]["joint_constraints"] = []
    else:
        path = tmp_path / "problems.json"
        path.write_text(json.dumps(COLLECTION | {"joints": ["shoulder_pan_joint"]}))
    if damage in ("mesh", "pose goal"):
        (pair / "scene0001.yaml").write_text(yaml.safe_dump(scene))
        (pair / "request0001.yaml").write_text(yaml.safe_dump(request))
    said = {"no folder": "no such", "empty": "no problems", "no request": "request0001", "mesh": "meshes"}
    with pytest.raises(ProblemFileError, match=said.get(damage, "joint")):
        load_problems(path)


@pytest.mark.parametrize(
    ("body", "said"),
    [("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "signal 9"), ("import time; time.sleep(60)", "hung")],
)
def test_a_contender_that_dies_or_hangs_has_failed(tmp_path: Path, body: str, said: str) -> None:
    from benchmarks.planner._contenders import Contender

    script = tmp_path / "run.py"
    script.write_text(f"print('{{\"ready\": true}}', flush=True)\ninput()\n{body}\n")
    with Contender("x", Path(sys.executable), str(script)) as contender:
        assert said in contender.ask({}, limit_s=1.0)["error"]


def test_a_fault_of_a_contenders_script_stops_the_benchmark(tmp_path: Path) -> None:
    from benchmarks.planner._contenders import Contender

    script = tmp_path / "run.py"
    script.write_text("print('{\"ready\": true}', flush=True)\ninput()\nraise KeyError('typo')\n")
    with Contender("x", Path(sys.executable), str(script)) as contender, pytest.raises(RuntimeError, match="typo"):
        contender.ask({}, limit_s=5.0)


@pytest.fixture(scope="module")
def ours() -> Callable[..., Any]:
    """Plans a problem in this process and returns the motion's samples and its duration."""
    from benchmarks.peers import run_roboxim

    from roboxim_core.models.library import ModelLibrary
    from roboxim_planner.pipeline import Planner

    planner = Planner(ModelLibrary().robot("panda"))

    def solve(problem: Any, seed: int = 1) -> tuple[np.ndarray, float]:
        answer = run_roboxim.plan(planner, {"problem": problem.plain(), "seed": seed, "limit_s": 60.0})
        assert not answer["error"], answer["error"]
        return run_roboxim.unpack(answer["positions"]), answer["duration_s"]

    return solve


def verdict_on(problem: Any, motion: tuple[np.ndarray, float]) -> Any:
    return problem.referee().judge(*motion, np.array(problem.start), problem.goal_value)


def test_the_planners_motions_are_clean(ours) -> None:
    from benchmarks.planner._problems import tabletop
    from benchmarks.planner._problems_hard import FAMILIES, hard

    problems = [tabletop(seed, salt=9) for seed in range(8)] + [hard(family, 3, salt=9) for family in FAMILIES]
    for problem in problems:
        assert verdict_on(problem, ours(problem)).clean, problem.name


def test_a_graze_between_free_samples_is_not_let_through(ours) -> None:
    from benchmarks.planner._problems import tabletop
    from benchmarks.planner._problems_hard import hard

    for problem, seed in ((tabletop(598), 598), (hard("table_under_pick", 12, salt=1), 12)):
        assert verdict_on(problem, ours(problem, seed)).clean, problem.name


def test_a_planner_that_overlooks_obstacles_is_caught(ours, monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks.peers import run_roboxim
    from benchmarks.planner._problems import tabletop

    seen = run_roboxim.scene_of
    monkeypatch.setattr(run_roboxim, "scene_of", lambda problem: seen(problem | {"solids": []}))
    verdicts = [verdict_on(problem, ours(problem)) for problem in (tabletop(seed, salt=9) for seed in range(0, 8, 2))]
    assert any("collision" in fault for verdict in verdicts for fault in verdict.faults)


def test_a_planner_that_forgets_what_it_holds_is_caught(ours, monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks.peers import run_roboxim
    from benchmarks.planner._problems import tabletop

    seen = run_roboxim.scene_of
    monkeypatch.setattr(run_roboxim, "scene_of", lambda problem: seen(problem | {"held": None}))
    verdicts = [verdict_on(problem, ours(problem)) for problem in (tabletop(seed, salt=9) for seed in range(0, 30, 6))]
    assert any("held" in fault for verdict in verdicts for fault in verdict.faults)


def test_a_time_law_beyond_the_limits_is_refused_and_caught_when_the_verifier_is_blind(
    ours, monkeypatch: pytest.MonkeyPatch
) -> None:
    from benchmarks.planner._problems import tabletop

    from roboxim_planner import pipeline, timing
    from roboxim_planner.verify import Finding

    def hasty(path, corners, limits, *rest):
        faster = replace(limits, velocity=1.2 * limits.velocity, acceleration=1.2 * limits.acceleration)
        return timing.time_path(path, corners, faster, *rest)

    problem = tabletop(0, salt=9)
    monkeypatch.setattr(pipeline, "time_path", hasty)
    with pytest.raises(AssertionError, match="TRAJECTORY_INVALID"):
        ours(problem)
    monkeypatch.setattr(pipeline, "verify_motion", lambda *_, **__: Finding())
    assert verdict_on(problem, ours(problem)).violations
