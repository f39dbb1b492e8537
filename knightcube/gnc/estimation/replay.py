"""Replay of measurements in order of time, with histories of coil commands and filter checkpoints.

After a late measurement is inserted, all later measurements are applied again. The application of the
measurements of one second takes longer than a control cycle. The replay can therefore be distributed over
several cycles, during which the filter continues without the late measurement.
"""

from __future__ import annotations

import bisect
import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from knightcube.astro import chi_square
from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.gnc.estimation.estimate import (
    LATENCY,
    SIZE,
    Estimate,
    FilterState,
    MeanRateMeasurement,
    Measurement,
    RateMeasurement,
)
from knightcube.gnc.estimation.mekf import (
    correct,
    innovation,
    keep_attitude,
    release_attitude,
)
from knightcube.gnc.estimation.rigid_body import (
    ProcessNoise,
    RateChange,
    RigidBody,
    Torquing,
    propagate,
    rate_change,
)


class CommandHistory:
    """The recent coil commands in order of time.

    Before the first command, no coil is driven, with the dipole moment and magnetic field `idle`.
    """

    def __init__(self, body: RigidBody, history_ns: int) -> None:
        self._body = body
        self.idle = body.torquing(np.zeros(3))
        self._history_ns = history_ns
        self._times: list[int] = []
        self._torquings: list[Torquing] = []

    def __len__(self) -> int:
        return len(self._times)

    def record(
        self, time_ns: int, currents: FloatArray, field: FloatArray | None, known: bool = True
    ) -> None:
        """Record coil currents (3,) A that flow from `time_ns` on, and the field (3,) T, reference axes."""
        torquing = self._body.torquing(currents, field, known)
        if self._torquings and self._torquings[-1] == torquing:
            return
        self._times.append(time_ns)
        self._torquings.append(torquing)
        oldest = bisect.bisect_right(self._times, time_ns - self._history_ns) - 1
        if oldest > 64:  # commands are deleted in batches, not in each cycle
            del self._times[:oldest], self._torquings[:oldest]

    def mark_unknown(self, since_ns: int) -> None:
        """Treat the coil currents since `since_ns` as unknown."""
        first = bisect.bisect_left(self._times, since_ns)
        if self._torquings and (first == len(self._times) or self._times[first] > since_ns):
            self._torquings.insert(first, self.at(since_ns))
            self._times.insert(first, since_ns)
        self._torquings[first:] = [replace(torquing, known=False) for torquing in self._torquings[first:]]

    def at(self, time_ns: int) -> Torquing:
        """Return the coils' dipole and field at a time, as `Torquing`."""
        index = max(bisect.bisect_right(self._times, time_ns) - 1, 0)
        return self._torquings[index] if self._torquings else self.idle

    def spans(self, from_ns: int, to_ns: int) -> Iterator[tuple[Torquing, int]]:
        """Yield each coil command between two times, and the command's duration (ns), in order of time."""
        time_ns = from_ns
        index = max(bisect.bisect_right(self._times, from_ns) - 1, 0)
        while time_ns < to_ns:
            torquing = self._torquings[index] if self._torquings else self.idle
            more = index + 1 < len(self._torquings)
            until_ns = min(to_ns, self._times[index + 1]) if more else to_ns
            if until_ns > time_ns:
                yield torquing, until_ns - time_ns
                time_ns = until_ns
            index += more


_RATE_ONLY = {size: chi_square.bound(0.025, size) for size in (1, 3)}
"""Normalised squared innovation, by number of axes, above which a gyro sample corrects only the rate.
Normally a gyro sample also corrects angle, disturbance and coil gain, by their correlations with the rate.
Before a broken coil is detected, the correlations with the rate cause wrong corrections of angle, disturbance
and coil gain. Without the limit, the angle error reached 40 standard deviations although the rate was
correct. In a consistent filter, one gyro sample in forty exceeds the limit."""


@dataclass(slots=True, eq=False)
class Checkpoint:
    """A measurement, whether it passed the gate, and the state of the filter after its application.

    For the first checkpoint, the innovation (in the unit of the measurement) is empty, and the variance of
    the innovation is None.
    """

    measurement: Measurement
    used: bool
    state: FilterState
    covariance: FloatArray
    nis: float = math.nan
    innovation: tuple[float, ...] = ()
    variance: FloatArray | None = None

    @property
    def time_ns(self) -> int:
        """Time of the measurement."""
        return self.measurement.time_ns


class _Step(NamedTuple):
    """A propagation step under a single coil command, with the state and covariance after the step."""

    state: FilterState
    covariance: FloatArray
    torquing: Torquing
    span_ns: int
    result: tuple[FilterState, FloatArray]


@dataclass(frozen=True, slots=True)
class PropagationModel:
    """The model that propagates a state: body, process noise, coil commands, longest step (s) and gate.

    The mapping `gate` assigns the threshold of the normalised squared innovation to each number of measured
    components. The last steps are stored, because the propagation to the next measurement often repeats a
    step of the previous estimate.
    """

    body: RigidBody
    noise: ProcessNoise
    commands: CommandHistory
    longest_step: float
    gate: Mapping[int, float]
    _steps: deque[_Step] = field(default_factory=lambda: deque(maxlen=2), compare=False)

    def propagate(
        self, state: FilterState, covariance: FloatArray, from_ns: int, to_ns: int
    ) -> tuple[FilterState, FloatArray]:
        """Return state and covariance propagated between two times under the recorded coil commands."""
        for torquing, span_ns in self.commands.spans(from_ns, to_ns):
            for step in self._steps:
                if (
                    step.covariance is covariance
                    and step.state is state
                    and step.span_ns == span_ns
                    and step.torquing is torquing
                ):
                    state, covariance = step.result
                    break
            else:
                result = propagate(
                    self.body, self.noise, state, covariance, torquing, span_ns * 1e-9, self.longest_step
                )
                self._steps.append(_Step(state, covariance, torquing, span_ns, result))
                state, covariance = result
        return state, covariance

    def estimate(self, then: Checkpoint, time_ns: int, measured_ns: int) -> Estimate:
        """Return the estimate at `time_ns`, propagated from a checkpoint.

        `measured_ns` is the time of the last accepted measurement.
        """
        state, covariance = self.propagate(then.state, then.covariance, then.time_ns, time_ns)
        return Estimate(
            time_ns,
            np.array(state.quaternion),
            np.array(state.rate),
            np.array(state.bias),
            np.array(state.disturbance),
            state.parameters,
            covariance,
            measured_ns,
            state.latency,
            np.array(state.field_bias),
        )

    def rate_change(self, state: FilterState, covariance: FloatArray, time_ns: int) -> RateChange:
        """Return the change of the rate at the time of a gyro sample whose age is estimated."""
        half_ns = round(0.5e9 * math.sqrt(covariance[LATENCY, LATENCY]))
        first, last = self.commands.at(time_ns - half_ns), self.commands.at(time_ns + half_ns)
        return rate_change(self.body, state, covariance, first, last)


class Replay:
    """A replay of measurements in order of time, with its results in `checkpoints`."""

    def __init__(
        self, model: PropagationModel, start: Checkpoint, measurements: Sequence[Measurement]
    ) -> None:
        self._model = model
        self._state, self._covariance, self._time_ns = start.state, start.covariance, start.time_ns
        self._pending = deque(measurements)
        # The list contains the exposures that have not begun yet, with the next exposure as last element.
        self._exposures = [m for m in measurements if isinstance(m, MeanRateMeasurement)]
        self._exposures.sort(key=lambda m: m.since_ns, reverse=True)
        self.checkpoints: list[Checkpoint] = []

    @property
    def done(self) -> bool:
        """Whether all measurements of the replay have been applied."""
        return not self._pending

    def add(self, measurement: Measurement) -> None:
        """Append a measurement that is not older than the previous measurements and is not a mean rate."""
        self._pending.append(measurement)

    def advance(self, maximum: int | None = None) -> None:
        """Apply the next `maximum` measurements, by default all remaining measurements."""
        for _ in range(len(self._pending) if maximum is None else min(maximum, len(self._pending))):
            self._ingest(self._pending.popleft())

    def _ingest(self, measurement: Measurement) -> None:
        model = self._model
        while self._exposures and self._exposures[-1].since_ns <= measurement.time_ns:
            exposure = self._exposures.pop()
            self._propagate_to(exposure.since_ns)
            self._state, self._covariance = keep_attitude(self._state, self._covariance, exposure)
        self._propagate_to(measurement.time_ns)
        state, covariance = self._state, self._covariance
        change, rate_gate = None, math.inf
        if isinstance(measurement, RateMeasurement):
            if measurement.latency is not None:
                change = model.rate_change(state, covariance, measurement.time_ns)
            if model.noise.unknown_current:
                rate_gate = _RATE_ONLY[1 if model.body.suspended else 3]
        found = innovation(state, measurement, model.body.suspended, change)
        gate, is_aged = model.gate[len(found.value)], change is not None
        done = correct(state, covariance, found, gate, rate_gate, considers_age=is_aged)
        state, covariance = done.state, done.covariance
        if isinstance(measurement, MeanRateMeasurement):
            state, covariance = release_attitude(state, covariance, measurement)
        self._state, self._covariance = state, covariance
        alone = state._replace(kept=()) if state.kept else state
        own = covariance[:SIZE, :SIZE].copy() if state.kept else covariance
        self.checkpoints.append(
            Checkpoint(measurement, done.used, alone, own, done.square, found.value, done.spread)
        )

    def _propagate_to(self, time_ns: int) -> None:
        self._state, self._covariance = self._model.propagate(
            self._state, self._covariance, self._time_ns, time_ns
        )
        self._time_ns = time_ns


_SPARE_NS = 1_000_000_000
"""Time (ns) by which the oldest checkpoint may exceed the length of the history before all checkpoints older
than the history are dropped."""
_TIME = attrgetter("time_ns")


class CheckpointHistory:
    """The checkpoints of the last `history_ns` nanoseconds, an empty history before the filter starts."""

    def __init__(self, history_ns: int) -> None:
        self._history_ns = history_ns
        self._checkpoints: list[Checkpoint] = []

    def __len__(self) -> int:
        return len(self._checkpoints)

    def __getitem__(self, index: int) -> Checkpoint:
        return self._checkpoints[index]

    @property
    def newest(self) -> Checkpoint:
        """The newest checkpoint. Raises IndexError if the history is empty."""
        return self._checkpoints[-1]

    @property
    def newest_used(self) -> Checkpoint:
        """The newest checkpoint whose measurement passed the gate; if none passed, the newest checkpoint."""
        return next((c for c in reversed(self._checkpoints) if c.used), self._checkpoints[-1])

    def at(self, time_ns: int) -> Checkpoint | None:
        """Return the last checkpoint up to a time, or None for a time before the first checkpoint."""
        index = bisect.bisect_right(self._checkpoints, time_ns, key=_TIME)
        return self._checkpoints[index - 1] if index else None

    def rates(self, begin_ns: int, end_ns: int) -> tuple[IntArray, FloatArray] | None:
        """Return times (n,) ns and rates (n, 3) rad/s of the checkpoints that enclose an interval.

        Without a checkpoint at or after `end_ns`, the rates end with the newest checkpoint. Return None if no
        checkpoint is as old as `begin_ns`.
        """
        first = bisect.bisect_right(self._checkpoints, begin_ns, key=_TIME)
        last = bisect.bisect_left(self._checkpoints, end_ns, key=_TIME)
        spanning = self._checkpoints[first - 1 : last + 1]
        if not first:
            return None
        return np.array([c.time_ns for c in spanning]), np.array([c.state.rate for c in spanning])

    def index_before(self, begin_ns: int) -> int:
        """Return the number of checkpoints up to `begin_ns`.

        If `begin_ns` is within the exposure of a mean rate, count up to the start of that exposure.
        """
        while True:
            index = bisect.bisect_right(self._checkpoints, begin_ns, key=_TIME)
            spanning = [c.measurement.begin_ns for c in self._checkpoints[index:]]
            earliest = min(spanning, default=begin_ns)
            if earliest >= begin_ns:
                return index
            begin_ns = earliest

    def measurements_from(self, index: int) -> list[Measurement]:
        """Return the measurements of the checkpoints from the index `index` on."""
        return [checkpoint.measurement for checkpoint in self._checkpoints[index:]]

    def replace_from(self, index: int, checkpoints: Sequence[Checkpoint]) -> None:
        """Replace the checkpoints from the index `index` on."""
        self._checkpoints[index:] = checkpoints

    def index_of(self, checkpoint: Checkpoint) -> int:
        """Return the index of a checkpoint of the history."""
        return next(k for k in range(len(self) - 1, -1, -1) if self._checkpoints[k] is checkpoint)

    def restart(self, first: Checkpoint | None) -> None:
        """Drop all checkpoints, and begin a new history with `first` unless it is None."""
        self._checkpoints = [] if first is None else [first]

    def forget(self, now_ns: int) -> None:
        """Drop checkpoints that are too old, in batches, but always keep the newest checkpoint."""
        checkpoints = self._checkpoints
        horizon_ns = now_ns - self._history_ns
        if len(checkpoints) > 2 and checkpoints[0].time_ns < horizon_ns - _SPARE_NS:
            keep = bisect.bisect_left(checkpoints, horizon_ns, key=_TIME)
            del checkpoints[: min(keep, len(checkpoints) - 1)]
