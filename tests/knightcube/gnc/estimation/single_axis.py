"""A linear Kalman filter of the rotation about the suspension thread, a reference for the three-axis filter.

The states of the filter are angle, rate and disturbance. The angle theta = 2 asin q2 is used instead of q2,
because its kinematics are linear (Sease 5.9 is not): theta' = omega and omega' = u + d. The plant model gives
the acceleration u for the known current. The disturbance d, such as the torque of the suspension thread, is a
random walk. Each measurement is applied at its own time. After a late measurement, the later measurements are
applied again. A rate from a streaked image is the mean rate over its exposure. Until the exposure ends, the
angle at its start is an additional state (stochastic cloning, Roumeliotis and Burdick 2002), so an
acceleration within the exposure does not contradict the mean.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.plant import SingleAxisPlant

ANGLE, RATE = 0, 1


@dataclass(frozen=True, slots=True)
class Measurement:
    """One scalar measurement of state `component` (ANGLE or RATE) at `time_ns`, with its variance.

    If `since_ns` is given, the measurement is the mean rate from `since_ns` to `time_ns`.
    """

    time_ns: int
    component: int
    value: float
    variance: float
    since_ns: int | None = None

    @property
    def begin_ns(self) -> int:
        """Start time of the measured interval."""
        return self.time_ns if self.since_ns is None else self.since_ns


@dataclass(frozen=True, slots=True, eq=False)
class SingleAxisEstimate:
    """Angle (rad), rate (rad/s) and disturbance (rad/s^2) with their covariance (3, 3).

    `measured_ns` is the time of the newest measurement that the estimate uses.
    """

    time_ns: int
    angle: float
    rate: float
    disturbance: float
    covariance: FloatArray
    measured_ns: int


@dataclass(frozen=True, slots=True)
class SingleAxisSettings:
    """Noise and limits of the filter.

    Attributes:
        current_noise: standard deviation (A) of the error of the coil current, independent in each cycle.
        control_period: control period, s.
        disturbance_walk: random walk of the unmodelled acceleration, rad/s^2 per sqrt(s).
        disturbance_start: initial standard deviation of the unmodelled acceleration, rad/s^2.
        gate_sigma: largest normalised innovation of an accepted measurement.
        history_ns: largest delay of a usable measurement, ns.
    """

    current_noise: float
    control_period: float
    disturbance_walk: float
    disturbance_start: float = 0.02
    gate_sigma: float = 5.0
    history_ns: int = 6_000_000_000


@dataclass(slots=True)
class _Checkpoint:
    """A measurement, whether it passed the gate, and the state after it."""

    measurement: Measurement
    used: bool
    state: FloatArray
    covariance: FloatArray


class SingleAxisFilter:
    """The estimate, its recent measurements and the recent commands."""

    REJECTIONS_TO_RESTART = 40
    """Number of refused measurements in a row after which the filter restarts."""

    def __init__(self, plant: SingleAxisPlant, settings: SingleAxisSettings) -> None:
        self._plant = plant
        self._settings = settings
        gain = plant.torque_constant / plant.inertia
        self._rate_noise = (gain * settings.current_noise) ** 2 * settings.control_period
        self._history: list[_Checkpoint] = []
        self._command_times: list[int] = []
        self._commands: list[float] = []
        self._refused_in_a_row = 0
        self.refused = 0
        self.restarts = 0

    def command(self, time_ns: int, current: float) -> None:
        """Record the coil current, A, from `time_ns` on."""
        if self._commands and self._commands[-1] == current:
            return
        self._command_times.append(time_ns)
        self._commands.append(current)
        oldest = bisect.bisect_right(self._command_times, time_ns - self._settings.history_ns) - 1
        if oldest > 64:  # old commands are removed only occasionally, to save time
            del self._command_times[:oldest], self._commands[:oldest]

    def start(self, angle: Measurement, rate: Measurement) -> None:
        """Start the filter from an angle and a rate."""
        state = np.array([angle.value, rate.value, 0.0])
        covariance = np.diag([angle.variance, rate.variance, self._settings.disturbance_start**2])
        newest = max(angle, rate, key=lambda m: m.time_ns)
        self._history = [_Checkpoint(newest, True, state, covariance)]
        self._refused_in_a_row = 0

    @property
    def started(self) -> bool:
        """Whether the filter has an estimate."""
        return bool(self._history)

    def measure(self, measurement: Measurement) -> bool:
        """Apply a measurement at its own time; return whether it passed the gate or was too late."""
        if self._history and measurement.begin_ns >= self._history[-1].measurement.time_ns:
            used = self._apply([measurement], measurement)
        else:
            used = self._insert(measurement)
        self._count(used)
        self._forget(measurement.time_ns)
        return used

    def at(self, time_ns: int) -> SingleAxisEstimate:
        """Return the estimate propagated to `time_ns`, without a change of the filter."""
        last = self._history[-1]
        newest = next((c for c in reversed(self._history) if c.used), last)
        state, covariance = self._propagate(last.state, last.covariance, last.measurement.time_ns, time_ns)
        angle, rate, disturbance = (float(value) for value in state)
        return SingleAxisEstimate(time_ns, angle, rate, disturbance, covariance, newest.measurement.time_ns)

    def past(self, time_ns: int) -> SingleAxisEstimate | None:
        """Return the estimate at a past time, or None if the time precedes the stored history."""
        index = bisect.bisect_right(self._history, time_ns, key=lambda c: c.measurement.time_ns)
        if index == 0:
            return None
        then = self._history[index - 1]
        state, covariance = self._propagate(then.state, then.covariance, then.measurement.time_ns, time_ns)
        angle, rate, disturbance = (float(value) for value in state)
        return SingleAxisEstimate(time_ns, angle, rate, disturbance, covariance, then.measurement.time_ns)

    def _insert(self, measurement: Measurement) -> bool:
        """Go back to the start of a measurement, apply it, and apply the later measurements again."""
        index = self._index_before(measurement.begin_ns)
        if index == 0:
            return False
        later = [checkpoint.measurement for checkpoint in self._history[index:]]
        place = bisect.bisect_right(later, measurement.time_ns, key=lambda other: other.time_ns)
        later.insert(place, measurement)
        del self._history[index:]
        return self._apply(later, measurement)

    def _index_before(self, begin_ns: int) -> int:
        """Return the number of checkpoints before the time from which measurements are applied again.

        Measurements are applied again from `begin_ns`, or from the start of an averaging interval that
        contains `begin_ns`.
        """
        while True:
            index = bisect.bisect_right(self._history, begin_ns, key=lambda c: c.measurement.time_ns)
            spanning = [c.measurement.begin_ns for c in self._history[index:]]
            earliest = min(spanning, default=begin_ns)
            if earliest >= begin_ns:
                return index
            begin_ns = earliest

    def _apply(self, measurements: list[Measurement], asked: Measurement) -> bool:
        """Apply measurements in order of time after the last checkpoint; return whether `asked` was used."""
        last = self._history[-1]
        state, covariance, time_ns = last.state, last.covariance, last.measurement.time_ns
        begins = sorted({m.since_ns for m in measurements if m.since_ns is not None})
        columns: dict[int, int] = {}
        asked_used = False
        for measurement in measurements:
            while begins and begins[0] <= measurement.time_ns:
                begin_ns = begins.pop(0)
                state, covariance = self._propagate(state, covariance, time_ns, begin_ns)
                columns[begin_ns], time_ns = len(state), begin_ns
                state, covariance = _clone_angle(state, covariance)
            state, covariance = self._propagate(state, covariance, time_ns, measurement.time_ns)
            time_ns = measurement.time_ns
            row = _row(measurement, len(state), columns)
            state, covariance, used = self._update(state, covariance, measurement, row)
            self._history.append(_Checkpoint(measurement, used, state[:3], covariance[:3, :3]))
            asked_used = asked_used or (used and measurement is asked)
        return asked_used

    def _propagate(
        self, state: FloatArray, covariance: FloatArray, from_ns: int, to_ns: int
    ) -> tuple[FloatArray, FloatArray]:
        """Propagate state and covariance to a later time, with the commands of this interval."""
        time_ns = from_ns
        index = max(bisect.bisect_right(self._command_times, from_ns) - 1, 0)
        while time_ns < to_ns:
            current = self._commands[index] if self._commands else 0.0
            more = index + 1 < len(self._commands)
            until_ns = min(to_ns, self._command_times[index + 1]) if more else to_ns
            state, covariance = self._step(state, covariance, current, (until_ns - time_ns) * 1e-9)
            time_ns = max(until_ns, time_ns)
            index += more
        return state, covariance

    def _step(
        self, state: FloatArray, covariance: FloatArray, current: float, dt: float
    ) -> tuple[FloatArray, FloatArray]:
        """Propagate the first three states by `dt` s. Stored angles of the past stay constant."""
        angle, rate, disturbance = state[:3].tolist()
        acceleration = self._plant.acceleration(angle + 0.5 * dt * rate, rate, current) + disturbance
        state = state.copy()
        state[0] = angle + dt * rate + 0.5 * dt * dt * acceleration
        state[1] = rate + dt * acceleration
        transition = np.array([[1.0, dt, 0.5 * dt * dt], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
        covariance = covariance.copy()
        covariance[:3] = transition @ covariance[:3]
        covariance[:, :3] = covariance[:, :3] @ transition.T
        q = self._rate_noise
        covariance[0, 0] += q * dt**3 / 3.0
        covariance[0, 1] += 0.5 * q * dt * dt
        covariance[1, 0] += 0.5 * q * dt * dt
        covariance[1, 1] += q * dt
        covariance[2, 2] += self._settings.disturbance_walk**2 * dt
        return state, covariance

    def _update(
        self, state: FloatArray, covariance: FloatArray, measurement: Measurement, row: FloatArray
    ) -> tuple[FloatArray, FloatArray, bool]:
        """Apply a scalar update in Joseph's form, which keeps the covariance symmetric and positive."""
        innovation = measurement.value - float(row @ state)
        if measurement.component == ANGLE:
            innovation = math.remainder(innovation, 2.0 * math.pi)
        cross = covariance @ row
        variance = float(row @ cross) + measurement.variance
        if innovation * innovation > self._settings.gate_sigma**2 * variance:
            return state, covariance, False
        gain = cross / variance
        keep = np.eye(len(state)) - gain[:, None] * row
        covariance = keep @ covariance @ keep.T + measurement.variance * (gain[:, None] * gain)
        return state + gain * innovation, covariance, True

    def _count(self, used: bool) -> None:
        self._refused_in_a_row = 0 if used else self._refused_in_a_row + 1
        self.refused += not used
        if self._refused_in_a_row >= self.REJECTIONS_TO_RESTART:
            self._history.clear()
            self._refused_in_a_row = 0
            self.restarts += 1

    def _forget(self, now_ns: int) -> None:
        """Delete checkpoints and commands that are too old.

        Old entries are deleted only occasionally, to save time.
        """
        horizon_ns = now_ns - self._settings.history_ns
        if len(self._history) > 2 and self._history[0].measurement.time_ns < horizon_ns - 1_000_000_000:
            keep = bisect.bisect_left(self._history, horizon_ns, key=lambda c: c.measurement.time_ns)
            del self._history[: min(keep, len(self._history) - 1)]


def _clone_angle(state: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return state (n + 1,) and covariance (n + 1, n + 1) with the present angle as last state."""
    pick = np.append(np.arange(len(state)), ANGLE)
    return state[pick], covariance[np.ix_(pick, pick)]


def _row(measurement: Measurement, size: int, columns: dict[int, int]) -> FloatArray:
    """Return the row (size,) of the measurement Jacobian."""
    row = np.zeros(size)
    if measurement.since_ns is None:
        row[measurement.component] = 1.0
    else:
        span = (measurement.time_ns - measurement.since_ns) * 1e-9
        row[ANGLE] = 1.0 / span
        row[columns[measurement.since_ns]] = -1.0 / span
    return row
