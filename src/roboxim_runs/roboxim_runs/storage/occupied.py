"""Refuses an output folder that holds a dataset, bags or the results of another command, before anything is written.

Each command knows its own folder by a file, and continues in it. What a folder holds is found by names of files at the
folder itself: a folder of datasets or of runs is free.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.documents import read_json_object
from roboxim_core.plain_data.results_log import RUN_FILE
from roboxim_datasets.build import partial_of
from roboxim_recorder.bag_writer import PLACES

OWN_FILES = {
    "train": ("checkpoint.npz", "trained_on.json"),
    "pretrain": ("exposure.json",),
    "sweep": ("sweep.json",),
    "mine": ("rollouts.jsonl",),
    "evaluate": ("evaluation.json",),
    "benchmark": ("benchmark.json",),
    "experiment run": ("experiment.json", "stages.jsonl"),
    "experiment attest": ("scene_seed.json",),
    "generate": (RUN_FILE,),
}
"""Command to the files of which its folder alone has one; those of ``generate`` are any run's, see `command_of`."""
COMMANDS = {"demo": "generate", "eval": "evaluate", "train": "evaluate"}
"""Purpose of a run's episodes, mapped to the command that runs them."""
BAGS = ("*.mcap", "*.db3")
"""Names of the files of bags."""
RLDS_LEVELS = 2
"""Levels from the folder that an RLDS dataset is exported to down to its files: those of its name and its version."""


def require_own(
    folder: Path, command: str, *, own: Iterable[str] | None = None, after: Collection[str] = (), empty: bool = False,
    beside: str = "",
) -> None:  # fmt: skip
    """Refuse an output folder that holds something else.

    Args:
        folder: The output folder; need not exist.
        command: The command that is about to write.
        own: Names in the folder of which its own has one; none: those of `OWN_FILES`.
        after: Other commands whose folder it continues in.
        empty: Whether files that are none of these things are refused, too.
        beside: Format of datasets that may be there; empty: none.

    Raises:
        ConfigError: Naming what the folder is, and what to give instead.
    """
    names = OWN_FILES.get(command, ()) if own is None else own
    if not folder.is_dir() or any((folder / name).exists() for name in names) or not any(folder.glob("[!.]*")):
        return
    if (writer := _writer_of(folder)) and writer in after:
        return
    if writer:
        held = f"is the folder of 'roboxim {writer}', not of 'roboxim {command}'"
    elif found := _bags_in(folder) or _dataset_in(folder, beside):
        held = f"is {found}, not the folder of 'roboxim {command}'"
    elif empty:
        held = f"has files and is not the folder of 'roboxim {command}'"
    else:
        return
    other = folder.with_name(f"{folder.resolve().name}-{command.rpartition(' ')[2]}")
    raise ConfigError(f"{folder} {held}; choose a new or empty output folder (--out or out=), e.g. {other}")


def require_free_for_dataset(folder: Path, place: Path, format: str, command: str) -> None:
    """Refuse to write a dataset into a folder that holds something else than datasets of its format.

    Args:
        folder: The output folder.
        place: Place of the dataset: the folder, or in it. If it exists, or was begun, its writer decides.
        format: Its format.
        command: The command that is about to write.

    Raises:
        ConfigError: As `require_own`.
    """
    own = [str(at.relative_to(folder)) for at in (place, partial_of(place)) if folder in at.parents]
    require_own(folder, command, own=own, beside=format)


def command_of(config: Mapping[str, Any]) -> str:
    """Return the command that wrote a run's configuration."""
    return "rerender" if "rerender" in config else COMMANDS.get(str(config.get("purpose")), "generate")


def _writer_of(folder: Path) -> str:
    """Return the command whose folder this is; empty: none."""
    found = next((one for one, files in OWN_FILES.items() if any((folder / name).is_file() for name in files)), "")
    if found != "generate":
        return found
    try:
        return command_of(read_json_object(folder / RUN_FILE))
    except ConfigError:  # damaged
        return found


def _bags_in(folder: Path) -> str:
    if any(any(folder.glob(name)) for name in BAGS):
        return "a bag"
    below = ("*", *(f"{place}/*" for place in PLACES.values()))
    return "a folder of bags" if any(any(folder.glob(f"{at}/{name}")) for at in below for name in BAGS) else ""


def _dataset_in(folder: Path, besides: str) -> str:
    from roboxim_datasets.formats import FORMATS  # slow to import, and a new folder needs none

    for name in FORMATS:
        if name == besides:
            continue
        for at in FORMATS[name]().find(folder):
            levels = RLDS_LEVELS if name == "rlds" else int(at.is_file())
            if at == folder or folder in at.parents[:levels]:
                return f"a dataset ({name})"
    return ""
