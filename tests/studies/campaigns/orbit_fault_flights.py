"""Flights of campaign `orbit-faults`: the loop of config/orbit.yaml for 100 s in each of its modes.

Each flight begins in a state close to that of its mode, and not with a release at 10 deg/s. Cameras, receiver
and planner run more often than in a real flight, so that a fault of a few seconds affects them.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from sgp4.api import WGS72, Satrec
from sgp4.exporter import export_tle

from flight.schema import reader as configuration
from flight.schema.bodies import OrbitConfig, TargetStep
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orbit_knowledge import TwoLineElements
from sim_hal.settings import FaultEntry, Simulation
from sim_hal.worlds.free_body import FreeBody
from sim_hal.worlds.world import OrbitEnvironment
from tests.support.unlike_body import configured

MODES = ("detumble", "acquire", "sun", "point", "slew", "safe")
DURATION = 100.0
"""Duration (s) of each flight."""
SPEEDS = {"detumble": 0.15, "acquire": 0.004, "safe": 0.08}
"""Body rates (rad/s) at the release by mode, 0.001 in all other modes; SAFE begins with detumbling."""
SLEWED = math.radians(60.0)
FRAME_PERIOD = 2.5
WIDE_OFTEN = {"period": 2.0, "fine_period": 2.0, "max_age": 4.5}
OLD_DAYS, OLD_OFF = 7.0, 4.0
"""Age (days) of the old element set, and its along-track error (s): 30 km [assumed for a week]."""
_JULIAN = 2_440_587.5


def config_for(mode: str, elements: str = "", replans: bool = False, wide_often: bool = False) -> OrbitConfig:
    """Return the configuration of a run; `elements` is "old", "none", or empty for the elements of the orbit.

    If `wide_often`, each horizon camera takes an image every 2 s, even if none is needed.
    """
    config, _ = _described()
    assert config.camera is not None
    assert config.gps is not None
    camera = configuration.replace(
        config.camera, period=FRAME_PERIOD, fine_period=2.0 * FRAME_PERIOD, max_age=12.0
    )
    modes: dict[str, Any] = {"initial": "safe" if mode == "safe" else "detumble"}
    if mode in {"acquire", "sun"}:
        modes["acquired"] = mode
    slow = {} if mode in {"detumble", "safe"} else {"low_rate": 0.0175, "low_for": 0.5}
    pointing = {"replan_period": 10.0} if replans else {}
    wide = tuple(configuration.replace(one, **WIDE_OFTEN) for one in config.wide_cameras)
    lines = {"old": old_elements(), "none": None}.get(elements, config.elements)
    return configuration.replace(
        config,
        duration=DURATION,
        camera=camera,
        wide_cameras=wide if wide_often else config.wide_cameras,
        gps=configuration.replace(config.gps, max_age=6.0),
        modes=configuration.replace(config.modes, **modes),
        detumble=configuration.replace(config.detumble, **slow),
        pointing=configuration.replace(config.pointing, **pointing),
        executive=configuration.replace(config.executive, planner_timeout=8.0, vision_timeout=5.0),
        elements=lines,
        targets=_targets(mode),
    )


def world_for(mode: str, seed: int, faults: tuple[FaultEntry, ...]) -> Simulation:
    """Return the world of a flight, with the attitude at release that the mode requires."""
    _, section = _described()
    assert section.free_body is not None
    speed = SPEEDS.get(mode, 0.001)
    release = configuration.replace(section.free_body.release, speed=speed, attitude=release_attitude())
    body = configuration.replace(section.free_body, release=release)
    return configuration.replace(section, seed=seed, free_body=body, faults=faults)


def _targets(mode: str) -> tuple[TargetStep, ...]:
    """Return one inertial target: the attitude at release, or an attitude that requires a slew."""
    x, y, z, w = release_attitude()
    if mode == "slew":
        turn = quaternion.from_rotation_vector(np.array([0.0, SLEWED, 0.0]))
        x, y, z, w = quaternion.multiply(turn, np.array([x, y, z, w])).tolist()
    return (TargetStep(at=0.0, point="inertial", quaternion=(x, y, z, w)),)


@cache
def release_attitude() -> tuple[float, float, float, float]:
    """Return the attitude with +z to the Sun and the star camera (-y) as far from the Earth as possible."""
    around = _at_release()
    sun, up = np.array(around.sun), np.array(around.position)
    camera = up - sun * float(sun @ up)
    camera = camera / np.linalg.norm(camera)
    x, y, z, w = quaternion.from_matrix(np.stack([np.cross(-camera, sun), -camera, sun])).tolist()
    return x, y, z, w


@cache
def old_elements() -> tuple[str, str]:
    """Return the configured elements as a week-old set with an along-track error of `OLD_OFF` s."""
    config, _ = _described()
    assert config.elements is not None
    known = Satrec.twoline2rv(*config.elements)
    wanted = TwoLineElements(*config.elements).at(_begin() + OLD_OFF / 86_400.0)
    node = known.nodeo - known.nodedot * OLD_DAYS * 1440.0
    perigee = known.argpo - known.argpdot * OLD_DAYS * 1440.0
    anomaly = known.mo - known.mdot * OLD_DAYS * 1440.0
    epoch = known.jdsatepoch + known.jdsatepochF - 2_433_281.5 - OLD_DAYS

    def lines(shift: float) -> tuple[str, str]:
        made = Satrec()
        angles = (part % (2.0 * math.pi) for part in (perigee, anomaly + shift, node))
        argument, mean, ascending = angles
        made.sgp4init(
            WGS72, "i", 99999, epoch, known.bstar, known.ndot, known.nddot, known.ecco,
            argument, known.inclo, mean, known.no_kozai, ascending,
        )  # fmt: skip
        first, second = export_tle(made)
        return first, second

    shift = 0.0
    for _ in range(3):  # iterate for the mean anomaly that leads to this position with the secular rates
        found = TwoLineElements(*lines(shift)).at(_begin())
        ahead = np.cross(found.position, found.velocity)
        ahead = np.cross(ahead / np.linalg.norm(ahead), found.position)
        behind = wanted.position - found.position
        shift += float(behind @ ahead) / float(ahead @ ahead)
    return lines(shift)


@cache
def _described() -> tuple[OrbitConfig, Simulation]:
    return configured("orbit")


def _body() -> FreeBody:
    _, section = _described()
    assert section.free_body is not None

    def no_currents() -> FloatArray:
        return np.zeros(3)

    return FreeBody(section.free_body, no_currents, seed=section.seed, utc=section.utc)


def _at_release() -> OrbitEnvironment:
    return _body().surroundings()


def _begin() -> float:
    """Return the Julian date UTC of the release."""
    return _JULIAN + _body().utc_ns() * 1e-9 / 86_400.0
