"""Tests that predicted passes and eclipses agree with the project's model of orbit, Earth and Sun."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from ground.passes import OrbitPrediction, Pass, Station, read_stations, scheduled_targets, station_of
from knightcube.astro.earth.figure import semi_axes
from knightcube.astro.earth.orbit_knowledge import TwoLineElements
from knightcube.astro.earth.orientation import celestial_to_terrestrial, north_east_down, terrestrial_time
from knightcube.astro.earth.sun import earth_from_sun, julian_date, sunlit_share
from knightcube.errors import UsageError
from knightcube.gnc.guidance.pointing_target import Goal
from tests.support.orbit_elements import POLAR_ORBIT, summed

BEGIN = datetime(2026, 3, 20, 12, tzinfo=UTC)
BERLIN = Station(name="Berlin", latitude_deg=52.5, longitude_deg=13.4, height=40.0)
EPOCH = "1 99999U 26001A   26079.50000000  .00000000  00000-0  00000+0 0    0"
GEOSTATIONARY, NAVIGATION = (
    (summed(EPOCH + "0"), summed("2 99999   0.0100  50.0000 0002000 100.0000 100.0000  1.00270000    00")),
    (summed(EPOCH + "0"), summed("2 99999  55.0000  50.0000 0002000 100.0000 100.0000  2.00560000    00")),
)
STATIONS = (BERLIN, Station(name="Tromso", latitude_deg=69.66, longitude_deg=18.94, mask_deg=12.0))


@pytest.fixture(scope="module")
def prediction() -> OrbitPrediction:
    """Return a day of a satellite in a polar orbit."""
    return OrbitPrediction(POLAR_ORBIT, BEGIN, 1.0)


def seen(station: Station, at: datetime) -> tuple[float, float, float]:
    """Return elevation (deg), azimuth (deg) and distance (m) of the satellite for a ground station."""
    date = julian_date(at)
    satellite = celestial_to_terrestrial(date) @ TwoLineElements(*POLAR_ORBIT).at(date).position
    latitude, longitude = math.radians(station.latitude_deg), math.radians(station.longitude_deg)
    equatorial, _, polar = semi_axes()
    squared = 1.0 - (polar / equatorial) ** 2
    normal = equatorial / math.sqrt(1.0 - squared * math.sin(latitude) ** 2)
    across = (normal + station.height) * math.cos(latitude)
    up = (normal * (1.0 - squared) + station.height) * math.sin(latitude)
    place = np.array([across * math.cos(longitude), across * math.sin(longitude), up])
    north, east, down = north_east_down(longitude, latitude) @ (satellite - place)
    elevation = math.degrees(math.atan2(-down, math.hypot(north, east)))
    return elevation, math.degrees(math.atan2(east, north)) % 360.0, math.sqrt(north**2 + east**2 + down**2)


def test_positions_agree_with_the_exact_nutation_within_a_decimetre(prediction: OrbitPrediction) -> None:
    times = prediction._scale.from_datetimes(prediction._at[::400])
    exact = prediction._satellite.at(times).position.m.T
    assert np.abs(prediction._positions[::400] - exact).max() < 0.1


def test_a_pass_begins_and_ends_at_the_mask_and_culminates_between(prediction: OrbitPrediction) -> None:
    found = prediction.passes(STATIONS)
    assert {one.station.name for one in found} == {"Berlin", "Tromso"}
    for one in found:
        for at, azimuth in zip((one.rise, one.top, one.set), one.azimuths_deg, strict=True):
            elevation, own, distance = seen(one.station, at)
            expected = one.elevation_deg if at is one.top else one.station.mask_deg
            assert elevation == pytest.approx(expected, abs=0.02)
            # Azimuths are compared only below 80 deg of elevation, because they change quickly near the
            # zenith.
            if elevation < 80.0:
                assert (own - azimuth + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=0.1)
        assert distance > one.range
        assert seen(one.station, one.top)[2] == pytest.approx(one.range, abs=500.0)
        around = [seen(one.station, one.top + timedelta(seconds=shift))[0] for shift in (-5.0, 5.0)]
        assert max(around) <= one.elevation_deg + 1e-3


def test_every_pass_of_the_day_is_found(prediction: OrbitPrediction) -> None:
    found = prediction.passes((BERLIN,))
    for minute in np.arange(0.0, 1440.0, 0.5):
        at = BEGIN + timedelta(minutes=float(minute))
        elevation = seen(BERLIN, at)[0]
        if abs(elevation - BERLIN.mask_deg) > 0.1:
            assert any(one.rise < at < one.set for one in found) == (elevation > BERLIN.mask_deg), at


def test_a_pass_in_progress_at_the_start_is_whole(prediction: OrbitPrediction) -> None:
    first = prediction.passes((BERLIN,))[0]
    middle = first.rise + 0.5 * (first.set - first.rise)
    (same,) = OrbitPrediction(POLAR_ORBIT, middle, 0.01).passes((BERLIN,))
    assert abs((same.rise - first.rise).total_seconds()) < 0.5


def test_a_long_pass_in_progress_at_the_start_is_whole() -> None:
    first = OrbitPrediction(NAVIGATION, BEGIN, 1.0).passes((BERLIN,))[0]
    middle = first.rise + 0.5 * (first.set - first.rise)
    assert middle - first.rise > timedelta(hours=1)
    (same,) = OrbitPrediction(NAVIGATION, middle, 0.01).passes((BERLIN,))
    assert abs((same.rise - first.rise).total_seconds()) < 0.5


def test_a_station_at_which_a_geostationary_satellite_never_sets_is_refused() -> None:
    prediction = OrbitPrediction(GEOSTATIONARY, BEGIN, 1.0)
    assert prediction.passes((BERLIN,)) == []
    with pytest.raises(UsageError, match="station Denver: the satellite stays above 5 deg"):
        prediction.passes((Station(name="Denver", latitude_deg=39.0, longitude_deg=-105.0),))


def test_passes_of_an_unknown_revolution_are_refused() -> None:
    old = OrbitPrediction(POLAR_ORBIT, BEGIN + timedelta(days=200), 0.1)
    with pytest.raises(UsageError, match=r"2026-03-20 are too old: .* give newer elements"):
        old.passes((BERLIN,))


def _pass(rise: float, end: float, longitude: float) -> Pass:
    """Return a pass over a station at a longitude (deg), from `rise` to `end` (s after BEGIN)."""
    station = Station(name="station", latitude_deg=0.0, longitude_deg=longitude)
    at = [BEGIN + timedelta(seconds=seconds) for seconds in (rise, 0.5 * (rise + end), end)]
    return Pass(station, at[0], at[1], at[2], (0.0, 0.0, 0.0), 50.0, 6e5, 1.0, 0.0)


@pytest.mark.parametrize(
    ("spans", "expected"),
    [
        ([(500, 900), (2000, 2400)], [(380, 900), (1880, 2400)]),
        ([(500, 900), (960, 1400)], [(380, 900), (901, 1400)]),
        ([(500, 900), (600, 1000)], [(380, 900), (901, 1000)]),
        ([(500, 900), (600, 800), (850, 1300)], [(380, 900), None, (901, 1300)]),
    ],
)
def test_overlapping_passes_follow_each_other(
    spans: list[tuple[float, float]], expected: list[tuple[float, float] | None]
) -> None:
    passes = [_pass(*span, longitude=10.0 * number) for number, span in enumerate(spans)]
    for one, commands, times in zip(passes, scheduled_targets(passes), expected, strict=True):
        assert [(at - BEGIN).total_seconds() for at, _ in commands] == list(times or ())
        if times is not None:
            (_, station), (_, nadir) = commands
            assert math.degrees(station.numbers[1]) == pytest.approx(one.station.longitude_deg)
            assert nadir.goal is Goal.NADIR


def test_no_command_is_due_before_it_can_be_sent() -> None:
    passes = [_pass(*span, longitude=0.0) for span in ((-300, 40), (-20, 500), (600, 900))]
    made = scheduled_targets(passes, earliest=BEGIN + timedelta(seconds=60))
    assert [[(at - BEGIN).total_seconds() for at, _ in one] for one in made] == [[], [60, 500], [501, 900]]


def test_the_sun_at_satellite_and_station_is_that_of_the_ephemeris(prediction: OrbitPrediction) -> None:
    for one in prediction.passes(STATIONS):
        date = julian_date(one.top)
        sun = -earth_from_sun(float(terrestrial_time(date)))[0]
        position = TwoLineElements(*POLAR_ORBIT).at(date).position
        assert one.sunlit == pytest.approx(float(sunlit_share(position, sun)), abs=0.05)
        latitude, longitude = math.radians(one.station.latitude_deg), math.radians(one.station.longitude_deg)
        down = north_east_down(longitude, latitude)[2] @ celestial_to_terrestrial(date) @ sun
        expected = math.degrees(math.asin(-down / float(np.linalg.norm(sun))))
        assert one.sun_elevation_deg == pytest.approx(expected, abs=0.01)


def test_eclipses_begin_and_end_where_half_of_the_sun_is_visible(prediction: OrbitPrediction) -> None:
    eclipses = prediction.eclipses()
    assert 14 <= len(eclipses) <= 16
    elements = TwoLineElements(*POLAR_ORBIT)
    for begin, end in eclipses:
        assert 0.0 < (end - begin).total_seconds() < 2400.0
        for edge, sign in ((begin, 1.0), (end, -1.0)):
            if edge in {prediction.begin, prediction.end}:
                continue
            for shift, dark in ((-15.0, sign < 0.0), (15.0, sign > 0.0)):
                date = julian_date(edge + timedelta(seconds=shift))
                sun = -earth_from_sun(float(terrestrial_time(date)))[0]
                assert (float(sunlit_share(elements.at(date).position, sun)) < 0.5) == dark


def test_the_claimed_error_of_the_times_grows_with_the_age_of_the_elements() -> None:
    fresh, old = (OrbitPrediction(POLAR_ORBIT, BEGIN + timedelta(days=age), 0.1) for age in (0.0, 20.0))
    assert fresh.timing_error_s < 1.0
    assert old.timing_error_s > 3.0


def test_stations_are_read_from_text_and_file(tmp_path: Path) -> None:
    assert station_of("Berlin,52.5,13.4,40") == BERLIN
    for station in (BERLIN, Station(name="Apia", latitude_deg=-13.8333333, longitude_deg=-171.7666667)):
        assert station_of(station.text) == station
    file = tmp_path / "stations.yaml"
    file.write_text("stations:\n  - {name: Berlin, latitude_deg: 52.5, longitude_deg: 13.4, height: 40}\n")
    assert read_stations(file) == (BERLIN,)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("Berlin", "give NAME,LATITUDE,LONGITUDE"),
        ("Berlin,52.5,x", "could not convert"),
        ("Berlin,95,13", "`latitude_deg` is 95.0: must be -90 to 90; give NAME,"),
        ("Berlin,52,13,0,90", "`mask_deg` is 90.0: must be at least 0 and below 90"),
        ("Berlin,nan,13", "`latitude_deg` is nan"),
        (",52,13", "length >= 1"),
        ("Berlin,1,2,3,4,5", "give NAME,LATITUDE,LONGITUDE"),
    ],
)
def test_a_wrong_station_is_refused_with_the_reason(text: str, reason: str) -> None:
    with pytest.raises(UsageError, match="station") as refused:
        station_of(text)
    assert reason in str(refused.value)


def test_a_wrong_file_of_stations_names_file_and_key(tmp_path: Path) -> None:
    file = tmp_path / "stations.yaml"
    file.write_text("stations:\n  - {name: Berlin, latitude_deg: 52.5, longitude_deg: 13.4, hight: 40}\n")
    with pytest.raises(UsageError, match=r"stations.yaml:2: .*hight"):
        read_stations(file)


def test_the_message_on_a_missing_file_of_stations_lists_no_configurations(tmp_path: Path) -> None:
    with pytest.raises(UsageError) as found:
        read_stations(tmp_path / "stations.yaml")
    assert str(found.value).endswith("stations.yaml: cannot be read: no such file; check the path")
