"""Runs, datasets and selections in the studio."""

import html
import shutil
from dataclasses import replace

import numpy as np
import pytest
from browser import wait_for

from roboxim_core.errors import InvalidRequestError
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.where import with_files
from roboxim_recorder.export import EXPORTERS
from roboxim_runs.datasets.export import export_dataset
from roboxim_runs.datasets.rewriting import convert_dataset
from roboxim_studio.acting.what_if import Question
from roboxim_studio.episode.choice import selection_text
from roboxim_studio.episode.film import read_film
from roboxim_studio.opening import Kind, recognise
from roboxim_studio.sharing import share


def test_new_episodes_of_a_running_run_appear(studio, run, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    studio.open(recognise(str(copy)))
    assert len(studio.files.entries) == 1
    first = studio.files.entries[0]
    later = copy / "episodes" / "later"
    shutil.copytree(first.path, tmp_path / "later")
    (tmp_path / "later").rename(later)
    wait_for(lambda: len(studio.files.entries) == 2, "the new episode", 60)
    assert studio.episode.film.title == first.name


def test_an_evaluation_lists_the_episodes_of_every_policy(studio, run, tmp_path):
    for policy in ("bc", "random"):
        shutil.copytree(run, tmp_path / "evaluation" / policy)
    (tmp_path / "evaluation" / "report.html").write_text("")
    opened = recognise(str(tmp_path / "evaluation" / "report.html"))
    studio.open(opened)
    (one, other) = studio.files.entries
    assert one.name == f"bc/{one.episode}"
    assert other.name == f"random/{one.episode}"
    studio.files.open_named(other.name, beside=True)
    assert studio.what_if.other.path == other.path
    for policy in ("bc", "random"):
        assert f"success of {policy}" in studio.files._facts.content


def test_a_selection_of_an_evaluation_is_a_file_for_each_policy(studio, run, tmp_path, monkeypatch):
    monkeypatch.setattr("roboxim_studio.app.share", lambda film, library, file: file.write_text(str(film.path)))
    for policy in ("bc", "random"):
        shutil.copytree(run, tmp_path / "evaluation" / policy)
    studio.folder = studio.files._folder = tmp_path
    studio.open(recognise(str(tmp_path / "evaluation")))
    one, other = studio.files.entries
    selection = studio.files.selection
    selection.mark(one.name, "Leave out")
    studio.files.open_named(other.name)
    studio.episode.show(4)
    selection.trim("Starts here")
    marks, edits = dict(selection.marks), dict(selection.edits)
    files = selection.save("mine")
    assert [file.name for file in files] == ["mine-bc.where", "mine-random.where"]
    last = studio.episode.film.result.steps - 1
    assert [with_files([f"@{file}"]) for file in files] == [
        (f"episode!={one.episode}",), (f"trim {other.episode} 4..{last}",)
    ]  # fmt: skip
    assert f"lerobot {tmp_path / 'evaluation' / 'random'} --where @mine-random.where" in selection._saved.content
    selection.mark(one.name, "Unmark")
    selection.trim("Whole again")
    selection.load("mine")
    assert (selection.marks, selection.edits) == (marks, edits)
    written = [(studio.files.open_named(entry.name), studio.share())[1] for entry in (one, other)]
    assert [file.read_text() for file in written] == [str(one.path), str(other.path)]
    studio.watch(replace(studio.episode.film, path=None))
    selection.trim("Ends here")  # of an episode that is not in the list
    assert "none of this list" in selection._message.content
    assert selection.edits == edits


def test_writing_an_episode_replaces_no_file_of_others(studio, bag, tmp_path, monkeypatch):
    monkeypatch.setattr("roboxim_studio.app.share", lambda film, library, file: file.write_text("page"))
    studio.folder = tmp_path
    film = studio.open_bag(bag)
    (tmp_path / f"{film.title}.html").write_text("report")
    assert studio.share() is None
    assert "exists already" in studio.site._latest["alert"]
    questions = (Question(tick=3), Question(tick=3, moved="target"))
    for other in (replace(film, path=None, title=f"{film.title}: {question.words}") for question in questions):
        studio.watch(other)
        assert studio.share() == studio.share()  # its own file
    assert len(list(tmp_path.iterdir())) == 3


def test_a_bag_that_is_still_being_copied_is_listed_when_it_is_whole(studio, run, tmp_path, monkeypatch):
    monkeypatch.setattr("roboxim_studio.panels.files.WATCH_S", 600.0)
    shutil.copytree(run, tmp_path / "run")
    (tmp_path / "run" / "results.jsonl").unlink(missing_ok=True)
    (file,) = (tmp_path / "run").glob("episodes/*/*.mcap")
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    studio.open(recognise(str(tmp_path / "run")))
    assert [entry.outcome for entry in studio.files.entries] == ["unreadable"]
    file.write_bytes(whole)
    studio.files.look()
    assert [entry.outcome for entry in studio.files.entries] == ["success"]


def test_a_selection_file_leaves_episodes_out_of_exports_and_touches_no_bag(studio, run, tmp_path):
    studio.files._folder = tmp_path
    studio.open(recognise(str(run)))
    (entry,) = studio.files.entries
    before = {file: file.stat().st_mtime_ns for file in run.rglob("*")}
    studio.files.selection.mark(entry.name, "Leave out")
    (file,) = studio.files.selection.save("mine")
    assert with_files([f"@{file}"]) == (f"episode!={entry.name}",)
    assert {file: file.stat().st_mtime_ns for file in run.rglob("*")} == before
    studio.files.selection.mark(entry.name, "Unmark")
    assert not studio.files.selection.marks
    assert studio.files.selection.save("../x") == ()
    assert not list(tmp_path.parent.glob("x.where"))
    (tmp_path / "of_another_run.where").write_text("episode!=demo-0-00003-0\n")
    assert studio.files.selection.save("of_another_run") == ()
    assert "exists already" in studio.files.selection._saved.content
    assert studio.files.selection.save("mine") == (file,)  # its own file
    more = "# mine\nsteps<999\nepisode!=demo-0-00003-0\n"
    (tmp_path / "of_another_run.where").write_text(f"{more}episode!={entry.name}\n")
    studio.files.selection.load("of_another_run")
    assert studio.files.selection.marks == {entry.name: "out"}
    assert "steps&lt;999; episode!=demo-0-00003-0" in studio.files._facts.content
    studio.files.selection.mark(entry.name, "Unmark")
    (file,) = studio.files.selection.save("of_another_run")
    assert file.read_text().endswith(f"are left out.\n{more}")  # what the studio does not show stays
    assert str(run) in studio.files.selection._saved.content


@pytest.mark.thorough
def test_a_selection_file_trims_and_relabels_and_can_be_loaded_again(studio, run, tmp_path):
    studio.files._folder = tmp_path
    studio.open(recognise(str(run)))
    (entry,) = studio.files.entries
    last = studio.episode.film.result.steps
    studio.episode.show(4)
    studio.files.selection.trim("Starts here")
    studio.episode.show(last - 2)
    studio.files.selection.trim("Ends here")
    studio.files.selection.relabel("Lift  it = now")
    studio.files.selection.mark(entry.name, "Flag")
    (file,) = studio.files.selection.save("mine")
    lines = (f"trim {entry.episode} 4..{last - 3}", f"relabel {entry.episode} Lift it = now")
    assert with_files([f"@{file}"]) == lines
    config = EXPORTERS["hdf5"]().config(val_fraction=0.0, where=lines)
    (episode,) = open_dataset(export_dataset("hdf5", [run], tmp_path / "data", config).path).episodes()
    assert (episode.length, episode.instruction) == (last - 6, "Lift it = now")
    edits, marks = dict(studio.files.selection.edits), dict(studio.files.selection.marks)
    studio.files.selection.trim("Whole again")
    studio.files.selection.relabel("")
    studio.files.selection.mark(entry.name, "Unmark")
    assert not studio.files.selection.edits
    studio.files.selection.load("mine")
    assert (studio.files.selection.edits, studio.files.selection.marks) == (edits, marks)
    studio.files.selection.load("../mine")
    studio.episode.show(0)
    studio.files.selection.trim("Ends here")
    assert "nothing would be left" in studio.files.selection._message.content


def test_conditions_list_the_episodes_that_meet_them(studio, run):
    studio.open(recognise(str(run)))
    panel = studio.files
    panel.filter("object=cube; steps<1000")
    assert len(panel.shown()) == 1
    panel.filter("steps>1000")
    assert panel.shown() == ()
    panel.filter("colour=red")
    assert "no episode has 'colour'" in html.unescape(panel.selection._message.content)
    panel.filter("")
    assert len(panel.shown()) == 1


def test_a_dataset_is_filtered_marked_trimmed_and_audited_without_being_touched(studio, run, tmp_path):
    source = tmp_path / "hdf5"
    export_dataset("hdf5", [run], source, EXPORTERS["hdf5"]().config(val_fraction=0.0))
    before = {file: file.read_bytes() for file in source.rglob("*") if file.is_file()}
    studio.dataset._saves = tmp_path
    studio.open(recognise(str(source)))
    panel = studio.dataset
    panel.filter("outcome=success; steps<1000")
    (name,) = panel._found
    assert panel._meeting.options[1].startswith(f"{name} | ")
    panel.filter("skill=nothing")
    assert "expected" in panel.selection._message.content
    panel.selection.audit()
    assert "never change" in panel.selection._message.content
    panel.step(3)
    panel.selection.trim("Starts here")
    panel.selection.relabel("Lift it")
    panel.selection.mark(name, "Flag")
    (file,) = panel.selection.save("mine")
    assert with_files([f"@{file}"]) == (f"trim {name} 3..{len(panel.episode) - 1}", f"relabel {name} Lift it")
    convert_dataset(source, tmp_path / "cut", "hdf5", where=with_files([f"@{file}"]))
    (episode,) = open_dataset(tmp_path / "cut").episodes()
    assert (episode.length, episode.instruction) == (len(panel.episode) - 3, "Lift it")
    panel.selection.mark(name, "Leave out")
    assert with_files([f"@{panel.selection.save('none')[0]}"])[0] == f"episode!={name}"
    assert {file: file.read_bytes() for file in source.rglob("*") if file.is_file()} == before


def test_an_audit_of_a_clean_run_flags_nothing(studio, run):
    studio.open(recognise(str(run)))
    studio.files.selection.audit()
    assert not studio.files.selection.marks


def test_a_line_of_a_selection_file_that_is_no_condition_is_named(tmp_path):
    file = tmp_path / "a.where"
    file.write_text(selection_text(["b", "a"], ["c"], "run", 3) + "episode\n")
    with pytest.raises(InvalidRequestError, match="a.where line 5"):
        with_files([f"@{file}"])


def test_statistics_and_filters(studio, run):
    studio.open(recognise(str(run)))
    (found,) = studio.files.measure().values()
    assert found.steps == len(studio.episode.film)
    assert 0 < found.jerk_m_s3 < 1e3
    assert found.start_m["target"] == pytest.approx(studio.episode.film.states[0].entity("target").pose.position[:2])
    studio.files._words.value = "no such words"
    studio.files._list()
    assert studio.files.shown() == ()


def test_an_exported_dataset_opens_with_pictures_and_curves(studio, run, tmp_path):
    export_dataset("rlds", [run], tmp_path / "rlds", EXPORTERS["rlds"]().config(val_fraction=0.0))
    opened = recognise(str(tmp_path / "rlds"))
    assert opened.kind == Kind.DATASET
    studio.open(opened)
    panel = studio.dataset
    assert len(panel.dataset) == 1
    assert panel._pictures.complete.wait(60)
    film = read_film(next((run / "episodes").iterdir()), in_background=False)
    panel.step(3)
    assert panel.episode.instruction == film.info.task.instruction
    shown = panel._pictures.at(3)
    assert set(shown) == set(panel.episode.cameras)
    difference = shown["workspace"].astype(int) - film.pictures.at(3)["workspace"]
    assert np.abs(difference).mean() < 6  # both are JPEG


@pytest.mark.slow
def test_a_shared_episode_plays_offline_and_asks_nobody(bag, chromium, studio, tmp_path):
    film = read_film(bag)
    file = share(film, studio.library, tmp_path / "episode.html")
    assert str(tmp_path) not in file.read_text()
    chromium.open(file.as_uri())
    chromium.wait("document.querySelector('canvas')")
    chromium.wait(f"document.querySelector('#episode').innerText.includes({film.info.task.instruction!r})")
    chromium.wait("[...document.querySelectorAll('input')].some(one => parseFloat(one.value) > 0.3)", 60)  # it plays
    asked = [url for url in chromium.requests if not url.startswith(("data:", "blob:", "about:"))]
    assert asked == [file.as_uri()]
    assert not chromium.errors
