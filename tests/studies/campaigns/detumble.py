"""Campaign `detumble`: detumbling from 10 to 0.5 deg/s by coils alone, with all simulated disturbances.

Two craft are detumbled, each in a Sun-synchronous, an ISS-like and an equatorial orbit. The law
`magnetometer` has only a magnetometer and the orbit. The law `attitude` also has a gyro with a bias and a
coarse attitude. The law `inertia` has the same sensors, but the body's moments and principal axes differ from
the configured ones by up to the default accuracies. The coils pause for 0.2 s in every 4 s for the
magnetometer, and in every 2 s while the rate is uncertain. They are also off before the rate is known. The
coils are commanded every quarter of a second, and at least once per 0.3 rad of the body's rotation. Each time
is compared with a rigorous lower bound (`least_time`) for any control of these coils. The bound assumes that
the coils are never off, and that the largest dipole can have any direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from flight.schema.bodies import FieldDetumble
from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.ephemeris import FieldAhead
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.astro.quaternion import attitude_matrix
from knightcube.gnc.control.detumble import WindowSchedule
from knightcube.gnc.control.field_detumbler import FieldDetumbler, FieldDetumblerSettings, FieldPrediction
from knightcube.gnc.estimation.field_rate import FieldRateSettings
from knightcube.gnc.estimation.rigid_body import BodyErrors
from sim_hal.description_errors import NO_ERRORS, DescriptionErrors
from sim_hal.settings import Disturbances, TipOff
from sim_hal.worlds.free_body import CRAFTS, DRAG_COEFFICIENT, SOLAR_PRESSURE
from sim_hal.worlds.orbit import air_flow
from tests.studies.campaigns.free_flight import CRAFT, FIX_SIGMA, GYRO_NOISE, SECOND, STILL, FreeFlight

DIRECTIONS = 2000
CLOSER, TRIES = (0.06, 0.02, 0.007), 60
"""Spreads (rad) of further directions around the worst one found, and number of directions for each
spread."""


def least_time(
    momentum: FloatArray,
    field: FloatArray,
    step: FloatArray | float,
    reach: float,
    left: float,
    others: FloatArray | float = 0.0,
) -> float:
    """Return a lower bound (s) of the time in which a momentum (3,), N m s, can fall to `left` N m s.

    In inertial axes the momentum h obeys h' = m x B + T, whatever the inertia and the attitude are. The
    dipole moment m of the coils is at most `reach` (A m^2), and the torque T of all other causes at most
    `others` (N m), both in magnitude. For any unit vector y,

        y . (h(0) - h(t)) = integral of (m . (y x B) - y . T) <= integral of (reach |B x y| + others).

    Since y . h(t) <= |h(t)|, a momentum of at most `left` after the time t needs, for every y,

        y . h(0) - left <= integral of (reach |B x y| + others) from 0 to t.

    The right-hand side grows with t, so for each y, t is at least the time at which the two sides are equal.
    The result is the latest of these times over all directions that are tried. It is a lower bound whichever
    directions are tried, because each direction alone gives a lower bound. Three orthogonal coils with the
    same limit together have a dipole moment of at most sqrt(3) times this limit.

    Args:
        momentum: initial angular momentum (3,), N m s, inertial axes.
        field: magnetic field (n, 3), T, at the middles of n steps, in the same axes.
        step: duration of all steps or of each step (n,), s. The result is at most the total duration.
        reach: largest magnitude of the coils' dipole moment, A m^2.
        left: final momentum, N m s.
        others: largest torque of other causes, N m, for all steps or for each step (n,).
    """
    rng = np.random.default_rng(1)
    tried = rng.standard_normal((DIRECTIONS, 3))
    tried[0] = momentum
    longest, worst = -1.0, tried[0]
    other = np.broadcast_to(np.asarray(others, dtype=float), len(field))[:, None]
    steps = np.broadcast_to(np.asarray(step, dtype=float), len(field))
    ends = np.concatenate([[0.0], np.cumsum(steps)])
    for close in (None, *CLOSER):
        if close is not None:
            tried = worst + close * rng.standard_normal((TRIES, 3))
        tried /= np.linalg.norm(tried, axis=1, keepdims=True)
        pull = reach * np.linalg.norm(np.cross(field[:, None], tried), axis=2) + other
        removed = np.vstack([np.zeros(len(tried)), np.cumsum(pull * steps[:, None], axis=0)])
        times = np.interp(_crossed(removed, tried @ momentum - left), np.arange(len(ends)), ends)
        if times.max() > longest:
            longest, worst = float(times.max()), tried[times.argmax()]
    return longest


def _crossed(removed: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return the fractional row indices (k,) at which each column of `removed` reaches its value in `wanted`.

    The columns of `removed` (n + 1, k) increase with the row; `wanted` has the shape (k,).
    """
    row = np.sum(removed < wanted, axis=0)
    after = np.clip(row, 1, len(removed) - 1)
    column = np.arange(len(wanted))
    low, high = removed[after - 1, column], removed[after, column]
    part = np.clip((wanted - low) / np.maximum(high - low, 1e-300), 0.0, 1.0)
    return np.where(wanted <= 0.0, 0.0, after - 1.0 + part)


SPEED, SLOW = math.radians(10.0), math.radians(0.5)
SCHEDULE = WindowSchedule(100_000_000, 100_000_000, 3_800_000_000)
SAMPLES_NS = range(SCHEDULE.settle_ns, SCHEDULE.settle_ns + SCHEDULE.measure_ns, 25_000_000)
LAWS = ("magnetometer", "attitude", "inertia")
CELLS = tuple((orbit, law) for orbit in ("sso", "iss", "equator") for law in LAWS)
LONGEST = 6000.0
"""Time (s) after which a body that still rotates counts as lost."""
WALK, LIGHTEST = 4.0, 1.04
"""Largest random walk of the residual dipole, in standard deviations per axis, and largest solar pressure
relative to that at one astronomical unit.
"""
LEAST_CYCLES = 16
"""Smallest number of coil commands in a control window; a flight has 152."""
HORIZON = {"knightcube": 1500.0, "cubesat_3u": 3000.0}
"""Planning horizon (s), by craft."""
ATTITUDE_SIGMA = np.radians(1.0)
"""Error (rad per axis) of the coarse attitude from Sun and field."""
FIELD_SIGMA = 2e-7
TORQUE_WALK = {"knightcube": 3e-4, "cubesat_3u": 3e-5}
"""Random walk of torque / inertia (rad/s per sqrt(s)), by craft: a tenth of the coils' torque over a few
seconds.
"""
TARGETS = {
    ("knightcube", "magnetometer"): 2000.0,
    ("knightcube", "attitude"): 450.0,
    ("knightcube", "inertia"): 450.0,
    ("cubesat_3u", "magnetometer"): 2700.0,
    ("cubesat_3u", "attitude"): 1500.0,
    ("cubesat_3u", "inertia"): 1500.0,
}
"""Required detumbling times (s)."""
OVER = {"magnetometer": 1.6, "attitude": 1.3, "inertia": 1.4}
"""Required medians of time / lower bound, by law, in the orbits that are not equatorial."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights of each craft, orbit and law."""
    return [
        Case(f"{craft}/{law}/{orbit}/{run}", (seed, run), {"craft": craft, "law": law, "orbit": orbit})
        for run in range(runs)
        for craft in CRAFT
        for orbit, law in CELLS
    ]


def description(law: str, seed: int, inertia: FloatArray) -> DescriptionErrors:
    """Return random errors of a configured inertia tensor (3, 3) for a law, drawn by a seed."""
    if law != "inertia":
        return NO_ERRORS
    generator, bounds = np.random.default_rng([seed, 0x1E7]), BodyErrors()
    described = np.linalg.eigvalsh(inertia)
    while True:
        moments = 1.0 + bounds.moments * generator.uniform(-1.0, 1.0, 3)
        if 2.0 * float((moments * described).max()) < float((moments * described).sum()):
            break
    return replace(NO_ERRORS, moments=moments, axes=bounds.axes * generator.uniform(-1.0, 1.0, 3))


def run(case: Case) -> Result:
    """Simulate until the body is slow or counts as lost."""
    wanted = case.parameters
    release = TipOff(speed=wanted.get("speed") or SPEED)
    noises = Disturbances(**(STILL if wanted.get("still") else {}))
    errors = description(wanted["law"], hash_of(case), CRAFTS[wanted["craft"]].inertia)
    flight = FreeFlight(wanted["craft"], hash_of(case), wanted["orbit"], release, noises, errors)
    law = _Law(flight, wanted)
    bound = _Bound(flight)
    fastest = 0.0
    longest = wanted.get("longest", LONGEST)
    while flight.time_ns < longest * SECOND:
        start_ns = flight.time_ns  # of a window
        flight.act(np.zeros(3))
        for phase_ns in SAMPLES_NS:
            flight.advance(start_ns + phase_ns)
            law.sample()
        acting_ns = start_ns + SCHEDULE.settle_ns + SCHEDULE.measure_ns
        end_ns = start_ns + SCHEDULE.period_ns
        while not law.detumbler.trusted and acting_ns < end_ns - SAMPLES_NS.step:
            flight.advance(acting_ns)
            law.sample()
            acting_ns += SAMPLES_NS.step
        if law.detumbler.trusted:
            end_ns = max(law.detumbler.next_pause_ns, acting_ns)
        act_ns = end_ns - acting_ns
        speed = float(np.linalg.norm(flight.motion.rate))
        cycles = max(LEAST_CYCLES, int(np.ceil(speed * act_ns / SECOND / 0.3)))
        for cycle in range(cycles):
            flight.advance(acting_ns + act_ns * cycle // cycles)
            flight.act(law.dipole())
        flight.advance(end_ns)
        law.dipole()
        bound.pass_window()
        fastest = max(fastest, float(np.linalg.norm(flight.motion.rate)))
        if float(np.linalg.norm(flight.motion.rate)) < SLOW:
            break
    rate = float(np.linalg.norm(flight.motion.rate))
    return {
        **wanted,
        "seconds": flight.time_ns / SECOND,
        "least": bound.least(),
        "rate": rate,
        "lost": bool(rate >= SLOW),
        "square": flight.square,
        "fastest_deg": math.degrees(fastest),
    }


def hash_of(case: Case) -> int:
    """Return the seed of a case's world, which is the same for all laws."""
    return case.seed[0] * 100_003 + case.seed[1]


class _Bound:
    """Lower bound of the time of a flight, computed from its true craft and the field along its orbit."""

    def __init__(self, flight: FreeFlight) -> None:
        self._flight = flight
        motion, craft = flight.body.motion(flight.time_ns), flight.body.craft
        attitude = attitude_matrix(quaternion.multiply(craft.to_principal, motion.quaternion))
        rate = attitude_matrix(craft.to_principal) @ motion.rate
        self._momentum = attitude.T @ (np.array(craft.inertia) * rate)
        self._fields = [flight.body.orbit_truth().field]
        self._others = [self._other()]
        self._times_ns = [flight.time_ns]

    def pass_window(self) -> None:
        """Record the magnetic field and the largest torque of other causes at the end of a control window."""
        self._fields.append(self._flight.body.orbit_truth().field)
        self._others.append(self._other())
        self._times_ns.append(self._flight.time_ns)

    def least(self) -> float:
        """Return the lower bound of the detumbling time (s), from the fields and torques recorded so far."""
        flight, craft = self._flight, self._flight.body.craft
        fields, others = np.array(self._fields), np.array(self._others)
        currents = np.array(list(product((-1.0, 1.0), repeat=3))) * flight.limit / flight.dipole_per_ampere
        reach = float(np.linalg.norm(currents @ craft.coil_dipole.T, axis=1).max())
        residual = craft.constant_dipole + WALK * craft.walking_dipole
        reach += float(np.linalg.norm(residual) + np.linalg.norm(craft.sunlit_dipole))
        step = np.diff(self._times_ns) / SECOND
        left = max(craft.inertia) * SLOW
        middles = 0.5 * (fields[1:] + fields[:-1])
        return least_time(self._momentum, middles, step, reach, left, np.maximum(others[1:], others[:-1]))

    def _other(self) -> float:
        """Return the largest torque (N m) of gravity gradient, drag and sunlight over all attitudes."""
        craft, here = self._flight.body.craft, self._flight.body.surroundings()
        moments = craft.inertia
        gravity = (
            1.5 * GRAVITATIONAL_PARAMETER / np.linalg.norm(here.position) ** 3 * (max(moments) - min(moments))
        )
        areas = np.array([face.area for face in craft.faces])
        arms = np.array([face.arm for face in craft.faces])
        # The aerodynamic forces on the faces of a box are equivalent to one force at the centre of the box.
        middle = float(np.linalg.norm(arms.mean(axis=0)))
        speed = float(np.linalg.norm(air_flow(here)))
        force = 0.5 * DRAG_COEFFICIENT * here.density * speed**2 * float(np.linalg.norm(areas[::2]))
        light = 2.0 * SOLAR_PRESSURE * LIGHTEST * float(areas @ np.linalg.norm(arms, axis=1))
        return float(gravity + middle * force + light)


class _Law:
    """The flight's control law with the sensors of its kind; some magnetometer samples may be outliers."""

    def __init__(self, flight: FreeFlight, wanted: dict[str, Any]) -> None:
        self._flight = flight
        self._spikes = wanted.get("spikes", 0.0)
        self._knows = wanted["law"] != "magnetometer"
        craft = wanted["craft"]
        noise = FieldRateSettings(
            inertia=flight.inertia, field_sigma=FIELD_SIGMA, torque_walk=TORQUE_WALK[craft]
        )
        section = FieldDetumble()
        braking = FieldDetumblerSettings(
            limit=flight.limit,
            horizon=HORIZON[craft],
            replan=section.replan,
            gentle=section.gentle,
            spin_up=section.spin_up,
            slow=SLOW,
        )
        self._instants = braking.instants
        self._field = FieldAhead()
        self.detumbler = FieldDetumbler(SCHEDULE, braking, noise, self._expected)

    def sample(self) -> None:
        flight = self._flight
        self.detumbler.dipole(flight.time_ns)
        field = flight.field()
        if flight.generator.uniform() < self._spikes:
            field = field + 1e-4 * flight.generator.standard_normal(3)
        noise = GYRO_NOISE * np.sqrt(40.0) * flight.generator.standard_normal(3)
        gyro = flight.motion.rate + flight.gyro_bias + noise
        self.detumbler.sample(flight.time_ns, field, gyro if self._knows else None)

    def dipole(self) -> FloatArray:
        return self.detumbler.dipole(self._flight.time_ns)

    def _expected(self, _: int) -> FieldPrediction:
        """Return the field predicted along the orbit, in the axes of a coarse attitude or in ICRS."""
        flight = self._flight
        truth, draw = flight.body.orbit_truth(), flight.generator.standard_normal
        place, velocity = truth.position + FIX_SIGMA * draw(3), truth.velocity + 0.05 * draw(3)
        state = OrbitState(truth.utc, place, velocity, FIX_SIGMA)
        ahead = self._field.along(state, self._instants)
        if not self._knows:
            return FieldPrediction(ahead, False)
        return FieldPrediction(ahead @ attitude_matrix(flight.attitude(ATTITUDE_SIGMA)).T, True)


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return the times until the bodies are slow, by craft, law and orbits."""
    facts: dict[str, Any] = {}
    for (craft, law), wanted in TARGETS.items():
        for orbits in (("sso", "iss"), ("equator",)):
            mine = [
                result
                for result in results
                if (result["craft"], result["law"]) == (craft, law) and result["orbit"] in orbits
            ]
            if mine:
                facts[f"{craft}/{law}/{'+'.join(orbits)}"] = _cell(mine, wanted, OVER[law])
    return summary(facts)


def _cell(mine: Sequence[Result], wanted: float, over_wanted: float) -> dict[str, Any]:
    """Return the results of the flights of one craft and law."""
    seconds = np.array([result["seconds"] for result in mine])
    over = seconds / np.array([max(result["least"], 1.0) for result in mine])
    return {
        "runs": len(mine),
        "lost": sum(result["lost"] for result in mine),
        "median": float(np.median(seconds)),
        "p95": float(np.percentile(seconds, 95.0)),
        "worst": float(seconds.max()),
        "wanted": wanted,
        "within": int(np.sum(seconds <= wanted)),
        "fastest_deg": max(result["fastest_deg"] for result in mine),
        "over_least": [float(np.percentile(over, part)) for part in (0.0, 50.0, 95.0)],
        "over_wanted": over_wanted,
    }
