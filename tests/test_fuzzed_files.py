"""Structure-aware fuzzing of what others hand over: URDFs, meshes and YAML.

Real files are taken apart, a part is dropped, renamed, retyped, emptied, cut, repeated or exchanged, and the file is
put together again, so that a reader gets past its first checks. What comes out is read, or refused by a `RoboximError`.
8 mutations of each format run always, 100 with ``-m fuzz``, as in CI, 2,000 with ``-m slow``.
"""

from __future__ import annotations

import copy
import random
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import trimesh
import yaml
from fuzzing import CI, FEW, MANY, accepted, mutated_bytes, run

from roboxim_core.config import config_dir, load_config
from roboxim_core.conventions.convention import load_convention
from roboxim_core.models.check import check_object
from roboxim_core.models.hulls import hull_of
from roboxim_core.models.urdf import urdf_object
from roboxim_runs.episodes.task_choice import task_text

ODD = ("", "nan", "-1", "1e999", "0", "x" * 300, "\u00e4\u2028", "[]", "null", "${a}", "1,5", "../..")
ODD_VALUES = (None, True, -1, 0, 1e308, float("nan"), float("inf"), "", "x", [], {}, [[]], {"a": 1}, "\u00e4", 10**30)


# ------------------------------------------------------------------ URDF and meshes


DRAWER = """<robot name="drawer">
<material name="wood"><color rgba="0.5 0.3 0.1 1"/></material>
<link name="base"><inertial><mass value="1.5"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>
<visual><origin xyz="0 0 0.05" rpy="0 0 0"/><geometry><box size="0.2 0.2 0.1"/></geometry>
<material name="wood"/></visual>
<collision><origin xyz="0 0 0.05"/><geometry><box size="0.2 0.2 0.1"/></geometry></collision></link>
<link name="knob"><inertial><mass value="0.05"/></inertial>
<visual><geometry><mesh filename="package://objects/meshes/box.obj" scale="1 1 1"/></geometry></visual>
<collision><geometry><cylinder radius="0.01" length="0.03"/></geometry></collision></link>
<link name="tray"><inertial><mass value="0.3"/></inertial>
<collision><geometry><sphere radius="0.03"/></geometry></collision></link>
<joint name="slide" type="prismatic"><parent link="base"/><child link="tray"/><origin xyz="0 0 0.1" rpy="0 0 1.57"/>
<axis xyz="1 0 0"/><limit lower="0" upper="0.2" effort="1" velocity="1"/>
<dynamics damping="0.1" friction="0.2"/></joint>
<joint name="glue" type="fixed"><parent link="tray"/><child link="knob"/></joint></robot>
"""


def fuzz_urdf(folder: Path, rng: random.Random) -> None:
    root = ElementTree.fromstring(DRAWER)
    parents = {child: parent for parent in root.iter() for child in parent}
    for _ in range(rng.randint(1, 3)):
        element = rng.choice([e for e in root.iter() if e is not root])
        kind = rng.choice(("drop", "attribute", "drop_attribute", "rename", "repeat", "exchange", "empty", "move"))
        if kind == "drop" and element in parents and element in list(parents[element]):
            parents[element].remove(element)
        elif kind == "attribute" and element.attrib:
            name = rng.choice(sorted(element.attrib))
            element.attrib[name] = rng.choice((*ODD, element.attrib[name] + " 1", "base", "tray"))
        elif kind == "drop_attribute" and element.attrib:
            del element.attrib[rng.choice(sorted(element.attrib))]
        elif kind == "rename":
            element.tag = rng.choice(("link", "joint", "box", "mesh", "xacro", "origin", "capsule"))
        elif kind == "repeat" and element in parents:
            parents[element].append(copy.deepcopy(element))
        elif kind == "exchange":
            other = rng.choice(list(root.iter()))
            element.attrib, other.attrib = other.attrib, element.attrib
        elif kind == "empty":
            for child in list(element):
                element.remove(child)
        elif kind == "move" and element in parents:
            parents[element].append(ElementTree.Element("link", {"name": rng.choice(ODD)}))
    text = ElementTree.tostring(root)
    if rng.random() < 0.2:
        text = mutated_bytes(text, rng)
    (folder / "meshes").mkdir()
    (folder / "urdf").mkdir()
    trimesh.creation.box((0.02, 0.02, 0.02)).export(folder / "meshes" / "box.obj")
    (folder / "urdf" / "own.urdf").write_bytes(text.replace(b"package://objects", b"package://" + folder.name.encode()))
    (folder / "urdf" / "own.yaml").write_text("name: own\nurdf: own.urdf\n")
    accepted(lambda: urdf_object(folder / "urdf" / "own.urdf"))
    if rng.random() < 0.4:  # it is slow
        check_object(folder / "urdf" / "own.yaml")  # findings, never an exception


def fuzz_mesh(folder: Path, rng: random.Random) -> None:
    kind = rng.choice(("obj", "stl", "glb", "ply", "off", "dae"))
    mesh = trimesh.creation.box((0.04, 0.04, 0.04))
    data = mesh.export(file_type=kind)
    data = data if isinstance(data, bytes) else data.encode()
    if kind in ("obj", "off", "dae", "ply") and rng.random() < 0.7:
        words = re.split(rb"(\s+)", data)
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(len(words))
            words[at] = rng.choice(
                [word.encode() for word in ODD] + [b"-7", b"99999999", b"v", b"f", rng.choice(words)]
            )
        data = b"".join(words)
    else:
        data = mutated_bytes(data, rng)
    (folder / f"own.{kind}").write_bytes(data)
    (folder / "own.yaml").write_text(f"name: own\nmesh: own.{kind}\nmass: 0.05\n")
    accepted(lambda: hull_of(folder / f"own.{kind}"))
    check_object(folder / "own.yaml")


# ------------------------------------------------------------------ YAML


def places(data: object, path: tuple = ()) -> list[tuple]:
    """Return the paths of all values of plain data."""
    found = [path] if path else []
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        found += places(value, (*path, key))
    return found


def mutated_tree(data: object, rng: random.Random) -> object:
    """Return plain data with a value dropped, renamed, retyped, repeated or exchanged."""
    data = copy.deepcopy(data)
    for _ in range(rng.randint(1, 3)):
        paths = places(data)
        if not paths:
            return rng.choice(ODD_VALUES)
        path = rng.choice(paths)
        holder = data
        for key in path[:-1]:
            holder = holder[key]
        kind = rng.choice(("drop", "rename", "retype", "retype", "list", "exchange"))
        if kind == "drop":
            del holder[path[-1]]
        elif kind == "rename" and isinstance(holder, dict):
            holder[rng.choice(("", "x", 1, "name", None))] = holder.pop(path[-1])
        elif kind == "list":
            holder[path[-1]] = [holder[path[-1]]] * rng.randint(0, 3)
        elif kind == "exchange":
            other = data
            for key in rng.choice(paths):
                other = other[key] if isinstance(other, (dict, list)) and key in places_of(other) else other
            holder[path[-1]] = copy.deepcopy(other)
        else:
            holder[path[-1]] = rng.choice(ODD_VALUES)
    return data


def places_of(data: object) -> list:
    return list(data) if isinstance(data, dict) else list(range(len(data)))


def fuzz_yaml(folder: Path, rng: random.Random) -> None:
    kind, read = rng.choice((
        ("tasks", lambda file: task_text(str(file))),
        ("objects", check_object),
        ("conventions", lambda file: load_convention(str(file))),
        ("cameras", lambda file: load_config(file, dict[str, object])),
    ))  # fmt: skip
    source = rng.choice(sorted((config_dir() / kind).glob("*.yaml")))
    data = yaml.safe_load(source.read_text())
    text = yaml.safe_dump(mutated_tree(data, rng), allow_unicode=True).encode(
        rng.choice(("utf-8", "utf-16", "latin-1")), "replace"
    )
    file = folder / "own.yaml"
    file.write_bytes(mutated_bytes(text, rng) if rng.random() < 0.2 else text)
    accepted(lambda: read(file))


# ------------------------------------------------------------------ the runs


FORMATS = {"urdf": fuzz_urdf, "mesh": fuzz_mesh, "yaml": fuzz_yaml}


@pytest.mark.parametrize("name", FORMATS)
def test_no_mutation_gives_a_traceback(tmp_path, name):
    run(FORMATS[name], tmp_path, name, range(FEW))


@pytest.mark.fuzz
@pytest.mark.parametrize("name", FORMATS)
def test_no_mutation_of_a_hundred_gives_a_traceback(tmp_path, name):
    run(FORMATS[name], tmp_path, name, range(FEW, CI))


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_no_mutation_of_many_gives_a_traceback(tmp_path, name):
    run(FORMATS[name], tmp_path, name, range(CI, MANY))
