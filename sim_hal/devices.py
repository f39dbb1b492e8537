"""Functions that connect the emulated devices of this package to emulated wires (`flight.schema.devices`)."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from flight.schema.devices import (
    SENSOR_PARTS,
    Coils,
    Gps,
    InertialUnitSection,
    PowerMonitorSection,
    Sensor,
    SensorsSection,
    SolarStringsSection,
    axis_matrix,
)
from flight.schema.document import ConfigError, imported
from hal.drivers.ads1115 import StringWiring
from hal.drivers.coils import CoilSettings, wirings
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix
from sim_hal.emulation import ORBIT_STREAM, Emulation
from sim_hal.emulators.coil_circuit import CoilCircuit, CoilCondition, EmulatedIna219
from sim_hal.emulators.drv8830 import BridgeCircuit
from sim_hal.emulators.pca9685 import EmulatedPca9685
from sim_hal.emulators.sensors import EmulatedAdis16470, EmulatedIcm20948, EmulatedLis3mdl, Measurements
from sim_hal.emulators.vn100 import Vn100Emulator, Vn100EmulatorSettings
from sim_hal.emulators.vn100_sensors import PROFILES, NoiseProfile
from sim_hal.worlds.world import OrbitingWorld, orbiting

if TYPE_CHECKING:
    from sim_hal.emulators.gps import EmulatedGps, GpsErrors
    from sim_hal.emulators.solar_cells import EmulatedSolarCells

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


def gps_errors(emulation: Emulation) -> GpsErrors:
    """Return the errors of the emulated GPS receiver."""
    from sim_hal.emulators.gps import GpsErrors  # noqa: PLC0415 - see `sim_hal.assembly`

    truth = emulation.section.orbit_devices
    return GpsErrors(walk=truth.gps_walk, noise=truth.gps_noise, start=truth.gps_start)


def emulate_ublox(emulation: Emulation, gps: Gps) -> EmulatedGps:
    """Connect an emulated u-blox receiver to its serial line. Raises ConfigError if no orbit is simulated."""
    from sim_hal.emulators.gps import EmulatedGps  # noqa: PLC0415 - see `sim_hal.assembly`

    world, line = orbiting(emulation.world, "gps"), emulation.connect(gps.device, gps.baud_rate)
    return EmulatedGps(world, line, emulation.generator, gps_errors(emulation), emulation.start_ns)


def emulate_ads1115(emulation: Emulation, section: SolarStringsSection) -> EmulatedSolarCells:
    """Connect the emulated converters of the solar cells. Raises ConfigError if no orbit is simulated."""
    from sim_hal.emulators.solar_cells import EmulatedSolarCells, SolarCellsModel  # noqa: PLC0415 - see `sim_hal.assembly`

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


def emulate_nmea(emulation: Emulation, gps: Gps) -> EmulatedGps:
    """Connect an emulated NMEA receiver to its serial line. Raises ConfigError if no orbit is simulated."""
    from sim_hal.emulators.nmea import EmulatedNmeaGps  # noqa: PLC0415 - see `sim_hal.assembly`

    world, line = orbiting(emulation.world, "gps"), emulation.connect(gps.device, gps.baud_rate)
    receiver = EmulatedNmeaGps(world, line, emulation.generator, gps_errors(emulation), emulation.start_ns)
    receiver.obeys = False
    return receiver


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
        part = _emulator(sensor, f"{emulation.kind}.sensors[{number}]", measured)
        made.append(part)
        if sensor.spi is not None:
            emulation.wires.spi_devices[sensor.spi] = part
        else:
            emulation.wires.i2c(sensor.bus).attach(part)
    return tuple(made)


def _emulator(sensor: Sensor, key: str, measured: Measurements) -> Any:
    place = SENSOR_PARTS.get(sensor.part, sensor.part)
    if sensor.emulator is not None:
        return imported(f"{key}.emulator", sensor.emulator, {}, os.environ)(measured, sensor)
    if place not in EMULATORS:
        known = ", ".join(SENSOR_PARTS)
        raise ConfigError(
            f"{key}.emulator",
            f"is missing: only {known} have a built-in emulator; name your own by `emulator`",
        )
    return EMULATORS[place](sensor.address or _ADDRESSES.get(place, 0), measured)
