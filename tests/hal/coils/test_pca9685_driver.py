"""Tests of the PCA9685 driver: its writes, its refusals, and the faults that it detects."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Sequence

import pytest

from hal.drivers.pca9685 import FULL_OFF, FULL_ON, Pca9685, prescale_for
from hal.interfaces.errors import NotResponding, OutOfRange, Refused
from sim_hal.emulators.i2c_bus import EmulatedI2cBus
from sim_hal.emulators.pca9685 import EmulatedPca9685
from tests.hal.coils.rig import INA, PCA, Rig
from tests.manual_clock import ManualClock


class Recorder(EmulatedI2cBus):
    """An emulated bus that records all writes."""

    def __init__(self, chip: EmulatedPca9685, clock: ManualClock) -> None:
        super().__init__([chip])
        self._clock = clock
        self.written: list[tuple[int, list[int], int]] = []

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        """Write one byte, and record it with its time."""
        self.written.append((register, [value], self._clock.now_ns()))
        super().write_byte_data(address, register, value)

    def write_i2c_block_data(self, address: int, register: int, values: Sequence[int]) -> None:
        """Write a block, and record it with its time."""
        self.written.append((register, list(values), self._clock.now_ns()))
        super().write_i2c_block_data(address, register, values)


@pytest.fixture
def recorder() -> tuple[Pca9685, Recorder, EmulatedPca9685]:
    """Return a driver, the bus that records its writes, and its chip."""
    clock = ManualClock()
    chip = EmulatedPca9685(PCA, clock.now_ns)
    bus = Recorder(chip, clock)
    return Pca9685(bus, PCA, clock), bus, chip


@pytest.mark.parametrize(("frequency", "prescale"), [(50.0, 121), (200.0, 30), (1525.0, 3), (24.0, 253)])
def test_prescale_values_of_the_data_sheet(frequency: float, prescale: int) -> None:
    """For 200 Hz, PRE_SCALE is the power-on value 0x1E of the data sheet's example; for 50 Hz it is 0x79."""
    assert prescale_for(frequency) == prescale


@pytest.mark.parametrize("frequency", [0.0, 23.0, 1600.0, math.nan, math.inf])
def test_a_frequency_that_the_chip_cannot_make_is_refused(frequency: float) -> None:
    with pytest.raises(OutOfRange, match="PWM frequency"):
        prescale_for(frequency)


def test_set_up_follows_the_data_sheet_with_all_off_first(
    recorder: tuple[Pca9685, Recorder, EmulatedPca9685],
) -> None:
    """The set-up of the chip follows the data sheet, after all channels were switched off.

    The sequence is all off, sleep, PRE_SCALE, wake with auto-increment, a wait of 500 us, totem pole.
    """
    pca, bus, chip = recorder
    pca.configure()
    assert [(register, values) for register, values, _ in bus.written] == [
        (0xFD, [0x10]),
        (0x00, [0x11]),  # at power-on, SLEEP of MODE1 is set; ALLCALL is kept until the wake-up
        (0xFE, [0x79]),
        (0x00, [0x20]),
        (0x01, [0x04]),
    ]
    assert bus.written[4][2] - bus.written[3][2] >= 500_000
    assert chip.frequency == pytest.approx(50.03, abs=0.01)
    assert chip.violations == set()


def test_a_chip_left_running_is_switched_off_before_anything_else(
    recorder: tuple[Pca9685, Recorder, EmulatedPca9685],
) -> None:
    """Channels that a previous process has left driven, with MODE1 = 0x20, are switched off first."""
    pca, bus, chip = recorder
    pca.configure()
    pca.write_channels(0, [FULL_ON, (0, 100)])
    bus.written.clear()
    seen: list[list[float]] = []
    chip.on_stop = lambda written: seen.append([chip.duty(0), chip.duty(1)])
    pca.configure()
    assert bus.written[0][:2] == (0xFD, [0x10])
    assert bus.written[1][:2] == (0x00, [0x30])
    assert seen
    assert all(duties == [0.0, 0.0] for duties in seen)
    assert chip.violations == set()


def test_three_coils_are_one_block_of_24_bytes(recorder: tuple[Pca9685, Recorder, EmulatedPca9685]) -> None:
    pca, bus, chip = recorder
    pca.configure()
    bus.written.clear()
    pca.write_channels(0, [(0, 0x123), FULL_OFF, FULL_OFF, (0, 0xFED), FULL_ON, FULL_OFF])
    off, on = [0, 0, 0, 0x10], [0, 0x10, 0, 0]
    block = [0, 0, 0x23, 0x01, *off, *off, 0, 0, 0xED, 0x0F, *on, *off]
    assert [(register, values) for register, values, _ in bus.written] == [(0x06, block)]
    assert [chip.duty(channel) for channel in range(6)] == [0x123 / 4096, 0.0, 0.0, 0xFED / 4096, 1.0, 0.0]


@pytest.mark.parametrize("counts", [(0, 0), (7, 7), (4096, 4096), (0, 4097), (-1, 5)])
def test_counts_that_the_chip_leaves_undefined_are_refused(counts: tuple[int, int]) -> None:
    rig = Rig()
    with pytest.raises(OutOfRange, match="must differ"):
        rig.pca.write_channels(0, [counts])


@pytest.mark.parametrize(("first", "number"), [(0, 0), (0, 9), (-1, 2), (15, 2)])
def test_channels_that_do_not_exist_or_fit_are_refused(first: int, number: int) -> None:
    rig = Rig()
    with pytest.raises(OutOfRange, match="channel"):
        rig.pca.write_channels(first, [FULL_OFF] * number)


def test_a_brown_out_is_noticed_and_mended(rig: Rig) -> None:
    rig.pca.configure()
    assert rig.pca.is_configured()
    rig.wire.chip.brown_out()
    assert not rig.pca.is_configured()
    rig.pca.configure()
    assert rig.pca.is_configured()


def test_another_part_at_the_address_is_refused_with_the_cure(rig: Rig) -> None:
    """Another chip at the address is refused with a remedy. Both chips have the default address 0x40.

    An INA219 acknowledges each write, but it does not have the registers of a PCA9685.
    """
    with pytest.raises(Refused, match="another chip at this address"):
        Pca9685(rig.bus, INA, rig.clock).configure()


def test_an_outer_clock_that_an_upset_has_chosen_is_cleared_by_a_software_reset(rig: Rig) -> None:
    """EXTCLK of MODE1, set by an upset, is cleared by a software reset.

    No channel is driven during the reset. The bit is sticky: no write of the register clears it.
    """
    rig.pca.configure()
    rig.wire.chip.flip(0x00, 6)
    rig.pca.write_channels(0, [FULL_ON])
    seen: list[float] = []
    rig.wire.chip.on_stop = lambda written: seen.append(rig.wire.chip.duty(0))
    assert not rig.pca.is_configured()
    rig.pca.configure()
    assert rig.pca.is_configured()
    assert rig.wire.chip.frequency == pytest.approx(50.03, abs=0.01)
    assert set(seen) == {0.0}
    assert rig.wire.chip.violations == set()


def test_a_clock_bit_that_no_reset_clears_is_refused(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.wire.chip.flip(0x00, 6)
    monkeypatch.setattr(rig.bus, "write_byte", lambda address, value: None)
    with pytest.raises(Refused, match="power cycle"):
        rig.pca.configure()


def test_a_silent_chip_is_named_with_what_to_check(rig: Rig) -> None:
    rig.wire.bus.detach(rig.wire.chip)
    for action in (rig.pca.configure, rig.pca.is_configured, rig.pca.all_off):
        with pytest.raises(NotResponding, match=r"pca9685 at 0x40: .*no acknowledge"):
            action()


def test_switching_off_works_in_every_state_of_the_chip(rig: Rig) -> None:
    rig.pca.all_off()  # SLEEP is set, as in the state after power-on
    rig.pca.configure()
    rig.pca.write_channels(0, [FULL_ON] * 8)
    rig.pca.write_channels(8, [(0, 2000)] * 8)
    assert min(rig.duties) > 0.0
    rig.pca.all_off()
    assert rig.duties == [0.0] * 16


def test_a_failed_switch_off_is_reported(rig: Rig) -> None:
    rig.pca.configure()
    rig.pca.write_channels(0, [FULL_ON])
    rig.wire.bus.nack(PCA, times=1)
    with pytest.raises(NotResponding, match="could not be switched off"):
        rig.pca.all_off()
    rig.pca.all_off()
    assert rig.duties == [0.0] * 16


def test_the_guardian_imports_no_numpy() -> None:
    """The guardian, which switches the coils off, does not import numpy, so that it starts fast."""
    code = "import sys, hal.guardian, hal.buses.smbus_byte; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=30).returncode == 0
