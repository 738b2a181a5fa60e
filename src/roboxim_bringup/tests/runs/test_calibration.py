"""The rates that a finished run of an experiment teaches, from planted times."""

from dataclasses import replace

import pytest

from roboxim_bringup.experiment_card import evaluation_folder
from roboxim_bringup.experiment_files import checked_design
from roboxim_bringup.runs.calibration import rates_of_run
from roboxim_bringup.runs.folder import RunFolder
from roboxim_bringup.runs.results_log import ResultsLog
from roboxim_core.episode import EpisodeResult
from roboxim_eval.experiments import stages_of
from roboxim_eval.testing import RATES, experiment_of

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


def episodes(folder, first_s, wall_s):
    """Write 20 episodes of which the first one of each of two workers takes longer."""
    with RunFolder(folder).opened({}) as run:
        for index in range(20):
            seconds = first_s if index < 2 else wall_s
            run.append(EpisodeResult(episode_id=str(index), index=index, outcome="success", wall_s=seconds))


def finished(out, **more):
    design = checked_design("mine", experiment_of(TEXT))
    log = ResultsLog(out / "stages.jsonl")
    for stage in stages_of(design):
        log.append(stage.name, {"stage": stage.name, "wall_s": WALL[stage.kind], **more})
    episodes(out / "generate/0", 14.0, 4.0)
    episodes(evaluation_folder(out, "evaluate/all.0"), 6.0, 6.0)
    return design


def test_a_run_teaches_the_rates_of_its_stages(tmp_path):
    found = rates_of_run("mine", tmp_path, finished(tmp_path), 2, BEFORE)
    assert found.demonstration_s == pytest.approx(2.0), "both workers work, and what they load is no episode's"
    assert found.start_s == pytest.approx(60 - 20 * 2.0)
    assert found.steps_per_s == pytest.approx(1000 / (210 - 10))
    assert found.rollout_s == pytest.approx(3.0)
    assert found.evaluate_start_s == pytest.approx(80 - 7 - 20 * 3.0)
    assert found.proof_s == pytest.approx((9 - 5) / 20)
    assert (found.film_s, found.train_start_s) == (BEFORE.film_s, BEFORE.train_start_s), "which a run does not show"


def test_a_run_in_pieces_teaches_nothing(tmp_path):
    """The log has the time of the last piece alone, in which most of a stage may have been done before."""
    assert rates_of_run("mine", tmp_path, finished(tmp_path, continued=True), 2, BEFORE) is None
