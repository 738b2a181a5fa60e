"""Runs an experiment: a graph of stages, each an ordinary run in its own folder.

``OUT/experiment.json`` holds the experiment and the inputs of every stage, ``OUT/stages.jsonl`` a line for each
finished stage, in the order in which they ended. The same call continues: finished stages are skipped, and an
unfinished one continues as its run does. A stage whose inputs have changed is refused by name. A renderer that differs
from that of finished stages is refused too, and so are changed files that the experiment refers to. Each line also
states the version of the code, for the card.
"""

from __future__ import annotations

import itertools
import shutil
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from roboxim_core.config import digest, to_plain
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.differences import differences
from roboxim_core.plain_data.results_log import ResultsLog
from roboxim_core.whole_files import write_json, write_whole
from roboxim_eval.experiments import Design, Stage, stages_of
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.fresh import SceneSeed
from roboxim_policies.identity import location_free
from roboxim_runs.events import Notice, OnEvent, ignore
from roboxim_runs.executors import Cancellation, Executor, KeptProcesses
from roboxim_runs.executors.protocol import as_json
from roboxim_runs.experiments.calibration.learned import rates_of_run
from roboxim_runs.experiments.calibration.rates import store_rates, stored_rates
from roboxim_runs.experiments.card import DRAWING, STAGES_FILE, collect_card, collect_proofs
from roboxim_runs.experiments.checks import (
    changed_after_results,
    require_definitions,
    require_policies,
    require_renderer,
    state_of,
)
from roboxim_runs.experiments.definitions import definitions
from roboxim_runs.experiments.files import checked_design, known_as, load_experiment
from roboxim_runs.experiments.products import has_product, lost_products
from roboxim_runs.experiments.provenance import (
    ATTEST_FILE,
    ORIGIN,
    Attestations,
    Origin,
    attestation_template,
    folder_sha256,
)
from roboxim_runs.experiments.report import STATE_FILE, ExperimentFolder, write_card, write_experiment_report
from roboxim_runs.experiments.run_config import RENDERER, ExperimentRunConfig
from roboxim_runs.experiments.scenes.again import scenes_of, take_trainings
from roboxim_runs.experiments.scenes.fresh import COMMITTED, in_scenes_of, store_seed
from roboxim_runs.experiments.scenes.leakage import scene_leakage
from roboxim_runs.experiments.stages import Stages
from roboxim_runs.experiments.trained.policies import (
    is_named,
    policy_of,
    require_found,
    require_known,
    require_trainers_policy,
    server_of_policy,
)
from roboxim_runs.experiments.trained.servers import require_reachable
from roboxim_runs.experiments.trained.starts import require_start, start_digests
from roboxim_runs.storage.folder import checked_path, locked, make_folder
from roboxim_runs.storage.occupied import require_own
from roboxim_runs.training.commands import Trained, train, train_on

CHANGED = "changed_after_results"
"""Key of ``experiment.json``: sentences for the card."""
SHARD = "shard"
"""Key of ``experiment.json``: the part of each stage's episodes that the folder has, ``I/N``; empty: all."""


@dataclass(frozen=True, kw_only=True)
class ExperimentResult:
    """State of an experiment after a call."""

    out: Path
    """The run's folder."""
    finished: tuple[str, ...]
    """Names of the finished stages."""
    missing: tuple[str, ...]
    """Names of the stages that are not finished."""
    waiting: tuple[str, ...] = ()
    """Evaluations among them whose policy is trained elsewhere and not named yet."""
    card: Card | None
    """Results; none while evaluations are missing."""


def run_experiment(
    config: ExperimentRunConfig,
    *,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    executor: Executor | None = None,
    training_executor: Executor | None = None,
    scenes: SceneSeed | None = None,
) -> ExperimentResult:
    """Run the stages of an experiment that its folder lacks.

    Args:
        config: Configuration of the run.
        on_event: Receives the events of all stages.
        cancellation: Ends the run when it is set.
        executor: Runs episodes and reads bags; none: processes of this machine.
        training_executor: Runs the trainings, with as many workers as trainings at a time; its machines share the
            experiment's folder. None: processes of this machine.
        scenes: Seed of the fresh scenes that the experiments of a benchmark share; none: the folder's, or one that
            ``fresh`` draws.

    Raises:
        CancelledError: When the run was cancelled; the same call continues.
        ConfigError: When the experiment is invalid, a policy is unknown, inputs of a finished stage have changed, or
            the folder holds something else.
        RoboximError: When a stage fails, or a proof does.
    """
    experiment = load_experiment(config.experiment, config.scale, changes=config.changes, trainer=config.trainer)
    require_own(checked_path(config.out), "experiment run", after=("experiment attest",))
    scenes = scenes_of(
        checked_path(config.out), trained=checked_path(config.trained) if config.trained else None, fresh=config.fresh,
        scene_seed=config.scene_seed, shared=scenes,
    )  # fmt: skip
    experiment = in_scenes_of(experiment, scenes.seed if scenes else config.scene_seed)
    design = checked_design(config.experiment, experiment, config.trainer)
    if experiment.curve is not None and not design.trainer.until:
        on_event(Notice(text="the trainer does not end at checkpoints (until), so there is no learning curve"))
    for sentence in scene_leakage(design):
        on_event(Notice(text=sentence))
    with KeptProcesses() as kept:
        run = _Run(config, design, on_event, cancellation, executor, kept, scenes)
        make_folder(run.out)
        with locked(run.out):  # two commands would write one checkpoint in turns
            return _run_stages(run, training_executor)


def _run_stages(run: _Run, training_executor: Executor | None) -> ExperimentResult:
    """Run the stages that a folder lacks; write the card when all are there."""
    if run.config.fresh and run.config.trained:
        take_trainings(checked_path(run.config.trained), run.out)
    run.open()
    if run.scenes is not None:
        store_seed(run.scenes, run.out)
    stages = [stage for stage in run.stages if run.wanted(stage) and run.ready(stage)]
    for kind, ones in itertools.groupby(stages, key=lambda stage: stage.kind):  # all trainings follow each other
        if kind == "train":
            run.train(tuple(ones), training_executor)
        else:
            for stage in ones:
                run.finish(stage)
    done = run.done
    missing = tuple(stage.name for stage in run.stages if stage.name not in done)
    card = None
    if not run.config.shard and not any(name.startswith(("evaluate/", "prove/")) for name in missing):
        name = Path(run.config.experiment).stem
        collect_proofs(run.stages, run.out, state_of(run.out).get(CHANGED, []))
        folder = ExperimentFolder.of(run.out)
        card = collect_card(
            name, run.config.scale, run.design, run.out, trainer=run.config.trainer, renderer=folder.renderer
        )  # fmt: skip
        write_card(card, run.out)
        write_experiment_report(folder, card)
        if training_executor is None:
            run.learn_rates(known_as(run.config.experiment))
    return ExperimentResult(
        out=run.out, finished=tuple(s.name for s in run.stages if s.name in done), missing=missing,
        waiting=tuple(name for name in missing if run.waits_for_policy(name)), card=card,
    )  # fmt: skip


class _Run:
    """An experiment's folder, and its stages."""

    def __init__(
        self,
        config: ExperimentRunConfig,
        design: Design,
        on_event: OnEvent,
        cancellation: Cancellation | None,
        executor: Executor | None,
        kept: KeptProcesses,
        scenes: SceneSeed | None,
    ) -> None:
        self.config, self.design, self.scenes = config, design, scenes
        self._committed = {COMMITTED: scenes.commitment} if scenes else {}
        self.out = checked_path(config.out)
        self.log = ResultsLog(self.out / STAGES_FILE)
        self.trained = checked_path(config.trained) if config.trained and config.shard else self.out
        trained = bool(design.trainer.command)
        self.stages = tuple(stage for stage in stages_of(design) if stage.kind != "train" or trained)
        self._ran = False
        self._lost: set[str] = set()
        self._by_name = {stage.name: stage for stage in self.stages}
        require_known(design, config.policies)
        evaluations = [s for s in self.stages if s.kind == "evaluate" and "evaluate" in config.only]
        self.policies = {s.name: policy_of(design, s, config.policies, self.trained) for s in evaluations}
        servers = {s.name: server_of_policy(design, s, config.policies, self.trained) for s in evaluations}
        require_reachable(servers.values(), executor)
        require_found(config.policies.values() if evaluations else ())
        require_trainers_policy(design.trainer)
        self._starts = {f"train/{name}": weights for name, weights in start_digests(design).items()}
        self._runner = Stages(
            design=design, out=self.out, policies=self.policies, servers=servers, workers=config.workers,
            renderer=config.renderer, on_event=on_event, cancellation=cancellation, executor=executor, kept=kept,
            shard=config.shard,
        )  # fmt: skip

    # -------------------------------------------------------------- state

    def open(self) -> None:
        """Store the experiment, or check that the folder holds the same one."""
        stored = state_of(self.out)
        before = stored.get("stages", {})
        done = {entry.data.get("stage", ""): entry.key for entry in self.log.read()}
        for stage in self.stages:
            if stage.name in done and done[stage.name] != self._key(stage) and stage.part in self.config.only:
                changed = differences(
                    {**before.get(stage.name, {}), SHARD: stored.get(SHARD, "")},
                    {**as_json(self._inputs(stage)), SHARD: self.config.shard},
                )
                raise ConfigError(
                    f"{self.out}: stage '{stage.name}' was finished with other inputs "
                    f"({changed or 'of a stage that it needs'}); choose another output folder (--out)"
                )
        folders = tuple(dict.fromkeys((self.out, self.trained)))
        draws = not set(DRAWING).isdisjoint(self.config.only)
        if draws:
            require_renderer(folders, self._by_name, self.config.renderer, otherwise=RENDERER)
        defined = definitions(self.design)
        require_definitions(folders, self.stages, defined)
        finished = {name: policy for name, policy in self.policies.items() if policy and name in done}
        given, trained = self.config.policies, self.trained
        named = {n: p for n, p in finished.items() if is_named(self.design, self._by_name[n], given, trained)}
        require_policies(self.out, named)
        inputs = {
            stage.name: as_json(self._inputs(stage)) for stage in self.stages
            if stage.name not in before or not self._lacks_what_it_ran_with(stage)
        }  # fmt: skip
        content = {
            "experiment": self.config.experiment, "scale": self.config.scale, "trainer": self.config.trainer,
            "benchmark": self.config.benchmark, SHARD: self.config.shard,
            "renderer": self.config.renderer if draws else stored.get("renderer", self.config.renderer),
            "config": to_plain(self.design.config), "definitions": defined, "stages": {**before, **inputs},
            CHANGED: [*stored.get(CHANGED, []), *changed_after_results(self.out, stored, self.design.config)],
        }  # fmt: skip
        pending = [s for s in self.stages if s.name not in self.done and self.wanted(s) and self.ready(s)]
        for stage in pending:
            if stage.kind == "train":
                require_start(self.design, stage.name.removeprefix("train/"))
        write_json(self.out / STATE_FILE, as_json(content))
        self._attest()
        if not self.config.shard:  # which has a part of the products alone
            self._lost = lost_products(self._by_name, self.done, pending, self.out)

    def _attest(self) -> None:
        """Check what is attested about the trainings; write a file to fill in if they run elsewhere."""
        names = tuple(f"{t.condition}.{t.replicate}" for t in self.design.trainings)
        Attestations.of(self.out, self.design).require_known(names)
        path = self.out / ATTEST_FILE
        if names and not self.design.trainer.command and not path.exists():
            write_whole(path, attestation_template(names))

    @property
    def done(self) -> set[str]:
        """Names of the finished stages whose inputs are unchanged and whose products are there if they are read."""
        keys = {entry.key for entry in self.log.read()}
        return {stage.name for stage in self.stages if self._key(stage) in keys} - self._lost

    def _inputs(self, stage: Stage) -> dict[str, Any]:
        policy = self.policies.get(stage.name)
        return stage.inputs | ({"policy": to_plain(policy)} if policy else {}) | self._start(stage)

    def _key(self, stage: Stage) -> str:
        policy = self.policies.get(stage.name)
        if self._lacks_what_it_ran_with(stage):
            return next((e.key for e in self.log.read() if e.data.get("stage") == stage.name), "")
        part = {"shard": self.config.shard} if self.config.shard else {}
        named = policy and as_json(to_plain(replace(policy, **location_free(policy.spec, policy.options))))
        return digest({"sha": stage.sha, "name": stage.name, "policy": named, **self._start(stage), **part})

    def _lacks_what_it_ran_with(self, stage: Stage) -> bool:
        """Whether the policy that a stage evaluates is not named now, or the checkpoint that it begins with is gone."""
        unnamed = stage.kind == "evaluate" and self.policies.get(stage.name) is None
        return unnamed or self._starts.get(stage.name) == ""

    def _start(self, stage: Stage) -> dict[str, str]:
        """Return the weights that a training begins with; empty: they are drawn."""
        return {"start": self._starts[stage.name]} if stage.name in self._starts else {}

    def learn_rates(self, name: str) -> None:
        """Store the rates that a whole run on this machine showed, for later plans."""
        before = stored_rates(self.design.config.image_size, name)
        if before is None or not self._ran or self._runner.executor is not None:
            return
        found = rates_of_run(name, self.config.scale, self.out, self.design, self.config.workers, before)
        if found is not None:
            store_rates(found)

    # -------------------------------------------------------------- stages

    def waits_for_policy(self, name: str) -> bool:
        """Return whether a stage is an evaluation whose policy is not named yet."""
        return name in self.policies and self.policies[name] is None

    def wanted(self, stage: Stage) -> bool:
        """Return whether this call is to run a stage. The proofs of a shard's episodes are those of the whole."""
        return stage.part in self.config.only and not (self.config.shard and stage.kind == "prove")

    def ready(self, stage: Stage) -> bool:
        """Return whether a stage can run; it cannot while a policy that it needs is trained elsewhere."""
        return not any(map(self.waits_for_policy, (stage.name, *stage.needs)))

    def _done_in_whole(self) -> set[str]:
        """Names of the stages that are finished in the folder of the whole experiment; not those of evaluations."""
        keys = {entry.key for entry in ResultsLog(self.trained / STAGES_FILE).read()}
        whole = {
            stage.name: digest({"sha": stage.sha, "name": stage.name, "policy": None, **self._start(stage)})
            for stage in self.stages
        }  # fmt: skip
        return {name for name, key in whole.items() if key in keys}

    def train(self, stages: Sequence[Stage], executor: Executor | None) -> None:
        """Run the trainings that are not finished, several at a time."""
        done = self.done
        missing = [stage for stage in stages if stage.name not in done]
        for stage in missing:
            self._require_needs(stage, done)

        committed = self._committed

        def finished(one: Trained) -> None:
            origin = {ORIGIN: dict(one.origin)} if one.origin else {}
            self._log(
                one.stage, one.wall_s, continued=one.continued, at_once=round(one.at_once, 2), **origin, **committed
            )

        run = partial(train, at_once=self.config.trainings) if executor is None else partial(train_on, executor)
        run(
            missing, self.out, on_event=self._runner.on_event, on_trained=finished,
            cancellation=self._runner.cancellation,
        )  # fmt: skip

    def finish(self, stage: Stage) -> None:
        """Run a stage unless it is finished."""
        done = self.done
        if stage.name in done:
            return
        self._require_needs(stage, done)
        self._clear(stage)
        started, continued = time.monotonic(), (self.out / stage.name).exists()
        made = self._runner.run(stage, self._by_name)
        self._log(stage, time.monotonic() - started, continued=continued, **made)

    def _clear(self, stage: Stage) -> None:
        """Set apart the remains of a stage that must run again because its bags or its dataset are gone."""
        folder = self.out / stage.name
        again = stage.name in self._lost or (
            not self.config.shard and folder.exists() and not has_product(stage, self.out)
        )
        if again:
            apart = folder.with_name(f".{folder.name}-without-bags")
            shutil.rmtree(apart, ignore_errors=True)
            if folder.exists():
                folder.rename(apart)
            what = "dataset is" if stage.kind == "export" else "bags are"
            self._runner.on_event(Notice(text=f"{stage.name} runs again: its {what} gone, as after 'unpack'"))

    def _require_needs(self, stage: Stage, done: Collection[str]) -> None:
        """Check that the stages that a stage needs are finished.

        Raises:
            ConfigError: Naming those that are not.
        """
        absent = [need for need in stage.needs if need not in done and need in self._by_name]
        if self.config.shard:
            absent = [need for need in absent if need not in self._done_in_whole()]
        if absent and self.config.shard:
            raise ConfigError(
                f"stage '{stage.name}' needs {', '.join(absent)}, not finished in {self.trained}; merge the shards of "
                "the demonstrations, run --only generate,export,train there, and name that folder with --trained"
            )
        if absent:
            raise ConfigError(f"stage '{stage.name}' needs {', '.join(absent)}; run these kinds of stages too (--only)")

    def _log(self, stage: Stage, wall_s: float, *, continued: bool, **facts: Any) -> None:
        """Append a finished stage to the log of stages."""
        self._ran = True
        origin = Origin.here(self.config.renderer if stage.kind in DRAWING else "")
        entry = {"stage": stage.name, "wall_s": round(wall_s, 1), ORIGIN: to_plain(origin), **facts}
        if continued:
            entry["continued"] = True  # wall_s has not all of it
        if stage.kind in ("export", "train"):
            entry["sha256"] = folder_sha256(self.out / stage.name)
        self.log.append(self._key(stage), entry)
        self._lost.discard(stage.name)
