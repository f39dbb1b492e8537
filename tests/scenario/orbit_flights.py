"""Configurations and worlds of short orbit runs, shared by several tests."""

from __future__ import annotations

import numpy as np

from flight.schema import reader as configuration
from flight.schema.bodies import OrbitConfig, as_orbit
from ground.telemetry import Run
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from sim_hal.settings import FaultEntry, Simulation
from sim_hal.worlds.free_body import FreeBody
from tests.support.flights import CONFIG

ORBIT = CONFIG.parent / "orbit.yaml"


TEXT = ORBIT.read_text(encoding="utf-8")


def orbit_config(duration: float, **modes: object) -> OrbitConfig:
    """Return the configuration without horizon cameras, which only `test_wide_cameras` simulates."""
    config = configuration.replace(as_orbit(configuration.load(ORBIT)), wide_cameras=())
    section = configuration.replace(config.modes, **modes)
    return configuration.replace(config, duration=duration, modes=section)


def world(speed: float, *faults: FaultEntry) -> Simulation:
    section = configuration.simulation_section(TEXT, str(ORBIT), Simulation)
    assert section is not None
    assert section.free_body is not None
    release = configuration.replace(section.free_body.release, speed=speed)
    return configuration.replace(
        section, free_body=configuration.replace(section.free_body, release=release), faults=faults
    )


def speed(run: Run) -> FloatArray:
    return np.asarray(np.linalg.norm(run["truth"]["rate"], axis=1))


NEAR_REST = 0.00524
"""Initial rate (rad/s), 0.3 deg/s, which is below the rate at which detumbling ends."""


DURATION, ACQUIRED = 62.0, 28.0
"""Duration (s) of the run, and latest time (s) by which a fine attitude must be available."""


GYRO_BIAS, FIELD_BIAS = (4e-4, -5e-4, 3e-4), (2e-7, -1e-7, 1.5e-7)
"""Gyro bias (rad/s) and field error (T), which the filter initially assumes to be zero."""


MUTE = FaultEntry(fault="gps: off", at=35.0, span=60.0)


def skyward() -> Simulation:
    """Return a world with body -y normal to the orbit. The star camera's boresight is 22 deg above -y."""
    section = world(NEAR_REST, MUTE)
    craft = section.free_body
    assert craft is not None
    around = FreeBody(craft, lambda: np.zeros(3), seed=section.seed, utc=section.utc).surroundings()
    across = np.cross(around.position, around.velocity)
    across, ahead = across / np.linalg.norm(across), np.array(around.velocity)
    ahead = ahead / np.linalg.norm(ahead)
    rows = np.stack([ahead, -across, np.cross(ahead, -across)])
    qx, qy, qz, qw = quaternion.from_matrix(rows).tolist()
    release = configuration.replace(craft.release, attitude=(qx, qy, qz, qw))
    unit = configuration.replace(section.imu, profile="datasheet", gyro_bias=GYRO_BIAS, field_bias=FIELD_BIAS)
    body = configuration.replace(craft, release=release)
    return configuration.replace(section, imu=unit, free_body=body)


def navigating() -> OrbitConfig:
    config = orbit_config(DURATION)
    assert config.gps is not None
    at_rest = configuration.replace(config.detumble, low_rate=0.0175, low_for=0.5)
    gps = configuration.replace(config.gps, max_age=10.0)
    return configuration.replace(config, gps=gps, detumble=at_rest)
