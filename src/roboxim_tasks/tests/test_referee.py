"""An instruction names exactly one solution in its scene, whatever the skill; the referee here knows only words."""

import itertools

import pytest

from roboxim_core.specs import PhysicalObject
from roboxim_tasks.config import load_task_config
from roboxim_tasks.roles import SPOKEN, description, fits_description, task_distractors, task_objects
from roboxim_tasks.skills import SKILLS


def words_that_fit(thing, library):
    """All ways to name a thing: its noun with any of its true modifiers, said or not."""
    truths = {kind: modifier.default for kind, modifier in library.object_modifiers(thing.model).items()}
    truths |= thing.modifiers
    spoken = [str(truths[kind]) for kind in SPOKEN if kind in truths]
    return {
        " ".join((*chosen, thing.name))
        for count in range(len(spoken) + 1)
        for chosen in itertools.combinations(spoken, count)
    }


@pytest.mark.parametrize("skill", sorted(SKILLS))
def test_no_other_object_of_the_scene_fits_what_the_instruction_names(skill, generator, library, seed_path):
    config = load_task_config(skill)
    for index in range(40):
        task = generator.task(seed_path(index), config)
        for named in task_objects(task):
            assert description(named) in words_that_fit(named, library)
            others = [thing for thing in (*task_objects(task), *task_distractors(task)) if thing is not named]
            assert not [thing for thing in others if description(named) in words_that_fit(thing, library)], task


@pytest.mark.parametrize(
    ("model", "modifiers", "fits"),
    [
        ("apple", {}, True), ("apple", {"color": "red"}, True), ("apple", {"color": "green"}, False),
        ("cube", {"color": "red"}, False), ("apple", {"color": "red", "size": "small"}, True),
    ],
)  # fmt: skip
def test_what_a_thing_is_by_default_counts(model, modifiers, fits, library):
    named = PhysicalObject(entity="target", model="apple", name="apple", modifiers={"color": "red"})
    thing = PhysicalObject(entity="other", model=model, name=model, modifiers=modifiers)
    assert fits_description(thing, named, library) is fits
