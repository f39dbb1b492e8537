"""The recent steps of a satellite's filter, taken one after another, and again for a late measurement.

A step holds the commands and measurements between two times, a second at most. It ends early when the coils
begin or cease to act, so that its dipole is nearly constant. The magnetometer counts only while the coils are
at rest and their field has decayed.
"""

from __future__ import annotations

import bisect
import dataclasses
import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from hal.interfaces.devices import ImuReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, conjugate, from_rotation_vector, multiply
from knightcube.gnc.estimation.free_filter import (
    FilterEnvironment,
    FreeFilter,
    FreeFilterSettings,
    FreeMemory,
    SlowStates,
)
from knightcube.gnc.estimation.measurements import (
    AttitudeMeasurement,
    DirectionMeasurement,
    FieldMeasurement,
    MeanRateMeasurement,
    Measurement,
)

Floats = tuple[float, float, float]
_NOTHING: Floats = (0.0, 0.0, 0.0)


class DipoleHistory:
    """The dipoles on the wire in order of time, and since when they are known."""

    def __init__(self, history_ns: int) -> None:
        self._history_ns = history_ns
        self._times: list[int] = []
        self._dipoles: list[Floats] = []
        self._sums: list[Floats] = []  # A m^2 ns: the integral until each time
        self.unknown_ns = -1
        """Time (ns) until which dipoles were not known; -1 if they always were."""

    def record(self, time_ns: int, dipole: Floats, known: bool) -> None:
        """Record the dipole A m^2 in force from `time_ns` on; in order of time."""
        if not known:
            self.unknown_ns = max(self.unknown_ns, time_ns)
        if self._dipoles and dipole == self._dipoles[-1]:
            return
        time_ns = max(time_ns, self._times[-1]) if self._times else time_ns
        self._sums.append(self._sum(time_ns))
        self._times.append(time_ns)
        self._dipoles.append(dipole)
        oldest = bisect.bisect_right(self._times, time_ns - self._history_ns) - 1
        if oldest > 64:  # in batches, not each cycle
            del self._times[:oldest], self._dipoles[:oldest], self._sums[:oldest]

    def total(self, time_ns: int) -> FloatArray:
        """Return the integral (3,) A m^2 s of the dipole until a time; only differences have a meaning."""
        return np.array(self._sum(time_ns)) / SECOND_NS

    def mean(self, from_ns: int, to_ns: int) -> FloatArray:
        """Return the mean dipole (3,) A m^2 between two times; before the first record it is zero."""
        if to_ns <= from_ns:
            return np.array(self._dipoles[-1] if self._dipoles else _NOTHING)
        return np.subtract(self._sum(to_ns), self._sum(from_ns)) / (to_ns - from_ns)

    def at_rest_since(self) -> int | None:
        """Return since when the dipole is zero; None while it is not."""
        if not self._dipoles:
            return 0
        return self._times[-1] if self._dipoles[-1] == _NOTHING else None

    def _sum(self, time_ns: int) -> Floats:
        place = bisect.bisect_right(self._times, time_ns) - 1
        if place < 0:
            return self._sums[0] if self._sums else _NOTHING
        since = time_ns - self._times[place]
        (a, b, c), (x, y, z) = self._sums[place], self._dipoles[place]
        return a + since * x, b + since * y, c + since * z


@dataclass(slots=True, eq=False)
class FilterStep:
    """What was commanded and measured between two times.

    Attributes:
        dipole: (3,) A m^2, the mean on the wire; `doubt` A m^2 by which an axis may differ where not known.
        gyro: (3,) rad/s, the mean of `samples` readings, whose mean time is `gyro_ns`.
        impulse: (3,) A m^2 s, of the dipole after a sample, in the mean of the samples.
        field: (3,) T, the mean of `fields` readings about `field_ns`; None without one.
        late: the measurements of times within the step, in their order.
        before: the estimate at its beginning; None before there was one.
    """

    begin_ns: int
    end_ns: int
    dipole: FloatArray
    doubt: float
    around: FilterEnvironment
    gyro: FloatArray
    gyro_ns: int
    samples: int
    impulse: FloatArray
    field: FloatArray | None
    field_ns: int
    fields: int
    late: list[Measurement] = dataclasses.field(default_factory=list)
    before: FreeMemory | None = None

    @property
    def seconds(self) -> float:
        """Its length, s."""
        return (self.end_ns - self.begin_ns) / SECOND_NS


class OpenStep:
    """Gathers the readings of the step under way."""

    def __init__(self, begin_ns: int, acts: bool) -> None:
        """Begin at a time, with coils that act or rest."""
        self.begin_ns = self.end_ns = begin_ns
        self._acts = acts
        self._rates: list[FloatArray] = []
        self._totals: list[FloatArray] = []
        self._fields: list[FloatArray] = []
        self._rates_ns = self._fields_ns = 0

    def add(self, reading: ImuReading, total: FloatArray, listens: bool) -> None:
        """Add a reading and the dipole's `total` (3,) then; `listens`: the coils do not disturb its field."""
        since = reading.time_ns - self.begin_ns
        self.end_ns = reading.time_ns
        self._rates.append(reading.rate)
        self._totals.append(total)
        self._rates_ns += since
        if listens:
            self._fields.append(reading.field)
            self._fields_ns += since

    def is_over(self, acts: bool, longest_ns: int) -> bool:
        """Return whether it has lasted long enough, or the coils have begun or ceased to act."""
        return acts != self._acts or self.end_ns - self.begin_ns >= longest_ns

    def close(self, dipole: FloatArray, doubt: float, around: FilterEnvironment) -> FilterStep:
        """Return the step from its beginning to the newest reading."""
        samples, fields = len(self._rates), len(self._fields)
        return FilterStep(
            self.begin_ns,
            self.end_ns,
            dipole,
            doubt,
            around,
            np.mean(self._rates, axis=0),
            self.begin_ns + self._rates_ns // samples,
            samples,
            self._totals[-1] - np.mean(self._totals, axis=0),
            np.mean(self._fields, axis=0) if fields else None,
            self.begin_ns + self._fields_ns // max(fields, 1),
            fields,
        )


FORGOTTEN_NS = 10_000_000_000
"""Time (ns) without a contradicting gyro, after which the commanded dipoles are trusted again."""
_LONGEST = 2.0
_EYE: FloatArray = np.eye(3)


@dataclass(frozen=True, slots=True, kw_only=True)
class OrbitFilterSettings:
    """The body, its sensors, and the steps.

    Attributes:
        inertia: (3, 3) kg m^2. dipole_per_ampere: m^2. dipole_limit: A m^2 of each coil.
        gyro_noise: rad/s of an axis of a sample. field_noise: T of an axis of a sample.
        unknown_psd: rad^2/s^3, density of the body's acceleration where no estimate has one.
        settle_ns: after the coils have come to rest, until the magnetometer is free of their field.
        history_ns: how old a measurement may be.
        step_ns: the longest step.
        slow: the slow states that an earlier boot learned.
    """

    inertia: FloatArray
    dipole_per_ampere: float
    dipole_limit: float
    gyro_noise: float
    field_noise: float
    unknown_psd: float
    settle_ns: int
    history_ns: int
    step_ns: int = SECOND_NS
    slow: SlowStates | None = None
    free: FreeFilterSettings = field(default_factory=FreeFilterSettings)


class StepReplay:
    """Owns the filter and its recent steps, oldest first.

    Attributes:
        free: the estimate at the end of the newest step.
        refused_gyros: how many steps in a row had a gyro that contradicts the motion.
        contradicted: how many steps with a dipole, in a row, had a gyro that contradicts it; forgotten after
            `FORGOTTEN_NS`, as coils that rest on it would never show the contrary.
        refused_fields: how many fields in a row contradicted the estimate.
    """

    def __init__(self, settings: OrbitFilterSettings) -> None:
        self._settings = settings
        self.free = FreeFilter(settings.inertia, settings.free, settings.slow)
        self.steps: deque[FilterStep] = deque()
        self.refused_gyros = 0
        self.refused_fields = 0
        self.contradicted = 0
        self._refused_ns = 0

    def add(self, step: FilterStep) -> None:
        """Add the newest step and forget those beyond the history; take it if there is an estimate."""
        self.steps.append(step)
        while self.steps[0].end_ns < step.end_ns - self._settings.history_ns:
            self.steps.popleft()
        if self.free.started:
            self.take_on(len(self.steps) - 1)

    def follow_gyro(self) -> None:
        """Take the last steps again with unknown dipoles if the gyro contradicts the commanded dipoles.

        The deviation may have begun in the step before, whose mean rate shows only half of it.
        """
        steps, refused = self.steps, self.refused_gyros > 0
        now_ns = steps[-1].end_ns
        if refused:
            self.contradicted, self._refused_ns = self.contradicted + 1, now_ns
        elif steps[-1].dipole.any() or now_ns - self._refused_ns >= FORGOTTEN_NS:
            self.contradicted = 0  # a pause between two commands says nothing of them
        if refused and not steps[-1].doubt:
            first = max(len(steps) - 2, 0)
            for k in range(first, len(steps)):
                steps[k].doubt = self._settings.dipole_limit
            self.take_again(first)

    def doubt_since(self, since_ns: int) -> set[int]:
        """Take the steps since then again with unknown dipoles; return the measurements used."""
        steps = self.steps
        first = next((k for k, step in enumerate(steps) if step.end_ns > since_ns), len(steps))
        for k in range(first, len(steps)):
            steps[k].doubt = self._settings.dipole_limit
        return self.take_again(first)

    def make_room(self, refused: AttitudeMeasurement, since_ns: int) -> set[int]:
        """Doubt the dipoles since then for a refused attitude, if it is used then; return what is used.

        Coils that depart from their commands by less than the gyro shows would lead the attitude astray.
        """
        doubts = [step.doubt for step in self.steps]
        used = self.doubt_since(min(since_ns, refused.time_ns))
        if id(refused) in used:
            return used
        for step, doubt in zip(self.steps, doubts, strict=True):
            step.doubt = doubt
        return self.take_again(0)

    def start(self, attitude: AttitudeMeasurement, place: int, doubted: bool) -> None:
        """Start from an attitude in step number `place`; the estimates before it are forgotten.

        `doubted`: they were contradicted.
        """
        first = self.steps[place]
        self.free.start(attitude.quaternion, attitude.covariance, first.gyro, doubted=doubted)
        for k in range(place + 1):
            self.steps[k].before = None
            self.steps[k].late.clear()
        self._advance(first, attitude.time_ns, first.end_ns)
        self._end(first)
        self.take_on(place + 1)

    def place(self, time_ns: int) -> int | None:
        """Return the number of the step that holds a time; None beyond the history."""
        for k, step in enumerate(self.steps):
            if step.begin_ns <= time_ns < step.end_ns:
                return k
        return None

    def newest_field(self) -> tuple[FieldMeasurement, FloatArray] | None:
        """Return the newest field and the gyro's rate (3,) rad/s of its step; None without one.

        Its covariance is for the start of an estimate: the field's bias enters again with the next.
        """
        step = next((step for step in reversed(self.steps) if step.field is not None), None)
        if step is None or step.field is None:
            return None
        spread = self._settings.field_noise**2 + (2.0 * self._settings.free.magnet[0]) ** 2
        field = FieldMeasurement(step.field_ns, step.field, step.around.field, spread * _EYE)
        return field, step.gyro

    def turned(self, from_ns: int, to_ns: int) -> FloatArray | None:
        """Return the body's rotation (4,) between two times by the gyro; None beyond the history."""
        if to_ns < from_ns:
            back = self.turned(to_ns, from_ns)
            return None if back is None else conjugate(back)
        rotation, left_ns = np.array([0.0, 0.0, 0.0, 1.0]), to_ns - from_ns
        for step in self.steps:
            span_ns = min(step.end_ns, to_ns) - max(step.begin_ns, from_ns)
            if span_ns > 0:
                turn = span_ns / SECOND_NS * (step.gyro - self.free.gyro_bias)
                rotation, left_ns = multiply(from_rotation_vector(turn), rotation), left_ns - span_ns
        return rotation if left_ns == 0 else None

    def take_again(self, first: int) -> set[int]:
        """Return to the beginning of step `first`, take it and later steps; return the measurements used."""
        while first < len(self.steps) and self.steps[first].before is None:
            first += 1
        if first == len(self.steps):
            return set()
        then = self.steps[first].before
        assert then is not None
        self.free.recall(then)
        return self.take_on(first)

    def take_on(self, first: int) -> set[int]:
        """Take the steps from number `first` on; return the identities of the late measurements used."""
        used: set[int] = set()
        for k in range(first, len(self.steps)):
            step = self.steps[k]
            step.before = self.free.memory()
            time_ns = step.begin_ns
            for measurement in step.late:
                self._advance(step, time_ns, measurement.time_ns)
                time_ns = measurement.time_ns
                if self._apply(measurement, step):
                    used.add(id(measurement))
            self._advance(step, time_ns, step.end_ns)
            self._end(step)
        return used

    def _advance(self, step: FilterStep, from_ns: int, to_ns: int) -> None:
        seconds = (to_ns - from_ns) / SECOND_NS
        parts = math.ceil(seconds / _LONGEST)
        for _ in range(parts):
            self.free.advance(seconds / parts, step.dipole, step.around, step.doubt)

    def _end(self, step: FilterStep) -> None:
        """Apply the gyro's and the magnetometer's means of a step, at its end."""
        free, settings = self.free, self._settings
        since = (step.end_ns - step.gyro_ns) / SECOND_NS
        shown = attitude_matrix(free.quaternion) @ step.around.field
        # The coils act for a part of the step: after its samples by `impulse`, not by the mean.
        uneven = np.cross(step.impulse - since * step.dipole, shown)
        change = since * free.acceleration + free.motion.inverse @ uneven
        spread = settings.free.coil_error**2 * float(change @ change) + settings.gyro_noise**2 / step.samples
        refused = not free.gyro(step.gyro, spread * _EYE, change, since)
        self.refused_gyros = self.refused_gyros + 1 if refused else 0
        if step.field is not None:
            ago = (step.end_ns - step.field_ns) / SECOND_NS
            turn = ago * (free.rate - 0.5 * ago * free.acceleration)
            now = attitude_matrix(from_rotation_vector(turn)) @ step.field
            used = free.field(now, step.around.field, settings.field_noise**2 / step.fields * _EYE)
            self.refused_fields = 0 if used else self.refused_fields + 1

    def _apply(self, measurement: Measurement, step: FilterStep) -> bool:
        """Apply a measurement to the estimate of its time; return whether it passed the gate."""
        free = self.free
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
