"""Emulated DRV8830 bridges with their coils (TI SLVSAB2). The coil current is the output voltage over R."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hal.drivers.coils import CoilSettings
from hal.drivers.drv8830 import CLEAR, CONTROL, FAULT, volts_of
from knightcube.astro.arrays import FloatArray


class EmulatedDrv8830:
    """One bridge with its registers CONTROL and FAULT; the function `changed` is called after a write."""

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
        """Return registers from the pointer on."""
        return bytes((*self.registers, *bytes(count))[self._pointer : self._pointer + count]).ljust(
            count, b"\0"
        )

    def brown_out(self) -> None:
        """Interrupt the supply, which clears the registers."""
        self.registers = [0, 0]
        self._changed()


class BridgeCircuit:
    """Coils on DRV8830 bridges. The coil currents are drawn with noise at each write.

    Attributes:
        parts: the bridges.
        chip: None, because no PWM chip drives the coils.
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
        """Make one bridge for each coil.

        `noise` (A) bounds the error of a driven current, and `supply` (V) is the voltage of the supply.
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
