"""The cubic prey of 5.35-5.38."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knightcube.gnc.guidance.one_axis.path import CubicPrey

Q2 = st.floats(-0.7, 0.7)
SLOPE = st.floats(-0.1, 0.1)


@given(Q2, SLOPE, Q2, SLOPE, st.floats(1.0, 60.0))
def test_the_prey_joins_both_states(
    start: float, slope: float, end: float, end_slope: float, horizon: float
) -> None:
    prey = CubicPrey.between(start, slope, end, end_slope, horizon)
    ends = np.array([0.0, horizon])
    np.testing.assert_allclose(prey.q2(ends), [start, end], atol=1e-12)
    np.testing.assert_allclose(prey.q2_rate(ends), [slope, end_slope], atol=1e-12)


def test_coefficients_are_those_of_equations_5_37_and_5_38() -> None:
    """By hand for 0.4 at 0.01 to -0.3 at 0 in 10 s: C2 = [3 (-0.7) - 0.2]/100, C3 = (-0.01 + 0.46)/300."""
    prey = CubicPrey.between(0.4, 0.01, -0.3, 0.0, 10.0)
    assert (prey.c0, prey.c1) == (0.4, 0.01)
    assert prey.c2 == pytest.approx(-0.023, abs=1e-15)
    assert prey.c3 == pytest.approx(0.0015, abs=1e-15)


def test_the_printed_rate_is_the_derivative_of_the_printed_path() -> None:
    prey = CubicPrey.between(0.2, -0.05, -0.3, 0.01, 9.0)
    time, step = np.linspace(1.0, 8.0, 15), 1e-4
    difference = (prey.q2(time + step) - prey.q2(time - step)) / (2 * step)
    np.testing.assert_allclose(prey.q2_rate(time), difference, atol=1e-9)
