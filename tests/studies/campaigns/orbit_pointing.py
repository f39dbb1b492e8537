"""Campaign `orbit-pointing`: nadir along the flight by coils alone, the attitude estimated.

A 3U and the KnightCube start at their law's attitude and rate with nothing learned and fly two revolutions
and more; the first one teaches the filter the residual dipole and the torques and is not judged. `share`
multiplies the torques that the coils can not cancel at once: drag, sunlight, and the turn of the principal
axes, which the gravity gradient acts on; the residual dipole is always whole. The coils pause a tenth of each
two seconds for the magnetometer; star attitudes come each 10 s, two seconds late. Tables of gains are made
each half revolution. `plain` flies without feed-forward.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flight.gnc.control.three_axes.pointing import PointingLaw
from flight.gnc.control.three_axes.pointing_table import PointingWeights, pointing_table
from flight.gnc.earth.disturbance import pressures, shapes
from flight.gnc.earth.ephemeris import Ephemeris
from flight.gnc.estimation.free_filter import FreeFilter, FreeFilterSettings
from flight.gnc.estimation.free_motion import GYRO, TURN, Around
from flight.gnc.guidance.three_axes.attitude_law import AttitudeLaw, nadir, references, velocity
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import attitude_matrix, conjugate, multiply, to_rotation_vector
from sim_hal.worlds.free_body.section import Disturbances, TipOff
from tests.studies.campaigns.campaign import Campaign, Case, Result, Summary
from tests.studies.campaigns.free_flight import FIELD_NOISE, GYRO_NOISE, SECOND, WATTS, FreeFlight

REVOLUTION = 5_700.0
CYCLE, PAUSE = 2.0, 0.2
"""s."""
STARS_EVERY = 10.0
"""s."""
STAR_SIGMA = 5e-5
"""rad an axis, 10"."""
PREVIEW, TABLE_EVERY, KNOT = 2.0 * REVOLUTION, 0.5 * REVOLUTION, 10.0
LOST = np.radians(60.0)
WEIGHTS = {
    "knightcube": PointingWeights(turn=np.radians(1.0), rate=1.0, dipole=1e-4),
    "cubesat_3u": PointingWeights(turn=np.radians(1.0), rate=1.0, dipole=1e-3),
}
CELLS = (
    ("cubesat_3u", 0.1, "whole", 0.4),
    ("cubesat_3u", 0.3, "whole", 1.2),
    ("cubesat_3u", 1.0, "whole", None),
    ("cubesat_3u", 0.1, "plain", None),
    ("knightcube", 0.1, "whole", 2.0),
    ("knightcube", 0.3, "whole", 5.0),
)
"""Craft, share, law, and deg rms wanted of issue 19."""
LAW = AttitudeLaw(np.array([0.0, 0.0, 1.0]), nadir, np.array([1.0, 0.0, 0.0]), velocity)


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` flights of each cell, the same orbits for each."""
    return [
        Case(f"{craft}/{share}/{law}/{run}", (seed, run), {"craft": craft, "share": share, "law": law})
        for run in range(runs)
        for craft, share, law, _ in CELLS
    ]


def run(case: Case) -> Result:
    """Fly the case."""
    flight = _Flight(case)
    cycles = round(case.parameters.get("revolutions", 2.5) * REVOLUTION / CYCLE)
    for cycle in range(cycles):
        if not flight.cycle(cycle * CYCLE):
            break
    return flight.result()


class _Flight:
    """One craft with its filter and law."""

    def __init__(self, case: Case) -> None:
        wanted = case.parameters
        self._parameters = wanted
        share = wanted["share"]
        noises = Disturbances(drag=share, solar_pressure=share, principal_turn_deg=3.0 * share)
        seed = case.seed[0] * 100_003 + case.seed[1]
        held = FreeFlight(wanted["craft"], seed, "sso", TipOff(rate=(0.0, 0.0, 0.0)), noises)
        held.advance(0)
        start = references(LAW.attitudes, held.ephemeris(60.0), np.array([2.0]))
        qx, qy, qz, qw = start.quaternion[0].tolist()
        wx, wy, wz = start.rate[0].tolist()
        tip_off = TipOff(rate=(wx, wy, wz), attitude=(qx, qy, qz, qw))
        self.flight = FreeFlight(wanted["craft"], seed, "sso", tip_off, noises)
        self.flight.advance(0)
        self._filter = FreeFilter(self.flight.inertia, FreeFilterSettings())
        self._filter.start(
            self.flight.attitude(STAR_SIGMA),
            STAR_SIGMA**2 * np.eye(3),
            self._gyro(self.flight.motion.rate, 1.0),
        )
        self._law: PointingLaw | None = None
        self._begun = 0.0
        self._ahead: Ephemeris | None = None
        self._stars: FloatArray | None = None
        self._notes: list[list[float]] = []
        self._lost = False
        self._rate_then: FloatArray = np.zeros(3)

    def cycle(self, time: float) -> bool:
        """Fly one cycle; return whether the craft still points."""
        flight, found = self.flight, self._filter
        if self._law is None or time - self._begun >= TABLE_EVERY:
            self._plan(time)
        around = self._around(time)
        flight.act(np.zeros(3))
        before = flight.motion.rate
        flight.advance(round((time + PAUSE) * SECOND))
        found.advance(PAUSE, np.zeros(3), around)
        noise = (FIELD_NOISE**2 + (3e-8) ** 2) * np.eye(3)
        found.field(flight.field(), around.field, noise)
        dipole = self._command(time + PAUSE, around)
        flight.act(dipole)
        acting = flight.motion.rate
        flight.advance(round((time + CYCLE) * SECOND))
        found.advance(CYCLE - PAUSE, dipole, around)
        # The mean over the cycle, compared with the rate at its end.
        mean = 0.5 * PAUSE / CYCLE * (before + acting) + 0.5 * (1.0 - PAUSE / CYCLE) * (
            acting + flight.motion.rate
        )
        slope = (found.rate - self._rate_then) / CYCLE
        found.gyro(self._gyro(mean, CYCLE), GYRO_NOISE**2 / CYCLE * np.eye(3), 0.5 * CYCLE * slope)
        self._see_stars(time + CYCLE)
        return not self._lost

    def _command(self, time: float, around: Around) -> FloatArray:
        found = self._filter
        assert self._law is not None
        self._rate_then = found.rate
        plain = self._parameters["law"] == "plain"
        field = attitude_matrix(found.quaternion) @ around.field
        residual = found.residual_dipole(around.sunlit) * (not plain)
        sizes = found.torque_sizes * (not plain)
        dipole = self._law.command(
            time - self._begun, found.quaternion, found.rate, field, residual, sizes
        ).dipole
        if round(time / CYCLE) % 5 == 0:
            self._note(time)
        return dipole

    def _note(self, time: float) -> None:
        """Note the true error against the law, and the filter's own errors."""
        flight, found = self.flight, self._filter
        assert self._ahead is not None
        wanted = LAW.attitudes(self._ahead, np.array([time - self._begun]))[0]
        turn = to_rotation_vector(multiply(flight.motion.quaternion, conjugate(wanted)))
        error = to_rotation_vector(multiply(flight.motion.quaternion, conjugate(found.quaternion)))
        both = np.concatenate([error, flight.gyro_bias - found.gyro_bias])
        pick = np.r_[TURN, GYRO]
        nees = float(both @ np.linalg.solve(found.covariance[np.ix_(pick, pick)], both)) / 6.0
        truth = flight.body.orbit_truth()
        missing = truth.residual_dipole - found.residual_dipole(truth.sunlit)
        known, unknown = float(np.linalg.norm(error)), float(np.linalg.norm(missing))
        self._notes.append([time, *turn, known, nees, unknown, truth.sunlit])
        self._lost = float(np.linalg.norm(turn)) > LOST

    def _plan(self, time: float) -> None:
        flight = self.flight
        ahead = flight.ephemeris(PREVIEW + 4.0 * KNOT)
        times = np.arange(2.0, PREVIEW, KNOT)
        wanted = references(LAW.attitudes, ahead, times)
        to_body = np.array([attitude_matrix(q) for q in wanted.quaternion])
        shape = shapes(pressures(ahead, times), to_body)
        position, field = ahead.position_at(times), ahead.field_at(times)
        weights = WEIGHTS[self._parameters["craft"]]
        table = pointing_table(wanted, flight.inertia, field, position, shape, weights)
        self._law, self._begun, self._ahead = PointingLaw(table, flight.limit), time, ahead

    def _around(self, time: float) -> Around:
        assert self._ahead is not None
        at = np.array([time - self._begun + 0.5 * CYCLE])
        ahead = self._ahead
        lit = float(ahead.sunlit_at(at)[0])
        return Around(ahead.field_at(at)[0], ahead.position_at(at)[0], pressures(ahead, at), lit)

    def _see_stars(self, time: float) -> None:
        """Give the filter the attitude that was exposed a cycle ago; expose the next."""
        if self._stars is not None and time % STARS_EVERY < CYCLE:
            self._filter.attitude(self._stars, STAR_SIGMA**2 * np.eye(3), CYCLE)
        self._stars = self.flight.attitude(STAR_SIGMA)

    def _gyro(self, rate: FloatArray, seconds: float) -> FloatArray:
        flight = self.flight
        noise = GYRO_NOISE / np.sqrt(seconds) * flight.generator.standard_normal(3)
        return np.asarray(rate + flight.gyro_bias + noise)

    def result(self) -> Result:
        """Return rms errors after the first revolution, deg, and what they cost."""
        notes = np.array(self._notes)
        judged = notes[notes[:, 0] > REVOLUTION]
        facts: dict[str, Any] = {
            **self._parameters,
            "lost": bool(self._lost),
            "hours": float(notes[-1, 0] / 3600.0),
        }
        if len(judged):
            turns = np.degrees(judged[:, 1:4])
            lit = judged[:, 7] > 0.5
            facts |= {
                "rms": float(np.sqrt(np.mean(np.sum(turns**2, axis=1)))),
                "nadir_rms": float(np.sqrt(np.mean(np.sum(turns[:, :2] ** 2, axis=1)))),
                "worst": float(np.linalg.norm(turns, axis=1).max()),
                "knowledge_rms": float(np.degrees(np.sqrt(np.mean(judged[:, 4] ** 2)))),
                "nees": float(np.mean(judged[:, 5])),
                "dipole_missing": [_rms(judged[at, 6]) for at in (lit, ~lit)],
                "mean_square": self.flight.square / (self.flight.time_ns / SECOND),
            }
        return facts


def _rms(values: FloatArray) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return pointing errors by craft and share."""
    facts: dict[str, Any] = {}
    heads = (
        "runs",
        "lost",
        "median",
        "worst run",
        "nadir",
        "largest",
        "known",
        "NEES",
        "dipole",
        "mW",
        "wanted",
    )
    lines = [f"{'craft, share, law':26}" + "".join(f"{head:>10}" for head in heads)]
    for craft, share, law, wanted in CELLS:
        mine = [r for r in results if (r["craft"], r["share"], r["law"]) == (craft, share, law)]
        judged = [r for r in mine if "rms" in r]
        if not judged:
            continue
        rms = [r["rms"] for r in judged]
        found = {
            "runs": len(mine),
            "lost": sum(r["lost"] for r in mine),
            "median": float(np.median(rms)),
            "worst_run": float(max(rms)),
            "nadir": float(np.median([r["nadir_rms"] for r in judged])),
            "largest": float(max(r["worst"] for r in judged)),
            "known": float(np.median([r["knowledge_rms"] for r in judged])),
            "nees": float(np.mean([r["nees"] for r in judged])),
            "dipole": float(np.median([r["dipole_missing"][0] for r in judged if r["dipole_missing"][0]])),
            "milliwatts": 1e3 * WATTS[craft] * float(np.median([r["mean_square"] for r in judged])),
            "wanted": wanted,
        }
        facts[f"{craft}/{share}/{law}"] = found
        row = [f"{found[name]:10.3g}" for name in list(found)[2:10]]
        counts = f"{f'{craft}, {share}, {law}':26}{found['runs']:10d}{found['lost']:10d}"
        lines.append(counts + "".join(row) + f"{wanted or '':>10}")
    lines.append(
        "deg rms of three axes and of nadir alone, largest error, deg known; A m^2 not known in sunlight"
    )
    return Summary("\n".join(lines) + "\n", facts)


ORBIT_POINTING = Campaign(
    "orbit-pointing",
    "nadir along the flight by coils alone, estimated attitude, all disturbances",
    cases,
    run,
    summarise,
    20,
)
