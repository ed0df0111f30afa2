"""The verdict on a training: is the θ that it ended with cheaper than its start?"""

from __future__ import annotations

from typing import Literal

import numpy as np

from cosim.core.protocols import Array
from cosim.core.statistics import Estimate, mean

Verdict = Literal[
    "better",
    "no difference shown",
    "worse: the start was kept",
    "θ was not changed",
    "not compared: no held-out runs",
]

BETTER: Verdict = "better"
NO_DIFFERENCE: Verdict = "no difference shown"
WORSE: Verdict = "worse: the start was kept"
UNCHANGED: Verdict = "θ was not changed"
NOT_COMPARED: Verdict = "not compared: no held-out runs"


def verdict(difference: Estimate) -> Verdict:
    """Verdict on a difference of mean costs.

    Args:
        difference: J after a training less J of its start, on the same noise, with its interval.

    Returns:
        `better` or `worse: …` where the whole interval lies on one side of zero. A cost that is not
        finite is worse, and without an interval no difference is shown.
    """
    if not np.isfinite(difference.value):
        return WORSE
    if difference.interval is None:
        return NO_DIFFERENCE
    low, high = difference.interval
    if high < 0:
        return BETTER
    return WORSE if low > 0 else NO_DIFFERENCE


def cost_difference(
    cost: Array,
    start: Array,
) -> Estimate:
    """J less J of the start, a mean over paired seeds.

    Args:
        cost: J of each seed, (K,).
        start: that of the start on the same seed, (K,).

    Returns:
        The mean with Student's interval, which one seed does not give.
    """
    # Where both are infinite the difference is no number.
    with np.errstate(invalid="ignore"):
        return mean(cost - start)
