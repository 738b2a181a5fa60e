import shutil
import subprocess
import sys
from dataclasses import replace

import pytest
from browser import wait_for

from roboxim_core.errors import ConfigError, RoboximError
from roboxim_recorder.bag import BagReader
from roboxim_studio.app import Studio
from roboxim_studio.episode.film import marks, read_film
from roboxim_studio.episode.judgement import judge, thresholds, with_thresholds
from roboxim_studio.first_view import first_view
from roboxim_studio.opening import Kind, recognise
from roboxim_studio.panels import markup
from roboxim_studio.serving.access import Access
from roboxim_studio.serving.site import Site
from roboxim_tasks.sequences.steps import task_of


def test_every_tick_shows_the_bags_state_and_verdict(studio, bag):
    film = studio.open_bag(bag)
    film.pictures.requested.set()
    assert film.pictures.complete.wait(60)
    for tick in BagReader(bag).ticks(cameras=()):
        studio.episode.show(tick.seq)
        assert film.states[tick.seq].state_hash == tick.state.state_hash
        assert tick.state.state_hash in studio.episode._state.content
        assert studio.episode.judgement.verdicts[tick.seq] == tick.step.verdict
        for entity in tick.state.entities:
            body = studio.view._bodies[entity.name][1]
            assert tuple(body.position) == pytest.approx(entity.pose.position, abs=1e-5)  # the page skips smaller moves
    assert set(film.pictures.at(0)) == {camera.name for camera in film.info.scene.cameras}


def test_what_a_page_shows_first_stays_when_the_studio_is_there(bag, tmp_path):
    site = Site(Access())
    first = first_view(site, recognise(str(bag)))
    shown = {name: handle for name, (_, handle) in first.view._bodies.items()}
    assert tuple(shown["target"].position) == pytest.approx(first.film.states[0].entity("target").pose.position)
    with Studio(site=site, first=first) as studio:
        assert studio.open_bag(bag) is first.film
        assert {name: handle for name, (_, handle) in studio.view._bodies.items()} == shown, "sent once"
        assert studio.open_bag(bag) is not first.film, "opened again, it is read again"
        studio.edit_episode()
        wait_for(lambda: studio.editor.desk is not None, "the scene to edit", 60)
        (clicked,) = shown["target"]._impl.click_cb
        clicked.callback(None)
        assert studio.editor.selected == "target", "what was shown first can be clicked"

    (damaged := tmp_path / bag.name).mkdir()
    (damaged / "x.mcap").write_bytes(b"no bag")
    site = Site(Access())
    first = first_view(site, recognise(str(damaged)))
    assert first.film is None
    with Studio(site=site, first=first) as studio, pytest.raises(RoboximError, match=bag.name):
        studio.open(recognise(str(damaged)))


def test_marks_name_contact_success_and_end(bag):
    film = read_film(bag)
    found = {mark.name: mark.seq for mark in marks(film)}
    solved = next(seq for seq, verdict in enumerate(film.verdicts) if verdict.success)
    assert found["solved"] == solved
    assert 0 < found["robot touches target"] < solved
    assert found["end: success"] == len(film) - 1


def test_judging_again_changes_the_verdict_and_refuses_wrong_thresholds(studio, bag):
    film = studio.open_bag(bag)
    panel = studio.episode
    assert panel.judgement.verdicts == film.verdicts
    panel.judge_again({"lift_m": 0.1, "hold_s": 5.0})
    assert not any(verdict.success for verdict in panel.judgement.verdicts)
    assert "with these thresholds: failure" in panel._judged.content
    before = panel.judgement
    panel.judge_again({"lift_m": -1.0})
    assert "0 &lt; lift_m" in panel._judged.content
    assert panel.judgement is before
    assert thresholds(film.info.task) == thresholds(film.info.task) | {"lift_m": 0.05}
    with pytest.raises(ConfigError, match="no threshold 'lift'.*lift_m"):
        with_thresholds(film.info.task, {"lift": 1.0})


def test_an_episode_of_several_steps_is_shown_and_judged(studio, bag):
    film = read_film(bag)
    steps = task_of([film.info.task, film.info.task], "Pick up the cube, then pick up the cube")
    film = replace(film, info=replace(film.info, task=steps))
    studio.watch(film)
    assert studio.episode.film is film
    studio.episode.show(5)
    assert "5 of" in studio.episode._state.content
    assert thresholds(steps) == {}
    studio.episode.judge_again({})
    assert "with these thresholds: " in studio.episode._judged.content


def test_lamps_say_measure_bound_and_whether_it_holds(bag):
    film = read_film(bag)
    judgement = judge(film.info.task, film.states)
    first, last = ({lamp.name: lamp for lamp in judgement.lamps(seq)} for seq in (0, len(film) - 1))
    assert not first["lifted"].holds
    assert last["lifted"].holds
    assert (last["lifted"].measure, last["lifted"].bounds) == ("lift_m", "> 0.05")
    assert last["lifted"].value > 0.05


def test_names_from_data_are_text():
    shown = markup.facts([("instruction", "<img src=x onerror=alert(1)>")]) + markup.paragraph("<b>&\"'")
    assert "<img" not in shown
    assert "<b>" not in shown


def test_what_is_opened(run, bag, tmp_path):
    assert recognise("").kind == Kind.NOTHING
    assert recognise(str(bag)).kind == recognise(str(next(bag.glob("*.mcap")))).kind == Kind.BAG
    assert recognise(str(run)).bags == (bag,)
    assert recognise("pick_up").kind == Kind.TASK
    with pytest.raises(ConfigError, match="neither a bag"):
        recognise(str(tmp_path))
    with pytest.raises(ConfigError, match="no 'no_such_task'"):
        recognise("no_such_task")


def test_a_run_lists_its_episodes_and_says_which_cannot_be_read(studio, run, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    broken = copy / "episodes" / "zz"
    broken.mkdir()
    (broken / "zz_0.mcap").write_bytes(b"nothing")
    opened = recognise(str(copy))
    studio.open(opened)
    entries = studio.files.entries
    assert [entry.outcome for entry in entries] == ["success", "unreadable"]
    assert entries[0].skill == "pick_up"
    with pytest.raises(RoboximError):
        studio.open_bag(entries[1].path)
    assert studio.episode.film.title == entries[0].name


ENDS = """
import sys
from pathlib import Path
from types import SimpleNamespace
import numpy as np
from roboxim_recorder.bag import BagReader
from roboxim_studio.episode.film import read_film

def without_end(reader, **wanted):
    return iter(lambda: SimpleNamespace(seq=0, images={"workspace": picture}), None)

film, picture = read_film(Path(sys.argv[1]), in_background=False), np.zeros((512, 512, 3), np.uint8)
whole, BagReader.ticks = BagReader.ticks, lambda reader, **wanted: (
    without_end(reader) if "kinds" in wanted else whole(reader, **wanted)
)
film = read_film(Path(sys.argv[1]))
while not film.pictures.at(0):
    pass
"""


@pytest.mark.thorough
def test_a_program_ends_while_pictures_are_read(bag):
    done = subprocess.run(
        [sys.executable, "-c", ENDS, str(bag)], capture_output=True, text=True, check=False, timeout=300
    )
    assert (done.returncode, done.stderr) == (0, "")
