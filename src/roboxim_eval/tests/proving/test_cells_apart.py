"""What tells cells apart: demands that exclude each other, not demands that merely differ."""

from dataclasses import replace

import pytest
from clean_episode import words

from roboxim_core.poses import Pose
from roboxim_eval.experiments.proving.cells_apart import (
    APART,
    OF_CELLS,
    PARTS,
    differing,
    distinguishable,
    distinguishing_checks,
)
from roboxim_eval.experiments.proving.delivery import CHECKS
from roboxim_eval.experiments.proving.demand import Allowed, Demand, View, gap


def span(low, high):
    return Allowed(lower=(low,), upper=(high,))


def box(*ends):
    return Allowed(lower=tuple(a for a, _ in ends), upper=tuple(b for _, b in ends))


def view(x, *, parent="world", turn=0.0):
    return View(parent=parent, pose=Pose(position=(x, 0.0, 0.6), quat_xyzw=(0.0, 0.0, turn, (1 - turn**2) ** 0.5)))


CELL = Demand(
    skill="pick_up", arguments={"angle": span(0.5, 1.0)}, models={"target": words("cube")},
    modifiers={"target": {"color": words("", "red"), "mass": words("", 1.0)}},
    physics={"target": {"mass_kg": span(0.05, 0.2)}}, table_friction=words(0.7), distractors=(1, 2),
    others={"apple": {}, "cube": {"color": words("blue", "green")}},
    areas={"target": (box((0.3, 0.5), (-0.1, 0.1)),)}, start=box((0.4, 0.5), (-0.1, 0.1), (0.3, 0.4)),
    cameras={"workspace": (view(1.0), view(1.2))},
    look={"light.intensity": span(1.0, 2.0), "table.texture": words("marble", "wood"), "exposure.wrist": words(0.0)},
    templates=("Pick up the {target}",),
)  # fmt: skip


def look(**values):
    return {"look": {**CELL.look, **{name.replace("_", "."): value for name, value in values.items()}}}


def area(*ends):
    return {"areas": {"target": (box(*ends),)}}


FREE = {"distractors": (1, 1), "others": {"apple": {}}}
APART_BY = [
    ("skill", {"skill": "rotate"}),
    ("skill", {"arguments": {"angle": span(1.1, 2.0)}}),
    ("object", {"models": {"target": words("apple", "onion")}}),
    ("object", {"modifiers": {"target": {"color": words("blue")}}}),
    ("object", {"modifiers": {"target": {"mass": span(1.5, 2.0)}}}),
    ("physics", {"physics": {"target": {"mass_kg": span(0.3, 0.5)}}}),
    ("physics", {"table_friction": words(0.5)}),
    ("distractors", {"distractors": (0, 0), "others": {}}),
    ("distractors", {"distractors": (3, 3)}),
    ("distractors", {"others": {"lemon": {}}}),
    ("distractors", {"others": {"cube": {"color": words("black")}}}),
    ("distractors", {"always": ("plate",)}),
    ("area", area((0.3, 0.5), (0.13, 0.3))),
    ("start", {"start": box((0.4, 0.5), (-0.1, 0.1), (0.45, 0.5))}),
    ("camera", {"cameras": {"workspace": (view(1.1),)}}),
    ("camera", {"cameras": {"workspace": (view(1.0, turn=0.1),)}}),
    ("camera", {"cameras": {"workspace": (view(1.0, parent="gripper"),)}}),
    ("camera", {"shifts": {"workspace": box((0.3, 0.4), (0.0, 0.0), (0.0, 0.0))}}),
    ("light", look(light_intensity=span(2.1, 3.0))),
    ("light", look(exposure_wrist=words(-1.0, 1.0))),
    ("texture", look(table_texture=words("", "speckle"))),
    ("instruction", {"templates": ("Lift the {target}", "Pick up the {target} gently")}),
]
SHARED_BY = [
    ("skill", {"arguments": {"angle": span(0.9, 2.0)}}),
    ("object", {"models": {"target": words("apple", "cube")}}),
    ("object", {"modifiers": {"target": {"color": words("red")}}}),
    ("object", {"modifiers": {"target": {"mass": span(0.5, 2.0)}}}),
    ("physics", {"physics": {"target": {"mass_kg": span(0.1, 0.5)}}}),
    ("physics", {"table_friction": None}),
    ("distractors", {"distractors": (0, 4)}),
    ("distractors", {"distractors": (0, 1), "others": {"lemon": {}, "apple": {}}}),
    ("area", area((0.3, 0.5), (0.11, 0.3))),
    ("start", {"start": None}),
    ("start", {"start": box((0.4, 0.5), (-0.1, 0.1), (0.2, 0.5))}),
    ("camera", {"cameras": {"workspace": (view(1.1), view(1.2))}}),
    ("camera", {"shifts": {"workspace": box((0.1, 0.4), (0.0, 0.0), (0.0, 0.0))}}),
    ("camera", {"cameras": {"workspace": (view(1.0, turn=0.1),)}, "turned": ("workspace",)}),
    ("light", look(light_intensity=span(1.9, 3.0))),
    ("texture", look(table_texture=words("wood"))),
    ("instruction", {"templates": ("Lift the {target}", "Pick up the {target}")}),
    ("instruction", {"templates": ("Pick up the cube",)}),
    ("instruction", {"templates": ("{verb} the {target}",)}),
    ("instruction", {"templates": ()}),
]


@pytest.mark.parametrize(("check", "other"), APART_BY)
def test_demands_that_exclude_each_other_tell_cells_apart(check, other):
    elsewhere = replace(CELL, **other)
    assert [name for name, apart in APART.items() if apart(elsewhere, CELL)] == [check]
    assert [name for name, apart in APART.items() if apart(CELL, elsewhere)] == [check]
    assert distinguishable(CELL, elsewhere)
    assert check in differing(CELL, elsewhere)


@pytest.mark.parametrize(("check", "other"), SHARED_BY)
def test_demands_that_merely_differ_do_not(check, other):
    elsewhere = replace(CELL, **other)
    assert not distinguishable(CELL, elsewhere)
    assert not distinguishable(elsewhere, CELL)
    assert differing(CELL, elsewhere) == (check,)


def test_a_camera_that_the_other_cell_lacks_tells_its_cell():
    both = replace(CELL, cameras={**CELL.cameras, "wrist": (view(0.0, parent="gripper"),)})
    assert distinguishable(both, CELL)
    assert not distinguishable(CELL, both), "what a cell has beside the demanded cameras is no fault"


def test_distractors_that_every_scene_has_say_nothing_about_the_drawn_ones():
    cell = replace(CELL, distractors=(1, 3), always=("plate",))
    other = replace(cell, others={"lemon": {}})
    assert not distinguishable(cell, other), "both may have the plate alone"
    assert distinguishable(replace(cell, distractors=(2, 3)), other)
    assert not distinguishable(replace(cell, **FREE, always=()), replace(CELL, **FREE))


def test_cells_are_told_apart_by_skill_object_area_and_camera_where_they_can_be():
    dark = replace(CELL, **look(light_intensity=span(2.1, 3.0)))
    turned, elsewhere = replace(dark, skill="rotate"), replace(CELL, start=box((0.4, 0.5), (0.3, 0.4), (0.3, 0.4)))
    assert distinguishing_checks(CELL, [turned]) == OF_CELLS
    assert distinguishing_checks(CELL, [turned, dark]) == (*OF_CELLS, "light")
    assert distinguishing_checks(CELL, [dark, elsewhere]) == (*OF_CELLS, "start", "light")
    assert distinguishing_checks(CELL, [replace(dark, templates=("Lift it",))]) == (*OF_CELLS, "light", "instruction")


def test_every_check_of_what_a_cell_demands_is_known_here():
    assert list(APART) == list(PARTS) == [name for name in CHECKS if name not in ("words", "latency")]


def test_the_gap_between_values_is_the_largest_over_the_axes():
    assert gap(words(1.0, 5.0), words(2.5)) == 1.5
    assert gap(words((0.0, 0.0)), box((1.0, 2.0), (3.0, 4.0))) == 3.0
    assert gap(span(0.0, 2.0), span(1.0, 3.0)) == 0.0
    assert gap(words("wood"), words("marble", "wood")) == 0.0
    assert gap(words("", 1.0), words("none")) == gap(words("wood"), span(0.0, 1.0)) == float("inf")
