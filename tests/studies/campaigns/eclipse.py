"""Campaign `eclipse`: accuracy of the filter's attitude during an eclipse without stars.

The cells `filter` run the filter of the loop (`FreeFilter`, with the sensor noise of the configurations) on a
craft that points to nadir. The bias of the simulated gyro walks as the filter assumes. Star fixes every 10 s
calibrate the bias for at least LEARNED s before the shadow. From the start of a shadow, the filter has only
gyro and magnetometer. Orbits without a shadow of at least SHORTEST s are replaced by new draws. The cells
`storm`, half as many as `filter`, add a field error of STORM.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flight.bodies.orbit.body import filter_settings
from flight.schema import reader as configuration
from flight.schema.bodies import as_orbit
from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import conjugate, multiply, to_rotation_vector
from knightcube.gnc.estimation.free_filter import ATTITUDE, FreeFilter
from tests.studies.campaigns.orbit_pointing_flight import CYCLE, PAUSE, STAR_SIGMA, PointingFlight
from tests.studies.campaigns.statistics import grouped
from tests.support.flights import CONFIG

CRAFT = {"knightcube": "orbit.yaml", "cubesat_3u": "orbit_3u.yaml"}
SETTLED, LAST = 300.0, 120.0
"""Start (s) of the evaluation of errors with star fixes, and length (s) of the evaluated last part of the
shadow.
"""


def judged(error: FloatArray, sigma: FloatArray) -> Result | None:
    """Return statistics of errors (n, 3), rad, with standard deviations (n, 3), or None if n is 0."""
    if not len(error):
        return None
    return {
        "rms_deg": float(np.degrees(np.sqrt(np.mean(np.sum(error**2, axis=1))))),
        "claim_deg": float(np.degrees(np.sqrt(np.mean(np.sum(sigma**2, axis=1))))),
        "nees": float(np.mean((error / sigma) ** 2)),
        "sigmas": float((np.abs(error) / sigma).max()),
    }


LEARNED, SHORTEST, LONGEST = 3_800.0, 1_900.0, 12_000.0
"""Shortest time (s) with star fixes, so that a revolution has passed when the shadow ends.

Shortest duration (s) of the shadow; longest flight (s).
"""
NOTED = 14.0
"""Interval (s) between recorded errors, chosen so that all ages of the last star fix (every 10 s) occur."""
STORM, STORM_TIME = 5e-8, 300.0
"""Standard deviation per axis (T) and time constant (s) of the Gauss-Markov field error, as configured."""
SHARE = 0.3
"""Disturbance torques as a fraction of the worst case, as in the configurations."""
PHASES = ("stars", "eclipse")


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights of each craft, and half as many in a storm."""
    return [
        Case(f"{kind}/{craft}/{run}", (seed, run), {"kind": kind, "craft": craft})
        for kind, flown in (("filter", runs), ("storm", runs // 2))
        for craft in CRAFT
        for run in range(flown)
    ]


class DarkFlight(PointingFlight):
    """A flight at nadir whose star camera is silent from `dark` s on; `end` (s) is the end of the shadow."""

    dark, end = math.inf, 0.0

    def __init__(self, craft: str, seed: int, storm: float = 0.0) -> None:
        """Create the flight; `storm` (T per axis) is the standard deviation of the added field error."""
        self._storm, self._weather = storm, np.random.default_rng([seed, 0x570])
        super().__init__({"craft": craft, "share": SHARE, "target": "nadir"}, seed)
        config = as_orbit(configuration.load(CONFIG.parent / CRAFT[craft]))
        noise = filter_settings(config).coil_noise / math.sqrt(CYCLE - PAUSE)
        self.flight.coil_noise = noise
        first, self._filter = self._filter, FreeFilter(self.flight.inertia, filter_settings(config))
        gyro = self._gyro(self.flight.motion.rate, 1.0)
        self._filter.start(first.quaternion, STAR_SIGMA**2 * np.eye(3), gyro)
        self.flight.field_error = storm * self._weather.standard_normal(3)

    def cycle(self, time: float) -> None:
        """Simulate one cycle in a changing field."""
        kept = math.exp(-CYCLE / STORM_TIME)
        kick = self._storm * math.sqrt(1.0 - kept**2) * self._weather.standard_normal(3)
        self.flight.field_error = kept * self.flight.field_error + kick
        super().cycle(time)

    def find_shadow(self, learned: float, shortest: float) -> bool:
        """Find the first shadow that begins after `learned` s; return whether it is long enough."""
        times = np.arange(0.0, LONGEST)
        dark = self.flight.ephemeris(LONGEST + 1.0).sunlit_at(times) < 0.5
        begins = np.flatnonzero(dark[1:] & ~dark[:-1] & (times[1:] > learned)) + 1
        ends = np.flatnonzero(~dark[1:] & dark[:-1]) + 1
        if not len(begins) or not len(later := ends[ends > begins[0]]):
            return False
        self.dark, self.end = float(times[begins[0]]), float(times[later[0]])
        return self.end - self.dark >= shortest

    def error(self) -> tuple[FloatArray, FloatArray, float]:
        """Return attitude error and sigma (3,), rad, and the relative error of the residual dipole."""
        found, truth = self._filter, self.flight.body.orbit_truth()
        off = to_rotation_vector(multiply(self.flight.motion.quaternion, conjugate(found.quaternion)))
        missing = truth.residual_dipole - found.residual_dipole(truth.sunlit)
        share = float(np.linalg.norm(missing) / np.linalg.norm(truth.residual_dipole))
        return off, np.sqrt(np.diag(found.covariance[ATTITUDE, ATTITUDE])), share

    def _see_stars(self, time: float) -> None:
        if time < self.dark:
            super()._see_stars(time)


def run(case: Case) -> Result:
    """Run the case; the parameters `learned`, `shortest`, `settled`, `last` and `seconds` shorten the run."""
    given, seed = case.parameters, case.seed
    number, storm = seed[0] * 100_003 + seed[1], STORM * (given["kind"] == "storm")
    flight = DarkFlight(given["craft"], number, storm)
    while not flight.find_shadow(given.get("learned", LEARNED), given.get("shortest", SHORTEST)):
        number += 1_000_003
        flight = DarkFlight(given["craft"], number, storm)
    end = min(flight.end, flight.dark + given.get("seconds", math.inf))
    settled, last = given.get("settled", SETTLED), given.get("last", LAST)
    times, errors, sigmas, shares = [], [], [], []
    for cycle in range(round(end / CYCLE)):
        flight.cycle(cycle * CYCLE)
        if cycle * CYCLE % NOTED == 0.0:
            off, claim, missing = flight.error()
            times.append(cycle * CYCLE)
            errors.append(off)
            sigmas.append(claim)
            shares.append(missing)
    at, error, sigma, share = np.array(times), np.array(errors), np.array(sigmas), np.array(shares)
    stars, late = (at > settled) & (at < flight.dark), at > end - last
    lit = (at > flight.dark - 5.0 * last) & (at < flight.dark)
    return {
        "kind": given["kind"],
        "craft": given["craft"],
        "shadow_s": end - flight.dark,
        "learned_s": flight.dark,
        "stars": judged(error[stars], sigma[stars]),
        "eclipse": judged(error[late], sigma[late]),
        "dipole": {"sunlight": _rms(share[lit]), "shadow": _rms(share[at > end - 5.0 * last])},
    }


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return errors and claimed uncertainties by kind, craft and phase of the flight."""
    facts: dict[str, Any] = {}
    for cell, mine in grouped(results, "kind", "craft").items():
        for phase in PHASES:
            if parts := [r[phase] for r in mine if r[phase] is not None]:
                facts[f"{cell}/{phase}"] = _row(parts)
        facts[f"{cell}/dipole"] = _dipole(mine)
    return summary(facts)


def _dipole(results: Sequence[Result]) -> dict[str, tuple[float, float]]:
    """Return median and largest unknown fraction of the residual dipole, in sunlight and in shadow."""
    found = {}
    for light in ("sunlight", "shadow"):
        shares = [r["dipole"][light] for r in results if math.isfinite(r["dipole"][light])]
        if shares:
            found[light] = float(np.median(shares)), max(shares)
    return found


def _row(parts: Sequence[Result]) -> dict[str, float]:
    rms = np.array([r["rms_deg"] for r in parts])
    return {
        "flights": float(len(parts)),
        "rms": _rms(rms),
        "median": float(np.median(rms)),
        "worst": float(rms.max()),
        "claim": _rms(np.array([r["claim_deg"] for r in parts])),
        "sigmas": max(r["sigmas"] for r in parts),
        "nees": float(np.mean([r["nees"] for r in parts])),
    }
