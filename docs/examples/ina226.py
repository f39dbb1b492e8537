"""A device driver outside this repository: the current monitor INA226 of the coils' supply (TI SBOS547B).

A configuration selects the driver by `power_monitor: {driver: "ina226:INA226"}`, see
docs/extending/device.md.
"""

# --8<-- [start:section]
from __future__ import annotations

from typing import TYPE_CHECKING

from flight.schema.devices import Driver, PowerMonitorSection
from hal.interfaces.devices import PowerReading
from hal.interfaces.errors import DeviceError, OutOfRange, Refused, answering
from hal.interfaces.wires import Clock, I2cBus, Rig

if TYPE_CHECKING:  # the simulator is not imported on a board
    from sim_hal.emulation import Emulation


class Ina226Section(PowerMonitorSection, frozen=True, kw_only=True):
    """Configuration keys of the device: `address`, `bus` and `shunt` as for every monitor, and `averages`."""

    averages: int = 16


# --8<-- [end:section]

# --8<-- [start:driver]
CONFIG, SHUNT, BUS, DIE_ID = 0x00, 0x01, 0x02, 0xFF
SHUNT_STEP_V, BUS_STEP_V = 2.5e-6, 1.25e-3
PERIOD_NS = 200_000_000
AVERAGES = (1, 4, 16, 64, 128, 256, 512, 1024)


class Ina226:
    """Driver of the INA226, which reads its registers in a job of its own, never in the control loop."""

    def __init__(self, bus: I2cBus, clock: Clock, section: Ina226Section) -> None:
        self.name = f"ina226 at 0x{section.address:02x}"
        self._bus, self._clock, self._section = bus, clock, section
        self._reading: PowerReading | None = None
        self._error, self._configured = "", False
        self._ticker = clock.ticker("power", PERIOD_NS, self._serve)

    def identify(self) -> str:
        """Return the die's identifier as text. Raises NotResponding, or Refused for a different chip."""
        word = self._word(DIE_ID)
        if word >> 4 != 0x226:
            raise Refused(self.name, f"its identifier is 0x{word:04x}: is another chip at this address?")
        return f"answers: die 0x{word:04x}"

    def latest(self) -> PowerReading | None:
        """Return the newest reading, or None before the first reading."""
        return self._reading

    def error(self) -> str:
        """Return the text of the current failure, or an empty text while readings arrive."""
        return self._error

    def close(self) -> None:
        """Stop reading."""
        self._ticker.stop()

    def _serve(self) -> None:
        try:
            if not self._configured:
                self.identify()
                code = AVERAGES.index(self._section.averages)
                word = (0x4000 | code << 9 | 0x127).to_bytes(2, "big")
                with answering(self.name):
                    self._bus.write_i2c_block_data(self._section.address, CONFIG, list(word))
                self._configured = True
            shunt, bus = self._word(SHUNT), self._word(BUS)
        except DeviceError as error:
            self._error, self._configured = str(error), False
            return
        current = (shunt - (shunt >> 15 << 16)) * SHUNT_STEP_V / self._section.shunt
        volts, now_ns = bus * BUS_STEP_V, self._clock.now_ns()
        window_ns = 2 * 1_100_000 * self._section.averages
        self._error = ""
        self._reading = PowerReading(now_ns, volts, current, volts * current, current, now_ns - window_ns)

    def _word(self, register: int) -> int:
        with answering(self.name):
            return int.from_bytes(
                bytes(self._bus.read_i2c_block_data(self._section.address, register, 2)), "big"
            )


def open_monitor(rig: Rig, section: Ina226Section) -> Ina226:
    """Return the driver on the bus of a rig, which is the bus of a board or an emulated bus."""
    return Ina226(rig.wires.i2c(section.bus), rig.clock, section)


def probe(rig: Rig, section: Ina226Section) -> str:
    """Check for `knightcube check` that the device responds. Raises DeviceError if it does not."""
    monitor = open_monitor(rig, section)
    try:
        return monitor.identify()
    finally:
        monitor.close()


def check(section: Ina226Section) -> None:
    """Raise OutOfRange for a value that the device does not accept."""
    if section.averages not in AVERAGES:
        raise OutOfRange(
            "ina226", "averages", section.averages, AVERAGES[0], AVERAGES[-1], "(a power of 2 or 4)"
        )


# --8<-- [end:driver]


# --8<-- [start:emulator]
class EmulatedIna226:
    """Emulator of the INA226, which answers reads of its registers with bytes."""

    def __init__(self, emulation: Emulation, section: Ina226Section) -> None:
        self._emulation, self._section = emulation, section
        self._pointer = 0

    def answers(self, address: int) -> bool:
        """Return whether the chip acknowledges an address."""
        return address == self._section.address

    def write(self, address: int, data: bytes) -> None:
        """Set the register pointer. This model ignores values written to the configuration register."""
        self._pointer = data[0]

    def read(self, count: int) -> bytes:
        """Return the content of the register that the pointer selects."""
        now_ns = self._emulation.now_ns()
        volts, current = self._emulation.supply(now_ns - 35_000_000, now_ns)
        word = {
            SHUNT: round(current * self._section.shunt / SHUNT_STEP_V) & 0xFFFF,
            BUS: round(volts / BUS_STEP_V),
            DIE_ID: 0x2260,
        }.get(self._pointer, 0)
        return word.to_bytes(2, "big")[:count]


def emulate(emulation: Emulation, section: Ina226Section) -> EmulatedIna226:
    """Connect an emulated chip to its bus."""
    chip = EmulatedIna226(emulation, section)
    emulation.wires.i2c(section.bus).attach(chip)
    return chip


# --8<-- [end:emulator]

# --8<-- [start:registration]
INA226 = Driver(
    "power_monitor", Ina226Section, open_monitor, probe, emulate, check=check, addresses=(0x40, 0x4F)
)
# --8<-- [end:registration]
