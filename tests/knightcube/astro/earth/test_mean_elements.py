"""Tests of elements that are fitted to positions by SGP4 and by another orbit model."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.mean_elements import distances, fit_elements
from knightcube.astro.earth.orbit_knowledge import TwoLineElements
from knightcube.errors import UsageError
from sim_hal.settings import OrbitSection
from sim_hal.worlds.orbit import elements, julian_date, propagate

DATE = julian_date("2026-03-20T12:00:00Z")
LINES = (
    "1 99999U 26001A   26079.50000000  .00000000  00000-0  00000+0 0    05",
    "2 99999  97.4640 337.4170 0011973 295.7805  64.3547 15.24067411    09",
)


def test_the_elements_of_sgp4_positions_are_found_again() -> None:
    known = TwoLineElements(*LINES)
    dates = DATE + np.arange(0.0, 3.0, 0.004)
    made = fit_elements(dates, np.array([known.at(date).position for date in dates]))
    assert made.lines[0] == LINES[0]
    found, true = (np.array(lines[1].split()[2:7], dtype=float) for lines in (made.lines, LINES))
    np.testing.assert_allclose(found[[0, 1]], true[[0, 1]], atol=2e-4)
    assert float(made.lines[1][52:63]) == pytest.approx(float(LINES[1][52:63]), abs=2e-7)
    assert made.residuals.max() < 40.0
    np.testing.assert_array_equal(made.residuals, distances(made.lines, dates, _positions(known, dates)))


def _positions(known: TwoLineElements, dates: FloatArray) -> FloatArray:
    return np.array([known.at(float(date)).position for date in dates])


@pytest.mark.parametrize(
    "orbit",
    [
        OrbitSection(altitude=420e3, inclination_deg=51.6),
        OrbitSection(altitude=900e3, inclination_deg=10.0, eccentricity=0.1, true_anomaly_deg=200.0),
        OrbitSection(altitude=500e3, inclination_deg=0.0),
        OrbitSection(altitude=500e3, inclination_deg=180.0, eccentricity=0.0),
    ],
)
def test_an_orbit_with_oblateness_is_fitted_to_a_kilometre_over_a_day(orbit: OrbitSection) -> None:
    times = np.arange(0.0, 86_400.0, 600.0)
    positions = propagate(elements(orbit, DATE), 86_400.0).positions_at(times)
    assert fit_elements(DATE + times / 86_400.0, positions).residuals.max() < 2e3


def test_elements_of_a_short_arc_state_their_error_a_day_later() -> None:
    """A day later, elements from ten minutes of fixes have errors of at most a few stated deviations."""
    known, rng = TwoLineElements(*LINES), np.random.default_rng(4)
    dates = DATE + np.arange(0.0, 600.0, 10.0) / 86_400.0
    states = [known.at(float(date)) for date in dates]
    positions = np.array([state.position for state in states]) + rng.normal(0.0, 5.0, (60, 3))
    velocities = np.array([state.velocity for state in states]) + rng.normal(0.0, 0.05, (60, 3))
    made, without = fit_elements(dates, positions, velocities), fit_elements(dates, positions)
    # The residual consists of 8.7 m of noise, and of 12 m that are due to angles with a resolution of 1e-4
    # deg in the columns.
    assert 7.0 < made.rms < 14.0
    for fitted in (made, without):
        later = TwoLineElements(*fitted.lines).at(DATE + 1.0).position
        error = float(np.linalg.norm(later - known.at(DATE + 1.0).position))
        assert 0.1 * fitted.growth < error < 3.0 * fitted.growth
    assert 600.0 < made.growth < without.growth < 1500.0


def test_the_fit_to_noisy_positions_close_together_converges() -> None:
    known, rng = TwoLineElements(*LINES), np.random.default_rng(4)
    dates = DATE + np.arange(0.0, 1800.0, 10.0) / 86_400.0
    positions = _positions(known, dates)
    for _ in range(12):
        noisy = positions + rng.normal(0.0, 5.0, positions.shape)
        assert fit_elements(dates, noisy).rms < 20.0


def test_two_fixes_with_velocities_determine_elements() -> None:
    known = TwoLineElements(*LINES)
    dates = DATE + np.array([0.0, 20.0]) / 1440.0
    states = [known.at(float(date)) for date in dates]
    made = fit_elements(
        dates, np.array([one.position for one in states]), np.array([one.velocity for one in states])
    )
    assert made.residuals.max() < 100.0
    with pytest.raises(UsageError, match="elements need at least 2 fixes with velocities; given: 1"):
        fit_elements(dates[:1], np.zeros((1, 3)), np.zeros((1, 3)))


def test_fixes_from_just_before_the_end_of_a_year_determine_elements() -> None:
    known = TwoLineElements(*LINES)
    start = julian_date("2027-01-01T00:00:00Z") - 2e-4 / 86_400.0
    dates = start + np.array([0.0, 20.0]) / 1440.0
    states = [known.at(float(date) - start + DATE) for date in dates]
    positions = np.array([one.position for one in states])
    made = fit_elements(dates, positions, np.array([one.velocity for one in states]))
    assert made.lines[0][18:32] == "27001.00000000"
    assert made.residuals.max() < 100.0


def test_false_fixes_are_rejected() -> None:
    known = TwoLineElements(*LINES)
    dates = DATE + np.arange(0.0, 0.5, 0.004)
    positions = _positions(known, dates)
    false = [7, 50, 51, 120]
    positions[false] += np.array([[3e4, 0.0, 0.0], [0.0, 2e5, 0.0], [1e6, 1e6, 0.0], [0.0, 0.0, -6e3]])
    made = fit_elements(dates, positions)
    assert list(np.flatnonzero(~made.used)) == false
    assert made.rms < 40.0


def test_positions_without_an_orbit_are_refused() -> None:
    positions = _positions(TwoLineElements(*LINES), DATE + np.arange(4) / 1440.0)
    with pytest.raises(UsageError, match="elements need at least 4 positions; given: 3"):
        fit_elements(DATE + np.arange(3) / 1440.0, positions[:3])
    with pytest.raises(UsageError, match="their times must ascend"):
        fit_elements(np.full(4, DATE), positions)
    with pytest.raises(UsageError, match="define no orbital plane"):
        fit_elements(DATE + np.arange(4) / 1440.0, np.ones((4, 3)) * 7e6)
    with pytest.raises(UsageError, match="define no orbital plane"):
        fit_elements(DATE + np.arange(4) / 1440.0, np.zeros((4, 3)))
    with pytest.raises(UsageError, match="no elements fit the positions, which must be in m: "):
        fit_elements(DATE + np.arange(4) / 1440.0, 1e-3 * positions)
