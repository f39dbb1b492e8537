"""A camera driver outside the product, which a configuration names: flat frames of one exposure each."""

from __future__ import annotations

from typing import Any

import numpy as np

from flight.schema.devices import Camera, Driver
from flight.schema.values import Section
from hal.drivers.camera import CameraCounts
from hal.interfaces.devices import Frame
from hal.interfaces.wires import Clock, Rig


class FlatSection(Section, frozen=True, kw_only=True):
    """The key of the camera: the count of every pixel."""

    level: int = 10


class FlatCamera:
    """A camera that answers each trigger after the exposure."""

    name = "flat camera"

    def __init__(self, clock: Clock, shape: tuple[int, int], level: int) -> None:
        self.counts = CameraCounts()
        self._clock, self._shape, self._level = clock, shape, level
        self._started: tuple[int, int] | None = None
        self._number = 0

    def open(self) -> None:
        """Open nothing, because the camera is part of the program."""

    def check(self, exposure_ns: int) -> None:
        """Accept any exposure."""

    def expose(self, exposure_ns: int, trigger_ns: int) -> None:
        self._started = exposure_ns, trigger_ns

    def collect(self) -> Frame | None:
        now_ns = self._clock.now_ns()
        if self._started is None or now_ns < sum(self._started):
            return None
        (exposure_ns, start_ns), self._started = self._started, None
        self._number += 1
        return Frame(self._number, start_ns, exposure_ns, now_ns, np.full(self._shape, self._level, np.uint8))

    def close(self) -> None:
        """Nothing is open."""


def open_flat(rig: Rig, camera: Camera) -> FlatCamera:
    device: Any = camera.device
    return FlatCamera(rig.clock, (camera.rows, camera.columns), device.level)


FLAT = Driver("camera", FlatSection, open_flat, lambda rig, camera: "opens")
