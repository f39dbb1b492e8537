"""Flights that compare the filter's errors with its covariance: NEES and NIS with all disturbances.

The worlds are sim_hal's testbed and a body that is free in orbit. The testbed has a thread of 0 to 2e-5 N
m/rad and 0 to 4e-6 N m s/rad, which the filter does not know, and an aerodynamic torque. A controller that
uses the estimate moves the testbed through steps of q2. The free body rotates about three axes from a random
attitude, with a random walk of the torque and a rotating field. The coils' gain has an error of 10 % (1
sigma).

The VN-100 gives attitude and rate at 40 Hz with uniform noise and a constant gyro bias. The VN-100 loses 2 %
of its packets, and sends nothing in two intervals of 0.5 to 1 s. Every 5 s the star camera gives the mean
rate over 1 s with a full covariance if the stars are streaks, and on the free body also an attitude. The
camera's results are delayed by 0.2 to 0.6 s.

NEES divided by its degrees of freedom is 1 for a correct covariance; the 95 % band follows from the
chi-square of independent runs. NIS over all accepted measurements, divided by its degrees of freedom, has a
similar band.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from flight.bodies.testbed.control import about_thread
from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.quaternion import (
    IDENTITY,
    NED_TO_TESTBED,
    attitude_map,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter
from knightcube.gnc.estimation.estimate import (
    AttitudeMeasurement,
    Estimate,
    MeanRateMeasurement,
    Measurement,
    RateMeasurement,
)
from knightcube.gnc.estimation.rigid_body import RigidBody
from sim_hal.emulators.vn100_sensors import NoiseProfile, Sensors
from sim_hal.worlds.world import BodyMotion
from tests.support.consistency_worlds import (
    CYCLE_NS,
    DIPOLE,
    DRAG,
    DRAUGHT,
    GAIN_SIGMA,
    INERTIA,
    KNOWN_PLANT,
    MOST_DAMPING,
    MOST_STIFFNESS,
    TESTBED_FIELD,
    FreeWorld,
    SuspendedWorld,
    World,
)

Result = dict[str, Any]

QUATERNION_BOUND, RATE_BOUND = 1.75e-3, 1.75e-4
EXPOSURE, CAMERA_PERIOD = 40, 200
"""Exposure and period of the camera in cycles."""
LEAST_STREAK = 1.0e-3
"""Length (rad) of the shortest measurable streak, 3 px in a field of 20 deg."""
RATE_SIGMAS: FloatArray = np.array([1.5e-5, 1.5e-5, 1.5e-4])
TRACKER_SIGMAS: FloatArray = np.array([5e-5, 5e-5, 5e-4])


class Unit:
    """The sensors of an emulated VN-100, aligned with the body, at the position of the testbed.

    `claimed` is the ratio of stated to true variances.
    """

    def __init__(self, rng: np.random.Generator, bias: FloatArray, claimed: float = 1.0) -> None:
        profile = NoiseProfile(attitude_bound=QUATERNION_BOUND, rate_bound=RATE_BOUND)
        self._sensors = Sensors(rng, profile, IDENTITY, NED_TO_TESTBED, bias)
        self._map = attitude_map(IDENTITY, NED_TO_TESTBED)
        self._attitude_covariance = np.eye(3) * claimed * (2.0 * QUATERNION_BOUND) ** 2 / 3.0
        self._rate_covariance = np.eye(3) * claimed * RATE_BOUND**2 / 3.0

    def sample(self, now_ns: int, world: World) -> tuple[AttitudeMeasurement, RateMeasurement]:
        """Return the present reading of the IMU."""
        motion = BodyMotion(now_ns, world.attitude, world.rate, np.zeros(3), np.zeros(3))
        said = self._sensors.measure(motion, (1, 1, 1))
        return (
            AttitudeMeasurement(now_ns, self._map @ said.quaternion, self._attitude_covariance),
            RateMeasurement(now_ns, said.rate, self._rate_covariance),
        )


class Camera:
    """A star camera with a random mounting and delayed results."""

    def __init__(self, rng: np.random.Generator, tracks: bool) -> None:
        self._rng = rng
        self._tracks = tracks
        self._axes = random_axes(rng)
        self._started: FloatArray = IDENTITY
        self._late: list[tuple[int, str, Measurement]] = []

    def due(self, cycle: int, world: World) -> list[tuple[str, Measurement]]:
        """Expose a frame, and return the results that have arrived by `cycle`."""
        phase = cycle % CAMERA_PERIOD
        if phase == 1:
            self._started = world.attitude
        elif phase == 1 + EXPOSURE // 2 and self._tracks:
            error, covariance = seen_from(self._axes, TRACKER_SIGMAS, self._rng)
            seen = multiply(from_rotation_vector(error), world.attitude)
            measured = AttitudeMeasurement(cycle * CYCLE_NS, seen, covariance)
            self._send(cycle + EXPOSURE // 2, "star tracker", measured)
        elif phase == 1 + EXPOSURE:
            begin_ns, span = (cycle - EXPOSURE) * CYCLE_NS, EXPOSURE * CYCLE_NS * 1e-9
            rate = mean_rate(self._started, world.attitude, span)
            if np.linalg.norm(rate) * span > LEAST_STREAK:
                error, covariance = seen_from(self._axes, RATE_SIGMAS, self._rng)
                measured_rate = MeanRateMeasurement(begin_ns, cycle * CYCLE_NS, rate + error, covariance)
                self._send(cycle, "streaks", measured_rate)
        come = [(kind, m) for at, kind, m in self._late if at <= cycle]
        self._late = [entry for entry in self._late if entry[0] > cycle]
        return come

    def _send(self, end: int, kind: str, measurement: Measurement) -> None:
        self._late.append((end + int(self._rng.integers(8, 25)), kind, measurement))


class Pilot:
    """Control by the estimate: steps of q2 of a suspended body, or excitation of all axes of a free body."""

    def __init__(self, rng: np.random.Generator, suspended: bool) -> None:
        self._suspended = suspended
        self._targets = rng.uniform(-0.6, 0.6, 64)
        self._frequency, self._phase = rng.uniform(0.1, 0.6, 3), rng.uniform(0.0, 6.28, 3)

    def currents(self, cycle: int, estimate: Estimate) -> FloatArray:
        """Return the coil currents (3,) in A."""
        if not self._suspended:
            swing = np.sin(self._frequency * cycle * CYCLE_NS * 1e-9 + self._phase)
            return np.asarray(0.1 * swing)
        now = about_thread(estimate)
        wanted = 0.5 * (self._targets[(cycle // 800) % 64] - now.angle) - 1.2 * now.rate - now.disturbance
        gain = DIPOLE * -TESTBED_FIELD[2] * np.cos(now.angle) / INERTIA[1, 1]
        return np.array([np.clip(wanted / gain, -0.148, 0.148), 0.0, 0.0])


def mean_rate(start: FloatArray, end: FloatArray, span: float) -> FloatArray:
    """Return the constant rate (3,) that rotates the attitude `start` into `end` in `span` s (Rodrigues)."""
    vector = np.array(
        [
            start[3] * end[0] - end[3] * start[0] - (end[2] * start[1] - end[1] * start[2]),
            start[3] * end[1] - end[3] * start[1] - (end[0] * start[2] - end[2] * start[0]),
            start[3] * end[2] - end[3] * start[2] - (end[1] * start[0] - end[0] * start[1]),
        ]
    )
    scalar = start @ end
    sine = float(np.linalg.norm(vector))
    angle = 2.0 * np.arctan2(sine, abs(scalar)) * np.sign(scalar)
    return np.asarray(vector / max(sine, 1e-300) * angle / span)


def seen_from(
    axes: FloatArray, sigmas: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return a random error (3,) and its covariance (3, 3).

    `sigmas` (3,) are the standard deviations of the error along the columns of `axes` (3, 3).
    """
    return axes @ (sigmas * rng.standard_normal(3)), (axes * sigmas**2) @ axes.T


def random_axes(rng: np.random.Generator) -> FloatArray:
    """Return three orthogonal directions (3, 3) as a random mounting of the camera."""
    return np.asarray(np.linalg.qr(rng.standard_normal((3, 3)))[0])


SECONDS = 100
BIAS_SIGMA = 1e-3
CURRENT_SIGMA = 3.5e-3 / np.sqrt(3.0)
COMMAND_DELAY_NS = 8_000_000
LOST_SHARE = 0.02


@dataclass(slots=True)
class Tally:
    """Sums of the statistics of one run."""

    nis: dict[str, list[float]] = field(default_factory=dict)
    nees: list[float] = field(default_factory=list)
    refused: dict[str, int] = field(default_factory=dict)

    def measured(self, filter_: AttitudeFilter, kind: str, measurement: Measurement) -> None:
        """Pass a measurement to the filter, and record whether it was used and its NIS."""
        used = filter_.measure(measurement)
        if np.isfinite(filter_.nis):
            self.nis.setdefault(kind, []).append(filter_.nis)
        self.refused[kind] = self.refused.get(kind, 0) + (not used)


def filter_of(world: World) -> AttitudeFilter:
    """Return the filter for a world, with the noise settings but without the unknown errors."""
    push = DRAUGHT if world.suspended else DRAG
    settings = replace(
        KNOWN_PLANT,
        current_noise=CURRENT_SIGMA,
        disturbance_walk=push.walk,
        disturbance_start=push.start,
        bias_start=BIAS_SIGMA,
        torsion_start=MOST_STIFFNESS / np.sqrt(3.0) / INERTIA[1, 1],
        gain_start=GAIN_SIGMA,
        damping_start=MOST_DAMPING / np.sqrt(3.0) / INERTIA[1, 1],
    )
    return AttitudeFilter(RigidBody(INERTIA, DIPOLE, TESTBED_FIELD, world.suspended), settings)


def run(scene: str, seed: tuple[int, ...], seconds: int = SECONDS, claimed: float = 1.0) -> Result:
    """Simulate `testbed` or `free`. `claimed` multiplies the assumed variances of the IMU."""
    rng = np.random.default_rng(seed)
    world: World = SuspendedWorld(rng) if scene == "testbed" else FreeWorld(rng)
    bias = rng.normal(0.0, BIAS_SIGMA, 3)
    filter_, tally = filter_of(world), Tally()
    silent = _drop_outs(rng, seconds)
    unit = Unit(rng, bias, claimed)
    camera = Camera(rng, tracks=not world.suspended)
    pilot = Pilot(rng, world.suspended)
    for cycle in range(seconds * 40 + 1):
        now_ns = cycle * CYCLE_NS
        heard = cycle == 0 or not (silent[cycle] or rng.random() < LOST_SHARE)
        attitude, rate = unit.sample(now_ns, world)
        if not filter_.started:
            filter_.start(attitude, rate)
        elif heard:
            tally.measured(filter_, "unit attitude", attitude)
            tally.measured(filter_, "gyro", rate)
        for kind, measurement in camera.due(cycle, world):
            tally.measured(filter_, kind, measurement)
        if not filter_.started:  # the filter has restarted
            filter_.start(attitude, rate)
        estimate = filter_.at(now_ns)
        if cycle and cycle % 40 == 0:
            tally.nees.append(_nees(estimate, world, bias))
        currents = pilot.currents(cycle, estimate)
        world.advance(COMMAND_DELAY_NS)
        world.command(currents)
        filter_.command(now_ns + COMMAND_DELAY_NS, currents, world.field())
        world.advance(CYCLE_NS - COMMAND_DELAY_NS)
    return _result(scene == "testbed", tally, bias, estimate)


def _result(suspended: bool, tally: Tally, bias: FloatArray, last: Estimate) -> Result:
    pick = _free_errors(suspended)
    sigmas = np.sqrt(np.diag(last.covariance))
    axes = [1] if suspended else [0, 1, 2]
    return {
        "degrees": len(pick),
        "nees": tally.nees,
        "nis": {kind: [float(np.sum(v)), len(v)] for kind, v in tally.nis.items()},
        "nis_degrees": len(axes),
        "refused": tally.refused,
        "bias_sigmas": [float((last.bias[a] - bias[a]) / sigmas[6 + a]) for a in axes],
    }


def _nees(estimate: Estimate, world: World, bias: FloatArray) -> float:
    """Return the NEES of the error states that can be non-zero in this simulated world."""
    turn = to_rotation_vector(multiply(world.attitude, conjugate(estimate.quaternion)))
    error = np.concatenate(
        [
            turn,
            world.rate - estimate.rate,
            bias - estimate.bias,
            world.disturbance - estimate.disturbance,
            np.array(world.parameters) - np.array(estimate.parameters),
        ]
    )
    pick = _free_errors(world.suspended)
    scale = np.sqrt(np.diag(estimate.covariance)[pick])
    correlation = estimate.covariance[np.ix_(pick, pick)] / np.outer(scale, scale)
    whitened = error[pick] / scale
    return float(whitened @ np.linalg.solve(correlation, whitened))


def _free_errors(suspended: bool) -> IntArray:
    """Return the indices of the 15 error states that can be non-zero in this simulated world."""
    return np.array([1, 4, 7, 10, 12, 13, 14]) if suspended else np.array([*range(12), 14])


def _drop_outs(rng: np.random.Generator, seconds: int) -> list[bool]:
    """Return for each cycle whether the IMU is silent. One interval is silent in each half of the run."""
    silent = [False] * (seconds * 40 + 1)
    for half in range(2):
        begin = int(40 * seconds * (0.5 * half + rng.uniform(0.05, 0.4)))
        for cycle in range(begin, begin + int(rng.uniform(20, 41))):
            silent[cycle] = True
    return silent


def scene_facts(results: Sequence[Result]) -> dict[str, Any]:
    """Return the statistics of all runs of one world."""
    degrees = results[0]["degrees"]
    nees = np.array([result["nees"] for result in results]) / degrees
    means = nees.mean(axis=0)
    kinds = sorted({kind for result in results for kind in result["nis"]})
    bias = np.abs([result["bias_sigmas"] for result in results])
    return {
        "degrees": degrees,
        "nees_final": float(means[-1]),
        "nees_mean": float(means.mean()),
        "nis": {kind: _nis(results, kind) for kind in kinds},
        "refused": {kind: sum(r["refused"].get(kind, 0) for r in results) for kind in kinds},
        "bias_worst_sigmas": float(bias.max()),
    }


def _nis(results: Sequence[Result], kind: str) -> dict[str, Any]:
    total, count = np.sum([result["nis"].get(kind, [0.0, 0]) for result in results], axis=0)
    degrees = int(count) * results[0]["nis_degrees"]
    return {"measurements": int(count), "mean": float(total) / degrees}
