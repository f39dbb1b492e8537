"""The Sun carried on by a gyro: its drift shows the gyro's bias, and it is kept through an eclipse."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.gnc.estimation.carried_sun import LARGEST_BIAS, MEMORY, CarriedSun

SUN = np.array([0.36, 0.48, 0.8])
BIAS = np.array([8e-4, -6e-4, 0.0])
"""rad/s, normal to the Sun; what lies along it shows nothing."""
SECOND_NS = 1_000_000_000
NOISE = 0.02


def follow(carried: CarriedSun, begin: int, end: int, seen: bool, bias: FloatArray = BIAS) -> FloatArray:
    """Let seconds pass in a body that rolls about the Sun; return the true direction in body axes."""
    rng = np.random.default_rng(3)
    for second in range(begin, end):
        # The body turns about the Sun alone, so that its direction stays.
        rate = 2e-4 * SUN
        measured = rate + bias - carried.bias
        carried.turn(second * SECOND_NS, attitude_matrix(from_rotation_vector(measured)))
        if seen and second % 2 == 0:
            noisy = SUN + NOISE * rng.standard_normal(3)
            carried.see(second * SECOND_NS, noisy / np.linalg.norm(noisy))
    return SUN


def apart(carried: CarriedSun) -> float:
    """Return the angle, deg, between the carried Sun and the true one."""
    assert carried.direction is not None
    return float(np.degrees(np.arccos(np.clip(carried.direction @ SUN, -1.0, 1.0))))


def test_the_drift_of_the_sun_shows_the_bias_so_that_an_eclipse_is_bridged() -> None:
    carried = CarriedSun()
    follow(carried, 0, 1000, seen=True)
    assert np.linalg.norm(np.cross(SUN, carried.bias - BIAS)) < 1e-4
    follow(carried, 1000, 3100, seen=False)
    assert apart(carried) < 15.0
    blind = CarriedSun()
    blind.see(999 * SECOND_NS, SUN)
    for second in range(1000, 3100):
        blind.turn(second * SECOND_NS, attitude_matrix(from_rotation_vector(2e-4 * SUN + BIAS)))
    assert apart(blind) > 60.0, "without the bias it would be carried away"


def test_a_sun_is_forgotten_after_the_longest_eclipse() -> None:
    carried = CarriedSun()
    carried.see(0, SUN)
    for second in range(int(MEMORY) + 1):
        carried.turn(second * SECOND_NS, np.eye(3))
    assert carried.direction == pytest.approx(SUN)
    carried.turn(int(MEMORY + 1.0) * SECOND_NS, np.eye(3))
    assert carried.direction is None


def test_while_nobody_carries_it_no_bias_is_learned_and_an_old_direction_is_not_taken_up() -> None:
    """In other modes than SAFE the strings are read, too, but the body turns unheard."""
    carried = CarriedSun()
    for second in range(100):
        carried.see(second * SECOND_NS, attitude_matrix(from_rotation_vector(second * BIAS)) @ SUN)
    np.testing.assert_array_equal(carried.bias, np.zeros(3))
    carried.turn(101 * SECOND_NS, np.eye(3))
    assert carried.direction is not None
    carried.turn(110 * SECOND_NS, np.eye(3))
    assert carried.direction is None


def test_a_sun_far_from_the_carried_one_replaces_it_and_shows_no_bias() -> None:
    carried = CarriedSun()
    carried.see(0, SUN)
    carried.turn(SECOND_NS, np.eye(3))
    for other in (-SUN, np.array([0.8, 0.6, 0.0])):
        carried.see(SECOND_NS, other)
        assert carried.direction == pytest.approx(other)
    np.testing.assert_array_equal(carried.bias, np.zeros(3))


def test_no_bias_beyond_its_bound_is_believed() -> None:
    carried = CarriedSun()
    follow(carried, 0, 2000, seen=True, bias=20.0 * BIAS)
    assert np.abs(carried.bias).max() <= LARGEST_BIAS
