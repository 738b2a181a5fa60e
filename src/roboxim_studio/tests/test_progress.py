"""A run that goes on: what its folder says of it while it has finished nothing yet."""

import json

import numpy as np
import pytest
from browser import wait_for

from roboxim_core.episode import Draw
from roboxim_core.plain_data.results_log import RUN_FILE
from roboxim_core.seeds import SeedPath
from roboxim_runs.storage.event_log import EVENTS_FILE, STARTED, EventLog
from roboxim_runs.storage.folder import EPISODE_MARK
from roboxim_studio.acting.drive import Drive
from roboxim_studio.acting.lab import Lab
from roboxim_studio.app import Studio
from roboxim_studio.episode.film import read_film
from roboxim_studio.opening import Kind, recognise


@pytest.fixture
def begun(bag, tmp_path):
    """A run's folder whose first episode is being recorded, at tick 9, and that episode."""
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / RUN_FILE).write_text(json.dumps({"purpose": "demo", "episodes": 3}))
    (folder / "logs").mkdir()
    (folder / "logs" / "worker-0.log").write_text(f"{EPISODE_MARK.format(0)}\nnoise\n")
    EventLog(folder / EVENTS_FILE).write(STARTED, {"host": "here", "pid": 1, "executor": "local"})
    film, lab = read_film(bag), Lab()
    draw = Draw(task=film.info.task, scene=film.info.scene, max_steps=100)
    drive = Drive(lab.graph, draw, SeedPath(run_seed=1, purpose="demo", index=0), folder)
    for state in film.states[1:10]:
        drive.step(np.array(state.action_executed, np.float32))
    yield folder, drive
    drive.close()
    lab.close()


def test_a_run_that_has_finished_nothing_shows_its_workers_and_newest_pictures(begun, monkeypatch):
    folder, drive = begun
    opened = recognise(str(folder))
    assert (opened.kind, opened.bags) == (Kind.RUN, ())
    with Studio() as studio:  # the drive holds the lock of the folder
        studio.open(opened)
        assert studio.files.folder.visible
        progress = studio.files.progress
        progress.follow()
        (state,) = progress.states
        assert (state.state, state.done, state.total) == ("running", 0, 3)
        assert "worker 0</td><td>episode 0" in progress._facts.content
        (episode,) = progress.episodes
        assert episode.ticks == 9, "chunks of four ticks end with tick 0, 4 and 8"
        cameras = [camera.name for camera in drive._recorder.info.scene.cameras]
        assert all(episode.picture(name) is not None for name in cameras)
        assert episode.picture() is episode.picture(cameras[0]), "no picture is decoded twice"
        assert episode.picture("none") is None
        seen = drive._recorder._pictures.at(8)["workspace"]
        assert np.abs(episode.picture("workspace").astype(int) - seen).mean() < 4, "the film's is JPEG"
        assert progress.folder.visible

        drive.close()  # its bag is set apart
        progress.follow()
        assert progress.episodes == ()
        assert not progress.folder.visible
        monkeypatch.setattr(type(studio.site), "pages", property(lambda _: 1))
        wait_for(lambda: len(studio.files.entries) == 1, "the finished episode", 60)


def test_a_run_that_cannot_be_read_is_named(begun):
    folder, _ = begun
    with Studio() as studio:
        studio.open(recognise(str(folder)))
        (folder / RUN_FILE).write_text("{")
        studio.files.progress.follow()
        assert "is damaged" in studio.files.progress._facts.content


@pytest.mark.thorough
def test_a_folder_that_is_gone_for_a_while_is_followed_again(begun, tmp_path):
    folder, drive = begun
    with Studio() as studio:
        studio.open(recognise(str(folder)))
        folder.rename(tmp_path / "elsewhere")
        wait_for(lambda: "No such file" in studio.files.selection._message.content, "the message", 60)
        (tmp_path / "elsewhere").rename(folder)
        drive.close()
        wait_for(lambda: len(studio.files.entries) == 1, "the finished episode", 60)
