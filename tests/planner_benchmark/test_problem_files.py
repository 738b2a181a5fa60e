"""Published problem files are read in every format."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path

import pytest
import yaml
from benchmark_values import END, START

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
