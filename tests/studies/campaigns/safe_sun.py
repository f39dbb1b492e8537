"""Campaign `safe-sun`: Sun acquisition and pointing in SAFE mode by solar cells, gyro and magnetometer.

Both craft fly alternately in two orbits for two revolutions of 97 min. They start with a random attitude and
a rate of 0.5 deg/s, at which detumbling ends. Drag, sunlight and the rotation of the principal axes are
`share` of the worst case; gravity gradient and residual dipole have their full magnitude. The solar cells
have gain errors and also receive light from the sunlit Earth. `found` is the time at which the axis is first
within NEAR deg of the Sun. `rms` is the rms angle between axis and Sun in sunlight after SETTLED s, including
the time after each eclipse. `again` is the longest time from the end of an eclipse until the axis is within
NEAR deg.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.sun import sunlit_share
from knightcube.astro.quaternion import attitude_matrix
from knightcube.gnc.control.detumble import WindowSchedule
from knightcube.gnc.control.sun_acquisition import SunAcquisition, SunAcquisitionSettings
from knightcube.vision.solar_cells import SolarStringModel, coarse_sun
from sim_hal.emulators.power import SolarCellsModel
from sim_hal.settings import Disturbances, TipOff
from sim_hal.worlds.orbit import sun_position
from tests.studies.campaigns.detumble import SAMPLES_NS, hash_of
from tests.studies.campaigns.free_flight import CRAFT, GYRO_NOISE, ORBITS, SECOND, FreeFlight
from tests.studies.campaigns.statistics import grouped, largest, median, rms

AXIS = np.array([0.0, 0.0, 1.0])
SCHEDULE = WindowSchedule(100_000_000, 100_000_000, 1_800_000_000)
SPEED = math.radians(0.5)
SECONDS, SETTLED = 11_600.0, 1_800.0
NEAR = 20.0
"""Largest angle (deg) between axis and Sun at which the Sun counts as found."""
SHARES = (0.3, 1.0)
CYCLES = 6
"""Number of coil commands in a control window; the flight has 72."""
GAIN_ERROR, STRING_NOISE = 0.02, 2e-3
"""Relative gain error of the solar cells, and noise (A) for a peak current of 1 A."""
_STREAM = 0x5AFE


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights of each craft and share, alternately in two orbits."""
    orbits = list(ORBITS)
    return [
        Case(
            f"{craft}/{share}/{run}", (seed, run), {"craft": craft, "share": share, "orbit": orbits[run % 2]}
        )
        for run in range(runs)
        for craft in CRAFT
        for share in SHARES
    ]


class SafeFlight:
    """One craft with its sun acquisition.

    `notes` has a row for each window: time, angle (deg) between axis and Sun, sunlight and rate (deg/s).
    """

    def __init__(self, wanted: dict[str, Any], seed: int) -> None:
        """Create the flight. Keys of `wanted`: craft, share of the worst disturbances, orbit."""
        share = wanted["share"]
        disturbances = Disturbances(drag=share, solar_pressure=share, principal_turn_deg=3.0 * share)
        release = TipOff(speed=wanted.get("speed", SPEED))
        self._flight = FreeFlight(wanted["craft"], seed, wanted["orbit"], release, disturbances)
        self._draws = np.random.default_rng([seed, _STREAM])
        self._strings = SolarStringModel()
        gains = GAIN_ERROR * self._draws.standard_normal(len(self._strings.peaks))
        self._light = SolarCellsModel(self._strings.normals, self._strings.peaks, gains, noise=STRING_NOISE)
        seeking = SunAcquisitionSettings(inertia=self._flight.inertia, axis=AXIS, limit=self._flight.limit)
        self.law = SunAcquisition(SCHEDULE, seeking)
        self.notes: list[tuple[float, float, float, float]] = []

    def window(self, seconds: float) -> None:
        """Simulate one control window from `seconds` on: first a pause of the coils, then commands."""
        flight, start_ns = self._flight, round(seconds * SECOND)
        flight.act(np.zeros(3))
        for phase_ns in SAMPLES_NS:
            self._sample(start_ns + phase_ns)
        acting_ns = start_ns + SCHEDULE.settle_ns + SCHEDULE.measure_ns
        for cycle in range(CYCLES):
            self._sample(acting_ns + SCHEDULE.act_ns * cycle // CYCLES)
            flight.act(self.law.dipole(flight.time_ns))
        self._see()

    def _sample(self, time_ns: int) -> None:
        flight = self._flight
        flight.advance(time_ns)
        noise = GYRO_NOISE * math.sqrt(20.0) * flight.generator.standard_normal(3)
        self.law.sample(time_ns, flight.field(), flight.motion.rate + flight.gyro_bias + noise)

    def _see(self) -> None:
        """Give the sun acquisition the readings of the solar cells, and record the true states."""
        flight = self._flight
        truth = flight.body.orbit_truth()
        body = attitude_matrix(truth.quaternion)
        place = sun_position(truth.utc)
        currents = self._light.currents(truth.position, place, body, self._draws)
        found = coarse_sun(currents, self._strings)
        if found.direction is not None:
            self.law.update_sun(flight.time_ns, found.direction)
        to_sun = place - truth.position
        cosine = float(AXIS @ body @ to_sun) / float(np.linalg.norm(to_sun))
        lit = float(sunlit_share(truth.position, place))
        off = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
        rate = math.degrees(float(np.linalg.norm(truth.rate)))
        self.notes.append((flight.time_ns / SECOND, off, lit, rate))


def run(case: Case) -> Result:
    """Fly the case."""
    flight = SafeFlight(case.parameters, hash_of(case))
    seconds = case.parameters.get("seconds", SECONDS)
    window = SCHEDULE.period_ns / SECOND
    for number in range(round(seconds / window)):
        flight.window(number * window)
    return {**case.parameters, **judged(np.array(flight.notes), min(SETTLED, 0.5 * seconds))}


def judged(notes: FloatArray, settled: float) -> Result:
    """Return the results of `notes` (n, 4); results for sunlight or eclipse are None if it did not occur."""
    times, off, lit, rate = notes.T
    near, sunlit = off <= NEAR, lit > 0.5
    later = times > settled
    dawns = np.nonzero(sunlit[1:] & ~sunlit[:-1])[0] + 1
    returns = [np.nonzero(near[dawn:])[0] for dawn in dawns]
    again = [
        float(times[dawn + after[0]] - times[dawn])
        for dawn, after in zip(dawns, returns, strict=True)
        if len(after)
    ]
    return {
        "found": float(times[near][0]) if near.any() else None,
        "rms": rms(off[later & sunlit]),
        "rms_dark": rms(off[later & ~sunlit]),
        "worst": largest(off[later & sunlit]),
        "again": max(again, default=None),
        "missed": int(not near.any()) + len(returns) - len(again),
        "fastest_deg": float(rate.max()),
    }


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return the errors of the axis towards the Sun, by satellite and by share of the worst torques."""
    return summary({name: _figures(own) for name, own in grouped(results, "craft", "share").items()})


def _figures(mine: Sequence[Result]) -> dict[str, Any]:
    """Return the results of one cell."""
    lit = np.array([result["rms"] for result in mine if result["rms"] is not None])
    dark = [result["rms_dark"] for result in mine if result["rms_dark"] is not None]
    return {
        "runs": len(mine),
        "held": int(np.sum(lit <= NEAR)),
        "missed": sum(result["missed"] for result in mine),
        "median": float(np.median(lit)),
        "p95": float(np.percentile(lit, 95.0)),
        "worst": float(lit.max()),
        "dark": median(dark),
        "found": max((result["found"] for result in mine if result["found"] is not None), default=None),
        "again": max((result["again"] for result in mine if result["again"] is not None), default=None),
        "fastest_deg": max(result["fastest_deg"] for result in mine),
    }
