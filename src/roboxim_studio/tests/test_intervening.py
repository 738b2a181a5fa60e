"""A person takes over from a policy and hands back: what is recorded, judged, replayed and exported."""

import json
import shutil
import time

import h5py
import numpy as np
import pytest
from browser import wait_for
from websockets.sync.client import connect

from roboxim_core.episode import Draw
from roboxim_core.errors import InvalidRequestError, RecorderError, SimError
from roboxim_core.seeds import SeedPath
from roboxim_datasets.episode import whole_id
from roboxim_datasets.formats import open_dataset
from roboxim_recorder import topics
from roboxim_recorder.acted import ActedBy, acted_by, is_shared
from roboxim_recorder.bag import BagReader
from roboxim_recorder.export import EXPORTERS, export_bags
from roboxim_recorder.integrity.check import check_bag
from roboxim_recorder.replay import replay
from roboxim_recorder.run_bags import list_bags
from roboxim_runs.datasets.audit import AuditConfig, audit_dataset
from roboxim_runs.datasets.bag_finder import BagFinder
from roboxim_studio.acting.drive import Drive, continued
from roboxim_studio.acting.lab import Lab
from roboxim_studio.acting.partner import Partner
from roboxim_studio.episode.film import marks, read_film

SEED = SeedPath(run_seed=1, purpose="demo", index=0)
UP = np.array([0, 0, 0.01, 0, 0, 0, 1.0], np.float32)
POLICY, HUMAN, EXPERT = ActedBy
TURNS = (EXPERT,) * 4 + (HUMAN,) * 3


@pytest.fixture(scope="module")
def lab():
    lab = Lab()
    yield lab
    lab.close()


@pytest.fixture(scope="module")
def shared(lab, bag, tmp_path_factory):
    """A run with an episode in which a person took over from the expert and handed back."""
    folder = tmp_path_factory.mktemp("shared")
    film = read_film(bag)
    draw = Draw(task=film.info.task, scene=film.info.scene, max_steps=200)
    drive = Drive(lab.graph, draw, SEED, folder, partner=Partner("expert", lab.actor("expert")))
    for who in TURNS:
        drive.hand(to_partner=who == EXPERT)
        assert drive.partner_step() if who == EXPERT else drive.step(UP)
    drive.hand(to_partner=True)
    while drive.partner_step():
        pass
    assert drive.result.outcome == "success"
    assert drive.film.acted[:7] == TURNS
    return folder


@pytest.fixture(scope="module")
def reader(shared):
    return BagReader(next((shared / "episodes").iterdir()))


@pytest.mark.thorough
def test_every_action_says_who_acted_and_the_episode_replays(reader, lab):
    acted = acted_by(reader)
    assert acted[:7] == TURNS
    assert set(acted[7:]) == {EXPERT}
    assert len(acted) == reader.result.steps
    assert check_bag(reader.path).ok
    assert replay(reader, lab.graph.sim).same
    assert (reader.info.actor, reader.info.actor_privileged) == ("expert", True)
    names = [mark.name for mark in marks(read_film(reader.path)) if "takes over" in mark.name]
    assert names == ["human takes over", "expert takes over"]


def test_an_episode_of_one_actor_says_nothing_more(bag):
    assert topics.ACTED_BY not in BagReader(bag).counts
    assert not is_shared(BagReader(bag))
    assert set(acted_by(BagReader(bag))) == {EXPERT}


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["hdf5", "rlds", pytest.param("lerobot", marks=pytest.mark.slow)])
def test_exports_say_at_every_step_who_acted(shared, reader, tmp_path, name):
    path = export_bags(name, shared, tmp_path, EXPORTERS[name]().config(val_fraction=0.0)).path
    (episode,) = open_dataset(path).episodes()
    assert episode.signals["sim.acted_by"] == ("policy", "human", "expert")
    found = [("policy", "human", "expert")[int(step.signals["sim.acted_by"].argmax())] for step in episode.steps(())]
    assert tuple(found) == acted_by(reader)


@pytest.mark.thorough
def test_an_export_takes_the_steps_of_one_actor(shared, reader, tmp_path):
    label = {tick.seq - 1: tick.step.action_label for tick in reader.ticks(cameras=()) if tick.step.phase == "act"}
    config = EXPORTERS["hdf5"]().config
    path = export_bags("hdf5", shared, tmp_path / "human", config(val_fraction=0.0, acted_by="human")).path
    (episode,) = open_dataset(path).episodes()
    assert (episode.length, episode.success) == (3, False)
    assert np.allclose(episode.actions(), [label[seq] for seq in (4, 5, 6)], atol=1e-6)
    path = export_bags("hdf5", shared, tmp_path / "expert", config(val_fraction=0.0, acted_by="expert")).path
    first, second = open_dataset(path).episodes()
    assert (first.length, first.success) == (4, False)
    assert (second.length, second.success) == (reader.result.steps - 7, True)
    assert [step.reward for step in second.steps(())][-1] == 1
    assert np.allclose(second.actions()[0], label[7], atol=1e-6)
    assert {first.episode_id, second.episode_id} == {f"{reader.info.episode_id}-part{n}" for n in (0, 1)}
    with pytest.raises(RecorderError, match="no.* step by 'policy'|has a step by 'policy'"):
        export_bags("hdf5", shared, tmp_path / "policy", config(acted_by="policy"))
    with pytest.raises(InvalidRequestError, match="expert"):
        config(acted_by="experts")


@pytest.mark.thorough
def test_stretches_of_one_actor_are_audited_against_their_bag_and_are_not_replayed(shared, reader, tmp_path):
    config = EXPORTERS["hdf5"]().config(val_fraction=0.0, acted_by="expert")
    path = export_bags("hdf5", shared, tmp_path / "expert", config).path

    def findings():
        audited = audit_dataset(
            path, config=AuditConfig(bags=(shared,), render=False, checks=("content", "recorded_task"))
        )
        return [finding.text for check in audited.result.checks for finding in check.findings]

    assert findings() == []
    with h5py.File(next(path.glob("*.hdf5")), "r+") as file:
        file["data/demo_1/actions"][2, 0] += 0.01
    assert "action" in findings()[0]
    finder = BagFinder(path, [shared])
    for episode in open_dataset(path).episodes():
        bag, why = finder.find(episode)
        assert bag is None
        assert "the steps of one actor of" in why
        assert reader.info.episode_id in why
    assert whole_id("a-part12") == "a"
    assert [whole_id(name) for name in ("a-part", "a-partx", "-part1")] == ["a-part", "a-partx", "-part1"]


def test_a_trimmed_and_relabelled_export_is_audited_as_it_was_edited(run, tmp_path):
    first = list_bags(run)[0].name
    config = EXPORTERS["hdf5"]().config(val_fraction=0.0, where=(f"trim {first} 1..4", f"relabel {first} Do it"))
    path = export_bags("hdf5", run, tmp_path / "edited", config).path
    audited = audit_dataset(path, config=AuditConfig(bags=(run,), render=False, checks=("content",)))
    assert [finding.text for check in audited.result.checks for finding in check.findings] == []


def test_a_bag_of_one_actor_is_exported_as_before(run, tmp_path):
    config = EXPORTERS["hdf5"]().config
    whole = export_bags("hdf5", run, tmp_path / "whole", config(val_fraction=0.0)).path
    same = export_bags("hdf5", run, tmp_path / "expert", config(val_fraction=0.0, acted_by="expert")).path
    (one,), (other,) = (list(open_dataset(path).episodes()) for path in (whole, same))
    assert not one.signals
    assert (one.episode_id, one.length) == (other.episode_id, other.length)


def test_a_recorded_episode_is_taken_over_at_a_tick(lab, bag, tmp_path):
    film = read_film(bag)
    draw, after = continued(film, 6)
    drive = Drive(lab.graph, draw, SEED, tmp_path, after=after, partner=Partner("expert", lab.actor("expert")))
    assert drive.state.state_hash == film.states[6].state_hash
    assert not drive.partner_acts
    drive.step(UP, last=True)
    reader = BagReader(drive.bag)
    assert acted_by(reader) == (EXPERT,) * 6 + (HUMAN,)
    assert replay(reader, lab.graph.sim).same


def test_a_recording_that_the_simulator_does_not_repeat_is_not_continued(lab, bag, tmp_path):
    film = read_film(bag)
    draw, after = continued(film, 3)
    wrong = [(film.states[5], EXPERT), *after[1:]]
    with pytest.raises(SimError, match="tick 5 differs"):
        Drive(lab.graph, draw, SEED, tmp_path, after=wrong)
    assert not list(tmp_path.glob("*/*/*.mcap"))


def test_a_bag_that_says_of_too_few_actions_who_acted_is_damaged(reader, shared, tmp_path):
    copy = tmp_path / "bag"
    shutil.copytree(reader.path, copy)
    broken = BagReader(copy)
    broken.__dict__["result"] = type(reader.result)(**{**vars(reader.result), "steps": reader.result.steps + 1})
    with pytest.raises(RecorderError, match="names the actor of"):
        acted_by(broken)


@pytest.mark.thorough
def test_a_scripted_person_takes_over_through_the_server(studio, tmp_path):
    studio.drive.bags = tmp_path
    studio.open_task("pick_cube").result(timeout=300)
    studio.show("Drive")
    studio.drive._partner.value = "expert"
    drive = studio.drive.begin().result(timeout=300)
    with connect(f"{studio.url.replace('http', 'ws', 1).rstrip('/')}/control") as page:
        wait_for(lambda: drive.state.seq >= 3, "the expert", 120)
        page.send(json.dumps({"key": "KeyT"}))
        wait_for(lambda: not drive.partner_acts, "the hand-over", 60)
        taken = drive.state.seq
        while drive.state.seq < taken + 4:
            page.send(json.dumps({"held": ["KeyR"]}))
            time.sleep(0.02)
        page.send(json.dumps({"held": []}))
        page.send(json.dumps({"key": "KeyT"}))
        wait_for(lambda: drive.result is not None, "the end", 300)
    assert drive.result.outcome == "success"
    acted = acted_by(BagReader(drive.bag))
    assert set(acted[:taken]) == {EXPERT}
    assert acted[taken : taken + 4] == (HUMAN,) * 4
    assert acted[-1] == EXPERT
    assert check_bag(drive.bag).ok
