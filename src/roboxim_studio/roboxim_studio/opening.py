"""Finds what ``roboxim studio WHAT`` opens: a bag, a run, a dataset, or a task."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from roboxim_core.config import named_config
from roboxim_core.errors import ConfigError


class Kind(StrEnum):
    """A kind of thing that the studio shows."""

    NOTHING = "nothing"
    """Nothing was named."""
    BAG = "bag"
    """A recorded episode."""
    RUN = "run"
    """A folder of bags."""
    DATASET = "dataset"
    """A dataset of RLDS, LeRobot or HDF5."""
    TASK = "task"
    """A task of ``config/tasks`` or a YAML file."""


@dataclass(frozen=True, kw_only=True)
class Opened:
    """What was named."""

    kind: Kind
    """Its kind."""
    path: Path | None = None
    """Where it is; none: nothing was named."""
    bags: tuple[Path, ...] = ()
    """The bags of a run, those set apart included."""


def recognise(what: str) -> Opened:
    """Return what a name or a path of the command line means.

    Args:
        what: A bag, a run's folder, a report in one, a dataset, a task's name or file; empty: nothing.

    Raises:
        ConfigError: When there is no such thing.
    """
    if not what:
        return Opened(kind=Kind.NOTHING)
    path = Path(what)
    if path.is_file() and path.suffix == ".html":
        path = path.parent
    if path.is_dir():
        return _folder(path)
    if path.is_file() and path.suffix == ".mcap":
        return Opened(kind=Kind.BAG, path=path)
    if path.is_file() and path.suffix not in (".yaml", ".yml"):
        return _dataset(path)
    return Opened(kind=Kind.TASK, path=named_config("tasks", what))


def bags_of(folder: Path) -> tuple[Path, ...]:
    """Return the bags in a run's folder, kept ones first, then those set apart; sorted by name.

    An evaluation's folder has a folder for each policy, whose bags follow one another.
    """
    from roboxim_recorder.bag_writer import PLACES  # a page of one bag is served before this is needed

    runs = [folder, *sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))]
    found = [run / place for run in runs for place in PLACES.values() if (run / place).is_dir()]
    places = found or [folder]
    return tuple(
        bag for place in dict.fromkeys(places) for bag in sorted({file.parent for file in place.glob("[!.]*/*.mcap")})
    )


def _folder(path: Path) -> Opened:
    if list(path.glob("*.mcap")):
        return Opened(kind=Kind.BAG, path=path)
    reports = [path.parent] if list(path.glob("*.html")) else []  # a report may be a folder of its run
    for folder in (path, *reports):
        bags = bags_of(folder)
        if bags or _is_run(folder):
            return Opened(kind=Kind.RUN, path=folder, bags=bags)
    return _dataset(path)


def _is_run(folder: Path) -> bool:
    """Return whether a folder is a run's, or an evaluation's; it may not have finished an episode yet."""
    from roboxim_core.plain_data.results_log import RUN_FILE
    from roboxim_runs.storage.folder import folders_with

    return any(folders_with(RUN_FILE, folder, 1))


def _dataset(path: Path) -> Opened:
    from roboxim_datasets.formats import FORMATS

    if not any(made().find(path) for made in map(FORMATS.__getitem__, FORMATS)):
        raise ConfigError(
            f"{path} is neither a bag, a folder with bags (a run), nor a dataset of RLDS, LeRobot or HDF5; "
            "name one of these, or a task of config/tasks"
        )
    return Opened(kind=Kind.DATASET, path=path)
