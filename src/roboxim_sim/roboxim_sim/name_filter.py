"""Validation of the regular expressions in requests: only those with a bounded search time are accepted.

Python's engine backtracks. An expression that repeats a repetition or a choice can take time that is exponential in
the length of the name, and blocks the node meanwhile.
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
"""Maximum number of consecutive repetitions: three take time at most cubic in the name's length."""
_REPEATS = (ops.MAX_REPEAT, ops.MIN_REPEAT, ops.POSSESSIVE_REPEAT)


def name_filter(text: str) -> re.Pattern[str]:
    """Return the compiled expression.

    Raises:
        InvalidRequestError: When the text is no regular expression, too long, or could take too much time.
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
    """Return the number of repetitions in a parsed expression; a nested repetition counts as too many."""
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
