"""Explanations of episodes that failed by planted causes: which are named."""

from __future__ import annotations

import json
import re
import time
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import yaml
from planted_causes import FailsWhere
from scene_measures import scene_measures

from roboxim_bringup.core_graph import CoreActor
from roboxim_core.config_folders import named_config
from roboxim_core.episode import Draw, EpisodeResult, RunConfig
from roboxim_core.errors import ConfigError, SimError
from roboxim_core.plain_data.merging import merged
from roboxim_core.policies import PolicyDescription
from roboxim_core.seeds import SeedPath
from roboxim_core.vision.cameras import load_camera
from roboxim_runs.answers import explaining
from roboxim_runs.answers.changes import Change, changes_of
from roboxim_runs.answers.explaining import ExplainConfig, _Repeats, explain
from roboxim_runs.answers.trying import TryBench
from roboxim_runs.episodes.task_choice import task_text as task_text_of
from roboxim_tasks.meaning import asks_for_same, read_instruction
from roboxim_tasks.sequences.steps import steps_of

CHANGED = {
    "paraphrases": True,
    "distractors": {"minimum": 1},
    "reset": {"cameras": {"names": ["workspace"]}, "physics": {}},
}
CAUSES = {
    "distractors": {"distractors": [1, 9]},
    "color": {"color": "?"},
    "camera": {"camera": [0.03, 1]},
    "light": {"light": [0, 2.2]},
    "physics": {"friction": [0, 0.65]},
    "words": {"paraphrased": [1, 1]},
    "start": {"start": [0.12, 9]},
    "place": {"x": [0, 0.46]},
}
"""Change to the condition that it takes away; ``?`` is the drawn colour."""
PAIRS = (("distractors", "light"), ("camera", "start"))
IMAGES = RunConfig(image_width=64, image_height=64)


def task_text():
    task = yaml.safe_load(named_config("tasks", "pick_cube_randomised").read_text())
    return yaml.safe_dump(merged(task, CHANGED))


class Planted(_Repeats):
    """Repetitions whose outcomes are planted by the change's name."""

    OUTCOMES = {"": "00000", "light": "01111", "words": "11111", "color": "00", "start": "x"}

    def __init__(self, *_):
        self.infeasible = set()

    def _one(self, change, number):
        return {"0": False, "1": True, "x": None}[self.OUTCOMES[change.name][number]]


def test_a_change_is_taken_up_again_if_a_later_cause_lets_it_be_shown(monkeypatch):
    changes = [Change(name=name, words=name, apply=None) for name in ("light", "color", "start", "words")]
    monkeypatch.setattr(explaining, "changes_of", lambda *_: changes)
    monkeypatch.setattr(explaining, "_Repeats", Planted)
    seen = []
    found = explain(MagicMock(), MagicMock(), MagicMock(), on_tally=seen.append)
    assert {(one.name, one.successes, one.runs) for one in found.tried} == {
        ("light", 4, 5), ("words", 5, 5), ("color", 0, 2),
    }  # fmt: skip
    assert found.kind == "several"
    assert [one.name for one in seen] == ["", "light", "color", "words", "light", "color"]


def explained(monkeypatch, actor, *, now, before):
    """Explain a recorded failure of bc (version A), whose repetitions all end as given: outcome and hash of states."""
    monkeypatch.setattr(explaining, "changes_of", lambda *_: [Change(name="light", words="in light", apply=as_it_is)])
    monkeypatch.setattr(explaining, "recorded_run", lambda _: (RunConfig(), Draw(task=None, scene=None, max_steps=1)))
    monkeypatch.setattr(_Repeats, "_started", lambda _self, scene, _number: scene)
    ended = [
        EpisodeResult(episode_id="e", index=0, outcome=outcome, final_state_hash=states) for outcome, states in (
            before, now)
    ]  # fmt: skip
    tried = SimpleNamespace(result=ended[1], success=now[0] == "success", began=True)
    bench = SimpleNamespace(graph=MagicMock(), run=lambda *_, **__: tried)
    info = SimpleNamespace(
        episode_id="e", actor="bc", actor_version="A", index=0, run_seed=0, purpose="eval", attempt=0
    )
    told = []
    found = explain(
        bench, info, SimpleNamespace(describe=lambda: PolicyDescription(name=actor[0], version=actor[1])),
        ExplainConfig(repeats=3), recorded=ended[0], on_doubt=told.append,
    )  # fmt: skip
    assert tuple(told) == found.doubts
    return found


def as_it_is(task, scene, _):
    return task, scene


FAILED = ("failure", "abc")


def test_another_policy_than_the_recorded_one_is_named_or_refused(monkeypatch):
    assert explained(monkeypatch, ("bc", "A"), now=FAILED, before=FAILED).doubts == ()
    for given, said in ((("bc", "B"), r"'bc' \(B\) is given"), (("zero", ""), "'zero' is given")):
        (doubt,) = explained(monkeypatch, given, now=("failure", "xyz"), before=FAILED).doubts
        assert re.search(rf"e was recorded with the policy 'bc' \(A\), and {said}: what follows", doubt)
        with pytest.raises(ConfigError, match=rf"{said}, which does not repeat the .* \(failure and success\); give"):
            explained(monkeypatch, given, now=("success", "xyz"), before=FAILED)


def test_a_success_is_refused_before_anything_runs(monkeypatch):
    with pytest.raises(ConfigError, match="e succeeded, so that it has no failure to explain"):
        explained(monkeypatch, ("bc", "A"), now=FAILED, before=("success", "abc"))


def test_an_exact_repetition_that_ends_otherwise_than_the_recording_is_named(monkeypatch):
    for now in (("failure", "xyz"), ("success", "xyz")):
        (doubt,) = explained(monkeypatch, ("bc", "A"), now=now, before=FAILED).doubts
        assert f"the exact repetition of e ends otherwise than the recording (failure and {now[0]})" in doubt
    assert explained(monkeypatch, ("bc", "A"), now=FAILED, before=("failure", "")).doubts == ()  # of another program


@pytest.fixture(scope="module")
def bench():
    try:
        made = TryBench()
    except SimError as error:
        pytest.skip(str(error))
    with made:
        yield made


def failures(bench, names, wanted):
    """Yield failed episodes that have all conditions of some causes, with the policy that they fail."""
    number, found = 0, 0
    while found < wanted:
        seed = SeedPath(run_seed=41, purpose="eval", index=number)
        number += 1
        draw = bench.graph.tasks.draw(seed, task_text())
        measures = scene_measures(draw.task, draw.scene, bench.graph.sim.library)
        conditions = [dict(CAUSES[name]) for name in names]
        for condition in conditions:
            if condition.get("color") == "?":
                condition["color"] = measures["color"]
        if not all(_holds(measures, condition) for condition in conditions):
            continue
        actor = CoreActor(FailsWhere(conditions=conditions))
        tried = bench.run(draw, actor, seed, config=IMAGES)
        if tried.info is not None and not tried.success:
            found += 1
            yield tried.info, actor


def _holds(measures, condition):
    ((name, wanted),) = condition.items()
    value = measures.get(name)
    return value == wanted if isinstance(wanted, str) else value is not None and wanted[0] <= value <= wanted[1]


@pytest.mark.thorough
def test_only_what_is_not_nominal_can_be_changed(bench):
    draw = bench.graph.tasks.draw(SeedPath(run_seed=41, purpose="eval", index=0), task_text())
    info = bench.run(draw, CoreActor(FailsWhere(conditions=[{"distractors": [0, 9]}])), SeedPath(
        run_seed=41, purpose="eval", index=0), config=IMAGES).info  # fmt: skip
    changes = {change.name: change for change in changes_of(info, bench.graph.sim.library)}
    assert {"distractors", "color", "camera", "light", "physics", "start"} <= changes.keys()
    for name, change in changes.items():
        task, scene = change.apply(info.task, info.scene, 0)
        assert (task, scene) != (info.task, info.scene), name
        if name == "distractors":
            assert all(not role.startswith("distractor") for role in task.objects)
            assert len(scene.entities) == len(info.scene.entities) - sum(
                "distractor" in e.name for e in info.scene.entities
            )
        if name == "color":
            assert task.objects["target"].modifiers["color"] in task.instruction
    with pytest.raises(ConfigError, match="unknown change 'colour'.*color"):
        ExplainConfig(only=("colour",))


def drawn(bench, task_config, index=0):
    """Return what changes are chosen by: an episode of a task that did not run."""
    draw = bench.graph.tasks.draw(SeedPath(run_seed=7, purpose="eval", index=index), task_config)
    described = json.dumps({"task": json.loads(draw.config_json)})
    return SimpleNamespace(task=draw.task, scene=draw.scene, config_json=described, episode_id="drawn")


@pytest.mark.parametrize(
    ("views", "offered"), [("[whole]", False), ("[whole, workspace_left]", True), ("[workspace_left]", False)]
)
def test_a_camera_at_its_tasks_view_and_on_the_hand_is_nominal(bench, views, offered):
    task = yaml.safe_load(named_config("tasks", "pick_cube").read_text())
    cameras = {"names": ["workspace", "wrist"], "views": {"workspace": {"values": yaml.safe_load(views)}}}
    task = merged(task, {"reset": {"cameras": cameras}})
    infos = [drawn(bench, yaml.safe_dump(task), index) for index in range(6)]
    changes = [change for info in infos for change in changes_of(info, bench.graph.sim.library)]
    moved = [change for change in changes if change.name == "camera"]
    assert bool(moved) == offered
    for change in moved:
        _, scene = change.apply(infos[0].task, infos[0].scene, 0)
        assert (scene.cameras[0].name, scene.cameras[0].pose) == ("workspace", load_camera("whole").pose)
        assert scene.cameras[1] == infos[0].scene.cameras[1]


def test_nothing_to_change_names_what_was_asked_for(bench):
    info = drawn(bench, task_text_of("pick_cube"))
    with pytest.raises(ConfigError, match="can be changed by camera: that is nominal"):
        explain(bench, info, MagicMock(), ExplainConfig(only=("camera",)))


COLORED = {
    "material": """
skill: pick_up
objects: {target: {models: [cube], modifiers: {size: [small, large], color: [red, blue], material: [wooden, metal]}}}
""",
    "usual colour taken": """
skill: pick_up
objects: {target: {models: [cube], modifiers: {color: [blue, green]}}}
distractors: {minimum: 2, maximum: 2, models: [cube]}
""",
    "steps": """
steps: [{skill: push_object, roles: {target: box}}, {skill: pick_up, roles: {target: cube}}]
objects: {box: {models: [cube], modifiers: {color: [red]}}, cube: {models: [cube], modifiers: {color: [green]}}}
""",
}


@pytest.mark.parametrize("name", COLORED)
def test_an_instruction_means_the_object_of_another_colour_alone(bench, name):
    library = bench.graph.sim.library
    for index in range(3):
        info = drawn(bench, COLORED[name], index)
        (change,) = (change for change in changes_of(info, library) if change.name == "color")
        for number in range(4):
            task, scene = change.apply(info.task, info.scene, number)
            assert task.objects != info.task.objects
            (meant,) = read_instruction(task.instruction, scene, library).tasks
            assert asks_for_same(meant, task), task.instruction
            steps = [step.instruction.lower() for step in steps_of(task)]
            assert ", then ".join(steps) == task.instruction.lower()


@pytest.mark.thorough
def test_a_planted_cause_is_named(bench):
    info, actor = next(failures(bench, ["light"], 1))
    found = explain(bench, info, actor, ExplainConfig(only=("light", "color")))
    assert (found.kind, found.causes[0].name) == ("single", "light")
    assert found.sentence.startswith("In the nominal light it succeeds 5 of 5")


@pytest.mark.thorough
@pytest.mark.slow
def test_nine_of_ten_planted_causes_are_named(bench):
    """The table of docs/how-to/answers.md: run this file as a program."""
    rows = list(benchmark(bench, 2))
    right = sum(row[1] for row in rows)
    assert right >= 0.9 * sum(row[2] for row in rows), rows


def benchmark(bench, wanted):
    """Yield the causes that were planted, how often they were named, of how many, runs and seconds of an episode."""
    for names in [*([name] for name in CAUSES), *PAIRS]:
        right, runs, began = 0, bench.runs, time.monotonic()
        for info, actor in failures(bench, names, wanted):
            found = explain(bench, info, actor)
            expected = "single" if len(names) == 1 else "together"
            told = {name for cause in found.causes for name in cause.name.split("+")}
            right += found.kind == expected and told == set(names)
        yield "+".join(names), right, wanted, (bench.runs - runs) / wanted, (time.monotonic() - began) / wanted


def main():
    """Print the table of docs/how-to/answers.md."""
    with TryBench() as bench:
        for name, right, wanted, runs, seconds in benchmark(bench, 2):
            print(f"| {name} | {right} of {wanted} | {runs:.0f} | {seconds:.0f} s |", flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
