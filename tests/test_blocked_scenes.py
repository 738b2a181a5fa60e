"""In scenes with a blocked path the expert goes around; an actor that moves straight disturbs the obstacles."""

from __future__ import annotations

from dataclasses import replace

import pytest
import yaml

from roboxim_bringup.core_graph import CoreActor, CoreGraph
from roboxim_bringup.cores import CorePlanner
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.models.library import ModelLibrary
from roboxim_runs.episodes.task_choice import task_text
from roboxim_tasks.demonstration.expert import Expert


@pytest.mark.parametrize("task", ["pick_up_blocked", "place_on_blocked"])
@pytest.mark.thorough
def test_the_expert_goes_around_and_straight_lines_disturb_the_row(task, tmp_path):
    data = yaml.safe_load(task_text(task))
    data["reset"]["cameras"] = {"names": []}
    config = RunConfig(purpose="test", task_config=yaml.safe_dump(data), keep="none", output_dir=str(tmp_path))
    library = ModelLibrary()
    direct = CoreActor(Expert(library, CorePlanner(library), direct=True))
    assert direct.describe().name == "direct_expert"
    with CoreGraph(tmp_path, renderer="tiny") as cores:
        around = EpisodeRunner(cores.ports, config).run_index(1)
        straight = EpisodeRunner(replace(cores.ports, actor=direct), config).run_index(1)
    assert (around.outcome, around.recovered) == ("success", False), around
    assert around.verdict.predicates["distractors_shift_m"] < 0.001
    assert (straight.outcome, straight.reason) == ("failure", "disturbed_distractor"), straight
