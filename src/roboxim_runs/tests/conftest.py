"""Stand-ins of the runs of an experiment that need a simulator."""

import json
import os
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import pytest
from planted_cards import SKILL_AND_OBJECT

from roboxim_bringup.testing import graph, graph_parameters
from roboxim_core.config import parse_yaml
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import RoboximError
from roboxim_eval.experiments.proving.proofs import Tally
from roboxim_ros.testing import runtime
from roboxim_runs.experiments import stages as experiment_stages
from roboxim_runs.experiments.run_config import ExperimentRunConfig
from roboxim_runs.policies.specs import find_policies
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.storage.store import STORED_FILE
from roboxim_tasks.config import task_mix

__all__ = ["graph", "graph_parameters", "runtime"]

TEXT = SKILL_AND_OBJECT + """
trainers:
  mine: {command: "sh -c 'mkdir -p {out} && echo {seed} {steps} > {out}/model; : {dataset}'", policy: bc, steps: 7}
  external: {}
evaluate: {per_cell: 10, cells: {blind: unseen}}
compare:
  - {first: leave_out, second: baseline, where: unseen, primary: true}
  - {first: leave_out, second: blind, where: unseen}
"""  # fmt: skip
UNSEEN = ("pick_up target=cube", "place_on target=soda_can")


@pytest.fixture(autouse=True)
def _no_waiting_for_the_disk(monkeypatch):
    """Leave out `fsync` in this process: no test takes the machine's power, and each result waits 1 ms for it."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


@lru_cache(maxsize=16)
def mix_of_text(text):
    return task_mix(parse_yaml(text))


@dataclass
class Fakes:
    """Stands in for the runs that need a simulator. Policies succeed as planted: by condition, held-out or not."""

    planted: dict
    calls: list
    fail_at: str = ""
    training: Tally = Tally()
    evaluation: Tally = Tally()
    excluded: dict = field(default_factory=dict)
    judged: list = field(default_factory=list)
    exports: dict = field(default_factory=dict)
    policies: dict = field(default_factory=dict)

    def generate(self, config, **_):
        self.calls.append(f"generate {config.episodes}")
        assert config.first_try
        Path(config.out).mkdir(parents=True)
        results = [EpisodeResult(episode_id=str(i), index=i, outcome="success") for i in range(config.episodes)]
        return type("Result", (), {"results": results, "kept": results, "out": config.out})()

    def export_dataset(self, form, source, target, config, **_):
        self.exports[Path(target).name] = form, config
        (cells,) = config.where
        names = cells.removeprefix("cell=").split(",")
        number = sum(config.cell_counts.get(name, config.per_cell) for name in names)
        self.calls.append(f"export {Path(target).name} {number}")
        assert config.val_fraction == 0.0
        Path(target).mkdir(parents=True)
        return type("Report", (), {"splits": {"train": number}, "left_out": {}})()

    def prove_training(self, claims, mix, unseen, reading):
        self.calls.append(f"prove {' '.join(claim.name for claim in claims)}")
        return self.training

    def prove_evaluation(self, arms, reading):
        self.calls.append(f"prove rollouts {' '.join(arm.folder.parent.name for arm in arms)}")
        return self.evaluation, self.excluded

    def judge_again(self, failed, dataset, mix, reading):
        self.judged.append((dataset.name, len(failed)))
        return [{"cell": cell, "satisfied": ["place_on target=cube"]} for cell in failed.values()]

    def evaluate(self, config, executor, **_):
        name, replicate = config.policies.name, Path(config.out).name.split(".")[1]
        assert not config.page, "a page for each evaluation would take longer than the experiment's"
        if self.fail_at == f"{name}.{replicate}":
            raise RoboximError("the machine was switched off")
        self.calls.append(f"evaluate {name}.{replicate} {config.policies.spec}")
        self.policies[f"{name}.{replicate}"] = config.policies
        mix = mix_of_text(Path(config.task).read_text())
        own = ".py:" in config.policies.spec
        files = find_policies([config.policies])[0].files(Path(config.out)) if own else {}
        with RunFolder(Path(config.out) / name).opened({"command": "evaluate", "policy_files": files}) as folder:
            for index in range(config.episodes):
                drawn = mix.drawn(index)
                rate = self.planted[name, drawn["cell"] in UNSEEN]
                success = (int(drawn["cell_number"]) + int(replicate)) % 10 < 10 * rate
                outcome = "success" if success else "failure"
                folder.append(
                    EpisodeResult(episode_id=f"{index}", index=index, attempt=0, outcome=outcome, bag=f"{index}")
                )
            bags = "".join(json.dumps({"bag": f"{index}", "files": {}}) + "\n" for index in range(config.episodes))
            (folder.path / STORED_FILE).write_text(bags)
        return type("Result", (), {"require_measured": lambda self: None})()


@pytest.fixture
def fakes(monkeypatch):
    planted = {(name, unseen): 0.8 for name in ("leave_out", "baseline") for unseen in (True, False)}
    planted |= {("blind", True): 0.1, ("leave_out", True): 0.3}
    found = Fakes(planted=planted, calls=[])
    for name in ("generate", "export_dataset", "evaluate", "prove_training", "prove_evaluation", "judge_again"):
        monkeypatch.setattr(experiment_stages, name, getattr(found, name))
    return found


@pytest.fixture
def experiment():
    """Return the experiment's file."""
    return TEXT


@pytest.fixture
def config(tmp_path):
    """Return a function that makes the configuration of a run of an experiment."""

    def made(text=TEXT, **options):
        file = tmp_path / "mine.yaml"
        file.write_text(text)
        return ExperimentRunConfig(**{"experiment": str(file), "out": tmp_path / "out", **options})

    return made
