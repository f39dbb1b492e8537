"""Tests of register upsets and of a delayed current monitor: their effects, and corrections by drivers."""

from __future__ import annotations

import re

import numpy as np
import pytest

from flight.schema import reader as configuration
from hal.drivers.current_monitors import Ina219
from hal.drivers.pca9685 import LED0_ON_L, MODE1, MODE2, PRE_SCALE
from sim_hal.clock import SimClock
from sim_hal.emulators.coil_circuit import CALIBRATION, CONFIG
from sim_hal.faults.catalogue import Bench
from sim_hal.faults.schedule import parse, put
from sim_hal.rig import build_lockstep
from tests.hal.coils.rig import INA, Rig
from tests.hal.vn100.bench_line import bench_line
from tests.support.flights import demo_config, demo_world

MS = 1_000_000
CYCLE_NS = 25 * MS
UPSETS = ("pwm: upset", "monitor: upset", "imu: upset")


def driven_rig() -> Rig:
    """Return coils that have received a command in each cycle for one second."""
    rig = Rig()
    rig.coils.start()
    for _ in range(40):
        drive(rig)
    return rig


def drive(rig: Rig) -> None:
    rig.clock.sleep_until_ns(rig.clock.now_ns() + CYCLE_NS)
    rig.command(0.06, 0.0, -0.03)


@pytest.mark.parametrize(
    ("register", "bit"),
    [(MODE1, bit) for bit in range(6)]
    + [(MODE2, bit) for bit in range(5)]
    + [(PRE_SCALE, bit) for bit in range(8)],
)
def test_a_bit_of_the_chips_set_up_is_measured_and_mended_within_half_a_second(
    register: int, bit: int
) -> None:
    rig = driven_rig()
    sound = rig.wire.chip.register(register)
    rig.wire.chip.flip(register, bit)
    assert rig.wire.chip.register(register) ^ sound == 1 << bit
    errors = []
    for _ in range(60):
        drive(rig)
        errors.append(rig.coils.state().error)
    assert any("lost its register settings" in error for error in errors[:22])
    assert not any(errors[44:])
    assert rig.wire.chip.register(register) == sound
    assert rig.currents() == pytest.approx(rig.coils.state().current.tolist(), abs=1e-3)


def test_a_bit_of_an_output_changes_its_coil_until_the_next_command() -> None:
    rig = driven_rig()
    before = rig.currents()
    rig.wire.chip.flip(LED0_ON_L + 3, 3)  # the pin of x goes low half a PWM period later
    assert abs(rig.currents()[0] - before[0]) > 0.02
    drive(rig)
    drive(rig)
    assert rig.currents() == pytest.approx(before, abs=1e-3)


def test_a_bit_that_does_not_exist_stays_zero() -> None:
    chip = Rig().wire.chip
    chip.flip(MODE2, 7)
    assert chip.register(MODE2) == 0x04
    chip.flip(MODE1, 0)
    assert not chip.answers(0x70), "the ALLCALL bit exists"


@pytest.mark.parametrize("bit", [bit for bit in range(16) if bit != 14])
def test_a_bit_of_the_monitors_set_up_is_measured_and_mended(bit: int) -> None:
    rig = Rig()
    monitor = Ina219(rig.bus, INA, rig.clock)
    rig.clock.sleep_until_ns(3000 * MS)
    assert not monitor.error()
    sound = rig.wire.monitor.register(CONFIG)
    rig.wire.monitor.upset(CONFIG, bit)
    assert rig.wire.monitor.register(CONFIG) != sound
    rig.clock.sleep_until_ns(3250 * MS)
    assert "had lost its set-up" in monitor.error()
    rig.clock.sleep_until_ns(5000 * MS)
    assert not monitor.error()
    assert rig.wire.monitor.register(CONFIG) == sound


def test_an_upset_of_the_calibration_of_the_monitor_has_no_effect() -> None:
    rig = Rig()
    monitor = Ina219(rig.bus, INA, rig.clock)
    rig.coils.start()
    for cycle in range(160):
        if cycle == 80:
            rig.wire.monitor.upset(CALIBRATION, 12)
            rig.wire.monitor.upset(CALIBRATION, 0)
        drive(rig)
        assert not monitor.error()
    assert rig.wire.monitor.register(CALIBRATION) == 0x1000
    reading = monitor.latest()
    assert reading is not None
    assert reading.current == pytest.approx(0.09, rel=0.1)


@pytest.mark.parametrize(
    ("register", "bit"),
    [
        (75, 0),  # no port
        (75, 9),  # ports that do not exist
        (75, 20),  # rate above the capacity of the line
        (75, 24),  # an output that is too infrequent for any user
        (75, 32),  # output without any group
        (75, 41),  # an output group that the VN-100 does not have
        (75, 52),  # without the attitude
        (75, 62),  # fields that the VN-100 does not have
    ],
)
def test_a_unit_whose_output_is_upset_is_set_up_again_within_two_seconds(register: int, bit: int) -> None:
    bench = bench_line()
    bench.driver.configure()
    bench.run(0.5)
    bench.unit.upset(register, bit, bench.clock.now_ns())
    assert len(bench.run(1.0)) < 37, "an upset that shows"
    bench.run(1.0)
    assert bench.driver.recoveries == 1
    assert len(bench.run(1.0)) == pytest.approx(40, abs=1)


@pytest.mark.parametrize(
    ("register", "bit"),
    # Upsets that change the output rate, change a field, or add sentences to the packets.
    [*((75, bit) for bit in (16, 17, 18, 19, 21, 22, 23, 48)), (6, 1), (6, 3)],
)
def test_a_unit_with_additional_or_missing_outputs_is_set_up_again(register: int, bit: int) -> None:
    bench = bench_line()
    bench.driver.configure()
    bench.run(0.5)
    bench.unit.upset(register, bit, bench.clock.now_ns())
    bench.run(2.0)
    assert bench.driver.recoveries == 1
    assert len(bench.run(1.0)) == pytest.approx(40, abs=1)
    link = bench.driver.link()
    assert link.upsets == 1
    assert re.search("output that was not requested|at a wrong rate", link.upset)


@pytest.mark.parametrize(("register", "bit"), [(6, 9), (7, 12), (75, 1), (75, 100)])
def test_an_upset_that_leaves_the_readings_as_they_are_needs_nothing(register: int, bit: int) -> None:
    bench = bench_line()
    bench.driver.configure()
    bench.run(0.5)
    before = bench.unit.registers.read(register)
    bench.unit.upset(register, bit, bench.clock.now_ns())
    assert (bench.unit.registers.read(register) != before) == (bit < 100)
    assert len(bench.run(2.0)) == pytest.approx(80, abs=1)
    assert bench.driver.recoveries == 0
    assert (bench.driver.link().upsets, bench.driver.link().upset) == (0, "")


@pytest.mark.parametrize("name", UPSETS)
def test_an_upset_without_a_stated_register_changes_a_random_register(name: str) -> None:
    """An upset without a stated register changes a random register.

    40 upsets give more than ten different results.
    """
    lock = build_lockstep(configuration.replace(demo_config(10.0)), demo_world(), None, SimClock())
    hardware = lock.hardware
    assert hardware.monitor is not None
    seen = set()
    for number in range(40):
        bench = Bench(hardware, lock.line, lock.clock.now_ns, np.random.default_rng(number), lock.line.host)
        put([parse(f"{name} @ {number + 1}")], bench, 0)
        lock.clock.sleep_until_ns((number + 2) * 1_000_000_000)
        words = [hardware.pwm.register(register) for register in (MODE1, MODE2, PRE_SCALE)]
        words += [hardware.monitor.register(register) for register in (CONFIG, CALIBRATION)]
        seen.add((*words, *(hardware.unit.registers.read(register) for register in (6, 7, 75))))
    assert len(seen) > 10


def test_a_delayed_monitor_reports_the_current_of_two_seconds_ago() -> None:
    rig = Rig()
    monitor = Ina219(rig.bus, INA, rig.clock, averaged=1)
    rig.coils.start()
    rig.wire.monitor.lag_ns = 2000 * MS
    measured = []
    for cycle in range(240):
        rig.clock.sleep_until_ns(cycle * CYCLE_NS)
        rig.command(0.06 if cycle >= 80 else 0.0, 0.0, 0.0)
        reading = monitor.latest()
        measured.append(0.0 if reading is None else reading.current)
        assert not monitor.error()
    assert max(measured[:160]) < 5e-3, "nothing was driven two seconds ago"
    assert min(measured[180:]) > 0.04
    rig.wire.monitor.lag_ns = 0
    rig.command(0.0, 0.0, 0.0)
    rig.clock.sleep_until_ns(rig.clock.now_ns() + 1000 * MS)
    reading = monitor.latest()
    assert reading is not None
    assert reading.current < 5e-3
