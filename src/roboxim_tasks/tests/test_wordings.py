"""Shipped wordings fit the skills, are split without overlap, and give a task its instruction."""

import pytest

from roboxim_core.config import parse_yaml
from roboxim_core.config_folders import config_names
from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.plain_data.wordings import _sets, english_wordings, reworded, set_names, wordings_of
from roboxim_core.seeds import SeedPath
from roboxim_tasks.config import load_task_config, task_config
from roboxim_tasks.meaning import asks_for_same, read_instruction
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.skills import SKILLS, push_object, rotate

WORDED = [name for name in config_names("wordings") if not name.startswith("words_")]


@pytest.mark.parametrize("skill", WORDED)
def test_the_sets_of_a_skill_are_apart_and_begin_with_its_own_wording(skill):
    sets = _sets()[skill]
    assert sets["first"] == SKILLS[skill].templates[:1]
    assert set(SKILLS[skill].templates[1:]) <= set(sets["trained"])
    assert len(sets["held_out"]) >= 2
    templates = [template for templates in sets.values() for template in templates]
    assert len(templates) == len(set(templates))


def test_a_task_is_worded_by_a_set():
    text = "skill: pick_up\nwordings: held_out\n"
    assert task_config(parse_yaml(text)).templates.values == wordings_of("pick_up", "held_out")
    with pytest.raises(ConfigError, match="the wordings of 'pick_up' have no set 'heldout'; .*did you mean 'held_out'"):
        task_config(parse_yaml("skill: pick_up\nwordings: heldout\n"))
    with pytest.raises(ConfigError, match="there are no wordings of 'turn_upright'"):
        task_config(parse_yaml("skill: turn_upright\nwordings: trained\n"))
    with pytest.raises(ConfigError, match="another language.*--policy reworded --option wordings=german"):
        task_config(parse_yaml("skill: pick_up\nwordings: german\n"))


def test_wordings_beside_other_templates_are_refused_and_a_resolved_task_is_not():
    with pytest.raises(ConfigError, match="wordings.*'held_out' and `templates` both give the instructions"):
        task_config(parse_yaml("skill: pick_up\nwordings: held_out\ntemplates: {values: ['Lift the {target}']}\n"))
    same = ", ".join(f"'{template}'" for template in wordings_of("pick_up", "held_out"))
    again = task_config(parse_yaml(f"skill: pick_up\nwordings: held_out\ntemplates: {{values: [{same}]}}\n"))
    assert again.templates.values == wordings_of("pick_up", "held_out")


def test_an_instruction_is_said_in_other_words_and_another_language():
    assert "Grab the red cube" in reworded("Pick up the red cube", "held_out")
    assert reworded("Pick up the red cube", "german")[0] == "Heb den roten Würfel hoch"
    assert reworded("Place the soda can on the plate.", "german")[0] == "Leg die Getränkedose auf den Teller"
    turn = reworded("Rotate the knife clockwise by 90 degrees", "german")
    assert turn == ("Dreh das Messer im Uhrzeigersinn um 90 Grad",)
    other = reworded("Rotate the knife counter-clockwise by 90 degrees", "german")
    assert other == ("Dreh das Messer gegen den Uhrzeigersinn um 90 Grad",)
    assert "Stapel den Würfel auf den Holzklotz" in reworded("Stack the cube on the block", "german")
    assert reworded("Dance", "german") == ()
    assert set_names() == ("german", "held_out", "trained")


@pytest.mark.parametrize("skill", WORDED)
def test_what_the_english_sets_say_is_understood(skill):
    library = ModelLibrary()
    seed = SeedPath(run_seed=3, purpose="test", index=0)
    made = EpisodeGenerator(library, None, None).draw(seed, load_task_config(skill))
    for name in ("trained", "held_out"):
        texts = reworded(made.task.instruction, name)
        assert texts
        for text in texts:
            found = read_instruction(text, made.scene, library)
            assert any(asks_for_same(task, made.task) for task in found.tasks), text


@pytest.mark.parametrize("thing", ["cube", "soda can", "red cube", "light blue milk carton"])
def test_every_object_and_direction_goes_into_every_wording(thing):
    for skill, directions in (("push_object", push_object.DIRECTIONS), ("rotate", rotate.DIRECTIONS)):
        for direction in directions:
            words = {"target": thing, "direction": direction, "angle": "90"}
            for name in ("trained", "held_out"):
                said = reworded(english_wordings(skill)[0].format_map(words), name)
                assert said == tuple(each.format_map(words) for each in wordings_of(skill, name))


@pytest.mark.parametrize(
    "other", ["Push the green button", "Pick up the cube, then push the button", "Pick up the cube and then push it"]
)
def test_what_no_first_wording_says_has_no_other_words(other):
    assert reworded(other, "held_out") == ()
