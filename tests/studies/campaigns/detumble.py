"""Campaign `detumble`: from 10 deg/s to 0.5 by coils alone, in the simulated world with all disturbances.

Two craft, each in a Sun-synchronous and an ISS-like orbit, by two laws: `magnetometer`, which knows the
magnetometer alone, and `attitude`, which knows the gyro's rate, a coarse attitude and the field along the
orbit. The coils pause a fifth of each second, as the magnetometer needs. Coils are commanded as often as the
body turns by 0.3 rad.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flight.gnc.control.detumble import WindowSchedule
from flight.gnc.control.three_axes.field_detumbler import FieldBraking, FieldDetumbler
from flight.gnc.control.three_axes.momentum import MomentumPlan, braking_dipole, momentum_plan
from flight.gnc.earth.ephemeris import Ephemeris
from flight.gnc.estimation.field_rate import FieldRateSettings
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import attitude_matrix
from sim_hal.worlds.free_body.section import TipOff
from tests.studies.campaigns.campaign import Campaign, Case, Result, Summary
from tests.studies.campaigns.free_flight import CRAFT, GYRO_NOISE, ORBITS, SECOND, FreeFlight

SPEED, SLOW = math.radians(10.0), math.radians(0.5)
SCHEDULE = WindowSchedule(100_000_000, 100_000_000, 800_000_000)
DUTY = SCHEDULE.act_ns / SCHEDULE.period_ns
SAMPLES_NS = range(SCHEDULE.settle_ns, SCHEDULE.settle_ns + SCHEDULE.measure_ns, 25_000_000)
LAWS = ("magnetometer", "attitude")
LONGEST = 6000.0
"""s: a body that is not slow by then is lost."""
HORIZON, INSTANT, REPLAN = 3000.0, 20.0, 5.0
"""s: how far the field is known ahead, at what steps, and how often a plan is made."""
ATTITUDE_SIGMA = np.radians(1.0)
"""rad an axis, of the coarse attitude: Sun and field."""
GYRO_BIAS_LEFT = np.radians(0.02)
"""rad/s an axis, that a coarse attitude leaves of the gyro's bias."""
FIELD_SIGMA = 2e-7
TORQUE_WALK = {"knightcube": 3e-4, "cubesat_3u": 3e-5}
"""rad/s per sqrt(s): a tenth of the coils' torque over a few seconds."""
TARGETS = {
    ("knightcube", "magnetometer"): 2000.0,
    ("knightcube", "attitude"): 450.0,
    ("cubesat_3u", "magnetometer"): 2700.0,
    ("cubesat_3u", "attitude"): 1500.0,
}


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights of each craft and law, in the two orbits by turns."""
    orbits = list(ORBITS)
    return [
        Case(f"{craft}/{law}/{run}", (seed, run), {"craft": craft, "law": law, "orbit": orbits[run % 2]})
        for run in range(runs)
        for craft in CRAFT
        for law in LAWS
    ]


def run(case: Case) -> Result:
    """Fly until the body is slow, or lost."""
    wanted = case.parameters
    release = TipOff(speed=wanted.get("speed") or SPEED)
    flight = FreeFlight(wanted["craft"], hash_of(case), wanted["orbit"], release)
    law = _MagnetometerAlone(flight, wanted) if wanted["law"] == "magnetometer" else _AttitudeKnown(flight)
    longest = wanted.get("longest", LONGEST)
    seconds = 0
    while seconds < longest:
        start_ns = seconds * SECOND
        flight.act(np.zeros(3))
        for phase_ns in SAMPLES_NS:
            flight.advance(start_ns + phase_ns)
            law.sample()
        acting_ns = start_ns + SCHEDULE.settle_ns + SCHEDULE.measure_ns
        speed = float(np.linalg.norm(flight.motion.rate))
        cycles = max(1, int(np.ceil(speed * SCHEDULE.act_ns / SECOND / 0.3)))
        for cycle in range(cycles):
            flight.advance(acting_ns + SCHEDULE.act_ns * cycle // cycles)
            flight.act(law.dipole())
        seconds += 1
        flight.advance(seconds * SECOND)
        law.dipole()
        if float(np.linalg.norm(flight.motion.rate)) < SLOW:
            break
    rate = float(np.linalg.norm(flight.motion.rate))
    return {
        **wanted,
        "seconds": float(seconds),
        "rate": rate,
        "lost": bool(rate >= SLOW),
        "square": flight.square,
    }


def hash_of(case: Case) -> int:
    """Return the seed of a case's world: the same for both laws."""
    return case.seed[0] * 100_003 + case.seed[1]


class _MagnetometerAlone:
    """Brakes by the magnetometer alone; some samples may be spiked."""

    def __init__(self, flight: FreeFlight, wanted: dict[str, Any]) -> None:
        self._flight = flight
        self._spikes = wanted.get("spikes", 0.0)
        noise = FieldRateSettings(
            inertia=flight.inertia, field_sigma=FIELD_SIGMA, torque_walk=TORQUE_WALK[wanted["craft"]]
        )
        self._law = FieldDetumbler(SCHEDULE, FieldBraking(limit=flight.limit), noise)

    def sample(self) -> None:
        flight = self._flight
        self._law.dipole(flight.time_ns)
        field = flight.field()
        if flight.generator.uniform() < self._spikes:
            field = field + 1e-4 * flight.generator.standard_normal(3)
        self._law.sample(flight.time_ns, field)

    def dipole(self) -> FloatArray:
        return self._law.dipole(self._flight.time_ns)


class _AttitudeKnown:
    """Brakes by the momentum plan in the field expected along the orbit."""

    def __init__(self, flight: FreeFlight) -> None:
        self._flight = flight
        self._ahead: Ephemeris | None = None
        self._begin = 0.0
        self._plan: MomentumPlan | None = None
        self._planned = 0.0
        self._bias = GYRO_BIAS_LEFT * flight.generator.standard_normal(3)

    def sample(self) -> None:
        """Ignore the magnetometer."""

    def dipole(self) -> FloatArray:
        flight = self._flight
        now = flight.time_ns / SECOND
        if self._ahead is None or now - self._begin > 0.5 * HORIZON:
            self._ahead, self._begin = flight.ephemeris(1.5 * HORIZON), now
        turned = attitude_matrix(flight.attitude(ATTITUDE_SIGMA))
        if self._plan is None or now - self._planned >= REPLAN:
            noise = GYRO_NOISE * np.sqrt(40.0) * flight.generator.standard_normal(3)
            momentum = turned.T @ flight.inertia @ (flight.motion.rate + self._bias + noise)
            field = self._ahead.field_at(now - self._begin + np.arange(0.0, HORIZON, INSTANT))
            self._plan = momentum_plan(momentum, field, INSTANT, DUTY * flight.limit)
            self._planned = now
        field = turned @ self._ahead.field_at(np.array([now - self._begin]))[0]
        return braking_dipole(turned @ self._plan.costate, field, flight.limit)


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return the times to slow, by craft and law."""
    facts: dict[str, Any] = {}
    lines = [
        f"{'craft':12}{'law':14}{'runs':>6}{'lost':>6}{'median':>9}{'95 %':>9}{'worst':>9}{'wanted':>9}   s"
    ]
    for (craft, law), wanted in TARGETS.items():
        mine = [result for result in results if (result["craft"], result["law"]) == (craft, law)]
        if not mine:
            continue
        seconds = np.array([result["seconds"] for result in mine])
        lost = sum(result["lost"] for result in mine)
        found = {
            "runs": len(mine),
            "lost": lost,
            "median": float(np.median(seconds)),
            "p95": float(np.percentile(seconds, 95.0)),
            "worst": float(seconds.max()),
            "wanted": wanted,
            "within": float(np.mean(seconds <= wanted)),
        }
        facts[f"{craft}/{law}"] = found
        lines.append(
            f"{craft:12}{law:14}{len(mine):6d}{lost:6d}{found['median']:9.0f}{found['p95']:9.0f}"
            f"{found['worst']:9.0f}{wanted:9.0f}"
        )
    return Summary("\n".join(lines) + "\n", facts)


DETUMBLE = Campaign(
    "detumble",
    "a free satellite from 10 deg/s to 0.5 by coils: magnetometer alone, attitude known",
    cases,
    run,
    summarise,
    100,
)
