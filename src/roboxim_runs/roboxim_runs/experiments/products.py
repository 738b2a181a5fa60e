"""Finds which products of an experiment's finished stages still exist.

`roboxim experiment pack` leaves bags and datasets out. An unfinished run needs them again: the next training reads an
export, and the next proof reads bags. Their stages then run again, which gives the same demonstrations.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path

from roboxim_eval.experiments import Stage
from roboxim_runs.experiments.card import evaluation_folder
from roboxim_runs.storage.folder import RunFolder


def lost_products(stages: Mapping[str, Stage], done: Collection[str], pending: Iterable[Stage], out: Path) -> set[str]:
    """Return the finished stages whose products are missing although a later stage needs them.

    Args:
        stages: All stages by name.
        done: Names of those that the log of stages names.
        pending: Stages that are to run.
        out: The experiment's folder.
    """
    lost: set[str] = set()
    queue = list(pending)
    while queue:
        for name in _read_by(queue.pop(), stages):
            if name in done and name not in lost and not has_product(stages[name], out):
                lost.add(name)
                queue.append(stages[name])
    return lost


def _read_by(stage: Stage, stages: Mapping[str, Stage]) -> Iterator[str]:
    """Yield the stages whose products a stage reads: those that it needs; for a proof, those that they need too."""
    for need in stage.needs:
        if need in stages:
            yield need
            if stage.kind == "prove":
                yield from _read_by(Stage(name=need, kind="prove", needs=stages[need].needs, inputs={}, sha=""), stages)


def has_product(stage: Stage, out: Path) -> bool:
    """Return whether the product of a finished stage is there.

    A run of which some bags are gone has a product: it is damaged, and refused where it is read.

    Args:
        stage: The stage.
        out: The experiment's folder.
    """
    folder = evaluation_folder(out, stage.name) if stage.kind == "evaluate" else out / stage.name
    if stage.kind not in ("generate", "corrupt", "evaluate"):
        return stage.kind == "prove" or folder.is_dir()
    if not folder.is_dir():
        return False
    recorded = [result for result in RunFolder(folder).results() if result.bag]
    return not recorded or len(RunFolder(folder).without_bag(recorded)) < len(recorded)
