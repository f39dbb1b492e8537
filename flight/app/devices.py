"""Opens the buses and ports, real or simulated, and the configured devices on them.

The module `sim_hal.rig` is the only module of the simulator that the flight application imports, and only for
a simulated flight.
"""

from __future__ import annotations

import os
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flight.app.run import RunRequest
from flight.loop.state import state_folder
from flight.schema.devices import AravisDevice, Camera, V4l2Device, WideCamera
from flight.schema.document import ConfigError
from flight.schema.orbit import OrbitConfig
from flight.schema.sections import Config
from hal.buses.clock import SystemClock
from hal.buses.i2c_bus import LinuxI2cBus
from hal.buses.serial_port import PySerialPort
from hal.drivers.ads1115 import AdsSolarStrings, StringWiring
from hal.drivers.aravis_camera import AravisCamera, AravisSettings
from hal.drivers.camera import CameraDevice, ServedCamera
from hal.drivers.coils import CoilSettings, PwmTorqueCoils, wirings
from hal.drivers.ina219 import Ina219
from hal.drivers.pca9685 import Pca9685, switch_off
from hal.drivers.ublox import EARLIEST_NS, UbloxReceiver
from hal.drivers.v4l2_camera import Stamp, V4l2Camera, V4l2Settings
from hal.drivers.vn100.driver import Vn100, Vn100Settings
from hal.interfaces.devices import (
    FrameSource,
    GpsReceiver,
    InertialUnit,
    PowerMonitor,
    SolarStrings,
    TorqueCoils,
)
from hal.interfaces.errors import DeviceError, OutOfRange
from hal.interfaces.guardian import CoilReach
from hal.interfaces.wires import SECOND_NS, Clock, Rig, Wires
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orbit_knowledge import TwoLineElements
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH
from knightcube.astro.quaternion import NED_TO_TESTBED, attitude_map, attitude_matrix
from knightcube.errors import UsageError

if TYPE_CHECKING:
    from sim_hal.rig import PosedCamera, SimulationRequest

_BEFORE_ELEMENTS = 365.0
"""Maximum time (days) by which a GPS date may precede the epoch of the two-line elements."""


def fault_catalogue() -> tuple[str, str]:
    """Return the grammar of simulated faults, and a list of all faults."""
    from sim_hal import rig  # noqa: PLC0415

    return rig.fault_catalogue()


def corrupted_text(request: RunRequest, text: str) -> str:
    """Return a configuration's text with the corruption that the requested faults cause."""
    from sim_hal import rig  # noqa: PLC0415

    return rig.corrupted_text(request.faults, text, request.seed)


def injected_faults(request: RunRequest, text: str) -> tuple[str, ...]:
    """Return the faults of a flight as texts, first those of the configuration."""
    from sim_hal import rig  # noqa: PLC0415

    return rig.injected_faults(_simulation_request(request, text))


def simulated_rig(request: RunRequest, text: str, config: Config, stack: ExitStack) -> Rig:
    """Open the emulated devices of a configuration with the requested faults. Raises UsageError."""
    from sim_hal import rig  # noqa: PLC0415

    return rig.open_rig(_simulation_request(request, text), config, stack)


def check_simulated_elements(request: RunRequest, text: str, config: Config) -> None:
    """Raise ConfigError if the two-line elements of a configuration do not fit its simulated orbit."""
    from sim_hal import rig  # noqa: PLC0415

    rig.check_elements(_simulation_request(request, text), config)


def simulated_camera(config_path: Path, text: str, config: Config, rate: FloatArray) -> PosedCamera:
    """Return the emulated camera of a configuration, rotating at `rate` (3,), rad/s, in camera axes."""
    from sim_hal import rig  # noqa: PLC0415

    return rig.open_camera(rig.SimulationRequest(config_path, text, Path()), config, rate)


def _simulation_request(request: RunRequest, text: str) -> SimulationRequest:
    from sim_hal.rig import SimulationRequest  # noqa: PLC0415

    return SimulationRequest(
        request.config_path,
        text,
        request.out,
        request.realtime,
        request.seed,
        request.devices,
        request.faults,
    )


@dataclass(frozen=True, slots=True)
class Devices:
    """The open devices; devices that the configuration does not have are None or empty."""

    unit: InertialUnit
    coils: TorqueCoils
    power: PowerMonitor | None
    camera: FrameSource | None
    gps: GpsReceiver | None = None
    strings: SolarStrings | None = None
    horizon_cameras: tuple[FrameSource, ...] = ()


def open_devices(config: Config, rig: Rig, stack: ExitStack, patient: bool) -> Devices:
    """Open the devices, beginning with the coils, so that these are at zero before anything else happens.

    Raises DeviceError for a device that does not answer, unless the flight is `patient` and retries.
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
    gps, strings = open_gps(config, rig, stack), open_strings(config, rig, stack)
    return Devices(unit, coils, power, camera, gps, strings, rig.wires.wide)


def open_gps(config: Config, rig: Rig, stack: ExitStack) -> UbloxReceiver | None:
    """Open the GPS receiver, or return None if it is not configured.

    The receiver is configured when it is first read.
    """
    if config.gps is None or rig.wires.gps is None:
        return None
    earliest_ns = EARLIEST_NS
    if isinstance(config, OrbitConfig) and config.elements is not None:
        with suppress(UsageError):  # wrong elements are reported when the body is built
            days = TwoLineElements(*config.elements).epoch - UNIX_EPOCH
            earliest_ns = round((days - _BEFORE_ELEMENTS) * DAY) * SECOND_NS
    gps = UbloxReceiver(rig.wires.gps, rig.clock, round(config.gps.period * SECOND_NS), earliest_ns)
    stack.callback(gps.close)
    return gps


def open_strings(config: Config, rig: Rig, stack: ExitStack) -> AdsSolarStrings | None:
    """Open the converters of the solar cells, or return None if they are not configured."""
    section = config.solar_strings
    if section is None:
        return None
    wired = [StringWiring(s.address, s.channel, s.volt_per_ampere) for s in section.strings]
    strings = AdsSolarStrings(rig.wires.i2c, rig.clock, wired, round(section.period * SECOND_NS))
    stack.callback(strings.close)
    return strings


def check_settings(config: Config) -> None:
    """Raise ConfigError, with the permitted range, for a value that a driver does not accept."""
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
    wired = wirings(coils.channels, coils.resistance, coils.signs, coils.limits)
    return CoilSettings(wired, coils.supply_voltage, max(coils.limits), coils.stale_after)


def unit_settings(config: Config) -> Vn100Settings:
    """Return the settings of the inertial unit's driver, whose readings are in the testbed frame."""
    unit = config.inertial_unit
    mounting, known = np.array(unit.mounting), unit.calibration
    return Vn100Settings(
        attitude_map=attitude_map(mounting, NED_TO_TESTBED),
        mounting=attitude_matrix(mounting),
        gyro_matrix=np.array(known.gyro_matrix),
        field_matrix=np.array(known.field_matrix),
        field_bias=np.array(known.field_bias),
        rate_hz=unit.rate_hz,
        output=unit.output,
        field_range=unit.field_range,
    )


def linux_rig(config: Config, stack: ExitStack, patient: bool) -> Rig:
    """Open buses and ports, and switch the coils off before anything else can fail.

    Raises ConfigError, and DeviceError for missing hardware unless the flight is `patient` and waits for it.
    """
    clock = SystemClock()
    i2c = LinuxI2cBus(config.coils.bus, patient=patient, exclusive=True)
    stack.callback(i2c.close)
    with suppress(DeviceError) if patient else nullcontext():
        switch_off(i2c, config.coils.address)
    unit = config.inertial_unit
    serial = PySerialPort(unit.device, unit.baud_rate, clock, patient)
    stack.callback(serial.close)
    reach = CoilReach("hal.buses.smbus_byte:open_bus", i2c.name, config.coils.address)
    if (folder := state_folder(config, os.environ)) is not None:
        reach.note(folder)
    frames = linux_camera(config.camera, clock, stack, patient) if config.camera is not None else None
    gps = None
    if config.gps is not None:
        gps = PySerialPort(config.gps.device, config.gps.baud_rate, clock, patient)
        stack.callback(gps.close)
    wide = tuple(linux_camera(camera, clock, stack, patient) for camera in config.wide_cameras)
    wires = Wires(serial, i2c, frames, gps, wide)
    return Rig(clock, wires, lambda _: None, True, 0, reach=reach)


def linux_camera(
    camera: Camera | WideCamera, clock: Clock, stack: ExitStack, patient: bool = False
) -> FrameSource:
    """Open the configured camera.

    Raises ConfigError without a camera, and DeviceError for missing hardware unless the flight is `patient`.
    """
    device, shape = camera.device, (camera.columns, camera.rows)
    exposure_ns = round(camera.exposure * SECOND_NS)
    opened: CameraDevice
    if isinstance(device, V4l2Device):
        delay_ns = round(device.stamp_delay * SECOND_NS)
        opened = V4l2Camera(
            V4l2Settings(
                device.path,
                *shape,
                device.pixel_format,
                exposure_ns,
                device.gain,
                Stamp(device.stamp),
                delay_ns,
            ),
            clock,
        )
    elif isinstance(device, AravisDevice):
        opened = AravisCamera(
            AravisSettings(device.name, *shape, device.pixel_format, exposure_ns, device.gain), clock
        )
    else:
        raise ConfigError(
            "camera.device",
            "real devices are flown: give `{kind: v4l2, path: ...}` or `{kind: aravis, name: ...}`, or give "
            "`camera: none`",
        )
    source = ServedCamera(opened, clock, patient=patient)
    stack.callback(source.close)
    return source
