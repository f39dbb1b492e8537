"""Tests of the emulated current monitor against the data sheet of the INA219 (TI SBOS448G)."""

from __future__ import annotations

import pytest

from sim_hal.emulators.coil_circuit import EmulatedIna219, conversion_ns
from tests.hal.coils.rig import INA
from tests.manual_clock import ManualClock

CYCLE = 2 * 68_100_000


class Part:
    """An emulated current monitor with constant inputs."""

    def __init__(self, volts: float, amps: float, shunt_ohm: float) -> None:
        self.clock = ManualClock()
        self.windows: list[tuple[int, int]] = []
        self.inputs = (volts, amps)
        self.chip = EmulatedIna219(INA, self.clock.now_ns, self._measure, shunt_ohm)

    def _measure(self, start_ns: int, end_ns: int) -> tuple[float, float]:
        self.windows.append((start_ns, end_ns))
        return self.inputs

    def write(self, register: int, word: int) -> None:
        """Write a 16-bit word, big-endian."""
        self.chip.write(INA, bytes((register, word >> 8, word & 0xFF)))

    def read(self, register: int) -> int:
        """Read a 16-bit word, big-endian."""
        self.chip.write(INA, bytes((register,)))
        return int.from_bytes(self.chip.read(2), "big")


def test_power_on_values() -> None:
    part = Part(3.4, 0.1, 0.1)
    assert [part.read(register) for register in range(6)] == [0x399F, 0, 0, 0, 0, 0]


def test_the_worked_example_of_the_data_sheet() -> None:
    """The registers have the values of the data sheet's worked example (SBOS448).

    The example has 10 A in 2 mohm at 11.98 V, with LSBs of 1 mA and 20 mW.
    """
    part = Part(11.98, 10.0, 0.002)
    part.write(0x00, 0x019F)
    part.write(0x05, 0x5000)
    part.clock.advance(2 * 532_000)
    assert part.read(0x01) == 0x07D0
    assert part.read(0x02) == 0x5D98 | 0b10  # the table of the data sheet omits the ready bit
    assert part.read(0x04) == 0x2710
    assert part.read(0x03) == 0x1766
    assert part.read(0x02) == 0x5D98  # the read of the Power register has cleared the ready bit


def test_current_and_power_are_zero_while_calibration_is_void() -> None:
    part = Part(11.98, 10.0, 0.002)
    part.clock.advance(2 * 532_000)
    assert (part.read(0x04), part.read(0x03)) == (0, 0)
    part.write(0x05, 0x0001)
    assert part.read(0x05) == 0


def test_overflow_of_the_mathematics_is_flagged() -> None:
    part = Part(11.98, 10.0, 0.002)
    part.write(0x05, 0xFFFE)
    part.clock.advance(2 * 532_000)
    assert not part.read(0x02) & 1, "2000 x 65534 / 4096 = 31999 still fits"
    part.inputs = (11.98, 10.5)
    part.clock.advance(2 * 532_000)
    assert part.read(0x02) & 1


@pytest.mark.parametrize(
    ("config", "millivolts", "word"),
    [
        (0x019F, 40.0, 0x0FA0),  # full scale of each range, by the shunt tables of the data sheet
        (0x019F, 50.0, 0x0FA0),
        (0x099F, 80.0, 0x1F40),
        (0x119F, 160.0, 0x3E80),
        (0x199F, 320.0, 0x7D00),
        (0x199F, -320.0, 0x8300),
        (0x019F, -40.0, 0xF060),
        (0x199F, -0.01, 0xFFFF),
    ],
)
def test_shunt_words_of_the_data_sheet(config: int, millivolts: float, word: int) -> None:
    part = Part(5.0, millivolts * 1e-3 / 0.1, 0.1)
    part.write(0x00, config)
    part.clock.advance(2 * 532_000)
    assert part.read(0x01) == word


@pytest.mark.parametrize(
    ("code", "microseconds"),
    [(0, 84), (1, 148), (2, 276), (3, 532), (4, 84), (8, 532), (9, 1060), (12, 8510), (15, 68100)],
)
def test_conversion_times_of_the_data_sheet(code: int, microseconds: int) -> None:
    assert conversion_ns(code) == microseconds * 1000


def test_fewer_bits_give_coarser_steps() -> None:
    part = Part(5.0, 0.0123, 0.1)  # 1.23 mV is 123 steps at 12 bits
    part.write(0x00, 0x0007)  # resolution of 9 bits
    part.clock.advance(2 * 84_000)
    assert part.read(0x01) == 120


def test_a_conversion_is_ready_when_its_whole_window_has_passed() -> None:
    part = Part(3.4, 0.1, 0.1)
    part.write(0x00, 0x0FFF)
    begin = part.clock.now_ns()
    part.clock.advance(CYCLE - 1)
    assert not part.read(0x02) & 0b10
    part.clock.advance(1)
    assert part.read(0x02) & 0b10
    assert part.windows == [(begin, begin + 68_100_000), (begin + 68_100_000, begin + CYCLE)]


def test_a_triggered_conversion_happens_once_and_power_down_none() -> None:
    part = Part(3.4, 0.1, 0.1)
    part.write(0x00, 0x0FFB)
    part.clock.advance(CYCLE)
    part.read(0x03)
    part.clock.advance(10 * CYCLE)
    assert not part.read(0x02) & 0b10
    part.write(0x00, 0x0FF8)
    part.clock.advance(10 * CYCLE)
    assert not part.read(0x02) & 0b10


def test_the_reset_bit_is_a_power_on() -> None:
    part = Part(3.4, 0.1, 0.1)
    part.write(0x05, 0x1000)
    part.write(0x00, 0x8000)
    assert (part.read(0x00), part.read(0x05)) == (0x399F, 0)


def steps(volts: float, amps: float, config: int, shunt_ohm: float = 0.1) -> tuple[int, int]:
    """Return the words of the shunt (10 uV) and of the bus (4 mV) after one conversion."""
    part = Part(volts, amps, shunt_ohm)
    part.write(0x00, config)
    part.clock.advance(CYCLE)
    return part.read(0x01), part.read(0x02) >> 3


@pytest.mark.parametrize(("bits", "step"), [(0, 8), (1, 4), (2, 2), (3, 1)])
def test_shunt_and_bus_have_the_resolution_of_their_own_code(bits: int, step: int) -> None:
    """Shunt and bus have the resolutions of their own codes, 9 to 12 bits (SBOS448, Table 5).

    BADC is bits 7 to 10, and SADC is bits 3 to 6.
    """
    volts, amps = 1003 * 4e-3, 1003 * 10e-6 / 0.1
    coarse = round(1003 / step) * step
    assert steps(volts, amps, 0x3800 | bits << 7 | 0b0011 << 3 | 0b111) == (1003, coarse)
    assert steps(volts, amps, 0x3800 | 0b0011 << 7 | bits << 3 | 0b111) == (coarse, 1003)


def test_averaged_conversions_have_12_bits() -> None:
    for code in range(8, 16):
        assert steps(1003 * 4e-3, 1003e-4, 0x3800 | code << 7 | code << 3 | 0b111) == (1003, 1003)


@pytest.mark.parametrize(("config", "volts", "word"), [
    (0x199F, 15.9, 3975), (0x199F, 16.1, 4000), (0x399F, 16.1, 4025), (0x399F, 31.9, 7975),
    (0x399F, 33.0, 8000), (0x199F, -1.0, 0),
])  # fmt: skip
def test_the_bus_range_is_16_or_32_v(config: int, volts: float, word: int) -> None:
    """The bus range is 16 V or 32 V by bit 13 (BRNG, SBOS448), in steps of 4 mV."""
    assert steps(volts, 0.0, config)[1] == word


@pytest.mark.parametrize(
    ("mode", "spent_ns"), [(0b101, 276_000), (0b110, 8_510_000), (0b111, 276_000 + 8_510_000)]
)
def test_a_cycle_converts_what_the_mode_names(mode: int, spent_ns: int) -> None:
    """A cycle converts only the inputs that the mode names, and the other register keeps its content.

    The shunt has code 2 (276 us), and the bus has code 12 (8.51 ms).
    """
    part = Part(4.0, 0.1, 0.1)
    part.write(0x00, 0x1800 | 12 << 7 | 2 << 3 | mode)
    part.clock.advance(spent_ns - 1)
    assert not part.read(0x02) & 0b10
    part.clock.advance(1)
    assert part.read(0x02) & 0b10
    assert part.read(0x01) == (1000 if mode & 0b001 else 0)
    assert part.read(0x02) >> 3 == (1000 if mode & 0b010 else 0)
    assert [end - begin for begin, end in part.windows] == {
        0b101: [276_000], 0b110: [8_510_000], 0b111: [276_000, 8_510_000],
    }[mode]  # fmt: skip


def test_a_write_of_config_clears_the_ready_bit_unless_it_stops_the_conversions() -> None:
    for config, ready in ((0x399F, False), (0x3998, True), (0x399C, True)):
        part = Part(4.0, 0.1, 0.1)
        part.clock.advance(CYCLE)
        part.write(0x00, config)
        assert bool(part.read(0x02) & 0b10) is ready


def test_only_config_and_calibration_can_be_written_and_reserved_bits_read_zero() -> None:
    part = Part(4.0, 0.1, 0.1)
    for register in (1, 2, 3, 4):
        part.write(register, 0x1234)
        assert part.read(register) == 0
    part.write(0x00, 0x7FF8)
    part.write(0x05, 0xFFFF)
    assert (part.read(0x00), part.read(0x05)) == (0x3FF8, 0xFFFE)
    assert part.chip.register(6) == 0


def test_a_read_beyond_the_word_gives_the_level_of_the_idle_bus() -> None:
    part = Part(4.0, 0.1, 0.1)
    part.chip.write(INA, b"\x00")
    assert part.chip.read(4) == b"\x39\x9f\xff\xff"
    assert part.chip.read(1) == b"\x39"
    assert part.chip.answers(INA)
    assert not part.chip.answers(INA + 1)


def test_a_negative_current_is_shown_in_current_and_as_a_positive_power() -> None:
    """The register Current is signed (two's complement), and the register Power is positive.

    A current of -0.1 A in 0.1 ohm is -1000 steps, also with the calibration 4096.
    """
    part = Part(4.0, -0.1, 0.1)
    part.write(0x05, 0x1000)
    part.clock.advance(CYCLE)
    assert part.read(0x04) == 0x10000 - 1000
    assert part.read(0x03) == 1000 * 1000 // 5000


def test_flipped_bits_change_config_and_calibration_only() -> None:
    part = Part(4.0, 0.1, 0.1)
    part.write(0x05, 0x1000)
    part.chip.upset(0x00, 3)
    part.chip.upset(0x05, 0)
    part.chip.upset(0x05, 4)
    part.chip.upset(0x03, 4)
    assert (part.read(0x00), part.read(0x05)) == (0x399F ^ 1 << 3, 0x1010)
    part.chip.upset(0x00, 15)
    assert (part.read(0x00), part.read(0x05)) == (0x399F, 0)


def test_a_gain_error_and_a_lag_change_what_is_reported() -> None:
    part = Part(4.0, 0.1, 0.1)
    part.chip.gain = 1.2
    part.clock.advance(CYCLE)
    assert part.read(0x01) == 1200
    part.chip.gain = 1.0
    part.clock.advance(CYCLE)
    assert part.read(0x01) == 1000
    part.chip.lag_ns = CYCLE
    assert part.read(0x01) == 1200
    part.clock.advance(CYCLE)
    assert part.read(0x01) == 1000
    part.chip.frozen[0x01] = 77
    assert part.read(0x01) == 77
