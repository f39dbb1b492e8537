"""The satellite's filter behind the loop's Protocol: `FreeFilter` in steps of a second at most.

A step is taken when it is over, with the mean dipole that was on the wire and the mean of the gyro's samples.
Between steps the estimate is carried on by the model. A measurement of a past time, such as an attitude of
the stars, is applied at that time: the filter returns to the step's beginning and takes it and those after it
again.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from flight.bodies.orbit.carried import CarriedOn
from flight.bodies.orbit.steps import DipoleHistory, OpenStep, Step
from flight.gnc.estimation.estimate import Estimate, Knowledge
from flight.gnc.estimation.free_filter import FreeFilter, FreeFilterSettings
from flight.gnc.estimation.free_motion import Around
from flight.gnc.estimation.measurements import (
    AttitudeMeasurement,
    DirectionMeasurement,
    FieldMeasurement,
    MeanRateMeasurement,
    Measurement,
)
from flight.gnc.math.arrays import FloatArray, IntArray
from flight.gnc.math.quaternion import attitude_matrix, from_rotation_vector
from hal.interfaces.readings import ImuReading
from hal.interfaces.wires import SECOND_NS

FIELD_MEMORY = 300.0
"""s, for which the error of the field's model keeps its sign."""
REFUSALS_TO_RESTART = 3
"""Attitudes in a row that contradict the estimate: the estimate is wrong."""
_LONGEST = 2.0
_EYE: FloatArray = np.eye(3)


@dataclass(frozen=True, slots=True, kw_only=True)
class OrbitFilterSettings:
    """The body, its sensors, and the steps.

    Attributes:
        inertia: (3, 3) kg m^2. dipole_per_ampere: m^2. dipole_limit: A m^2 of each coil.
        gyro_noise: rad/s of an axis of a sample. field_noise: T, likewise.
        field_error: T of an axis, of the field's model.
        settle_ns: after the coils have come to rest, until the magnetometer is free of their field.
        history_ns: how old a measurement may be.
        step_ns: the longest step.
    """

    inertia: FloatArray
    dipole_per_ampere: float
    dipole_limit: float
    gyro_noise: float
    field_noise: float
    field_error: float
    settle_ns: int
    history_ns: int
    step_ns: int = SECOND_NS
    free: FreeFilterSettings = field(default_factory=FreeFilterSettings)


class OrbitFilter:
    """Implements `flight.loop.body.Filter`; `begin` starts it.

    Attributes:
        restarts: how often an estimate was discarded for a new one.
    """

    def __init__(self, settings: OrbitFilterSettings, around: Callable[[int], Around | None]) -> None:
        """`around` returns what surrounds the satellite at a time of the clock; None while not known."""
        self._settings = settings
        self._around = around
        self._free = FreeFilter(settings.inertia, settings.free)
        self._carried = CarriedOn(self._free)
        self._dipoles = DipoleHistory(settings.history_ns)
        self._open: OpenStep | None = None
        self._steps: deque[Step] = deque()
        self._field_ns = 0
        self._refused_gyros = self._refused_attitudes = 0
        self.restarts = 0

    @property
    def knowledge(self) -> Knowledge:
        """How well the attitude is known."""
        return self._free.knowledge

    @property
    def started(self) -> bool:
        """Whether there is an estimate: not while the attitude is lost."""
        return self.knowledge is not Knowledge.LOST

    @property
    def measured_ns(self) -> int:
        """The time of the newest reading."""
        return self._open.end_ns if self._open is not None else 0

    @property
    def doubts_commands(self) -> bool:
        """Whether the gyro contradicts the motion that the commanded dipoles make."""
        return self._refused_gyros >= 2

    @property
    def refused(self) -> int:
        """The number of measurements that did not pass their gate, replays included."""
        return self._free.refused

    @property
    def torque_sizes(self) -> FloatArray:
        """The sizes (9,) N m of the torques (`flight.gnc.earth.disturbance`)."""
        return self._free.torque_sizes

    @property
    def residual_dipole(self) -> FloatArray:
        """The residual dipole (3,) A m^2 in the present light, body axes."""
        lit = self._steps[-1].around.sunlit if self._steps else 0.0
        return self._free.residual_dipole(lit)

    @property
    def magnet_bias(self) -> FloatArray:
        """The magnetometer's bias (3,) T, body axes."""
        return self._free.magnet_bias

    def command(self, time_ns: int, currents: FloatArray, *, known: bool = True) -> None:
        """Record the coil currents (3,) A in force from `time_ns` on; only a guess unless `known`."""
        x, y, z = (self._settings.dipole_per_ampere * currents).tolist()
        self._dipoles.record(time_ns, (x, y, z), known)

    def mark_unknown(self, since_ns: int) -> None:
        """Treat the currents recorded since then as unknown, and take the steps since again."""
        steps = self._steps
        first = next((k for k, step in enumerate(steps) if step.end_ns > since_ns), len(steps))
        for k in range(first, len(steps)):
            steps[k].doubt = self._settings.dipole_limit
        self._take_again(first)

    def accept(self, reading: ImuReading) -> bool:
        """Accept a reading; return whether there is an estimate with which the gyro agrees."""
        if self._open is None:
            self._open = OpenStep(reading.time_ns, self._acts())
            return False
        if reading.time_ns <= self._open.end_ns:
            return False
        rest_ns = self._dipoles.at_rest_since()
        listens = rest_ns is not None and reading.time_ns - rest_ns >= self._settings.settle_ns
        self._open.add(reading, self._dipoles.total(reading.time_ns), listens)
        if self._open.is_over(self._acts(), self._settings.step_ns):
            self._close()
        return self.started and not self.doubts_commands

    def begin(self, attitude: AttitudeMeasurement) -> bool:
        """Start from an attitude; return False where no step was taken at its time."""
        self._close()
        place = self._place(attitude.time_ns)
        if place is None:
            return False
        steps, first = self._steps, self._steps[place]
        self.restarts += self._free.started
        self._free.start(attitude.quaternion, attitude.covariance, first.gyro)
        for k in range(place + 1):
            steps[k].before = None
            steps[k].late.clear()
        self._advance(first, attitude.time_ns, first.end_ns)
        self._end(first)
        self._take_on(place + 1)
        self._refused_attitudes = 0
        return True

    def measure_late(self, late: Sequence[Measurement], applied: Callable[[list[bool]], None]) -> None:
        """Apply measurements of past times; `applied` is called with which of them passed the gate."""
        self._close()
        places = [self._place(m.time_ns) for m in late]
        inside = [k for k in places if k is not None and self._steps[k].before is not None]
        taken: list[bool] = [False] * len(late)
        if inside:
            known = {id(m) for m, k in zip(late, places, strict=True) if k in inside}
            for m, k in zip(late, places, strict=True):
                if k is not None and id(m) in known:
                    self._steps[k].late = sorted([*self._steps[k].late, m], key=lambda other: other.time_ns)
            used = self._take_again(min(inside))
            taken = [id(m) in used for m in late]
        applied(taken)
        for m, was in zip(late, taken, strict=True):
            if isinstance(m, AttitudeMeasurement):
                self._judge(m, was)

    def catch_up(self, most: int | None = None) -> None:
        """Do nothing: late measurements are applied at once, a few steps in a millisecond or two."""

    def at(self, time_ns: int) -> Estimate:
        """Return the estimate propagated to `time_ns`; the filter itself does not change."""
        newest = self._steps[-1]
        dipole = self._dipoles.mean(newest.end_ns, time_ns)
        seconds = (time_ns - newest.end_ns) / SECOND_NS
        return self._carried.now(time_ns, seconds, dipole, newest.around, self.measured_ns)

    def past(self, time_ns: int) -> Estimate | None:
        """Return the estimate at a past time, None beyond the history."""
        if self._steps and time_ns >= self._steps[-1].end_ns:
            return self.at(time_ns) if time_ns <= self.measured_ns else None
        place = self._place(time_ns)
        if place is None:
            return None
        step = self._steps[place]
        if step.before is None:
            return None
        seconds = (time_ns - step.begin_ns) / SECOND_NS
        return self._carried.then(step.before, time_ns, seconds, step.dipole, step.around)

    def rates(self, begin_ns: int, end_ns: int) -> tuple[IntArray, FloatArray] | None:
        """Return times (n,) ns and rates (n, 3) rad/s that span an interval; None beyond the history."""
        inside = [s for s in self._steps if s.end_ns > begin_ns and s.begin_ns < end_ns]
        last = self.past(max(end_ns, inside[-1].end_ns)) if inside else None
        if not inside or last is None or inside[0].begin_ns > begin_ns:
            return None
        before = [step.before for step in inside]
        rates = [then.rate for then in before if then is not None]
        if len(rates) < len(before):
            return None
        times = [step.begin_ns for step in inside]
        return np.array([*times, last.time_ns], dtype=np.int64), np.array([*rates, last.rate])

    def _acts(self) -> bool:
        return self._dipoles.at_rest_since() is None

    def _place(self, time_ns: int) -> int | None:
        """Return the number of the step that holds a time; None beyond the history."""
        for k, step in enumerate(self._steps):
            if step.begin_ns <= time_ns < step.end_ns:
                return k
        return None

    def _close(self) -> None:
        """End the step under way at the newest reading, and take it."""
        gathered = self._open
        if gathered is None or gathered.end_ns == gathered.begin_ns:
            return
        begin_ns, end_ns = gathered.begin_ns, gathered.end_ns
        self._open = OpenStep(end_ns, self._acts())
        around = self._around((begin_ns + end_ns) // 2)
        if around is None:
            return
        doubtful = self._dipoles.unknown_ns >= begin_ns or self.doubts_commands
        doubt = self._settings.dipole_limit if doubtful else 0.0
        step = gathered.close(self._dipoles.mean(begin_ns, end_ns), doubt, around)
        if step.fields:
            step.field_span = min((end_ns - self._field_ns) / SECOND_NS, FIELD_MEMORY)
            self._field_ns = end_ns
        self._steps.append(step)
        while self._steps[0].end_ns < end_ns - self._settings.history_ns:
            self._steps.popleft()
        if self._free.started:
            self._take_on(len(self._steps) - 1)

    def _take_again(self, first: int) -> set[int]:
        """Return to the beginning of step `first` and take it and the later ones; return what was used."""
        while first < len(self._steps) and self._steps[first].before is None:
            first += 1
        if first == len(self._steps):
            return set()
        then = self._steps[first].before
        assert then is not None
        self._free.recall(then)
        return self._take_on(first)

    def _take_on(self, first: int) -> set[int]:
        """Take the steps from number `first` on; return the identities of the late measurements used."""
        used: set[int] = set()
        for k in range(first, len(self._steps)):
            step = self._steps[k]
            step.before = self._free.memory()
            time_ns = step.begin_ns
            for measurement in step.late:
                self._advance(step, time_ns, measurement.time_ns)
                time_ns = measurement.time_ns
                if self._apply(measurement, step):
                    used.add(id(measurement))
            self._advance(step, time_ns, step.end_ns)
            self._end(step)
        return used

    def _advance(self, step: Step, from_ns: int, to_ns: int) -> None:
        seconds = (to_ns - from_ns) / SECOND_NS
        parts = math.ceil(seconds / _LONGEST)
        for _ in range(parts):
            self._free.advance(seconds / parts, step.dipole, step.around, step.doubt)

    def _end(self, step: Step) -> None:
        """Apply the gyro's and the magnetometer's means of a step, at its end."""
        free, settings = self._free, self._settings
        since = (step.end_ns - step.gyro_ns) / SECOND_NS
        shown = attitude_matrix(free.quaternion) @ step.around.field
        # The coils act for a part of the step: after its samples by `impulse`, not by the mean.
        uneven = np.cross(step.impulse - since * step.dipole, shown)
        change = since * free.acceleration + free.motion.inverse @ uneven
        spread = settings.free.coil_error**2 * float(change @ change) + settings.gyro_noise**2 / step.samples
        refused = not free.gyro(step.gyro, spread * _EYE, change)
        self._refused_gyros = self._refused_gyros + 1 if refused else 0
        if step.field is not None:
            turn = free.rate * ((step.end_ns - step.field_ns) / SECOND_NS)
            now = attitude_matrix(from_rotation_vector(turn)) @ step.field
            model = settings.field_error**2 * 2.0 * FIELD_MEMORY / step.field_span
            free.field(now, step.around.field, (settings.field_noise**2 / step.fields + model) * _EYE)

    def _apply(self, measurement: Measurement, step: Step) -> bool:
        """Apply a measurement to the estimate of its time; return whether it passed the gate."""
        free = self._free
        if isinstance(measurement, AttitudeMeasurement):
            return free.attitude(measurement.quaternion, measurement.covariance)
        if isinstance(measurement, MeanRateMeasurement):
            since = 0.5 * (measurement.time_ns - measurement.since_ns) / SECOND_NS
            return free.mean_rate(measurement.rate, measurement.covariance, since * free.acceleration)
        if isinstance(measurement, DirectionMeasurement):
            return free.direction(measurement.observed, measurement.reference, measurement.covariance)
        if isinstance(measurement, FieldMeasurement):
            return free.field(measurement.field, measurement.reference, measurement.covariance)
        return free.gyro(measurement.rate, measurement.covariance)

    def _judge(self, attitude: AttitudeMeasurement, used: bool) -> None:
        """Begin again after too many attitudes that contradict the estimate."""
        self._refused_attitudes = 0 if used else self._refused_attitudes + 1
        if self._refused_attitudes >= REFUSALS_TO_RESTART:
            self.begin(attitude)
