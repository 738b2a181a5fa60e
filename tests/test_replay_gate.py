"""A dataset's actions are executed again: what they retain is measured, and a bad dataset is refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.actions import ActionContext, ActionSemantics, ActionTransform
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError
from roboxim_datasets.formats import open_dataset
from roboxim_recorder.bag import BagReader, mcap_file
from roboxim_recorder.export import EXPORTERS, ExportReport
from roboxim_recorder.integrity.check import check_bag
from roboxim_recorder.integrity.repair import OUTCOME_UNKNOWN, repair_bag
from roboxim_runs.datasets.export import REPLAY_FILE, export_dataset, gated
from roboxim_runs.datasets.replay_gate import (
    EpisodeReplay,
    ReplayReport,
    StreamReplay,
    replay_dataset,
    replay_episode,
    spread,
)
from roboxim_runs.episodes.reexecution import rejudge
from roboxim_runs.episodes.task_choice import task_text
from roboxim_sim.world import World


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Two demonstrations: the first without noise, the second with it."""
    folder = tmp_path_factory.mktemp("run")
    with CoreGraph(folder) as graph:
        for index, noise in enumerate((0.0, 1.0)):
            config = RunConfig(
                run_seed=5, purpose="demo", task_config=task_text("pick_cube"), image_width=16, image_height=16,
                noise_translation_m=0.003 * noise, noise_rotation_rad=0.01 * noise, output_dir=str(folder),
            )  # fmt: skip
            assert EpisodeRunner(graph.ports, config).run_index(index).outcome == "success"
    return folder


@pytest.fixture(scope="module")
def exported(run, tmp_path_factory):
    """The same as a dataset, far from its bags."""
    return export_dataset("rlds", run, tmp_path_factory.mktemp("dataset") / "a" / "b" / "c" / "rlds").path


@pytest.fixture(scope="module")
def report(exported, run):
    """The replay of the whole dataset."""
    return replay_dataset(exported, [run])


@pytest.fixture(scope="module")
def sim():
    sim = World()
    yield sim
    sim.close()


def replayed(exported, run, sim, number, change=lambda step: step, *, labels=False, **fields):
    """Replay an episode of the dataset with changed steps and fields."""
    episode = open_dataset(exported).episode(number)

    def read(wanted):
        return map(change, episode.read(wanted))

    bag = BagReader(run / "episodes" / episode.episode_id)
    return replay_episode(replace(episode, read=read, **fields), bag, sim, labels=labels)


def test_a_refusal_for_episodes_without_noise_names_one_of_them():
    def replay(number, *, noise_free):
        solved = StreamReplay(success=True, reason="", steps=1, tcp_error_m=(0.0,))
        lost = replace(solved, success=False, reason="missed")
        return EpisodeReplay(
            split="train", index=number, episode_id=f"demo-{number}", recorded_success=True, lossless=True,
            noise_free=noise_free, executed=solved, labels=lost,
        )  # fmt: skip

    episodes = replay(0, noise_free=False), replay(1, noise_free=True)
    refusal = ReplayReport(path=Path("a"), format="rlds", episodes=episodes).refusal
    assert "episodes without noise" in refusal
    assert refusal.endswith("first: demo-1 (missed)")


@pytest.mark.thorough
def test_a_trimmed_episode_is_no_failed_replay(run, tmp_path):
    edit = ("trim demo-5-00000-0 0..5",)
    trimmed = export_dataset("rlds", run, tmp_path / "rlds", EXPORTERS["rlds"]().config(where=edit)).path
    report = replay_dataset(trimmed, [run])
    assert "could not be replayed, first demo-5-00000-0: it was trimmed (6 steps" in report.refusal


def test_a_good_export_passes(report):
    assert report.refusal == ""
    assert report.required == 1.0
    assert str(report.retained("executed")) == "2 of 2 successes (100.0 %)"
    assert [episode.executed.exact for episode in report.episodes] == [True, True]
    assert report.tcp_error_m("executed") == {"median": 0.0, "p95": 0.0, "max": 0.0}
    calm, noisy = report.episodes
    assert (calm.noise_free, noisy.noise_free) == (True, False)
    assert calm.labels.success
    assert max(noisy.labels.tcp_error_m) > 1e-3, "labels without the noise that they correct lead elsewhere"
    assert noisy.labels.apart_at > 0
    assert report.retained("labels", noise_free=True).of == 1
    facts = json.loads(report.to_json())
    assert facts["passed"]
    assert len(facts["episodes"][0]["executed"]["tcp_error_m"]) == calm.executed.steps
    assert "passed" in "\n".join(report.lines)


def test_wrong_executed_actions_are_refused_and_the_first_failure_is_named(exported, run, sim, report):
    def mirrored(step):
        return replace(step, action_executed=step.action_executed * np.float32([1, -1, 1, 1, 1, 1, 1]))

    episode = replayed(exported, run, sim, 1, mirrored)
    assert not episode.executed.success
    assert episode.executed.apart_at > 0
    report = replace(report, episodes=(episode,))
    assert report.refusal.startswith("the executed actions retain 0 of 1 successes (0.0 %), required are 100 %")
    assert f"{episode.episode_id} ({episode.executed.reason}, 1 mm from the recording" in report.refusal


def test_wrong_labels_bind_only_without_noise(exported, run, sim, report):
    def open_label(step):
        return replace(step, action=np.float32([*step.action[:6], 1.0]))

    noisy = replayed(exported, run, sim, 1, open_label, labels=True)
    assert noisy.executed.success
    assert not noisy.labels.success
    assert replace(report, episodes=(noisy,)).refusal == ""
    calm = replayed(exported, run, sim, 0, open_label, labels=True)
    assert "the labels of the episodes without noise retain 0 of 1" in replace(report, episodes=(calm,)).refusal


@pytest.mark.parametrize(
    "semantics",
    [
        ActionSemantics(control="end_effector_absolute", rotation="quaternion_xyzw"),
        ActionSemantics(frame="tool", rotation="rotation_vector", gripper="absolute_open_minus_1_closed_1"),
        ActionSemantics(delta_base="measured"),
    ],
    ids=["absolute", "tool frame", "to the measured pose"],
)
def test_actions_of_another_meaning_are_converted_back(exported, run, sim, semantics):
    episode = open_dataset(exported).episode(1)
    bag = BagReader(run / "episodes" / episode.episode_id)
    transform = ActionTransform.between(ActionSemantics(), semantics)
    before = [ActionContext.of(tick.state, bag.info.scene.robot.pose) for tick in bag.ticks(cameras=())]

    def converted(step):
        action, executed = (
            np.float32(transform.apply(row, before[step.index])) for row in (step.action, step.action_executed)
        )
        return replace(step, action=action, action_executed=executed)

    found = replayed(exported, run, sim, 1, converted, semantics=semantics)
    assert found.lossless
    assert found.executed.success
    assert max(found.executed.tcp_error_m) < 1e-3


def test_a_dataset_at_half_the_rate_is_executed_at_its_own(exported, run, sim):
    episode = open_dataset(exported).episode(0)
    actions = np.stack([step.action_executed for step in episode.steps(())])
    actions = np.concatenate([actions, actions[-1:] * [0, 0, 0, 0, 0, 0, 1]])[: len(actions) // 2 * 2]
    pairs = actions.reshape(-1, 2, 7)
    summed = np.concatenate([pairs[:, :, :6].sum(axis=1), pairs[:, 1, 6:]], axis=1).astype(np.float32)
    steps = [replace(step, action=a, action_executed=a) for step, a in zip(episode.steps(()), summed, strict=False)]
    bag = BagReader(run / "episodes" / episode.episode_id)
    slow = replace(
        episode, length=len(steps), semantics=ActionSemantics(rate_hz=5.0), fps=5.0, read=lambda _: iter(steps)
    )
    found = replay_episode(slow, bag, sim, labels=False)
    assert not found.lossless
    assert len(found.executed.tcp_error_m) == found.executed.steps
    assert max(found.executed.tcp_error_m) < 0.02, "it follows the recording, two ticks at a time"


def test_actions_in_a_conventions_units_are_converted_back(run, tmp_path):
    text = (
        "rate_hz: 10\n"
        "images: [{camera: wrist, key: observation/wrist_image, width: 16, height: 16}]\n"
        "states: [{key: observation/state, parts: [{field: tcp_position}]}]\n"
        "action: {translation_scale_m: 0.05, rotation_scale_rad: 0.5, gripper: {open: -1, closed: 1}}\n"
    )
    (tmp_path / "mine.yaml").write_text(text)
    config = EXPORTERS["rlds"]().config(convention=str(tmp_path / "mine.yaml"))
    dataset = export_dataset("rlds", run, tmp_path / "rlds", config).path
    assert open_dataset(dataset).episode(0).semantics is None, "only the convention says what its actions mean"
    report = replay_dataset(dataset, [run], labels=False)
    assert report.refusal == ""
    assert report.required == 1.0
    assert report.tcp_error_m("executed")["max"] < 1e-3


def test_actions_without_a_meaning_are_refused(exported, run, sim):
    with pytest.raises(InvalidRequestError, match="does not say what its actions mean"):
        replayed(exported, run, sim, 0, semantics=None)


def test_bags_are_found_by_id_and_hash(exported, run, tmp_path):
    lost = replay_dataset(exported, labels=False)
    assert "its bag was not found" in lost.refusal
    copy = shutil.copytree(run, tmp_path / "copy")
    first, second = (copy / "episodes" / f"demo-5-{index:05d}-0" for index in range(2))
    shutil.rmtree(first)
    mcap_file(second).write_bytes(b"damaged")
    assert replay_dataset(exported, [copy]).refusal.startswith("2 episodes could not be replayed")
    beside = shutil.copytree(exported, tmp_path / "rlds" / "roboxim" / "1.0.0")
    shutil.copytree(run, tmp_path / "demos")
    assert replay_dataset(beside, episodes=1, labels=False).refusal == ""


def test_episodes_are_spread_evenly():
    assert spread(5, 0) == spread(5, 9) == [0, 1, 2, 3, 4]
    assert spread(100, 4) == [12, 37, 62, 87]


def test_an_export_is_gated(run, tmp_path):
    target = tmp_path / "rlds"
    report = export_dataset("rlds", run, target, gate=1)
    assert report.path == target / "roboxim" / "1.0.0"
    assert json.loads((report.path / REPLAY_FILE).read_text())["passed"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rlds"]


def test_a_refused_export_never_gets_its_place(run, tmp_path, monkeypatch):
    from roboxim_recorder.export import episodes

    def without_grasp(rows, semantics):
        return np.array([*rows[:6], 1.0])

    target = tmp_path / "rlds"
    export_dataset("rlds", run, target)
    before = {path: path.read_bytes() for path in target.rglob("*") if path.is_file()}
    monkeypatch.setattr(episodes, "_snapped", without_grasp)  # labels go through it
    with pytest.raises(RecorderError, match="does not pass the replay gate: the labels .*rlds.refused") as caught:
        export_dataset("rlds", run, target, overwrite=True, gate=2)
    assert caught.value.code == ErrorCode.EXPORT_REFUSED
    assert {path: path.read_bytes() for path in target.rglob("*") if path.is_file()} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rlds", "rlds.refused"]


def gate(target, place, *, refused="", overwrite=False):
    """Gate an export that writes its own name, without bags."""

    def export(folder, if_exists):
        path = folder / place.relative_to(target)
        path.mkdir(parents=True, exist_ok=if_exists == "overwrite")
        (path / "export.json").write_text("new")
        return ExportReport(path=path, splits={}, steps=0, left_out={}, dead_dimensions=())

    return gated(target, place, export, lambda dataset: refused, overwrite=overwrite)


@pytest.mark.parametrize("inside", ["", "roboxim/1.0.0"])
def test_a_refused_export_never_gets_its_place_in_a_folder_that_exists(tmp_path, inside):
    target = tmp_path / "set"
    target.mkdir()
    with pytest.raises(RecorderError, match="does not pass the replay gate"):
        gate(target, target / inside, refused="bad")
    assert not list(target.rglob("*"))


def test_a_gated_export_replaces_only_an_export(tmp_path):
    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(RecorderError, match="exists and is not an export"):
        gate(tmp_path, tmp_path, overwrite=True)
    assert (tmp_path / "precious.txt").read_text() == "mine"


def test_what_a_killed_gated_export_has_moved_aside_comes_back(tmp_path):
    place = tmp_path / "set"
    aside = tmp_path / ".set.old"
    aside.mkdir()
    (aside / "export.json").write_text("old")
    with pytest.raises(FileExistsError):
        gate(place, place)
    assert (place / "export.json").read_text() == "old"
    gate(place, place, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    assert (place / "export.json").read_text() == "new"


def test_a_bag_without_its_result_is_judged_again(run, tmp_path):
    bag = shutil.copytree(run / "episodes" / "demo-5-00000-0", tmp_path / "demo-5-00000-0")
    file = mcap_file(bag)
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * 0.5)])
    unknown = repair_bag(bag, tmp_path / "unknown")
    assert (unknown.outcome, unknown.reason) == ("error", OUTCOME_UNKNOWN)
    judged = repair_bag(bag, tmp_path / "judged", rejudge=rejudge)
    assert judged.kept == unknown.kept < len(BagReader(run / "episodes" / bag.name))
    assert judged.outcome in ("success", "failure")
    assert check_bag(judged.target).ok


def test_states_that_are_not_the_recorded_ones_are_not_judged(run):
    reader = BagReader(run / "episodes" / "demo-5-00000-0")
    states = [tick.state for tick in reader.ticks(cameras=())]
    assert rejudge(reader.info, states).success
    assert rejudge(reader.info, [*states[:9], replace(states[9], state_hash="another"), *states[10:]]) is None
