from __future__ import annotations

import pytest

from roboxim_core.errors import InvalidRequestError
from roboxim_sim.name_filter import name_filter


@pytest.mark.parametrize("text", ["", "^red", "cube_[0-9]+$", "a.*b", "red|blue", "(red|blue)_cube", ".*a.*b.*"])
def test_ordinary_filters_are_accepted(text):
    assert name_filter(text).pattern == text


@pytest.mark.parametrize(
    "text",
    [
        "(a+)+$",
        "(a|a)*b",
        "(.*)*x",
        "((a*)b)*",
        "a*a*a*a*a*b",
        "(a)(\\1)*\\1+",
        "[",
        "x" * 201,
        "a{1,99}" * 4,
        "(" * 100,
    ],
)
def test_filters_with_unbounded_search_time_are_rejected(text):
    with pytest.raises(InvalidRequestError, match="filter"):
        name_filter(text)
