"""Rates of a machine, from planted times: those that a finished run teaches, those of trainings side by side."""

import shutil
import signal
import sys
from dataclasses import replace

import pytest
from planted_cards import RATES, experiment_of

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import RoboximError
from roboxim_core.plain_data.results_log import ResultsLog
from roboxim_eval.experiments import SideBySide, stages_of
from roboxim_runs.experiments.calibration import trainings as calibration_trainings
from roboxim_runs.experiments.calibration.learned import rates_of_run
from roboxim_runs.experiments.calibration.measuring import rollout_times
from roboxim_runs.experiments.calibration.trainings import common_rate, common_steps, measure_side_by_side
from roboxim_runs.experiments.card import evaluation_folder
from roboxim_runs.experiments.files import checked_design
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.training import commands as experiment_trainings

TEXT = """
about: Is a short training enough?
factors: {task: [pick_up], target: [cube, soda_can]}
datasets:
  all: {cells: all, per_cell: 10}
conditions:
  all: {train: all}
trainers:
  mine: {command: "train {dataset} {out} {seed}", policy: bc, steps: 1000}
evaluate: {per_cell: 10}
replicates: {count: 1}
compare: []
image_size: 64x64
"""
BEFORE = replace(RATES, size="64x64")
WALL = {"generate": 60.0, "export": 2.0, "train": 210.0, "evaluate": 80.0, "prove": 9.0}


def episodes(folder, first_s, wall_s, failure_s=None):
    """Write 20 episodes of which the first one of each of two workers takes longer, or the first five fail."""
    with RunFolder(folder).opened({}) as run:
        for index in range(20):
            fails = failure_s is not None and index < 5
            seconds = failure_s if fails else first_s if index < 2 else wall_s
            outcome = "failure" if fails else "success"
            run.append(EpisodeResult(episode_id=str(index), index=index, outcome=outcome, steps=30, wall_s=seconds))


def finished(out, text=TEXT, training=None, **more):
    design = checked_design("mine", experiment_of(text))
    log = ResultsLog(out / "stages.jsonl")
    for stage in stages_of(design):
        trained = (training or {}).get(stage.name, {})
        log.append(stage.name, {"stage": stage.name, "wall_s": WALL[stage.kind], **more, **trained})
    episodes(out / "generate/0", 14.0, 4.0)
    episodes(evaluation_folder(out, "evaluate/all.0"), 6.0, 5.0, 9.0)
    return design


def test_a_run_teaches_the_rates_of_its_stages(tmp_path):
    found = rates_of_run("mine", "night", tmp_path, finished(tmp_path), 2, BEFORE)
    assert found.demonstration_s == pytest.approx(2.0), "both workers work, and what they load is no episode's"
    assert found.start_s == pytest.approx(60 - 20 * 2.0)
    assert found.steps_per_s == pytest.approx(1000 / (210 - 10))
    assert (found.success_s, found.failure_s, found.succeeded) == (pytest.approx(2.5), pytest.approx(4.5), 0.75)
    assert found.rollout_s(found.succeeded) == pytest.approx(3.0)
    assert found.experiment == "mine"
    assert found.evaluate_start_s == pytest.approx(80 - 7 - 20 * 3.0)
    assert found.proof_s == pytest.approx((9 - 5) / 20)
    assert (found.film_s, found.train_start_s) == (BEFORE.film_s, BEFORE.train_start_s), "which a run does not show"


def test_a_run_without_a_success_expects_them_as_long_as_demonstrations(tmp_path):
    design = finished(tmp_path)
    shutil.rmtree(evaluation_folder(tmp_path, "evaluate/all.0"))
    with RunFolder(evaluation_folder(tmp_path, "evaluate/all.0")).opened({}) as run:
        for index in range(20):
            run.append(EpisodeResult(episode_id=str(index), index=index, outcome="failure", steps=100, wall_s=8.0))
    found = rates_of_run("mine", "night", tmp_path, design, 2, BEFORE)
    assert (found.succeeded, found.failure_s) == (0.0, pytest.approx(4.0))
    assert found.success_s == pytest.approx(4.0 * 30 / 100), "demonstrations have 30 actions, the limit is 100"


def test_trainings_side_by_side_teach_a_rate_of_their_own(tmp_path):
    three = TEXT.replace("count: 1", "count: 4")
    training = {
        "train/all.0": {"wall_s": 270.0, "at_once": 2.0}, "train/all.1": {"wall_s": 270.0, "at_once": 1.98},
        "train/all.2": {"wall_s": 240.0, "at_once": 1.5}, "train/all.3": {"wall_s": 230.0, "at_once": 1.0},
    }  # fmt: skip
    design = finished(tmp_path, three, training)
    for replicate in (1, 2, 3):
        episodes(evaluation_folder(tmp_path, f"evaluate/all.{replicate}"), 6.0, 6.0)
    measured = SideBySide(trainings=2, steps_per_s=1.0, start_s=20.0, measured="2026-01-02", source="probe")
    found = rates_of_run("mine", "night", tmp_path, design, 2, BEFORE.learned(measured))
    assert found.at_once(2).steps_per_s == pytest.approx(1000 / (270 - 20)), "of those that always ran beside another"
    assert found.at_once(2).source == "run of mine night: 2,000 steps"
    assert found.steps_per_s == pytest.approx(1000 / (230 - 10)), "of the one that was alone"
    assert found.source == "run of mine night: 20 demonstrations, 1,000 steps, 80 rollouts"


def test_trainings_that_something_else_disturbed_teach_no_rate(tmp_path):
    four = TEXT.replace("count: 1", "count: 4")
    walls = {"train/all.0": 250.0, "train/all.1": 255.0, "train/all.2": 260.0, "train/all.3": 3000.0}
    beside = {name: {"wall_s": wall_s, "at_once": 2.0} for name, wall_s in walls.items()}
    design = finished(tmp_path, four, beside)
    for replicate in (1, 2, 3):
        episodes(evaluation_folder(tmp_path, f"evaluate/all.{replicate}"), 6.0, 6.0)
    found = rates_of_run("mine", "night", tmp_path, design, 2, BEFORE)
    assert found.at_once(2).steps_per_s == pytest.approx(1000 / (257.5 - 10)), "the median, not the mean"
    fast = replace(BEFORE, steps_per_s=2.6 * 1000 / (257.5 - 10))
    assert rates_of_run("mine", "night", tmp_path, design, 2, fast).at_once(2) is None, "one alone would be faster"


def test_a_training_of_unknown_length_teaches_no_rate(tmp_path):
    text = TEXT.replace("steps: 1000", "steps: 0").replace(
        "all: {train: all}", "all: {train: all}\n  long: {train: all, steps: 5000}"
    )
    design = finished(tmp_path, text)
    assert [training.steps for training in design.trainings] == [0, 5000]
    episodes(evaluation_folder(tmp_path, "evaluate/long.0"), 6.0, 6.0)
    found = rates_of_run("mine", "night", tmp_path, design, 2, BEFORE)
    assert found.steps_per_s == pytest.approx(5000 / (210 - 10)), "of the other one"


def test_a_run_without_a_training_alone_keeps_the_rate_of_one(tmp_path):
    design = finished(tmp_path, training={"train/all.0": {"wall_s": 240.0, "at_once": 2.0}})
    found = rates_of_run("mine", "night", tmp_path, design, 2, BEFORE)
    assert found.steps_per_s == BEFORE.steps_per_s
    assert found.source == "run of mine night: 20 demonstrations, 20 rollouts; trainings alone: test"
    assert found.at_once(2).steps_per_s == pytest.approx(1000 / (240 - 10)), "its start is not known any better"
    again = rates_of_run("mine", "night", tmp_path, design, 2, found)
    assert again.source == found.source
    assert again.demonstration_s == pytest.approx(2.0)


def test_a_probe_takes_successes_as_long_as_demonstrations_and_failures_as_long_as_the_limit():
    demonstrations = [
        EpisodeResult(episode_id=str(index), index=index, steps=steps) for index, steps in enumerate((30, 50))
    ]
    rollouts = [
        EpisodeResult(episode_id=str(index), index=index, steps=steps, wall_s=wall_s)
        for index, (steps, wall_s) in enumerate(((100, 11.0), (60, 5.0)))
    ]
    assert rollout_times(demonstrations, rollouts, 2) == (pytest.approx(0.05 * 40), pytest.approx(0.05 * 100))


def test_the_rate_side_by_side_is_that_of_the_time_in_which_all_made_steps():
    first = [(0.0, 10), (1.0, 30), (2.0, 40), (3.0, 50), (9.0, 170)]
    second = [(1.0, 10), (2.0, 15), (3.0, 20)]
    assert common_steps([first, second]) == 10
    assert common_rate([first, second]) == pytest.approx((10 + 5) / 2)
    assert common_steps([first, []]) == 0
    assert common_steps([first, [(20.0, 10)]]) == 0, "they were not at the same time"


TRAINER = """
import json, os, signal, sys, time
seed, fails = int(sys.argv[1]), sys.argv[2]
if fails == "fails":
    sys.exit("no memory left")
with open(os.environ["ROBOXIM_EVENTS"], "a") as events:
    for tick in range(1, 5):
        at = f"2026-01-01T00:00:0{tick}+00:00"
        done = (10 + 5 * seed) * tick
        print(json.dumps({"event": "stage_progress", "time": at, "done": done, "total": 99}), file=events)
signal.pause()
"""


@pytest.fixture
def trainers(monkeypatch):
    """Let scripts stand in for trainings of bc; the fixture has their processes."""
    processes = []

    def fake(fails):
        def started(words, log, reports):
            seed = words[words.index("--seed") + 1]
            command = [sys.executable, "-S", "-c", TRAINER, seed, "fails" if seed in fails else ""]
            processes.append(experiment_trainings.started(command, log, reports))
            return processes[-1]

        monkeypatch.setattr(calibration_trainings, "started", started)
        return processes

    return fake


def test_trainings_side_by_side_are_measured_and_ended(trainers, tmp_path):
    processes = trainers(fails=())
    found = measure_side_by_side(tmp_path / "rlds", tmp_path, 3, 30, source="probe")
    assert found.trainings == 3
    assert found.steps_per_s == pytest.approx((10 + 15 + 20) / 3)
    assert [process.poll() for process in processes] == [-signal.SIGKILL] * 3
    assert found.source == "probe"


def test_a_training_that_fails_ends_the_measurement(trainers, tmp_path):
    processes = trainers(fails=("1",))
    with pytest.raises(RoboximError, match=r"--seed 1 ended with exit code 1:\nno memory left"):
        measure_side_by_side(tmp_path / "rlds", tmp_path, 2, 31, source="probe")
    assert None not in [process.poll() for process in processes]


def test_a_run_in_pieces_teaches_nothing(tmp_path):
    """The log has the time of the last piece alone, in which most of a stage may have been done before."""
    assert rates_of_run("mine", "night", tmp_path, finished(tmp_path, continued=True), 2, BEFORE) is None
