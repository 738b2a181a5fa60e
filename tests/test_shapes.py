"""The set of shapes: a hundred objects that imports have made, each named by what one sees and by nothing else."""

from __future__ import annotations

import functools
from typing import Any

import pytest

from roboxim_core.config import config_dir
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import PALETTE
from roboxim_core.plain_data.documents import parse_yaml

LIBRARY = ModelLibrary()
SHAPES = LIBRARY.object_sets["shapes"]
FOLDER = config_dir() / "objects" / "shapes"


@functools.cache
def data() -> dict[str, dict[str, Any]]:
    """Return the content of all files; not at import, which every process of a test run pays for."""
    return {name: parse_yaml((FOLDER / f"{name}.yaml").read_text()) for name in SHAPES}


def words(name: str) -> tuple[str, str, str]:
    """Return size, colour and shape word of a shape's name."""
    *size, colour, shape = data()[name]["name"].split()
    return " ".join(size), colour, shape


def test_there_are_a_hundred_each_graspable_and_beside_their_licence():
    assert len(SHAPES) == 100
    assert all("graspable" in shape["affordances"] and shape["grasps"] for shape in data().values())
    assert "zlib" in (FOLDER / "LICENSE").read_text()


def test_colour_and_shape_word_fit_one_shape_alone():
    assert len({words(name)[1:] for name in SHAPES}) == len(SHAPES)
    named = (*LIBRARY.object_ids, *LIBRARY.object_sets["tools"])
    others = {word for name in named for word in LIBRARY.object(name).name.split()}
    assert not others & {words(name)[2] for name in SHAPES}, "a word that another object has"


@pytest.mark.parametrize("name", SHAPES)
def test_a_name_says_what_is_seen(name):
    size, colour, _ = words(name)
    assert name == data()[name]["name"].replace(" ", "_")
    (visual,) = data()[name]["links"][0]["visual"]
    assert tuple(visual["material"]["color"]) == PALETTE[colour]
    longest = max(data()[name]["size"])
    assert size == ("small" if longest < 0.075 else "large" if longest >= 0.095 else "")


def test_sizes_and_colours_vary():
    sizes = [words(name)[0] for name in SHAPES]
    assert min(sizes.count(size) for size in ("small", "", "large")) >= 8
    assert len({words(name)[1] for name in SHAPES}) == len(PALETTE)
