"""Episodes that are flagged or left out, as a file of conditions that exports take: ``--where @FILE``.

The source is never touched.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from roboxim_core.errors import ConfigError
from roboxim_core.limits import is_file_name
from roboxim_core.plain_data.documents import read_text
from roboxim_datasets.where import Choice, Condition, Edit, with_files

ENDING = ".where"
MADE = "# Made with roboxim studio"
FLAG = "# flagged: "


def selection_text(
    left_out: Iterable[str], flagged: Iterable[str], source: str, total: int, edits: Iterable[Edit] = (),
    kept: Iterable[str] = (),
) -> str:  # fmt: skip
    """Return the text of a selection file.

    Args:
        left_out: Ids of episodes that exports leave out.
        flagged: Ids of episodes that somebody should look at; only a comment.
        source: Name of the run.
        total: Number of its episodes.
        edits: Trims and new instructions.
        kept: Further lines, as they are.
    """
    out, looked = sorted(left_out), sorted(flagged)
    lines = [f"{MADE}: {len(out)} of {total} episodes of {source} are left out."]
    lines += [f"{FLAG}{name}" for name in looked]
    lines += [Condition(key="episode", sign="!=", values=(name,)).text for name in out]
    for edit in sorted(edits, key=lambda one: one.episode):
        lines += edit.texts
    return "\n".join([*lines, *kept]) + "\n"


@dataclass(frozen=True, kw_only=True)
class Saved:
    """What a selection file says."""

    left_out: frozenset[str] = frozenset()
    """Ids of episodes that are left out."""
    flagged: frozenset[str] = frozenset()
    """Ids of episodes that somebody should look at."""
    edits: Mapping[str, Edit] = field(default_factory=dict)
    """Episode to its edit."""
    kept: tuple[str, ...] = ()
    """Every other line: other conditions, what is said of other episodes, and comments."""


def read_selection(file: Path, episodes: Collection[str]) -> Saved:
    """Read a selection file.

    Args:
        file: The file.
        episodes: Ids of the episodes that can be marked and edited.

    Raises:
        ConfigError: When there is no such file.
        InvalidRequestError: When a line is neither a condition nor an edit.
    """
    with_files([f"@{file}"])  # names the line that is neither
    out: set[str] = set()
    flagged: set[str] = set()
    edits: list[str] = []
    kept: list[str] = []
    for line in map(str.strip, read_text(file).splitlines()):
        if not line or line.startswith(MADE):
            continue
        comment = line.startswith("#")
        edit = None if comment else Edit.parse(line)
        left_out = set() if comment or edit is not None else _left_out(line)
        if comment and line.startswith(FLAG) and line.removeprefix(FLAG) in episodes:
            flagged.add(line.removeprefix(FLAG))
        elif edit is not None and edit.episode in episodes:
            edits.append(line)
        elif left_out and all(one in episodes for one in left_out):
            out |= left_out
        else:
            kept.append(line)
    return Saved(left_out=frozenset(out), flagged=frozenset(flagged), edits=Choice.parse(edits).edits, kept=tuple(kept))


def _left_out(line: str) -> set[str]:
    """Return the ids of the episodes that a condition leaves out; empty: it is another condition."""
    condition = Condition.parse(line)
    return set(condition.values) if (condition.key, condition.sign) == ("episode", "!=") else set()


def selection_file(folder: Path, name: str) -> Path:
    """Return the file of a selection.

    Raises:
        ConfigError: When the name is no plain file name.
    """
    stem = name.removesuffix(ENDING)
    if not is_file_name(stem):
        raise ConfigError(f"'{name}' is no file name; expected letters, digits, '-' and '_', e.g. my_selection")
    return folder / f"{stem}{ENDING}"
