"""Elements that are fitted to positions of SGP4 itself, and to an orbit of another model."""

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


def test_positions_without_an_orbit_are_refused() -> None:
    positions = _positions(TwoLineElements(*LINES), DATE + np.arange(4) / 1440.0)
    with pytest.raises(UsageError, match="3 positions: elements need at least four"):
        fit_elements(DATE + np.arange(3) / 1440.0, positions[:3])
    with pytest.raises(UsageError, match="their times must ascend"):
        fit_elements(np.full(4, DATE), positions)
    with pytest.raises(UsageError, match="define no orbital plane"):
        fit_elements(DATE + np.arange(4) / 1440.0, np.ones((4, 3)) * 7e6)
