"""Tests of solar strings on ADS1115 converters in sunlight and shadow, with faults."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
import pytest

from hal.drivers.current_monitors import STEP, AdsSolarStrings, StringWiring, conversion_of
from hal.interfaces.errors import OutOfRange
from hal.interfaces.wires import SECOND_NS
from knightcube.astro import quaternion
from knightcube.vision.solar_cells import CoarseSunStatus, SolarStringModel, coarse_sun
from sim_hal.clock import SimClock, TimedSimulation
from sim_hal.emulators.i2c_bus import EmulatedI2cBus
from sim_hal.emulators.power import EmulatedAds1115, EmulatedSolarCells, SolarCellsModel
from sim_hal.settings import FreeBodySection, OrbitSection, TipOff
from sim_hal.worlds.free_body import FreeBody

WIRINGS = tuple(StringWiring(0x48 + index // 3, index % 3, 2.0) for index in range(6))
FACES = np.concatenate([np.eye(3), -np.eye(3)])


@dataclass
class Bench:
    clock: SimClock
    body: FreeBody
    bus: EmulatedI2cBus
    strings: EmulatedSolarCells
    driver: AdsSolarStrings

    def wait(self, seconds: float) -> None:
        self.clock.sleep_until_ns(self.clock.now_ns() + round(seconds * SECOND_NS))


def bench(peak: float = 0.5, after_noon: float = 0.0) -> Bench:
    """Return strings of `peak` A in an orbit that begins `after_noon` degrees behind the Sun's meridian."""
    clock = SimClock()
    orbit = OrbitSection(local_time=12.0, true_anomaly_deg=after_noon)
    body = FreeBody(FreeBodySection(orbit=orbit, release=TipOff(speed=0.0)), lambda: np.zeros(3))
    model = SolarCellsModel(FACES, np.full(6, peak), np.zeros(6), noise=0.0)
    strings = EmulatedSolarCells(body, model, WIRINGS, clock.now_ns, np.random.default_rng(1))
    bus = EmulatedI2cBus(strings.parts)
    clock.attach(TimedSimulation(body.advance_to, []))
    return Bench(clock, body, bus, strings, AdsSolarStrings(bus, clock, WIRINGS))


def test_the_strings_give_the_suns_direction_and_nothing_in_shadow() -> None:
    flown = bench()
    flown.wait(1.2)
    reading = flown.driver.latest()
    assert reading is not None
    found = coarse_sun(reading.currents, SolarStringModel(peaks=np.full(6, 0.5)))
    body = quaternion.attitude_matrix(flown.body.motion(flown.clock.now_ns()).quaternion)
    assert found.status is CoarseSunStatus.FOUND
    assert found.direction is not None
    assert np.degrees(np.arccos(found.direction @ body @ np.array(flown.body.surroundings().sun))) < 25.0
    night = bench(after_noon=165.0)
    night.wait(1.2)
    assert night.body.surroundings().sunlit == 0.0
    dark = night.driver.latest()
    assert dark is not None
    assert np.abs(dark.currents).max() < STEP


def test_a_reading_is_the_current_to_a_step_of_the_converter_and_no_older_than_its_round() -> None:
    flown = bench()
    flown.wait(2.0)
    reading = flown.driver.latest()
    assert reading is not None
    assert flown.clock.now_ns() - reading.time_ns <= SECOND_NS // 2
    exact = flown.strings._light(flown.clock.now_ns())
    np.testing.assert_allclose(reading.currents, exact, atol=0.51 * STEP / 2.0 + 2e-3 * exact.max())


def test_a_reset_of_the_whole_bus_costs_a_round_and_no_more() -> None:
    """After a reset of the whole bus, one round of readings is lost.

    The software reset of a PWM chip also resets the converters.
    """
    flown = bench()
    flown.wait(2.1)
    before = flown.driver.latest()
    flown.bus.write_byte(0x00, 0x06)
    flown.wait(1.3)
    after = flown.driver.latest()
    assert before is not None
    assert after is not None
    assert flown.driver.error() == ""
    assert after.time_ns - before.time_ns > SECOND_NS // 2
    assert flown.clock.now_ns() - after.time_ns <= SECOND_NS // 2


def test_dead_frozen_and_wrong_strings_look_as_they_do_on_a_satellite() -> None:
    flown = bench()
    flown.wait(1.2)
    sound = flown.driver.latest()
    assert sound is not None
    brightest = int(np.argmax(sound.currents))
    flown.strings.dead[brightest] = True
    flown.wait(1.2)
    dead = flown.driver.latest()
    assert dead is not None
    assert dead.currents[brightest] == 0.0
    flown.strings.dead[:] = False
    flown.strings.frozen = True
    flown.wait(1.2)
    held = flown.driver.latest()
    flown.wait(600.0)
    later = flown.driver.latest()
    assert held is not None
    assert later is not None
    np.testing.assert_array_equal(later.currents, held.currents)
    assert later.time_ns > held.time_ns


def test_a_silent_part_is_reported_and_a_brown_out_heals() -> None:
    flown = bench()
    flown.wait(1.2)
    before = flown.driver.latest()
    assert flown.driver.error() == ""
    lift = flown.bus.nack(0x49, times=None)
    flown.wait(1.2)
    assert "0x49" in flown.driver.error()
    assert flown.driver.latest() is before
    lift()
    flown.wait(1.2)
    assert flown.driver.error() == ""
    flown.strings.parts[0].brown_out()
    flown.wait(0.2)
    assert "brown-out" in flown.driver.error()
    flown.wait(1.2)
    assert flown.driver.error() == ""


def test_a_current_beyond_the_range_is_refused() -> None:
    flown = bench(peak=1.3)
    flown.strings.gain = 2.0
    flown.wait(1.2)
    error = flown.driver.error()
    assert "current of string" in error
    numbers = [float(number) for number in re.findall(r"-?\d+\.\d+", error)]
    assert numbers == pytest.approx([1.024, -1.024, 1.024], abs=5e-3), "2.048 V of full scale by 2 V/A"
    assert flown.driver.latest() is None


def test_wirings_and_periods_that_cannot_be_are_refused() -> None:
    bus, clock = EmulatedI2cBus(), SimClock()
    twice = (StringWiring(0x48, 0, 1.0), StringWiring(0x48, 0, 1.0))
    for wirings, period in ((twice, 1.0), ((), 1.0), ((StringWiring(0x48, 4, 1.0),), 1.0), (WIRINGS, 0.02)):
        with pytest.raises(OutOfRange):
            AdsSolarStrings(bus, clock, wirings, round(period * SECOND_NS))


def test_the_words_are_those_of_the_data_sheet() -> None:
    """The configuration is OS 1, MUX 1xx, PGA 010, MODE 1, DR 100, COMP_QUE 11 (SBAS444, Table 8-3).

    The power-on value is 0x8583.
    """
    assert [conversion_of(channel) for channel in range(4)] == [0xC583, 0xD583, 0xE583, 0xF583]
    clock = SimClock()
    bus = EmulatedI2cBus([EmulatedAds1115(0x48, clock.now_ns, lambda channel: 0.5 * channel)])
    assert bus.read_i2c_block_data(0x48, 1, 2) == [0x85, 0x83]
    bus.write_i2c_block_data(0x48, 1, [0xE5, 0x83])
    assert bus.read_i2c_block_data(0x48, 1, 2) == [0x65, 0x83]  # the converter is still converting
    clock.sleep_until_ns(8_000_000)
    assert bus.read_i2c_block_data(0x48, 1, 2) == [0xE5, 0x83]
    assert bus.read_i2c_block_data(0x48, 0, 2) == list(round(1.0 / 2.048 * 32768).to_bytes(2, "big"))
