"""The emulated devices of an orbit that are fitted; `sim_hal.orbit_assembly` builds them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING

from flight.schema.sections import Config
from knightcube.astro.arrays import Image
from sim_hal.emulators.camera import EmulatedCamera

if TYPE_CHECKING:  # they take half a second to import, and the testbed has none
    from sim_hal.earth_camera import EarthCameraModel, EarthScene
    from sim_hal.emulators.gps import EmulatedGps
    from sim_hal.emulators.solar_cells import EmulatedSolarCells

GPS_LINE = 1
"""The number of the receiver's line; the inertial unit's has none."""

ExposeWide = Callable[["EarthCameraModel", "EarthScene", tuple[int, ...]], "Future[Image]"]
"""Renders a scene with the noise of a seed."""


@dataclass(frozen=True, slots=True)
class OrbitDevices:
    """The devices that are fitted."""

    gps: EmulatedGps | None = None
    cells: EmulatedSolarCells | None = None
    wide: tuple[EmulatedCamera, ...] = ()


def wanted(config: Config) -> bool:
    """Return whether a configuration has any of them."""
    return bool(config.gps or config.solar_strings or config.wide_cameras)
