"""A new device from end to end: a TMP102 thermometer on the I2C bus that the coils use.

Run with `python docs/examples/device.py`. In the tree the four parts stand in `hal/interfaces/devices.py`
and `devices.py`, `hal/drivers/tmp102.py`, `sim_hal/emulators/tmp102.py` and `tests/hal/`.
Source of registers and scale: TI SBOS397.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from hal.interfaces.errors import NotResponding, Refused
from hal.interfaces.wires import Clock, I2cBus
from sim_hal.clock import SimClock
from sim_hal.emulators.i2c_bus import EmulatedI2cBus

TEMPERATURE, CONFIG = 0x00, 0x01
STEP_K = 0.0625
"""One count of the 12-bit temperature register, K."""


# --8<-- [start:interface]
@dataclass(frozen=True, slots=True)
class TemperatureReading:
    """One reading: `celsius` degree C, converted at `time_ns` of the host's clock or up to 0.26 s earlier."""

    time_ns: int
    celsius: float


class Thermometer(Protocol):
    """What the flight application may ask of a thermometer."""

    def read(self) -> TemperatureReading:
        """Return a new reading. Raises DeviceError when there is none."""


# --8<-- [end:interface]


# --8<-- [start:driver]
class Tmp102:
    """The driver. It knows registers, and meets the bus only as a Protocol."""

    def __init__(self, bus: I2cBus, address: int, clock: Clock) -> None:
        self.name = f"tmp102 at 0x{address:02x}"
        self._bus = bus
        self._address = address
        self._clock = clock

    def start(self) -> None:
        """Check that a TMP102 answers. Raises NotResponding, Refused."""
        config = self._word(CONFIG)
        if config & 0x6000 != 0x6000:  # the two resolution bits read as ones and cannot be written
            raise Refused(self.name, f"Config reads 0x{config:04x}: is another part at this address?")

    def read(self) -> TemperatureReading:
        """Return a new reading. Raises NotResponding."""
        word = self._word(TEMPERATURE)
        counts = word >> 4
        signed = counts - 0x1000 if counts & 0x800 else counts
        return TemperatureReading(self._clock.now_ns(), signed * STEP_K)

    def _word(self, register: int) -> int:
        try:
            high, low = self._bus.read_i2c_block_data(self._address, register, 2)
        except OSError as error:
            cause = f"{error.strerror}; check its power, wiring and address"
            raise NotResponding(self.name, cause) from error
        return high << 8 | low


# --8<-- [end:driver]


# --8<-- [start:emulator]
class EmulatedTmp102:
    """The part at the other end of the wire: it holds registers and answers bytes."""

    def __init__(self, address: int, celsius: Callable[[], float]) -> None:
        self.address = address
        self._celsius = celsius
        self._pointer = TEMPERATURE

    def answers(self, address: int) -> bool:
        """Report whether the part acknowledges this address."""
        return address == self.address

    def write(self, address: int, data: bytes) -> None:
        """Take the register pointer; Config is not writable in this small model."""
        self._pointer = data[0]

    def read(self, count: int) -> bytes:
        """Return bytes from the register pointer on; beyond a word the line floats high."""
        counts = round(self._celsius() / STEP_K) & 0xFFF
        word = counts << 4 if self._pointer == TEMPERATURE else 0x60A0
        return word.to_bytes(2, "big").ljust(count, b"\xff")[:count]


# --8<-- [end:emulator]


# --8<-- [start:use]
def main() -> None:
    """Read the emulated part through the real driver; then break the wire."""
    clock, warmth = SimClock(), [21.5]
    part = EmulatedTmp102(0x48, lambda: warmth[0])
    bus = EmulatedI2cBus([part])
    thermometer = Tmp102(bus, 0x48, clock)
    thermometer.start()
    print(f"{thermometer.read().celsius:+.4f} degree C")
    warmth[0] = -25.0625
    print(f"{thermometer.read().celsius:+.4f} degree C")
    bus.nack(0x48)  # a fault on the wire: one transaction is not acknowledged
    try:
        thermometer.read()
    except NotResponding as error:
        print(error)


# --8<-- [end:use]

if __name__ == "__main__":
    main()
