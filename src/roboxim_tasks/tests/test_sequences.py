"""What the YAML file of a longer task may say, and what is drawn and said of its steps."""

from collections import Counter
from dataclasses import replace

import pytest

from roboxim_core.config import parse_yaml
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.wordings import reworded
from roboxim_core.specs import EntitySpec, PhysicalObject, TaskSpec
from roboxim_tasks.config import task_config
from roboxim_tasks.meaning import asks_for_same, read_instruction
from roboxim_tasks.roles import Wording
from roboxim_tasks.sequences.steps import ORDER
from roboxim_tasks.skills import SKILLS

TEXT = """
steps:
- {skill: %s}
- {skill: place_on, roles: {target: cube, support: plate}}
- {skill: push_button, roles: {target: button}}
objects:
  cube: {models: [cube], modifiers: {color: [red]}}
  plate: {models: [plate]}
  button: {models: [button]}
"""
ROTATE = "rotate, roles: {target: cube}"


@pytest.fixture
def tasks(generator, seed_path):
    """Draw the tasks of the first episodes of a longer task, for a purpose and with further keys."""

    def drawn(first, more="", count=1, purpose="test"):
        config = task_config(parse_yaml(TEXT % first + more))
        return [generator.task(seed_path(index, purpose=purpose), config) for index in range(count)]

    return drawn


@pytest.mark.parametrize("paraphrases", [False, True])
def test_steps_in_any_order_are_not_told_in_one(tasks, library, paraphrases):
    said = tasks(ROTATE, f"order: any\nparaphrases: {str(paraphrases).lower()}\n", 12)
    entities = tuple(
        EntitySpec(name=n, model=thing.model, modifiers=thing.modifiers) for n, thing in said[0].objects.items()
    )
    for task in said:
        assert " also " in task.instruction
        assert "then" not in task.instruction.split()
        assert not task.instruction.startswith("First")
        scene = replace(task_config({}).base_scene(), entities=entities)
        (read,) = read_instruction(task.instruction, scene, library).tasks
        assert read.arguments[ORDER] == "any"
        assert asks_for_same(read, task)
        assert reworded(task.instruction, "held_out") == ()
    (then,) = read_instruction(
        "Rotate the red cube clockwise by 90 degrees, then press the button", scene, library
    ).tasks
    assert then.arguments[ORDER] == "fixed"


def test_every_step_has_a_paraphrase_of_its_own(tasks):
    drawn = Counter(
        tuple(task.drawn[name] for name in ("template", "step_1.template", "step_2.template", "step_3.template"))
        for task in tasks(ROTATE, "paraphrases: true\n", 400)
    )
    assert len(drawn) > 70, "of 81"
    for column in zip(*drawn.elements(), strict=True):
        assert all(100 < count < 170 for count in Counter(column).values())
    again = tasks(ROTATE, "paraphrases: true\n", 3)
    assert [task.instruction for task in again] == [
        task.instruction for task in tasks(ROTATE, "paraphrases: true\n", 3)
    ]


def test_drawn_arguments_of_a_step_are_recorded(tasks):
    said = tasks(f"{ROTATE}, arguments: {{direction: [clockwise, counter-clockwise], angle_deg: [45, 90]}}", "", 30)
    assert len({(task.drawn["step_1.direction"], task.drawn["step_1.angle_deg"]) for task in said}) == 4
    for task in said:
        assert f" {task.drawn['step_1.direction']} by {task.drawn['step_1.angle_deg']} degrees" in task.instruction
        assert "step_1.template" not in task.drawn


@pytest.mark.parametrize(
    ("first", "complaint"),
    [
        ("arguments: {angle_deg: [a]}", r"arguments.angle_deg \(line 3\): values must be a number, got 'a'"),
        ("arguments: {direction: [1]}", r"arguments.direction \(line 3\): expected str, got 1"),
        ("arguments: {direction: [left]}", r"arguments.direction \(line 3\): unknown direction 'left'"),
        (
            "arguments: {angle_deg: [20]}, lenient: {tolerance_deg: 30}",
            r"arguments.angle_deg \(line 3\): needs 0 < tol",
        ),
        ("templates: ['Turn the {tarket}']", r"templates \(line 3\): 'Turn the {tarket}': unknown name 'tarket'"),
        ("templates: ['Turn the {target']", r"templates \(line 3\): 'Turn the {target': expected '}'"),
        ("templates: [3]", r"templates \(line 3\): templates must be .*, not 3"),
    ],
)
def test_wrong_arguments_and_templates_of_a_step_are_refused_when_it_is_loaded(first, complaint):
    with pytest.raises(ConfigError, match=rf"steps\.0\.{complaint}"):
        task_config(parse_yaml(TEXT % f"{ROTATE}, {first}"))


@pytest.mark.parametrize("key", ["parameters", "lenient"])
def test_objects_that_suit_no_threshold_of_a_step_are_refused(key):
    step = "open_drawer, roles: {target: cabinet}, parameters: {open_m: 0.1}, lenient: {open_m: 0.1}"
    text = (TEXT % step).replace(
        "button: {models: [button]}", "button: {models: [button]}\n  cabinet: {models: [cabinet]}"
    )
    assert task_config(parse_yaml(text)).steps[0].lenient.open_m == 0.1
    with pytest.raises(ConfigError, match=r"steps\.0 \(line 3\): .*open_m"):
        task_config(parse_yaml(text.replace(f"{key}: {{open_m: 0.1}}", f"{key}: {{open_m: 0.5}}")))


@pytest.mark.parametrize(
    ("instruction", "named"),
    [
        ("Pick up the red cube", {"target"}),
        ("Put the red cube on the cube", {"target", "support"}),
        ("Put it on the cube", {"support"}),
        ("Put it on the icecube", set()),
    ],
)
def test_a_role_whose_noun_is_only_part_of_anothers_description_is_not_named(instruction, named, library):
    red = PhysicalObject(entity="a", model="cube", name="cube", modifiers={"color": "red"})
    objects = {"target": red, "support": PhysicalObject(entity="b", model="cube", name="cube")}
    task = TaskSpec(skill="stack", objects=objects, instruction=instruction)
    assert Wording.of_task(task, SKILLS["stack"].roles, library).named == named


def test_what_a_step_turns_upright_lies_whatever_its_role_is_called(generator, seed_path):
    text = """
steps:
- {skill: turn_upright, roles: {target: can}}
- {skill: place_left_of, roles: {target: cube, reference: can}}
objects: {can: {models: [soda_can]}, cube: {models: [cube]}}
reset: {cameras: {names: []}}
"""
    config = task_config(parse_yaml(text))
    assert config.reset["toppled"].roles == ("can",)
    drawn = generator.draw(seed_path(0), config)
    can, cube = (drawn.scene.entity(name).pose.rotation.apply([0.0, 0.0, 1.0])[2] for name in ("can", "cube"))
    assert abs(can) < 0.1 < abs(cube)
    with pytest.raises(ConfigError, match=r"reset\.toppled.*no role 'target' to topple; expected one of: can, cube"):
        task_config(parse_yaml(text.replace("reset: {", "reset: {toppled: {roles: target}, ")))
    with pytest.raises(ConfigError, match=r"reset\.distractors.*near: is the distance from the role 'target', and"):
        task_config(parse_yaml(text.replace("reset: {", "reset: {distractors: {near: {}}, ")))


def test_the_joints_of_every_step_are_drawn_as_what_the_task_is_about(generator, seed_path, library):
    text = """
steps:
- {skill: flip_switch, roles: {target: switch}}
- {skill: turn_knob, roles: {target: knob}}
objects: {switch: {models: [switch]}, knob: {models: [knob]}}
reset: {cameras: {names: []}, joints: {target: [0.5], others: [0.0], roles: {switch: {target: [1.0]}}}}
"""
    scene = generator.draw(seed_path(0), task_config(parse_yaml(text))).scene
    found = {}
    for name in ("switch", "knob"):
        (joint,) = library.object(name).joints
        position = scene.entity(name).joint_positions[joint.name]
        found[name] = (position - joint.lower) / (joint.upper - joint.lower)
    assert found == pytest.approx({"switch": 1.0, "knob": 0.5})
    with pytest.raises(ConfigError, match=r"roles.lever: no such role; expected one of: knob, switch"):
        task_config(parse_yaml(text.replace("{switch: {target: [", "{lever: {target: [")))
