"""Tests with random answers of PWM chip, current monitor and solar cells, and with damaged GPS fixes."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from random import Random

import numpy as np
from hypothesis import given

from hal.drivers.current_monitors import AdsSolarStrings, Ina219, StringWiring
from hal.drivers.gps import NAV_PVT, UbxParser, frame, reading_of, unpack_pvt
from hal.drivers.pca9685 import Pca9685
from hal.interfaces.errors import DeviceError, OutOfRange
from tests.hal.gps.bench_line import PVT
from tests.manual_clock import ManualClock
from tests.support.damaged import Files, assert_one_line, chances, offer


class Nonsense:
    """A bus whose devices keep some of the written bytes, return random bytes, or fail."""

    def __init__(self, chance: Random) -> None:
        self._chance = chance
        self._kept: dict[tuple[int, int], list[int]] = {}
        self._honest, self._failing = chance.random(), 0.3 * chance.random() ** 2

    def write_byte(self, address: int, value: int) -> None:
        self._fail()

    def read_byte_data(self, address: int, register: int) -> int:
        return self.read_i2c_block_data(address, register, 1)[0]

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        self.write_i2c_block_data(address, register, [value])

    def read_i2c_block_data(self, address: int, register: int, length: int) -> list[int]:
        self._fail()
        kept = self._kept.get((address, register), [])
        if len(kept) == length and self._chance.random() < self._honest:
            return list(kept)
        if self._chance.random() < 0.3:
            return [self._chance.choice((0xFF, 0x00))] * length
        return list(self._chance.randbytes(length))

    def write_i2c_block_data(self, address: int, register: int, values: Sequence[int]) -> None:
        self._fail()
        self._kept[address, register] = list(values)

    def close(self) -> None: ...

    def _fail(self) -> None:
        if self._chance.random() < self._failing:
            raise OSError(self._chance.choice((errno.EIO, errno.ENXIO, errno.ETIMEDOUT)), "no answer")


@given(chances())
def test_a_pwm_chip_that_answers_anything_is_refused_in_one_line(chance: Random) -> None:
    chip = Pca9685(Nonsense(chance), 0x40, ManualClock())
    for action in (chip.configure, chip.is_configured, chip.all_off):
        try:
            action()
        except DeviceError as error:
            assert_one_line(error)


@given(chances())
def test_a_current_monitor_shows_only_what_it_can_measure(chance: Random) -> None:
    clock = ManualClock()
    monitor = Ina219(Nonsense(chance), 0x45, clock)
    clock.advance(1_500_000_000)
    power = monitor.latest()
    monitor.close()
    assert power is None or (0.0 <= power.voltage <= 33.0 and abs(power.current) <= 3.3)


@given(chances())
def test_solar_cells_show_only_currents_that_the_converter_can_measure(chance: Random) -> None:
    clock = ManualClock()
    wiring = [StringWiring(0x48, channel, 40.0) for channel in range(4)]
    strings = AdsSolarStrings(Nonsense(chance), clock, wiring)
    clock.advance(1_500_000_000)
    reading = strings.latest()
    strings.close()
    assert reading is None or np.all(np.abs(reading.currents) <= 2.048 / 40.0)


@given(chances())
def test_a_position_fix_is_in_range_or_refused_and_a_good_frame_behind_damage_is_found(
    chance: Random,
) -> None:
    good = frame(NAV_PVT, PVT.packed(1000))

    def read(files: Files, whole: bool) -> None:
        parser = UbxParser()
        found = parser.feed(files["line"]) + parser.feed(bytes(3000) + good)
        assert (found[-1][0], found[-1][1]) == (NAV_PVT, good[6:-2])
        for kind, content, _ in found:
            if kind == NAV_PVT and len(content) == len(good) - 8:
                reading = reading_of(unpack_pvt(content), 10**12, 115_200)
                assert np.all(np.isfinite((*reading.position, *reading.velocity)))
                assert np.linalg.norm(reading.velocity) <= 12_001.0

    def reseal(data: bytes) -> bytes:
        return frame(NAV_PVT, data[6:-2].ljust(92, b"\x7f")[:92])

    examples = [{"line": good}, {"line": b"$GPGGA,\r\n" + good}]
    offer(chance, examples, read, (OutOfRange,), reseal)
