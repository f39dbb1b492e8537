"""The bound on chance matches against strewn stars, and the order statistic against enumeration."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from knightcube.vision.startracker.identification.verification import Chance, order_probability


@pytest.mark.parametrize("length", [1, 2, 3, 5])
def test_the_probability_of_an_order_is_that_of_enumeration(length: int) -> None:
    orders = list(itertools.permutations(range(length)))

    def inversions(order: tuple[int, ...]) -> int:
        return sum(a > b for a, b in itertools.combinations(order, 2))

    for order in orders[:: max(1, len(orders) // 20)]:
        fewer = sum(inversions(other) <= inversions(order) for other in orders)
        assert math.isclose(order_probability(order), fewer / len(orders))


def _chance(observed: int, spread: float) -> Chance:
    return Chance(observed, spread, 1.0, 0.0, 1, 3, 0.0)


def test_the_bound_is_not_below_what_strewn_stars_show() -> None:
    """One field, all turns and shifts, scale known: sky and image both strewn, ten stars of a unit square.

    Every pair of the image is laid on every pair of the sky that is as long, and the best number of matches
    counted; how often it reaches five is compared with the bound for five.
    """
    rng = np.random.default_rng(5)
    sigma, gate, stars, trials, reached = 0.004, 3.0, 10, 120, 0
    for _ in range(trials):
        sky, seen = (rng.uniform(size=stars) + 1j * rng.uniform(size=stars) for _ in range(2))
        best = 0
        for a, b in itertools.permutations(range(stars), 2):
            side = seen[b] - seen[a]
            turn = (sky[None, :] - sky[:, None]) / side + 10.0 * np.eye(stars)
            for i, j in np.argwhere(np.abs(np.abs(turn) - 1.0) * abs(side) < 2.0 * gate * sigma):
                rotation = turn[i, j] / abs(turn[i, j])
                laid = rotation * (seen - 0.5 * (seen[a] + seen[b])) + 0.5 * (sky[i] + sky[j])
                best = max(best, int((np.abs(laid[:, None] - sky).min(axis=1) < gate * sigma).sum()))
        reached += best >= 5
    bound = 10.0 ** _chance(stars, sigma**2).log10(gate, range(5), range(5, 10))
    assert reached / trials < min(bound, 1.0) + 0.05


def test_more_matches_are_less_likely_and_wider_gates_more() -> None:
    chance = _chance(20, 1e-8)
    values = [chance._of_places(3.5, matched, 20) for matched in range(4, 15)]
    assert np.all(np.diff(values) < 0.0)
    assert chance._of_places(8.0, 6, 20) > chance._of_places(3.5, 6, 20)
