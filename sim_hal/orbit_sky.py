"""The star camera's view from an orbit: aberration, the Earth in the way, the Sun in the baffle.

Aberration turns the whole frame by its value at the boresight (26" at most); across 20 deg the rest is 4" of
scale. Sunlight beside the field, on ground in the field or through the baffle saturates the frame; the dark
Earth hides the stars behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from typing import TYPE_CHECKING

import numpy as np

from flight.schema.devices import Camera
from knightcube.astro import quaternion
from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.sun import SPEED_OF_LIGHT, earth_velocity
from knightcube.vision.camera.lens import Pinhole
from sim_hal.emulators.camera import Expose
from sim_hal.worlds.world import OrbitEnvironment, OrbitingWorld

if TYPE_CHECKING:
    from sim_hal.star_camera import SourceTrack

BAFFLE = np.radians(25.0)
"""rad beyond the field's corner within which the Sun blinds the camera."""
_UNIX_EPOCH = 2_440_587.5


def from_orbit(expose: Expose, world: OrbitingWorld, camera: Camera) -> Expose:
    """Return the exposure of a camera in orbit; `expose` renders the stars of a free sky."""
    pinhole = Pinhole.from_field_of_view(camera.columns, camera.rows, np.radians(camera.field_of_view_deg))
    top = (1 << camera.bits) - 1

    def exposed(
        sequence: int, times: FloatArray, attitudes: FloatArray, tracks: Sequence[SourceTrack]
    ) -> Future[Image]:
        around = world.surroundings()
        date = _UNIX_EPOCH + world.utc_ns() * 1e-9 / 86_400.0
        turned = aberrated(attitudes, earth_velocity(date) + around.velocity)
        rendered = expose(sequence, times, turned, tracks)
        to_camera = quaternion.attitude_matrix(attitudes[len(attitudes) // 2])
        blinded, hidden = view(pinhole, to_camera, around)
        if not blinded and hidden is None:
            return rendered
        seen: Future[Image] = Future()

        def finish(done: Future[Image]) -> None:
            if not seen.set_running_or_notify_cancel():
                return
            frame = done.result().copy()
            if blinded:
                frame[:] = min(top, np.iinfo(frame.dtype).max)
            elif hidden is not None:
                frame[hidden] = np.median(frame)
            seen.set_result(frame)

        rendered.add_done_callback(lambda done: None if done.cancelled() else finish(done))
        return seen

    return exposed


def aberrated(attitudes: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return attitudes (k, 4) in which the stars about the boresight are shifted to `velocity` (3,) m/s."""
    boresights = quaternion.attitude_matrix(attitudes)[:, 2, :]
    # Aberration moves stars towards the velocity: the equivalent rotation of the camera is the opposite one.
    turn = np.cross(boresights, velocity / SPEED_OF_LIGHT)
    in_camera = np.einsum("kij,kj->ki", quaternion.attitude_matrix(attitudes), turn)
    return quaternion.multiply(quaternion.from_rotation_vector(-in_camera), attitudes)


def view(pinhole: Pinhole, to_camera: FloatArray, around: OrbitEnvironment) -> tuple[bool, BoolArray | None]:
    """Return whether sunlight blinds the camera, and the pixels (rows, columns) behind the dark Earth."""
    corner = float(np.arccos(pinhole.unit_vectors(np.zeros((1, 2)))[0, 2]))
    sun = to_camera @ around.sun
    if around.sunlit > 0.0 and np.arccos(np.clip(sun[2], -1.0, 1.0)) < corner + BAFFLE:
        return True, None
    distance = float(np.linalg.norm(around.position))
    down = to_camera @ around.position / -distance
    disc = float(np.arcsin(EARTH_RADIUS / distance))
    if np.arccos(np.clip(down[2], -1.0, 1.0)) > corner + disc:
        return False, None
    rows, columns = np.mgrid[0 : pinhole.rows, 0 : pinhole.columns]
    rays = pinhole.unit_vectors(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float))
    hidden = rays @ down > np.cos(disc)
    if not hidden.any():
        return False, None
    return _lit(rays[hidden], down, sun, distance), hidden.reshape(pinhole.rows, pinhole.columns)


def _lit(rays: FloatArray, down: FloatArray, sun: FloatArray, distance: float) -> bool:
    """Return whether the Sun shines on any ground that `rays` (m, 3), camera axes, meet."""
    rays = rays[:: max(1, len(rays) // 1000)]
    along = distance * (rays @ down)
    reach = along - np.sqrt(np.maximum(0.0, along**2 - distance**2 + EARTH_RADIUS**2))
    ground = reach[:, None] * rays - distance * down
    # The upper air is lit to six degrees beyond the terminator.
    return bool(np.any(ground @ sun / EARTH_RADIUS > -0.1))
