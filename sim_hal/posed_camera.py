"""A simulated star camera by itself: held as a configuration releases the body, or turning at a steady rate.

Its frames have a truth: the attitude at any time, and the rate.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flight.schema.sections import Config
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from sim_hal.assembly import StarRenderer, inline_exposure
from sim_hal.clock import SimClock
from sim_hal.emulators.star_camera import EmulatedStarCamera
from sim_hal.objects import Objects
from sim_hal.settings import Simulation
from sim_hal.worlds.motion import Motion
from sim_hal.worlds.simulation import TimedSimulation
from sim_hal.worlds.world import WorldInputs, make_world


def posed_camera(
    config: Config, section: Simulation, clock: SimClock, rate: FloatArray
) -> tuple[EmulatedStarCamera, Callable[[int], FloatArray]]:
    """Return the camera of a configuration on a clock, and its attitude (4,), ICRS into camera, at a time.

    It turns at `rate` (3,) rad/s, camera axes, from the attitude at which the body is released. Raises
    ConfigError for a world that cannot be.
    """
    camera = config.camera
    assert camera is not None, "the caller has seen to a camera section"
    begun_ns, mounting = clock.now_ns(), np.array(camera.mounting)
    world = make_world(WorldInputs(config, section, lambda: np.zeros(3), begun_ns))
    objects = Objects(section.objects, section.utc, begun_ns, world)
    held, body_rate = world.motion(begun_ns), attitude_matrix(mounting).T @ rate
    nothing = np.zeros(3)

    def motion(time_ns: int) -> Motion:
        turned = from_rotation_vector(body_rate * ((time_ns - begun_ns) * 1e-9))
        return Motion(time_ns, multiply(turned, held.quaternion), body_rate, nothing, nothing)

    device = EmulatedStarCamera(
        motion,
        inline_exposure(StarRenderer(camera, section.sky, section.seed)),
        clock.now_ns,
        round(section.sky.readout * 1e9),
        mounting,
        round(section.sky.line_time * camera.rows * 1e9),
        objects.tracks,
    )
    clock.attach(TimedSimulation(lambda _: None, [device]))
    return device, lambda time_ns: multiply(mounting, motion(time_ns).quaternion)
