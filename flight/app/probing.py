"""Looks for the real devices that a configuration names. Nothing is set up, and no coil is touched.

A device that does not answer is reported with the cure. A running flight holds its serial port and its
camera: they are then reported as busy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from flight.app.devices import linux_camera, unit_settings
from flight.schema.devices import Camera
from flight.schema.orbit_devices import WideCamera
from flight.schema.sections import Config
from hal.buses.clock import SystemClock
from hal.buses.i2c_bus import LinuxI2cBus, device_file
from hal.buses.serial_port import PySerialPort
from hal.drivers import ads1115, ina219
from hal.drivers.pca9685 import MODE1
from hal.drivers.vn100.driver import Vn100
from hal.interfaces.errors import DeviceError, NotResponding

_CHIP_CURE = "is it powered, wired and at this address? `i2cdetect -y` shows who answers"
_LISTENED_NS = 2_500_000_000
_LOOK_NS = 20_000_000


@dataclass(frozen=True, slots=True)
class Probed:
    """A device: its name in the configuration, where it should be, and its answer or the cure."""

    name: str
    place: str
    found: bool
    text: str


def probe(config: Config) -> list[Probed]:
    """Return each device that the configuration names, and each file or folder that a flight needs."""
    found = list(_chips(config))
    unit = config.inertial_unit
    found.append(_probed("inertial_unit", unit.device, lambda stack: _ask_unit(config, stack)))
    if config.gps is not None:
        gps = config.gps
        found.append(_probed("gps", gps.device, lambda stack: _listen(gps.device, gps.baud_rate, stack)))
    cameras: dict[str, Camera | WideCamera] = {} if config.camera is None else {"camera": config.camera}
    cameras |= {f"wide_cameras[{index}]": camera for index, camera in enumerate(config.wide_cameras)}
    for name, camera in cameras.items():
        found.append(_probed(name, _camera_place(camera), partial(_open_camera, camera)))
    return found + list(_files(config))


def _probed(name: str, place: str, ask: Callable[[ExitStack], str]) -> Probed:
    with ExitStack() as stack:
        try:
            return Probed(name, place, True, ask(stack))
        except DeviceError as error:
            return Probed(name, place, False, error.message)


def _chips(config: Config) -> Iterator[Probed]:
    """Look for the chips on the I2C bus, by reading one register of each."""
    bus = device_file(config.coils.bus)
    addresses = {"coils": (config.coils.address, MODE1)}
    if config.power_monitor is not None:
        addresses["power_monitor"] = config.power_monitor.address, ina219.CONFIG
    if config.solar_strings is not None:
        for address in sorted({string.address for string in config.solar_strings.strings}):
            addresses[f"solar_strings, 0x{address:02x}"] = address, ads1115.CONFIG
    for name, (address, register) in addresses.items():

        def ask(stack: ExitStack, address: int = address, register: int = register) -> str:
            opened = LinuxI2cBus(config.coils.bus)
            stack.callback(opened.close)
            try:
                opened.read_i2c_block_data(address, register, 2)
            except OSError as error:
                raise NotResponding(bus, f"{error.strerror}: {_CHIP_CURE}") from error
            return "answers"

        yield _probed(name, f"{bus}, 0x{address:02x}", ask)


def _ask_unit(config: Config, stack: ExitStack) -> str:
    clock, unit = SystemClock(), config.inertial_unit
    port = PySerialPort(unit.device, unit.baud_rate, clock)
    stack.callback(port.close)
    return f"answers: {Vn100(port, clock, unit_settings(config)).model()}"


def _listen(device: str, baud_rate: int, stack: ExitStack) -> str:
    """Wait for the bytes that a GPS receiver sends by itself, at least once a second."""
    clock = SystemClock()
    port = PySerialPort(device, baud_rate, clock)
    stack.callback(port.close)
    deadline_ns = clock.now_ns() + _LISTENED_NS
    while clock.now_ns() < deadline_ns:
        if port.receive():
            return "sends"
        clock.sleep_until_ns(clock.now_ns() + _LOOK_NS)
    silence = f"opens, but not one byte came in {_LISTENED_NS * 1e-9:g} s"
    raise NotResponding(device, f"{silence}: check power, the cable and the baud rate")


def _open_camera(camera: Camera | WideCamera, stack: ExitStack) -> str:
    linux_camera(camera, SystemClock(), stack)
    return "opens; `flight camera` shows what it sees"


def _camera_place(camera: Camera | WideCamera) -> str:
    device = camera.device
    return "" if device is None else str(getattr(device, "path", None) or getattr(device, "name", ""))


def _files(config: Config) -> Iterator[Probed]:
    tracker = config.camera.star_tracker if config.camera is not None else None
    if tracker is not None and tracker.index is not None:
        there = Path(tracker.index).is_file()
        cure = "no such file: make it with `flight index --camera CONFIG --out FILE`"
        yield Probed("camera.star_tracker.index", tracker.index, there, "is there" if there else cure)
    if config.commands.socket is not None:
        there = Path(config.commands.socket).parent.is_dir()
        cure = "no such folder: systemd makes it for the service (RuntimeDirectory), else make it"
        yield Probed("commands.socket", config.commands.socket, there, "has its folder" if there else cure)
