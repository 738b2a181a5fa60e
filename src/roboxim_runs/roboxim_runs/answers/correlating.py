"""Reads results of policies, of real robots or of a benchmark, to compare two of them.

A table is a CSV file with the columns ``policy``, ``successes``, ``trials`` and, if there are several tasks, ``cell``;
or a JSON file with a list of objects of these keys. The folder of an evaluation or an experiment, and a card, are
tables too.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from roboxim_core.errors import ConfigError, InvalidRequestError, counted, one_of
from roboxim_core.limits import echo
from roboxim_core.plain_data.documents import read_json, read_text
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.card_checks import outcomes_of_card
from roboxim_eval.statistics.correlation import (
    MIN_POLICIES,
    WHOLE,
    Correlation,
    PolicyCounts,
    correlation,
    policy_counts,
)
from roboxim_eval.statistics.tables import Arm, Count
from roboxim_runs.evaluation.report import RECORD_FILE, stored_record
from roboxim_runs.experiments.card import CARD_FILE
from roboxim_runs.experiments.report import stored_card
from roboxim_runs.storage.folder import RunFolder

COLUMNS = ("policy", "cell", "successes", "trials")
"""Keys of a row; ``cell`` may be missing."""
MAX_TRIALS = 10**9
"""Largest number of trials of a row."""
Table = Mapping[str, Arm]
"""Policy to its outcomes."""


def read_results(path: Path) -> Table:
    """Return the results of a file or a folder, by policy.

    Policies of an experiment are named by condition, all its trainings together, and ``CONDITION.R`` for one of them.

    Args:
        path: A CSV or JSON table, a card, or the folder of an evaluation or an experiment.

    Raises:
        ConfigError: When it is none, or a row is wrong (names it), or most episodes of a policy ended in errors.
    """
    table = _stored(path)
    erred = [name for name, arm in table.items() if 2 * arm.pooled.errors > arm.pooled.episodes]
    if erred:
        raise ConfigError(
            f"{path} does not measure {', '.join(erred)}: most episodes ended in errors; mend what they name, and "
            "evaluate again into another folder"
        )
    return table


def _stored(path: Path) -> Table:
    """Return the results of a file or a folder, as `read_results`, whatever their errors."""
    if path.is_dir():
        if (path / RECORD_FILE).exists():
            return {name: _one(_counted(path / name)) for name in stored_record(path).policies}
        if (path / CARD_FILE).exists():
            return _of_card(stored_card(path / CARD_FILE))
        raise ConfigError(f"{path} has neither {RECORD_FILE} of an evaluation nor {CARD_FILE} of an experiment")
    if path.suffix == ".csv":
        return _table(_csv_rows(path), str(path))
    if path.suffix == ".json":
        data = read_json(path)
        if isinstance(data, list):
            return _table(enumerate(data, start=1), str(path))
        return _of_card(stored_card(path))
    raise ConfigError(f"{path}: expected a .csv or .json file, or the folder of an evaluation or an experiment")


def _csv_rows(path: Path) -> Iterable[tuple[int, Any]]:
    reader = csv.DictReader(io.StringIO(read_text(path), newline=None), strict=True)
    try:
        columns = list(reader.fieldnames or ())
        if len(columns) == 1 and (found := re.search("[;\t|]", columns[0])):
            raise ConfigError(f"{path}: columns are separated by commas, not by {found.group()!r}; save it as such")
        if twice := [column for column in dict.fromkeys(columns) if columns.count(column) > 1]:
            raise ConfigError(f"{path} has the column '{twice[0]}' twice; leave one out")
        yield from enumerate(reader, start=2)
    except csv.Error as error:
        raise ConfigError(f"{path} line {reader.line_num}: {error}") from None


def _table(rows: Iterable[tuple[int, Any]], source: str) -> Table:
    """Return the outcomes of a table's rows.

    Raises:
        ConfigError: When a row lacks a column or has another one, a number is impossible, or a row appears twice.
    """
    found: dict[str, dict[str, Count]] = {}
    for number, row in rows:
        where = f"{source}, row {number}"
        if not isinstance(row, Mapping):
            raise ConfigError(f"{where}: expected an object with {', '.join(COLUMNS)}, got {row!r}")
        for key in row:
            if key is None:  # what follows the last column
                raise ConfigError(f"{where}: has more values than the header has columns, e.g. {echo(row[key][0])}")
            if key not in COLUMNS:
                raise ConfigError(f"{where}: unknown column '{key}'; {one_of(COLUMNS, str(key))}")
        for key in ("policy", "successes", "trials"):
            if row.get(key) in (None, ""):
                raise ConfigError(f"{where}: has no {key}; expected the columns {', '.join(COLUMNS)}")
        policy, cell = (_name(row.get(key), f"{where}: {key}") for key in ("policy", "cell"))
        if not policy:
            raise ConfigError(f"{where}: the policy has no name; name it as in the other table")
        try:
            count = Count(successes=_whole(row["successes"]), episodes=_whole(row["trials"]))
        except (ValueError, InvalidRequestError) as error:
            raise ConfigError(
                f"{where}: expected whole numbers with 0 <= successes <= trials, got {echo(row['successes'])} and "
                f"{echo(row['trials'])}"
            ) from error
        if not count.episodes:
            raise ConfigError(f"{where}: a rate needs at least one trial, got 0")
        if count.episodes > MAX_TRIALS:
            raise ConfigError(f"{where}: trials must be at most {MAX_TRIALS}, got {echo(row['trials'])}")
        if cell in found.setdefault(policy, {}):
            raise ConfigError(f"{where}: policy '{policy}' has a row of this cell already; add both up")
        found[policy][cell] = count
    if not found:
        raise ConfigError(f"{source} has no row; expected the columns {', '.join(COLUMNS)}")
    for policy, counts in found.items():
        if WHOLE in counts and len(counts) > 1:
            raise ConfigError(f"{source}: policy '{policy}' has rows with a cell and one without; name all cells")
    return {policy: _one(counts) for policy, counts in found.items()}


def _name(value: Any, what: str) -> str:
    """Return a name as text without spaces around it; `WHOLE` if there is none.

    Raises:
        ConfigError: When it is neither text nor a whole number.
    """
    if value is None:
        return WHOLE
    if isinstance(value, bool) or not isinstance(value, int | str):
        raise ConfigError(f"{what}: expected a name, got {echo(value)}")
    return str(value).strip()


def _whole(value: Any) -> int:
    """Return a whole number; a share such as 0.8 is refused.

    Raises:
        ValueError: When it is none.
    """
    if isinstance(value, bool) or not isinstance(value, int | str):
        raise ValueError(value)
    if isinstance(value, str) and not re.fullmatch(r"[+-]?[0-9]+", value.strip()):
        raise ValueError(value)  # e.g. 1_0, which is a number in Python alone
    return int(value)


def _counted(run: Path) -> dict[str, Count]:
    results = RunFolder(run).results()
    if not results:
        raise ConfigError(f"{run} has no results")
    won, errors = (sum(one.outcome == outcome for one in results) for outcome in ("success", "error"))
    return {WHOLE: Count(successes=won, episodes=len(results), errors=errors)}


def _of_card(card: Card) -> Table:
    found: dict[str, Arm] = {}
    for name, arm in outcomes_of_card(card).arms.items():
        found[name] = arm
        found |= {_training(name, number): _one(counts) for number, counts in enumerate(arm.replicates)}
    return found


def _training(condition: str, number: int) -> str:
    return f"{condition}.{number}"


def _trainings(table: Table, name: str) -> set[str]:
    """Return the names of the trainings that a policy consists of: a card has both. Others may have such a name."""
    names = ((_training(name, number), counts) for number, counts in enumerate(table[name].replicates))
    return {one for one, counts in names if one in table and table[one].replicates[0] is counts}


def _one(counts: Mapping[str, Count]) -> Arm:
    return Arm(replicates=(counts,))


def paired(first: Table, second: Table) -> list[PolicyCounts]:
    """Return the policies that two tables have, in the order of the first one.

    A condition of an experiment is left out if single trainings of it are in both tables: it would count them twice.

    Raises:
        ConfigError: When they have fewer than `MIN_POLICIES` in common.
        InvalidRequestError: When these have no cells in common; see `policy_counts`.
    """
    both = [name for name in first if name in second]
    single = {name for name in both for table in (first, second) if not _trainings(table, name).isdisjoint(both)}
    common = [name for name in both if name not in single]
    if len(common) < MIN_POLICIES:
        raise ConfigError(
            f"the tables have {counted(len(common), 'policy', 'policies')} in common "
            f"({', '.join(common) or 'none'}), and a correlation needs at least {MIN_POLICIES}: two points always lie "
            f"on a line. They have {', '.join(first)}; and {', '.join(second)}"
        )
    return policy_counts({name: (first[name], second[name]) for name in common})


def correlated(first: Path, second: Sequence[Path], *, seed: int = 0) -> Correlation:
    """Return the agreement of two benchmarks.

    Args:
        first: Results to be predicted, e.g. of real robots.
        second: Results that are to predict them; several, if each has other policies.
        seed: Seed of the interval's draws.

    Raises:
        ConfigError: When a table is wrong, two have a policy of the same name, or too few policies are in both.
    """
    arms: dict[str, Arm] = {}
    for path in second:
        found = read_results(path)
        if twice := sorted(arms.keys() & found.keys()):
            raise ConfigError(f"{path}: policy '{twice[0]}' is in another of the tables, too; rename it")
        arms |= found
    return correlation(paired(read_results(first), arms), seed=seed)
