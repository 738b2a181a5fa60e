"""For tests: comparisons of runs, a Ray cluster on this machine, planted results."""

from __future__ import annotations

import contextlib
import json
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from planted_cards import SKILL_AND_OBJECT

if TYPE_CHECKING:
    from roboxim_runs.experiments.report import ExperimentFolder

PLANTED_EXPERIMENT = SKILL_AND_OBJECT + """
dimensions: {task: skill, target: object}
trainers:
  mine: {command: "train {dataset} {out} {seed}", policy: bc, steps: 7}
evaluate: {per_cell: 20, cells: {blind: unseen}}
compare:
  - {first: leave_out, second: baseline, where: unseen, primary: true}
"""  # fmt: skip
"""Text of an experiment of three conditions in six cells; see `planted_folder`."""
PLANTED_RATES: Mapping[str, float] = {"leave_out": 0.4, "baseline": 0.9, "blind": 0.0}
"""Condition to its success rate in `planted_folder`."""


def recordings(run: Path) -> dict[str, str]:
    """Return the hash of every recording in a run's folder, by its path."""
    from roboxim_runs.storage.store import file_sha256

    return {str(path.relative_to(run)): file_sha256(path) for path in run.rglob("*/*/*.mcap")}


def repeatable_results(run: Path) -> list[dict[str, Any]]:
    """Return a run's results without the times, which no two machines share."""
    from roboxim_core.config import to_plain
    from roboxim_runs.storage.folder import RunFolder
    from roboxim_runs.storage.merging import CLOCKED

    found = [to_plain(result) for result in RunFolder(run).results()]
    return [{name: value for name, value in result.items() if name not in CLOCKED} for result in found]


def ray_cluster(nodes: int = 2) -> Any:
    """Return a `ray.cluster_utils.Cluster` of so many nodes on this machine, each with one CPU; the caller ends it."""
    from ray.cluster_utils import Cluster

    from roboxim_runs.executors.ray_cluster import OWN_CLUSTER

    head = {"num_cpus": 1, "_system_config": OWN_CLUSTER, **_agent_ports()}  # further nodes take the settings from it
    cluster = Cluster(initialize_head=True, head_node_args=head)
    for _ in range(nodes - 1):
        add_ray_node(cluster)
    return cluster


def add_ray_node(cluster: Any, **options: Any) -> Any:
    """Add a node with one CPU to a cluster and return it.

    Args:
        cluster: As `ray_cluster` returns it.
        **options: For `ray.cluster_utils.Cluster.add_node`.
    """
    return cluster.add_node(num_cpus=1, **_agent_ports(), **options)


def _agent_ports() -> dict[str, int]:
    """Return free ports for a node's agents: Ray ends a node that has not chosen its own within 15 s."""
    names = ("metrics_agent_port", "metrics_export_port", "runtime_env_agent_port", "dashboard_agent_listen_port")
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in names]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return {name: one.getsockname()[1] for name, one in zip(names, sockets, strict=True)}


def planted_folder(
    out: Path,
    rates: Mapping[str, float],
    text: str = PLANTED_EXPERIMENT,
    predicates: Mapping[str, float] | None = None,
) -> ExperimentFolder:
    """Write an experiment's folder with results: scene k of a cell is solved if its number is below the rate.

    Args:
        out: The folder, which does not exist yet.
        rates: Condition to its success rate, and key of a cell to that of all conditions there.
        text: The experiment, with 20 rollouts in each cell.
        predicates: Predicates of every verdict.
    """
    from planted_cards import experiment_of

    from roboxim_core.config import to_plain
    from roboxim_core.episode import EpisodeResult
    from roboxim_core.plain_data.results_log import ResultsLog
    from roboxim_core.verdicts import Verdict
    from roboxim_eval.experiments import stages_of
    from roboxim_runs.experiments.card import evaluation_folder
    from roboxim_runs.experiments.files import checked_design
    from roboxim_runs.experiments.report import ExperimentFolder
    from roboxim_runs.storage.folder import RunFolder
    from roboxim_tasks.config import task_mix

    config = experiment_of(text)
    design = checked_design("mine", config)
    out.mkdir(parents=True)
    state = {"experiment": "mine.yaml", "scale": "full", "config": to_plain(config), "stages": {}}
    (out / "experiment.json").write_text(json.dumps(state))
    log = ResultsLog(out / "stages.jsonl")
    for stage in stages_of(design):
        log.append("key", {"stage": stage.name, "wall_s": 1.0, "sha256": f"hash of {stage.name}"})
        if stage.kind == "train":
            (out / stage.name).mkdir(parents=True)
            (out / stage.name / "checkpoint.npz").write_text(stage.name)
        if stage.kind != "evaluate":
            continue
        condition = stage.name.removeprefix("evaluate/").partition(".")[0]
        mix = task_mix(stage.inputs["mix"])
        folder = evaluation_folder(out, stage.name)
        folder.mkdir(parents=True)
        with RunFolder(folder).opened({"command": "evaluate"}) as run:
            for index in range(stage.inputs["episodes"]):
                drawn = mix.drawn(index)
                won = int(drawn["cell_number"]) < 20 * rates.get(drawn["cell"], rates[condition])
                run.append(EpisodeResult(
                    episode_id=f"eval-{index}", index=index, outcome="success" if won else "failure",
                    reason="" if won else "not_lifted", instruction="Pick it up",
                    verdict=Verdict(predicates=dict(predicates or {})),
                ))  # fmt: skip
    return ExperimentFolder.of(out)
