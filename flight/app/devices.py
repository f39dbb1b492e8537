"""Opens the buses and ports, real or simulated, and the configured devices on them.

The module `sim_hal.rig` is the only module of the simulator that the flight application imports, and only for
a simulated flight.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flight.app.run import RunRequest
from flight.link.commands import event_problem
from flight.loop.state import state_folder
from flight.schema.bodies import OrbitConfig
from flight.schema.devices import (
    SENSOR_PARTS,
    AravisDevice,
    Camera,
    Coils,
    Gps,
    InertialUnitSection,
    MagnetometerSection,
    PowerMonitorSection,
    Sensor,
    SensorsSection,
    SolarStringsSection,
    UnitSection,
    V4l2Device,
    WideCamera,
    axis_matrix,
    driver_of,
    fitted_devices,
)
from flight.schema.document import ConfigError, call_named, imported
from flight.schema.sections import Config
from hal.buses.linux_wires import LinuxWires, device_file
from hal.buses.system import SystemClock
from hal.drivers.aravis_camera import AravisCamera, AravisSettings
from hal.drivers.camera import CameraDevice, ServedCamera
from hal.drivers.coils import (
    CONTROL,
    LAST_STEP,
    OFF,
    STEP_V,
    CoilSettings,
    Drv8830Bridges,
    Drv8830Coils,
    PwmTorqueCoils,
    wirings,
)
from hal.drivers.current_monitors import (
    ADS1115_CONFIG,
    CONFIG,
    AdsSolarStrings,
    Ina219,
    StringWiring,
    range_for,
)
from hal.drivers.gps import EARLIEST_NS, NmeaReceiver, UbloxReceiver
from hal.drivers.pca9685 import ALL_LED_OFF_H, FULL, MODE1, Pca9685
from hal.drivers.sensor_unit import CheckedUnit, CircuitPythonI2c, SensorPart, SensorUnit, UnitSettings
from hal.drivers.v4l2_camera import Stamp, V4l2Camera, V4l2Settings
from hal.drivers.vn100 import Vn100, Vn100Settings
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
from knightcube.astro.quaternion import NED_TO_TESTBED, attitude_map, attitude_matrix
from knightcube.errors import UsageError

if TYPE_CHECKING:
    from sim_hal.rig import EmulatedBench, PosedCamera, SimulationRequest

NO_INDEX = "no such file: make it with `knightcube index --camera CONFIG --out FILE`"
NO_CAMERA = (
    "the flight uses real devices: give `{driver: v4l2, path: ...}` or `{driver: aravis, name: ...}`, or "
    "give `camera: none`"
)
_BEFORE_ELEMENTS = 365.0
"""Maximum time (days) by which a GPS date may precede the epoch of the two-line elements."""


def fault_catalogue() -> tuple[str, str]:
    """Return the syntax of fault specifications, and the list of all simulated faults, as two texts."""
    from sim_hal import rig  # noqa: PLC0415

    return rig.fault_catalogue()


def corrupted_text(request: RunRequest, text: str) -> str:
    """Return a configuration's text with the corruption that the requested faults cause."""
    from sim_hal import rig  # noqa: PLC0415

    return rig.corrupted_text(request.faults, text, request.seed)


def injected_faults(request: RunRequest, text: str) -> tuple[str, ...]:
    """Return the faults of a flight as texts: the configured faults, followed by the requested faults."""
    from sim_hal import rig  # noqa: PLC0415

    return rig.injected_faults(_simulation_request(request, text))


def simulated_rig(request: RunRequest, text: str, config: Config, stack: ExitStack) -> Rig:
    """Open the emulated devices of a configuration. Raises UsageError if a requested fault is invalid."""
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


def emulated_bench(config_path: Path, text: str, config: Config) -> EmulatedBench:
    """Return the emulated devices of a configuration on a test bench, where the body is rotated by hand."""
    from sim_hal import rig  # noqa: PLC0415

    return rig.open_bench(rig.SimulationRequest(config_path, text, Path()), config)


def _simulation_request(request: RunRequest, text: str) -> SimulationRequest:
    from sim_hal.rig import SimulationRequest  # noqa: PLC0415

    options = request.out, request.realtime, request.seed, request.devices, request.faults
    return SimulationRequest(request.config_path, text, *options)


@dataclass(frozen=True, slots=True)
class Devices:
    """The open devices; a missing device is None or empty. `supply` begins with the battery's monitor."""

    unit: InertialUnit
    magnetometer: InertialUnit | None
    coils: TorqueCoils
    power: PowerMonitor | None
    camera: FrameSource | None
    gps: GpsReceiver | None = None
    strings: SolarStrings | None = None
    horizon_cameras: tuple[FrameSource, ...] = ()
    supply: tuple[PowerMonitor, ...] = ()


def open_devices(config: Config, rig: Rig, stack: ExitStack, patient: bool) -> Devices:
    """Open the devices, beginning with the coils, so that the coils are at zero before any other action.

    Raises DeviceError for a device that does not answer, unless the flight is `patient` and retries.
    """
    coils: TorqueCoils = opened("coils", config, rig, stack)
    _called("coils.driver", config.coils, coils.start, patient)
    power: PowerMonitor | None = opened("power_monitor", config, rig, stack)
    unit: InertialUnit = opened("inertial_unit", config, rig, stack)
    magnetometer: InertialUnit | None = opened("magnetometer", config, rig, stack)
    for kind, one in (("inertial_unit", unit), ("magnetometer", magnetometer)):
        with suppress(DeviceError) if patient else nullcontext():
            if one is not None:
                _called(f"{kind}.driver", getattr(config, kind), one.configure)
    cameras = [config.camera, *config.wide_cameras]
    if rig.cameras is None:
        frames = [open_camera(one, rig, stack, patient) if one is not None else None for one in cameras]
    else:
        frames = list(rig.cameras)
        for source in filter(None, frames):
            stack.callback(source.close)
    gps: GpsReceiver | None = opened("gps", config, _dated(rig, config), stack)
    strings: SolarStrings | None = opened("solar_strings", config, rig, stack)
    supply = [] if config.power is None else config.power.monitors().items()
    monitors = tuple(_opened("power_monitor", one, rig, stack, key) for key, one in supply)
    wide = tuple(filter(None, frames[1:]))
    return Devices(unit, magnetometer, coils, power, frames[0], gps, strings, wide, monitors)


def _called(key: str, section: Any, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of a device; an error in a driver of another package is raised as NotResponding.

    The key `key` of `section` names the driver.
    """
    named = getattr(section, "driver", None) or section.__struct_config__.tag
    if ":" in named:
        return call_named(key, named, function, *arguments, device=True)
    return function(*arguments)


def opened(kind: str, config: Config, rig: Rig, stack: ExitStack) -> Any:
    """Return the device of a section, opened by its driver, or None if the device is not configured."""
    section = getattr(config, kind)
    return None if section is None else _opened(kind, section, rig, stack, kind)


def _opened(kind: str, section: Any, rig: Rig, stack: ExitStack, key: str) -> Any:
    device = driver_of(kind, section, f"{key}.driver").open(rig, section)
    _check_methods(kind, section, device, f"{key}.driver")
    stack.callback(device.close)
    # The built-in drivers check their readings themselves, at less cost than `CheckedUnit`.
    if kind in {"inertial_unit", "magnetometer"} and ":" in section.driver:
        return CheckedUnit(device, section.field_range, rig.clock)
    return device


_PROTOCOLS: Mapping[str, type[Any]] = {
    "inertial_unit": InertialUnit,
    "magnetometer": InertialUnit,
    "coils": TorqueCoils,
    "power_monitor": PowerMonitor,
    "gps": GpsReceiver,
    "solar_strings": SolarStrings,
    "camera": CameraDevice,
}
"""Protocol of the drivers of each kind."""


def _check_methods(kind: str, section: Any, device: Any, key: str) -> None:
    """Close the device and raise NotResponding if a driver of another package lacks a required method."""
    named = getattr(section, "driver", None) or section.__struct_config__.tag
    if ":" not in named:
        return
    for name, value in vars(_PROTOCOLS[kind]).items():
        if callable(value) and not name.startswith("_") and not callable(getattr(device, name, None)):
            if callable(close := getattr(device, "close", None)):
                close()
            problem = f"whose driver {type(device).__name__} has no method `{name}`: add it"
            raise NotResponding(f"`{key}`", f"is {named!r}, {problem}")


def _dated(rig: Rig, config: Config) -> Rig:
    """Return the rig with its earliest plausible UTC, computed from the epoch of the two-line elements."""
    if isinstance(config, OrbitConfig) and config.elements is not None:
        with suppress(UsageError):  # invalid elements are reported when the body is built
            days = TwoLineElements(*config.elements).epoch - UNIX_EPOCH
            return replace(rig, earliest_utc_ns=round((days - _BEFORE_ELEMENTS) * DAY) * SECOND_NS)
    return rig


def check_settings(config: Config) -> None:
    """Raise ConfigError for a value that a driver does not accept, and for an unknown event to clear."""
    for index, step in enumerate(config.commands.timeline):
        if step.clear is not None and (problem := event_problem(step.clear)):
            raise ConfigError(f"commands.timeline[{index}].clear", f"is {step.clear!r}, which {problem}")
    for name, kind, section in fitted_devices(config):
        try:
            driver_of(kind, section, f"{name}.driver").check(section)
        except OutOfRange as error:
            key = error.quantity.removeprefix("coil ").replace(" ", "_")
            known = hasattr(section, key)
            problem = f"{error.value!r}: must be {error.low:g} to {error.high:g} {error.unit}".rstrip()
            raise ConfigError(
                f"{name}.{key}" if known else name, f"is {problem}" if known else f"{key} is {problem}"
            ) from error


def real_rig(config: Config, stack: ExitStack, patient: bool = False, exclusive: bool = False) -> Rig:
    """Return this machine's hardware, which `stack` closes; `exclusive` locks the bus of the coils."""
    clock = SystemClock()
    wires = LinuxWires(clock, stack, config.coils.bus, patient, exclusive)
    return Rig(clock, wires, lambda _: None, True, 0)


def linux_rig(config: Config, stack: ExitStack, patient: bool) -> Rig:
    """Open the bus of the coils, and switch the coils off before anything else can fail.

    Raises ConfigError if the coils' driver gives no I2C writes that switch the coils off. Raises DeviceError
    for missing hardware, unless `patient` is true: the flight then waits for the hardware.
    """
    rig = real_rig(config, stack, patient, exclusive=True)
    off = driver_of("coils", config.coils).off(config.coils)
    if not off:
        raise ConfigError(
            "coils.driver", "its `off` returns no I2C writes, by which the guardian stops the coils"
        )
    bus = rig.wires.i2c()
    with suppress(DeviceError) if patient else nullcontext():
        for write in off:
            _write_patiently(bus, write)
    reach = CoilReach("hal.buses.smbus_byte:open_bus", device_file(config.coils.bus), tuple(off))
    if (folder := state_folder(config, os.environ)) is not None:
        reach.note(folder)
    return replace(rig, reach=reach)


def _write_patiently(bus: I2cBus, write: tuple[int, int, int]) -> None:
    """Write a byte to a register of a coil chip. Raises NotResponding if the write and two retries fail."""
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

    Raises ConfigError if the camera has no `device`, and DeviceError for missing hardware unless the flight
    is `patient`.
    """
    if camera.device is None:
        raise ConfigError("camera.device", NO_CAMERA)
    key = "camera.device.driver"
    device: CameraDevice = driver_of("camera", camera.device, key).open(rig, camera)
    _check_methods("camera", camera.device, device, key)
    source: ServedCamera = _called(key, camera.device, ServedCamera, device, rig.clock, patient)
    stack.callback(source.close)
    return source


# Functions of the built-in drivers, to which the driver registrations refer (`flight.schema.devices`).


def _serial_device(section: InertialUnitSection | Gps) -> Sequence[str]:
    return (section.device,)


def _own_bus(section: Coils | PowerMonitorSection | SolarStringsSection) -> Sequence[str]:
    return () if section.bus is None else (device_file(section.bus),)


files_vn100 = files_ublox = files_nmea = _serial_device
files_pca9685 = files_drv8830 = files_ina219 = files_ads1115 = _own_bus

_CHIP_CURE = "check power, wiring and address; `i2cdetect -y` lists the chips that answer"
_LISTENED_NS = 2_500_000_000
_LOOK_NS = 20_000_000


def unit_settings(unit: InertialUnitSection) -> Vn100Settings:
    """Return the settings of the VN-100's driver, whose readings are in the testbed frame."""
    mapped = attitude_map(np.array(unit.mounting), NED_TO_TESTBED)
    return Vn100Settings(attitude_map=mapped, output=unit.output, **_common_settings(unit))


def _common_settings(unit: UnitSection) -> dict[str, Any]:
    """Return the settings that the drivers of all inertial units share, by name."""
    known = unit.calibration
    return {
        "mounting": attitude_matrix(np.array(unit.mounting)),
        "gyro_matrix": np.array(known.gyro_matrix),
        "field_matrix": np.array(known.field_matrix),
        "field_bias": np.array(known.field_bias),
        "rate_hz": unit.rate_hz,
        "field_range": unit.field_range,
    }


check_vn100 = unit_settings


def open_vn100(rig: Rig, unit: InertialUnitSection) -> Vn100:
    """Return the driver of a VN-100."""
    return Vn100(rig.wires.serial(unit.device, unit.baud_rate), rig.clock, unit_settings(unit))


def probe_vn100(rig: Rig, unit: InertialUnitSection) -> str:
    """Ask a VN-100 for its model number. Raises DeviceError if it does not answer."""
    return f"answers: {open_vn100(rig, unit).model()}"


def open_sensors(rig: Rig, unit: SensorsSection) -> SensorUnit:
    """Return the driver of an inertial unit of several sensors. Raises ConfigError for an unknown sensor."""
    parts, measured = [], set[str]()
    kind = "magnetometer" if isinstance(unit, MagnetometerSection) else "inertial_unit"
    for number, sensor in enumerate(unit.sensors):
        key = f"{kind}.sensors[{number}]"
        part = imported(f"{key}.part", sensor.part, SENSOR_PARTS, os.environ)
        if (sensor.spi is not None) != hasattr(part, "SPEED_HZ"):
            problem = (
                "is only for a sensor on an SPI bus" if sensor.spi else "is missing: this is an SPI device"
            )
            raise ConfigError(f"{key}.spi", problem)
        axes: dict[str, FloatArray] = {
            quantity: _axes_of(f"{key}.measures.{quantity}", quantity, names)
            for quantity, names in sensor.measures.items()
        }
        parts.append(SensorPart(sensor.part, partial(_started, part, rig, sensor), axes))
        measured |= set(axes)
    if "magnetic" not in measured:
        raise ConfigError(
            f"{kind}.sensors", "do not measure the magnetic field: add a sensor that measures `magnetic`"
        )
    return SensorUnit(rig.clock, parts, UnitSettings(**_common_settings(unit)))


def _axes_of(key: str, quantity: str, names: Sequence[str]) -> FloatArray:
    """Return the matrix (3, 3) from sensor to unit axes. Raises ConfigError for axes that no sensor has."""
    matrix, given = axis_matrix(names), f"is [{', '.join(names)}]"
    if not np.abs(matrix).sum(axis=0).all():
        raise ConfigError(key, f"{given}: name each of the sensor's axes x, y and z once")
    # Some magnetometers have left-handed axes.
    if quantity != "magnetic" and np.linalg.det(matrix) < 0.0:
        raise ConfigError(
            key, f"{given}: these axes are left-handed: change the sign of one axis, or swap two"
        )
    return matrix


def _started(part: Callable[..., Any], rig: Rig, sensor: Sensor) -> Any:
    """Start a sensor, and return its driver."""
    if sensor.spi is not None:
        kind: Any = part
        driver = part(rig.wires.spi(sensor.spi, kind.SPEED_HZ, kind.MODE))
    else:
        given = {} if sensor.address is None else {"address": sensor.address}
        driver = part(CircuitPythonI2c(rig.wires.i2c(sensor.bus)), **given)
    for name, value in (sensor.set or {}).items():
        setattr(driver, name, value)
    return driver


def probe_sensors(rig: Rig, unit: SensorsSection) -> str:
    """Start all sensors, which writes their settings. Raises NotResponding if a sensor does not answer."""
    opened = open_sensors(rig, unit)
    try:
        opened.configure()
    finally:
        opened.close()
    return f"{', '.join(sensor.part for sensor in unit.sensors)}: each answers"


def files_sensors(unit: SensorsSection) -> Sequence[str]:
    """Return the SPI devices, and the I2C buses other than the coils' bus."""
    buses = [device_file(sensor.bus) for sensor in unit.sensors if sensor.bus is not None]
    return list(dict.fromkeys([*buses, *(sensor.spi for sensor in unit.sensors if sensor.spi)]))


def coil_settings(coils: Coils) -> CoilSettings:
    """Return the settings of the coil driver."""
    wired = wirings(coils.channels, coils.resistance, coils.signs, coils.limits)
    return CoilSettings(wired, coils.supply_voltage, max(coils.limits), coils.stale_after)


check_pca9685 = coil_settings


def check_drv8830(coils: Coils) -> CoilSettings:
    """Return the settings of coils on DRV8830 bridges. Raises OutOfRange for an excessive supply voltage."""
    volts, most = coils.supply_voltage, round(LAST_STEP * STEP_V, 2)
    if volts > most:
        raise OutOfRange("coils", "supply voltage of DRV8830 bridges", volts, 0.1, most, "V")
    return coil_settings(coils)


def open_pca9685(rig: Rig, coils: Coils) -> TorqueCoils:
    """Return the driver of coils on a PCA9685."""
    pca = Pca9685(rig.wires.i2c(coils.bus), coils.address, rig.clock)
    return PwmTorqueCoils(pca, rig.clock, coil_settings(coils))


def probe_pca9685(rig: Rig, coils: Coils) -> str:
    """Read a register of the PWM chip. Raises NotResponding."""
    return _read_chips(rig, coils.bus, MODE1, coils.address)


def off_pca9685(coils: Coils) -> Sequence[tuple[int, int, int]]:
    """Return the write that switches all outputs off."""
    return ((coils.address, ALL_LED_OFF_H, FULL),)


def open_drv8830(rig: Rig, coils: Coils) -> TorqueCoils:
    """Return the driver of coils on DRV8830 bridges."""
    settings = check_drv8830(coils)
    bridges = Drv8830Bridges(rig.wires.i2c(coils.bus), coils.address, rig.clock, settings)
    return Drv8830Coils(bridges, rig.clock, settings)


def probe_drv8830(rig: Rig, coils: Coils) -> str:
    """Read a register of each bridge. Raises NotResponding."""
    return _read_chips(rig, coils.bus, CONTROL, *_bridges(coils))


def off_drv8830(coils: Coils) -> Sequence[tuple[int, int, int]]:
    """Return the writes that switch all bridges off."""
    return tuple((address, CONTROL, OFF) for address in _bridges(coils))


def _bridges(coils: Coils) -> range:
    return range(coils.address, coils.address + len(coils.slots))


def open_ina219(rig: Rig, monitor: PowerMonitorSection) -> Ina219:
    """Return the driver of an INA219."""
    bus, largest = rig.wires.i2c(monitor.bus), monitor.maximum_current
    return Ina219(bus, monitor.address, rig.clock, monitor.shunt, maximum_current=largest)


def check_ina219(monitor: PowerMonitorSection) -> int:
    """Return the range bits of an INA219. Raises OutOfRange if no range covers its current."""
    return range_for(monitor.maximum_current, monitor.shunt)


def probe_ina219(rig: Rig, monitor: PowerMonitorSection) -> str:
    """Read a register of the current monitor. Raises NotResponding."""
    return _read_chips(rig, monitor.bus, CONFIG, monitor.address)


def open_ublox(rig: Rig, gps: Gps) -> GpsReceiver:
    """Return the driver of a u-blox receiver, which configures the receiver at its first reading."""
    earliest_ns = max(EARLIEST_NS, rig.earliest_utc_ns)
    port = rig.wires.serial(gps.device, gps.baud_rate)
    return UbloxReceiver(port, rig.clock, round(gps.period * SECOND_NS), earliest_ns)


def probe_ublox(rig: Rig, gps: Gps) -> str:
    """Wait for bytes of the GPS receiver, whose baud rate the driver changes if necessary."""
    port = rig.wires.serial(gps.device, gps.baud_rate)
    return _wait_for(lambda: bool(port.receive()), rig, gps, "byte")


def _wait_for(arrived: Callable[[], bool], rig: Rig, gps: Gps, what: str) -> str:
    """Wait until a GPS receiver, which sends without a request, has sent `what`. Raises NotResponding.

    A receiver sends at least once a second after its power-on, and once per `period` after a flight.
    """
    listened_ns = max(_LISTENED_NS, round((gps.period + 0.5) * SECOND_NS))
    deadline_ns = rig.clock.now_ns() + listened_ns
    while rig.clock.now_ns() < deadline_ns:
        if arrived():
            return "sends"
        rig.clock.sleep_until_ns(rig.clock.now_ns() + _LOOK_NS)
    silence = f"the port opens, but no {what} arrived in {listened_ns * 1e-9:g} s"
    raise NotResponding(gps.device, f"{silence}: check power, the cable and the baud rate")


def open_nmea(rig: Rig, gps: Gps) -> GpsReceiver:
    """Return the driver of a receiver that sends NMEA 0183 sentences without requests."""
    port = rig.wires.serial(gps.device, gps.baud_rate)
    return NmeaReceiver(port, rig.clock, max(EARLIEST_NS, rig.earliest_utc_ns))


def probe_nmea(rig: Rig, gps: Gps) -> str:
    """Wait for a valid sentence, because the driver cannot change the receiver's baud rate."""
    receiver = open_nmea(rig, gps)

    def arrived() -> bool:
        receiver.poll()
        return receiver.link().sentences > 0

    return _wait_for(arrived, rig, gps, f"NMEA sentence at {gps.baud_rate} baud")


def open_ads1115(rig: Rig, section: SolarStringsSection) -> AdsSolarStrings:
    """Return the driver of the analogue-to-digital converters that measure the solar cells."""
    wired = [StringWiring(one.address, one.channel, one.volt_per_ampere) for one in section.strings]
    bus = rig.wires.i2c(section.bus)
    return AdsSolarStrings(bus, rig.clock, wired, round(section.period * SECOND_NS))


def probe_ads1115(rig: Rig, section: SolarStringsSection) -> str:
    """Read a register of each converter. Raises NotResponding."""
    addresses = sorted({string.address for string in section.strings})
    return _read_chips(rig, section.bus, ADS1115_CONFIG, *addresses)


def open_v4l2(rig: Rig, camera: Camera | WideCamera) -> V4l2Camera:
    """Return the driver of a Video for Linux camera."""
    device = camera.device
    assert isinstance(device, V4l2Device)
    settings = V4l2Settings(
        device.path,
        camera.columns,
        camera.rows,
        device.pixel_format,
        round(camera.exposure * SECOND_NS),
        device.gain,
        Stamp(device.stamp),
        round(device.stamp_delay * SECOND_NS),
    )
    return V4l2Camera(settings, rig.clock)


def open_aravis(rig: Rig, camera: Camera | WideCamera) -> AravisCamera:
    """Return the driver of a GenICam camera."""
    device = camera.device
    assert isinstance(device, AravisDevice)
    shape, exposure_ns = (camera.columns, camera.rows), round(camera.exposure * SECOND_NS)
    return AravisCamera(
        AravisSettings(device.name, *shape, device.pixel_format, exposure_ns, device.gain), rig.clock
    )


def probe_v4l2(rig: Rig, camera: Camera | WideCamera) -> str:
    """Return a text that describes an opened camera (`flight.app.devices.open_camera`)."""
    return "the camera can be opened; `knightcube camera` shows its images"


probe_aravis = probe_v4l2


def files_v4l2(camera: Camera | WideCamera) -> Sequence[str]:
    """Return the video device."""
    return (camera.device.path,) if isinstance(camera.device, V4l2Device) else ()


files_aravis = files_v4l2


def _read_chips(rig: Rig, bus: int | str | None, register: int, *addresses: int) -> str:
    """Read a register of each chip on an I2C bus. Raises NotResponding if a chip does not answer."""
    opened = rig.wires.i2c(bus)
    for address in addresses:
        try:
            opened.read_i2c_block_data(address, register, 2)
        except OSError as error:
            raise NotResponding(f"0x{address:02x}", f"{error.strerror}: {_CHIP_CURE}") from error
    named = ", ".join(f"0x{address:02x}" for address in addresses)
    return f"{named} answer{'s' if len(addresses) == 1 else ''}"
