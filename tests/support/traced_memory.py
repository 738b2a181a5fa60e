"""How much memory a block takes."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def peak_below(most: int) -> Iterator[None]:
    """Check the largest memory of a block [bytes], as far as Python and NumPy take it.

    Tracing ends with the block, also when it fails: it would make all later tests slow.
    """
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()
