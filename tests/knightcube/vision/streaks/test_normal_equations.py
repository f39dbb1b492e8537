"""Tests of the scatter of stars' normal equations, with randomly drawn noise."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.vision.streaks.normal_equations import StarEquations, contradiction

_STARS = 400
_KEPT = np.array([0, 1, 2, 6])


def _drawn(noise: float, blind: bool = False) -> StarEquations:
    """Return the normal equations of stars with very different fluxes.

    The errors of the right-hand sides are `noise` times the errors that the equations state. If `blind` is
    set, each star has no information about two random directions.
    """
    rng = np.random.default_rng(3)
    change = rng.normal(size=(_STARS, 4, 6)) * 10.0 ** rng.uniform(-2.0, 2.0, (_STARS, 1, 1))
    change *= np.array([1e3, 1e3, 1e3, 1.0])[:, None]
    if blind:
        change = change[:, :, :2]
    step = np.array([1e-3, -2e-3, 0.0, 0.1])
    information = change @ change.swapaxes(1, 2)
    drawn = noise * rng.normal(size=(_STARS, change.shape[2], 1))
    return StarEquations(_KEPT, information, information @ step + (change @ drawn)[..., 0])


@pytest.mark.parametrize("blind", [False, True])
@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_the_scatter_of_noise_is_one_per_degree_of_freedom(noise: float, blind: bool) -> None:
    """The scatter of pure noise is one per degree of freedom.

    The result depends neither on the units of the parameters nor on undetermined directions.
    """
    assert contradiction(_drawn(noise, blind)) == pytest.approx(noise**2, rel=0.1)


def test_a_single_star_has_no_scatter() -> None:
    many = _drawn(3.0)
    assert contradiction(StarEquations(_KEPT, many.information[:1], many.score[:1])) == 1.0
