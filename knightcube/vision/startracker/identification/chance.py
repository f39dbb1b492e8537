"""The significance of a match with the sky: the expected number of equally good chance matches.

An upper bound of the expected number of attitudes, among those searched, at which random stars match guide
stars as well or better; far below one, also of the probability of a false match. The bound does not depend on
how a candidate was found and is raised for every choice that the matching makes among gates, limits of
brightness and tests (Bonferroni).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

_MOST_ORDERED = 12


@dataclass(frozen=True, slots=True)
class Chance:
    """The parameters of a chance match.

    Attributes:
        observed: number of stars.
        spread: sigma^2 of a star over the area of the field.
        fields: number of such fields in the searched part of the sky.
        scales: ln of the highest over the lowest scale.
        choices: how many gates the matching chooses from.
        least: the fewest stars that are accepted.
        enough: log10 below which the exact value does not matter.
    """

    observed: int
    spread: float
    fields: float
    scales: float
    choices: int
    least: int
    enough: float

    def log10(self, gate: float, observed: Sequence[int], ranks: Sequence[int]) -> float:
        """Return log10 of the bound for observed stars that match the expected ones of `ranks` within `gate`.

        Both are numbered in order of brightness. The matching chooses the faintest star that counts: for
        the j-th choice, with j - 1 brighter expected stars missing, the bound is raised by j^2
        pi^2/6.
        """
        pairs = sorted(zip(ranks, observed, strict=True))
        best = math.inf
        for matched in range(len(pairs), self.least - 1, -1):
            expected = pairs[matched - 1][0] + 1
            value = self._of_places(gate, matched, expected)
            value += math.log10(self.choices * math.pi**2 / 6.0 * (expected - matched + 1.0) ** 2)
            if self.enough < value < self.enough + 8.0 and matched <= _MOST_ORDERED:
                value += min(0.0, math.log10(2.0 * order_probability([star for _, star in pairs[:matched]])))
            best = min(best, value)
            if best < self.enough - 2.0:
                break
        return best

    def _of_places(self, gate: float, matched: int, expected: int) -> float:
        """Return log10 of the number of chance matches of `matched` stars or more with `expected` ones.

        The first star may be any of those of the sky; the second any in the ring about it that the distance
        of the two leaves, as wide as scale and gate are; each star besides has to lie within the gate of an
        expected one: for all choices of the matched among the observed. The fit draws its own stars to it:
        left out of the fit, each would lie farther off by 1/(1 - leverage).
        """
        leverage = 2.0 / matched if matched > 2 else 0.5
        chance = min(expected * math.pi * gate * gate * self.spread / (1.0 - leverage) ** 2, 0.5)
        if matched <= self.observed * chance:
            return math.log10(self.fields * expected)
        # The mean square distance of two points of a unit square is 1/3.
        ring = 2.0 * math.pi / 3.0 * expected * (self.scales + 2.0 * gate * math.sqrt(3.0 * self.spread))
        lost = self.observed - matched
        ways = math.lgamma(self.observed + 1) - math.lgamma(matched + 1) - math.lgamma(lost + 1)
        rest = (matched - 2) * math.log(chance) + lost * math.log1p(-chance)
        # The terms for still more stars fall faster than a geometric series (Feller VI.3).
        ratio = lost / (matched + 1.0) * chance / (1.0 - chance)
        return (ways + rest - math.log1p(-ratio) + math.log(self.fields * expected * ring)) / math.log(10.0)


def order_probability(sequence: Sequence[int]) -> float:
    """Return the probability that a random order has as few inversions as `sequence` (Kendall's tau)."""
    inversions = sum(a > b for place, a in enumerate(sequence) for b in sequence[place + 1 :])
    counts = _inversion_counts(len(sequence))
    return sum(counts[: inversions + 1]) / math.factorial(len(sequence))


@lru_cache(maxsize=_MOST_ORDERED + 1)
def _inversion_counts(length: int) -> tuple[int, ...]:
    """Return how many of the orders of `length` things have 0, 1, 2 ... inversions (Mahonian numbers)."""
    counts = [1]
    for more in range(1, length):
        counts = [sum(counts[max(0, total - more) : total + 1]) for total in range(len(counts) + more)]
    return tuple(counts)
