"""A magnetometer outside this repository, QMC5883L, with its driver and its emulator.

A configuration names driver and emulator in a section of the driver `sensors`, see docs/extending/device.md.
"""

from __future__ import annotations

import struct
from typing import Any

COUNTS_PER_TESLA = 3000.0 * 1e4
CONTROL, OUT = 0x09, 0x00


class Qmc5883:
    """Driver of the QMC5883L with the interface of CircuitPython drivers. The start may sleep."""

    def __init__(self, i2c: Any, address: int = 0x0D) -> None:
        self._i2c, self._address = i2c, address
        i2c.writeto(address, bytes((CONTROL, 0x1D)))  # 8 gauss, 200 Hz, continuous

    @property
    def magnetic(self) -> tuple[float, ...]:
        """Return the field (3,), microtesla, in sensor axes."""
        data = bytearray(6)
        self._i2c.writeto_then_readfrom(self._address, bytes((OUT,)), data)
        return tuple(1e6 * counts / COUNTS_PER_TESLA for counts in struct.unpack("<3h", data))


class EmulatedQmc5883:
    """Emulator of the QMC5883L, which answers reads with the bytes of a measurement."""

    def __init__(self, measured: Any, sensor: Any) -> None:
        self._measured, self._address = measured, sensor.address

    def answers(self, address: int) -> bool:
        """Return whether the chip acknowledges an address."""
        return bool(address == self._address)

    def write(self, address: int, data: bytes) -> None:
        """Accept a register pointer or a setting, both of which this model ignores."""

    def read(self, count: int) -> bytes:
        """Return a measurement with noise of 0.2 uT."""
        field = self._measured.of("magnetic", 2e-7)
        return struct.pack("<3h", *(round(value * COUNTS_PER_TESLA) for value in field))[:count]
