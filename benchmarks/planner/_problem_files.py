"""Reader for published planning problems for the Panda: MotionBenchMaker's scenes and requests, and a JSON collection.

- A folder or tar archive of pairs ``sceneNNNN.yaml`` (a MoveIt planning scene) and ``requestNNNN.yaml`` (a MoveIt
  motion plan request), as MotionBenchMaker publishes them, one folder for each set; or one such scene file with its
  request beside it. Source: https://github.com/KavrakiLab/motion_bench_maker
- ``problems.json``: ``{"joints": [...], "problems": {set: [{"box": [...], "cylinder": [...], "sphere": [...],
  "start": [...], "goals": [[...]]}]}}``, to which VAMP converts them. Source: https://github.com/KavrakiLab/vamp

All poses are in the frame of the robot's base, goals are arm configurations. The arm must be the Panda.
"""

from __future__ import annotations

import json
import re
import tarfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin
import yaml
from benchmarks.planner._problems import Problem, problem
from benchmarks.planner._referee import Referee, Solid

Array = npt.NDArray[np.float64]
JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
IDENTITY = pin.SE3.Identity()


class ProblemFileError(ValueError):
    """A file has no problems in a known format; the message names the place."""


def load_problems(path: Path) -> tuple[list[Problem], list[str]]:
    """Return the problems of a file or folder, and the reasons for omitted ones.

    A problem is omitted if its start or goal collides on the original meshes, because then it is infeasible.

    Args:
        path: A JSON collection, a folder, a tar archive, or a scene's YAML file.

    Raises:
        ProblemFileError: When there are no problems, or one cannot be read.
    """
    if not path.exists():
        raise ProblemFileError(f"{path}: no such file or folder")
    drawn = list(_from_json(path) if path.suffix == ".json" else _from_yaml(path))
    if not drawn:
        raise ProblemFileError(f"{path}: no problems; expected problems.json or pairs of scene*.yaml and request*.yaml")
    found, left_out = [], []
    for name, solids, start, goal in drawn:
        referee = Referee(solids)
        colliding = [what for what, q in (("start", start), ("goal", goal)) if referee.collides(q)]
        if colliding:
            left_out.append(f"{name}: {' and '.join(colliding)} in collision")
        else:
            found.append(problem(name, referee, start, goal, joints=True))
    return found, left_out


Read = tuple[str, list[Solid], Array, Array]


def _from_json(path: Path) -> Iterator[Read]:
    content = json.loads(path.read_text())
    if not isinstance(content, dict) or not isinstance(content.get("problems"), dict):
        raise ProblemFileError(f"{path}: expected an object with 'problems', lists of problems by the set's name")
    joints = content.get("joints", list(JOINTS))
    if sorted(joints) != sorted(JOINTS):
        raise ProblemFileError(f"{path}: problems of the joints {joints}; this benchmark plans for {list(JOINTS)}")
    order = [joints.index(joint) for joint in JOINTS]
    for family, problems in content["problems"].items():
        for position, entry in enumerate(problems):
            name = f"{family}-{entry.get('index', position)}"
            try:
                solids = [_json_solid(kind, item) for kind in ("box", "cylinder", "sphere") for item in entry[kind]]
                start, goal = (np.array(q, dtype=float)[order] for q in (entry["start"], entry["goals"][0]))
            except (KeyError, IndexError, TypeError, ValueError) as error:
                raise ProblemFileError(f"{path}: {name}: {type(error).__name__} {error}") from error
            yield name, solids, start, goal


def _json_solid(kind: str, item: dict[str, Any]) -> Solid:
    sizes = {
        "box": lambda: tuple(2.0 * half for half in item["half_extents"]),
        "cylinder": lambda: (item["radius"], item["length"]),
        "sphere": lambda: (item["radius"],),
    }
    quat = item.get("orientation_quat_xyzw", (0.0, 0.0, 0.0, 1.0))
    return _solid(kind, sizes[kind](), _pose({"position": item["position"], "orientation": quat}))


def _from_yaml(path: Path) -> Iterator[Read]:
    texts = dict(_yaml_texts(path))
    for scene_name, text in sorted(texts.items()):
        match = re.fullmatch(r"(.*?)scene(\d*)\.ya?ml", scene_name)
        if match is None:
            continue
        folder, number = match.groups()
        request = next((texts[n] for end in ("yaml", "yml") if (n := f"{folder}request{number}.{end}") in texts), None)
        if request is None:
            raise ProblemFileError(f"{path}: {scene_name} has no request{number}.yaml beside it")
        family = Path(folder).name or path.resolve().parent.name
        try:
            solids = _moveit_solids(yaml.load(needed_of_scene(text), _Loader))
            start, goal = _moveit_request(yaml.load(request, _Loader))
        except (KeyError, IndexError, TypeError, ValueError, yaml.YAMLError) as error:
            raise ProblemFileError(f"{path}: {scene_name}: {type(error).__name__} {error}") from error
        yield f"{family}-{int(number or 0)}", solids, start, goal


def _yaml_texts(path: Path) -> Iterator[tuple[str, str]]:
    """Return the YAML files at a path by name, including subfolders."""
    if path.is_dir():
        for file in path.rglob("*.y*ml"):
            yield str(file.relative_to(path.parent)), file.read_text()
    elif path.suffix in (".yaml", ".yml"):
        yield path.name, path.read_text()
        for file in path.parent.glob(f"request{''.join(re.findall('[0-9]', path.stem))}.y*ml"):
            yield file.name, file.read_text()
    else:
        if not tarfile.is_tarfile(path):
            raise ProblemFileError(f"{path}: neither JSON, YAML nor a tar archive")
        with tarfile.open(path) as archive:
            for member in archive:
                content = archive.extractfile(member) if member.isfile() else None
                if content is not None and member.name.endswith((".yaml", ".yml")):
                    yield member.name, content.read().decode()


_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_NEEDED = {"": {"robot_state", "world"}, "world": {"collision_objects"}}
"""The parts of a scene that are read: top-level keys, and keys of their mappings."""


def needed_of_scene(text: str) -> str:
    """Return the needed parts of a MoveIt scene's YAML text; parsing the octomap alone would take seconds.

    Block mappings are split by the indentation of their keys. Other text, such as flow style, is kept unchanged.
    """
    kept = []
    for key, part in _parts(text, ""):
        if key in _NEEDED[""]:
            wanted = _NEEDED.get(key)
            head, _, body = part.partition("\n")
            indent = re.match(" *", body)
            if wanted and indent and indent.group():
                children = [child for name, child in _parts(body, indent.group()) if name in wanted]
                part = "\n".join([head, *children])
            kept.append(part)
    return "\n".join(kept) if kept else text


def _parts(text: str, indent: str) -> Iterator[tuple[str, str]]:
    """Yield the keys of a block mapping at an indentation, each with its lines."""
    starts = list(re.finditer(rf"^{indent}([A-Za-z_]\w*):", text, re.MULTILINE))
    for number, match in enumerate(starts, start=1):
        end = starts[number].start() if number < len(starts) else len(text)
        yield match.group(1), text[match.start() : end].rstrip("\n")


def _moveit_solids(scene: dict[str, Any]) -> list[Solid]:
    if scene.get("robot_state", {}).get("attached_collision_objects"):
        raise ValueError("attached collision objects are not read")
    solids = []
    for item in scene["world"]["collision_objects"]:
        if item.get("meshes"):
            raise ValueError(f"object '{item.get('id')}' has meshes; primitives are read")
        base = _pose(item["pose"]) if item.get("pose") else IDENTITY
        for primitive, pose in zip(item["primitives"], item["primitive_poses"], strict=True):
            kind, sizes = _KINDS.get(primitive["type"], primitive["type"]), list(primitive["dimensions"])
            if kind == "cylinder":
                sizes = sizes[1::-1]  # MoveIt lists the height first
            solids.append(_solid(kind, tuple(sizes), base * _pose(pose)))
    return solids


_KINDS = {1: "box", 2: "sphere", 3: "cylinder"}


def _moveit_request(request: dict[str, Any]) -> tuple[Array, Array]:
    state = request["start_state"]["joint_state"]
    start = dict(zip(state["name"], state["position"], strict=True))
    constraints = request["goal_constraints"][0]
    if not constraints.get("joint_constraints"):
        raise ValueError("a goal without joint constraints; goals are read as arm configurations")
    goal = {item["joint_name"]: item["position"] for item in constraints["joint_constraints"]}
    return np.array([start[joint] for joint in JOINTS], float), np.array([goal[joint] for joint in JOINTS], float)


def _pose(value: dict[str, Any]) -> pin.SE3:
    """Return a pose whose parts are lists, or mappings as ROS writes them."""
    position = _numbers(value.get("position", (0.0, 0.0, 0.0)), "xyz")
    quat = _numbers(value.get("orientation", (0.0, 0.0, 0.0, 1.0)), "xyzw")
    return pin.XYZQUATToSE3(np.array([*position, *(np.array(quat) / np.linalg.norm(quat))]))


def _numbers(value: Sequence[float] | dict[str, float], names: str) -> list[float]:
    numbers = [value[name] for name in names] if isinstance(value, dict) else list(value)
    if len(numbers) != len(names) or not np.isfinite(numbers).all():
        raise ValueError(f"expected {names}, got {value}")
    return [float(number) for number in numbers]


def _solid(kind: str, size: tuple[float, ...], pose: pin.SE3) -> Solid:
    x, y, z, *quat = pin.SE3ToXYZQUAT(pose).tolist()
    return Solid(kind=kind, size=tuple(map(float, size)), position=(x, y, z), quat_xyzw=tuple(quat))
