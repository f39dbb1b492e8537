"""Campaign `eclipse`: what the loop's filter knows of the attitude through an eclipse without stars.

The loop of `config/orbit.yaml` and `config/orbit_3u.yaml`, released at nadir along the flight `LIT` s before
the Earth's shadow begins. The star camera teaches the filter the gyro's bias, until it falls silent `BLIND` s
before the shadow: the wide cameras hold the attitude until then, gyro and magnetometer alone through the
shadow. Node and errors are drawn; a shadow lasts about 35 min.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from flight.gnc.earth.ephemeris import predict
from flight.gnc.earth.orbit_knowledge import OrbitState
from flight.gnc.math import quaternion
from flight.gnc.math.arrays import FloatArray
from flight.schema import reader as configuration
from flight.schema.orbit import OrbitConfig, TargetStep, as_orbit
from ground.report.knowledge import attitude_errors
from ground.report.signals import seconds
from ground.telemetry.reader import Run
from sim_hal.settings import FaultEntry, Simulation
from sim_hal.worlds.free_body.body import FreeBody
from sim_hal.worlds.free_body.section import FreeBodySection, TipOff
from tests.scenario.flights import CONFIG, fly
from tests.studies.campaigns.campaign import Campaign, Case, Result, Summary

CRAFT = {"knightcube": "orbit.yaml", "cubesat_3u": "orbit_3u.yaml"}
LIT, BLIND, SHADOW = 900.0, 300.0, 2400.0
"""s: from the release to the shadow, from the last star to it, and the longest shadow."""
SETTLED, LAST = 300.0, 120.0
"""s: from the release until stars are judged; the ends of the sunlight and of the shadow that are judged."""
REVOLUTION = 5_700.0
NODES = (9.5, 14.5)
"""h, mean local times of the ascending node between which each flight has its own."""
WANTED = {"stars": 0.01, "sunlit": 0.05, "eclipse": 0.3}
"""deg rms of three axes (issue 19)."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights of each craft."""
    return [Case(f"{craft}/{run}", (seed, run), {"craft": craft}) for craft in CRAFT for run in range(runs)]


def run(case: Case) -> Result:
    """Fly the case; `lit`, `blind`, `settled` and `seconds` of its parameters shorten the flight."""
    given = case.parameters
    lit, blind = given.get("lit", LIT), given.get("blind", BLIND)
    path = CONFIG.parent / CRAFT[given["craft"]]
    world, shadow = _world(path, case, lit, lit - blind)
    seconds_flown = given.get("seconds", shadow)
    with TemporaryDirectory(prefix="eclipse-") as folder:
        flown = fly(_config(path, seconds_flown), Path(folder), section=world)
    return {"craft": given["craft"], **_facts(flown, lit - blind, lit, given.get("settled", SETTLED))}


def _config(path: Path, duration: float) -> OrbitConfig:
    """Return the configuration that points to nadir; braking ends at once, elements are of one orbit."""
    config = as_orbit(configuration.load(path))
    rest = configuration.replace(config.detumble, low_rate=config.modes.tumble_rate, low_for=0.1)
    target = TargetStep(at=0.0, point="nadir", roll_deg=0.0)
    return configuration.replace(config, detumble=rest, elements=None, duration=duration, targets=(target,))


def _world(path: Path, case: Case, lit: float, silent: float) -> tuple[Simulation, float]:
    """Return the world whose shadow begins after `lit` s, and the time, s, at which it ends."""
    section = configuration.simulation_section(path.read_text(encoding="utf-8"), str(path), Simulation)
    assert section is not None
    assert section.free_body is not None
    node = float(np.random.default_rng(case.seed).uniform(*NODES))
    first = configuration.replace(section.free_body.orbit, local_time=node, true_anomaly_deg=0.0)
    body = configuration.replace(section.free_body, orbit=first)
    ahead = predict(_state(body, section.utc), 1.5 * REVOLUTION)
    times = np.arange(lit, 1.5 * REVOLUTION)
    dark = ahead.sunlit_at(times) < 0.5
    begin = int(np.flatnonzero(dark[1:] & ~dark[:-1])[0]) + 1
    end = begin + int(np.argmin(dark[begin:]))
    orbit = configuration.replace(first, true_anomaly_deg=360.0 * begin / REVOLUTION)
    body = configuration.replace(body, orbit=orbit)
    body = configuration.replace(body, release=_at_nadir(_state(body, section.utc)))
    world = configuration.replace(
        section,
        seed=case.seed[0] * 100_003 + case.seed[1],
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


def _facts(flown: Run, silent: float, lit: float, settled: float) -> Result:
    """Return rms errors, deg, NEES of an axis and largest errors, sigmas, by the parts of the flight."""
    errors, packets, truth = attitude_errors(flown), flown["navigation"], flown["orbit_truth"]
    end = float(seconds(truth)[-1])
    parts = {"stars": (settled, silent), "sunlit": (lit - LAST, lit), "eclipse": (end - LAST, end)}
    found: Result = {"shadow_s": end - lit, "restarts": int(packets["restarts"][-1])}
    for name, (begin, until) in parts.items():
        inside = (errors.times > begin) & (errors.times <= until)
        error, sigma = errors.error[inside], errors.sigma[inside]
        if not len(error):
            found[name] = None
            continue
        found[name] = {
            "rms_deg": float(np.degrees(np.sqrt(np.mean(np.sum(error**2, axis=1))))),
            "claim_deg": float(np.degrees(np.sqrt(np.mean(np.sum(sigma**2, axis=1))))),
            "nees": float(np.mean((error / sigma) ** 2)),
            "sigmas": float((np.abs(error) / sigma).max()),
        }
    return found


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return errors and claims by craft and part of the flight."""
    facts: dict[str, Any] = {}
    heads = ("flights", "lost", "deg rms", "median", "worst", "claim", "sigmas", "NEES", "wanted")
    lines = [f"{'':22}" + "".join(f"{head:>10}" for head in heads)]
    for craft in CRAFT:
        mine = [r for r in results if r["craft"] == craft]
        for part, wanted in WANTED.items():
            judged = [r[part] for r in mine if r[part] is not None]
            if not mine:
                continue
            row = {"flights": float(len(mine)), "lost": float(len(mine) - len(judged)), **_row(judged)}
            facts[f"{craft}/{part}"] = row
            cells = "".join(f"{value:>10.3g}" for value in row.values())
            lines.append(f"{craft + ', ' + part:22}{cells}{wanted:>10}")
    lines.append(
        "with stars; the last two minutes of sunlight, and of the shadow, without: deg rms of three axes"
    )
    lines.append(
        "of all flights, of the median and of the worst one, the claim, the largest error in sigmas of"
    )
    lines.append("its axis, NEES of an axis (1 is honest); lost: without an attitude in that part")
    return Summary("\n".join(lines) + "\n", facts)


def _row(judged: Sequence[Result]) -> dict[str, float]:
    if not judged:
        return dict.fromkeys(("rms", "median", "worst", "claim", "sigmas", "nees"), math.nan)
    rms = np.array([r["rms_deg"] for r in judged])
    return {
        "rms": float(np.sqrt(np.mean(rms**2))),
        "median": float(np.median(rms)),
        "worst": float(rms.max()),
        "claim": float(np.sqrt(np.mean([r["claim_deg"] ** 2 for r in judged]))),
        "sigmas": max(r["sigmas"] for r in judged),
        "nees": float(np.mean([r["nees"] for r in judged])),
    }


ECLIPSE = Campaign(
    "eclipse",
    "the attitude through an eclipse without stars, by gyro and magnetometer, in the loop",
    cases,
    run,
    summarise,
    20,
)
