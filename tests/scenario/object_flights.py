"""Simulated flights with space objects in the camera's field of view, shared by several tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flight.schema import reader as configuration
from flight.schema.devices import ObjectTracking
from ground.telemetry import Run
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix
from sim_hal.settings import LineOfSight, SkyObject
from tests.support.flights import demo_config, demo_world, fly

_DURATION = 9.5


_HELD = np.array([0.0, 0.2, 0.0, np.sqrt(0.96)])


def flight_with_objects(folder: Path, objects: tuple[SkyObject, ...], duration: float = _DURATION) -> Run:
    """Return a run of a body at rest with objects in view and a frame of 0.2 s in each second."""
    config = demo_config(duration)
    world = demo_world()
    assert config.camera is not None
    assert world.release is not None
    camera = configuration.replace(config.camera, exposure=0.2, period=1.0, objects=ObjectTracking())
    step = configuration.replace(config.steps[0], q2=0.2)
    release = configuration.replace(world.release, q2=0.2, rate=0.0)
    section = configuration.replace(world, release=release, objects=objects)
    return fly(configuration.replace(config, camera=camera, steps=(step,)), folder, section=section)


def _line(across_deg: float, rate_deg: float, towards_deg: float) -> LineOfSight:
    """Return the line of sight to an object that begins off the boresight along camera x."""
    angle = np.radians(across_deg)
    seen = np.array([np.sin(angle), 0.0, np.cos(angle)]) @ attitude_matrix(_HELD)
    return LineOfSight(
        right_ascension_deg=float(np.degrees(np.arctan2(seen[1], seen[0]))),
        declination_deg=float(np.degrees(np.arcsin(seen[2]))),
        rate_deg=rate_deg,
        towards_deg=towards_deg,
    )


_LINES = (_line(-3.0, 0.3, 40.0), _line(3.0, 0.1, 250.0))


_BRIGHTNESS = (3.0, 4.5)


def two_objects() -> tuple[SkyObject, ...]:
    """Return two objects on opposite sides of the boresight."""
    pairs = zip(_BRIGHTNESS, _LINES, strict=True)
    return tuple(SkyObject(magnitude=m, line_of_sight=line) for m, line in pairs)


_PIXEL = np.radians(20.0) / 1024


def _place(line: LineOfSight, time: FloatArray) -> FloatArray:
    """Return the true directions (n, 3) of an object, by definition of right ascension and position angle."""
    ra, dec = np.radians([line.right_ascension_deg, line.declination_deg])
    start = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.cross(start, east)
    towards = np.radians(line.towards_deg)
    ahead = np.cos(towards) * north + np.sin(towards) * east
    angle = np.radians(line.rate_deg) * time[:, None]
    return np.asarray(np.cos(angle) * start + np.sin(angle) * ahead)
