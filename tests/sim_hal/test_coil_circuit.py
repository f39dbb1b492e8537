"""Tests of the coil circuit: currents of the bridges, supply current, and the emulated INA219."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.drivers.coils import CoilWiring
from hal.drivers.pca9685 import FULL_OFF, FULL_ON, PwmCounts
from sim_hal.emulators.coil_circuit import Bridge, Chopping, CoilCircuit, EmulatedIna219, conversion_ns
from tests.hal.coils.rig import INA, THESIS, THESIS_COILS, Rig
from tests.manual_clock import ManualClock

FULL = 3.4 / 23.0
PULSE = st.tuples(st.integers(0, 4095), st.integers(0, 4096))


@pytest.mark.parametrize(
    ("input_a", "input_b", "current"),
    [
        (FULL_ON, FULL_ON, 0.0),  # H H: 0 V
        (FULL_ON, FULL_OFF, FULL),  # H L: V_supply, CW
        (FULL_OFF, FULL_ON, -FULL),  # L H: V_supply, CCW
        (FULL_OFF, FULL_OFF, 0.0),  # L L: 0 V
        ((0, 1024), FULL_OFF, FULL / 4),
        ((0, 2048), (1024, 3072), 0.0),  # phases of the bridge: positive, brake, negative
        ((0, 2048), (0, 1024), FULL / 4),  # both inputs high: brake
        ((3000, 1000), FULL_OFF, FULL * 2096 / 4096),  # the pulse continues across the end of the period
    ],
)
def test_the_voltage_of_the_coil_is_that_of_table_5_2(
    input_a: PwmCounts, input_b: PwmCounts, current: float
) -> None:
    rig = Rig()
    rig.pca.configure()
    rig.pca.write_channels(0, [input_a, input_b])
    assert rig.currents() == pytest.approx([current, 0.0, 0.0], abs=1e-15)


def test_the_uncertainty_is_uniform_within_its_bound_and_drawn_at_each_command() -> None:
    """The current error is uniform within 3.5 mA, and is drawn at each command.

    The standard deviation of the error is 3.5e-3/sqrt(3) A, which 2,000 random draws determine to within 8 %
    (5 sigma).
    """
    rig = Rig(uncertainty=3.5e-3)
    rig.coils.start()
    errors = []
    for _ in range(2000):
        rig.command(0.1, -0.05, 0.0)
        x, y, z = rig.currents()
        errors.append((x - rig.coils.state().current[0], y - rig.coils.state().current[1]))
        assert z == 0.0, "none at zero command"
    spread = np.array(errors)
    assert np.all(np.abs(spread) <= 3.5e-3)
    assert np.max(np.abs(spread)) > 3.4e-3
    assert np.std(spread, axis=0) == pytest.approx([3.5e-3 / 3**0.5] * 2, rel=0.08)
    assert np.abs(np.mean(spread, axis=0)).max() < 5 * 3.5e-3 / 3**0.5 / 2000**0.5
    assert abs(np.corrcoef(spread.T)[0, 1]) < 5 / 2000**0.5


def test_the_current_keeps_its_error_until_the_coil_is_written_again() -> None:
    rig = Rig(uncertainty=3.5e-3)
    rig.coils.start()
    rig.command(0.1, 0.0, 0.0)
    before = rig.currents()
    assert rig.pca.is_configured()
    rig.pca.write_channels(2, [FULL_OFF, FULL_OFF])
    assert rig.currents() == before
    rig.command(0.1, 0.0, 0.0)
    assert rig.currents() != before


def test_the_true_current_never_passes_the_limit() -> None:
    rig = Rig(uncertainty=3.5e-3)
    rig.coils.start()
    for sign in (1.0, -1.0):
        for _ in range(50):
            rig.command(sign, sign, sign)
            assert max(map(abs, rig.currents())) <= FULL
    limited = Rig(replace(rig.settings, current_limit=0.1), uncertainty=3.5e-3)
    limited.coils.start()
    for _ in range(50):
        limited.command(1.0, 1.0, 1.0)
        assert max(limited.currents()) <= 0.1


def test_the_same_seed_gives_the_same_currents() -> None:
    def fly() -> list[list[float]]:
        rig = Rig(uncertainty=3.5e-3)
        rig.coils.start()
        flowing = []
        for step in range(20):
            rig.command(0.01 * step, 0.0, -0.05)
            rig.clock.advance(25_000_000)
            flowing.append(rig.currents())
        return flowing

    assert fly() == fly()


def test_the_current_depends_on_the_true_resistance_of_the_coil() -> None:
    """A coil of 20 ohm that the driver assumes to have 23 ohm carries 0.115 A instead of 0.1 A."""
    rig = Rig()
    truth = replace(THESIS, coils=(CoilWiring(0, 1, 20.0), *THESIS_COILS[1:]))
    circuit = CoilCircuit(rig.wire.chip, truth, np.random.default_rng(1), rig.clock.now_ns, uncertainty=0.0)
    rig.coils.start()
    rig.command(0.1, 0.0, 0.0)
    assert circuit.currents()[0] == pytest.approx(0.115, abs=1e-4)


def test_a_sleeping_or_browned_out_chip_carries_no_current() -> None:
    rig = Rig()
    rig.coils.start()
    rig.command(0.1, 0.1, 0.1)
    rig.bus.write_byte_data(0x40, 0x00, 0x30)
    assert rig.currents() == [0.0, 0.0, 0.0]


@given(a=PULSE, b=PULSE, begin=st.integers(0, 100_000_000), span=st.integers(100_000, 68_100_000))
def test_the_chopped_charge_agrees_with_sampling_the_bridge(
    a: tuple[int, int], b: tuple[int, int], begin: int, span: int
) -> None:
    """The charge of chopped currents agrees with samples of the bridge.

    The reference samples the middle of 20,000 slices. Each edge may be wrong by one slice.
    """
    period = 20_000_000.0
    chopping = Chopping(0, 0, period, ((Bridge(a, b), 0.148),))
    count = 20_000
    times = begin + span * (np.arange(count) + 0.5) / count
    at = times / period % 1.0 * 4096
    on_a, on_b = ((at - first) % 4096 < length for first, length in (a, b))
    sampled = 0.148 * np.mean(on_a != on_b)
    edges = 4 * (span / period + 2)
    assert chopping.charge(begin, begin + span) / span == pytest.approx(sampled, abs=0.148 * edges / count)


def test_the_supply_is_chopped_and_its_mean_over_whole_periods_is_the_sum_of_magnitudes() -> None:
    rig = Rig()
    rig.coils.start()
    rig.command(0.1, -0.05, 0.0)
    rig.clock.advance(1)
    begin = rig.clock.now_ns()
    period = round(1e9 / rig.wire.chip.frequency)
    rig.clock.advance(3 * period)
    supply = rig.wire.circuit.mean_supply
    volts, amps = supply(begin, begin + 3 * period)
    assert volts == 3.4
    assert amps == pytest.approx(0.15, abs=1e-4)
    slices = [supply(begin + k * period // 500, begin + (k + 1) * period // 500)[1] for k in range(500)]
    assert max(slices) == pytest.approx(2 * FULL, rel=1e-3), "both coils driven at once"
    assert min(slices) == 0.0


def test_a_single_conversion_of_the_chopped_current_is_off_by_up_to_18_percent() -> None:
    """A single ADC sample of the chopped current is off by up to 18 %.

    A sample of 68.1 ms contains up to 4 pulses, and 3.4 pulses on average (`hal.drivers.current_monitors`).
    """
    rig = Rig()
    rig.coils.start()
    rig.command(0.05, 0.0, 0.0)
    begin = rig.clock.now_ns()
    rig.clock.advance(100_000_000)
    window = 68_100_000
    starts = begin + np.linspace(0, 20_000_000, 400).astype(int)
    ratios = [rig.wire.circuit.mean_supply(int(at), int(at) + window)[1] / 0.05 for at in starts]
    assert 1.15 < max(ratios) < 1.19
    assert 0.81 < min(ratios) < 0.89


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
