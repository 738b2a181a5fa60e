"""Whether this version of RoboXim reads the files of another version: `roboxim upgrade-check`.

Each artefact is read by the reader that the commands use, so a user would see the same errors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from roboxim_core.errors import ConfigError, RoboximError
from roboxim_core.plain_data.documents import parse_json
from roboxim_core.plain_data.results_log import RUN_FILE
from roboxim_eval.benchmark.card import SCHEMA as BENCHMARK_SCHEMA
from roboxim_eval.benchmark.card import check_benchmark_card, is_benchmark_card
from roboxim_eval.experiments.card import SCHEMA, parse_card
from roboxim_policies.learning.checkpoint_file import FORMAT, read_description
from roboxim_recorder.bag import BagReader
from roboxim_recorder.bag_writer import FORMAT_VERSION
from roboxim_runs.storage.folder import RunFolder

FORMATS: dict[str, str | int] = {
    "bag": FORMAT_VERSION,
    "card": SCHEMA,
    "benchmark card": BENCHMARK_SCHEMA,
    "bc checkpoint": FORMAT,
}
"""Formats that this version writes."""


@dataclass(frozen=True, kw_only=True)
class Readability:
    """Whether an artefact can be read."""

    kind: str
    """``run``, ``bag``, ``card`` or ``checkpoint``."""
    path: Path
    readable: bool
    detail: str
    """Its content, or why it cannot be read and what to do."""


def examine(folder: Path) -> Iterator[Readability]:
    """Read every run, bag, card and checkpoint of a folder, and yield the findings.

    Raises:
        ConfigError: The folder is missing or holds none of them.
    """
    if not folder.exists():
        raise ConfigError(f"{folder} does not exist; expected a folder of a run, an experiment or a training")
    artefacts = [(kind, path) for kind, pattern, _ in KINDS for path in sorted(folder.rglob(pattern))]
    if not artefacts:
        raise ConfigError(f"{folder} holds no run, bag, card or checkpoint of RoboXim")
    readers = {kind: reader for kind, _, reader in KINDS}
    for kind, path in artefacts:
        try:
            yield Readability(kind=kind, path=path, readable=True, detail=readers[kind](path))
        except RoboximError as error:
            yield Readability(kind=kind, path=path, readable=False, detail=str(error))


def _run(path: Path) -> str:
    run = RunFolder(path.parent)
    run.config()
    return f"{len(run.results())} results"


def _bag(path: Path) -> str:
    reader = BagReader(path)
    return f"{len(reader)} ticks, '{reader.result.outcome}'"


def _card(path: Path) -> str:
    data = parse_json(path.read_text(), source=str(path))
    parse = check_benchmark_card if is_benchmark_card(data) else parse_card
    return f"{len(parse(data, source=str(path)).sentences)} sentences"


def _checkpoint(path: Path) -> str:
    return f"{read_description(path)['step']} steps"


KINDS: tuple[tuple[str, str, Callable[[Path], str]], ...] = (
    ("run", RUN_FILE, _run),
    ("bag", "*.mcap", _bag),
    ("card", "card.json", _card),
    ("checkpoint", "checkpoint.npz", _checkpoint),
)
"""Name, file pattern and reader of each kind."""
