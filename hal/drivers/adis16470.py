"""Driver of the ADIS16470, an inertial sensor of Analog Devices on an SPI bus (data sheet, revision C).

An SPI frame has 16 bits, and the answer to a read request comes in the next frame. The value of each axis has
32 bits in two registers. The sample counter is read before and after all axes; equal values show that the
axes belong to one sample. The properties of the driver have the names and units of CircuitPython drivers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from hal.interfaces.errors import NotResponding, Refused
from hal.interfaces.wires import SpiDevice

X_GYRO_LOW, X_ACCL_LOW, DATA_CNTR, MSC_CTRL, DEC_RATE, PROD_ID = 0x04, 0x10, 0x22, 0x60, 0x64, 0x72
PRODUCT = 16470
GYRO_STEP = math.radians(0.1) / 65536
"""Rate (rad/s) of one count of 32 bits."""
ACCELERATION_STEP = 1.25e-3 * 9.80665 / 65536
"""Specific force (m/s^2) of one count of 32 bits."""
SAMPLE_HZ = 2000.0
_TRIES = 3


class Adis16470:
    """An ADIS16470, read without waiting: `gyro` is in rad/s and `acceleration` in m/s^2."""

    SPEED_HZ, MODE = 1_000_000, 3

    def __init__(self, device: SpiDevice) -> None:
        """Check the product number.

        Raises NotResponding if no chip answers, and Refused if a different chip answers.
        """
        self._device = device
        (product,) = self._read([PROD_ID])
        if product in {0x0000, 0xFFFF}:
            raise NotResponding("ADIS16470", "the SPI line is silent: check power, wiring and chip select")
        if product != PRODUCT:
            raise Refused("ADIS16470", f"PROD_ID is {product}: is another chip connected?")
        self.decimation = 24

    @property
    def decimation(self) -> int:
        """Decimation d: d + 1 samples are averaged, so that the data rate is 2000 Hz / (d + 1)."""
        return self._read([DEC_RATE])[0]

    @decimation.setter
    def decimation(self, value: int) -> None:
        self._write(DEC_RATE, value)

    @property
    def gyro(self) -> tuple[float, ...]:
        """Rotation rate (3,), rad/s, in sensor axes."""
        return self._vector(X_GYRO_LOW, GYRO_STEP)

    @property
    def acceleration(self) -> tuple[float, ...]:
        """Specific force (3,), m/s^2, in sensor axes."""
        return self._vector(X_ACCL_LOW, ACCELERATION_STEP)

    def _vector(self, first: int, step: float) -> tuple[float, ...]:
        for _ in range(_TRIES):
            before, *halves, after = self._read([DATA_CNTR, *range(first, first + 12, 2), DATA_CNTR])
            if before == after:
                break
        words = [high << 16 | low for low, high in zip(halves[::2], halves[1::2], strict=True)]
        return tuple((word - (word >> 31 << 32)) * step for word in words)

    def _read(self, registers: Sequence[int]) -> list[int]:
        """Return the values of 16-bit registers, each in the frame after the register's request."""
        frames = self._device.transfer([bytes((register, 0)) for register in (*registers, 0)])
        return [int.from_bytes(frame, "big") for frame in frames[1:]]

    def _write(self, register: int, value: int) -> None:
        halves = (register, value & 0xFF), (register + 1, value >> 8)
        self._device.transfer([bytes((0x80 | address, byte)) for address, byte in halves])
