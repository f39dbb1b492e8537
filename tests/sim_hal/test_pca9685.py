"""Tests of the emulated PCA9685 against the NXP data sheet."""

from __future__ import annotations

import pytest

from sim_hal.emulators.i2c_bus import EmulatedI2cBus
from sim_hal.emulators.pca9685 import EmulatedPca9685
from tests.manual_clock import ManualClock

ADDRESS = 0x41


class Bench:
    """A chip on a bus, in its state after power-on."""

    def __init__(self) -> None:
        self.clock = ManualClock()
        self.chip = EmulatedPca9685(ADDRESS, self.clock.now_ns)
        self.bus = EmulatedI2cBus([self.chip])

    def write(self, register: int, *values: int) -> None:
        """Write consecutive registers in one transaction."""
        self.bus.write_i2c_block_data(ADDRESS, register, values)

    def read(self, register: int, count: int = 1) -> list[int]:
        """Read consecutive registers in one transaction."""
        return self.bus.read_i2c_block_data(ADDRESS, register, count)

    def wake(self) -> None:
        """Wake the chip with auto-increment, and wait for its oscillator."""
        self.write(0x00, 0x20)
        self.clock.advance(500_000)


@pytest.fixture
def bench() -> Bench:
    """Return a new chip."""
    return Bench()


def test_power_on_values(bench: Bench) -> None:
    mode = [bench.read(register)[0] for register in range(6)]
    assert mode == [0x11, 0x04, 0xE2, 0xE4, 0xE8, 0xE0]
    leds = [bench.read(register)[0] for register in range(0x06, 0x46)]
    assert leds == [0x00, 0x00, 0x00, 0x10] * 16
    assert bench.read(0xFE) == [0x1E]
    assert [bench.read(register)[0] for register in range(0xFA, 0xFE)] == [0, 0, 0, 0]


def test_without_auto_increment_all_bytes_go_to_one_register(bench: Bench) -> None:
    bench.write(0x06, 1, 2, 3)
    assert [bench.read(register)[0] for register in (0x06, 0x07, 0x08)] == [3, 0, 0]
    assert bench.read(0x06, 3) == [3, 3, 3]


def test_auto_increment_wraps_after_led15_to_mode1(bench: Bench) -> None:
    bench.wake()
    assert bench.read(0x44, 4) == [0x00, 0x10, 0x20, 0x04]
    bench.write(0x45, 0x10, 0x20, 0x14)
    assert bench.read(0x01) == [0x14]


def test_auto_increment_wraps_after_pre_scale_to_mode1(bench: Bench) -> None:
    bench.wake()
    assert bench.read(0xFD, 3) == [0x00, 0x1E, 0x20]


def test_pre_scale_is_writable_only_asleep_and_is_3_at_least(bench: Bench) -> None:
    bench.write(0xFE, 0x79)
    assert bench.read(0xFE) == [0x79]
    bench.wake()
    bench.write(0xFE, 0x50)
    assert bench.read(0xFE) == [0x79]
    assert bench.chip.violations
    bench.write(0x00, 0x30)
    bench.write(0xFE, 0x00)
    assert bench.read(0xFE) == [0x03]


def test_frequency_follows_pre_scale_and_stops_asleep(bench: Bench) -> None:
    assert bench.chip.frequency == 0.0
    bench.wake()
    assert bench.chip.frequency == pytest.approx(25e6 / (4096 * 31))


def test_reserved_bits_and_registers_read_zero(bench: Bench) -> None:
    bench.wake()
    bench.write(0x06, 0xFF, 0xFF, 0xFF, 0xFF)
    assert bench.read(0x06, 4) == [0xFF, 0x1F, 0xFF, 0x1F]
    bench.write(0x46, 0xAA)
    assert bench.read(0x46) == [0x00]


def test_all_led_registers_write_all_channels(bench: Bench) -> None:
    bench.wake()
    bench.write(0xFA, 0x00, 0x00, 0x00, 0x08)
    assert bench.read(0x06, 32) == [0x00, 0x00, 0x00, 0x08] * 8
    assert [bench.chip.duty(channel) for channel in range(16)] == [0.5] * 16


@pytest.mark.parametrize(
    ("on", "off", "duty"),
    [
        (0x0000, 0x1000, 0.0),  # full OFF
        (0x1000, 0x0000, 1.0),  # full ON
        (0x1000, 0x1000, 0.0),  # full OFF has precedence over full ON
        (409, 1228, 819 / 4096),  # data sheet example 1: 10 % delay, 20 % duty
        # data sheet example 2: 90 % delay, 90 % duty, which continues in the next period
        (3685, 3275, 3686 / 4096),
        (0, 4095, 4095 / 4096),
        (4095, 0, 1 / 4096),
    ],
)
def test_duty_follows_on_and_off_counts(bench: Bench, on: int, off: int, duty: float) -> None:
    bench.wake()
    bench.write(0x0A, on & 0xFF, on >> 8, off & 0xFF, off >> 8)
    assert bench.chip.duty(1) == duty
    assert bench.chip.violations == set()


def test_equal_counts_are_noted_as_a_violation(bench: Bench) -> None:
    bench.wake()
    bench.write(0x06, 5, 0, 5, 0)
    assert bench.chip.duty(0) == 0.0
    assert bench.chip.violations == {"LED0: ON count = OFF count = 5"}


def test_sleep_stops_the_outputs_and_restart_brings_them_back(bench: Bench) -> None:
    """Sleep stops the outputs, and a write of RESTART starts the outputs again (data sheet 7.3.1.1).

    RESTART is set by sleep while a channel runs, and is cleared by a write.
    """
    bench.wake()
    bench.write(0x06, 0, 0, 0, 0x08)
    bench.write(0x00, 0x30)
    assert bench.chip.duty(0) == 0.0
    assert bench.read(0x00) == [0xB0]
    bench.write(0x00, 0x20)
    bench.clock.advance(500_000)
    assert bench.read(0x00) == [0xA0]
    assert bench.chip.duty(0) == 0.0
    bench.write(0x00, 0xA0)
    assert bench.read(0x00) == [0x20]
    assert bench.chip.duty(0) == 0.5
    assert bench.chip.violations == set()


def test_restart_too_soon_after_waking_does_nothing(bench: Bench) -> None:
    bench.wake()
    bench.write(0x06, 0, 0, 0, 0x08)
    bench.write(0x00, 0x30)
    bench.write(0x00, 0x20)
    bench.clock.advance(499_000)
    bench.write(0x00, 0xA0)
    assert bench.chip.duty(0) == 0.0
    assert bench.chip.violations == {"RESTART within 500 us of waking"}


def test_an_orderly_shutdown_leaves_no_restart(bench: Bench) -> None:
    bench.wake()
    bench.write(0x06, 0, 0, 0, 0x08)
    bench.write(0xFD, 0x10)
    bench.write(0x00, 0x30)
    assert bench.read(0x00) == [0x30]


def test_writing_a_channel_takes_the_place_of_restart(bench: Bench) -> None:
    bench.wake()
    bench.write(0x06, 0, 0, 0, 0x08)
    bench.write(0x00, 0x30)
    bench.wake()
    bench.write(0x06, 0, 0, 0, 0x04)
    assert bench.chip.duty(0) == 0.25
    assert bench.read(0x00) == [0x20]


def test_the_external_clock_bit_sticks_until_a_reset(bench: Bench) -> None:
    bench.write(0x00, 0x50)
    assert bench.read(0x00) == [0x50]
    bench.write(0x00, 0x20)
    assert bench.read(0x00) == [0x60]
    assert bench.chip.frequency == 0.0
    bench.bus.send(0x00, b"\x06")
    assert bench.read(0x00) == [0x11]


def test_inverted_outputs_and_the_output_enable_pin(bench: Bench) -> None:
    bench.wake()
    bench.write(0x06, 0, 0, 0, 0x04)
    bench.write(0x01, 0x14)
    assert (bench.chip.duty(0), bench.chip.duty(1)) == (0.75, 1.0)
    bench.chip.output_enable = False
    assert (bench.chip.duty(0), bench.chip.duty(1)) == (0.0, 0.0)


def test_software_reset_is_one_byte_to_the_general_call(bench: Bench) -> None:
    bench.wake()
    bench.bus.send(0x00, b"\x06\x06")
    assert bench.read(0x00) == [0x20]
    bench.bus.send(0x00, b"\x06")
    assert bench.read(0x00) == [0x11]


def test_all_call_reaches_every_chip_that_has_it_enabled() -> None:
    clock = ManualClock()
    chips = [EmulatedPca9685(address, clock.now_ns) for address in (0x40, 0x41, 0x42)]
    bus = EmulatedI2cBus(chips)
    for chip in chips:
        bus.write_byte_data(chip.address, 0x00, 0x21)
    bus.write_byte_data(0x42, 0x00, 0x20)
    bus.write_i2c_block_data(0x70, 0x06, [0, 0, 0, 8])
    assert [chip.duty(0) for chip in chips] == [0.5, 0.5, 0.0]


def test_of_two_chips_that_answer_one_read_the_zeros_win() -> None:
    clock = ManualClock()
    bus = EmulatedI2cBus([EmulatedPca9685(address, clock.now_ns) for address in (0x40, 0x41)])
    for address, value in ((0x40, 0x1C), (0x41, 0x07)):
        bus.write_byte_data(address, 0x06, value)
    assert bus.read_byte_data(0x70, 0x06) == 0x04


def test_a_moved_all_call_address_is_followed(bench: Bench) -> None:
    bench.write(0x05, 0x6F << 1)
    assert bench.chip.answers(0x6F)
    assert not bench.chip.answers(0x70)
    bench.write(0x00, 0x10)
    assert not bench.chip.answers(0x6F)


def test_outputs_change_once_per_transaction_at_its_stop(bench: Bench) -> None:
    bench.wake()
    stops: list[int] = []
    bench.chip.on_stop = stops.append
    bench.write(0x0A, *[0, 0, 0, 8] * 3)
    bench.read(0x06, 8)
    bench.write(0x00, 0x20)
    assert stops == [0b1110, 0]


def test_a_brown_out_is_a_power_on(bench: Bench) -> None:
    bench.wake()
    bench.write(0x06, 0, 0, 0, 8)
    bench.chip.brown_out()
    assert bench.chip.duty(0) == 0.0
    assert bench.read(0x00) == [0x11]
    assert bench.read(0x09) == [0x10]


def test_a_power_on_and_an_upset_change_all_outputs_at_once(bench: Bench) -> None:
    bench.wake()
    stops: list[int] = []
    bench.chip.on_stop = stops.append
    bench.chip.brown_out()
    bench.chip.upset(0x06, 1)
    bench.chip.flip(0x06, 1)
    bench.bus.write_byte(0x00, 0x06)
    assert stops == [0xFFFF] * 4
    assert bench.read(0x06) == [0]


def test_a_flipped_bit_stays_zero_where_the_data_sheet_reserves_it(bench: Bench) -> None:
    bench.chip.flip(0x07, 5)
    bench.chip.flip(0x07, 4)
    assert bench.read(0x07) == [0x10]
