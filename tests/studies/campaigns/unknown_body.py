"""Campaign `unknown-body`: attitude knowledge of satellites that differ from their description, in the loop.

Each flight of `config/orbit.yaml` or `config/orbit_3u.yaml` begins at another position of the orbit with a
tumble. The rate of the tumble is lower than the configured rate, so that all phases fit into the flight. The
differences of body, coils and sensors from the configuration are at most the accuracies that the
configuration states (`simulation.free_body.errors`). The dipoles of the coils vary over tens of seconds
(`COIL_VARIATION`). Cells `NAME-tumble` are only the first minutes of such flights, in which most bodies still
tumble. They show within minutes whether the claimed uncertainty is correct.

The attitude is evaluated in each phase: tumble, acquisition, slew, and pointing in sunlight and in eclipse.
The NEES is given per axis, from samples 10 s apart, about the body axes and about the axes of the star
camera. The share of samples beyond 5 sigma and the longest excursion come from all attitude packets (10 Hz)
with a fine attitude. `learned_refused` counts the events `learned-refused`, which are false alarms in these
flights.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from flight.link import events
from flight.link.events import POINTING, Mode
from flight.schema import reader as configuration
from flight.schema.bodies import OrbitConfig
from ground.campaigns.runner import Case, Result, Summary, summary
from ground.report.orbit import (
    FINE,
    WITH_STARS_S,
    AttitudeErrors,
    attitude_errors,
    camera_errors,
    detumbling_periods,
    star_camera,
    stars_age,
)
from ground.report.signals import seconds
from ground.telemetry import Run
from knightcube.astro.arrays import BoolArray, FloatArray
from sim_hal.settings import Simulation
from tests.studies.campaigns.statistics import mean
from tests.support.flights import fly
from tests.support.unlike_body import configured, released

SPEED = {"orbit": math.radians(5.0), "orbit_3u": math.radians(3.0)}
"""Angular rates (rad/s) at the release by configuration."""
FLOWN = {"orbit": 1300.0, "orbit_3u": 1900.0}
"""Durations (s) of the flights by configuration."""
BEGINNINGS = {"orbit": 200.0, "orbit_3u": 250.0}
"""Durations (s) of the cells `NAME-tumble`."""
COIL_VARIATION = 0.005
"""Relative standard deviation of each coil's dipole; the dipole changes every 20 s."""
PHASES = ("tumble", "acquisition", "slew", "sunlit", "eclipse")
EVERY = 10.0
"""Time (s) between the samples of a NEES."""
BEYOND = 5.0
"""Error about an axis, in standard deviations, above which a sample counts as an excursion."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights of each configuration, and `runs` cells `NAME-tumble`."""
    found = []
    for k, name in itertools.product(range(runs), FLOWN):
        short = {"name": name, "label": f"{name}-tumble", "seconds": BEGINNINGS[name]}
        found += [Case(f"{name}/{k}", (seed, k), {"name": name})]
        found += [Case(f"{name}-tumble/{k}", (seed, k), short)]
    return found


def run(case: Case) -> Result:
    """Run the case; its parameters `seconds` and `speed` (rad/s) may replace duration and release rate."""
    given = case.parameters
    name = given["name"]
    duration, speed = given.get("seconds", FLOWN[name]), given.get("speed", SPEED[name])
    config, world = _flight(name, case.seed, duration, speed)
    with TemporaryDirectory(prefix="unknown-body-") as folder:
        flown = fly(config, Path(folder), section=world)
    return {"name": given.get("label", name), **facts(flown, config)}


def _flight(
    name: str, seed: tuple[int, ...], duration: float, speed: float
) -> tuple[OrbitConfig, Simulation]:
    """Return configuration and world of a flight to the first target.

    The configuration has no orbital elements, because elements fit only one orbit.
    """
    config, world = configured(name)
    config = configuration.replace(config, elements=None, duration=duration, targets=config.targets[:1])
    place = float(np.random.default_rng(seed).uniform(0.0, 360.0))
    world = released(world, seed[0] * 100_003 + seed[1], place, speed)
    assert world.free_body is not None
    varying = configuration.replace(world.free_body.disturbances, coil_variation=COIL_VARIATION)
    body = configuration.replace(world.free_body, disturbances=varying)
    return config, configuration.replace(world, free_body=body)


def facts(flown: Run, config: OrbitConfig) -> Result:
    """Return the results of one flight."""
    body, camera = attitude_errors(flown), camera_errors(flown)
    packets, stars, rates = flown["navigation"], flown["stars"], flown["streak"]
    # Measurements before the first estimate are not counted, because the filter cannot reject them.
    begun = body.times[0] if len(body.times) else math.inf
    measured = np.isfinite(stars["quaternion"][:, 0]) & (seconds(stars) > begun)
    rated = np.isfinite(rates["rate"][:, 0]) & (seconds(rates) > begun)
    thinned = _thinned(body.times)
    sampled = AttitudeErrors(body.times[thinned], body.error[thinned], body.sigma[thinned])
    availability = star_camera(flown, config) or {}
    return {
        "phases": {
            phase: {
                "body": _figures(sampled, inside),
                "camera": _figures(camera, inside_camera),
                "stars": _figures(camera, inside_camera & (stars_age(flown, camera.times) < WITH_STARS_S)),
            }
            for (phase, inside), inside_camera in zip(
                in_phases(flown, sampled.times).items(), in_phases(flown, camera.times).values(), strict=True
            )
        },
        "fine_s": next(iter(seconds(packets)[packets["knowledge"] == FINE].tolist()), None),
        "excursions": _excursions(flown, body),
        "restarts": int(packets["restarts"][-1]),
        "learned_refused": int(np.sum(flown["event"]["code"] == events.LEARNED_REFUSED.code)),
        "refused": int(packets["refused"][-1]),
        "attitudes": [int(measured.sum()), int((measured & (stars["accepted"] == 0)).sum())],
        "rates": [int(rated.sum()), int((rated & (rates["accepted"] == 0)).sum())],
        "inertia": _inertia(flown),
        "unobstructed": [availability.get("unobstructed", 0), availability.get("measured", 0)],
        "longest_gap_s": availability.get("longest_gap_s", 0.0),
    }


def _thinned(times: FloatArray) -> BoolArray:
    """Return which samples are the first of their interval of `EVERY` s."""
    return np.diff(np.floor(times / EVERY), prepend=-1.0) > 0.0


def in_phases(flown: Run, times: FloatArray) -> dict[str, BoolArray]:
    """Return which of the `times` (n,), s, are in each phase.

    A slew lasts from the time at which the body starts to point at a target until the planned path ends.
    """
    modes = np.array(flown["mode"]["mode"])
    mode = modes[np.maximum(np.searchsorted(seconds(flown["mode"]), times, side="right") - 1, 0)]
    around = flown["orbit_truth"]
    lit = around["sunlit"][np.minimum(np.searchsorted(seconds(around), times), len(around) - 1)] > 0.5
    points = np.isin(mode, [int(one) for one in POINTING])
    slews = np.zeros(len(times), dtype=bool)
    happened = flown["event"]
    changes = happened[np.isin(happened["code"], (events.SLEW_BEGUN.code, events.SLEW_ENDED.code))]
    if len(changes):
        last = np.searchsorted(seconds(changes), times, side="right") - 1
        slews = (last >= 0) & (changes["code"][np.maximum(last, 0)] == events.SLEW_BEGUN.code)
    return {
        "tumble": mode == int(Mode.DETUMBLE),
        "acquisition": mode == int(Mode.ACQUIRE),
        "slew": points & slews,
        "sunlit": points & ~slews & lit,
        "eclipse": points & ~slews & ~lit,
    }


def _figures(errors: AttitudeErrors, inside: BoolArray) -> list[float]:
    """Return the number of samples, and sums of squared errors, claimed variances and normalised squares."""
    error, sigma = errors.error[inside], errors.sigma[inside]
    sums = (np.sum(error**2), np.sum(sigma**2), np.mean((error / sigma) ** 2, axis=1).sum())
    return [float(len(error)), *map(float, sums)]


def _excursions(flown: Run, body: AttitudeErrors) -> dict[str, float]:
    """Return the numbers of fine samples and of excursions per axis, and the longest excursion (s)."""
    packets = flown["navigation"]
    at = np.maximum(np.searchsorted(seconds(packets), body.times, side="right") - 1, 0)
    fine = packets["knowledge"][at] == FINE
    beyond = (np.abs(body.error) > BEYOND * body.sigma) & fine[:, None]
    longest = begun = 0.0
    inside = False
    for time, out in zip(body.times.tolist(), beyond.any(axis=1).tolist(), strict=True):
        begun = time if out and not inside else begun
        inside = out
        longest = max(longest, time - begun) if out else longest
    largest = np.abs(body.error[fine]) / body.sigma[fine]
    return {
        "samples": 3.0 * float(fine.sum()),
        "beyond": float(beyond.sum()),
        "longest_s": longest,
        "sigmas": float(largest.max()) if len(largest) else 0.0,
    }


def _inertia(flown: Run) -> dict[str, float] | None:
    """Return the largest error of J / trace(J) after detumbling, its claimed sigma, and the NEES."""
    packets, true = flown["description"], flown["true_description"]
    periods = [stop for _, stop, slowed in detumbling_periods(flown, math.inf) if slowed]
    later = packets[seconds(packets) >= periods[0]] if periods else packets[:0]
    if not len(later) or not len(true):
        return None
    found, real = later[0]["inertia"].astype(float), true[0]["inertia"].astype(float)
    error = found / found[:3].sum() - real / real[:3].sum()
    sigma = later[0]["inertia_ratio_sigma"].astype(float)
    return {
        "error": float(np.abs(error).max()),
        "claim": float(sigma.max()),
        "nees": float(np.mean((error / sigma) ** 2)),
    }


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return a row for each phase of each configuration, and a row for each configuration."""
    phases: dict[str, Any] = {}
    flights: dict[str, Any] = {}
    for name in dict.fromkeys(result["name"] for result in results):
        mine = [result for result in results if result["name"] == name]
        for phase in PHASES:
            phases[f"{name}/{phase}"] = _phase([result["phases"][phase] for result in mine])
        flights[name] = _flights(mine)
    return summary({"phases": phases, "flights": flights})


def _phase(parts: Sequence[Result]) -> dict[str, float | None]:
    """Return the results of a phase over all flights; angles are deg rms over three axes."""
    row: dict[str, float | None] = {}
    for name in ("body", "camera", "stars"):
        count, error, claim, nees = np.sum([part[name] for part in parts], axis=0).tolist()
        row[f"{name}_n"] = count
        row[f"{name}_deg"] = math.degrees(math.sqrt(error / count)) if count else None
        row[f"{name}_claim"] = math.degrees(math.sqrt(claim / count)) if count else None
        row[f"{name}_nees"] = nees / count if count else None
    worst = [part["body"][3] / part["body"][0] for part in parts if part["body"][0] >= 3.0]
    row["worst_nees"] = max(worst, default=None)
    return row


def _flights(mine: Sequence[Result]) -> dict[str, Any]:
    """Return the results of the flights of one configuration."""
    out = [result["excursions"] for result in mine]
    samples, beyond = (sum(one[key] for one in out) for key in ("samples", "beyond"))
    inertia = [result["inertia"] for result in mine if result["inertia"] is not None]
    attitudes, rates, unobstructed = (
        np.sum([result[key] for result in mine], axis=0).tolist()
        for key in ("attitudes", "rates", "unobstructed")
    )
    return {
        "flights": len(mine),
        "beyond": beyond / samples if samples else None,
        "fine_s": max((result["fine_s"] for result in mine if result["fine_s"] is not None), default=None),
        "excursion_s": max(one["longest_s"] for one in out),
        "sigmas": max(one["sigmas"] for one in out),
        "restarts": sum(result["restarts"] for result in mine),
        "learned_refused": sum(result["learned_refused"] for result in mine),
        "refused": sum(result["refused"] for result in mine),
        "attitudes": attitudes,
        "rates": rates,
        "inertia_n": len(inertia),
        "inertia_error": max((one["error"] for one in inertia), default=None),
        "inertia_nees": mean([one["nees"] for one in inertia]),
        "available": unobstructed[1] / unobstructed[0] if unobstructed[0] else None,
        "gap_s": max(result["longest_gap_s"] for result in mine),
    }
