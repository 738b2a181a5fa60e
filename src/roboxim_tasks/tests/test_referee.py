"""An instruction names exactly one solution in its scene, whatever the skill; the referee here knows only words."""

import re
from dataclasses import dataclass, replace

import pytest

from roboxim_core.errors import ErrorCode, TaskError
from roboxim_core.models.modifiers import FINISHES, PALETTE
from roboxim_core.poses import Pose
from roboxim_core.specs import EntitySpec, PhysicalObject, SceneSpec
from roboxim_tasks.components import COMPONENTS, ResetComponent, register
from roboxim_tasks.config import load_task_config, parse_task_config
from roboxim_tasks.meaning import read_instruction
from roboxim_tasks.roles import fits_description, task_objects
from roboxim_tasks.skills import SKILLS

SIZES = {"small", "medium", "large"}


def is_true_of(word, thing, library):
    """Whether a word is true of a thing that is looked at, and held against what it is usually like."""
    values = {kind: modifier.default for kind, modifier in library.object_modifiers(thing.model).items()}
    if word not in SIZES:
        return word in {str(value) for value in {**values, **thing.modifiers}.values()}
    if "size" not in values:
        return False
    wanted = library.object_modifiers(thing.model)["size"].factors[word]
    now, usual = (library.object(thing.model, modifiers).size[2] for modifiers in (thing.modifiers, {}))
    if "scale" not in thing.modifiers:
        return now / usual == pytest.approx(wanted, abs=1e-6)
    return (now / usual <= 1.1 * wanted or wanted > 1) and (now / usual >= 0.9 * wanted or wanted < 1)


def spoken_of(instruction, library):
    """What an instruction speaks of: a noun and what is said of it, in the order of the words."""
    nouns = sorted({library.object(model).name for model in library.object_ids}, key=len, reverse=True)
    said = "|".join(sorted({*SIZES, *PALETTE, *FINISHES}))
    found = re.findall(rf"((?:\b(?:{said}) )*)\b({'|'.join(nouns)})\b", instruction)
    return [(noun, words.split()) for words, noun in found]


def judge(task, scene_things, library):
    """Refuse a task whose words do not lead to its objects, each of them alone."""
    rest, sought = dict(scene_things), [thing.entity for thing in task_objects(task)]
    for noun, words in spoken_of(task.instruction, library):
        fits = [
            name
            for name, thing in scene_things.items()
            if thing.name == noun and all(is_true_of(word, thing, library) for word in words)
        ]
        assert len(fits) == 1, (task.instruction, noun, words, fits)
        assert fits[0] in sought, task.instruction
        rest.pop(fits[0], None)
    for role, of_skill in SKILLS[task.skill].roles.items():
        entity = task.objects[role].entity
        if entity in rest:  # not named: then nothing else may fill the role
            fits = [n for n, thing in rest.items() if of_skill.suits(library.object(thing.model, thing.modifiers))]
            assert fits == [entity], task.instruction


def judge_tasks(config, generator, library, seed_path, number):
    for index in range(number):
        task = generator.task(seed_path(index), config)
        judge(task, {thing.entity: thing for thing in task.objects.values()}, library)


@pytest.mark.parametrize("skill", sorted(SKILLS))
def test_no_other_object_of_the_scene_fits_what_the_instruction_names(skill, generator, library, seed_path):
    judge_tasks(load_task_config(skill), generator, library, seed_path, 40)


CUBES = "models: {values: [cube]}, modifiers"
SEVERAL = "distractors: {minimum: 2, maximum: 3, models: {values: [cube, plate, cabinet, apple, button]}, modifiers: "
USERS = {
    "a role that no template names": f"""
skill: open_drawer
paraphrases: true
objects: {{target: {{models: {{values: [cabinet]}}, modifiers: {{color: {{values: [white]}}}}}}}}
{SEVERAL} {{color: {{values: [blue]}}}}}}
""",
    "no role named": f"""
skill: pick_up
templates: {{values: [Pick it up, "Pick up the {{target}}"]}}
objects: {{target: {{{CUBES}: {{color: {{values: [red]}}}}}}}}
{SEVERAL} {{color: {{values: [blue]}}}}}}
""",
    "one of two roles named": f"""
skill: stack
templates: {{values: ["Stack the {{target}} on the other", "Stack the {{target}} on the {{support}}"]}}
objects:
  support: {{{CUBES}: {{color: {{values: [red, green]}}}}}}
  target: {{{CUBES}: {{color: {{values: [red, green]}}}}}}
{SEVERAL} {{color: {{values: [blue, yellow]}}}}}}
""",
    "size words against scales": f"""
skill: pick_up
objects: {{target: {{{CUBES}: {{size: {{values: [small, medium, large]}}}}}}}}
distractors: {{minimum: 2, maximum: 3, {CUBES}: {{scale: {{lower: 0.6, upper: 1.4}}}}}}
""",
    "size words and scales together": f"""
skill: pick_up
objects: {{target: {{{CUBES}: {{size: {{values: [small, large]}}, scale: {{lower: 0.7, upper: 1.4}}}}}}}}
distractors: {{minimum: 1, maximum: 2, {CUBES}: {{size: {{values: [small, medium, large]}}}}}}
""",
}


@pytest.mark.parametrize("name", USERS)
def test_whatever_a_user_configures(name, generator, library, seed_path):
    judge_tasks(parse_task_config(USERS[name]), generator, library, seed_path, 60)


@pytest.mark.parametrize(
    "text",
    [
        "skill: open_drawer\ndistractors: {minimum: 1, maximum: 1, models: {values: [cabinet]}, "
        "modifiers: {color: {values: [blue]}}}\n"
        "objects: {target: {models: {values: [cabinet]}, modifiers: {color: {values: [white]}}}}",
        f"skill: pick_up\ntemplates: {{values: [Pick it up]}}\ndistractors: {{minimum: 1, maximum: 1, {CUBES}: "
        "{color: {values: [blue]}}}\nobjects: {target: {modifiers: {color: {values: [red]}}}}",
        f"skill: pick_up\nobjects: {{target: {{{CUBES}: {{size: {{values: [small]}}}}}}}}\n"
        f"distractors: {{minimum: 1, maximum: 1, {CUBES}: {{scale: {{values: [0.6, 0.8, 0.85]}}}}}}",
    ],
    ids=["two cabinets", "it", "scaled down"],
)
def test_what_words_cannot_tell_apart_is_refused(text, generator, seed_path):
    with pytest.raises(TaskError, match="distractor_distinct") as error:
        generator.task(seed_path(0), parse_task_config(text))
    assert error.value.code == ErrorCode.RESET_INFEASIBLE


def test_an_object_that_contradicts_its_size_word_is_refused(generator, seed_path):
    text = f"objects: {{target: {{{CUBES}: {{size: {{values: [small]}}, scale: {{values: [1.3]}}}}}}}}"
    with pytest.raises(TaskError, match="size_true"):
        generator.task(seed_path(0), parse_task_config(text))


@dataclass(frozen=True, kw_only=True)
class Nothing:
    pass


def test_a_reset_component_of_one_s_own_cannot_make_it_ambiguous(generator, seed_path):
    class Another(ResetComponent):
        name, Config, places = "another", Nothing, True

        def reset(self, scene, context):
            spare = EntitySpec(
                name="spare", model="cube", modifiers={"color": "red"}, pose=Pose(position=(0.3, 0.4, 0.0225))
            )
            return replace(scene, entities=(*scene.entities, spare))

    class Recoloured(ResetComponent):
        name, Config, places = "recoloured", Nothing, True

        def reset(self, scene, context):
            return replace(scene, entities=tuple(replace(e, modifiers={"color": "blue"}) for e in scene.entities))

    for component in (Another, Recoloured):
        register(component)
        try:
            config = parse_task_config(
                f"objects: {{target: {{modifiers: {{color: {{values: [red]}}}}}}}}\n"
                f"reset: {{{component.name}: {{}}}}\nmax_draws: 3"
            )
            with pytest.raises(TaskError, match="instruction_unambiguous"):
                generator.draw(seed_path(0), config)
        finally:
            COMPONENTS._items.pop(component.name)


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


@pytest.mark.parametrize(
    ("modifiers", "color", "fits"),
    [
        ({"material": "rubber"}, "black", True), ({"material": "rubber"}, "red", False),
        ({"material": "rubber", "color": "red"}, "black", False), ({"material": "rubber", "color": "red"}, "red", True),
        ({"material": "plastic"}, "red", True), ({"material": "wooden"}, "tan", True),
    ],
)  # fmt: skip
def test_the_colour_of_a_material_counts_where_none_is_given(modifiers, color, fits, library):
    named = PhysicalObject(entity="target", model="cube", name="cube", modifiers={"color": color})
    assert fits_description(replace(named, entity="other", modifiers=modifiers), named, library) is fits
    scene = SceneSpec(entities=(EntitySpec(name="other", model="cube", modifiers=modifiers),))
    assert bool(read_instruction(f"Pick up the {color} cube", scene, library).tasks) is fits
