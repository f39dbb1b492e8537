"""Attitude from gyros, Sun, nadir and magnetic field (Meller et al., section 2 and Fig. 3).

Gyros propagate the attitude, and directions correct attitude and bias. The filter is `AttitudeFilter` of
`knightcube.gnc.estimation` for a free body in orbit. It starts from the first directions that agree and
determine the attitude accurately enough. Then it uses each measurement of Sun, nadir and field at the time of
the measurement. It estimates the magnetometer's bias together with the field model's error, which changes
equally slowly. In eclipse it uses the bias that was estimated in sunlight. Flights do not use this filter;
the campaigns `orbit-attitude` and `orbit-frames` measure it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.special import chdtri

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.solvers import VectorObservation, field_observation, weighted_fit
from knightcube.astro.attitude.wahba import AttitudeError, AttitudeFix
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter, FilterSettings
from knightcube.gnc.estimation.estimate import (
    ATTITUDE,
    FIELD_BIAS,
    AttitudeMeasurement,
    DirectionMeasurement,
    Estimate,
    FieldMeasurement,
    RateMeasurement,
)
from knightcube.gnc.estimation.rigid_body import RigidBody

FIELD = "field"
_UNIT_TOLERANCE = 1e-6
_HISTORY_NS = 6_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DeterminationSettings:
    """Sensor noise, body and limits.

    Attributes:
        inertia: inertia tensor (3, 3), kg m^2, body axes.
        rate_sigma: standard deviation of a gyro sample, rad/s.
        bias_start, bias_walk: initial gyro bias, rad/s, and its random walk, rad/s per sqrt(s).
        field_sigma: standard deviation of a magnetometer sample, T.
        field_bias_start, field_bias_walk: magnetometer bias with the model's error, T, and its random walk, T
            per sqrt(s).
        disturbance_start, disturbance_walk: torque over inertia, rad/s^2, and its random walk, rad/s^2 per
            sqrt(s).
        start_sigma: largest standard deviation of the worst axis at the start, rad.
        start_age: largest age of directions at the start, s.
        lost_sigma: standard deviation, rad, above which the estimate is discarded, because the linearisation
            is then invalid.
        fresh: longest time without accepted measurements for which a sensor counts as in use, s.
        gate_sigma: rejection threshold of measurements, in sigma.
        longest_step: longest step of the filter, s.
    """

    inertia: FloatArray
    rate_sigma: float
    bias_start: float
    bias_walk: float
    field_sigma: float
    field_bias_start: float
    field_bias_walk: float
    disturbance_start: float
    disturbance_walk: float
    start_sigma: float = math.radians(5.0)
    start_age: float = 2.0
    lost_sigma: float = math.radians(6.0)
    fresh: float = 5.0
    gate_sigma: float = 5.0
    longest_step: float = 0.5


class Status(Enum):
    """The sensors on which the attitude is based."""

    ACQUIRING = "acquiring"
    """The available directions do not yet determine the attitude."""
    OBSERVED = "observed"
    """At least two directions are in use, with or without the field."""
    AIDED = "aided"
    """One direction is in use; the rotation about it drifts with the gyros until the direction changes."""
    COASTING = "coasting"
    """Only the gyros are in use."""


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """The attitude at `time_ns` and its accuracy.

    Attributes:
        estimate: None while acquiring.
        sigma: standard deviations (3,) about the body axes, rad; infinite while acquiring.
        in_use: the sensors with recent accepted measurements, without the gyros.
    """

    time_ns: int
    status: Status
    estimate: Estimate | None
    sigma: FloatArray
    in_use: frozenset[str]


@dataclass(frozen=True, slots=True, eq=False)
class _Waiting:
    """A direction that was measured before the first attitude."""

    time_ns: int
    observation: VectorObservation


class AttitudeDetermination:
    """State of the filter, or the directions from which it will start.

    Attributes:
        refused: number of rejected measurements of each sensor.
        starts: number of starts of the filter.
        nis: normalised innovation squared of the last measurement, NaN without one.
    """

    def __init__(self, settings: DeterminationSettings) -> None:
        self._settings = settings
        self._body = RigidBody(settings.inertia, 0.0, np.zeros(3))
        self._filter = self._new_filter()
        self._waiting: dict[str, _Waiting] = {}
        self._taken_ns: dict[str, int] = {}
        self._rate: RateMeasurement | None = None
        self.refused: dict[str, int] = {}
        self.starts = 0
        self.nis = math.nan

    def rate(self, time_ns: int, rate: FloatArray) -> None:
        """Accept the gyros' rate (3,) rad/s, body axes."""
        self.nis = math.nan
        if not np.all(np.isfinite(rate)):
            return
        self._rate = RateMeasurement(time_ns, rate, self._settings.rate_sigma**2 * np.eye(3))
        if self._filter.started:
            self._ingest("gyro", self._rate)

    def direction(
        self, sensor: str, time_ns: int, observed: FloatArray, reference: FloatArray, covariance: FloatArray
    ) -> None:
        """Accept a direction: unit vectors (3,) in body and inertial axes, covariance (3, 3) rad^2, body.

        `sensor` is any name except that of the field.
        """
        self.nis = math.nan
        if not (_is_unit(observed) and _is_unit(reference) and np.all(np.isfinite(covariance))):
            self._refuse(sensor)
        elif self._filter.started:
            self._ingest(sensor, DirectionMeasurement(time_ns, observed, reference, covariance))
        else:
            self._wait(sensor, time_ns, VectorObservation(observed, reference, covariance))

    def field(self, time_ns: int, field: FloatArray, reference: FloatArray) -> None:
        """Accept the magnetometer's field (3,), T, body axes, and the model's field `reference` (3,), T."""
        self.nis = math.nan
        settings = self._settings
        if not (np.all(np.isfinite(field)) and np.all(np.isfinite(reference))):
            self._refuse(FIELD)
        elif self._filter.started:
            covariance = settings.field_sigma**2 * np.eye(3)
            self._ingest(FIELD, FieldMeasurement(time_ns, field, reference, covariance))
        else:
            # The bias affects the first attitude and the next sample, which the filter treats as independent.
            # Twice the bias's sigma gives the first attitude the correct weight.
            spread = settings.field_sigma**2 + (2.0 * settings.field_bias_start) ** 2
            try:
                self._wait(FIELD, time_ns, field_observation(field, reference, spread * np.eye(3)))
            except AttitudeError:
                self._refuse(FIELD)

    def report(self, time_ns: int) -> Report:
        """Return the attitude at `time_ns` and its accuracy; discard an estimate that is too uncertain."""
        fresh_ns = round(self._settings.fresh * 1e9)
        in_use = frozenset(name for name, then in self._taken_ns.items() if time_ns - then <= fresh_ns)
        estimate = self._filter.at(time_ns) if self._filter.started else None
        if estimate is not None:
            sigma = np.sqrt(np.diag(estimate.covariance)[ATTITUDE])
            if float(np.max(sigma)) < self._settings.lost_sigma:
                return Report(time_ns, _status(in_use), estimate, sigma, in_use)
            self._filter = self._new_filter()
        return Report(time_ns, Status.ACQUIRING, None, np.full(3, np.inf), in_use)

    def _ingest(
        self, sensor: str, measurement: RateMeasurement | DirectionMeasurement | FieldMeasurement
    ) -> None:
        if self._filter.measure(measurement):
            if sensor != "gyro":
                self._taken_ns[sensor] = max(measurement.time_ns, self._taken_ns.get(sensor, 0))
        else:
            self._refuse(sensor)
        self.nis = self._filter.nis

    def _refuse(self, sensor: str) -> None:
        self.refused[sensor] = self.refused.get(sensor, 0) + 1

    def _wait(self, sensor: str, time_ns: int, observation: VectorObservation) -> None:
        """Store a direction, and start if the stored directions determine an attitude."""
        self._waiting[sensor] = _Waiting(time_ns, observation)
        oldest_ns = time_ns - round(self._settings.start_age * 1e9)
        self._waiting = {name: w for name, w in self._waiting.items() if w.time_ns >= oldest_ns}
        if self._rate is None or self._rate.time_ns < oldest_ns or len(self._waiting) < 2:
            return
        fix = begin([self._moved(waiting, time_ns) for waiting in self._waiting.values()])
        if fix is None or float(np.max(np.diag(fix.covariance))) > self._settings.start_sigma**2:
            return
        attitude = AttitudeMeasurement(time_ns, fix.quaternion, fix.covariance)
        self._filter = self._new_filter()
        self._filter.start(attitude, self._rate)
        self._taken_ns = {name: w.time_ns for name, w in self._waiting.items()}
        self._waiting = {}
        self.starts += 1

    def _moved(self, waiting: _Waiting, time_ns: int) -> VectorObservation:
        """Return a stored direction at `time_ns`.

        Its covariance includes the body rotation since its measurement.
        """
        assert self._rate is not None
        rate = float(np.linalg.norm(self._rate.rate)) + 3.0 * self._settings.bias_start
        turned = rate * (time_ns - waiting.time_ns) * 1e-9
        observation = waiting.observation
        return VectorObservation(
            observation.observed, observation.reference, observation.covariance + turned**2 * np.eye(3)
        )

    def _new_filter(self) -> AttitudeFilter:
        settings = self._settings
        return AttitudeFilter(
            self._body,
            FilterSettings(
                current_noise=0.0,
                control_period=1.0,
                disturbance_walk=settings.disturbance_walk,
                disturbance_start=settings.disturbance_start,
                bias_walk=settings.bias_walk,
                bias_start=settings.bias_start,
                torsion_start=0.0,
                damping_start=0.0,
                gain_start=0.0,
                latency_start=0.0,
                latency_walk=0.0,
                field_bias_start=settings.field_bias_start,
                field_bias_walk=settings.field_bias_walk,
                gate_sigma=settings.gate_sigma,
                history_ns=_HISTORY_NS,
                longest_step=settings.longest_step,
            ),
        )


def begin(observations: Sequence[VectorObservation], improbable: float = 1e-4) -> AttitudeFix | None:
    """Return the attitude from directions, or None if they contradict each other or do not determine it.

    The angles between the n directions must agree with those between their references, by a chi-square test
    with 2 n - 3 degrees of freedom.
    """
    try:
        fix = weighted_fit(observations)
    except (AttitudeError, np.linalg.LinAlgError):
        return None
    return fix if 2.0 * fix.loss <= float(chdtri(2 * len(observations) - 3, improbable)) else None


def field_bias(estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return the magnetometer's bias, (3,) T body axes, and its sigmas (3,)."""
    return estimate.field_bias, np.sqrt(np.diag(estimate.covariance)[FIELD_BIAS])


def _status(in_use: frozenset[str]) -> Status:
    if len(in_use) >= 2:
        return Status.OBSERVED
    return Status.AIDED if in_use else Status.COASTING


def _is_unit(vector: FloatArray) -> bool:
    # A vector with a NaN also fails this comparison.
    return vector.shape == (3,) and abs(float(np.linalg.norm(vector)) - 1.0) <= _UNIT_TOLERANCE
