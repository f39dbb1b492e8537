"""Opens the buses and ports, real or simulated, and the configured devices on them.

The module `sim_hal.rig` is the only module of the simulator that the flight application imports, and only for
a simulated flight.
"""

from __future__ import annotations

import os
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flight.app.run import RunRequest
from flight.loop.state import state_folder
from flight.schema.devices import Camera, WideCamera
from flight.schema.document import ConfigError
from flight.schema.drivers import DRIVERS, driver_of
from flight.schema.orbit import OrbitConfig
from flight.schema.sections import Config
from hal.buses.clock import SystemClock
from hal.buses.i2c_bus import device_file
from hal.buses.linux_wires import LinuxWires
from hal.drivers.camera import CameraDevice, ServedCamera
from hal.interfaces.devices import (
    FrameSource,
    GpsReceiver,
    InertialUnit,
    PowerMonitor,
    SolarStrings,
    TorqueCoils,
)
from hal.interfaces.errors import DeviceError, NotResponding, OutOfRange
from hal.interfaces.guardian import CoilReach
from hal.interfaces.wires import SECOND_NS, I2cBus, Rig
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orbit_knowledge import TwoLineElements
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH
from knightcube.errors import UsageError

if TYPE_CHECKING:
    from sim_hal.rig import PosedCamera, SimulationRequest

NO_CAMERA = (
    "real devices are flown: give `{driver: v4l2, path: ...}` or `{driver: aravis, name: ...}`, or "
    "give `camera: none`"
)
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
    coils: TorqueCoils = opened("coils", config, rig, stack)
    coils.start(patient=patient)
    power: PowerMonitor | None = opened("power_monitor", config, rig, stack)
    unit: InertialUnit = opened("inertial_unit", config, rig, stack)
    with suppress(DeviceError) if patient else nullcontext():
        unit.configure()
    cameras = [config.camera, *config.wide_cameras]
    if rig.cameras is None:
        frames = [open_camera(one, rig, stack, patient) if one is not None else None for one in cameras]
    else:
        frames = list(rig.cameras)
        for source in filter(None, frames):
            stack.callback(source.close)
    gps: GpsReceiver | None = opened("gps", config, _dated(rig, config), stack)
    strings: SolarStrings | None = opened("solar_strings", config, rig, stack)
    return Devices(unit, coils, power, frames[0], gps, strings, tuple(filter(None, frames[1:])))


def opened(kind: str, config: Config, rig: Rig, stack: ExitStack) -> Any:
    """Return the open device of a section through its driver, or None if it is not configured."""
    section = getattr(config, kind)
    if section is None:
        return None
    device = driver_of(kind, section).open(rig, section)
    stack.callback(device.close)
    return device


def _dated(rig: Rig, config: Config) -> Rig:
    """Return the rig with the earliest possible date of the flight, from the two-line elements."""
    if isinstance(config, OrbitConfig) and config.elements is not None:
        with suppress(UsageError):  # wrong elements are reported when the body is built
            days = TwoLineElements(*config.elements).epoch - UNIX_EPOCH
            return replace(rig, earliest_utc_ns=round((days - _BEFORE_ELEMENTS) * DAY) * SECOND_NS)
    return rig


def check_settings(config: Config) -> None:
    """Raise ConfigError, with the permitted range, for a value that a driver does not accept."""
    for kind in DRIVERS:
        section = getattr(config, kind)
        if section is None or kind == "camera":
            continue
        try:
            driver_of(kind, section).check(section)
        except OutOfRange as error:
            key = error.quantity.removeprefix("coil ").replace(" ", "_")
            known = hasattr(section, key)
            problem = f"{error.value!r}: must be {error.low:g} to {error.high:g} {error.unit}".rstrip()
            raise ConfigError(
                f"{kind}.{key}" if known else kind, f"is {problem}" if known else f"{key} is {problem}"
            ) from error


def real_rig(config: Config, stack: ExitStack, patient: bool = False, exclusive: bool = False) -> Rig:
    """Return this machine's hardware with nothing opened; `stack` closes whatever a driver opens.

    The bus of the coils is locked for this process if `exclusive` is true.
    """
    clock = SystemClock()
    wires = LinuxWires(clock, stack, config.coils.bus, patient, exclusive)
    return Rig(clock, wires, lambda _: None, True, 0)


def linux_rig(config: Config, stack: ExitStack, patient: bool) -> Rig:
    """Open the bus of the coils, and switch the coils off before anything else can fail.

    Raises ConfigError, and DeviceError for missing hardware unless the flight is `patient` and waits for it.
    """
    rig, off = (
        real_rig(config, stack, patient, exclusive=True),
        driver_of("coils", config.coils).off(config.coils),
    )
    if not off:
        raise ConfigError("coils.driver", "registers no writes (`off`) by which the guardian stops the coils")
    bus = rig.wires.i2c()
    with suppress(DeviceError) if patient else nullcontext():
        for write in off:
            _write_patiently(bus, write)
    reach = CoilReach("hal.buses.smbus_byte:open_bus", device_file(config.coils.bus), tuple(off))
    if (folder := state_folder(config, os.environ)) is not None:
        reach.note(folder)
    return replace(rig, reach=reach)


def _write_patiently(bus: I2cBus, write: tuple[int, int, int]) -> None:
    """Write a byte to a register of a coil chip, with two retries. Raises NotResponding."""
    for left in (2, 1, 0):
        try:
            bus.write_byte_data(*write)
            return
        except OSError as error:
            if left == 0:
                problem = f"could not be switched off: {error.strerror}"
                raise NotResponding(f"coils' chip at 0x{write[0]:02x}", problem) from error


def open_camera(
    camera: Camera | WideCamera, rig: Rig, stack: ExitStack, patient: bool = False
) -> FrameSource:
    """Open the configured camera.

    Raises ConfigError without a camera, and DeviceError for missing hardware unless the flight is `patient`.
    """
    if camera.device is None:
        raise ConfigError("camera.device", NO_CAMERA)
    device: CameraDevice = driver_of("camera", camera.device, "camera.device.driver").open(rig, camera)
    source = ServedCamera(device, rig.clock, patient=patient)
    stack.callback(source.close)
    return source
