"""What surrounds the satellite by belief: from elements or fixes, interpolated, false fixes refused."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest

from flight.bodies.orbit.environment import CONTRADICTED, GPS_DELAY_NS, EstimatedEnvironment
from flight.schema import reader as configuration
from flight.schema.orbit import as_orbit
from hal.interfaces.devices import GpsReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.ephemeris import predict
from knightcube.astro.earth.geomagnetism import field
from knightcube.astro.earth.orbit_knowledge import TwoLineElements
from knightcube.astro.earth.orientation import ROTATION_RATE, celestial_to_terrestrial
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH
from sim_hal.clock import SimClock
from tests.support.flights import CONFIG

UTC_NS = round(datetime.fromisoformat("2026-03-20T12:00:00Z").timestamp()) * SECOND_NS


@pytest.fixture
def elements() -> TwoLineElements:
    config = as_orbit(configuration.load(CONFIG.parent / "orbit.yaml"))
    assert config.elements is not None
    return TwoLineElements(*config.elements)


def reading(elements: TwoLineElements, time_ns: int, shift: FloatArray | None = None) -> GpsReading:
    """Return a fix at `time_ns` of a clock that begins at `UTC_NS`."""
    utc_ns = UTC_NS + time_ns
    date = UNIX_EPOCH + utc_ns / (DAY * SECOND_NS)
    state, turn = elements.at(date), celestial_to_terrestrial(date)
    position = turn @ state.position
    velocity = turn @ state.velocity - np.cross([0.0, 0.0, ROTATION_RATE], position)
    place = position + (0.0 if shift is None else shift)
    began_ns = time_ns + GPS_DELAY_NS
    return GpsReading(began_ns, began_ns, utc_ns, place, velocity, 5.0, 0.05, 9, True)


def test_elements_place_the_satellite_and_its_field(elements: TwoLineElements) -> None:
    known = EstimatedEnvironment(elements, SimClock(UTC_NS))
    for seconds in (0.0, 15.0, 31.0, 500.0):
        now_ns = round(seconds * SECOND_NS)
        date = known.julian_date(now_ns)
        expected = elements.at(date)
        found = known.at(now_ns)
        assert found is not None
        assert found.position == pytest.approx(expected.position, abs=30.0)
        assert found.field == pytest.approx(field(date, expected.position), abs=1e-8)
        velocity = known.velocity(now_ns)
        assert velocity is not None
        assert 2.0e4 < np.linalg.norm(velocity) < 4.0e4


@pytest.mark.parametrize("years", [0, 4, 5, 10, 15])
def test_the_place_the_sun_and_the_shadow_are_known_after_the_field_model_has_ended(
    elements: TwoLineElements, years: int
) -> None:
    known = EstimatedEnvironment(None, SimClock(UTC_NS))
    first = reading(elements, 0)
    assert known.fix(replace(first, utc_ns=UTC_NS + round(years * 365.25) * 86_400 * SECOND_NS))
    around, sun, velocity = known.at(SECOND_NS), known.sun(SECOND_NS), known.velocity(SECOND_NS)
    assert around is not None
    assert sun is not None
    assert velocity is not None
    assert 2e-5 < np.linalg.norm(around.field) < 6e-5
    assert around.field_sigma == pytest.approx(2.5e-8 * max(0.0, 2026.21 + years - 2030.0), abs=1e-9)
    assert np.linalg.norm(sun) == pytest.approx(1.0)
    assert 0.0 <= around.sunlit <= 1.0


def test_without_elements_nothing_is_known_before_the_first_fix(elements: TwoLineElements) -> None:
    known = EstimatedEnvironment(None, SimClock(UTC_NS + 300 * SECOND_NS))
    assert known.at(0) is None
    assert known.velocity(0) is None
    assert known.state(0) is None
    assert known.fix(reading(elements, 10 * SECOND_NS))
    found = known.at(12 * SECOND_NS)
    assert found is not None
    expected = elements.at(UNIX_EPOCH + (UTC_NS + 12 * SECOND_NS) / (DAY * SECOND_NS))
    assert found.position == pytest.approx(expected.position, abs=50.0), "the receiver's time, not the host's"


def test_a_false_fix_is_refused_by_the_elements_however_often_it_comes(elements: TwoLineElements) -> None:
    known = EstimatedEnvironment(elements, SimClock(UTC_NS))
    shift = np.array([3e4, 0.0, 0.0])
    answers = [known.fix(reading(elements, k * SECOND_NS, shift)) for k in range(CONTRADICTED + 5)]
    assert not any(answers)
    assert known.refused == CONTRADICTED + 5
    assert known.fix(reading(elements, 60 * SECOND_NS))


@pytest.mark.parametrize("speed", [0.0, 0.9, 1.5])
def test_a_fix_with_an_impossible_velocity_is_refused(elements: TwoLineElements, speed: float) -> None:
    """The orbit would meet the Earth or leave it."""
    for known in (
        EstimatedEnvironment(elements, SimClock(UTC_NS)),
        EstimatedEnvironment(None, SimClock(UTC_NS)),
    ):
        sound = reading(elements, 0)
        assert not known.fix(replace(sound, velocity=speed * sound.velocity))
        assert known.fix(reading(elements, SECOND_NS))


@pytest.mark.parametrize("age", [1, 6, 14, 30, 60])
@pytest.mark.parametrize("drag", [" 25000-3", " 50000-3"])
def test_good_fixes_win_over_old_elements_and_a_jump_of_the_receiver_is_refused(age: int, drag: str) -> None:
    """Elements with B* 0 of a satellite with B* 2.5e-4 and 5e-4; later fixes are judged by earlier fixes."""
    first = "1 99001U 26001A   26079.50000000  .00000000  00000-0  00000+0 0  9996"
    second = "2 99001  97.4640 337.4170 0011973 295.7805  64.3547 15.30000000000102"
    dragged = first[:53] + drag + first[61:68]
    total = sum(int(c) if c.isdigit() else c == "-" for c in dragged) % 10
    old, true = TwoLineElements(first, second), TwoLineElements(f"{dragged}{total}", second)
    utc_ns = UTC_NS + age * 86_400 * SECOND_NS
    known = EstimatedEnvironment(old, SimClock(utc_ns))

    def fix(seconds: int, shift: FloatArray | None = None) -> GpsReading:
        time_ns = age * 86_400 * SECOND_NS + seconds * SECOND_NS
        sound = reading(true, time_ns, shift)
        return replace(sound, time_ns=seconds * SECOND_NS + GPS_DELAY_NS)

    before = known.state(0)
    assert before is not None
    off = np.linalg.norm(before.position - true.at(before.julian_date).position)
    assert off < 4.0 * before.sigma
    assert known.fix(fix(0))
    state = known.state(0)
    assert state is not None
    assert state.sigma < 20.0
    assert not known.fix(fix(1, np.array([0.0, 4e4, 0.0])))
    assert known.fix(fix(2))


def test_without_elements_a_first_fix_that_was_false_is_given_up(elements: TwoLineElements) -> None:
    known = EstimatedEnvironment(None, SimClock(UTC_NS))
    assert known.fix(reading(elements, 0, np.array([3e4, 0.0, 0.0])))
    answers = [known.fix(reading(elements, k * SECOND_NS)) for k in range(1, CONTRADICTED + 2)]
    assert answers == [False] * CONTRADICTED + [True]


def test_a_fix_that_the_receiver_does_not_vouch_for_is_not_used(elements: TwoLineElements) -> None:
    known = EstimatedEnvironment(None, SimClock(UTC_NS))
    assert not known.fix(replace(reading(elements, 0), valid=False))
    assert known.refused == 0


def test_a_fix_of_unknown_accuracy_is_used_with_a_wide_one(elements: TwoLineElements) -> None:
    known = EstimatedEnvironment(None, SimClock(UTC_NS))
    assert known.fix(replace(reading(elements, 0), sigma=np.nan, velocity_sigma=np.nan))
    state = known.state(100 * SECOND_NS)
    assert state is not None
    assert 300.0 < state.sigma < 500.0


def test_a_long_prediction_from_the_known_state_agrees_with_the_environment(
    elements: TwoLineElements,
) -> None:
    known = EstimatedEnvironment(elements, SimClock(UTC_NS))
    state = known.state(5 * SECOND_NS)
    assert state is not None
    ahead = predict(state, 100.0)
    found = known.at(45 * SECOND_NS)
    assert found is not None
    assert ahead.position_at(np.array([40.0]))[0] == pytest.approx(found.position, abs=5.0)


def test_a_receiver_whose_time_stands_is_refused_for_as_long_as_it_does(elements: TwoLineElements) -> None:
    known, frozen = EstimatedEnvironment(elements, SimClock(UTC_NS)), reading(elements, 10 * SECOND_NS)
    assert known.fix(frozen)
    for seconds in range(11, 60):
        time_ns = seconds * SECOND_NS + GPS_DELAY_NS
        assert not known.fix(replace(frozen, time_ns=time_ns, arrival_ns=time_ns))
    date = UNIX_EPOCH + (UTC_NS + 60 * SECOND_NS) / (DAY * SECOND_NS)
    assert known.julian_date(60 * SECOND_NS) == pytest.approx(date, abs=1e-8), "the time goes on"


def test_a_receiver_whose_bytes_come_late_is_believed_only_after_a_while(elements: TwoLineElements) -> None:
    known, late_ns = EstimatedEnvironment(elements, SimClock(UTC_NS)), 2 * SECOND_NS
    assert known.fix(reading(elements, 10 * SECOND_NS))
    used = []
    for seconds in range(11, 60):
        sent = reading(elements, seconds * SECOND_NS)
        used.append(known.fix(replace(sent, time_ns=sent.time_ns + late_ns)))
    assert used.index(True) == CONTRADICTED
