"""Emulated buses and serial lines by name, and the inputs of a device's emulator.

A driver's registration (`flight.schema.devices`) names the function that connects its emulated device here.
In lock-step, serial lines exist only in memory; in real time, they are pseudo-terminals.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flight.schema.devices import driver_of
from flight.schema.document import ConfigError
from flight.schema.sections import Config
from hal.buses.i2c_bus import device_file
from hal.interfaces.errors import NotResponding
from hal.interfaces.wires import SerialPort, SpiDevice
from sim_hal.clock import SerialEnd
from sim_hal.emulators.i2c_bus import EmulatedI2cBus
from sim_hal.emulators.serial_line import EmulatedSerialLine, PtyLine
from sim_hal.settings import Simulation
from sim_hal.worlds.world import BodyMotion, World

_LINE_STREAM = 0x11E
ORBIT_STREAM = 0x0B17
"""First key of the random streams of the devices that need an orbit."""
_LINE_KEYS = {"inertial_unit": (), "gps": (1,)}
"""Keys of the random streams for faults of the serial lines."""


class EmulatedWires:
    """Emulated connections by the names in the configuration (`hal.interfaces.wires.Wires`).

    Attributes:
        buses: I2C buses by device file.
        lines: serial lines by device file, in memory or as pseudo-terminals.
        spi_devices: devices on SPI buses by device file.
    """

    def __init__(
        self, now_ns: Callable[[], int], seed: int, coil_bus: int | str, *, pty: bool = False
    ) -> None:
        """Make the bus of the coils. If `pty` is true, serial lines are pseudo-terminals."""
        self._now_ns, self._seed, self._pty = now_ns, seed, pty
        self._coil_bus = device_file(coil_bus)
        self.buses = {self._coil_bus: EmulatedI2cBus()}
        self.lines: dict[str, EmulatedSerialLine | PtyLine] = {}
        self.spi_devices: dict[str, SpiDevice] = {}
        self._kinds: dict[str, str] = {}

    def connect(self, kind: str, device: str, baud_rate: int) -> SerialEnd:
        """Make a serial line for the device of section `kind`, and return the device's end."""
        if device in self.lines:
            raise ConfigError(f"{kind}.device", f"is {device!r}, which another device uses")
        generator = line_generator(self._seed, *_LINE_KEYS.get(kind, (zlib.crc32(device.encode()),)))
        self._kinds[kind] = device
        if self._pty:
            line = self.lines[device] = PtyLine(baud_rate, generator)
            return line
        in_memory = self.lines[device] = EmulatedSerialLine(self._now_ns, baud_rate, generator)
        return in_memory.device

    def line_of(self, kind: str) -> EmulatedSerialLine | PtyLine | None:
        """Return the serial line of the device of section `kind`, or None if it has none."""
        return self.lines.get(self._kinds.get(kind, ""))

    def i2c(self, bus: int | str | None = None) -> EmulatedI2cBus:
        """Return an I2C bus, which is created at its first use; None means the bus of the coils."""
        name = self._coil_bus if bus is None else device_file(bus)
        return self.buses.setdefault(name, EmulatedI2cBus())

    def serial(self, device: str, baud_rate: int) -> SerialPort:
        """Return the host's end of a serial line in memory. Raises NotResponding."""
        line = self.lines.get(device)
        if not isinstance(line, EmulatedSerialLine):
            raise NotResponding(device, "no emulated device is connected to this line")
        line.host.set_baud_rate(baud_rate)
        return line.host

    def spi(self, device: str, speed_hz: int, mode: int) -> SpiDevice:
        """Return an emulated device on an SPI bus. Raises NotResponding."""
        if device not in self.spi_devices:
            raise NotResponding(device, "no emulated device is connected to this SPI bus")
        return self.spi_devices[device]


def line_generator(seed: int, *line: int) -> np.random.Generator:
    """Return a serial line's random generator for faults, independent of other uses of the seed."""
    return np.random.default_rng([seed, _LINE_STREAM, *line])


@dataclass(frozen=True, slots=True)
class Emulation:
    """Inputs of a device's emulator.

    Attributes:
        kind: section of the device in the configuration, for example `gps`.
        wires: emulated connections, to which the emulator connects its device.
        config: configuration of the flight.
        section: section `simulation`, with true values that differ from the configuration.
        generator: random generator of this device.
        now_ns: function that returns the simulation time, ns.
        start_ns: simulation time at the start, ns.
        world: simulated world; the emulator of the coils, which is built before the world, must not use it.
        sense: function from a time (ns) to the motion and magnetic field at the inertial unit, with the
            unit's calibration errors and the field of the coils.
        supply: function from the start and end of a time window (ns) to the mean supply voltage (V) and
            current (A) of the coils.
    """

    kind: str
    wires: EmulatedWires
    config: Config
    section: Simulation
    generator: np.random.Generator
    now_ns: Callable[[], int]
    start_ns: int
    world: World
    sense: Callable[[int], BodyMotion]
    supply: Callable[[int, int], tuple[float, float]]

    def connect(self, device: str, baud_rate: int) -> SerialEnd:
        """Make the device's serial line, and return the device's end of the line."""
        return self.wires.connect(self.kind, device, baud_rate)


def emulated(emulation: Emulation) -> object | None:
    """Return the emulated device of the emulation's section, or None if it is not configured.

    Raises ConfigError for a driver without an emulator.
    """
    section = getattr(emulation.config, emulation.kind)
    if section is None:
        return None
    driver = driver_of(emulation.kind, section)
    if driver.emulate is None:
        raise ConfigError(f"{emulation.kind}.driver", f"is {section.driver!r}, which registers no emulator")
    device: object = driver.emulate(emulation, section)
    return device
