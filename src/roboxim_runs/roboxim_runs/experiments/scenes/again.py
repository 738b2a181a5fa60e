"""A seed that is committed to before the trainings, and trainings of an earlier run that meet fresh scenes."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from roboxim_core.errors import ConfigError, counted
from roboxim_core.plain_data.documents import read_json
from roboxim_core.plain_data.results_log import ResultsLog, line_of
from roboxim_core.whole_files import write_whole
from roboxim_eval.experiments import stages_of
from roboxim_eval.experiments.fresh import SceneSeed
from roboxim_runs.experiments.card import CARD_FILE, STAGES_FILE
from roboxim_runs.experiments.provenance import ATTEST_FILE
from roboxim_runs.experiments.report import ExperimentFolder, folder_card
from roboxim_runs.experiments.scenes.fresh import (
    COMMITTED,
    PUBLIC_FILE,
    drawn_seed,
    require_no_other_seed,
    stored_seed,
)
from roboxim_runs.storage.occupied import require_own


def attested_seed(out: Path) -> SceneSeed:
    """Return the seed of a run's fresh scenes, to commit to it before the trainings.

    Raises:
        ConfigError: When a training of the folder ended without it, or the folder holds something else.
    """
    require_own(out, "experiment attest", after=("experiment run", "benchmark"))
    if early := list(_uncommitted(out, stored_seed(out))):
        raise ConfigError(
            f"{out}: {counted(len(early), 'training')} ended before a seed was committed to ({early[0]}), so that a "
            "commitment shows nothing about them; attest a new folder, or run with --fresh, which the card states"
        )
    return drawn_seed(out)


def _uncommitted(out: Path, seed: SceneSeed | None) -> Iterator[str]:
    """Yield the finished trainings of a folder, or of a benchmark's subfolders, whose lines lack a commitment."""
    for log in (out / STAGES_FILE, *sorted(out.glob(f"*/{STAGES_FILE}"))):
        for entry in ResultsLog(log).read():
            name = entry.data.get("stage", "")
            if name.startswith("train/") and (seed is None or entry.data.get(COMMITTED) != seed.commitment):
                yield name


def scenes_of(
    out: Path, *, trained: Path | None, fresh: bool, scene_seed: int, shared: SceneSeed | None = None
) -> SceneSeed | None:
    """Return the seed of a run's fresh scenes; none: its scenes are the public ones, or of a seed that was given.

    Nothing is written into the folder, as the run may be refused yet; see `store_seed` and `take_trainings`.

    Args:
        out: The run's folder.
        trained: With ``fresh``, the run in the public scenes whose trainings are evaluated again; of a shard, the
            folder of the whole experiment, which has the seed. None: the folder itself has the trainings.
        fresh: Whether to draw a seed unless the folder has one.
        scene_seed: Seed that was given; 0: none.
        shared: Seed of the benchmark that the experiment is a part of; none: the folder's, or one that is drawn.

    Raises:
        ConfigError: When the folder has another seed, or the trainings are not to be had.
    """
    if fresh and trained is not None:
        _folder_to_take(trained, out)
    elif trained is not None:
        shared = stored_seed(trained)
    if shared is not None:
        require_no_other_seed(shared, out)
    seed = shared or stored_seed(out)
    if fresh and seed is None:
        return SceneSeed.drawn()
    if seed is not None and scene_seed not in (0, seed.seed):
        raise ConfigError(f"{out} has fresh scenes of another seed than --scene-seed; choose another folder (--out)")
    return seed


def take_trainings(source: Path, out: Path) -> None:
    """Put the demonstrations, datasets and trainings of a finished run into a new folder, for fresh scenes.

    The caller holds the new folder's lock. Files are linked where the file system allows it. A folder that has them
    already is not changed.

    Args:
        source: Folder of a run in the public scenes.
        out: The new run's folder.

    Raises:
        ConfigError: When the source has no results, fresh scenes of its own, or the folder has another run.
    """
    folder = _folder_to_take(source, out)
    if folder is None:
        return
    lines = {entry.data.get("stage", ""): entry for entry in ResultsLog(source / STAGES_FILE).read()}
    kept = [s.name for s in stages_of(folder.design) if s.part != "evaluate" and s.name in lines]
    for name in kept:
        parts = (source / name, *sorted((source / name).parent.glob(f"{Path(name).name}@*")))
        for one in parts:
            if one.is_dir():
                shutil.copytree(one, out / one.relative_to(source), copy_function=_linked, dirs_exist_ok=True)
    if (source / ATTEST_FILE).exists():
        shutil.copy2(source / ATTEST_FILE, out / ATTEST_FILE)
    write_whole(out / PUBLIC_FILE, (source / CARD_FILE).read_text())
    ended = [entry for entry in lines.values() if entry.data.get("stage") in kept]  # in the order in which they ended
    write_whole(out / STAGES_FILE, "".join(line_of(entry.key, entry.data) for entry in ended))  # last: now it has them


def _folder_to_take(source: Path, out: Path) -> ExperimentFolder | None:
    """Return the folder of a run whose trainings a folder may get; None: it has them.

    Raises:
        ConfigError: When it must not; see `take_trainings`.
    """
    folder = ExperimentFolder.of(source)
    if not (source / CARD_FILE).exists():
        raise ConfigError(f"{source} has no {CARD_FILE}: finish its run first, 'roboxim experiment run' continues it")
    card = folder_card(folder)
    if card.fresh is not None or card.experiment.config.evaluate.seed:
        raise ConfigError(f"{source} has fresh scenes itself; name the run in the public scenes")
    if (out / PUBLIC_FILE).exists():
        if read_json(out / PUBLIC_FILE).get("sha256") != card.sha256:
            raise ConfigError(f"{out} has the trainings of another run; choose another output folder (--out)")
        return None if (out / STAGES_FILE).exists() else folder  # the call before was interrupted
    if (out / STAGES_FILE).exists():
        raise ConfigError(f"{out} has a run of its own; choose another output folder (--out)")
    return folder


def _linked(source: str, target: str) -> None:
    Path(target).unlink(missing_ok=True)  # it is there from an interrupted call
    try:
        os.link(source, target)
    except OSError:  # another file system
        shutil.copy2(source, target)
