"""Runs the stages of an experiment: each is an ordinary run in its own folder, or a proof.

Trainings are in `roboxim_runs.training.commands`.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from roboxim_core.config import to_plain
from roboxim_core.errors import RoboximError
from roboxim_core.plain_data.documents import read_json_object
from roboxim_core.seeds import CELL
from roboxim_core.shards import Shard
from roboxim_core.whole_files import write_json, write_whole
from roboxim_eval.experiments import Design, Stage
from roboxim_eval.experiments.proving.changes import changed_parts
from roboxim_eval.experiments.proving.proofs import NAMED, Tally
from roboxim_eval.experiments.trainers import RLDS
from roboxim_runs.datasets.corruption import corrupt
from roboxim_runs.datasets.export import export_dataset
from roboxim_runs.episodes.generation import GenerationConfig, generate
from roboxim_runs.evaluation.run import EvaluationConfig, evaluate
from roboxim_runs.events import Notice, OnEvent
from roboxim_runs.executors import Cancellation, Executor, KeptProcesses, LocalExecutor
from roboxim_runs.executors.protocol import as_json
from roboxim_runs.experiments.card import PROOF_FILE, evaluation_folder
from roboxim_runs.experiments.delivery.demands import task_mix_of
from roboxim_runs.experiments.delivery.proving import (
    ArmClaim,
    DatasetClaim,
    Reading,
    judge_again,
    prove_evaluation,
    prove_trained_on,
    prove_training,
)
from roboxim_runs.experiments.trained.exports import export_config
from roboxim_runs.experiments.trained.servers import Server, serving
from roboxim_runs.policies.specs import PolicySpec
from roboxim_runs.storage.folder import RunFolder


@dataclass(frozen=True, kw_only=True)
class Stages:
    """Runs the stages of an experiment."""

    design: Design
    """The experiment."""
    out: Path
    """Its folder."""
    policies: Mapping[str, PolicySpec | None]
    """Name of an evaluation to its policy."""
    workers: int
    """Processes that run episodes."""
    renderer: str
    """Renderer of the images."""
    on_event: OnEvent
    """Receives the events of all stages."""
    cancellation: Cancellation | None
    """Ends the run when it is set."""
    executor: Executor | None
    """Runs episodes and reads bags; none: processes of this machine."""
    kept: KeptProcesses
    """Processes of this machine that run the episodes of one stage after the other."""
    shard: str = ""
    """``I/N``: the part of the episodes to run; empty: all."""
    servers: Mapping[str, Server | None] = field(default_factory=dict)
    """Name of an evaluation to the server of its policy; none: it needs none."""

    def run(self, stage: Stage, stages: Mapping[str, Stage]) -> dict[str, Any]:
        """Run a stage.

        Args:
            stage: The stage.
            stages: All stages by name.

        Returns:
            Facts about the result for the log of stages.

        Raises:
            CancelledError: When the run was cancelled; the same call continues.
            RoboximError: When the stage fails.
        """
        if stage.kind == "prove":
            prove = self._prove_training if stage.part == "export" else self._prove_evaluation
            prove(stage, stages)
            return {}
        if self.shard and not Shard.parse(self.shard).indices(stage.inputs["episodes"]):
            return {}  # more shards than episodes
        made: dict[str, Any] | None = getattr(self, f"_{stage.kind}")(stage)
        return made or {}

    @property
    def _options(self) -> dict[str, Any]:
        return {"on_event": self.on_event, "cancellation": self.cancellation}

    @property
    def _size(self) -> tuple[int, int]:
        width, _, height = self.design.config.image_size.partition("x")
        return int(width), int(height or width)

    def _folder(self, stage: str) -> Path:
        return self.out / stage

    def _episodes(self, run: Path) -> Executor:
        """Return what runs the episodes of a run's folder."""
        return self.executor or LocalExecutor(self.workers, log_dir=run / "logs", kept=self.kept)

    def _mix(self, stage: Stage) -> str:
        """Write a stage's task mix, and return the file."""
        path = self.out / "mixes" / f"{stage.name.replace('/', '-')}.yaml"
        path.parent.mkdir(exist_ok=True)
        write_whole(path, yaml.safe_dump(as_json(stage.inputs["mix"]), sort_keys=False))
        return str(path)

    # -------------------------------------------------------------- data

    def _generate(self, stage: Stage) -> None:
        noise = stage.inputs["noise"]
        result = generate(
            GenerationConfig(
                task=self._mix(stage), out=self._folder(stage.name), episodes=stage.inputs["episodes"],
                seed=stage.inputs["seed"], size=self._size, first_try=True, workers=self.workers,
                renderer=self.renderer, shard=self.shard,
                noise_mm=noise["translation_mm"], noise_mrad=noise["rotation_mrad"],
                noise_descents=noise.get("descents", 0.0),
            ),
            executor=self._episodes(self._folder(stage.name)), **self._options,
        )  # fmt: skip
        failed = len(result.results) - len(result.kept)
        if failed:
            raise RoboximError(
                f"{failed} of {len(result.results)} demonstrations in {result.out} failed in all attempts, so the "
                "cells do not have their numbers; raise max_draws of the task, or widen what it draws"
            )

    def _corrupt(self, stage: Stage) -> None:
        folder = self._folder(stage.name)
        shutil.rmtree(folder, ignore_errors=True)  # of an interrupted run: only a whole copy is named in the log
        made = corrupt(
            self._folder(stage.needs[0]), folder, stage.inputs["fault"], stage.inputs["share"],
            seed=stage.inputs["seed"], link=True, **self._options,
        )  # fmt: skip
        wanted = max(1, round(stage.inputs["share"] * sum(stage.inputs["counts"].values())))
        if len(made.planted) < wanted:
            raise RoboximError(
                f"'{stage.inputs['fault']}' could be planted in {len(made.planted)} of {wanted} episodes; the others "
                "do not allow it; lower the share, or choose a task that allows it"
            )

    def _export(self, stage: Stage) -> dict[str, Any]:
        counts: dict[str, int] = stage.inputs["counts"]
        form = stage.inputs.get("format", RLDS)
        largest = max(counts.values())
        selection = export_config(
            form, stage.inputs.get("options", {}), where=(f"cell={','.join(counts)}",), per_cell=largest,
            cell_counts={cell: count for cell, count in counts.items() if count < largest},
        )  # fmt: skip
        report = export_dataset(
            form, self._folder(stage.needs[0]), self._folder(stage.name), selection, **self._options
        )
        exported = sum(report.splits.values())
        if exported != sum(counts.values()):
            raise RoboximError(
                f"{stage.name} has {exported} episodes, expected {sum(counts.values())}: {report.left_out}"
            )
        return {"faulty": len(self._claim(stage).planted)}

    # -------------------------------------------------------------- policies

    def _evaluate(self, stage: Stage) -> None:
        policy = self.policies[stage.name]
        assert policy is not None
        with serving(self.servers.get(stage.name), self._folder(stage.name), **self._options):
            result = evaluate(
                EvaluationConfig(
                    policies=policy, task=self._mix(stage), out=self._folder(stage.name),
                    episodes=stage.inputs["episodes"], seed=stage.inputs["seed"], max_steps=stage.inputs["max_steps"],
                    size=self._size, workers=self.workers, renderer=self.renderer, page=False, shard=self.shard,
                    latency=stage.inputs["latency_ticks"],
                ),
                executor=self._episodes(evaluation_folder(self.out, stage.name)), **self._options,
            )  # fmt: skip
        result.require_measured()

    # -------------------------------------------------------------- proofs

    def _reading(self, stage: Stage) -> Reading:
        return Reading(
            workers=self.workers, logs=self._folder(stage.name) / "logs", executor=self.executor, **self._options
        )

    def _prove_training(self, stage: Stage, stages: Mapping[str, Stage]) -> None:
        claims = [self._claim(stages[need]) for need in stage.needs]
        found = prove_training(claims, as_json(stage.inputs["mix"]), stage.inputs["unseen"], self._reading(stage))
        self._store(stage, found, {}, None, max_faults=0.0)

    def _claim(self, export: Stage) -> DatasetClaim:
        source = self._folder(export.needs[0])
        listing = source.with_name(f"{source.name}-planted.json")
        planted = read_json_object(listing)["planted"] if export.needs[0].startswith("corrupt/") else {}
        name = export.name.removeprefix("export/")
        return DatasetClaim(
            name=name, path=self._folder(export.name), bags=source, counts=export.inputs["counts"], planted=planted
        )

    def _prove_evaluation(self, stage: Stage, stages: Mapping[str, Stage]) -> None:
        arms = [self._arm(stages[need]) for need in stage.needs]
        found, excluded = prove_evaluation(arms, self._reading(stage))
        if stage.of_curve:  # the final rollouts' proof says what the trainings read
            self._store(stage, found, excluded, None)
            return
        trainings = dict.fromkeys(t for need in stage.needs for t in stages[need].needs if t.startswith("train/"))
        for name in trainings:
            if name in stages:
                found += prove_trained_on(self._folder(name), self._claim(stages[stages[name].needs[0]]))
            else:
                found += Tally(statements=(f"{name} took place elsewhere: its training data are unproven",))
        again = self._judge_again(stage, stages, arms, excluded)
        self._store(stage, found, excluded, again)

    def _arm(self, stage: Stage) -> ArmClaim:
        name = stage.name.removeprefix("evaluate/").rsplit(".", 1)[0]
        condition, checkpoint = self.design.config.conditions[name], stage.inputs["checkpoint"]
        return ArmClaim(
            condition=f"{name}@{checkpoint}" if checkpoint else name,
            folder=self._folder(stage.name) / name, mix=as_json(stage.inputs["mix"]),
            words=condition.instruction, latency_ticks=condition.latency_ticks, changed=changed_parts(condition.set),
        )  # fmt: skip

    def _judge_again(
        self, stage: Stage, stages: Mapping[str, Stage], arms: Sequence[ArmClaim], excluded: Mapping[str, Sequence[int]]
    ) -> list[dict[str, Any]] | None:
        """Judge failed held-out episodes of the primary comparison's first condition by the training's instructions.

        Returns:
            The episodes; none: no training of this experiment held cells out.
        """
        primary = self.design.config.primary
        first = self.design.config.conditions[primary.first] if primary else None
        unseen = {cell.key for cell in self.design.cells if cell.unseen}
        if primary is None or first is None or not first.train or not unseen:
            return None
        arm = next(arm for arm in arms if arm.condition == primary.first)
        mix, run, failed = task_mix_of(json.dumps(arm.mix)), RunFolder(arm.folder), {}
        for result in run.results():
            cell = mix.drawn(result.index)[CELL]
            out = result.index in excluded.get(primary.first, ())
            if cell in unseen and result.outcome == "failure" and result.bag and not out:
                failed[str(run.path / result.bag)] = cell
        generation = stage.name.rpartition(".")[2] if self.design.generations > 1 else "0"
        claim = self._claim(stages[f"export/{first.train}.{generation}"])
        return judge_again(failed, claim, as_json(stage.inputs["mix"]), self._reading(stage))

    def _store(
        self,
        stage: Stage,
        found: Tally,
        excluded: Mapping[str, Sequence[int]],
        again: Sequence[Mapping[str, Any]] | None,
        **limits: float,
    ) -> None:
        """Write a proof, and refuse it when too much failed. Faults that are tolerated are stated.

        Raises:
            RoboximError: Naming bags and figures.
        """
        folder = self._folder(stage.name)
        folder.mkdir(parents=True, exist_ok=True)
        refusal = found.refusal(**limits)
        if found.faults and not refusal:
            found += Tally(statements=(self._tolerated(stage, found, excluded),))
        content = {**to_plain(found), "excluded": excluded, "judged_again": again}
        write_json(folder / PROOF_FILE, content)
        for text in found.statements:
            self.on_event(Notice(text=text))
        if refusal:
            raise RoboximError(f"{stage.name}: {refusal}\nall of them are in {folder / PROOF_FILE}")

    def _tolerated(self, stage: Stage, found: Tally, excluded: Mapping[str, Sequence[int]]) -> str:
        """Return a proof's faults in words: bags relative to the experiment's folder, checks and figures."""
        checked = max((number for _, number in found.checks.values()), default=0)
        named = "; ".join(str(replace(fault, bag=self._within(fault.bag))) for fault in found.faults[:NAMED])
        more = f"; and {len(found.faults) - NAMED} more" if len(found.faults) > NAMED else ""
        left_out = sum(map(len, excluded.values()))
        return (
            f"{stage.name}: tolerated faults in {len(found.faulty)} of {checked} episodes, {left_out} of them left out "
            f"of the results: {named}{more} (all of them are in {stage.name}/{PROOF_FILE})"
        )

    def _within(self, bag: str) -> str:
        """Return a bag's path relative to the experiment's folder; as it is if it lies elsewhere."""
        path = Path(bag)
        return path.relative_to(self.out).as_posix() if path.is_relative_to(self.out) else bag
