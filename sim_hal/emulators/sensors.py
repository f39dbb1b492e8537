"""Gyros, magnetometers and accelerometers emulated by their registers: ICM-20948, LIS3MDL and ADIS16470.

The sensors measure at their data rates with the white noise of their data sheets. A configuration names the
emulator of another sensor as `module:function`, which takes `Measurements` and the sensor's section, and
returns an `I2cPart` or an SPI device.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hal.drivers.sensor_unit import (
    ACCELERATION_STEP,
    DATA_CNTR,
    DEC_RATE,
    GYRO_STEP,
    MSC_CTRL,
    PROD_ID,
    PRODUCT,
    SAMPLE_HZ,
    X_ACCL_LOW,
    X_GYRO_LOW,
)
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from sim_hal.emulators.i2c_bus import Registers
from sim_hal.worlds.world import STANDARD_GRAVITY, BodyMotion

_TURN = math.radians(1.0)


@dataclass(frozen=True, slots=True)
class Measurements:
    """Quantities that an ideal sensor measures in sensor axes, with white noise added on request.

    Attributes:
        sense: function from a time (ns) to the motion at the sensor, body axes.
        to_sensor: matrix (3, 3) from body axes to sensor axes by quantity.
        generator: random generator of the noise.
        now_ns: function that returns the simulation time, ns.
    """

    sense: Callable[[int], BodyMotion]
    to_sensor: dict[str, FloatArray]
    generator: np.random.Generator
    now_ns: Callable[[], int]

    def of(self, quantity: str, deviation: float) -> FloatArray:
        """Return a quantity (3,), rad/s, T or m/s^2, with white noise of the sigma `deviation`."""
        motion = self.sense(self.now_ns())
        true = {
            "gyro": motion.rate,
            "magnetic": motion.field_body,
            "acceleration": motion.specific_force_body,
        }[quantity]
        turned = self.to_sensor.get(quantity, np.eye(3)) @ true
        return np.asarray(turned + deviation * self.generator.standard_normal(3))


class EmulatedLis3mdl(Registers):
    """A LIS3MDL magnetometer (ST DocID024204)."""

    _WHO_AM_I, _CTRL1, _CTRL2, _CTRL3, _OUT = 0x0F, 0x20, 0x21, 0x22, 0x28
    _COUNTS_PER_GAUSS = (6842, 3421, 2281, 1711)
    _SLOW_HZ = (0.625, 1.25, 2.5, 5.0, 10.0, 20.0, 40.0, 80.0)
    _FAST_HZ = (1000.0, 560.0, 300.0, 155.0)
    _NOISE_T = 0.35e-6
    """RMS noise (T) in ultra-high-performance mode with 12 gauss range; each lower mode doubles the noise."""

    def __init__(self, address: int, measured: Measurements) -> None:
        super().__init__(address)
        self._measured = measured
        self.reset()

    def reset(self) -> None:
        """Set every register to its power-on value."""
        self._held = {self._CTRL1: 0x10, self._CTRL3: 0x03}
        self._sample = b"\0" * 6
        self._number = -1

    def store(self, register: int, value: int) -> None:
        """Write a register; bit 2 of CTRL_REG2 resets the chip."""
        if register == self._CTRL2 and value & 0x04:
            self.reset()
        elif 0x20 <= register <= 0x24:
            self._held[register] = value

    def load(self, register: int) -> int:
        """Return a register's value."""
        if self._OUT <= register < self._OUT + 6:
            return self._sample[register - self._OUT]
        return 0x3D if register == self._WHO_AM_I else self._held.get(register, 0)

    def latch(self) -> None:
        """Convert at the data rate while the chip is in continuous mode."""
        control = self._held[self._CTRL1]
        mode = control >> 5 & 3
        rate = self._FAST_HZ[mode] if control & 2 else self._SLOW_HZ[control >> 2 & 7]
        number = int(self._measured.now_ns() * rate // SECOND_NS)
        if self._held[self._CTRL3] & 3 or number == self._number:
            return
        self._number = number
        scale = 1e4 * self._COUNTS_PER_GAUSS[self._held.get(self._CTRL2, 0) >> 5 & 3]
        counts = np.rint(scale * self._measured.of("magnetic", self._NOISE_T * 2 ** (3 - mode)))
        self._sample = np.clip(counts, -32768, 32767).astype("<i2").tobytes()


class EmulatedIcm20948(Registers):
    """An ICM-20948 with its AK09916 magnetometer behind the internal I2C master (TDK DS-000189)."""

    _BANK, _AK09916 = 0x7F, 0x0C
    _GYRO_PER_DEGREE = (131.0, 65.5, 32.8, 16.4)
    _COUNTS_PER_G = (16384, 8192, 4096, 2048)
    _FIELD_STEP_T, _FIELD_NOISE_T = 0.15e-6, 0.3e-6
    _GYRO_BANDWIDTH_HZ = (229.8, 187.6, 154.3, 73.3, 35.9, 17.8, 8.9, 376.5)
    """Noise bandwidths (Hz) of the gyro's filter settings; without a filter the bandwidth is 12.1 kHz."""
    _FORCE_BANDWIDTH_HZ = (265.0, 265.0, 136.0, 68.8, 34.4, 17.0, 8.3, 499.0)

    def __init__(self, address: int, measured: Measurements) -> None:
        super().__init__(address)
        self._measured = measured
        self.reset()

    def reset(self) -> None:
        """Set every register to its power-on value."""
        self._held = {(0, 0x00): 0xEA, (0, 0x06): 0x41, (2, 0x01): 0x01, (2, 0x14): 0x01}
        self._mag = {0x00: 0x48, 0x01: 0x09}
        self._bank = 0
        self._number = self._field_number = -1

    def store(self, register: int, value: int) -> None:
        """Write a register; bit 7 of PWR_MGMT_1 resets the chip."""
        if register == self._BANK:
            self._bank = value >> 4 & 3
            return
        self._held[self._bank, register] = value
        if (self._bank, register) == (0, 0x06) and value & 0x80:
            self.reset()
        if (self._bank, register) == (3, 0x15) and value & 0x80:  # start a transfer on the internal bus
            self._transfer()

    def load(self, register: int) -> int:
        """Return a register's value."""
        return self._bank << 4 if register == self._BANK else self._held.get((self._bank, register), 0)

    def latch(self) -> None:
        """Convert at the data rates of gyro and magnetometer, unless the chip sleeps."""
        if self._held[0, 0x06] & 0x40:
            return
        now_ns, held, measured = self._measured.now_ns(), self._held, self._measured
        number = now_ns * 1100 // (SECOND_NS * (1 + held.get((2, 0x00), 0)))
        if number != self._number:
            self._number = number
            gyro, force = held[2, 0x01], held[2, 0x14]
            width = self._GYRO_BANDWIDTH_HZ[gyro >> 3 & 7] if gyro & 1 else 12_106.0
            rate = measured.of("gyro", 0.015 * _TURN * math.sqrt(width))
            self._put(0x33, rate / _TURN * self._GYRO_PER_DEGREE[gyro >> 1 & 3])
            width = self._FORCE_BANDWIDTH_HZ[force >> 3 & 7] if force & 1 else 1_209.0
            specific = measured.of("acceleration", 230e-6 * STANDARD_GRAVITY * math.sqrt(width))
            self._put(0x2D, specific / STANDARD_GRAVITY * self._COUNTS_PER_G[force >> 1 & 3])
        slow = {0x02: 10, 0x04: 20, 0x06: 50, 0x08: 100}.get(self._mag.get(0x31, 0), 0)
        read = held.get((3, 0x03)) == 0x80 | self._AK09916 and held.get((3, 0x05), 0) & 0x80
        if slow and read and now_ns * slow // SECOND_NS != self._field_number:
            self._field_number = now_ns * slow // SECOND_NS
            field = measured.of("magnetic", self._FIELD_NOISE_T) / self._FIELD_STEP_T
            self._put(0x3B, field, "<i2")

    def _put(self, register: int, counts: FloatArray, kind: str = ">i2") -> None:
        data = np.clip(np.rint(counts), -32768, 32767).astype(kind).tobytes()
        self._held |= {(0, register + offset): byte for offset, byte in enumerate(data)}

    def _transfer(self) -> None:
        address, register = self._held.get((3, 0x13), 0), self._held.get((3, 0x14), 0)
        if address & 0x7F == self._AK09916:
            if address & 0x80:
                self._held[3, 0x17] = self._mag.get(register, 0)
            else:
                self._mag[register] = self._held.get((3, 0x16), 0)
        self._held[0, 0x17] = 0x40


class EmulatedAdis16470:
    """An ADIS16470 on an SPI bus, which sends each answer one frame after the request."""

    _GYRO_DENSITY, _FORCE_DENSITY = 0.008 * _TURN, 100e-6 * STANDARD_GRAVITY

    def __init__(self, _: int, measured: Measurements) -> None:
        self._measured = measured
        self._held = {PROD_ID: PRODUCT, MSC_CTRL: 0x00C1, DEC_RATE: 0}
        self._number = -1
        self._answer = b"\0\0"

    def transfer(self, frames: Sequence[bytes]) -> list[bytes]:
        """Execute the request in each frame of two bytes, and return the answer to the preceding request."""
        return [self._frame(data) for data in frames]

    def _frame(self, data: bytes) -> bytes:
        answer, (address, value) = self._answer, data
        register = address & 0x7E
        if address & 0x80:
            shift = 8 * (address & 1)
            self._held[register] = self._held.get(register, 0) & ~(0xFF << shift) | value << shift
        else:
            self._latch()
            self._answer = self._held.get(register, 0).to_bytes(2, "big")
        return answer

    def _latch(self) -> None:
        """Store a new sample in the registers if one is due."""
        rate = SAMPLE_HZ / (1 + self._held[DEC_RATE])
        number = int(self._measured.now_ns() * rate // SECOND_NS)
        if number == self._number:
            return
        self._number, root = number, math.sqrt(0.5 * rate)
        self._held[DATA_CNTR] = number & 0xFFFF
        for first, quantity, density, step in (
            (X_GYRO_LOW, "gyro", self._GYRO_DENSITY, GYRO_STEP),
            (X_ACCL_LOW, "acceleration", self._FORCE_DENSITY, ACCELERATION_STEP),
        ):
            counts = np.rint(self._measured.of(quantity, density * root) / step).astype(np.int64)
            for axis, count in enumerate(counts.tolist()):
                low = first + 4 * axis
                self._held |= {low: count & 0xFFFF, low + 2: count >> 16 & 0xFFFF}
