"""Runs an experiment: a graph of stages, each an ordinary run in a folder of its own.

``OUT/experiment.json`` holds the experiment and the inputs of every stage, ``OUT/stages.jsonl`` a line for each
finished stage. The same call continues: finished stages are skipped, and an unfinished one continues as its run does. A
stage whose inputs have changed is refused by name.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any

import yaml

from roboxim_bringup.executors import Cancellation, CancelledError
from roboxim_bringup.experiment_card import collect_card
from roboxim_bringup.experiment_files import checked_design, load_experiment
from roboxim_bringup.experiment_provenance import (
    ATTEST_FILE,
    Attestations,
    attestation_template,
    folder_sha256,
)
from roboxim_bringup.parameters import parse_options
from roboxim_bringup.runs.evaluation import EvaluationConfig, evaluate
from roboxim_bringup.runs.events import Notice, OnEvent, StageFinished, StageStarted, ignore
from roboxim_bringup.runs.experiment_report import (
    STATE_FILE,
    ExperimentFolder,
    write_card,
    write_experiment_report,
)
from roboxim_bringup.runs.export import ExportConfig, export_rlds
from roboxim_bringup.runs.folder import checked_path, make_folder
from roboxim_bringup.runs.generation import GenerationConfig, generate
from roboxim_bringup.runs.policies import PolicySpec, find_policies
from roboxim_bringup.runs.results_log import ResultsLog, write_atomically
from roboxim_core.config import digest, to_plain
from roboxim_core.differences import differences
from roboxim_core.documents import parse_json, read_text
from roboxim_core.errors import ConfigError, RoboximError, one_of
from roboxim_eval.experiments import Design, Stage, stages_of
from roboxim_eval.experiments.card import Card

KINDS = ("generate", "export", "train", "evaluate")
POLL_S = 1.0


@dataclass(frozen=True, kw_only=True)
class ExperimentRunConfig:
    """Configuration of an experiment's run."""

    experiment: str
    """Name in ``config/experiments``, or a YAML file."""
    scale: str = "full"
    """One of its scales."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Keys of the file to replace, e.g. a benchmark's own scales."""
    out: Path | str = "runs/experiment"
    """The run's folder."""
    trainer: str = ""
    """Trainer of the file; empty: its first one."""
    policies: Mapping[str, PolicySpec] = field(default_factory=dict)
    """Policies that exist: ``CONDITION.REPLICATE``, or ``CONDITION`` for all replicates, to the policy."""
    only: tuple[str, ...] = KINDS
    """Kinds of stages to run."""
    workers: int = field(default_factory=lambda: min(2, os.cpu_count() or 1))
    """Processes that run episodes."""
    renderer: str = "raster"
    """Renderer of the images."""

    def __post_init__(self) -> None:
        """Check the names.

        Raises:
            ConfigError: When a kind of stage is unknown.
        """
        for kind in self.only:
            if kind not in KINDS:
                raise ConfigError(f"only: no stages of kind '{kind}'; {one_of(KINDS, kind)}")


@dataclass(frozen=True, kw_only=True)
class ExperimentResult:
    """State of an experiment after a call."""

    out: Path
    """The run's folder."""
    finished: tuple[str, ...]
    """Names of the finished stages."""
    missing: tuple[str, ...]
    """Names of the stages that are not finished."""
    card: Card | None
    """Results; none while evaluations are missing."""


def run_experiment(
    config: ExperimentRunConfig, *, on_event: OnEvent = ignore, cancellation: Cancellation | None = None
) -> ExperimentResult:
    """Run the stages of an experiment that its folder lacks.

    Args:
        config: Configuration of the run.
        on_event: Receives the events of all stages.
        cancellation: Ends the run when it is set.

    Raises:
        CancelledError: When the run was cancelled; the same call continues.
        ConfigError: When the experiment is invalid, a policy is not named, or inputs of a finished stage have changed.
        RoboximError: When a stage fails.
    """
    experiment = load_experiment(config.experiment, config.scale, changes=config.changes)
    if experiment.curve is not None:
        experiment = replace(experiment, curve=None)
        on_event(Notice(text="the learning curve is left out: only the last checkpoint of each training is evaluated"))
    design = checked_design(config.experiment, experiment, config.trainer)
    faulty = [name for name in design.datasets if experiment.datasets[name].fault]
    if faulty:
        raise ConfigError(f"datasets with planted faults cannot be made by 'experiment run' yet: {', '.join(faulty)}")
    run = _Run(config, design, on_event, cancellation)
    run.open()
    for stage in run.stages:
        if stage.kind in config.only:
            run.finish(stage)
    done = run.done
    missing = tuple(stage.name for stage in run.stages if stage.name not in done)
    card = None
    if not any(name.startswith("evaluate/") for name in missing):
        name = Path(config.experiment).stem
        card = collect_card(
            name, config.scale, design, run.out, trainer=config.trainer, renderer=config.renderer
        )  # fmt: skip
        write_card(card, run.out)
        write_experiment_report(ExperimentFolder.of(run.out), card)
    return ExperimentResult(
        out=run.out, finished=tuple(s.name for s in run.stages if s.name in done), missing=missing, card=card
    )


class _Run:
    """An experiment's folder, and its stages."""

    def __init__(
        self, config: ExperimentRunConfig, design: Design, on_event: OnEvent, cancellation: Cancellation | None
    ) -> None:
        self.config, self.design = config, design
        self.out = checked_path(config.out)
        self.log = ResultsLog(self.out / "stages.jsonl")
        self._options: dict[str, Any] = {"on_event": on_event, "cancellation": cancellation}
        self._on_event, self._cancellation = on_event, cancellation
        trained = bool(design.trainer.command)
        self.stages = tuple(stage for stage in stages_of(design) if stage.kind != "train" or trained)
        self.policies = {
            stage.name: self._policy(stage)
            for stage in self.stages
            if stage.kind == "evaluate" and "evaluate" in config.only
        }
        _require_found(self.policies.values())

    # -------------------------------------------------------------- state

    def open(self) -> None:
        """Store the experiment, or check that the folder holds the same one."""
        make_folder(self.out)
        state = self.out / STATE_FILE
        stored = parse_json(read_text(state), source=str(state)) if state.exists() else {}
        before = stored.get("stages", {}) if isinstance(stored, dict) else {}
        done = {entry.data.get("stage", ""): entry.key for entry in self.log.read()}
        for stage in self.stages:
            if stage.name in done and done[stage.name] != self._key(stage) and stage.kind in self.config.only:
                changed = differences(before.get(stage.name, {}), _plain(self._inputs(stage)))
                raise ConfigError(
                    f"{self.out}: stage '{stage.name}' was finished with other inputs "
                    f"({changed or 'of a stage that it needs'}); choose another output folder (--out)"
                )
        inputs = {stage.name: _plain(self._inputs(stage)) for stage in self.stages}
        content = {
            "experiment": self.config.experiment, "scale": self.config.scale, "trainer": self.config.trainer,
            "renderer": self.config.renderer, "config": to_plain(self.design.config), "stages": {**before, **inputs},
        }  # fmt: skip
        write_atomically(state, json.dumps(_plain(content), indent=2) + "\n")
        self._attest()

    def _attest(self) -> None:
        """Check what is attested about the trainings; write a file to fill in if they run elsewhere."""
        names = tuple(f"{t.condition}.{t.replicate}" for t in self.design.trainings)
        Attestations.of(self.out, self.design.trainer).require_known(names)
        path = self.out / ATTEST_FILE
        if names and not self.design.trainer.command and not path.exists():
            write_atomically(path, attestation_template(names, self.design.trainer.steps))

    @property
    def done(self) -> set[str]:
        """Names of the finished stages whose inputs are unchanged."""
        keys = {entry.key for entry in self.log.read()}
        return {stage.name for stage in self.stages if self._key(stage) in keys}

    def _inputs(self, stage: Stage) -> dict[str, Any]:
        policy = self.policies.get(stage.name)
        return stage.inputs | ({"policy": to_plain(policy)} if policy else {})

    def _key(self, stage: Stage) -> str:
        policy = self.policies.get(stage.name)
        if policy is None and stage.kind == "evaluate":  # not to be run now: what it ran with is unknown
            return next((e.key for e in self.log.read() if e.data.get("stage") == stage.name), "")
        return digest({"sha": stage.sha, "name": stage.name, "policy": _plain(to_plain(policy)) if policy else None})

    # -------------------------------------------------------------- stages

    def finish(self, stage: Stage) -> None:
        """Run a stage unless it is finished."""
        if stage.name in self.done:
            return
        absent = [need for need in stage.needs if need not in self.done and need in {s.name for s in self.stages}]
        if absent:
            raise ConfigError(f"stage '{stage.name}' needs {', '.join(absent)}; run these kinds of stages too (--only)")
        started = time.monotonic()
        getattr(self, f"_{stage.kind}")(stage)
        entry = {"stage": stage.name, "wall_s": round(time.monotonic() - started, 1)}
        if stage.kind in ("export", "train"):
            entry["sha256"] = folder_sha256(self._folder(stage.name))
        self.log.append(self._key(stage), entry)

    def _folder(self, stage: str) -> Path:
        return self.out / stage

    def _mix(self, stage: Stage) -> str:
        """Write a stage's task mix, and return the file."""
        path = self.out / "mixes" / f"{stage.name.replace('/', '-')}.yaml"
        path.parent.mkdir(exist_ok=True)
        path.write_text(yaml.safe_dump(_plain(stage.inputs["mix"]), sort_keys=False))
        return str(path)

    def _generate(self, stage: Stage) -> None:
        size = tuple(map(int, stage.inputs["size"].split("x")))
        result = generate(
            GenerationConfig(
                task=self._mix(stage), out=self._folder(stage.name), episodes=stage.inputs["episodes"],
                seed=stage.inputs["seed"], size=(size[0], size[-1]), first_try=True, workers=self.config.workers,
                renderer=self.config.renderer,
            ),
            **self._options,
        )  # fmt: skip
        failed = len(result.results) - len(result.kept)
        if failed:
            raise RoboximError(
                f"{failed} of {len(result.results)} demonstrations in {result.out} failed in all attempts, so the "
                "cells do not have their numbers; raise max_draws of the task, or widen what it draws"
            )

    def _export(self, stage: Stage) -> None:
        counts: dict[str, int] = stage.inputs["counts"]
        selection = ExportConfig(
            val_fraction=0.0, where=(f"cell={','.join(counts)}",), per_cell=max(counts.values()),
        )  # fmt: skip
        report = export_rlds(self._folder(stage.needs[0]), self._folder(stage.name), selection, **self._options)
        exported = sum(report.splits.values())
        if exported != sum(counts.values()):
            raise RoboximError(
                f"{stage.name} has {exported} episodes, expected {sum(counts.values())}: {report.left_out}"
            )

    def _train(self, stage: Stage) -> None:
        folder = self._folder(stage.name)
        words = [
            word.format(dataset=self._folder(stage.needs[0]), out=folder, seed=stage.inputs["seed"],
                        steps=stage.inputs["steps"])
            for word in shlex.split(stage.inputs["command"])
        ]  # fmt: skip
        folder.parent.mkdir(exist_ok=True)
        self._on_event(StageStarted(title=f"training {stage.name}", total=1))
        with open(folder.parent / f"{folder.name}.log", "a") as log:
            process = _started(words, log)
            try:
                while process.poll() is None:
                    if self._cancellation is not None and self._cancellation.is_set():
                        raise CancelledError("the experiment was cancelled")
                    try:
                        process.wait(POLL_S)
                    except subprocess.TimeoutExpired:
                        continue
            finally:
                if process.poll() is None:
                    process.terminate()
                    process.wait()
        if process.returncode:
            raise RoboximError(f"{shlex.join(words)} ended with code {process.returncode}; see {log.name}")
        self._on_event(StageFinished())

    def _evaluate(self, stage: Stage) -> None:
        size = tuple(map(int, self.design.config.image_size.split("x")))
        result = evaluate(
            EvaluationConfig(
                policies=self.policies[stage.name], task=self._mix(stage), out=self._folder(stage.name),
                episodes=stage.inputs["episodes"], seed=stage.inputs["seed"], max_steps=stage.inputs["max_steps"],
                size=(size[0], size[-1]), workers=self.config.workers, renderer=self.config.renderer,
            ),
            **self._options,
        )  # fmt: skip
        result.require_measured()

    # -------------------------------------------------------------- policies

    def _policy(self, stage: Stage) -> PolicySpec:
        """Return the policy of an evaluation.

        Raises:
            ConfigError: When it is trained elsewhere and not named.
        """
        name, replicate = stage.name.removeprefix("evaluate/").rsplit(".", 1)
        condition = self.design.config.conditions[name]
        given = self.config.policies
        for key in (f"{name}.{replicate}", name):
            if key in given:
                return replace(given[key], name=name)
        base = condition.checkpoint_of or name
        for key in (f"{base}.{replicate}", base):
            if key in given:
                return _worded(given[key], name, condition.instruction)
        if not self.design.trainer.command or self.design.config.conditions[base].given:
            raise ConfigError(
                f"the policy of {base}.{replicate} is trained elsewhere: name it with --policy {base}.{replicate}=SPEC"
            )
        checkpoint = str(self._folder(f"train/{base}.{replicate}").resolve())
        policy = PolicySpec(spec=self.design.trainer.policy, options={"checkpoint": checkpoint})
        return _worded(policy, name, condition.instruction)


def _started(words: Sequence[str], log: IO[str]) -> subprocess.Popen[bytes]:
    """Start a training command; ``roboxim`` is the one of this environment.

    Raises:
        ConfigError: When there is no such program.
    """
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)))
    try:
        return subprocess.Popen(words, stdout=log, stderr=subprocess.STDOUT, env={**os.environ, "PATH": path})
    except OSError as error:
        raise ConfigError(f"the training command cannot be started: {shlex.join(words)} ({error.strerror})") from None


def _worded(policy: PolicySpec, name: str, instruction: str | None) -> PolicySpec:
    """Return a policy that receives another instruction; none: the task's own."""
    if instruction is None:
        return replace(policy, name=name)
    if policy.spec == "expert":
        raise ConfigError(f"the expert reads the task, not its words; name another policy with --policy {name}=SPEC")
    options = {**policy.options, "policy": policy.spec, "instruction": instruction}
    return PolicySpec(spec="reworded", name=name, options=options)


def named_policies(words: Sequence[str], options: Sequence[str] = ()) -> dict[str, PolicySpec]:
    """Return policies named on the command line.

    Args:
        words: ``CONDITION[.R]=SPEC``.
        options: ``CONDITION[.R].KEY=VALUE``.

    Raises:
        ConfigError: When a word has another form, or an option is for a policy that is not named.
    """
    found = {}
    for word in words:
        name, equals, spec = word.partition("=")
        if not equals or not spec:
            raise ConfigError(f"--policy {word}: expected CONDITION[.R]=SPEC, e.g. leave_out.0=client.py:Mine")
        found[name] = PolicySpec(spec=spec)
    given: dict[str, list[str]] = {}
    for word in options:
        name = next((n for n in sorted(found, key=len, reverse=True) if word.startswith(f"{n}.")), "")
        if not name:
            raise ConfigError(f"--option {word}: it is for none of the policies; {one_of(found, word)}")
        given.setdefault(name, []).append(word[len(name) + 1 :])
    return {name: replace(policy, options=parse_options(given.get(name, []))) for name, policy in found.items()}


def _require_found(policies: Iterable[PolicySpec]) -> None:
    """Check policies that are named by the user before anything runs.

    Raises:
        ConfigError: When one is unknown or does not take its options.
    """
    checked: list[PolicySpec] = []
    for policy in policies:
        if policy not in checked and "checkpoint" not in policy.options:
            find_policies([policy])
            checked.append(policy)


def _plain(value: Any) -> Any:
    return json.loads(json.dumps(value))
