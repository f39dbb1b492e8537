"""Tests of initial orbits from artificial passes, against trajectories that scipy integrates."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from knightcube.astro.arrays import FloatArray
from knightcube.gnc import first_orbit as module
from knightcube.gnc.first_orbit import ArcError, Bearings, first_orbit, smoothed, trajectories

MU, RADIUS, J2 = 3.986004418e14, 6378136.6, 1.0826359e-3
LIGHT = 299792458.0
EARTH = np.array([12e3, -25e3, 9e3])
OBSERVER = np.array([6.9e6, 1e5, -2e5, 100.0, 3.4e3, 6.8e3])
OBJECT = OBSERVER + np.array([2.4e5, 1.5e5, 2.0e5, -300.0, 2.5e3, -1.5e3])
TIMES: FloatArray = np.linspace(100.0, 220.0, 9)
MIDDLE = 4
SIGMA = 1e-5


def flown(state: FloatArray, times: FloatArray, middle: int) -> FloatArray:
    """Return the states (n, 6) at `times` of a free fall that has the given state at `times[middle]`."""

    def slope(_: float, y: FloatArray) -> FloatArray:
        x, r2 = y[:3], float(y[:3] @ y[:3])
        polar = 1.0 - 5.0 * x[2] ** 2 / r2
        bulge = 1.5 * J2 * RADIUS**2 / r2 * np.array([polar, polar, polar + 2.0])
        return np.concatenate([y[3:], -MU / r2**1.5 * (1.0 + bulge) * x])

    def run(at: FloatArray) -> FloatArray:
        done = solve_ivp(slope, (at[0], at[-1]), state, "DOP853", at, rtol=1e-11, atol=1e-6)
        return np.asarray(done.y.T)

    ahead = run(times[middle:])
    return np.concatenate([run(times[middle::-1])[:0:-1], ahead]) if middle else ahead


def directions(state: FloatArray, observer: FloatArray) -> FloatArray:
    """Return the apparent directions (n, 3) of an object, with light time and without aberration."""
    states = flown(state, TIMES, MIDDLE)
    way = states[:, :3] - observer[:, :3]
    way = way - np.linalg.norm(way, axis=1)[:, None] / LIGHT * (states[:, 3:] + EARTH)
    return np.asarray(way / np.linalg.norm(way, axis=1)[:, None])


def bearings(state: FloatArray = OBJECT, sigma: float = SIGMA) -> Bearings:
    observer = flown(OBSERVER, TIMES, MIDDLE)
    return Bearings(TIMES, directions(state, observer), np.full(len(TIMES), sigma), observer, EARTH)


def slope_of(function: Callable[[FloatArray], FloatArray], state: FloatArray) -> FloatArray:
    """Return the derivative (n, 6) of a function of a state by central differences."""
    steps = np.diag([10.0, 10.0, 10.0, 0.01, 0.01, 0.01])
    parts = [(function(state + step) - function(state - step)).ravel() / (2.0 * step.sum()) for step in steps]
    return np.stack(parts, axis=1)


def test_the_integration_is_that_of_scipy_with_the_oblate_earth() -> None:
    times = np.array([0.0, 3.0, 61.0, 400.0])
    found = trajectories(np.stack([OBJECT, OBSERVER]), times)
    assert found.shape == (4, 2, 6)
    for k, start in enumerate((OBJECT, OBSERVER)):
        off = found[:, k] - flown(start, times, 0)
        assert np.abs(off[:, :3]).max() < 0.01
        assert np.abs(off[:, 3:]).max() < 1e-4
    back = trajectories(found[-1], times[::-1])
    np.testing.assert_allclose(back[-1], [OBJECT, OBSERVER], rtol=0.0, atol=1.0)


def test_inside_the_earth_the_acceleration_is_bounded() -> None:
    deep = np.array([[1e5, 0.0, 0.0, 0.0, 0.0, 0.0]])
    acceleration = module._derivative(deep)[0, 3:]
    assert abs(acceleration[0]) == pytest.approx(MU / (0.5 * RADIUS) ** 3 * 1e5 * (1.0 + 6.0 * J2), rel=1e-6)


def test_the_orbit_of_a_long_arc_is_found_with_its_uncertainty() -> None:
    seen = bearings()
    found = first_orbit(seen)
    truth = OBJECT - OBSERVER
    assert found.time == TIMES[MIDDLE]
    assert found.distance == pytest.approx(float(np.linalg.norm(truth[:3])), rel=1e-4)
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(found.state - OBJECT) < 0.05 * sigma)
    assert found.lasts
    assert found.chi_square == pytest.approx(0.0, abs=1e-2)
    assert found.degrees == 2 * len(TIMES) - 6
    low, high = found.interval
    assert low < found.distance < high < module.RATIO * low

    def scaled(state: FloatArray) -> FloatArray:
        return directions(state, seen.observer) / SIGMA

    jacobian = slope_of(scaled, OBJECT)
    size = np.linalg.norm(jacobian, axis=0)
    expected = np.linalg.inv((jacobian / size).T @ (jacobian / size)) / np.outer(size, size)
    np.testing.assert_allclose(sigma, np.sqrt(np.diag(expected)), rtol=0.02)
    correlation = found.covariance / np.outer(sigma, sigma)
    np.testing.assert_allclose(correlation, expected / np.outer(*[np.sqrt(np.diag(expected))] * 2), atol=0.02)
    along = truth[:3] / np.linalg.norm(truth[:3])
    of_distance = math.sqrt(float(along @ found.covariance[:3, :3] @ along))
    assert 0.5 * (high - low) == pytest.approx(math.sqrt(3.841) * of_distance, rel=0.05)


def test_too_few_sightings_are_refused() -> None:
    seen = bearings()
    few = Bearings(TIMES[:5], seen.directions[:5], seen.sigma[:5], seen.observer[:5], EARTH)
    with pytest.raises(ArcError, match=r"5 sightings.*6"):
        first_orbit(few)


def test_an_arc_that_leaves_the_distance_open_is_refused_with_its_interval() -> None:
    with pytest.raises(ArcError, match=r"arc of 120 s .* km .*1\.5"):
        first_orbit(bearings(sigma=1e-3))


def test_directions_that_no_free_fall_explains_are_refused() -> None:
    seen = bearings()
    bent = seen.directions.copy()
    bent[::2] += 1.2e-4 * np.array([0.3, -0.2, 0.9])
    bent /= np.linalg.norm(bent, axis=1)[:, None]
    with pytest.raises(ArcError, match=r"chi-square \d+ with 12 degrees"):
        first_orbit(Bearings(TIMES, bent, seen.sigma, seen.observer, EARTH))


def test_an_object_that_leaves_the_earth_has_no_orbit() -> None:
    fast = OBJECT.copy()
    fast[3:] *= 12e3 / np.linalg.norm(fast[3:])
    with pytest.raises(ArcError, match=r"every orbit at a distance of \d.* km"):
        first_orbit(bearings(fast))


@pytest.mark.parametrize(
    ("perigee", "apogee", "lasts"), [(80.5e3, 900e3, True), (79.5e3, 900e3, False), (300e3, 4e7, True)]
)
def test_a_lasting_orbit_has_its_perigee_above_80_km(perigee: float, apogee: float, lasts: bool) -> None:
    near, far = RADIUS + perigee, RADIUS + apogee
    speed = math.sqrt(2.0 * MU * far / (near * (near + far)))
    observer = np.zeros((9, 6))
    observer[:, 0] = near - 1e5
    fit = module._ArcFit(
        Bearings(TIMES, np.tile([1.0, 0.0, 0.0], (9, 1)), np.full(9, SIGMA), observer, EARTH)
    )
    unknowns = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, math.log(1e5)]])
    axes = fit.states(np.array([[0.0, 0.0, 1e-5, 0.0, 0.0, math.log(1e5)]]))[0, 3:]
    np.testing.assert_allclose(np.linalg.norm(axes), 1.0)
    unknowns[0, 2] = speed / 1e5
    assert fit.admissible(unknowns).tolist() == [lasts]


def test_the_interval_is_interpolated_to_the_bound_of_chi_square() -> None:
    logarithms = np.arange(6.0)
    chi_square = 10.0 + np.array([10.0, 5.0, 2.0, 0.0, 1.0, 3.0])
    inner, ends = module._within(logarithms, chi_square)
    assert inner == (2.0, 5.0)
    assert ends[0] == pytest.approx(2.0 - (3.841 - 2.0) / 3.0)
    assert ends[1] == 5.0, "the last point is not extrapolated"


def test_positions_are_smoothed_to_the_orbit_that_fits_them() -> None:
    sigma = np.linspace(5.0, 15.0, len(TIMES))
    exact = flown(OBSERVER, TIMES, MIDDLE)
    guess = exact.copy()
    guess[MIDDLE] += [3.0, -2.0, 1.0, 0.5, -0.5, 0.2]
    positions = guess.copy()
    positions[:, :3] = exact[:, :3]
    states, covariance = smoothed(TIMES, positions, sigma, MIDDLE)
    assert np.abs(states - exact)[:, :3].max() < 0.1
    assert np.abs(states - exact)[:, 3:].max() < 2e-3

    def scaled(state: FloatArray) -> FloatArray:
        return np.asarray(flown(state, TIMES, MIDDLE)[:, :3] / sigma[:, None])

    jacobian = slope_of(scaled, OBSERVER)
    size = np.linalg.norm(jacobian, axis=0)
    expected = np.linalg.inv((jacobian / size).T @ (jacobian / size)) / np.outer(size, size)
    np.testing.assert_allclose(covariance, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())
    np.testing.assert_allclose(np.diag(covariance), np.diag(expected), rtol=1e-3)
