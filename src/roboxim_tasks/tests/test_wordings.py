"""Shipped wordings fit the skills, are split without overlap, and give a task its instruction."""

import itertools
import operator
import re

import pytest

from roboxim_core.config import load_yaml, named_config, parse_yaml
from roboxim_core.config_folders import config_names
from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.plain_data.wordings import _sets, english_wordings, names_in, reworded, set_names, wordings_of
from roboxim_core.seeds import SeedPath
from roboxim_tasks.config import load_task_config, task_config
from roboxim_tasks.meaning import _match, asks_for_same, read_instruction
from roboxim_tasks.roles import SPOKEN
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.skills import SKILLS, push_object, rotate, turn_knob

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


def instructions(skill, things):
    """Return the instructions of a skill in its first wording: with each thing in every role, and every other word."""
    directions = {"push_object": push_object.DIRECTIONS, "rotate": rotate.DIRECTIONS}.get(skill, ("",))
    (first,) = _sets()[skill]["first"]
    for direction in directions:
        for angle in ("45", "90", "180") if skill == "rotate" else ("",):
            for thing, other in zip(things, [*things[1:], *things[:1]], strict=True):
                words = {"target": thing, "support": other, "container": other, "direction": direction, "angle": angle}
                yield first.format_map(words), words


@pytest.mark.parametrize("skill", WORDED)
def test_every_object_and_word_goes_whole_into_every_wording(skill):
    for instruction, words in instructions(skill, ["cube", "soda can", "red cube", "light blue milk carton"]):
        for name in ("trained", "held_out"):
            said = reworded(instruction, name)
            assert said == tuple(each.format_map(words) for each in wordings_of(skill, name))
            assert all(is_a_sentence(each) for each in said), said
            for each in said:
                assert all(f"the {words[role]}" in each.lower() for role in SKILLS[skill].roles)


WORDS = {"turn_knob": {"direction": turn_knob.DIRECTIONS}, "push_object": {"direction": push_object.DIRECTIONS},
         "rotate": {"direction": rotate.DIRECTIONS, "angle": ["45", "180"]},
         "open_drawer": {"drawer": ["top", "left"]}, "close_drawer": {"drawer": ["top", "left"]}}  # fmt: skip


@pytest.mark.parametrize("skill", sorted(SKILLS))
def test_a_skills_own_templates_are_sentences_whose_words_are_found_again(skill):
    own = WORDS.get(skill, {})
    assert own.keys() == set(SKILLS[skill].words)
    for template, *values in itertools.product(SKILLS[skill].templates, *own.values()):
        for thing, other in (("cube", "soda can"), ("soda can", "large red cube"), ("kitchen unit", "cube")):
            roles = dict(zip(SKILLS[skill].roles, (thing, other), strict=False))
            words = {
                name: word
                for name, word in (roles | dict(zip(own, values, strict=True))).items()
                if name in names_in(template)
            }
            text = template.format_map(words)
            assert is_a_sentence(text), text
            assert _match(template, text, SKILLS[skill], ["soda can", "kitchen unit", "cube"]) == words


@pytest.fixture(scope="module")
def shipped():
    """The configurations of all shipped tasks whose skills have wordings."""
    configs = [load_task_config(name) for name in config_names("tasks")]
    cells = [cell for config in configs for cell in getattr(config, "cells", (config,))]
    return [cell for cell in cells if cell.skill in WORDED]


@pytest.mark.parametrize("skill", WORDED)
def test_every_object_and_word_is_said_in_german(skill, library, shipped):
    drawn = {thing for role in SKILLS[skill].roles for thing in descriptions(skill, role, library, shipped)}
    german = set(load_yaml(named_config("wordings", "words_german")).values())
    way = r"hoch|vom Tisch|nach \w+|(?:im|gegen den) Uhrzeigersinn um \d+ Grad"
    for instruction, words in instructions(skill, sorted(drawn)):
        for each in reworded(instruction, "german"):
            assert is_a_sentence(each)
            found = re.fullmatch(rf"\w+ (d(?:en|ie|as) .+?)(?: (?:auf|in) (d(?:en|ie|as) .+?))?( (?:{way}))?", each)
            assert found, each
            assert {found[1], found[2] or found[1]} <= german, each
            assert bool(found[2]) == (len(SKILLS[skill].roles) > 1)
            assert bool(found[2]) != bool(found[3])
            assert words["angle"] in each


def descriptions(skill, role, library, shipped):
    """Return how instructions name what may fill a role: every noun, and what the shipped tasks draw."""
    for model in library.object_ids:
        if SKILLS[skill].roles[role].suits(library.object(model)):
            yield library.object(model).name
    for config in (config for config in shipped if config.skill == skill):
        for model in config.objects[role].models.values:
            known, modifiers = library.object_modifiers(model), config.objects[role].modifiers
            spoken = [modifiers[kind].values for kind in SPOKEN if kind in modifiers and kind in known]
            for words in itertools.product(*spoken):
                yield " ".join((*words, library.object(model).name))
    if role == "container":
        yield from (f"{drawer} drawer of the cabinet" for drawer in ("top", "middle", "bottom"))


def is_a_sentence(text):
    """Return whether a text begins with a capital letter, has all braces filled and no word twice in a row."""
    words = text.lower().split()
    return text[:1].isupper() and not set("{}") & set(text) and all(map(operator.ne, words, words[1:]))


@pytest.mark.parametrize(
    "other", ["Push the green button", "Pick up the cube, then push the button", "Pick up the cube and then push it"]
)
def test_what_no_first_wording_says_has_no_other_words(other):
    assert reworded(other, "held_out") == ()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("first: Lift the {target\n", r"first \(line 1\): 'Lift the {target': expected '}' before end of string; "),
        ("first: Lift it}\n", r"first \(line 1\): 'Lift it}': Single '}' encountered in format string; expected names"),
        ("first: Lift the {}\n", r"first \(line 1\): 'Lift the {}': expected a name in braces, as in {target}, got {}"),
        ("first: Lift the {target:d}\n", r"expected a name in braces, as in {target}, got {target:d}"),
        ("trained: ['Lift the {target}']\n", "first: expected the skill's first wording, found no such key"),
        ("first: [a]\n", r"first \(line 1\): expected a wording with names in braces, got \['a'\]"),
        ("first: Lift the {target}\nmine: Raise it\n", r"mine \(line 2\): expected a list of wordings, got 'Raise it'"),
        (
            "first: Lift the {target}\nmine:\n- Raise the {target}\n- Raise the {tarket}\n",
            r"mine.1 \(line 4\): 'Raise the {tarket}': expected {target} in braces, as in 'first', got {tarket}",
        ),
        ("first: Lift the {target}\nmine: ['Raise {']\n", r"mine.0 \(line 2\): 'Raise {': Single '{' encountered"),
        ("first: Lift the {target}\nmine: [3]\n", r"mine.0 \(line 2\): expected a wording with names in braces, got 3"),
        ("first: Lift the {target}\nslots: {way: [up]}\n", r"slots.way \(line 2\): 'first' has no such name in braces"),
        (
            "first: Lift the {target}\nslots: {target: up}\n",
            r"slots.target \(line 2\): expected a list of words, got 'up'",
        ),
    ],
)
def test_a_wrong_file_of_wordings_is_refused_with_its_name_and_entry(text, complaint, tmp_path, monkeypatch):
    (tmp_path / "wordings").mkdir()
    (tmp_path / "wordings" / "pick_up.yaml").write_text(text)
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))
    with pytest.raises(ConfigError, match=rf"wordings/pick_up\.yaml is not valid: .*{complaint}"):
        reworded("Lift the cube", "mine")
    with pytest.raises(ConfigError, match=rf"wordings/pick_up\.yaml is not valid: .*{complaint}"):
        task_config(parse_yaml("skill: pick_up\nwordings: mine\n"))


def test_wordings_that_name_what_the_skill_lacks_are_refused_when_a_task_is_loaded(tmp_path, monkeypatch):
    (tmp_path / "wordings").mkdir()
    (tmp_path / "wordings" / "pick_up.yaml").write_text("first: Lift the {thing}\nmine: ['Raise the {thing}']\n")
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))
    expected = (
        r"wordings \(line 2\): .*wordings/pick_up\.yaml is not valid: 'Raise the {thing}': unknown name 'thing'; "
    )
    with pytest.raises(ConfigError, match=f"{expected}expected one of: target"):
        task_config(parse_yaml("skill: pick_up\nwordings: mine\n"))


def test_a_changed_file_of_wordings_is_read_again(tmp_path, monkeypatch):
    (tmp_path / "wordings").mkdir()
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))
    for word in ("Raise", "Bring up"):
        (tmp_path / "wordings" / "pick_up.yaml").write_text(
            f"first: Lift the {{target}}\nmine: ['{word} {{target}}']\n"
        )
        (tmp_path / "wordings" / "words_mine.yaml").write_text(f"cube: '{word} Würfel'\n")
        assert reworded("Lift the cube", "mine") == (f"{word} {word} Würfel",)
    (tmp_path / "wordings" / "words_mine.yaml").write_text("cube: [Würfel]\n")
    with pytest.raises(ConfigError, match=r"words_mine\.yaml is not valid: cube \(line 1\): expected the words"):
        reworded("Lift the cube", "mine")


def test_a_role_may_be_named_twice(tmp_path, monkeypatch):
    (tmp_path / "wordings").mkdir()
    text = "first: Take the {target} and lift the {target}\nmine: ['Raise the {target}']\n"
    (tmp_path / "wordings" / "pick_up.yaml").write_text(text)
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))
    assert reworded("Take the red cube and lift the red cube", "mine") == ("Raise the red cube",)
    assert reworded("Take the red cube and lift the mug", "mine") == ()


def test_wordings_ask_for_what_the_verdict_demands():
    """A push must not lift the object, and "over to" would be beside the support."""
    assert not [text for text in english_wordings("push_object") if re.match("move|bring|take|carry", text, re.I)]
    assert all(re.search(r"\bon(to)? (top of )?the {support}", text) for text in english_wordings("place_on"))
