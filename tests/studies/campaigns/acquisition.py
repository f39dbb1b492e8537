"""Campaign `acquisition`: time from a slow rotation, lost in space, to a fine attitude in the loop.

Each run has its own attitude, rotation axis and position in the orbit; the receiver has a fix after a second.
The star camera is blind while the Sun is near its field of view, or sunlit ground is in it. Runs in sunlight
and in shadow are counted separately. Errors and claimed uncertainties are those of the star camera's
attitude. The attitude of the body also has the error of the camera's mounting.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from flight.schema import reader as configuration
from flight.schema.orbit import OrbitConfig, as_orbit
from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from ground.report.orbit import COARSE, FINE, camera_errors
from ground.report.signals import seconds
from ground.telemetry import Run
from sim_hal.settings import Simulation
from tests.support.flights import CONFIG, fly

ORBIT = CONFIG.parent / "orbit.yaml"
SPEED, DURATION = math.radians(0.5), 120.0
WANTED, SETTLED = 60.0, 10.0
"""Limits (s): time to a fine attitude, and time after which the error of a fine attitude counts."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights."""
    return [Case(f"acquisition/{run}", (seed, run), {}) for run in range(runs)]


def run(case: Case) -> Result:
    """Fly the case."""
    duration = case.parameters.get("duration", DURATION)
    with TemporaryDirectory(prefix="acquisition-") as folder:
        flown = fly(_config(duration), Path(folder), section=_world(case))
    return {**case.parameters, **_facts(flown)}


def _config(duration: float) -> OrbitConfig:
    """Return the configuration without detumbling, and without orbital elements, which fit only one orbit."""
    config = as_orbit(configuration.load(ORBIT))
    rest = configuration.replace(config.detumble, low_rate=2.0 * SPEED, low_for=0.1)
    return configuration.replace(config, detumble=rest, elements=None, duration=duration)


def _world(case: Case) -> Simulation:
    section = configuration.simulation_section(ORBIT.read_text(encoding="utf-8"), str(ORBIT), Simulation)
    assert section is not None
    assert section.free_body is not None
    place = float(np.random.default_rng(case.seed).uniform(0.0, 360.0))
    body = section.free_body
    body = configuration.replace(
        body,
        orbit=configuration.replace(body.orbit, true_anomaly_deg=place),
        release=configuration.replace(body.release, speed=SPEED),
    )
    receiver = configuration.replace(section.orbit_devices, gps_start=1.0)
    seed = case.seed[0] * 100_003 + case.seed[1]
    return configuration.replace(section, seed=seed, free_body=body, orbit_devices=receiver)


def _facts(flown: Run) -> Result:
    packets, errors = flown["navigation"], camera_errors(flown)
    level, times = packets["knowledge"].astype(int), seconds(packets)
    fine_s = float(times[level == FINE][0]) if (level == FINE).any() else math.inf
    judged = errors.times > fine_s + SETTLED
    fine = level[np.maximum(np.searchsorted(times, errors.times, side="right") - 1, 0)] == FINE
    error, sigma = errors.error[judged & fine], errors.sigma[judged & fine]
    return {
        "fine_s": fine_s,
        "coarse_share": float(np.mean(level >= COARSE)),
        "blind_share": float(np.mean([b"saturated" in status for status in flown["streak"]["status"]])),
        "sunlit": bool(flown["orbit_truth"]["sunlit"].min() > 0.5),
        "rms_deg": float(np.degrees(np.sqrt(np.mean(np.sum(error**2, axis=1))))) if len(error) else None,
        "worst_sigmas": float((np.abs(error) / sigma).max()) if len(error) else None,
        "nees": float(np.mean((error / sigma) ** 2)) if len(error) else None,
        "refused": int(packets["refused"][-1]),
    }


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return times to a fine attitude, and then errors and claimed sigmas, for sunlight and shadow."""
    facts: dict[str, Any] = {}
    for name, lit in (("sunlit", True), ("shadow", False)):
        mine = [r for r in results if r["sunlit"] is lit]
        if not mine:
            continue
        judged = [r for r in mine if r["rms_deg"] is not None]
        rms = [r["rms_deg"] for r in judged] or [math.nan]
        found = {
            "flights": len(mine),
            "within": sum(r["fine_s"] <= WANTED for r in mine),
            "never": sum(math.isinf(r["fine_s"]) for r in mine),
            "blind": float(np.mean([r["blind_share"] for r in mine])),
            "rms": float(np.median(rms)),
            "worst": float(max(rms)),
            "sigmas": max((r["worst_sigmas"] for r in judged), default=math.nan),
            "nees": float(np.mean([r["nees"] for r in judged] or [math.nan])),
        }
        facts[name] = found
    return summary(facts)


ACQUISITION = Campaign(
    "acquisition",
    "lost in space to a fine attitude by the star camera, in the loop",
    cases,
    run,
    summarise,
    40,
)
