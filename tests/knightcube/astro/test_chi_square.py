"""Tests of the upper quantile and the tail probability of chi-square against scipy."""

from __future__ import annotations

import math

import pytest
from scipy.special import chdtrc, chdtri

from knightcube.astro.chi_square import bound, chance_beyond


@pytest.mark.parametrize("degrees", [1, 2, 3, 4, 7])
@pytest.mark.parametrize("sigma", [0.0, 0.5, 3.0, 5.0, 15.0, 30.0])
def test_the_upper_quantile_is_that_of_scipy(degrees: int, sigma: float) -> None:
    chance = math.erfc(sigma / math.sqrt(2.0))
    assert bound(chance, degrees) == pytest.approx(chdtri(degrees, chance), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("degrees", [1, 2, 3, 6])
def test_the_tail_probability_is_that_of_scipy(degrees: int) -> None:
    for x in (0.0, 0.1, 1.0, 10.0, 300.0):
        assert chance_beyond(x, degrees) == pytest.approx(chdtrc(degrees, x), rel=1e-11)
