"""The flights of campaign `eclipse` in the whole loop, of `config/orbit.yaml` and `config/orbit_3u.yaml`.

Released at nadir along the flight `LIT` s before the Earth's shadow begins. The star camera teaches the
filter the gyro's bias, until it falls silent `BLIND` s before the shadow: the wide cameras hold the attitude
until then, gyro and magnetometer alone through the shadow. Node and errors are drawn.
"""

from __future__ import annotations

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from flight.schema import reader as configuration
from flight.schema.orbit import OrbitConfig, TargetStep, as_orbit
from ground.report.orbit import attitude_errors, dipole_errors
from ground.report.signals import seconds
from ground.telemetry import Run
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.ephemeris import predict
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER, SEMI_MAJOR_AXIS
from knightcube.astro.earth.orbit_knowledge import OrbitState
from sim_hal.settings import FaultEntry, FreeBodySection, Simulation, TipOff
from sim_hal.worlds.free_body import FreeBody
from tests.studies.campaigns.campaign import Result
from tests.support.flights import CONFIG, fly

CRAFT = {"knightcube": "orbit.yaml", "cubesat_3u": "orbit_3u.yaml"}
LIT, BLIND = 900.0, 300.0
"""s: from the release to the shadow, and from the last star to it."""
SETTLED, LAST = 300.0, 120.0
"""s: from the release until stars are judged; the ends of the sunlight and of the shadow that are judged."""
NODES = (9.5, 14.5)
"""h, mean local times of the ascending node between which each flight has its own."""


def fly_loop(given: dict[str, Any], seed: tuple[int, ...]) -> Result:
    """Fly the loop; `lit`, `blind`, `settled`, `last` and `seconds` of what is given shorten the flight."""
    lit, blind = given.get("lit", LIT), given.get("blind", BLIND)
    spans = given.get("settled", SETTLED), lit - blind, lit, given.get("last", LAST)
    path = CONFIG.parent / CRAFT[given["craft"]]
    world, shadow = _world(path, seed, lit, lit - blind)
    with TemporaryDirectory(prefix="eclipse-") as folder:
        flown = fly(_config(path, given.get("seconds", shadow)), Path(folder), section=world)
    return _facts(flown, *spans)


def _config(path: Path, duration: float) -> OrbitConfig:
    """Return the configuration that points to nadir; braking ends at once, elements are of one orbit."""
    config = as_orbit(configuration.load(path))
    rest = configuration.replace(config.detumble, low_rate=config.modes.tumble_rate, low_for=0.1)
    target = TargetStep(at=0.0, point="nadir", roll_deg=0.0)
    return configuration.replace(config, detumble=rest, elements=None, duration=duration, targets=(target,))


def _world(path: Path, seed: tuple[int, ...], lit: float, silent: float) -> tuple[Simulation, float]:
    """Return the world whose shadow begins after `lit` s, and the time, s, at which it ends."""
    section = configuration.simulation_section(path.read_text(encoding="utf-8"), str(path), Simulation)
    assert section is not None
    assert section.free_body is not None
    node = float(np.random.default_rng(seed).uniform(*NODES))
    first = configuration.replace(section.free_body.orbit, local_time=node, true_anomaly_deg=0.0)
    body = configuration.replace(section.free_body, orbit=first)
    start = _state(body, section.utc)
    revolution = 2.0 * math.pi * math.sqrt((SEMI_MAJOR_AXIS + first.altitude) ** 3 / GRAVITATIONAL_PARAMETER)
    ahead = predict(start, lit + 1.5 * revolution)
    times = np.arange(lit, lit + 1.5 * revolution)
    dark = ahead.sunlit_at(times) < 0.5
    begin = int(np.flatnonzero(dark[1:] & ~dark[:-1])[0]) + 1
    end = begin + int(np.argmin(dark[begin:]))  # of the times, the first of which is `lit`
    orbit = configuration.replace(first, true_anomaly_deg=360.0 * begin / revolution)
    body = configuration.replace(body, orbit=orbit)
    body = configuration.replace(body, release=_at_nadir(_state(body, section.utc)))
    world = configuration.replace(
        section,
        seed=seed[0] * 100_003 + seed[1],
        free_body=body,
        orbit_devices=configuration.replace(section.orbit_devices, gps_start=1.0),
        faults=(FaultEntry(fault="camera: off", at=silent),),
    )
    return world, lit + float(end - begin)


def _state(body: FreeBodySection, utc: str) -> OrbitState:
    def no_currents() -> FloatArray:
        return np.zeros(3)

    truth = FreeBody(body, no_currents, utc=utc).orbit_truth()
    return OrbitState(truth.utc, truth.position, truth.velocity, 0.0)


def _at_nadir(state: OrbitState) -> TipOff:
    """Return the release with body +z to nadir, +x along the flight, turning with the orbit."""
    down, normal = -state.position, np.cross(state.position, state.velocity)
    z, y = down / np.linalg.norm(down), -normal / np.linalg.norm(normal)
    a, b, c, d = quaternion.from_matrix(np.stack([np.cross(y, z), y, z])).tolist()
    speed = float(np.linalg.norm(normal) / (down @ down))
    return TipOff(rate=(0.0, -speed, 0.0), attitude=(a, b, c, d))


def _facts(flown: Run, settled: float, silent: float, lit: float, last: float) -> Result:
    """Return rms errors, deg, NEES of an axis and largest errors, sigmas, by the parts of the flight."""
    errors, packets, truth = attitude_errors(flown), flown["navigation"], flown["orbit_truth"]
    end = float(seconds(truth)[-1])
    parts = {"stars": (settled, silent), "sunlit": (lit - last, lit), "eclipse": (end - last, end)}
    dark = truth["sunlit"][seconds(truth) > lit] < 0.5
    found: Result = {
        "shadow_s": end - lit,
        "dark_share": float(np.mean(dark)),
        "restarts": int(packets["restarts"][-1]),
        "dipole": dipole_errors(flown),
    }
    for name, (begin, until) in parts.items():
        inside = (errors.times > begin) & (errors.times <= until)
        found[name] = judged(errors.error[inside], errors.sigma[inside])
    return found


def judged(error: FloatArray, sigma: FloatArray) -> Result | None:
    """Return what errors (n, 3) rad and their deviations (n, 3) come to; None without any."""
    if not len(error):
        return None
    return {
        "rms_deg": float(np.degrees(np.sqrt(np.mean(np.sum(error**2, axis=1))))),
        "claim_deg": float(np.degrees(np.sqrt(np.mean(np.sum(sigma**2, axis=1))))),
        "nees": float(np.mean((error / sigma) ** 2)),
        "sigmas": float((np.abs(error) / sigma).max()),
    }
