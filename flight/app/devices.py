"""Opens the drivers of the devices on a rig's wires, as configured."""

from __future__ import annotations

from contextlib import ExitStack, nullcontext, suppress

import numpy as np

from flight.loop.services import Devices
from flight.schema.errors import ConfigError
from flight.schema.sections import Config
from hal.drivers.ads1115 import AdsSolarStrings, StringWiring
from hal.drivers.coil_settings import CoilSettings, wirings
from hal.drivers.coils import PwmTorqueCoils
from hal.drivers.ina219 import Ina219
from hal.drivers.pca9685 import Pca9685
from hal.drivers.ublox.receiver import UbloxReceiver
from hal.drivers.vn100.driver import Vn100, Vn100Settings
from hal.interfaces.errors import DeviceError, OutOfRange
from hal.interfaces.rig import Rig
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.frames import NED_TO_TESTBED, attitude_map
from knightcube.astro.quaternion import attitude_matrix


def open_devices(config: Config, rig: Rig, stack: ExitStack, patient: bool) -> Devices:
    """Open the devices, the coils first, so that they are at zero before anything else happens.

    Raises DeviceError for a device that does not answer; the drivers of a `patient` flight keep trying.
    """
    coils = PwmTorqueCoils(
        Pca9685(rig.wires.i2c, config.coils.address, rig.clock), rig.clock, coil_settings(config)
    )
    stack.callback(coils.close)
    coils.start(patient=patient)
    power = None
    if config.power_monitor is not None:
        monitor = config.power_monitor
        power = Ina219(rig.wires.i2c, monitor.address, rig.clock, monitor.shunt)
        stack.callback(power.close)
    unit = Vn100(rig.wires.serial, rig.clock, unit_settings(config))
    stack.callback(unit.close)
    with suppress(DeviceError) if patient else nullcontext():
        unit.configure()
    camera = rig.wires.frames
    if camera is not None:
        stack.callback(camera.close)
    for wide in rig.wires.wide:
        stack.callback(wide.close)
    gps = open_gps(config, rig, stack)
    strings = open_strings(config, rig, stack)
    return Devices(unit, coils, power, camera, gps, strings, rig.wires.wide)


def open_gps(config: Config, rig: Rig, stack: ExitStack) -> UbloxReceiver | None:
    """Open the GPS receiver where one is configured; it is set up while it is read."""
    if config.gps is None or rig.wires.gps is None:
        return None
    gps = UbloxReceiver(rig.wires.gps, rig.clock, round(config.gps.period * SECOND_NS))
    stack.callback(gps.close)
    return gps


def open_strings(config: Config, rig: Rig, stack: ExitStack) -> AdsSolarStrings | None:
    """Open the solar strings' converters where they are configured."""
    section = config.solar_strings
    if section is None:
        return None
    wired = [StringWiring(s.address, s.channel, s.volt_per_ampere) for s in section.strings]
    strings = AdsSolarStrings(rig.wires.i2c, rig.clock, wired, round(section.period * SECOND_NS))
    stack.callback(strings.close)
    return strings


def check_settings(config: Config) -> None:
    """Refuse a value that a driver does not take. Raises ConfigError with the driver's range."""
    for section, settings in (("coils", coil_settings), ("inertial_unit", unit_settings)):
        try:
            settings(config)
        except OutOfRange as error:
            key = error.quantity.removeprefix("coil ").replace(" ", "_")
            known = hasattr(getattr(config, section), key)
            problem = f"{error.value!r}: must be {error.low:g} to {error.high:g} {error.unit}".rstrip()
            raise ConfigError(
                f"{section}.{key}" if known else section, f"is {problem}" if known else f"{key} is {problem}"
            ) from error


def coil_settings(config: Config) -> CoilSettings:
    """Return the settings of the coil driver."""
    coils = config.coils
    wired = wirings(coils.channels, coils.resistance, coils.signs, coils.enable_channels)
    return CoilSettings(wired, coils.supply_voltage, coils.current_limit, coils.stale_after)


def unit_settings(config: Config) -> Vn100Settings:
    """Return the settings of the inertial unit's driver; readings are in the testbed frame."""
    unit = config.inertial_unit
    mounting = np.array(unit.mounting)
    return Vn100Settings(
        attitude_map=attitude_map(mounting, NED_TO_TESTBED),
        mounting=attitude_matrix(mounting),
        rate_hz=unit.rate_hz,
        output=unit.output,
        field_range=unit.field_range,
    )
