"""Tests that a gyro propagates the Sun direction through an eclipse, and that its drift shows the bias."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.gnc.control.sun_acquisition import LARGEST_BIAS, MEMORY, PropagatedSun

SUN = np.array([0.36, 0.48, 0.8])
BIAS = np.array([8e-4, -6e-4, 0.0])
"""Gyro bias (rad/s) normal to the Sun direction; the component along it is not observable."""
SECOND_NS = 1_000_000_000
NOISE = 0.02


def follow(
    propagated: PropagatedSun, begin: int, end: int, seen: bool, bias: FloatArray = BIAS
) -> FloatArray:
    """Simulate for some seconds a body that rolls about the Sun direction; return the true Sun direction."""
    rng = np.random.default_rng(3)
    for second in range(begin, end):
        # The body rotates about the Sun direction, so the Sun direction is constant in body axes.
        rate = 2e-4 * SUN
        measured = rate + bias - propagated.bias
        propagated.propagate(second * SECOND_NS, attitude_matrix(from_rotation_vector(measured)))
        if seen and second % 2 == 0:
            noisy = SUN + NOISE * rng.standard_normal(3)
            propagated.measure(second * SECOND_NS, noisy / np.linalg.norm(noisy))
    return SUN


def apart(propagated: PropagatedSun) -> float:
    """Return the angle (deg) between the propagated and the true Sun direction."""
    assert propagated.direction is not None
    return float(np.degrees(np.arccos(np.clip(propagated.direction @ SUN, -1.0, 1.0))))


def test_the_drift_of_the_sun_shows_the_bias_so_that_an_eclipse_is_bridged() -> None:
    propagated = PropagatedSun()
    follow(propagated, 0, 1000, seen=True)
    assert np.linalg.norm(np.cross(SUN, propagated.bias - BIAS)) < 1e-4
    follow(propagated, 1000, 3100, seen=False)
    assert apart(propagated) < 15.0
    blind = PropagatedSun()
    blind.measure(999 * SECOND_NS, SUN)
    for second in range(1000, 3100):
        blind.propagate(second * SECOND_NS, attitude_matrix(from_rotation_vector(2e-4 * SUN + BIAS)))
    assert apart(blind) > 60.0, "without the bias it would be propagated away"


def test_a_sun_is_forgotten_after_the_longest_eclipse() -> None:
    propagated = PropagatedSun()
    propagated.measure(0, SUN)
    for second in range(int(MEMORY) + 1):
        propagated.propagate(second * SECOND_NS, np.eye(3))
    assert propagated.direction == pytest.approx(SUN)
    propagated.propagate(int(MEMORY + 1.0) * SECOND_NS, np.eye(3))
    assert propagated.direction is None


def test_while_the_direction_is_not_propagated_no_bias_is_estimated() -> None:
    """While the direction is not propagated, no bias is estimated, and an old direction is not used.

    In modes other than SAFE, the solar strings are read, but the direction is not propagated.
    """
    propagated = PropagatedSun()
    for second in range(100):
        propagated.measure(second * SECOND_NS, attitude_matrix(from_rotation_vector(second * BIAS)) @ SUN)
    np.testing.assert_array_equal(propagated.bias, np.zeros(3))
    propagated.propagate(101 * SECOND_NS, np.eye(3))
    assert propagated.direction is not None
    propagated.propagate(110 * SECOND_NS, np.eye(3))
    assert propagated.direction is None


def test_a_sun_far_from_the_propagated_one_replaces_it_and_shows_no_bias() -> None:
    propagated = PropagatedSun()
    propagated.measure(0, SUN)
    propagated.propagate(SECOND_NS, np.eye(3))
    for other in (-SUN, np.array([0.8, 0.6, 0.0])):
        propagated.measure(SECOND_NS, other)
        assert propagated.direction == pytest.approx(other)
    np.testing.assert_array_equal(propagated.bias, np.zeros(3))


def test_no_bias_beyond_its_bound_is_believed() -> None:
    propagated = PropagatedSun()
    follow(propagated, 0, 2000, seen=True, bias=20.0 * BIAS)
    assert np.abs(propagated.bias).max() <= LARGEST_BIAS
