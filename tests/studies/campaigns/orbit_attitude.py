"""Campaign `orbit-attitude`: errors, sigmas and NEES of a direction filter over one orbit with an eclipse.

Each run is one revolution from sunrise to sunrise (`orbit_world`) through `direction_filter`; its last 36
minutes are dark. Some variants lose a sensor, or all cameras, permanently after ten minutes; one has worse
gyros. The NEES is that of attitude and gyro bias divided by six, over independent runs; 1 is expected.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flight.schema.reader import replace
from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.geomagnetism import field as believed_field
from knightcube.astro.quaternion import conjugate, multiply
from knightcube.astro.quaternion import to_rotation_vector as rotation_vector
from knightcube.gnc.estimation.estimate import ATTITUDE, BIAS, Estimate
from tests.studies.campaigns.direction_filter import AttitudeDetermination, DeterminationSettings
from tests.support import orbit_world
from tests.support.consistency_worlds import band
from tests.support.orbit_geometry import suite as suite_of
from tests.support.orbit_world import OPTICAL_SIGMA, PUSH_WALK, STEP, Readings, World
from tests.support.sensor_suite import SensorSuite

SETTLED = 300.0
"""Time (s) after which the errors in sunlight are evaluated."""
WHENS = {"both": "Sun and nadir in view", "sunlit": "all sunlight", "eclipse": "end of eclipse"}


def variant_facts(results: Sequence[Result]) -> dict[str, Any]:
    """Return the results of the runs of one variant."""
    parts = [_parts(np.array(result["notes"])) for result in results]
    low, high = band(len(results) * 6)
    # Only instants that all runs have are used. They are counted from the end, where all eclipses end.
    shortest = min(len(result["notes"]) for result in results)
    nees = np.array([np.array(result["notes"])[-shortest:, 8] for result in results])
    # Only instants at which every run has an attitude are used, because the confidence band is for this
    # number of runs.
    whole = np.all(np.isfinite(nees), axis=0)
    whole[: round(SETTLED / 10.0)] = False
    settled = np.mean(nees[:, whole], axis=0) / 6.0
    kinds = sorted({kind for result in results for kind in result["nis"]})
    return {
        "runs": len(results),
        **{name: _figures(parts, name) for name in WHENS},
        "nees_band": [low, high],
        "share_in_band": float(np.mean((settled >= low) & (settled <= high))),
        "nees_mean": float(np.mean(settled)),
        "nis": {
            kind: float(np.divide(*np.sum([r["nis"].get(kind, [0.0, 0.0]) for r in results], axis=0)))
            for kind in kinds
        },
        "refused": {kind: sum(r["refused"].get(kind, 0) for r in results) for kind in kinds},
        "starts": max(result["starts"] for result in results),
        "never": sum(result["starts"] == 0 for result in results),
    }


def _parts(notes: FloatArray) -> dict[str, float]:
    """Return rms errors per axis (deg), claimed errors (deg), and NEES by part of the orbit.

    In part "both" Sun and nadir are in use, "sunlit" is all sunlight, and "eclipse" the last minute of the
    eclipse.
    """
    seconds, sunlit = notes[:, 0], notes[:, 1] > 0.5
    error, sigma, nees = notes[:, 2:5], notes[:, 5:8], notes[:, 8] / 6.0
    day = sunlit & (seconds >= SETTLED)
    end = ~sunlit & (seconds > seconds[-1] - 60.0)
    found = {}
    both = day & (notes[:, 9] > 0.5)
    for name, when in (("both", both), ("sunlit", day), ("eclipse", end)):
        found[name] = _rms(error[when])
        found[f"{name} said"] = _rms(sigma[when])
        found[f"{name} NEES"] = float(np.nanmean(nees[when])) if np.any(np.isfinite(nees[when])) else np.nan
    return found


def _figures(parts: Sequence[dict[str, float]], name: str) -> dict[str, float | None]:
    """Return the rms error of all runs and of the worst run, the median claimed error, and the mean NEES."""
    rms = np.array([part[name] for part in parts])
    known = rms[np.isfinite(rms)]
    if not known.size:
        return {"rms": None, "worst": None, "said": None, "nees": None}
    return {
        "rms": float(np.sqrt(np.mean(known**2))),
        "worst": float(np.max(known)),
        "said": float(np.sqrt(np.nanmean([part[f"{name} said"] ** 2 for part in parts]))),
        "nees": float(np.nanmean([part[f"{name} NEES"] for part in parts])),
    }


def _rms(values: FloatArray) -> float:
    """Return the root mean square per axis of rows (n, 3)."""
    return float(np.sqrt(np.nanmean(values**2))) if np.any(np.isfinite(values)) else float("nan")


SUITE = "uw"
LOST_AT = 600.0
"""Time (s) at which a variant loses its sensor."""
VARIANTS: dict[str, frozenset[str]] = {
    "all sensors": frozenset(),
    "no magnetometer": frozenset({"field"}),
    "no Sun": frozenset({"sun"}),
    "no nadir": frozenset({"nadir"}),
    "no cameras": frozenset({"sun", "nadir"}),
    "no gyros": frozenset({"gyro"}),
    "restless gyros": frozenset(),
}
RESTLESS = {"bias_walk": 3.5e-6}
"""Random walk of the gyro bias (rad/s per sqrt(s)): 0.002 deg/s in 100 s, which is the short-term
stability of gyros like the QRS-11, interpreted as a random walk.
"""
SECOND = 1_000_000_000
NOTED = round(10.0 / STEP)
"""Number of steps between two recorded samples."""


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` orbits of each variant, in the same worlds."""
    return [
        Case(
            f"{variant}/{run}",
            (seed, run),
            {"variant": variant, **(RESTLESS if variant == "restless gyros" else {})},
        )
        for variant in VARIANTS
        for run in range(runs)
    ]


def settings_of(suite: SensorSuite) -> DeterminationSettings:
    """Return the filter's settings: the noise of the suite, and the disturbance torques of the body."""
    assert suite.gyros is not None
    assert suite.magnetometer is not None
    return DeterminationSettings(
        inertia=np.diag(suite.inertia),
        rate_sigma=suite.gyros.noise / np.sqrt(STEP),
        bias_start=suite.gyros.bias_start,
        bias_walk=suite.gyros.bias_walk,
        field_sigma=suite.magnetometer.noise,
        field_bias_start=suite.magnetometer.bias_start,
        field_bias_walk=suite.magnetometer.bias_walk,
        disturbance_start=3.0 * PUSH_WALK / np.sqrt(orbit_world.AGILITY),
        disturbance_walk=PUSH_WALK,
        longest_step=STEP,
    )


def run(case: Case) -> Result:
    """Simulate one orbit."""
    rng = np.random.default_rng(case.seed)
    suite = _suite(case)
    truth = orbit_world.world(suite, rng, case.parameters.get("seconds"))
    said = orbit_world.readings(suite, truth, rng)
    flown = _Flight(suite, truth, said, case)
    for step in range(1, len(truth.attitudes)):
        flown.step(step)
    return flown.result()


def _suite(case: Case) -> SensorSuite:
    """Return the sensor suite of a case."""
    suite = suite_of(case.parameters.get("suite", SUITE))
    walk = case.parameters.get("bias_walk")
    if walk is None or suite.gyros is None:
        return suite
    return replace(suite, gyros=replace(suite.gyros, bias_walk=walk))


class _Flight:
    """One orbit through the filter, with a recorded sample every ten seconds."""

    def __init__(self, suite: SensorSuite, truth: World, said: Readings, case: Case) -> None:
        self._truth, self._said, self._case = truth, said, case
        self._lost = VARIANTS[case.parameters["variant"]]
        self._lost_at = case.parameters.get("lost_at", LOST_AT)
        self._every = {
            "camera": round(1.0 / suite.camera_rate_hz / STEP),
            "field": round(1.0 / (suite.magnetometer.rate_hz if suite.magnetometer else 1.0) / STEP),
        }
        claimed = case.parameters.get("claimed", 1.0)
        self._covariance = claimed * OPTICAL_SIGMA**2 * np.eye(3)
        self._dates = orbit_world.dates(truth.pass_)
        self._filter = AttitudeDetermination(settings_of(suite))
        self._notes: list[tuple[float, ...]] = []
        self._status: list[str] = []
        self._nis: dict[str, list[float]] = {}

    def step(self, k: int) -> None:
        """Give the filter the measurements of instant k."""
        truth, said = self._truth, self._said
        seconds = float(truth.pass_.times[k] - truth.pass_.times[0])
        now_ns = round(seconds * SECOND)
        lost = self._lost if seconds >= self._lost_at else frozenset()
        # A gyro sample is the mean rate over its period, which is the rate at mid-period.
        if "gyro" not in lost:
            self._filter.rate(now_ns - round(0.5 * STEP * SECOND), said.gyro[k])
            self._count("gyro", 3)
        position = truth.pass_.positions[k]
        if k % self._every["camera"] == 0:
            if truth.sun_in_field[k] and "sun" not in lost:
                self._filter.direction("sun", now_ns, said.sun[k], truth.sun[k], self._covariance)
                self._count("sun", 2)
            if truth.nadir_in_field[k] and "nadir" not in lost:
                down = -position / np.linalg.norm(position)
                self._filter.direction("nadir", now_ns, said.nadir[k], down, self._covariance)
                self._count("nadir", 2)
        if k % self._every["field"] == 0 and "field" not in lost:
            self._filter.field(now_ns, said.magnetometer[k], believed_field(float(self._dates[k]), position))
            self._count("field", 3)
        if k % NOTED == 0:
            self._note(k, seconds, now_ns)

    def _count(self, kind: str, degrees: int) -> None:
        if np.isfinite(self._filter.nis):
            total = self._nis.setdefault(kind, [0.0, 0.0])
            total[0] += self._filter.nis
            total[1] += degrees

    def _note(self, k: int, seconds: float, now_ns: int) -> None:
        report = self._filter.report(now_ns)
        self._status.append(report.status.value)
        if report.estimate is None:
            self._notes.append((seconds, float(self._truth.sunlit[k]), *[np.nan] * 7, 0.0))
            return
        turn, nees = errors_of(report.estimate, self._truth.attitudes[k], self._said.gyro_bias[k])
        self._notes.append(
            (
                seconds,
                float(self._truth.sunlit[k]),
                *np.degrees(turn),
                *np.degrees(report.sigma),
                nees,
                float({"sun", "nadir"} <= report.in_use),
            )
        )

    def result(self) -> Result:
        """Return the samples: time, sunlit, errors (3) and sigmas (3), deg, NEES, Sun and nadir in use."""
        notes = np.array(self._notes)
        return {
            **self._case.parameters,
            "notes": np.round(notes, 6).tolist(),
            "status": self._status,
            "nis": self._nis,
            "refused": self._filter.refused,
            "starts": self._filter.starts,
        }


def errors_of(estimate: Estimate, attitude: FloatArray, bias: FloatArray) -> tuple[FloatArray, float]:
    """Return the attitude error (3,), rad, in body axes, and the NEES of attitude and gyro bias."""
    turn = rotation_vector(multiply(attitude, conjugate(estimate.quaternion)))
    error = np.concatenate([turn, bias - estimate.bias])
    pick = np.r_[ATTITUDE, BIAS]
    covariance = estimate.covariance[np.ix_(pick, pick)]
    scale = np.sqrt(np.diag(covariance))
    whitened = error / scale
    return turn, float(whitened @ np.linalg.solve(covariance / np.outer(scale, scale), whitened))


def summarise(results: Sequence[Result], out: Path) -> Summary:
    """Return accuracy and NEES of each variant, and the plot of one orbit."""
    facts: dict[str, Any] = {}
    for variant in VARIANTS:
        mine = [result for result in results if result["variant"] == variant]
        if mine:
            facts[variant] = variant_facts(mine)
    return summary(facts)


ORBIT_ATTITUDE = Campaign(
    "orbit-attitude",
    "Sun, nadir, field and gyros through the filter over one orbit with eclipse",
    cases,
    run,
    summarise,
    20,
)
