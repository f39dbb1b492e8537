"""A configuration with every type of device of a satellite, in the world of a free body."""

from __future__ import annotations

import numpy as np

from flight.schema import reader
from flight.schema.bodies import TestbedConfig
from flight.schema.devices import Gps, SolarString, SolarStringsSection, WideCamera
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from sim_hal.settings import FreeBodySection, OrbitSection, Simulation, TipOff
from sim_hal.worlds.free_body import FreeBody
from sim_hal.worlds.world import OrbitEnvironment
from tests.support.flights import demo_config, demo_world

UTC = "2026-03-20T12:00:00Z"
FACES = (
    (1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, 0.0, 1.0),
    (-1.0, 0.0, 0.0),
    (0.0, -1.0, 0.0),
    (0.0, 0.0, -1.0),
)
DOWN = float(np.sqrt(0.5))


def orbit_config(camera: bool = False) -> TestbedConfig:
    """Return the demonstration with a GPS receiver, six solar cell strings and two horizon cameras."""
    strings = tuple(
        SolarString(normal=face, address=0x48 + index // 4, channel=index % 4)
        for index, face in enumerate(FACES)
    )
    wide = (
        WideCamera(),
        WideCamera(columns=128, rows=128, mounting=(DOWN, 0.0, 0.0, DOWN)),
    )
    config = demo_config(10.0, camera=camera)
    return reader.replace(
        config, gps=Gps(), solar_strings=SolarStringsSection(strings=strings), wide_cameras=wide
    )


def orbit_world(boresight: FloatArray | None = None) -> Simulation:
    """Return an orbit whose ascending node is below the Sun. Body +z points along `boresight`, ICRS."""
    attitude = None
    if boresight is not None:
        boresight = boresight / np.linalg.norm(boresight)
        across = np.cross(boresight, [0.3, 0.5, 0.8])
        across = across / np.linalg.norm(across)
        x, y, z, w = quaternion.from_matrix(
            np.stack([across, np.cross(boresight, across), boresight])
        ).tolist()
        attitude = (x, y, z, w)
    release = TipOff(speed=0.02, attitude=attitude)
    body = FreeBodySection(orbit=OrbitSection(local_time=12.0), release=release)
    return reader.replace(demo_world(), world="free_body", free_body=body, release=None, utc=UTC, seed=3)


def at_first() -> OrbitEnvironment:
    """Return the environment of the craft at the start."""
    section = orbit_world().free_body
    assert section is not None
    return FreeBody(section, lambda: np.zeros(3), seed=3, utc=UTC).surroundings()
