"""Upper quantiles of the chi-square distribution for small numbers of degrees of freedom.

The upper tail probability has a closed form (Abramowitz and Stegun, 26.4.4, 26.4.5 and 26.4.8), which is
inverted by bisection. The module scipy.stats would need 13 MB of memory in the control process.
"""

from __future__ import annotations

import math
from functools import lru_cache

_BISECTIONS = 200


def chance_beyond(x: float, degrees: int) -> float:
    """Return the probability that a chi-square variable of 1 or more `degrees` of freedom exceeds x."""
    half = 0.5 * x
    chance = math.erfc(math.sqrt(half)) if degrees % 2 else math.exp(-half)
    for below in range(2 - degrees % 2, degrees, 2):
        chance += half ** (0.5 * below) * math.exp(-half) / math.gamma(0.5 * below + 1.0)
    return chance


@lru_cache(maxsize=64)
def bound(chance: float, degrees: int) -> float:
    """Return the value that a chi-square variable exceeds with a probability `chance` above 0 and up to 1."""
    low, high = 0.0, 1.0
    while chance_beyond(high, degrees) > chance:
        low, high = high, 2.0 * high
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if not low < middle < high:
            break
        low, high = (middle, high) if chance_beyond(middle, degrees) > chance else (low, middle)
    return high
