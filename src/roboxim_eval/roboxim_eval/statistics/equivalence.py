"""Two one-sided tests that a difference of success rates is within a margin (equivalence).

The tests at an error probability ``alpha`` show it if the interval of the difference at the confidence ``1 - 2 alpha``
is within the margin. Their p value is the smallest ``alpha`` at which it is.

Source:
    Schuirmann (1987), Journal of Pharmacokinetics and Biopharmaceutics 15, 657-680.
"""

from __future__ import annotations

from collections.abc import Callable

NORMAL = 1.959963984540054
"""The 97.5 % quantile of the normal distribution."""


def p_within(value: float, below: float, above: float, margin: float) -> float:
    """Return the p value of both tests for an interval whose ends move with the quantiles of the normal distribution.

    Args:
        value: The difference, -1..1.
        below: How far its 95 % interval extends below it.
        above: How far it extends above it.
        margin: Largest difference that counts as equally good, 0..1.
    """
    from scipy.stats import norm

    return two_one_sided(value, below / NORMAL, above / NORMAL, margin, tail=norm.sf)


def two_one_sided(
    value: float, below: float, above: float, margin: float, *, tail: Callable[[float], float]
) -> float:  # fmt: skip
    """Return the larger one of the p values that the difference is above ``-margin`` and below ``margin``.

    Args:
        value: The difference, -1..1.
        below: Its standard error towards ``-margin``.
        above: Its standard error towards ``margin``.
        margin: Largest difference that counts as equally good, 0..1.
        tail: Standard errors to the probability of a larger deviation.
    """
    rooms = (margin + value, below), (margin - value, above)
    return max(float(tail(room / error)) if error else float(room <= 0) for room, error in rooms)
