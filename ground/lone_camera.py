"""The camera of a configuration and nothing else of it: coils and unit stay untouched."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from flight.app.linux import linux_camera
from flight.app.request import RunRequest
from flight.app.requested_config import requested_config
from flight.app.simulated import simulated_camera
from flight.schema.devices import Camera
from flight.schema.errors import ConfigError
from hal.buses.clock import SystemClock
from hal.interfaces.devices import FrameSource
from hal.interfaces.wires import Clock


@contextmanager
def opened_camera(config_path: Path) -> Iterator[tuple[Clock, FrameSource, Camera]]:
    """Open nothing but the camera of a configuration, simulated where it has a simulation section.

    Raises ConfigError when there is no camera in it, DeviceError.
    """
    text, config = requested_config(RunRequest(config_path, Path()))
    if config.camera is None:
        raise ConfigError(str(config_path), "`camera` is none: give a configuration with a camera")
    with ExitStack() as stack:
        if config.simulation is None:
            clock: Clock = SystemClock()
            yield clock, linux_camera(config.camera, clock, stack), config.camera
        else:
            yield *simulated_camera(config_path, text, config), config.camera
