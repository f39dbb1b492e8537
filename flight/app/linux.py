"""Linux's hardware: the configured serial port, I2C bus and camera."""

from __future__ import annotations

import os
from contextlib import ExitStack, nullcontext, suppress

from flight.loop.state.opening import state_folder
from flight.schema.devices import AravisDevice, Camera, V4l2Device
from flight.schema.errors import ConfigError
from flight.schema.orbit_devices import WideCamera
from flight.schema.sections import Config
from hal.buses.clock import SystemClock
from hal.buses.i2c_bus import LinuxI2cBus
from hal.buses.serial_port import PySerialPort
from hal.drivers.aravis_camera import AravisCamera, AravisSettings
from hal.drivers.camera import CameraDevice, ServedCamera
from hal.drivers.pca9685 import switch_off
from hal.drivers.v4l2_camera import V4l2Camera
from hal.drivers.v4l2_settings import Stamp, V4l2Settings
from hal.guardian.client import CoilReach
from hal.interfaces.devices import FrameSource
from hal.interfaces.errors import DeviceError
from hal.interfaces.rig import Rig
from hal.interfaces.wires import SECOND_NS, Clock, Wires


def linux_rig(config: Config, stack: ExitStack, patient: bool) -> Rig:
    """Open the wires, and switch the coils off before anything else can fail.

    Raises ConfigError; DeviceError for missing hardware, but `patient` wires are opened once they appear.
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

    Raises ConfigError when none is named; DeviceError, but a `patient` camera is opened once it appears.
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
            "real devices are flown: say which camera, `{kind: v4l2, path: ...}` or `{kind: aravis, name: "
            "...}`, or say `camera: none`",
        )
    source = ServedCamera(opened, clock, patient=patient)
    stack.callback(source.close)
    return source
