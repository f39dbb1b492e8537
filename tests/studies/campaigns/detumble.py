"""Campaign `detumble`: from 10 deg/s to 0.5 by coils alone, in the simulated world with all disturbances.

Two craft, each in a Sun-synchronous and an ISS-like orbit, by one law: `magnetometer` knows the magnetometer
alone, `attitude` also a gyro with its bias, a coarse attitude and the orbit. The coils pause a tenth of each
two seconds, as the magnetometer needs, and before they act at all. Coils are commanded each quarter of a
second, and as often as the body turns by 0.3 rad. Beside each time stands a bound from below
(`least_time`), without a bound of the rate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.ephemeris import FieldAhead, predict
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.astro.quaternion import attitude_matrix
from knightcube.gnc.control.detumble import WindowSchedule
from knightcube.gnc.control.field_detumbler import FieldDetumbler, FieldDetumblerSettings
from knightcube.gnc.estimation.field_rate import FieldRateSettings
from sim_hal.settings import Disturbances, TipOff
from tests.studies.campaigns.campaign import Campaign, Case, Result, Summary, summary
from tests.studies.campaigns.free_flight import (
    CRAFT,
    FIX_SIGMA,
    GYRO_NOISE,
    ORBITS,
    SECOND,
    STILL,
    FreeFlight,
)

SATURATED = 1.5
"""Mean over all attitudes of the sum of a unit vector's components, by size."""
DIRECTIONS = 2000
CLOSER, TRIES = (0.06, 0.02, 0.007), 60
"""Spreads (rad) of the directions tried around the worst one so far, and their number for each spread."""


def least_time(momentum: FloatArray, field: FloatArray, step: float, reach: float, left: float) -> float:
    """Return the bound, s, for all but `left` N m s of a momentum (3,).

    `field` (n, 3) T is that at the middles of steps of `step` s, in the momentum's inertial axes; `reach` is
    in A m^2. The bound is n steps at most.
    """
    rng = np.random.default_rng(1)
    tried = rng.standard_normal((DIRECTIONS, 3))
    longest, worst = -1.0, tried[0]
    for close in (None, *CLOSER):
        if close is not None:
            tried = worst + close * rng.standard_normal((TRIES, 3))
        tried /= np.linalg.norm(tried, axis=1, keepdims=True)
        across = np.linalg.norm(np.cross(field[:, None], tried), axis=2)
        removed = np.vstack([np.zeros(len(tried)), np.cumsum(across, axis=0)]) * (step * reach)
        times = _crossed(removed, tried @ momentum - left) * step
        if times.max() > longest:
            longest, worst = float(times.max()), tried[times.argmax()]
    return longest


def _crossed(removed: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return by column the row, in parts, where `removed` (n + 1, k), rising, reaches `wanted` (k,)."""
    row = np.sum(removed < wanted, axis=0)
    after = np.clip(row, 1, len(removed) - 1)
    column = np.arange(len(wanted))
    low, high = removed[after - 1, column], removed[after, column]
    part = np.clip((wanted - low) / np.maximum(high - low, 1e-300), 0.0, 1.0)
    return np.where(wanted <= 0.0, 0.0, after - 1.0 + part)


SPEED, SLOW = math.radians(10.0), math.radians(0.5)
SCHEDULE = WindowSchedule(100_000_000, 100_000_000, 1_800_000_000)
SAMPLES_NS = range(SCHEDULE.settle_ns, SCHEDULE.settle_ns + SCHEDULE.measure_ns, 25_000_000)
LAWS = ("magnetometer", "attitude")
LONGEST = 6000.0
"""s: a body that is not slow by then is lost."""
AHEAD, BOUND_STEP = 3000.0, 10.0
"""s that the bound looks ahead, and its step."""
LEAST_CYCLES = 8
"""Commands in a window; the flight gives 72."""
HORIZON = {"knightcube": 1500.0, "cubesat_3u": 3000.0}
"""s that a plan looks ahead."""
ATTITUDE_SIGMA = np.radians(1.0)
"""rad an axis, of the coarse attitude: Sun and field."""
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
    noises = Disturbances(**(STILL if wanted.get("still") else {}))
    flight = FreeFlight(wanted["craft"], hash_of(case), wanted["orbit"], release, noises)
    law = _Law(flight, wanted)
    least = _least(flight)
    fastest = 0.0
    longest = wanted.get("longest", LONGEST)
    seconds = 0
    while seconds < longest:
        start_ns = seconds * SECOND  # of a window
        flight.act(np.zeros(3))
        for phase_ns in SAMPLES_NS:
            flight.advance(start_ns + phase_ns)
            law.sample()
        acting_ns = start_ns + SCHEDULE.settle_ns + SCHEDULE.measure_ns
        seconds += SCHEDULE.period_ns // SECOND
        while not law.trusted and acting_ns < seconds * SECOND - SAMPLES_NS.step:
            flight.advance(acting_ns)
            law.sample()
            acting_ns += SAMPLES_NS.step
        act_ns = seconds * SECOND - acting_ns
        speed = float(np.linalg.norm(flight.motion.rate))
        cycles = max(LEAST_CYCLES, int(np.ceil(speed * act_ns / SECOND / 0.3)))
        for cycle in range(cycles):
            flight.advance(acting_ns + act_ns * cycle // cycles)
            flight.act(law.dipole())
        flight.advance(seconds * SECOND)
        law.dipole()
        fastest = max(fastest, float(np.linalg.norm(flight.motion.rate)))
        if float(np.linalg.norm(flight.motion.rate)) < SLOW:
            break
    rate = float(np.linalg.norm(flight.motion.rate))
    return {
        **wanted,
        "seconds": float(seconds),
        "least": least,
        "rate": rate,
        "lost": bool(rate >= SLOW),
        "square": flight.square,
        "fastest_deg": math.degrees(fastest),
    }


def hash_of(case: Case) -> int:
    """Return the seed of a case's world: the same for both laws."""
    return case.seed[0] * 100_003 + case.seed[1]


def _least(flight: FreeFlight) -> float:
    """Return the bound of the time to slow from now on, s."""
    motion, truth = flight.body.motion(flight.time_ns), flight.body.orbit_truth()
    ahead = predict(OrbitState(truth.utc, truth.position, truth.velocity, 0.0), AHEAD)
    steps = np.arange(0.5 * BOUND_STEP, AHEAD, BOUND_STEP)
    momentum = attitude_matrix(motion.quaternion).T @ (flight.inertia @ motion.rate)
    share = SCHEDULE.act_ns / SCHEDULE.period_ns
    left = float(np.linalg.norm(momentum)) * SLOW / float(np.linalg.norm(motion.rate))
    return least_time(momentum, ahead.field_at(steps), BOUND_STEP, SATURATED * share * flight.limit, left)


class _Law:
    """The flight's law with what it may know; some samples of the magnetometer may be spiked."""

    def __init__(self, flight: FreeFlight, wanted: dict[str, Any]) -> None:
        self._flight = flight
        self._spikes = wanted.get("spikes", 0.0)
        self._knows = wanted["law"] == "attitude"
        craft = wanted["craft"]
        noise = FieldRateSettings(
            inertia=flight.inertia, field_sigma=FIELD_SIGMA, torque_walk=TORQUE_WALK[craft]
        )
        braking = FieldDetumblerSettings(limit=flight.limit, horizon=HORIZON[craft])
        self._instants = braking.instants
        self._field = FieldAhead()
        self._law = FieldDetumbler(SCHEDULE, braking, noise, self._expected)

    def sample(self) -> None:
        flight = self._flight
        self._law.dipole(flight.time_ns)
        field = flight.field()
        if flight.generator.uniform() < self._spikes:
            field = field + 1e-4 * flight.generator.standard_normal(3)
        noise = GYRO_NOISE * np.sqrt(40.0) * flight.generator.standard_normal(3)
        gyro = flight.motion.rate + flight.gyro_bias + noise
        self._law.sample(flight.time_ns, field, gyro if self._knows else None)

    @property
    def trusted(self) -> bool:
        return self._law.trusted

    def dipole(self) -> FloatArray:
        return self._law.dipole(self._flight.time_ns)

    def _expected(self, _: int) -> FloatArray | None:
        """Return the field expected ahead along the orbit, in the axes of a coarse attitude."""
        if not self._knows:
            return None
        flight = self._flight
        truth, draw = flight.body.orbit_truth(), flight.generator.standard_normal
        place, velocity = truth.position + FIX_SIGMA * draw(3), truth.velocity + 0.05 * draw(3)
        state = OrbitState(truth.utc, place, velocity, FIX_SIGMA)
        ahead = self._field.along(state, self._instants)
        return np.asarray(ahead @ attitude_matrix(flight.attitude(ATTITUDE_SIGMA)).T)


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return the times to slow, by craft and law."""
    facts: dict[str, Any] = {}
    for (craft, law), wanted in TARGETS.items():
        mine = [result for result in results if (result["craft"], result["law"]) == (craft, law)]
        if not mine:
            continue
        seconds = np.array([result["seconds"] for result in mine])
        over = seconds / np.array([max(result["least"], 1.0) for result in mine])
        lost = sum(result["lost"] for result in mine)
        found = {
            "runs": len(mine),
            "lost": lost,
            "median": float(np.median(seconds)),
            "p95": float(np.percentile(seconds, 95.0)),
            "worst": float(seconds.max()),
            "wanted": wanted,
            "within": int(np.sum(seconds <= wanted)),
            "fastest_deg": max(result["fastest_deg"] for result in mine),
            "over_least": [float(np.percentile(over, part)) for part in (50.0, 95.0)],
        }
        facts[f"{craft}/{law}"] = found
    return summary(facts)


DETUMBLE = Campaign(
    "detumble",
    "a free satellite from 10 deg/s to 0.5 by coils: magnetometer alone, attitude known",
    cases,
    run,
    summarise,
    100,
)
