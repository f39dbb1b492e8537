"""Tests of the drivers of current monitors with the emulated chips: INA219 and ADS1115."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
import pytest

from hal.drivers.current_monitors import (
    STEP,
    AdsSolarStrings,
    Ina219,
    StringWiring,
    config_for,
    conversion_of,
    range_for,
)
from hal.interfaces.devices import PowerMonitor
from hal.interfaces.errors import OutOfRange
from hal.interfaces.wires import SECOND_NS
from knightcube.astro import quaternion
from knightcube.vision.solar_cells import CoarseSunStatus, SolarStringModel, coarse_sun
from sim_hal.clock import SimClock, TimedSimulation
from sim_hal.emulators.coil_circuit import EmulatedIna219
from sim_hal.emulators.i2c_bus import EmulatedI2cBus
from sim_hal.emulators.power import EmulatedAds1115, EmulatedSolarCells, SolarCellsModel
from sim_hal.settings import FreeBodySection, OrbitSection, TipOff
from sim_hal.worlds.free_body import FreeBody
from tests.hal.coils.rig import INA, PCA, Rig
from tests.manual_clock import ManualClock

MS = 1_000_000
CYCLE = 2 * 68_100_000


@pytest.mark.parametrize(("current", "bits"), [(0.4, 0b00), (0.8, 0b01), (1.6, 0b10), (3.2, 0b11)])
def test_the_narrowest_range_is_chosen(current: float, bits: int) -> None:
    assert range_for(current, 0.1) == bits


def test_config_asks_for_32_v_80_mv_and_128_samples() -> None:
    assert config_for(0b01) == 0x2FFF


def test_a_supply_of_24_v_is_measured() -> None:
    """The INA219 measures up to 26 V, but its 16 V range reports at most 16 V."""
    rig = Rig()
    rig.wire.monitor._measure = lambda start_ns, end_ns: (24.0, 0.1)
    monitor = Ina219(rig.bus, INA, rig.clock)
    rig.clock.advance(1400 * MS)
    reading = monitor.latest()
    assert reading is not None
    assert (reading.voltage, reading.current) == pytest.approx((24.0, 0.1), abs=4e-3)


@pytest.mark.parametrize(
    ("current", "shunt"), [(3.3, 0.1), (0.0, 0.1), (math.nan, 0.1), (0.8, 0.0), (0.8, math.inf)]
)
def test_currents_and_shunts_beyond_the_ranges_are_refused(current: float, shunt: float) -> None:
    rig = Rig()
    with pytest.raises(OutOfRange):
        Ina219(rig.bus, INA, rig.clock, shunt_ohm=shunt, maximum_current=current)


def test_readings_follow_the_coils(rig: Rig) -> None:
    """With two fully driven coils, the monitor reads 2 x 3.4 V/23 ohm to 0.1 mA, and 3.4 V to 4 mV."""
    rig.coils.start()
    monitor: PowerMonitor = Ina219(rig.bus, INA, rig.clock)
    assert monitor.latest() is None
    for _ in range(80):
        rig.command(1.0, -1.0, 0.0)
        rig.clock.advance(25 * MS)
    reading = monitor.latest()
    assert reading is not None
    assert monitor.error() == ""
    assert reading.voltage == pytest.approx(3.4, abs=2e-3)
    assert reading.current == pytest.approx(2 * 3.4 / 23.0, abs=2e-4)
    assert reading.power == pytest.approx(reading.voltage * reading.current)
    assert 0 <= rig.clock.now_ns() - reading.time_ns <= 200 * MS
    monitor.close()
    monitor.close()
    rig.clock.advance(1000 * MS)
    assert monitor.latest() == reading


def test_a_chopped_current_is_read_to_the_7_percent_of_five_conversions(rig: Rig) -> None:
    """The mean of five ADC samples of a chopped current of 0.15 A is within 7 %.

    Currents of 0.1 A and -0.05 A draw 0.15 A together. A single ADC sample may be 18 % off.
    """
    rig.coils.start()
    monitor = Ina219(rig.bus, INA, rig.clock)
    newest = set()
    for _ in range(200):
        rig.command(0.1, -0.05, 0.0)
        rig.clock.advance(25 * MS)
        reading = monitor.latest()
        if reading is not None and rig.clock.now_ns() > 2000 * MS:
            assert reading.current == pytest.approx(0.15, rel=0.07)
            assert reading.newest == pytest.approx(0.15, rel=0.185)
            newest.add(reading.newest)
    assert max(newest) - min(newest) > 1e-3, "the conversions drift through the PWM's phase"


@pytest.mark.parametrize(("averaged", "least", "most"), [(1, 0.10, 0.185), (5, 0.0, 0.07)])
def test_a_chopped_current_is_averaged_over_several_conversions(
    averaged: int, least: float, most: float
) -> None:
    """A mean of five ADC samples of a chopped current is within 7 %. A single sample is up to 18.5 % off.

    Pulses of 10 % of 19.988 ms are integrated exactly. The largest error in 20 s of readings is checked.
    """
    period, duty, amps = 19.988e6, 0.1, 3.4 / 23.0

    def charge(time_ns: int) -> float:
        whole, part = divmod(time_ns, period)
        return amps * (whole * duty * period + min(part, duty * period))

    clock = ManualClock()
    rig = Rig(clock=clock)
    rig.wire.bus.attach(
        EmulatedIna219(
            0x44, clock.now_ns, lambda start, end: (3.4, (charge(end) - charge(start)) / (end - start))
        )
    )
    monitor = Ina219(rig.bus, 0x44, clock, averaged=averaged)
    clock.advance(2000 * MS)
    worst = 0.0
    for _ in range(100):
        clock.advance(200 * MS)
        reading = monitor.latest()
        assert reading is not None
        worst = max(worst, abs(reading.current / (duty * amps) - 1.0))
    assert least <= worst <= most


def test_a_negative_shunt_voltage_is_a_negative_current() -> None:
    """A monitor with a reversed shunt reads a negative current, and not 6.5 kA."""
    clock = ManualClock()
    rig = Rig(clock=clock)
    rig.wire.bus.attach(EmulatedIna219(0x44, clock.now_ns, lambda start, end: (3.4, -0.12)))
    monitor = Ina219(rig.bus, 0x44, clock)
    clock.advance(600 * MS)
    reading = monitor.latest()
    assert reading is not None
    assert reading.current == pytest.approx(-0.12)


def test_no_conversion_is_counted_twice() -> None:
    rig = Rig()
    monitor = Ina219(rig.bus, INA, rig.clock, period_ns=10 * MS)
    times = set()
    for _ in range(100):
        rig.clock.advance(10 * MS)
        reading = monitor.latest()
        if reading is not None:
            times.add(reading.time_ns)
    assert len(times) == (1000 - 10) * MS // CYCLE


def test_a_current_beyond_the_range_is_given_as_at_least_the_range() -> None:
    """A current beyond the range of 0.8 A is reported as 0.8 A and as clipped.

    A short circuit gives 1 A. Without a reading, the shorted coil would not be found.
    """
    clock = ManualClock()
    rig = Rig(clock=clock)
    amps = [0.2]
    rig.wire.bus.attach(EmulatedIna219(0x44, clock.now_ns, lambda start, end: (3.4, amps[0])))
    monitor = Ina219(rig.bus, 0x44, clock)
    found = []
    for current in (0.2, 1.0, 0.1):
        amps[0] = current
        clock.advance(1400 * MS)  # until the mean contains only samples of this current
        reading = monitor.latest()
        assert reading is not None
        assert monitor.error() == ""
        found.append((round(reading.current, 3), round(reading.newest, 3), reading.clipped))
    assert found == [(0.2, 0.2, False), (0.8, 0.8, True), (0.1, 0.1, False)]


def test_an_overflow_of_the_chips_mathematics_is_an_error() -> None:
    """An overflow of the chip's multiplication is reported as an error.

    Another program has changed Calibration, so that 7000 x 65534 / 4096 exceeds the register Current.
    """
    clock = ManualClock()
    rig = Rig(clock=clock)
    rig.wire.bus.attach(EmulatedIna219(0x44, clock.now_ns, lambda start, end: (3.4, 0.7)))
    rig.bus.write_i2c_block_data(0x44, 0x05, [0xFF, 0xFE])
    monitor = Ina219(rig.bus, 0x44, clock)
    clock.advance(600 * MS)
    assert "overflow" in monitor.error()
    assert monitor.latest() is None


def test_a_silent_monitor_is_an_error_until_it_answers(rig: Rig) -> None:
    monitor = Ina219(rig.bus, INA, rig.clock)
    rig.wire.bus.nack(INA, times=None)
    rig.clock.advance(400 * MS)
    assert "no acknowledge" in monitor.error()
    assert monitor.latest() is None
    rig.wire.bus.clear_faults()
    rig.clock.advance(1400 * MS)
    assert monitor.error() == ""
    assert monitor.latest() is not None


def test_a_brown_out_is_detected_reported_and_repaired(rig: Rig) -> None:
    monitor = Ina219(rig.bus, INA, rig.clock)
    rig.clock.advance(1000 * MS)
    rig.wire.monitor.brown_out()
    rig.clock.advance(200 * MS)
    assert "brown-out" in monitor.error()
    assert rig.wire.monitor.register(0x00) == 0x2FFF
    rig.clock.advance(1200 * MS)
    assert monitor.error() == ""


def test_a_brown_out_is_reported_even_if_an_earlier_run_had_set_the_chip_up() -> None:
    rig = Rig()
    rig.bus.write_i2c_block_data(INA, 0x00, [0x2F, 0xFF])
    monitor = Ina219(rig.bus, INA, rig.clock)
    rig.clock.advance(400 * MS)
    assert monitor.error() == ""
    rig.wire.monitor.brown_out()
    rig.clock.advance(200 * MS)
    assert "brown-out" in monitor.error()


def test_another_part_at_the_address_is_named(rig: Rig) -> None:
    monitor = Ina219(rig.bus, PCA, rig.clock)
    rig.clock.advance(200 * MS)
    assert "another chip" in monitor.error()


def test_a_monitor_that_stops_converting_is_an_error() -> None:
    class Frozen(EmulatedIna219):
        def _convert(self) -> None:
            pass

    clock = ManualClock()
    rig = Rig(clock=clock)
    rig.wire.bus.attach(Frozen(0x44, clock.now_ns, lambda start, end: (3.4, 0.1)))
    monitor = Ina219(rig.bus, 0x44, clock)
    clock.advance(1000 * MS)
    assert monitor.error() == ""
    clock.advance(1000 * MS)
    assert "no conversion" in monitor.error()


def test_the_newest_conversion_is_returned_with_the_time_that_it_averages(rig: Rig) -> None:
    """An ADC sample is returned with the start of its averaging time.

    A sample that began before a step of the current is not used for the time after the step.
    """
    rig.coils.start()
    monitor = Ina219(rig.bus, INA, rig.clock)
    rig.clock.advance(2000 * MS)
    step_ns = rig.clock.now_ns()
    mixed = returned = 0
    for _ in range(40):
        rig.command(1.0, 0.0, 0.0)
        rig.clock.advance(25 * MS)
        reading = monitor.latest()
        assert reading is not None
        if reading.newest_since_ns >= step_ns:
            assert reading.newest == pytest.approx(3.4 / 23.0, abs=2e-4)
            mixed += reading.current < 0.146
            returned += 1
    assert mixed > 0, "the mean still holds the time before"
    assert returned > 20


@pytest.mark.parametrize("amps", [0.0, 0.05])
def test_a_monitor_that_always_gives_the_same_is_reported_at_any_current(rig: Rig, amps: float) -> None:
    """A monitor whose ready bit stays set after a read is reported as stuck, even at a constant current."""
    rig.coils.start()
    monitor = Ina219(rig.bus, INA, rig.clock)

    def fly(cycles: int) -> None:
        for _ in range(cycles):
            rig.command(amps, 0.0, 0.0)
            rig.clock.advance(25 * MS)

    fly(80)
    assert monitor.error() == ""
    rig.wire.monitor.frozen = {number: rig.wire.monitor.register(number) for number in range(6)}
    rig.wire.monitor.frozen[2] |= 0b10
    fly(40)
    assert "stuck" in monitor.error()
    rig.wire.monitor.frozen.clear()
    fly(80)
    assert monitor.error() == ""


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


def test_dead_frozen_and_wrong_strings_give_the_readings_of_real_ones() -> None:
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


def test_a_current_beyond_the_range_is_clipped_and_named_and_leaves_the_other_strings() -> None:
    flown, sound = bench(peak=0.5), bench(peak=0.5)
    light = flown.strings._light
    flown.strings._light = lambda now_ns: light(now_ns) + np.array([0.0, 0.0, 1.3, 0.0, 0.0, 0.0])  # type: ignore[method-assign]
    flown.wait(1.2)
    sound.wait(1.2)
    error = flown.driver.error()
    assert "current of string 3" in error
    numbers = [float(number) for number in re.findall(r"-?\d+\.\d+", error)]
    assert numbers == pytest.approx([1.024, -1.024, 1.024], abs=5e-3), "2.048 V of full scale by 2 V/A"
    reading, whole = flown.driver.latest(), sound.driver.latest()
    assert reading is not None
    assert whole is not None
    assert reading.currents[2] == pytest.approx(1.024, abs=5e-3)
    others = [0, 1, 3, 4, 5]
    np.testing.assert_allclose(reading.currents[others], whole.currents[others], atol=STEP)
    flown.strings._light = light  # type: ignore[method-assign]
    flown.wait(1.2)
    assert flown.driver.error() == ""


def test_impossible_wirings_and_periods_are_refused() -> None:
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
