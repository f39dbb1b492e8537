"""Tests of the predicted environment: its source, its interpolation, and the refusal of false fixes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from flight.bodies.orbit.environment import (
    CONFIRMED,
    FIRST_FIXES,
    EstimatedEnvironment,
    Witness,
)
from flight.loop.navigation import GPS_DELAY_NS
from flight.schema import reader as configuration
from flight.schema.bodies import as_orbit
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
from tests.support.orbit_elements import summed

INPUT = Path(__file__).resolve().parents[5] / "shared/data/inputs/tle-bstar0-drag.txt"
UTC_NS = round(datetime.fromisoformat("2026-03-20T12:00:00Z").timestamp()) * SECOND_NS


@pytest.fixture
def elements() -> TwoLineElements:
    config = as_orbit(configuration.load(CONFIG.parent / "orbit.yaml"))
    assert config.elements is not None
    return TwoLineElements(*config.elements)


def reading(elements: TwoLineElements, time_ns: int, shift: FloatArray | None = None) -> GpsReading:
    """Return a GPS fix at the time `time_ns` of a clock whose zero is at `UTC_NS`."""
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
    later_ns = round(years * 365.25) * DAYS_NS
    for second in range(FIRST_FIXES):
        sound = reading(elements, second * SECOND_NS)
        used = known.fix(replace(sound, utc_ns=sound.utc_ns + later_ns))
    assert used
    around, sun, velocity = known.at(3 * SECOND_NS), known.sun(3 * SECOND_NS), known.velocity(3 * SECOND_NS)
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
    used = [known.fix(reading(elements, second * SECOND_NS)) for second in (8, 9, 10)]
    assert used == [False, False, True]
    assert (known.refused, known.refusal) == (0, ""), "the first fixes were refused"
    found = known.at(12 * SECOND_NS)
    assert found is not None
    expected = elements.at(UNIX_EPOCH + (UTC_NS + 12 * SECOND_NS) / (DAY * SECOND_NS))
    assert found.position == pytest.approx(expected.position, abs=50.0), "the receiver's time, not the host's"


def test_a_fix_with_a_negative_standard_deviation_is_refused(elements: TwoLineElements) -> None:
    known = EstimatedEnvironment(elements, SimClock(UTC_NS))
    sound = reading(elements, 0)
    for name, false in (
        ("sigma", replace(sound, sigma=-1.0)),
        ("velocity_sigma", replace(sound, velocity_sigma=-1.0)),
    ):
        assert not known.fix(false)
        assert known.refusal.startswith(f"{name}: -1.0")


@pytest.mark.parametrize("speed", [0.0, 0.9, 1.5])
def test_a_fix_with_an_impossible_velocity_is_refused(elements: TwoLineElements, speed: float) -> None:
    """A fix is refused if its orbit would be unbound or below the Earth's surface."""
    for known in (
        EstimatedEnvironment(elements, SimClock(UTC_NS)),
        EstimatedEnvironment(None, SimClock(UTC_NS)),
    ):
        sound = reading(elements, 0)
        assert not known.fix(replace(sound, velocity=speed * sound.velocity))
        assert "not an orbit" in known.refusal
        assert any([known.fix(reading(elements, second * SECOND_NS)) for second in range(1, 4)])


DAYS_NS = 86_400 * SECOND_NS
FIRST = "1 99001U 26001A   26079.50000000  .00000000  00000-0  00000+0 0  9996"
SECOND = "2 99001  97.4640 337.4170 0011973 295.7805  64.3547 15.30000000000102"


def dragged(drag: str) -> TwoLineElements:
    """Return elements like FIRST and SECOND with another drag term."""
    return TwoLineElements(summed(FIRST[:53] + drag + FIRST[61:]), SECOND)


def ahead(degrees: float) -> TwoLineElements:
    """Return elements like FIRST and SECOND with a mean anomaly that is larger by `degrees`."""
    return TwoLineElements(FIRST, summed(f"{SECOND[:43]}{(64.3547 + degrees) % 360.0:8.4f}{SECOND[51:]}"))


class Flight:
    """The GPS receiver, read every ten seconds, of a satellite that moves as the elements `true` describe.

    The readings start `days` days after the epoch of the elements.
    """

    def __init__(self, known: TwoLineElements | None, true: TwoLineElements, days: int = 0) -> None:
        self.true, self.days_ns = true, days * DAYS_NS
        self.environment = EstimatedEnvironment(known, SimClock(UTC_NS + self.days_ns))
        self.seconds = 0

    def reading(self, shift: FloatArray | None = None, seconds: float = 0.0) -> GpsReading:
        """Return the fix at the present time, shifted in position and in UTC."""
        sound = reading(self.true, self.days_ns + self.seconds * SECOND_NS, shift)
        time_ns = self.seconds * SECOND_NS + GPS_DELAY_NS
        utc_ns = sound.utc_ns + round(seconds * SECOND_NS)
        return replace(sound, time_ns=time_ns, arrival_ns=time_ns, utc_ns=utc_ns)

    def fly(
        self, duration: int, made: Callable[[], GpsReading], witness: Witness | None = None
    ) -> list[bool]:
        """Return, for each fix of the next `duration` seconds, whether it was used."""
        used = []
        for _ in range(duration // 10):
            used.append(self.environment.fix(made(), witness))
            self.seconds += 10
        return used

    def off(self) -> tuple[float, float]:
        """Return the error (m) of the predicted present position, and its stated standard deviation (m)."""
        state = self.environment.state(self.seconds * SECOND_NS)
        assert state is not None
        return float(np.linalg.norm(state.position - self.true.at(state.julian_date).position)), state.sigma


@pytest.mark.parametrize("age", [1, 6, 14, 30, 60])
@pytest.mark.parametrize("drag", [" 25000-3", " 50000-3"])
def test_good_fixes_win_over_old_elements_and_a_jump_of_the_receiver_is_refused(age: int, drag: str) -> None:
    """Good fixes replace elements that are 1 to 60 days old; afterwards a jump of 40 km is refused.

    The elements have B* 0, but the satellite has B* 2.5e-4 or 5e-4. Each fix is compared with earlier fixes.
    """
    flight = Flight(TwoLineElements(FIRST, SECOND), dragged(drag), age)
    off, sigma = flight.off()
    assert off < 4.0 * sigma
    used = flight.fly(round(CONFIRMED) + 40, flight.reading)
    assert used.index(True) == 0 if age == 1 else used.index(True) <= CONFIRMED // 10 + 1
    off, sigma = flight.off()
    assert off < 4.0 * sigma < 100.0
    assert not any(flight.fly(30, lambda: flight.reading(np.array([0.0, 4e4, 0.0]))))
    assert all(flight.fly(30, flight.reading))


@pytest.mark.skipif(not INPUT.is_file(), reason="../shared/data/inputs/tle-bstar0-drag.txt is missing")
@pytest.mark.parametrize("age", [4, 6, 30])
def test_old_elements_with_a_wrong_drag_term_are_replaced_by_good_fixes(age: int) -> None:
    """Elements with B* 0 are replaced by good fixes of a satellite with B* 5e-4.

    The elements have errors of 226 km after 6 days and 5,514 km after 30 days.
    """
    first, second = INPUT.read_text(encoding="ascii").splitlines()
    true = TwoLineElements(summed(first[:53] + " 50000-3" + first[61:]), second)
    flight = Flight(TwoLineElements(first, second), true, age)
    flight.days_ns = round((true.epoch - UNIX_EPOCH) * DAY) * SECOND_NS - UTC_NS + age * DAYS_NS
    flight.environment = EstimatedEnvironment(
        TwoLineElements(first, second), SimClock(UTC_NS + flight.days_ns)
    )
    off, sigma = flight.off()
    assert off < 4.0 * sigma
    assert any(flight.fly(600, flight.reading))
    off, sigma = flight.off()
    assert off < 4.0 * sigma < 100.0


@pytest.mark.parametrize("degrees", [1.0, 15.0, -120.0])
def test_consistent_fixes_replace_elements_that_they_contradict(degrees: float) -> None:
    """Elements of another satellite, or from before a manoeuvre, are replaced by consistent fixes."""
    flight = Flight(ahead(degrees), TwoLineElements(FIRST, SECOND))
    flight.fly(50, lambda: flight.reading(np.array([2e5, 0.0, 0.0])))
    used = flight.fly(600, flight.reading)
    assert CONFIRMED // 10 <= used.index(True) <= CONFIRMED // 10 + 1
    assert all(used[used.index(True) :])
    off, sigma = flight.off()
    assert off < 4.0 * sigma < 100.0
    flight.seconds += 2000
    off, sigma = flight.off()
    assert off < 4.0 * sigma, "without fixes the elements are used, with the error that the fixes have shown"
    assert any(flight.fly(600, flight.reading))


@pytest.mark.parametrize("shift", [(7e3, 0.0, 0.0), (0.0, -3e4, 0.0), (0.0, 2e5, 3e5)])
@pytest.mark.parametrize("days", [6, 30])
def test_a_shifted_receiver_is_not_confirmed(days: int, shift: tuple[float, float, float]) -> None:
    """Fixes with shifted positions are refused, because shifted positions and velocities form no orbit."""
    flight = Flight(TwoLineElements(FIRST, SECOND), dragged(" 50000-3"), days)
    assert not any(flight.fly(1200, lambda: flight.reading(np.array(shift))))
    off, sigma = flight.off()
    assert off < 4.0 * sigma
    assert any(flight.fly(600, flight.reading))
    off, sigma = flight.off()
    assert off < 4.0 * sigma < 100.0


def test_a_receiver_that_jumps_is_refused_by_old_elements_too() -> None:
    flight, random = Flight(TwoLineElements(FIRST, SECOND), dragged(" 50000-3"), 40), np.random.default_rng(3)
    used = flight.fly(1500, lambda: flight.reading(2e5 * random.standard_normal(3)))
    assert not any(used)
    off, sigma = flight.off()
    assert off < 4.0 * sigma


def test_single_false_fixes_do_not_delay_the_replacement() -> None:
    flight, random = Flight(ahead(15.0), TwoLineElements(FIRST, SECOND)), np.random.default_rng(4)
    false = iter(random.random(100) < 0.2)
    used = flight.fly(600, lambda: flight.reading(1e5 * random.standard_normal(3) if next(false) else None))
    assert any(used)
    off, sigma = flight.off()
    assert off < 4.0 * sigma < 400.0


def test_a_receiver_with_a_false_time_is_refused_although_its_orbit_is_consistent() -> None:
    known = TwoLineElements(FIRST, SECOND)
    flight = Flight(known, known)
    assert not any(flight.fly(1200, lambda: flight.reading(seconds=100.0)))
    assert all(flight.fly(60, flight.reading))


@pytest.mark.parametrize("days", [-30.0, -3.0])
def test_a_date_before_the_elements_is_refused(days: float) -> None:
    known = TwoLineElements(FIRST, SECOND)
    flight = Flight(known, known)
    assert not any(flight.fly(600, lambda: flight.reading(seconds=86_400 * days)))


def strength(flight: Flight, elements: TwoLineElements) -> float:
    """Return the field strength, T, at the present position of a satellite."""
    date = UNIX_EPOCH + (UTC_NS + flight.seconds * SECOND_NS) / (DAY * SECOND_NS)
    return float(np.linalg.norm(field(date, elements.at(date).position)))


def test_the_field_decides_between_elements_and_a_consistent_false_orbit() -> None:
    """The field strength contradicts fixes that are wrong by a quarter of an orbit, but not true fixes."""
    there, here = ahead(90.0), TwoLineElements(FIRST, SECOND)
    for known, true, used in ((here, there, False), (there, here, True)):
        flight = Flight(known, true)
        answers = []
        for _ in range(60):
            witness = Witness(strength(flight, here), 1e-6)
            answers += flight.fly(10, flight.reading, witness)
        assert any(answers) is used


def test_a_magnetometer_that_contradicts_both_orbits_decides_nothing() -> None:
    flight = Flight(ahead(90.0), TwoLineElements(FIRST, SECOND))
    assert any(flight.fly(600, flight.reading, Witness(9e-5, 1e-6)))


def test_the_sun_refutes_an_orbit_in_the_shadow() -> None:
    """One half of the orbit is in sunlight and the other half in shadow.

    Measured sunlight contradicts elements whose present position is in shadow.
    """
    lit, dark = TwoLineElements(FIRST, SECOND), ahead(180.0)
    used = {}
    for name, known, true in (("dark", lit, dark), ("lit", dark, lit)):
        flight = Flight(known, true)
        flight.seconds = 500
        used[name] = any(flight.fly(600, flight.reading, Witness(sunlit=True)))
    assert sorted(used.values()) == [False, True]


def test_a_clock_before_the_elements_leaves_the_orbit_unknown_until_a_fix() -> None:
    elements = TwoLineElements(FIRST, SECOND)
    flight = Flight(elements, elements, 1)
    flight.environment = EstimatedEnvironment(elements, SimClock(UTC_NS - 5 * DAYS_NS))
    assert flight.environment.clock_doubt.startswith("the wall clock is 5.0 days before the epoch")
    assert flight.environment.state(0) is None
    assert all(flight.fly(30, flight.reading))
    assert flight.environment.clock_doubt == ""
    off, sigma = flight.off()
    assert off < 4.0 * sigma


def test_old_elements_widen_the_field_and_a_fix_narrows_it() -> None:
    flight = Flight(TwoLineElements(FIRST, SECOND), dragged(" 50000-3"), 20)
    before = flight.environment.at(0)
    assert before is not None
    off = np.linalg.norm(before.field - field(flight.environment.julian_date(0), before.position))
    assert 5e-7 < before.field_sigma < 6e-5
    assert off < before.field_sigma
    flight.fly(600, flight.reading)
    after = flight.environment.at(600 * SECOND_NS)
    assert after is not None
    assert after.field_sigma == 0.0


def test_without_elements_a_first_orbit_that_was_false_is_given_up() -> None:
    flight = Flight(None, TwoLineElements(FIRST, SECOND))
    assert any(flight.fly(60, lambda: flight.reading(np.array([3e4, 0.0, 0.0]))))
    off, sigma = flight.off()
    assert off < 4.0 * sigma
    assert any(flight.fly(600, flight.reading))
    off, sigma = flight.off()
    assert off < 4.0 * sigma < 100.0


def test_a_fix_that_the_receiver_marks_as_invalid_is_not_used(elements: TwoLineElements) -> None:
    known = EstimatedEnvironment(None, SimClock(UTC_NS))
    assert not known.fix(replace(reading(elements, 0), valid=False))
    assert known.refused == 0


def test_a_fix_of_unknown_accuracy_is_used_with_a_wide_one(elements: TwoLineElements) -> None:
    known = EstimatedEnvironment(elements, SimClock(UTC_NS))
    for second in range(0, round(CONFIRMED) + 20, 20):
        sound = reading(elements, second * SECOND_NS)
        assert known.fix(replace(sound, sigma=np.nan, velocity_sigma=np.nan))
    state = known.state((second + 100) * SECOND_NS)
    assert state is not None
    assert 300.0 < state.sigma < 500.0


@pytest.mark.parametrize("shift", [0.0, 4.9e3])
def test_a_fix_near_accurate_elements_is_used_at_once_and_believed_after_a_while(shift: float) -> None:
    elements = TwoLineElements(FIRST, SECOND)
    flight = Flight(elements, elements)
    assert all(flight.fly(20, lambda: flight.reading(np.array([0.0, shift, 0.0]))))
    off, sigma = flight.off()
    assert off < 4.0 * sigma
    assert sigma > 1e3
    used = flight.fly(800, lambda: flight.reading(np.array([0.0, shift, 0.0])))
    off, sigma = flight.off()
    assert off < 4.0 * sigma
    assert (sigma < 20.0) is all(used) is (shift == 0.0)


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


def test_a_receiver_is_refused_while_its_time_does_not_advance(elements: TwoLineElements) -> None:
    known, frozen = EstimatedEnvironment(elements, SimClock(UTC_NS)), reading(elements, 10 * SECOND_NS)
    assert known.fix(frozen)
    for seconds in range(11, 60):
        time_ns = seconds * SECOND_NS + GPS_DELAY_NS
        assert not known.fix(replace(frozen, time_ns=time_ns, arrival_ns=time_ns))
        assert "time jumps" in known.refusal
    date = UNIX_EPOCH + (UTC_NS + 60 * SECOND_NS) / (DAY * SECOND_NS)
    assert known.julian_date(60 * SECOND_NS) == pytest.approx(date, abs=1e-8), "the time goes on"


def test_a_receiver_whose_bytes_come_late_is_believed_only_after_a_while() -> None:
    elements = TwoLineElements(FIRST, SECOND)
    flight = Flight(elements, elements)
    assert all(flight.fly(10, flight.reading))

    def late() -> GpsReading:
        sent = flight.reading()
        return replace(sent, time_ns=sent.time_ns + 2 * SECOND_NS)

    assert CONFIRMED // 10 <= flight.fly(600, late).index(True) <= CONFIRMED // 10 + 1


def test_after_a_leap_second_fixes_are_used_again_and_the_position_is_within_its_uncertainty() -> None:
    """UTC is compared in terrestrial axes, because a leap second does not change the Earth's rotation."""
    elements = TwoLineElements(FIRST, SECOND)
    flight = Flight(None, elements)
    assert all(flight.fly(600, flight.reading)[FIRST_FIXES:])
    for _ in range(20):
        used = flight.fly(60, lambda: flight.reading(seconds=-1.0))
        state = flight.environment.state(flight.seconds * SECOND_NS)
        assert state is not None
        date = UNIX_EPOCH + (UTC_NS + flight.seconds * SECOND_NS) / (DAY * SECOND_NS)
        place = celestial_to_terrestrial(state.julian_date) @ state.position
        true = celestial_to_terrestrial(date) @ elements.at(date).position
        assert np.linalg.norm(place - true) < 4.0 * state.sigma
    assert all(used)
