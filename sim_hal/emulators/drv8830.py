"""Emulated DRV8830 bridges with their coils (TI SLVSAB2).

The coil current is the output voltage divided by the coil's resistance.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hal.drivers.coils import CoilSettings
from hal.drivers.drv8830 import CLEAR, CONTROL, FAULT, volts_of
from knightcube.astro.arrays import FloatArray


class EmulatedDrv8830:
    """One bridge with its registers CONTROL and FAULT; the function `changed` is called after each change."""

    def __init__(self, address: int, changed: Callable[[], None]) -> None:
        self.address = address
        self.registers = [0, 0]
        self._pointer = 0
        self._changed = changed

    def answers(self, address: int) -> bool:
        """Return whether the bridge acknowledges an address."""
        return address == self.address

    def write(self, address: int, data: bytes) -> None:
        """Set the register pointer, and write registers."""
        self._pointer = data[0]
        for value in data[1:]:
            if self._pointer == CONTROL:
                self.registers[CONTROL] = value
                self._changed()
            elif self._pointer == FAULT and value & CLEAR:
                self.registers[FAULT] = 0
            self._pointer += 1

    def read(self, count: int) -> bytes:
        """Return register contents, beginning at the register pointer."""
        return bytes((*self.registers, *bytes(count))[self._pointer : self._pointer + count]).ljust(
            count, b"\0"
        )

    def brown_out(self) -> None:
        """Interrupt the supply, which clears the registers."""
        self.registers = [0, 0]
        self._changed()


class BridgeCircuit:
    """Coils on DRV8830 bridges. At each write, random errors are added to the coil currents.

    Attributes:
        parts: the bridges.
        chip: always None, because the coils have no PWM chip.
    """

    chip = None

    def __init__(
        self,
        address: int,
        truth: CoilSettings,
        generator: np.random.Generator,
        noise: float,
        supply: float,
    ) -> None:
        """Create one bridge for each coil.

        `noise` (A) is the largest random error of a coil current, and `supply` (V) is the supply voltage.
        """
        self.parts = [EmulatedDrv8830(address + n, self._update) for n in range(len(truth.coils))]
        self._truth, self._generator, self._noise, self._supply = truth, generator, noise, supply
        self._currents: FloatArray = np.zeros(len(truth.coils))

    def currents(self) -> FloatArray:
        """Return the current of each coil (n,), A."""
        return self._currents

    def mean_supply(self, start_ns: int, end_ns: int) -> tuple[float, float]:
        """Return the supply voltage (V) and the present supply current (A)."""
        return self._supply, float(np.abs(self._currents).sum())

    def _update(self) -> None:
        volts = np.array([volts_of(part.registers[CONTROL]) for part in self.parts])
        noise = self._noise * (2.0 * self._generator.random(len(volts)) - 1.0)
        ohm = np.array([coil.sign * coil.resistance for coil in self._truth.coils])
        self._currents = np.where(volts != 0.0, volts / ohm + noise, 0.0)
