"""Episodes that are flagged or left out, as a file of conditions that exports take: ``--where @FILE``.

The source is never touched.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from roboxim_core.errors import ConfigError
from roboxim_core.limits import is_file_name
from roboxim_core.whole_files import write_whole

ENDING = ".where"


def selection_text(left_out: Iterable[str], flagged: Iterable[str], source: str, total: int) -> str:
    """Return the text of a selection file.

    Args:
        left_out: Ids of episodes that exports leave out.
        flagged: Ids of episodes that somebody should look at; only a comment.
        source: Name of the run.
        total: Number of its episodes.
    """
    out, looked = sorted(left_out), sorted(flagged)
    lines = [f"# Made with roboxim studio: {len(out)} of {total} episodes of {source} are left out."]
    lines += [f"# flagged: {name}" for name in looked]
    lines += [f"episode!={name}" for name in out]
    return "\n".join(lines) + "\n"


def save_selection(folder: Path, name: str, text: str) -> Path:
    """Write a selection file; returns it.

    Raises:
        ConfigError: When the name is no plain file name.
        OSError: When it cannot be written.
    """
    stem = name.removesuffix(ENDING)
    if not is_file_name(stem):
        raise ConfigError(f"'{name}' is no file name; expected letters, digits, '-' and '_', e.g. my_selection")
    file = folder / f"{stem}{ENDING}"
    write_whole(file, text)
    return file
