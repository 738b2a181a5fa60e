"""This machine's measured rates, in the user's cache folder, a file for each image size.

Lists and plans of experiments read them; this module therefore imports nothing that measures.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from roboxim_core.config import from_json, to_json
from roboxim_core.documents import read_text
from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import Rates


def rates_file(size: str) -> Path:
    """Return the file of this machine's rates for an image size, e.g. ``128x128``, in the user's cache folder."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "roboxim" / f"rates-{size}.json"


def stored_rates(size: str) -> Rates | None:
    """Return this machine's last rates; none: never measured, or measured by another version.

    Args:
        size: Image size, e.g. ``128x128``.

    Raises:
        ConfigError: When the file cannot be read.
    """
    path = rates_file(size)
    if not path.is_file():
        return None
    try:
        return from_json(read_text(path), Rates, source=str(path))
    except ConfigError:
        return None


def store_rates(rates: Rates) -> Path:
    """Store rates as this machine's; return the file."""
    path = rates_file(rates.size)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".draft")
    draft.write_text(to_json(rates) + "\n")
    shutil.move(draft, path)
    return path
