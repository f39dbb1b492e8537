"""The camera of a configuration and nothing else of it: coils and unit stay untouched."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flight.app.accepted_config import requested_config
from flight.app.devices import linux_camera, simulated_camera
from flight.app.run import RunRequest
from flight.schema.devices import Camera
from flight.schema.document import ConfigError
from hal.buses.clock import SystemClock
from hal.interfaces.devices import FrameSource
from hal.interfaces.wires import Clock
from knightcube.astro.arrays import FloatArray
from knightcube.errors import UsageError


@dataclass(frozen=True, slots=True)
class LoneCamera:
    """An open camera, its clock, its section; of a simulated one the attitude (4,) at a time of the clock."""

    clock: Clock
    frames: FrameSource
    section: Camera
    attitude: Callable[[int], FloatArray] | None = None


@contextmanager
def opened_camera(config_path: Path, rate: FloatArray | None = None) -> Iterator[LoneCamera]:
    """Open nothing but the camera of a configuration, simulated where it has a simulation section.

    A simulated one turns at `rate` (3,) rad/s in camera axes, if given. Raises ConfigError when there is no
    camera in the configuration, UsageError for a real camera that should turn, DeviceError.
    """
    text, config = requested_config(RunRequest(config_path, Path()))
    if config.camera is None:
        raise ConfigError(str(config_path), "`camera` is none: give a configuration with a camera")
    if config.simulation is not None:
        turning = np.zeros(3) if rate is None else rate
        posed = simulated_camera(config_path, text, config, turning)
        yield LoneCamera(posed.clock, posed.frames, config.camera, posed.attitude)
        return
    if rate is not None:
        raise UsageError("--rate: this configuration has a real camera, which turns as somebody turns it")
    with ExitStack() as stack:
        clock = SystemClock()
        yield LoneCamera(clock, linux_camera(config.camera, clock, stack), config.camera)
