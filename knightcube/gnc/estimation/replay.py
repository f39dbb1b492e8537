"""Applies measurements in order of time from a checkpoint on, at once or a few at a time.

After a late measurement all later ones are applied again. A second of them costs more than the time of a
control cycle, so the work can be spread over cycles while the filter continues unchanged.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from knightcube.astro import chi_square
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.commands import CommandHistory
from knightcube.gnc.estimation.estimate import LATENCY, Estimate
from knightcube.gnc.estimation.innovation import innovation
from knightcube.gnc.estimation.latency import Motion, considered, motion
from knightcube.gnc.estimation.measurements import MeanRateMeasurement, Measurement, RateMeasurement
from knightcube.gnc.estimation.mekf import (
    correct,
    keep_attitude,
    normalised_square,
    of_the_rate_alone,
    release_attitude,
)
from knightcube.gnc.estimation.propagation import ProcessNoise, propagate
from knightcube.gnc.estimation.rigid_body import RigidBody
from knightcube.gnc.estimation.state import SIZE, State

_SURPRISING = {size: chi_square.bound(0.025, size) for size in (1, 3)}
"""Normalised squares of a gyro's sample, by its size, beyond which it corrects the rate alone.

A sample corrects angle, disturbance and coil gain too, by what the model says of the coils. In the tenths of
a second before a broken coil is noticed that is wrong: the angle went off by up to 40 of its sigmas while the
rate was right. A sound filter has one such sample in forty.
"""


@dataclass(slots=True, eq=False)
class Checkpoint:
    """A measurement, whether it passed the gate, and the state just after it.

    Attributes:
        innovation: its components, of the measurement's unit; empty at the start.
        variance: their covariance; None at the start.
    """

    measurement: Measurement
    used: bool
    state: State
    covariance: FloatArray
    nis: float = math.nan
    innovation: tuple[float, ...] = ()
    variance: FloatArray | None = None

    @property
    def time_ns(self) -> int:
        """When the measurement was taken."""
        return self.measurement.time_ns


@dataclass(frozen=True, slots=True)
class Model:
    """The model of propagation: body, noise and commands; `gate` by a measurement's degrees of freedom."""

    body: RigidBody
    noise: ProcessNoise
    commands: CommandHistory
    longest_step: float
    gate: Mapping[int, float]

    def propagate(
        self, state: State, covariance: FloatArray, from_ns: int, to_ns: int
    ) -> tuple[State, FloatArray]:
        """Propagate state and covariance over the commands in force between two times, forward only."""
        for torquing, span_ns in self.commands.spans(from_ns, to_ns):
            state, covariance = propagate(
                self.body, self.noise, state, covariance, torquing, span_ns * 1e-9, self.longest_step
            )
        return state, covariance

    def estimate(self, then: Checkpoint, time_ns: int, measured_ns: int) -> Estimate:
        """Return the estimate of `time_ns` propagated from a checkpoint; measured at `measured_ns` last."""
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

    def motion(self, state: State, covariance: FloatArray, time_ns: int) -> Motion:
        """Return how the rate changes around the time of a sample whose age is estimated."""
        half_ns = round(0.5e9 * math.sqrt(covariance[LATENCY, LATENCY]))
        first, last = self.commands.at(time_ns - half_ns), self.commands.at(time_ns + half_ns)
        before = self.body.accelerate(state.quaternion, state.rate, state.parameters, first)
        after = before
        if last is not first:
            after = self.body.accelerate(state.quaternion, state.rate, state.parameters, last)
        return motion(before, after, state.disturbance, covariance)


class Replay:
    """Applies measurements in order of time; `checkpoints` are the results so far."""

    def __init__(self, model: Model, start: Checkpoint, measurements: Sequence[Measurement]) -> None:
        self._model = model
        self._state, self._covariance, self._time_ns = start.state, start.covariance, start.time_ns
        self._pending = deque(measurements)
        # Exposures that have not begun yet, the first one last.
        self._exposures = [m for m in measurements if isinstance(m, MeanRateMeasurement)]
        self._exposures.sort(key=lambda m: m.since_ns, reverse=True)
        self.checkpoints: list[Checkpoint] = []

    @property
    def done(self) -> bool:
        """Whether all measurements are applied."""
        return not self._pending

    def add(self, measurement: Measurement) -> None:
        """Append a measurement that is not older than the others and not a mean over an exposure."""
        self._pending.append(measurement)

    def advance(self, most: int | None = None) -> None:
        """Apply the next `most` measurements, or all remaining."""
        for _ in range(len(self._pending) if most is None else min(most, len(self._pending))):
            self._ingest(self._pending.popleft())

    def _ingest(self, measurement: Measurement) -> None:
        model = self._model
        while self._exposures and self._exposures[-1].since_ns <= measurement.time_ns:
            exposure = self._exposures.pop()
            self._propagate_to(exposure.since_ns)
            self._state, self._covariance = keep_attitude(self._state, self._covariance, exposure)
        self._propagate_to(measurement.time_ns)
        state, covariance = self._state, self._covariance
        aging = None
        if isinstance(measurement, RateMeasurement) and measurement.latency is not None:
            aging = model.motion(state, covariance, measurement.time_ns)
        found = innovation(state, measurement, model.body.suspended, aging)
        nis, gain, variance = normalised_square(found, covariance)
        used = 0.0 <= nis <= model.gate[len(found.value)]  # a NaN does not pass
        if aging is not None:
            gain = considered(gain)
        if (
            isinstance(measurement, RateMeasurement)
            and model.noise.unknown_current
            and nis > _SURPRISING[len(found.value)]
        ):
            gain = of_the_rate_alone(gain)
        if used:
            state, covariance = correct(state, covariance, found, gain)
        if isinstance(measurement, MeanRateMeasurement):
            state, covariance = release_attitude(state, covariance, measurement)
        self._state, self._covariance = state, covariance
        alone = state._replace(kept=()) if state.kept else state
        self.checkpoints.append(
            Checkpoint(measurement, used, alone, covariance[:SIZE, :SIZE], nis, found.value, variance)
        )

    def _propagate_to(self, time_ns: int) -> None:
        self._state, self._covariance = self._model.propagate(
            self._state, self._covariance, self._time_ns, time_ns
        )
        self._time_ns = time_ns
