"""Collects the card of an experiment from its folder: counts from results, hashes of what they came from.

What follows from these parts, and the check of a stored card, is in `roboxim_eval.experiments`. Proofs of delivery and
substitutions are stored by the stages that find them, as ``OUT/proofs.json`` (check to the numbers of episodes that
passed and that were checked), ``OUT/excluded.json`` (evaluation stage to indices of episodes that are none of their
cells) and ``OUT/judged_again.json`` (a list of ``{cell, satisfied}``).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from roboxim_core.config import from_plain, to_plain
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.documents import read_json, read_json_object
from roboxim_core.plain_data.results_log import ResultsLog
from roboxim_core.seeds import CELL, CELL_NUMBER
from roboxim_core.whole_files import write_json, write_whole
from roboxim_eval.experiments import Design, Stage, chosen, stages_of
from roboxim_eval.experiments.card import (
    Card,
    CardDataset,
    CardEnvironment,
    CardEvaluation,
    CardExperiment,
    CardTraining,
    JudgedAgain,
    parse_card,
    sha256_of,
)
from roboxim_eval.experiments.card_checks import concluded
from roboxim_eval.statistics.beside import beside_success
from roboxim_runs.executors.protocol import as_json
from roboxim_runs.experiments.delivery.demands import task_mix_of
from roboxim_runs.experiments.files import trainer_name
from roboxim_runs.experiments.provenance import Attestations, Origin, device, origin_statements
from roboxim_runs.experiments.scenes.fresh import card_part
from roboxim_runs.experiments.trained.starts import with_start
from roboxim_runs.storage.folder import RunFolder
from roboxim_tasks.config import TaskMix

CARD_FILE = "card.json"
STAGES_FILE = "stages.jsonl"
PROOFS_FILE = "proofs.json"
JUDGED_FILE = "judged_again.json"
EXCLUDED_FILE = "excluded.json"
STATEMENTS_FILE = "statements.json"
PROOF_FILE = "proof.json"
"""File of a proof's folder with its checks, faults and statements."""
DRAWING = ("generate", "evaluate")
"""Kinds of stages that draw images."""
TIMES = ("wall_s", "inference_s")
"""Fields of a result that are not part of its hash."""

Scene = tuple[str, int]
"""Cell and number in the cell, which name a scene within a replicate."""


def evaluation_folder(out: Path, stage: str) -> Path:
    """Return the run folder of an evaluation stage, e.g. ``OUT/evaluate/blind.0/blind``."""
    condition = stage.removeprefix("evaluate/").rpartition(".")[0]
    return out / stage / condition


def results_of(design: Design, out: Path) -> dict[str, dict[Scene, EpisodeResult]]:
    """Return the results of an experiment's evaluations: stage name to scene to result.

    Episodes that are none of their cells by the proofs of delivery (`EXCLUDED_FILE`) are left out.

    Args:
        design: The experiment.
        out: Its folder.

    Raises:
        ConfigError: When an evaluation is not finished, or its results are damaged.
    """
    found = {}
    excluded = _stored(out / EXCLUDED_FILE, dict[str, tuple[int, ...]], {})
    for stage in stages_of(design):
        if stage.kind == "evaluate":
            folder = evaluation_folder(out, stage.name)
            by_scene = _by_scene(task_mix_of(json.dumps(stage.inputs["mix"])), RunFolder(folder).results())
            if len(by_scene) != stage.inputs["episodes"]:
                raise ConfigError(
                    f"{folder} has {len(by_scene)} of {stage.inputs['episodes']} rollouts; run the experiment again"
                )
            none = excluded.get(stage.name, ())
            found[stage.name] = {scene: result for scene, result in by_scene.items() if result.index not in none}
    return found


def _stored(file: Path, kind: Any, otherwise: Any) -> Any:
    """Return what a stage has stored in a file; the other value when there is no file."""
    return from_plain(read_json(file), kind, source=str(file)) if file.exists() else otherwise


def _by_scene(mix: TaskMix, results: Sequence[EpisodeResult]) -> dict[Scene, EpisodeResult]:
    found = {}
    for result in results:
        drawn = mix.drawn(result.index)
        found[drawn[CELL], int(drawn[CELL_NUMBER])] = result
    return found


def collect_card(
    name: str, scale: str, design: Design, out: Path, *, trainer: str = "", renderer: str = ""
) -> Card:  # fmt: skip
    """Return the card of an experiment whose evaluations are finished.

    Args:
        name: Name of the experiment.
        scale: Its scale.
        design: The experiment.
        out: Its folder.
        trainer: Trainer that was chosen, as the run was given it; empty: the file's first one.
        renderer: Renderer of the stages whose line in ``stages.jsonl`` does not state theirs.

    Raises:
        ConfigError: When an evaluation is not finished, or a file of the folder is damaged.
    """
    results = results_of(design, out)
    products = {entry.data.get("stage", ""): entry.data for entry in ResultsLog(out / STAGES_FILE).read()}
    datasets = _datasets(design, products)
    config = design.config
    finished = [stage for stage in stages_of(design) if stage.name in products]
    origins = {stage.name: Origin.of(products[stage.name]) for stage in finished}
    drawn = {s.name: _renderer(origins[s.name], renderer) for s in finished if s.kind in DRAWING}
    origin = _origin_of_evaluations([origins[s.name] for s in finished if s.kind == "evaluate"], renderer, out)
    card = Card(
        experiment=CardExperiment(
            name=name, scale=scale, thesis=config.thesis, sha256=sha256_of(as_json(to_plain(config))),
            trainer=trainer_name(config, trainer), deviations=config.deviations, config=config,
        ),
        code=origin.code,
        environment=CardEnvironment(
            packages_sha256=origin.packages_sha256, renderer=_renderer(origin, renderer),
            device=origin.device or device(),
        ),
        datasets=datasets,
        trainings=tuple(_trainings(design, products, datasets, out)),
        evaluations=tuple(_evaluations(design, results)),
        pairs={
            str(number): tuple(_pairs(design, number, results))
            for number, compare in enumerate(config.compare)
            if not compare.against
        },
        judged_again=_stored(out / JUDGED_FILE, tuple[JudgedAgain, ...], None),
        proofs=_stored(out / PROOFS_FILE, dict[str, tuple[int, int]], {}),
        statements=(
            *_stored(out / STATEMENTS_FILE, tuple[str, ...], ()), *origin_statements(origins, drawn)
        ),
        times={  # the log has them in the order in which they ended
            stage.name: float(products[stage.name].get("wall_s", 0.0)) for stage in finished
        },
    )  # fmt: skip
    return concluded(replace(card, fresh=card_part(out, products, card)), design)


def collect_proofs(stages: Sequence[Stage], out: Path, changed: Sequence[str]) -> None:
    """Write what the proofs of all stages found, for the card.

    Args:
        stages: All stages; those that prove are finished.
        out: The experiment's folder.
        changed: Statements besides those of the proofs.
    """
    checks: dict[str, list[int]] = {}
    excluded: dict[str, list[int]] = {}
    again: list[Any] | None = None
    statements = list(changed)
    for stage in stages:
        if stage.kind != "prove":
            continue
        proof = read_json_object(out / stage.name / PROOF_FILE)
        statements += [text for text in proof["statements"] if text not in statements]
        prefix = "training " if stage.part == "export" else "curve " if stage.of_curve else ""
        for name, (passed, number) in proof["checks"].items():
            before = checks.get(prefix + name, [0, 0])
            checks[prefix + name] = [before[0] + passed, before[1] + number]
        replicate = stage.name.rpartition(".")[2]
        for name, indices in proof["excluded"].items():
            condition, at, checkpoint = name.partition("@")
            excluded[f"evaluate/{condition}.{replicate}{at}{checkpoint}"] = indices
        if proof["judged_again"] is not None:
            again = [*(again or []), *proof["judged_again"]]
    write_json(out / PROOFS_FILE, checks)
    write_json(out / STATEMENTS_FILE, statements)
    write_whole(out / EXCLUDED_FILE, json.dumps(excluded) + "\n")
    if again is not None:
        write_whole(out / JUDGED_FILE, json.dumps(again) + "\n")


def _renderer(origin: Origin | None, otherwise: str) -> str:
    return (origin.renderer if origin else "") or otherwise


def _origin_of_evaluations(evaluations: Sequence[Origin | None], renderer: str, out: Path) -> Origin:
    """Return what the last evaluation that states it ran with.

    A folder of an older version states it in no line: it keeps what its card says, and without a card it is what this
    process has.
    """
    if known := [origin for origin in evaluations if origin is not None]:
        return known[-1]
    path = out / CARD_FILE
    try:
        card = parse_card(read_json(path), source=str(path)) if path.exists() else None
    except ConfigError:  # of another schema, or damaged: this call writes it again
        card = None
    if card is None:
        return Origin.here(renderer)
    environment = card.environment
    return Origin(
        code=card.code, packages_sha256=environment.packages_sha256, renderer=renderer, device=environment.device
    )


def _evaluations(design: Design, results: Mapping[str, Mapping[Scene, EpisodeResult]]) -> Iterator[CardEvaluation]:
    stages = {stage.name: stage for stage in stages_of(design)}
    for evaluation in design.evaluations:
        name = stage_name(evaluation.condition, evaluation.replicate, evaluation.checkpoint)
        rows = results[name]
        by_cell = {cell: [r for (c, _), r in rows.items() if c == cell] for cell in evaluation.counts}
        yield CardEvaluation(
            condition=evaluation.condition, replicate=evaluation.replicate, checkpoint=evaluation.checkpoint,
            seed=stages[name].inputs["seed"], results_sha256=results_sha256(rows),
            by_cell={
                cell: (
                    sum(r.outcome == "success" for r in of_cell), len(of_cell),
                    sum(r.outcome == "error" for r in of_cell),
                )
                for cell, of_cell in sorted(by_cell.items())
            },
            beside=beside_success([rows[scene] for scene in sorted(rows)]),
        )  # fmt: skip


def stage_name(condition: str, replicate: int, checkpoint: int = 0) -> str:
    """Return the name of an evaluation's stage."""
    return f"evaluate/{condition}.{replicate}" + (f"@{checkpoint}" if checkpoint else "")


def results_sha256(rows: Mapping[Scene, EpisodeResult]) -> str:
    """Return the hash of an evaluation's results without their wall times."""
    plain = [to_plain(rows[scene]) for scene in sorted(rows)]
    return sha256_of(as_json([{key: v for key, v in row.items() if key not in TIMES} for row in plain]))


def _pairs(
    design: Design, number: int, results: Mapping[str, Mapping[Scene, EpisodeResult]]
) -> Iterator[tuple[int, int, int, int]]:
    compare = design.config.compare[number]
    cells = {cell.key for cell in chosen(design.cells, compare.where)}
    for replicate in range(design.config.replicates.count):
        first, second = (results[stage_name(name, replicate)] for name in (compare.first, compare.second))
        shared = [scene for scene in first if scene in second and scene[0] in cells]
        won = [(first[s].outcome == "success", second[s].outcome == "success") for s in shared]
        yield (won.count((True, True)), won.count((True, False)), won.count((False, True)), won.count((False, False)))


def _datasets(design: Design, products: Mapping[str, Mapping[str, Any]]) -> dict[str, CardDataset]:
    found = {}
    for stage in stages_of(design):
        if stage.kind == "export" and stage.name in products:
            product = products[stage.name]
            found[stage.name.removeprefix("export/")] = CardDataset(
                sha256=str(product.get("sha256", "")), by_cell=dict(stage.inputs["counts"]),
                fault=stage.inputs["fault"], faulty=int(product.get("faulty", 0)),
            )  # fmt: skip
    return found


def _trainings(
    design: Design, products: Mapping[str, Mapping[str, Any]], datasets: Mapping[str, CardDataset], out: Path
) -> Iterator[CardTraining]:
    attestations, here = Attestations.of(out, design), bool(design.trainer.command)
    stages: dict[str, Stage] = {stage.name: stage for stage in stages_of(design)}
    for training in design.trainings:
        name = f"train/{training.condition}.{training.replicate}"
        dataset = stages[name].needs[0].removeprefix("export/")
        attest = attestations.training(
            f"{training.condition}.{training.replicate}", steps=training.steps,
            dataset_sha256=datasets[dataset].sha256 if dataset in datasets else "", here=here,
        )  # fmt: skip
        attest = with_start(attest, design, out / name)
        yield CardTraining(
            condition=training.condition, replicate=training.replicate, dataset=dataset,
            recipe_sha256=sha256_of(as_json(attest.recipe)), seed=training.seed,
            steps=training.steps if here else 0,
            checkpoint_sha256=str(products.get(name, {}).get("sha256", "")), attest=attest,
        )  # fmt: skip
