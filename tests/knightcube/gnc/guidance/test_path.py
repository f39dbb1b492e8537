"""Tests of Legendre-Gauss-Lobatto nodes and their exactness, and of the cubic prey path of 5.35-5.38."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knightcube.errors import UsageError
from knightcube.gnc.guidance.plant import CubicPrey, lgl_rule


@pytest.mark.parametrize(
    ("count", "nodes", "weights"),
    [
        (3, [-1.0, 0.0, 1.0], [1 / 3, 4 / 3, 1 / 3]),
        (4, [-1.0, -np.sqrt(1 / 5), np.sqrt(1 / 5), 1.0], [1 / 6, 5 / 6, 5 / 6, 1 / 6]),
        (5, [-1.0, -np.sqrt(3 / 7), 0.0, np.sqrt(3 / 7), 1.0], [1 / 10, 49 / 90, 32 / 45, 49 / 90, 1 / 10]),
        (
            6,
            [-1.0, -0.765055323929465, -0.285231516480645, 0.285231516480645, 0.765055323929465, 1.0],
            [1 / 15, 0.378474956297847, 0.554858377035486, 0.554858377035486, 0.378474956297847, 1 / 15],
        ),
    ],
)
def test_nodes_and_weights_are_the_published_ones(
    count: int, nodes: list[float], weights: list[float]
) -> None:
    """Abramowitz & Stegun list the nodes and weights in table 25.6."""
    rule = lgl_rule(count)
    np.testing.assert_allclose(rule.nodes, nodes, atol=1e-14)
    np.testing.assert_allclose(rule.weights, weights, atol=1e-14)


@pytest.mark.parametrize("count", [6, 16, 24, 48])
def test_quadrature_is_exact_to_its_degree_and_no_further(count: int) -> None:
    rule = lgl_rule(count)
    for degree in range(2 * count - 2):
        exact = 0.0 if degree % 2 else 2.0 / (degree + 1)
        assert rule.weights @ rule.nodes**degree == pytest.approx(exact, abs=1e-13)
    if count == 6:
        assert abs(rule.weights @ rule.nodes**10 - 2.0 / 11.0) > 1e-3


@pytest.mark.parametrize("count", [6, 16, 24])
def test_differentiation_is_exact_for_polynomials_of_the_nodes(count: int) -> None:
    rule = lgl_rule(count)
    for degree in range(count):
        slope = degree * rule.nodes ** max(degree - 1, 0)
        np.testing.assert_allclose(rule.differentiation @ rule.nodes**degree, slope, atol=1e-11)


def test_interpolation_is_exact_on_nodes_and_between() -> None:
    rule = lgl_rule(12)
    points = np.concatenate([np.linspace(-1.0, 1.0, 41), rule.nodes])
    matrix = rule.interpolation(points)
    for degree in range(12):
        np.testing.assert_allclose(matrix @ rule.nodes**degree, points**degree, atol=1e-13)


def test_a_rule_is_shared_and_cannot_be_spoilt() -> None:
    assert lgl_rule(10) is lgl_rule(10)
    with pytest.raises(ValueError, match="read-only"):
        lgl_rule(10).nodes[0] = 0.0


def test_fewer_than_two_nodes_are_refused() -> None:
    with pytest.raises(UsageError, match="at least 2"):
        lgl_rule(1)


Q2 = st.floats(-0.7, 0.7)
SLOPE = st.floats(-0.1, 0.1)


@given(Q2, SLOPE, Q2, SLOPE, st.floats(1.0, 60.0))
def test_the_prey_path_joins_both_states(
    start: float, slope: float, end: float, end_slope: float, horizon: float
) -> None:
    prey = CubicPrey.between(start, slope, end, end_slope, horizon)
    ends = np.array([0.0, horizon])
    np.testing.assert_allclose(prey.q2(ends), [start, end], atol=1e-12)
    np.testing.assert_allclose(prey.q2_rate(ends), [slope, end_slope], atol=1e-12)


def test_coefficients_are_those_of_equations_5_37_and_5_38() -> None:
    """From q2 = 0.4 with the rate 0.01 to -0.3 at rest in 10 s, the coefficients follow from 5.37 and 5.38.

    C2 = [3 (-0.7) - 0.2]/100, and C3 = (-0.01 + 0.46)/300.
    """
    prey = CubicPrey.between(0.4, 0.01, -0.3, 0.0, 10.0)
    assert (prey.c0, prey.c1) == (0.4, 0.01)
    assert prey.c2 == pytest.approx(-0.023, abs=1e-15)
    assert prey.c3 == pytest.approx(0.0015, abs=1e-15)


def test_the_printed_rate_is_the_derivative_of_the_printed_path() -> None:
    prey = CubicPrey.between(0.2, -0.05, -0.3, 0.01, 9.0)
    time, step = np.linspace(1.0, 8.0, 15), 1e-4
    difference = (prey.q2(time + step) - prey.q2(time - step)) / (2 * step)
    np.testing.assert_allclose(prey.q2_rate(time), difference, atol=1e-9)
