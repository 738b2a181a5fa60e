import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
from browser import wait_for

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.config import digest
from roboxim_core.episode import Draw, EpisodeResult, EpisodeRunner, RunConfig
from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary
from roboxim_recorder.bag import BagReader
from roboxim_runs.episodes.task_choice import task_text
from roboxim_studio.editing import composition as edits
from roboxim_studio.editing.document import with_instruction
from roboxim_studio.episode.film import read_film
from roboxim_tasks.choices import Choice
from roboxim_tasks.config import load_task_config, parse_task_config
from roboxim_tasks.sequences.steps import task_of

LIBRARY = ModelLibrary()
FILM = SimpleNamespace(result=EpisodeResult(episode_id="", index=0))


@pytest.fixture
def made():
    return edits.composed(task_text("pick_cube"))


def test_a_composed_task_is_the_task_that_its_yaml_describes(made):
    made = edits.with_models(made, "target", ["cube", "apple"], LIBRARY)
    made = edits.with_modifier(made, "target", "color", Choice(values=("red", "blue")))
    made = edits.with_templates(made, ["Bitte den {target} aufheben", "Pick the {target}"])
    made = edits.with_distractors(made, 1, 3)
    made = edits.with_models(made, edits.DISTRACTORS, ["banana", "apple"], LIBRARY)
    made = edits.with_parameter(made, "lift_m", 0.08)
    config = parse_task_config(made.text)
    assert config == made.config
    assert config.objects["target"].models.values == ("cube", "apple")
    assert config.objects["target"].modifiers["color"].values == ("red", "blue")
    assert config.templates.values == ("Bitte den {target} aufheben", "Pick the {target}")
    assert (config.distractors.minimum, config.distractors.maximum) == (1, 3)
    assert config.distractors.modifiers["color"].values == ("red", "green", "yellow")  # the cubes' that fruit has
    assert config.parameters.lift_m == 0.08
    assert config.reset == edits.composed(task_text("pick_cube")).config.reset
    other = edits.with_skill(made, "put_into")
    assert set(other.roles) == {"container", "target", edits.DISTRACTORS}
    assert other.config.distractors == config.distractors


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda made: edits.with_models(made, "target", [], LIBRARY), "at least one"),
        (lambda made: edits.with_models(made, "target", ["cabinet"], LIBRARY), "graspable"),
        (lambda made: edits.with_models(made, "no_role", ["cube"], LIBRARY), "no role 'no_role'"),
        (lambda made: edits.with_modifier(made, "target", "color", Choice(values=("loud",))), "loud"),
        (lambda made: edits.with_templates(made, ["Pick the {thing}"]), "thing"),
        (lambda made: edits.with_distractors(made, 4, 2), "minimum"),
        (lambda made: edits.with_parameter(made, "lift_m", "high"), "lift_m"),
        (lambda made: edits.with_skill(made, "/tmp/mine.py:Skill"), "unknown skill"),
    ],
)
def test_what_generate_would_refuse_is_refused_while_composing(made, change, why):
    with pytest.raises(ConfigError, match=why):
        change(made)


@pytest.mark.parametrize("task", ["two_steps", "skill_object_baseline"])
def test_tasks_of_several_skills_are_drawn_but_not_composed(studio, task):
    with pytest.raises(ConfigError, match="not composed"):
        edits.composed(task_text(task))
    studio.compose._task.value = task
    studio.compose._choose()
    assert studio.compose.form.made is None
    assert "not composed" in studio.compose.form._problem.content
    assert studio.compose.text == task_text(task)


@pytest.fixture
def solved(studio, monkeypatch):
    """The draws that the expert was to play."""
    found = []
    monkeypatch.setattr("roboxim_studio.panels.compose.take", lambda graph, draw, *_, **__: found.append(draw) or FILM)
    monkeypatch.setattr(studio.compose, "_watch", lambda film: None)
    return found


def test_the_expert_plays_what_was_drawn_until_it_is_edited(studio, bag, monkeypatch, solved):
    compose, film = studio.compose, read_film(bag)
    draws = [Draw(task=film.info.task, scene=film.info.scene, max_steps=9, config_json=json.dumps({"max_steps": 9}))]
    asked = []
    monkeypatch.setattr(studio.lab, "draw", lambda text, seed: asked.append(text) or draws[-1])
    studio.show("Scene")
    compose.draw().result(timeout=60)
    compose.solve().result(timeout=60)
    assert (solved, len(asked)) == (draws, 1)
    studio.editor.edit(lambda document: with_instruction(document, "Lift the cube"))
    compose.solve().result(timeout=60)
    assert "Lift the cube" in asked[1]
    assert "max_steps: 9" in asked[1]


@pytest.mark.parametrize("purpose", ["demo", "eval"])
def test_a_saved_task_names_only_commands_that_give_its_scenes(studio, tmp_path, purpose):
    compose = studio.compose
    compose._saves, compose._purpose.value = tmp_path, purpose
    compose._choose()
    compose.save("my_task")
    assert ("roboxim generate" in compose._message.content) == (purpose == "demo")
    assert f"--purpose {purpose}" in compose._message.content


def test_a_drawn_task_of_several_steps_is_shown_and_solved_but_not_edited(studio, bag, monkeypatch, solved):
    compose, film = studio.compose, read_film(bag)
    studio.watch(film)
    studio.edit_episode()
    assert studio.editor.desk is not None
    task = task_of([film.info.task, film.info.task], "Pick up the cube, then pick up the cube")
    scene = replace(film.info.scene, control_rate_hz=20.0)
    draw = Draw(task=task, scene=scene, max_steps=9)
    monkeypatch.setattr(studio.lab, "draw", lambda text, seed: draw)
    assert compose.draw().result(timeout=60) is draw
    assert studio.view.scene == scene
    assert (studio.editor.desk, studio.editor.folder.visible) == (None, False)
    assert "cannot be edited" in compose._message.content
    compose.solve().result(timeout=60)
    assert solved == [draw]
    studio.watch(replace(film, info=replace(film.info, task=task)))
    studio.edit_episode()
    assert studio.mode == "Episode"
    assert "several steps" in studio.site._latest["alert"]


def test_a_refused_edit_is_named_in_the_page_and_changes_nothing(studio, tmp_path):
    compose = studio.compose
    compose._choose()
    before = compose.text
    assert not compose.form.toggle("target", "cube")  # the only one
    assert "at least one model" in compose._message.content
    assert not compose.form.edit(lambda made: edits.with_distractors(made, 9, 9))
    assert compose.text == before
    compose._saves = tmp_path / "inside"
    compose._saves.mkdir()
    for name in ("../evil", "a/b", "", "x\0"):
        assert compose.save(name) is None
    assert not list(tmp_path.glob("**/*.yaml"))


@pytest.mark.thorough
def test_a_saved_task_gives_generate_the_scene_that_was_shown(studio, tmp_path):
    compose = studio.compose
    compose._saves = tmp_path
    compose._choose()
    assert compose.form.toggle("target", "apple")
    assert compose.form.edit(lambda made: edits.with_distractors(made, 1, 1))
    assert compose.form.edit(lambda made: edits.with_templates(made, ["Get the {target}"]))
    compose._seed.value, compose._index.value = 4, 1
    draw = compose.draw(another=True).result(timeout=120)
    assert draw.task.instruction.startswith("Get the")
    assert digest(draw.scene) in compose._message.content
    (tmp_path / "others.yaml").write_text("skill: pick_up\n")
    assert compose.save("others") is None
    assert (tmp_path / "others.yaml").read_text() == "skill: pick_up\n"
    file = compose.save("my_task")
    assert load_task_config(str(file)) == compose.form.made.config
    config = RunConfig(run_seed=4, purpose="demo", task_config=task_text(str(file)), output_dir=str(tmp_path / "run"))
    with CoreGraph(tmp_path / "run") as graph:
        result = EpisodeRunner(graph.ports, config, library=graph.sim.library).run_index(2)
    info = BagReader(tmp_path / "run" / result.bag).info
    assert digest(info.scene) == digest(draw.scene)
    assert info.task.instruction == draw.task.instruction
    film = compose.solve().result(timeout=300)
    assert film.info.scene == draw.scene


@pytest.mark.thorough
def test_refusals_are_counted_with_their_causes(studio, monkeypatch):
    monkeypatch.setattr("roboxim_studio.panels.compose.COUNTED", 2)
    compose = studio.compose
    compose._task.value = "pick_cube"
    compose._choose()
    compose.form.edit(lambda made: edits.with_distractors(made, 8, 8))
    counts = compose.count().result(timeout=300)
    assert sum(counts.values())
    for name, number in counts.items():
        assert f"{name} {number}" in compose._message.content.replace("&#x27;", "'")


@pytest.mark.thorough
def test_a_task_is_composed_in_the_page(studio, chromium):
    studio.open_task("pick_cube").result(timeout=120)
    chromium.open(studio.url)
    chromium.wait("document.querySelector('#composed')?.innerText.includes('scene')")
    chromium.run("[...document.querySelectorAll('*')].find((one) => one.innerText?.trim() === 'Compose').click()")
    chromium.wait("document.querySelector('textarea')")
    words = "Fetch the {target}"
    chromium.run(
        "(() => { const area = document.querySelector('textarea');"
        "Object.getOwnPropertyDescriptor(HTMLTextAreaElement.prototype, 'value').set.call(area, "
        f"{json.dumps(words)}); area.dispatchEvent(new Event('input', {{bubbles: true}})) }})()"
    )
    wait_for(lambda: studio.compose.form.made.templates == (words,), "the new instruction")
    chromium.run("[...document.querySelectorAll('input')].find((one) => one.value === 'cube').click()")
    apple = "[...document.querySelectorAll('[role=option]')].find((one) => one.innerText.trim() === '+ apple')"
    chromium.wait(f"!!({apple})")
    chromium.run(f"({apple}).click()")
    wait_for(lambda: studio.compose.form.made.roles["target"].models.values == ("cube", "apple"), "the new model")
    chromium.wait("[...document.querySelectorAll('input')].some((one) => one.value === 'cube, apple')")
    chromium.click("Draw another")
    chromium.wait("document.querySelector('#composed')?.innerText.includes('Fetch the')")
    assert studio.compose.drawn.task.instruction.startswith("Fetch the")
    assert not chromium.errors
