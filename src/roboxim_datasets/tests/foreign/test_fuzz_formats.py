"""Whatever a file contains, a reader reads it, names what it leaves out, or refuses it in a sentence."""

from __future__ import annotations

import random
import shutil
from collections import Counter
from pathlib import Path

import pytest
from made_foreign import hdf5, lerobot21, lerobot30, rlds
from mutations import mutate

from roboxim_core.errors import RoboximError
from roboxim_datasets.card import count, summary
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.plans import plan_of
from roboxim_datasets.rewrite import write_dataset

MAKERS = {"hdf5": hdf5, "lerobot 3.0": lerobot30, "lerobot 2.1": lerobot21, "rlds": rlds}


def outcome(source: Path, target: Path) -> str:
    """Read a dataset as `info` and `convert` do: ``read``, ``named`` (a part was left out) or ``refused``."""
    try:
        dataset = open_dataset(source)
        counts = count(dataset)
        summary(dataset, counts)
        written = write_dataset(
            plan_of(dataset), target, "hdf5", how="convert", fps=0 if dataset.description.fps else 10
        )
    except RoboximError:
        return "refused"
    found = open_dataset(target)
    assert dict(found.splits) == dict(dataset.splits)
    assert count(found).steps == dict(counts.steps)
    return "named" if written.left_out else "read"


def fuzz(maker: str, folder: Path, seeds: range) -> Counter[str]:
    original = MAKERS[maker](folder / "original" / "1.0.0")
    found: Counter[str] = Counter()
    for seed in seeds:
        copy = folder / "copy" / "1.0.0"
        shutil.rmtree(folder / "copy", ignore_errors=True)
        shutil.rmtree(folder / "target", ignore_errors=True)
        for left in folder.glob(".partial-*"):
            shutil.rmtree(left)
        shutil.copytree(original, copy)
        done = mutate(copy, random.Random(seed))
        try:
            found[outcome(copy, folder / "target")] += 1
        except Exception as error:
            error.add_note(f"{maker}, seed {seed}: {done}")
            raise
    return found


@pytest.mark.parametrize("maker", MAKERS)
def test_what_is_made_is_read(maker: str, tmp_path: Path) -> None:
    assert outcome(MAKERS[maker](tmp_path / "a" / "1.0.0"), tmp_path / "b") != "refused"


@pytest.mark.parametrize("maker", MAKERS)
def test_mutations_cause_no_traceback(maker: str, tmp_path: Path) -> None:
    assert sum(fuzz(maker, tmp_path, range(8)).values()) == 8


@pytest.mark.fuzz
@pytest.mark.parametrize("maker", MAKERS)
def test_a_hundred_mutations_cause_no_traceback(maker: str, tmp_path: Path) -> None:
    found = fuzz(maker, tmp_path, range(100))
    assert sum(found.values()) == 100
    assert found["refused"] > 5


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("maker", MAKERS)
def test_two_thousand_mutations_cause_no_traceback(maker: str, tmp_path: Path) -> None:
    found = fuzz(maker, tmp_path, range(100, 2_100))
    print(f"{maker}: {dict(found)}")  # noqa: T201 - the table of docs/how-to/audit.md
    assert sum(found.values()) == 2_000
