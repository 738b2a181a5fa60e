"""Tasks of several steps: what is drawn, how it is judged, and that the expert solves what is shipped."""

from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from roboxim_bringup.core_graph import CoreActor, CoreGraph
from roboxim_core.config import named_config
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import EntitySpec, TaskSpec
from roboxim_tasks.config import load_task_config, parse_task_config
from roboxim_tasks.meaning import asks_for_same, read_instruction
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.sequences.steps import arguments_of, own_objects, steps_of

SHIPPED = ("two_steps", "tidy_up", "drawer_chain")
DRAWN = SeedPath(run_seed=7, purpose="demo", index=0)


def blind(name: str, **change) -> str:
    data = yaml.safe_load(Path(named_config("tasks", name)).read_text())
    data["reset"]["cameras"] = {"names": []}
    return yaml.safe_dump(data | change)


def made_of(task: TaskSpec, *steps: TaskSpec) -> TaskSpec:
    """Return another task about the same objects; a single step stays a task of one skill."""
    if len(steps) == 1:
        return steps[0]
    whole = {thing.entity: role for role, thing in task.objects.items()}
    pairs = [(s, {own: whole[entity] for own, entity in own_objects(s).items()}) for s in steps]
    return replace(task, skill="+".join(s.skill for s in steps), arguments=arguments_of(pairs, "fixed"))


class Doing:
    """The expert of another task than the one that is judged."""

    def __init__(self, expert, other):
        self._expert = expert
        self._other = other

    def describe(self):
        return self._expert.describe()

    def reset(self, start):
        self._expert.reset(replace(start, task=self._other(start.task)))

    def act(self, window):
        return self._expert.act(window)


def play(folder, name, other=None, indices=(0,), *, stop=True, **change):
    with CoreGraph(folder) as graph:
        ports = graph.ports
        if other is not None:
            ports = replace(ports, actor=CoreActor(Doing(ports.actor, other)))
        config = RunConfig(
            run_seed=7, purpose="demo", task_config=blind(name, **change), keep="none", stop_on_success=stop
        )
        runner = EpisodeRunner(ports, config)
        return [runner.run_index(index) for index in indices]


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_sequences_say_all_their_steps(name):
    config = load_task_config(name)
    task = EpisodeGenerator(ModelLibrary()).task(DRAWN, config)
    steps = steps_of(task)
    assert task.drawn["length"] == str(len(config.steps)) == str(len(steps))
    assert [step.skill for step in steps] == [step.skill for step in config.steps]
    assert all(step.instruction for step in steps)
    assert {thing.entity for step in steps for thing in step.objects.values()} == {
        thing.entity for thing in task.objects.values()
    }


def test_sentence_joins_the_steps():
    task = EpisodeGenerator(ModelLibrary()).task(DRAWN, load_task_config("drawer_chain"))
    opened, put, shut = (step.instruction for step in steps_of(task))
    assert task.instruction == f"{opened}, then {put[0].lower()}{put[1:]}, then {shut[0].lower()}{shut[1:]}"


@pytest.mark.parametrize("name", SHIPPED[:1] + SHIPPED[2:])
def test_a_sentence_of_several_steps_is_read(name):
    library, config = ModelLibrary(), load_task_config(name)
    generator = EpisodeGenerator(library)
    task, other = (generator.task(replace(DRAWN, index=index), config) for index in (0, 1))
    entities = tuple(
        EntitySpec(name=thing.entity, model=thing.model, modifiers=thing.modifiers) for thing in task.objects.values()
    )
    scene = replace(config.base_scene(), entities=entities)
    reading = read_instruction(task.instruction, scene, library)
    assert (reading.understood, reading.absent) == (True, ())
    assert any(asks_for_same(read, task) for read in reading.tasks)
    assert not any(asks_for_same(read, task) for read in read_instruction(other.instruction, scene, library).tasks)


def test_expert_does_both_steps(tmp_path):
    (result,) = play(tmp_path, "two_steps")
    assert result.outcome == "success"
    assert not result.recovered
    assert result.verdict.predicates["steps_share"] == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_expert_does_what_is_shipped(tmp_path, name):
    results = play(tmp_path, name, indices=range(3))
    assert [result.outcome for result in results] == ["success"] * 3, [result.reason for result in results]


CHEATS = {
    "first_step_only": (lambda task, one, two: (one,), "step_2_not_pressed", 0.5),
    "second_step_only": (lambda task, one, two: (two,), "step_1_not_on_support", 0.0),
    "wrong_order": (lambda task, one, two: (two, one), "step_2_not_pressed", 0.5),
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", CHEATS)
def test_cheats_fail_and_say_which_step(tmp_path, name):
    steps, reason, share = CHEATS[name]
    (result,) = play(tmp_path, "two_steps", lambda task: made_of(task, *steps(task, *steps_of(task))), stop=False)
    assert result.outcome == "failure"
    assert result.verdict.predicates["steps_share"] == share
    assert (result.reason, result.verdict.reason) == (reason, reason)


@pytest.mark.thorough
def test_a_step_that_is_undone_does_not_count(tmp_path):
    steps = [
        {"skill": "open_drawer", "roles": {"target": "cabinet"}, "parameters": {"drawer": "top"}},
        {"skill": "push_button", "roles": {"target": "target"}},
    ]
    objects = {"cabinet": {"models": {"values": ["cabinet"]}}, "target": {"models": {"values": ["button"]}}}

    def opened_pushed_shut(task):
        first, second = steps_of(task)
        shut = {"drawer": "top", "joint": first.arguments["joint"]}
        closed = replace(first, skill="close_drawer", arguments=shut, instruction="Close the top drawer")
        return made_of(task, first, second, closed)

    change = {"steps": steps, "objects": objects, "distractors": {}}
    (result,) = play(tmp_path, "drawer_chain", opened_pushed_shut, stop=False, **change)
    assert (result.outcome, result.reason) == ("failure", "step_1_undone")
    assert result.success_ever
    assert result.verdict.predicates["steps_share"] == 0.5


@pytest.mark.thorough
def test_any_order_counts_in_any_order(tmp_path):
    (result,) = play(tmp_path, "two_steps", lambda task: made_of(task, *reversed(steps_of(task))), order="any")
    assert result.outcome == "success"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": [{"skill": "push_button", "roles": {"target": "button"}}]}, "2 to 5 steps, got 1"),
        ({"order": "random"}, "unknown name 'random'"),
        ({"skill": "pick_up"}, "stack\\+push_button"),
        ({"steps": [{"skill": "stack"}, {"skill": "push_button", "roles": {"target": "knob"}}]}, "unknown name 'knob'"),
        ({"steps": [{"skill": "stack"}, {"skill": "push"}]}, "unknown name 'push'"),
        ({"arguments": {"drawer": {"values": ["top"]}}}, "below its steps"),
        (
            {
                "order": "any",
                "steps": [*[{"skill": "push_button", "roles": {"target": "button"}}] * 2, {"skill": "stack"}],
            },
            "asks for the same as step 1, so that one action would do both",
        ),
    ],
)
def test_wrong_sequences_are_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        parse_task_config(blind("two_steps", **change))


@pytest.mark.thorough
def test_cameras_see_all_objects_of_a_long_task(tmp_path):
    """Draw a scene with its cameras: five named objects, each of which is drawn once more by itself."""
    with CoreGraph(tmp_path) as graph:
        draw = graph.ports.scenes.draw(DRAWN, Path(named_config("tasks", "tidy_up")).read_text())
    assert len(draw.task.objects) == 5
    assert draw.scene.cameras


CUBE, OTHER = ({"models": {"values": ["cube"]}, "modifiers": {"color": {"values": [c]}}} for c in ("red", "blue"))
BOWL = {"models": {"values": ["bowl"]}}
ABOUT_ONE = {
    "turned_twice": ([{"skill": "rotate"}, {"skill": "rotate"}], {}),
    "taken_from_another": ([{"skill": "stack", "roles": {"support": "other"}}, {"skill": "pick_up"}], {"other": OTHER}),
    "lifted_and_put": ([{"skill": "pick_up"}, {"skill": "put_into", "roles": {"container": "bowl"}}], {"bowl": BOWL}),
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", ABOUT_ONE)
def test_expert_goes_on_with_the_object_of_the_step_before(tmp_path, name):
    steps, others = ABOUT_ONE[name]
    change = {"steps": steps, "objects": {"target": CUBE, **others}, "distractors": {}}
    (result,) = play(tmp_path, "two_steps", **change)
    assert (result.outcome, result.reason) == ("success", "")
