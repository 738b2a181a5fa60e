"""Episodes of a dataset are chosen, trimmed and relabelled while it is converted; the source stays."""

import json
from dataclasses import replace

import numpy as np
import pytest

from roboxim_core.config import to_json
from roboxim_core.errors import InvalidRequestError, RecorderError
from roboxim_core.specs import PhysicalObject, TaskSpec
from roboxim_datasets.choosing import chosen_plan
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.rewrite import write_dataset
from roboxim_datasets.where import Choice, Condition, Edit


@pytest.mark.parametrize("format", ["rlds", "hdf5"])
def test_a_selection_chooses_trims_and_relabels(tmp_path, write, format):
    source = write(tmp_path / "a", [0, 1, 2], val=[3])
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    texts = ["episode!=demo-1", "trim demo-0 1..2", "relabel train/2 Push it", "trim demo-3 0..1"]
    written = write_dataset(chosen_plan(source, texts), tmp_path / "b", format, how="convert")
    made = {episode.episode_id: episode for episode in open_dataset(written.path).episodes()}
    whole = {episode.episode_id: episode for episode in source.episodes()}
    assert sorted(made) == ["demo-0", "demo-2", "demo-3"]
    assert np.array_equal(made["demo-0"].actions(), whole["demo-0"].actions()[1:3])
    assert made["demo-2"].instruction == "Push it"
    assert made["demo-0"].instruction == whole["demo-0"].instruction
    assert made["demo-3"].length == 2
    assert made["demo-3"].success is None
    assert {file: file.read_bytes() for file in before} == before


def test_selections_that_mean_no_episode_are_refused(tmp_path, write):
    source = write(tmp_path / "a", [0, 1])
    with pytest.raises(InvalidRequestError, match="no episode 'demo-7' to edit.*demo-0"):
        chosen_plan(source, ["trim demo-7 0..1"])
    with pytest.raises(InvalidRequestError, match=r"has the steps 0\.\."):
        chosen_plan(source, ["trim demo-0 0..999"])
    with pytest.raises(RecorderError, match="no episode of"):
        chosen_plan(source, ["episode!=demo-0,demo-1"])


@pytest.mark.parametrize("text", ["trim demo-0", "trim demo-0 5..4", "trim demo-0 a..b", "relabel demo-0 a\x07b"])
def test_an_edit_that_makes_no_sense_is_refused(text):
    with pytest.raises(InvalidRequestError):
        Choice.parse([text])


def test_edits_by_an_episode_s_id_and_place_add_up(tmp_path, write, episode_of):
    texts = ["relabel train/1 Push it", "trim train/1 0..1", "trim demo-1 1..2"]
    episode = chosen_plan(write(tmp_path / "a", [0, 1]), texts)["train"][1].read()
    assert episode.instruction == "Push it"
    assert np.array_equal(episode.actions(), episode_of(1).actions()[1:])


def test_a_trim_keeps_the_words_of_the_steps_that_it_keeps(tmp_path, write, episode_of, description):
    description = replace(description, features=replace(description.features, subtasks=True))
    whole = episode_of(0, length=4)

    def read(wanted):
        for step in whole.read(wanted):
            late = step.index > 1
            yield replace(step, instruction=["Open it", "Close it"][late], subtask=["Reach", "Push"][late])

    several = {"instruction": "Open it", "instructions": ("Open it", "Close it"), "subtasks": ("Reach", "Push")}
    source = write(tmp_path / "a", [replace(whole, read=read, **several)], format="hdf5", description=description)
    made = write_dataset(chosen_plan(source, ["trim demo-0 2..3"]), tmp_path / "b", "hdf5", how="convert")
    episode = open_dataset(made.path).episode(0)
    assert (episode.instruction, episode.instructions) == ("Close it", ())
    assert [(episode.words(step), step.subtask) for step in episode.steps(())] == [("Close it", "Push")] * 2
    [facts] = json.loads((made.path / "export.json").read_text()).get("edits")
    assert facts["steps"] == [2, 3]


def test_edits_of_one_episode_add_up():
    choice = Choice.parse(["trim a 1..2", "relabel a b = c", "relabel=x", "trim a 2..3"])
    assert choice.edits == {"a": Edit(episode="a", steps=(2, 3), instruction="b = c")}
    assert [text for text, _ in choice.conditions] == ["relabel=x"]
    assert choice.edits["a"].texts == ("trim a 2..3", "relabel a b = c")
    assert Choice.parse(choice.edits["a"].texts).edits == choice.edits
    assert [Condition.parse(text).text for text in ("steps < 9", "cell != a, b")] == ["steps<9", "cell!=a,b"]


def test_conditions_can_name_the_recorded_task(tmp_path, write, episode_of):
    def of(index, model, color):
        thing = PhysicalObject(entity="target", name=model, model=model, modifiers={"color": color})
        task = TaskSpec(
            skill="pick_up", objects={"target": thing}, arguments={"lift_m": 0.05}, instruction="", drawn={"cell": "a"}
        )
        episode = episode_of(index)
        return replace(episode, metadata={**episode.metadata, "task": to_json(task)})

    source = write(tmp_path / "a", [of(0, "cube", "red"), of(1, "apple", "red"), episode_of(2)])
    for text in ("object=apple", "target=apple", "target!=cube", "camera=work*", "rate_hz=10"):
        texts = [text, "target.color=red", "cell=a", "argument.lift_m<0.1", "drawn.cell=a"]
        kept = [place.index for place in chosen_plan(source, texts)["train"]]
        assert kept == ([1] if "apple" in text or "!" in text else [0, 1]), text
