"""Regular expressions of requests: only those whose search takes little time on any name.

Python's engine tries every way to match. An expression that repeats a repetition, or a choice, takes time that is
exponential in the length of the name, and holds the node meanwhile.
"""

from __future__ import annotations

import re
from re import _constants as ops  # type: ignore[attr-defined]
from re import _parser  # type: ignore[attr-defined]
from typing import Any

from roboxim_core import limits
from roboxim_core.errors import InvalidRequestError

MAX_CHARACTERS = 200
MAX_REPEATS = 3
"""Repetitions, one after another: three take at most the cube of a name's length."""
_REPEATS = (ops.MAX_REPEAT, ops.MIN_REPEAT, ops.POSSESSIVE_REPEAT)


def name_filter(text: str) -> re.Pattern[str]:
    """Return the compiled expression.

    Raises:
        InvalidRequestError: When it is none, too long, or may take too much time.
    """
    if len(text) > MAX_CHARACTERS:
        raise InvalidRequestError(f"a filter may have {MAX_CHARACTERS} characters, got {len(text)}")
    try:
        parsed = _parser.parse(text)
        repeats = _count(parsed, within=False)
        compiled = re.compile(text)
    except (re.error, OverflowError, RecursionError) as error:
        raise InvalidRequestError(f"filter {limits.echo(text)} is no regular expression: {error}") from None
    if repeats > MAX_REPEATS:
        raise InvalidRequestError(f"a filter may have {MAX_REPEATS} repetitions, got {limits.echo(text)}")
    return compiled


def _count(tree: Any, *, within: bool) -> int:
    """Return how many repetitions a parsed expression has; one within another counts as too many."""
    found = 0
    for op, argument in tree:
        if op in (*_REPEATS, ops.BRANCH, ops.GROUPREF) and within:
            return MAX_REPEATS + 1
        if op in _REPEATS:
            found += 1 + _count(argument[2], within=True)
        elif isinstance(argument, tuple):
            for part in argument:
                for tree_below in part if isinstance(part, list) else [part]:
                    if isinstance(tree_below, _parser.SubPattern):
                        found += _count(tree_below, within=within)
    return found
