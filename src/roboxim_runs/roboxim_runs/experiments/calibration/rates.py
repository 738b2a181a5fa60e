"""This machine's measured rates: a file in the user's cache folder for each image size and experiment.

Lists and plans of experiments read them, so this module does not import the measuring code.
"""

from __future__ import annotations

from pathlib import Path

from roboxim_core.config import from_json, to_json
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.documents import read_text
from roboxim_core.user_folders import cache_dir
from roboxim_core.whole_files import write_whole
from roboxim_eval.experiments import Rates


def rates_file(size: str, experiment: str) -> Path:
    """Return the file of this machine's rates, in the user's cache folder.

    Args:
        size: Image size, e.g. ``128x128``.
        experiment: Name of the experiment whose episodes were measured.
    """
    return _folder(size) / f"{experiment}.json"


def stored_rates(size: str, experiment: str) -> Rates | None:
    """Return this machine's last rates of an experiment, else those of the experiment that was measured last.

    Rates of several trainings at a time do not depend on the experiment: those of others are added.

    Args:
        size: Image size, e.g. ``128x128``.
        experiment: Name of the experiment.

    Returns:
        The rates, with the name of the experiment that they are of; none: never measured, or by another version.
    """
    found = sorted(filter(None, map(_read, _folder(size).glob("*.json"))), key=lambda rates: rates.measured)
    if not found:
        return None
    chosen = next((rates for rates in found if rates.experiment == experiment), found[-1])
    parallel = sorted((rate for rates in found for rate in rates.side_by_side), key=lambda rate: rate.measured)
    return chosen.learned(*parallel)


def _folder(size: str) -> Path:
    return cache_dir() / f"rates-{size}"


def _read(path: Path) -> Rates | None:
    try:
        return from_json(read_text(path), Rates, source=str(path))
    except ConfigError:
        return None


def store_rates(rates: Rates) -> Path:
    """Store rates as this machine's; return the file."""
    path = rates_file(rates.size, rates.experiment)
    write_whole(path, to_json(rates) + "\n")
    return path
