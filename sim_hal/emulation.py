"""Emulated buses and serial lines by name, and the functions that connect the emulated devices to them.

A driver's registration (`flight.schema.devices`) names the function that connects the driver's emulated
device. In lock-step, serial lines exist only in memory; in real time, they are pseudo-terminals.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from flight.schema.devices import (
    SENSOR_PARTS,
    Coils,
    Gps,
    InertialUnitSection,
    PowerMonitorSection,
    SensorsSection,
    SolarStringsSection,
    axis_matrix,
    driver_of,
)
from flight.schema.document import MISTAKES, ConfigError, call_named, imported
from flight.schema.sections import Config
from hal.buses.linux_wires import device_file
from hal.drivers.coils import CoilSettings, wirings
from hal.drivers.current_monitors import StringWiring
from hal.interfaces.errors import NotResponding
from hal.interfaces.wires import SerialPort, SpiDevice
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix
from sim_hal.clock import check_emulator
from sim_hal.emulators.coil_circuit import BridgeCircuit, CoilCircuit, CoilCondition, EmulatedIna219
from sim_hal.emulators.i2c_bus import EmulatedI2cBus
from sim_hal.emulators.pca9685 import EmulatedPca9685
from sim_hal.emulators.sensors import EmulatedAdis16470, EmulatedIcm20948, EmulatedLis3mdl, Measurements
from sim_hal.emulators.serial_line import DeviceEnd, EmulatedSerialLine, PtyLine
from sim_hal.emulators.vn100 import Vn100Emulator, Vn100EmulatorSettings
from sim_hal.emulators.vn100_sensors import PROFILES, NoiseProfile
from sim_hal.settings import Simulation
from sim_hal.worlds.world import BodyMotion, OrbitingWorld, World, orbiting

if TYPE_CHECKING:
    from sim_hal.emulators.gps import EmulatedGps
    from sim_hal.emulators.power import EmulatedSolarCells

_LINE_STREAM = 0x11E
ORBIT_STREAM = 0x0B17
"""Second number, after the simulation's seed, in the seeds of the devices that need an orbit."""
_LINE_KEYS = {"inertial_unit": (), "gps": (1,)}
"""Last numbers in the seed of a line's faults, by section; other lines use a checksum of the device name."""


class EmulatedWires:
    """Emulated buses, serial lines and SPI devices by device file (`hal.interfaces.wires.Wires`)."""

    def __init__(
        self, now_ns: Callable[[], int], seed: int, coil_bus: int | str, *, pty: bool = False
    ) -> None:
        """Create the I2C bus of the coil driver. If `pty` is true, serial lines are pseudo-terminals."""
        self._now_ns, self._seed, self._pty = now_ns, seed, pty
        self._coil_bus = device_file(coil_bus)
        self.buses = {self._coil_bus: EmulatedI2cBus()}
        self.lines: dict[str, EmulatedSerialLine | PtyLine] = {}
        self.spi_devices: dict[str, SpiDevice] = {}
        self._kinds: dict[str, str] = {}

    def connect(self, kind: str, device: str, baud_rate: int) -> DeviceEnd:
        """Create a serial line for the device of section `kind`, and return the device's end of the line."""
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
        """Return the serial line of the device of section `kind`, or None if it has no serial line."""
        return self.lines.get(self._kinds.get(kind, ""))

    def i2c(self, bus: int | str | None = None) -> EmulatedI2cBus:
        """Return an I2C bus, created at its first use, or the coil driver's bus if `bus` is None."""
        name = self._coil_bus if bus is None else device_file(bus)
        return self.buses.setdefault(name, EmulatedI2cBus())

    def serial(self, device: str, baud_rate: int) -> SerialPort:
        """Return the host's end of a serial line in memory. Raises NotResponding."""
        line = self.lines.get(device)
        if not isinstance(line, EmulatedSerialLine):
            raise NotResponding(device, "no emulated device is connected to this line")
        line.host.open()
        line.host.set_baud_rate(baud_rate)
        return line.host

    def spi(self, device: str, speed_hz: int, mode: int) -> SpiDevice:
        """Return an emulated device on an SPI bus. Raises NotResponding."""
        if device not in self.spi_devices:
            raise NotResponding(device, "no emulated device is connected to this SPI bus")
        return _CheckedSpi(self.spi_devices[device])


class _CheckedSpi:
    """An emulated SPI device that reports mistakes in the code of another package (`check_emulator`)."""

    def __init__(self, device: SpiDevice) -> None:
        self._device = device

    def transfer(self, frames: Sequence[bytes]) -> list[bytes]:
        """Send frames one after the other, and return the bytes received during each frame."""
        try:
            return self._device.transfer(frames)
        except MISTAKES as error:
            check_emulator(error)
            raise


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

    def connect(self, device: str, baud_rate: int) -> DeviceEnd:
        """Create the device's serial line, and return the device's end of the line."""
        return self.wires.connect(self.kind, device, baud_rate)


NO_EMULATOR = (
    "which registers no emulator: give its Driver the argument `emulate` (docs/extending/device.md), or omit "
    "the section `simulation` to fly the real device"
)
"""Text about a driver that is used in a simulation but has no emulator."""


def emulated(emulation: Emulation) -> object | None:
    """Return the emulated device of the section `emulation.kind`, or None if it is not configured.

    Raises ConfigError for a driver without an emulator.
    """
    section = getattr(emulation.config, emulation.kind)
    if section is None:
        return None
    driver = driver_of(emulation.kind, section)
    if driver.emulate is None:
        raise ConfigError(f"{emulation.kind}.driver", f"is {section.driver!r}, {NO_EMULATOR}")
    device: object = driver.emulate(emulation, section)
    return device


BUS_VOLTAGE = 5.0
"""Supply voltage (V) of the coils before the losses of the H-bridge (Sease, chapter 5: a 5 V power bus)."""
EMULATORS: dict[str, Callable[[int, Measurements], Any]] = {
    SENSOR_PARTS["icm20948"]: EmulatedIcm20948,
    SENSOR_PARTS["lis3mdl"]: EmulatedLis3mdl,
    SENSOR_PARTS["adis16470"]: EmulatedAdis16470,
}
_ADDRESSES = {SENSOR_PARTS["icm20948"]: 0x69, SENSOR_PARTS["lis3mdl"]: 0x1C}
"""I2C addresses that the drivers use if the configuration gives none."""


def true_coils(emulation: Emulation, coils: Coils) -> CoilSettings:
    """Return the true properties of the simulated coils."""
    truth = emulation.section.truth
    wired = wirings(coils.channels, truth.resistance or coils.resistance, coils.signs, coils.limits)
    supply = truth.supply_voltage or coils.supply_voltage
    return CoilSettings(wired, supply, max(coils.limits), coils.stale_after)


def emulate_pca9685(emulation: Emulation, coils: Coils) -> CoilCircuit:
    """Connect an emulated PCA9685 to the bus, and return the circuit of the coils."""
    pwm = EmulatedPca9685(coils.address, emulation.now_ns)
    noise = emulation.section.current_noise
    circuit = CoilCircuit(
        pwm, true_coils(emulation, coils), emulation.generator, emulation.now_ns, noise, BUS_VOLTAGE
    )
    for axis in coils.absent:
        circuit.become(axis, CoilCondition.OPEN)
    emulation.wires.i2c(coils.bus).attach(pwm)
    return circuit


def emulate_ina219(emulation: Emulation, fitted: PowerMonitorSection) -> EmulatedIna219:
    """Connect an emulated INA219 to its bus."""
    monitor = EmulatedIna219(fitted.address, emulation.now_ns, emulation.supply, fitted.shunt)
    emulation.wires.i2c(fitted.bus).attach(monitor)
    return monitor


def emulate_vn100(emulation: Emulation, unit: InertialUnitSection) -> Vn100Emulator:
    """Connect an emulated VN-100 to its serial line."""
    imu = emulation.section.imu
    profile = NoiseProfile() if imu.profile == "bounds" else PROFILES[imu.profile]
    settings = Vn100EmulatorSettings(
        noise=replace(profile, attitude_bound=imu.quaternion_noise, rate_bound=imu.rate_noise),
        mounting=np.array(unit.mounting),
        gyro_bias=np.array(imu.gyro_bias),
        clock_ppm=imu.clock_ppm,
        free_fall=isinstance(emulation.world, OrbitingWorld),
    )
    line = emulation.connect(unit.device, unit.baud_rate)
    emulator = Vn100Emulator(emulation.sense, line, emulation.generator, settings, now_ns=emulation.start_ns)
    if line.baud_rate != unit.baud_rate:
        emulator.set_baud_rate(unit.baud_rate)
    return emulator


def emulate_ublox(emulation: Emulation, gps: Gps) -> EmulatedGps:
    """Connect an emulated u-blox receiver to its serial line. Raises ConfigError if no orbit is simulated."""
    from sim_hal.emulators.gps import EmulatedGps  # noqa: PLC0415 - see `sim_hal.assembly`

    return _receiver(emulation, gps, EmulatedGps)


def emulate_nmea(emulation: Emulation, gps: Gps) -> EmulatedGps:
    """Connect an emulated NMEA receiver to its serial line. Raises ConfigError if no orbit is simulated."""
    from sim_hal.emulators.gps import EmulatedNmeaGps  # noqa: PLC0415 - see `sim_hal.assembly`

    receiver = _receiver(emulation, gps, EmulatedNmeaGps)
    receiver.obeys = False
    return receiver


def _receiver(emulation: Emulation, gps: Gps, kind: type[EmulatedGps]) -> EmulatedGps:
    from sim_hal.emulators.gps import GpsErrors  # noqa: PLC0415 - see `sim_hal.assembly`

    truth = emulation.section.orbit_devices
    errors = GpsErrors(walk=truth.gps_walk, noise=truth.gps_noise, start=truth.gps_start)
    world, line = orbiting(emulation.world, "gps"), emulation.connect(gps.device, gps.baud_rate)
    return kind(world, line, emulation.generator, errors, emulation.start_ns)


def emulate_ads1115(emulation: Emulation, section: SolarStringsSection) -> EmulatedSolarCells:
    """Connect the emulated converters of the solar cells. Raises ConfigError if no orbit is simulated."""
    from sim_hal.emulators.power import EmulatedSolarCells, SolarCellsModel  # noqa: PLC0415 - see `sim_hal.assembly`

    strings, truth = section.strings, emulation.section.orbit_devices
    errors = np.random.default_rng([emulation.section.seed, ORBIT_STREAM, 2])
    model = SolarCellsModel(
        normals=np.array([string.normal for string in strings]),
        peaks=np.array([string.peak for string in strings]),
        gain_errors=truth.string_gain * errors.standard_normal(len(strings)),
        noise=truth.string_noise,
        albedo=truth.albedo,
    )
    wired = [StringWiring(one.address, one.channel, one.volt_per_ampere) for one in strings]
    world = orbiting(emulation.world, "solar_strings")
    cells = EmulatedSolarCells(world, model, wired, emulation.now_ns, emulation.generator)
    for part in cells.parts:
        emulation.wires.i2c(section.bus).attach(part)
    return cells


def emulate_drv8830(emulation: Emulation, coils: Coils) -> BridgeCircuit:
    """Connect the bridges to the bus, and return the circuit of the coils."""
    settings, noise = true_coils(emulation, coils), emulation.section.current_noise
    circuit = BridgeCircuit(coils.address, settings, emulation.generator, noise, BUS_VOLTAGE)
    for index, part in enumerate(circuit.parts):
        if index not in coils.absent:
            emulation.wires.i2c(coils.bus).attach(part)
    return circuit


def emulate_sensors(emulation: Emulation, unit: SensorsSection) -> tuple[Any, ...]:
    """Connect the sensors of an inertial unit. Raises ConfigError for a sensor without an emulator."""
    to_unit, made = attitude_matrix(np.array(unit.mounting)).T, []
    for number, sensor in enumerate(unit.sensors):
        axes: dict[str, FloatArray] = {
            quantity: axis_matrix(names).T @ to_unit for quantity, names in sensor.measures.items()
        }
        measured = Measurements(emulation.sense, axes, emulation.generator, emulation.now_ns)
        key = f"{emulation.kind}.sensors[{number}].emulator"
        place = SENSOR_PARTS.get(sensor.part, sensor.part)
        part: Any
        if sensor.emulator is not None:
            made_by = imported(key, sensor.emulator, {}, os.environ)
            part = call_named(key, sensor.emulator, made_by, measured, sensor)
        elif place in EMULATORS:
            part = EMULATORS[place](sensor.address or _ADDRESSES.get(place, 0), measured)
        else:
            known = ", ".join(SENSOR_PARTS)
            problem = f"is missing: only {known} have a built-in emulator; name your own by `emulator`"
            raise ConfigError(key, problem)
        made.append(part)
        if sensor.spi is not None:
            emulation.wires.spi_devices[sensor.spi] = part
        else:
            emulation.wires.i2c(sensor.bus).attach(part)
    return tuple(made)
