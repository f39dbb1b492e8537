"""Tests of the public functions of Sun, field, eclipse and orbit against independent computations."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import erfa
import numpy as np
import pytest
from sgp4.api import Satrec

from knightcube.astro.almanac import (
    apparent_sun,
    magnetic_field,
    magnetic_field_on_ground,
    orbit_state,
    propagate_elements,
    propagate_orbit,
    sun_direction,
    sunlit_fraction,
)
from knightcube.astro.arrays import FloatArray, finite_array, unit_vector
from knightcube.astro.earth.figure import EARTH_RADIUS, GRAVITATIONAL_PARAMETER, J2
from knightcube.astro.earth.geomagnetism import GeomagneticError
from knightcube.astro.earth.orbit_knowledge import (
    LARGEST_SIGMA,
    OrbitError,
    TwoLineElements,
    propagated,
)
from knightcube.astro.earth.orientation import celestial_to_terrestrial, terrestrial_time
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, julian_date
from knightcube.errors import ArgumentError, UsageError
from sim_hal.worlds.orbit import sun_position

TIME = datetime(2026, 11, 26, 12, 0, tzinfo=UTC)
FIRST = "1 25544U 98067A   25320.50000000  .00010000  00000-0  18000-3 0  9990"
SECOND = "2 25544  51.6400 200.0000 0005000 100.0000 260.0000 15.50000000539990"


def test_the_sun_agrees_with_the_almanac_and_is_displaced_by_aberration() -> None:
    """The Sun direction agrees with an almanac of 42" accuracy, and includes the aberration of 5.2".

    The almanac is that of the simulator. The satellite's own velocity of 7.6 km/s causes the aberration.
    """
    for date in np.linspace(2_460_700.5, 2_462_400.5, 40):
        apparent, distance = apparent_sun(date, np.zeros(3), np.zeros(3))
        almanac = sun_position(terrestrial_time(date))
        assert (
            np.degrees(np.linalg.norm(np.cross(apparent, almanac / np.linalg.norm(almanac)))) < 45.0 / 3600.0
        )
        assert distance == pytest.approx(float(np.linalg.norm(almanac)), rel=1e-4)
    across = np.cross(apparent, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    leant, _ = apparent_sun(date, np.zeros(3), 7.6e3 * across)
    assert (leant - apparent) @ across == pytest.approx(7.6e3 / 299_792_458.0, rel=1e-3)


def test_the_suns_direction_is_that_of_the_almanac() -> None:
    almanac = sun_position(terrestrial_time(julian_date(TIME)))
    direction = sun_direction(TIME)
    assert np.linalg.norm(direction) == pytest.approx(1.0, abs=1e-12)
    assert direction @ almanac == pytest.approx(np.linalg.norm(almanac), rel=1e-7)
    # An observer that is displaced by a thousandth of the Sun's distance, normal to the Sun direction,
    # measures the parallax.
    across = np.cross(direction, [0.0, 0.0, 1.0])
    moved = sun_direction(TIME, 1e-3 * ASTRONOMICAL_UNIT * across / np.linalg.norm(across))
    assert np.linalg.norm(moved - direction) == pytest.approx(1e-3, rel=0.05)


def test_the_field_in_orbit_and_on_the_ground_are_one_field() -> None:
    latitude, longitude, height = 0.7, -1.2, 500e3
    ground = magnetic_field_on_ground(TIME, latitude=latitude, longitude=longitude, height=height)
    in_itrs = erfa.gd2gc(1, longitude, latitude, height)
    orbit = magnetic_field(TIME, in_itrs @ celestial_to_terrestrial(julian_date(TIME)))
    assert np.linalg.norm(orbit) == pytest.approx(np.linalg.norm(ground), rel=1e-9)
    assert 2e-5 < np.linalg.norm(orbit) < 6e-5
    with pytest.raises(GeomagneticError, match="2025"):
        magnetic_field(datetime(2031, 1, 1, tzinfo=UTC), (7e6, 0.0, 0.0))


def test_the_earth_hides_a_sun_behind_it_and_not_in_front_of_it() -> None:
    towards = sun_direction(TIME)
    side = np.cross(towards, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    positions = 7e6 * np.array([towards, -towards, side])
    np.testing.assert_array_equal(sunlit_fraction(TIME, positions), [1.0, 0.0, 1.0])
    edge = np.sqrt(1.0 - (EARTH_RADIUS / 7e6) ** 2)
    at_edge = 7e6 * (EARTH_RADIUS / 7e6 * side - edge * towards)
    assert 0.2 < sunlit_fraction(TIME, at_edge) < 0.8
    assert sunlit_fraction(TIME, at_edge, "cylindrical") in (0.0, 1.0)
    with pytest.raises(ArgumentError, match="conical or cylindrical"):
        sunlit_fraction(TIME, at_edge, "round")  # type: ignore[arg-type]


def test_kepler_elements_give_energy_momentum_and_apsides() -> None:
    elements = {
        "semi_major_axis": 7e6, "eccentricity": 0.02, "inclination": 1.2, "ascending_node": 0.5,
        "argument_of_perigee": 0.8,
    }  # fmt: skip
    position, velocity = orbit_state(**elements, true_anomaly=0.9)
    energy = 0.5 * velocity @ velocity - GRAVITATIONAL_PARAMETER / np.linalg.norm(position)
    assert energy == pytest.approx(-GRAVITATIONAL_PARAMETER / 14e6, rel=1e-12)
    momentum = np.cross(position, velocity)
    assert momentum[2] / np.linalg.norm(momentum) == pytest.approx(np.cos(1.2), rel=1e-12)
    assert np.arctan2(momentum[0], -momentum[1]) == pytest.approx(0.5)
    perigee, fastest = orbit_state(**elements)
    assert np.linalg.norm(perigee) == pytest.approx(7e6 * 0.98)
    assert perigee @ fastest == pytest.approx(0.0, abs=1.0)
    assert perigee[2] == pytest.approx(7e6 * 0.98 * np.sin(0.8) * np.sin(1.2))
    assert fastest[2] > 0.0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"eccentricity": 1.0}, "eccentricity"),
        ({"semi_major_axis": 6e6}, "perigee"),
        ({"inclination": float("nan")}, "inclination: nan: .* finite"),
        ({"inclination": 97.4}, "inclination: 97.4: give 0 to 3.142 rad; math.radians converts degrees"),
        ({"inclination": -0.1}, "inclination: -0.1: give 0 to 3.142 rad"),
        ({"ascending_node": 337.4}, "ascending_node: 337.4: give -6.283 to 6.283 rad"),
        ({"semi_major_axis": 7e3}, "7000 m from the Earth's centre: .* in metres"),
    ],
)
def test_elements_of_no_orbit_are_refused(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        orbit_state(**{"semi_major_axis": 7e6, "inclination": 1.0, **wrong})


PLACE, MOTION = np.array([7e6, 0.0, 0.0]), np.array([0.0, 7.5e3, 0.0])
NONE = [float("nan")] * 3


@pytest.mark.parametrize(
    ("call", "reason"),
    [
        (lambda: magnetic_field(TIME, NONE), "position: .* give finite"),
        (lambda: magnetic_field(TIME, [0.0, 0.0, 0.0]), "position: 0 m from the Earth's centre"),
        (lambda: magnetic_field(TIME, 1e-3 * PLACE), "7000 m .*: give metres, not kilometres"),
        (
            lambda: magnetic_field(TIME, [PLACE, PLACE]),
            r"shape \(2, 3\): give finite numbers of shape",
        ),
        (lambda: magnetic_field("2026-11-26", PLACE), "'2026-11-26': give a datetime"),  # type: ignore[arg-type]
        (lambda: magnetic_field(TIME, 1e6 * PLACE), "7e.12 m from the Earth's centre: .* valid up to"),
        (
            lambda: magnetic_field(TIME, np.ma.masked_array(PLACE, [False, True, False])),
            "position: 1 masked elements: replace them",
        ),
        (lambda: magnetic_field(TIME, 1j * PLACE), "position: .* give finite numbers"),
        (lambda: magnetic_field(datetime(2024, 12, 31, tzinfo=UTC), PLACE), "year 2024.99.*: WMM2025"),
        (
            lambda: magnetic_field_on_ground(TIME, latitude=0.9, longitude=13.4),
            "longitude: 13.4: give -6.283 to 6.283 rad; math.radians converts degrees",
        ),
        (
            lambda: magnetic_field_on_ground(TIME, latitude=0.9, longitude=0.2, height=1e9),
            "1.006e.09 m from the Earth's centre: the model is valid up to 6.378e.07 m",
        ),
        (lambda: sun_direction(datetime(1899, 12, 31)), "time: 1899-12-31.*: give a time from 1900 to 2099"),
        (lambda: sunlit_fraction(datetime(2100, 1, 1), PLACE), "time: 2100-01-01.*: give a time"),
        (lambda: propagate_orbit(PLACE, MOTION, [1e9]), "seconds: 1e.09 s from the state: .* a newer state"),
        (lambda: propagate_orbit(PLACE, MOTION, [[1.0]]), r"seconds: an array of shape \(1, 1\)"),
        (lambda: sunlit_fraction(TIME, NONE), "position: .* give finite"),
        (lambda: sunlit_fraction(TIME, [0.0, 0.0, 0.0]), "position: 0 m"),
        (lambda: sunlit_fraction(TIME, [PLACE, 1e-3 * PLACE]), "7000 m .*: give metres"),
        (lambda: sunlit_fraction(TIME, [7e6, 0.0]), r"shape \(2,\): give three components"),
        (lambda: sun_direction(TIME, NONE), "position: .* give finite"),
        (lambda: sun_direction(TIME, 1e-3 * PLACE), "give metres"),
        (lambda: sun_direction(TIME, PLACE, NONE), "velocity: .* give finite"),
        (lambda: propagate_orbit(NONE, MOTION, [1.0]), "position: .* give finite"),
        (lambda: propagate_orbit(PLACE, NONE, [1.0]), "velocity: .* give finite"),
        (lambda: propagate_orbit(1e-3 * PLACE, 1e-3 * MOTION, [1.0]), "give metres"),
        (lambda: propagate_orbit(PLACE, 1e-3 * MOTION, [1.0]), "perigee 3 m from .* velocity in m/s"),
        (lambda: propagate_orbit(PLACE, 1e200 * MOTION, [1.0]), "velocity: .* give at most 20000 m/s"),
        (lambda: propagate_orbit(1e100 * PLACE, MOTION, [1.0]), "position: .* give at most 1.5e.09 m"),
        (lambda: propagate_orbit(PLACE, MOTION, [float("nan")]), "seconds: .* give finite"),
        (lambda: propagate_orbit("here", MOTION, [1.0]), "position: 'here': give finite numbers"),
        (lambda: propagate_elements(FIRST, [TIME]), "elements: '1 25544U.* give the two lines"),  # type: ignore[arg-type]
        (lambda: unit_vector("axis", [0.0, 0.0, 0.0]), "axis: .* whose length is not zero"),
    ],
)
def test_wrong_positions_velocities_and_times_are_refused(call: Any, reason: str) -> None:
    """Values that are not finite or have another unit raise an error instead of giving a wrong result."""
    with pytest.raises((ArgumentError, GeomagneticError), match=reason):
        call()


def test_positions_on_the_ground_and_far_away_are_accepted() -> None:
    """The lower limit of positions is below every point of the Earth's surface, and no limit is above."""
    pole = [0.0, 0.0, 6_356_752.0]
    assert 5e-5 < np.linalg.norm(magnetic_field(TIME, pole)) < 7e-5
    assert sunlit_fraction(TIME, np.zeros((0, 3))).shape == (0,)
    assert sunlit_fraction(TIME, 4e8 * sun_direction(TIME)) == 1.0
    away, _ = propagate_orbit(PLACE, [0.0, 12e3, 0.0], [1e4])  # a hyperbola, whose perigee is its start
    assert np.linalg.norm(away[0]) > 5e7


def test_directions_are_normalised_and_unit_vectors_stay_unchanged() -> None:
    unit = np.array([0.36, 0.48, 0.8])
    np.testing.assert_array_equal(unit_vector("axis", unit), unit)
    np.testing.assert_allclose(unit_vector("axis", 3.0 * unit), unit, rtol=1e-15)
    assert finite_array("size", 2).shape == ()


def test_a_field_on_the_ground_needs_a_latitude_in_rad_and_a_height_above_the_depths_of_the_sea() -> None:
    for wrong in ({"latitude": 45.0}, {"latitude": 0.5, "height": float("nan")}, {"latitude": float("nan")}):
        with pytest.raises(GeomagneticError, match=r"invalid position.* a latitude of at most pi/2 rad"):
            magnetic_field_on_ground(TIME, longitude=0.0, **wrong)
    with pytest.raises(GeomagneticError, match=r"height -7e\+06 m: must be above -12000 m"):
        magnetic_field_on_ground(TIME, latitude=0.5, longitude=0.0, height=-7e6)
    assert np.isfinite(magnetic_field_on_ground(TIME, latitude=0.2, longitude=2.5, height=-1.1e4)).all()


@pytest.mark.parametrize("year", [1990, 2024, 2026, 2060])
def test_elements_far_from_their_epoch_give_no_orbit(year: int) -> None:
    """The elements of a low orbit do not give the position months before or after their epoch."""
    reason = f"the elements of 2025-11-16 do not give the orbit on {year}-12-01: .* exceeds 1000 km"
    with pytest.raises(OrbitError, match=reason):
        propagate_elements((FIRST, SECOND), [datetime(year, 12, 1)])


def test_elements_are_accepted_until_their_standard_deviation_reaches_its_limit() -> None:
    """Elements of an orbit at 420 km are accepted for two weeks before and after their epoch."""
    epoch, elements = datetime(2025, 11, 16, 12), TwoLineElements(FIRST, SECOND)
    days = next(d for d in range(1, 99) if elements.at(elements.epoch + d).sigma > LARGEST_SIGMA)
    assert 10 < days < 20
    times = [epoch + timedelta(days=sign * (days - 1)) for sign in (-1, 1)]
    assert propagate_elements((FIRST, SECOND), times)[0].shape == (2, 3)
    with pytest.raises(OrbitError, match=f"{days} days from the epoch: use elements near this date"):
        propagate_elements((FIRST, SECOND), [epoch + timedelta(days=days)])


def test_a_propagated_orbit_precesses_by_the_oblateness_and_returns() -> None:
    position, velocity = orbit_state(semi_major_axis=7e6, inclination=np.radians(98.0))
    period = 2.0 * np.pi * np.sqrt(7e6**3 / GRAVITATIONAL_PARAMETER)
    times = np.array([0.0, 10.0 * period])
    positions, velocities = propagate_orbit(position, velocity, times)
    np.testing.assert_array_equal(positions[0], position)
    before, after = (np.cross(positions[k], velocities[k]) for k in range(2))
    node = np.arctan2(after[0], -after[1]) - np.arctan2(before[0], -before[1])
    precession = -1.5 * J2 * (EARTH_RADIUS / 7e6) ** 2 * np.cos(np.radians(98.0)) * 20.0 * np.pi
    assert node == pytest.approx(precession, rel=0.01)
    back, _ = propagate_orbit(positions[1], velocities[1], [-10.0 * period])
    assert np.linalg.norm(back[0] - position) < 100.0


def test_two_line_elements_are_those_of_sgp4() -> None:
    times = [datetime(2025, 11, 16, 12, 0, tzinfo=UTC) + timedelta(minutes=20 * k) for k in range(3)]
    positions, velocities = propagate_elements((FIRST, SECOND), times)
    satellite = Satrec.twoline2rv(FIRST, SECOND)
    for time, position, velocity in zip(times, positions, velocities, strict=True):
        _, r, v = satellite.sgp4(julian_date(time), 0.0)
        assert np.linalg.norm(position) == pytest.approx(1e3 * np.linalg.norm(r), rel=1e-7)
        assert np.linalg.norm(velocity) == pytest.approx(1e3 * np.linalg.norm(v), rel=1e-7)
        assert position @ velocity == pytest.approx(1e6 * np.dot(r, v), abs=1e5)
    empty, _ = propagate_elements((FIRST, SECOND), [])
    assert empty.shape == (0, 3)


def test_an_orbit_at_times_in_any_order_is_integrated_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The integration goes through the times in increasing order, instead of back and forth."""
    times = np.array([5000.0, -3000.0, 0.0, 9000.0, -100.0, 5000.0])
    lengths: list[float] = []

    def counted(state: FloatArray, duration: float) -> FloatArray:
        lengths.append(abs(duration))
        return propagated(state, duration)

    monkeypatch.setattr("knightcube.astro.almanac.propagated", counted)
    positions, velocities = propagate_orbit(PLACE, MOTION, times)
    assert sum(lengths) == pytest.approx(12_000.0)
    for time, position, velocity in zip(times, positions, velocities, strict=True):
        (alone,), (moving,) = propagate_orbit(PLACE, MOTION, [time])
        np.testing.assert_allclose(position, alone, atol=5.0)
        np.testing.assert_allclose(velocity, moving, atol=5e-3)
