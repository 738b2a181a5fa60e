"""Trend of success rates over a quantity that conditions differ in, e.g. the number of combinations seen."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from roboxim_eval.statistics.components import student_limit
from roboxim_eval.statistics.replicates import Interval, pooled_rate
from roboxim_eval.statistics.tables import Arm


def trend(places: Sequence[float], arms: Sequence[Arm]) -> Interval:
    """Return the slope of the least-squares line through the conditions' success rates, with its 95 % interval.

    Each replicate has its own slope, since its conditions share the seed and the scenes; the interval is Student's t
    over them. It is never narrower than that of the rollouts alone: a few replicates can agree by chance. It is
    unbounded for one replicate.

    Args:
        places: The quantity of each condition.
        arms: Outcomes of each condition, replicate by replicate.
    """
    x = np.asarray(places, float)
    weights = (x - x.mean()) / ((x - x.mean()) ** 2).sum()
    slopes = weights @ np.array([arm.rates for arm in arms])
    value = float(slopes.mean())
    if len(slopes) < 2:
        return Interval(value=value, low=-math.inf, high=math.inf)
    pooled = [pooled_rate(arm) for arm in arms]
    errors = [max(rate.high - rate.rate, rate.rate - rate.low) for rate in pooled]  # 95 %
    alone = math.sqrt(sum((w * error) ** 2 for w, error in zip(weights, errors, strict=True)))
    half = max(alone, student_limit(len(slopes) - 1) * float(slopes.std(ddof=1)) / math.sqrt(len(slopes)))
    return Interval(value=value, low=value - half, high=value + half)
