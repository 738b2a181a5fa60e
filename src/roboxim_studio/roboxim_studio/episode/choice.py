"""Episodes that are flagged or left out, as a file of conditions that exports take: ``--where @FILE``.

The source is never touched.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from roboxim_core.errors import ConfigError
from roboxim_core.limits import is_file_name
from roboxim_core.plain_data.documents import read_text
from roboxim_datasets.where import Choice, Edit, with_files
from roboxim_studio.own_files import OwnFiles

ENDING = ".where"
FLAG = "# flagged: "


def selection_text(
    left_out: Iterable[str], flagged: Iterable[str], source: str, total: int, edits: Iterable[Edit] = ()
) -> str:
    """Return the text of a selection file.

    Args:
        left_out: Ids of episodes that exports leave out.
        flagged: Ids of episodes that somebody should look at; only a comment.
        source: Name of the run.
        total: Number of its episodes.
        edits: Trims and new instructions.
    """
    out, looked = sorted(left_out), sorted(flagged)
    lines = [f"# Made with roboxim studio: {len(out)} of {total} episodes of {source} are left out."]
    lines += [f"{FLAG}{name}" for name in looked]
    lines += [f"episode!={name}" for name in out]
    for edit in sorted(edits, key=lambda one: one.episode):
        if edit.steps:
            lines.append(f"trim {edit.episode} {edit.steps[0]}..{edit.steps[1]}")
        if edit.instruction:
            lines.append(f"relabel {edit.episode} {edit.instruction}")
    return "\n".join(lines) + "\n"


@dataclass(frozen=True, kw_only=True)
class Saved:
    """What a selection file says."""

    left_out: frozenset[str] = frozenset()
    """Ids of episodes that are left out."""
    flagged: frozenset[str] = frozenset()
    """Ids of episodes that somebody should look at."""
    edits: Mapping[str, Edit] = field(default_factory=dict)
    """Episode to its edit."""


def read_selection(folder: Path, name: str) -> Saved:
    """Read a selection file that `save_selection` wrote.

    Raises:
        ConfigError: When the name is no plain file name, or there is no such file.
        InvalidRequestError: When a line is no condition.
    """
    file = selection_file(folder, name)
    choice = Choice.parse(with_files([f"@{file}"]))
    out = {v for _, one in choice.conditions if (one.key, one.sign) == ("episode", "!=") for v in one.values}
    flags = [line.removeprefix(FLAG) for line in read_text(file).splitlines() if line.startswith(FLAG)]
    return Saved(left_out=frozenset(out), flagged=frozenset(flags), edits=choice.edits)


def save_selection(folder: Path, name: str, text: str, own: OwnFiles) -> Path:
    """Write a selection file; returns it.

    Raises:
        ConfigError: When the name is no plain file name, or that of another file.
        OSError: When it cannot be written.
    """
    file = selection_file(folder, name)
    own.write(file, text)
    return file


def selection_file(folder: Path, name: str) -> Path:
    """Return the file of a selection.

    Raises:
        ConfigError: When the name is no plain file name.
    """
    stem = name.removesuffix(ENDING)
    if not is_file_name(stem):
        raise ConfigError(f"'{name}' is no file name; expected letters, digits, '-' and '_', e.g. my_selection")
    return folder / f"{stem}{ENDING}"
