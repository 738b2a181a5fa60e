"""Makes the benchmarks and the helper module of this folder importable."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="module", autouse=True)
def _benchmarks_importable() -> Iterator[None]:
    paths = [str(ROOT), str(ROOT / "benchmarks" / "peers")]
    sys.path[:0] = paths
    yield
    for path in paths:
        sys.path.remove(path)
