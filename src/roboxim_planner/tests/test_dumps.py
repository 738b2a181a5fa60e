from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from roboxim_core.errors import ConfigError, ErrorCode, RequestTimeoutError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_planner.constraint import Upright
from roboxim_planner.draw import draw_profiles, draw_scene
from roboxim_planner.dumps import Dump, answered, find_dump, list_dumps, read_dump, self_contained, write_dump
from roboxim_planner.pipeline import MotionOptions, Planner
from roboxim_planner.queries import (
    QUERIES,
    IkQuery,
    JointsQuery,
    LineQuery,
    PoseQuery,
    Query,
    RetimeQuery,
    SequenceQuery,
)
from roboxim_planner.scene import AllowedContact, Attached, Body, PlanningScene, PointHull, TriangleMesh, box
from roboxim_planner.sequence import Stage, StageGoal

HOME = (0.0, -0.2, 0.0, -2.2, 0.0, 2.0, 0.785)
CORNERS = ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1))
SCENE = PlanningScene(
    bodies=(
        box("table", (0.9, 1.4, 0.05), Pose(position=(0.5, 0.0, -0.025))),
        Body(name="hull", shapes=(PointHull(points=CORNERS),), pose=Pose(position=(0.3, -0.5, 0.0))),
        Body(name="sheet", shapes=(TriangleMesh(vertices=CORNERS, triangles=((0, 1, 2),)),)),
    ),
    attached=(Attached(body=box("stick", (0.02, 0.02, 0.1), Pose(position=(0.0, 0.0, 0.03)))),),
    allowed=(AllowedContact(body_a="stick", body_b="table"), AllowedContact(body_a="sheet")),
    gripper_opening=0.3,
)
LIMITED = MotionOptions(velocity_scaling=0.5, max_tcp_speed_m_s=0.3, seed=3)


def queries(down: Pose) -> list[Query]:
    """Return one query of each kind."""
    common = {"robot": "panda", "scene": SCENE, "start": HOME, "options": LIMITED}
    upright = {**common, "options": replace(LIMITED, upright=Upright(tolerance_rad=0.5))}
    stage = Stage(kind="pose", goals=(StageGoal(pose=down),), gripper_opening=0.2, options=LIMITED)
    return [
        PoseQuery(**upright, targets=(down,)),
        JointsQuery(**common, goal=(0.3, *HOME[1:])),
        LineQuery(**common, waypoints=(down,), min_fraction=0.5),
        SequenceQuery(**common, stages=(stage,)),
        RetimeQuery(**common, path=(HOME, (0.3, *HOME[1:]), HOME)),
        IkQuery(**common, target=down, mode="all", count=4),
    ]


def dump(query: Query, planner: Planner) -> Dump:
    outcome, _ = answered(query, planner)
    digest = ModelLibrary().digest("panda")
    return Dump(query=query, outcome=outcome, config=planner.config, robot_digest=digest)


@pytest.fixture
def down(tcp_down: Callable[..., Pose]) -> Pose:
    return tcp_down(0.5, -0.1, 0.3)


@pytest.mark.parametrize("index", range(6))
def test_query_comes_back_from_its_dump_and_is_answered_alike(
    planner: Planner, tmp_path: Path, down: Pose, index: int
) -> None:
    query = queries(down)[index]
    assert QUERIES[query.kind] is type(query)
    written = dump(query, planner)
    assert written.outcome.error_code == 0, written.outcome
    read = read_dump(write_dump(written, tmp_path, "a", kept=3))
    assert read == replace(written, query=self_contained(query))
    again, _ = read.run_again(ModelLibrary())
    assert again.digest == written.outcome.digest


def test_failure_is_repeated_word_by_word(planner: Planner, tmp_path: Path, tcp_down: Callable[..., Pose]) -> None:
    block = box("block", (0.1, 0.1, 0.2), Pose(position=(0.5, 0.2, 0.1)))
    query = PoseQuery(
        robot="panda", scene=PlanningScene(bodies=(block,)), start=HOME, targets=(tcp_down(0.5, 0.2, 0.1),)
    )
    written = dump(query, planner)
    assert written.outcome.error_code == ErrorCode.GOAL_IN_COLLISION
    again, answer = read_dump(write_dump(written, tmp_path, "a", kept=3)).run_again(ModelLibrary())
    assert (again, answer) == (written.outcome, None)


def test_timeout_is_repeated_at_its_step_and_can_be_let_run(planner: Planner, tmp_path: Path, walled, left) -> None:
    goal = left * np.array([-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, 1.0])
    query = JointsQuery(robot="panda", scene=walled, start=tuple(left.tolist()), goal=tuple(goal.tolist()))

    def late(stage: str, iterations: int) -> None:
        if stage == "search" and iterations > 0:
            raise RequestTimeoutError(f"time out in stage '{stage}', {iterations} iterations")

    outcome, _ = answered(query, planner, late)
    assert outcome.error_code == ErrorCode.TIMEOUT
    written = replace(dump(query, planner), outcome=outcome)
    read = read_dump(write_dump(written, tmp_path, "a", kept=3))
    assert read.run_again(ModelLibrary())[0] == outcome
    assert read.run_again(ModelLibrary(), deadline=False)[0].error_code == 0


def test_folder_is_bounded_and_names_are_found(planner: Planner, tmp_path: Path, down: Pose) -> None:
    written = dump(queries(down)[5], planner)
    other = tmp_path / "other.json"
    other.write_text("{}")
    os.utime(other, (1e9, 1e9))
    paths = [write_dump(written, tmp_path, "same", kept=3) for _ in range(5)]
    assert sorted(list_dumps(tmp_path)) == sorted(paths[2:])
    assert find_dump("latest", tmp_path) == list_dumps(tmp_path)[0]
    assert find_dump(paths[3].name, tmp_path) == paths[3]
    with pytest.raises(ConfigError, match="no dump 'sam-3'"):
        find_dump("sam-3", tmp_path)
    with pytest.raises(ConfigError, match="not a planner dump"):
        read_dump(other)


@pytest.mark.thorough
def test_a_path_that_cannot_be_retimed_is_drawn_also_without_objects(planner: Planner, tmp_path: Path) -> None:
    query = RetimeQuery(robot="panda", path=(HOME, (9.8, *HOME[1:])))
    outcome, answer = answered(query, planner)
    assert outcome.error_code == ErrorCode.TRAJECTORY_INVALID
    assert draw_scene(query, planner, answer, tmp_path / "path.png", error=outcome.error_msg).is_file()


@pytest.mark.thorough
def test_pictures_are_drawn(planner: Planner, tmp_path: Path, down: Pose) -> None:
    query = queries(down)[3]
    outcome, answer = answered(query, planner)
    assert answer is not None, outcome
    with Image.open(draw_scene(query, planner, answer, tmp_path / "scene.png")) as picture:
        colors = {color for _, color in picture.convert("RGB").getcolors(1_000_000)}
    assert len(colors) > 300
    with Image.open(draw_profiles(query, planner, answer.plans, tmp_path / "profiles.png")) as picture:
        assert picture.width > 1000
