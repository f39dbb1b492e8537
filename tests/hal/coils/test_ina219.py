"""Tests of the current monitor's driver with the emulated chip, on both buses."""

from __future__ import annotations

import math

import pytest

from hal.drivers.current_monitors import Ina219, config_for, range_for
from hal.interfaces.devices import PowerMonitor
from hal.interfaces.errors import OutOfRange
from sim_hal.emulators.coil_circuit import EmulatedIna219
from tests.hal.coils.rig import INA, PCA, Rig
from tests.manual_clock import ManualClock

MS = 1_000_000
CYCLE = 2 * 68_100_000


@pytest.mark.parametrize(("current", "bits"), [(0.4, 0b00), (0.8, 0b01), (1.6, 0b10), (3.2, 0b11)])
def test_the_narrowest_range_is_chosen(current: float, bits: int) -> None:
    assert range_for(current, 0.1) == bits


def test_config_asks_for_16_v_80_mv_and_128_samples() -> None:
    assert config_for(0b01) == 0x0FFF


@pytest.mark.parametrize(
    ("current", "shunt"), [(3.3, 0.1), (0.0, 0.1), (math.nan, 0.1), (0.8, 0.0), (0.8, math.inf)]
)
def test_what_cannot_be_measured_is_refused(current: float, shunt: float) -> None:
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


def test_a_brown_out_is_noticed_said_and_mended(rig: Rig) -> None:
    monitor = Ina219(rig.bus, INA, rig.clock)
    rig.clock.advance(1000 * MS)
    rig.wire.monitor.brown_out()
    rig.clock.advance(200 * MS)
    assert "brown-out" in monitor.error()
    assert rig.wire.monitor.register(0x00) == 0x0FFF
    rig.clock.advance(1200 * MS)
    assert monitor.error() == ""


def test_a_brown_out_is_said_even_if_an_earlier_run_had_set_the_chip_up() -> None:
    rig = Rig()
    rig.bus.write_i2c_block_data(INA, 0x00, [0x0F, 0xFF])
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
