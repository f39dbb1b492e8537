"""The satellite's attitude filter, which runs `FreeFilter` in steps of at most one second.

A step contains the coil commands and the measurements between two times. A step ends early when the coils are
switched on or off, so that the dipole is nearly constant during a step. When a step has ended, the filter
processes it with the mean commanded dipole and the mean of the gyro samples. Magnetometer samples are used
only while the coils are off and their field has decayed. Within an incomplete step, the estimate is
propagated by the model. A measurement of a past time, such as a star fix, is applied at its own time. The
filter returns to the beginning of the step that contains this time, and repeats all steps since then.

The learned states are stored for the next boot in three parts, without the cross-covariance of different
parts. The part `attitude-errors` contains the biases and matrices of gyro and magnetometer and the
misalignment of the star camera. The part `attitude-torques` contains the residual dipole in shadow and in
sunlight and the torques. The part `body` contains the inertia and the matrix of the coils. The matrix of the
coils applies to dipoles that were computed with the signs and gains from the coil monitor. The signs and
gains from the coil monitor are therefore stored too, in the entry `coil-factors`. Another entry,
`learned-at`, is the time (UTC, s) for which the learned states were estimated. At the next boot, the
covariance of each state grows by its random walk over the elapsed time. It also grows by a fraction of its
initial covariance, because switching a sensor off and on changes its bias.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from flight.bodies.orbit.environment import StuckFieldCheck
from flight.bodies.orbit.propagation import (
    DipoleHistory,
    EstimatePropagation,
    FilterStep,
    OpenStep,
    RateByField,
)
from flight.loop.state import Learned
from hal.interfaces.devices import ImuReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import BoolArray, FloatArray, IntArray, cross_product
from knightcube.astro.quaternion import attitude_matrix, conjugate, from_rotation_vector, multiply
from knightcube.gnc.control.coil_map import CoilMap
from knightcube.gnc.estimation import free_filter as states
from knightcube.gnc.estimation.error_state import PLAUSIBLE, ErrorState, PriorCheck, plausible
from knightcube.gnc.estimation.estimate import (
    AttitudeMeasurement,
    DirectionMeasurement,
    Estimate,
    FieldMeasurement,
    Knowledge,
    MeanRateMeasurement,
    Measurement,
)
from knightcube.gnc.estimation.field_rate import RATE, FieldRate, FieldRateSettings
from knightcube.gnc.estimation.free_filter import (
    CAMERA,
    COIL_ERROR,
    COILS,
    DIPOLE,
    FIELD_MATRIX,
    GYRO,
    GYRO_MATRIX,
    INERTIA,
    MAGNET,
    SLOW,
    SUN_CAMERA,
    SUNLIT,
    TORQUES,
    FilterEnvironment,
    FreeFilter,
    FreeFilterSettings,
    FreeMemory,
    SlowStates,
    density_walk,
)

ERRORS, SOURCES, BODY, LEARNED_AT = "attitude-errors", "attitude-torques", "body", "learned-at"
COIL_FACTORS = "coil-factors"
UNKNOWN_AGE = 86_400.0
"""Largest assumed age (s) of learned states. This age is also assumed if the clock was set back."""


def _places(*parts: slice) -> IntArray:
    """Return the indices, among the slow states, of slices of the filter's state vector."""
    return np.asarray(np.concatenate([np.arange(part.start, part.stop) for part in parts]) - GYRO.start)


_TORQUES = slice(TORQUES.start - GYRO.start, TORQUES.stop - GYRO.start)
"""Slice of the slow states that contains the amplitudes of the disturbance torques."""
PARTS = {
    ERRORS: _places(GYRO, MAGNET, GYRO_MATRIX, FIELD_MATRIX, CAMERA),
    SOURCES: _places(DIPOLE, SUNLIT, TORQUES),
    BODY: _places(INERTIA, COILS),
}


def learned_of(slow: SlowStates, utc: float) -> dict[str, Learned]:
    """Return the slow states by name, as estimated at a time (UTC, s)."""
    found = {name: Learned.of(slow.values[at], slow.covariance[np.ix_(at, at)]) for name, at in PARTS.items()}
    return {**found, LEARNED_AT: Learned((utc,), ((0.0,),))}


def start_from(
    learned: Mapping[str, Learned],
    layout: ErrorState,
    changed: float,
    utc: float,
    dipole: Sequence[float] = (0.0, 0.0, 0.0),
) -> tuple[SlowStates, list[str]]:
    """Return the prior of the slow states at a time (UTC, s), and why learned states were rejected.

    The expected residual dipole is `dipole` (3,), A m^2. Each boot is assumed to change each state by
    `changed` times its initial standard deviation (one sigma).
    """
    initial, walks = layout.prior[SLOW, SLOW], layout.walks[SLOW]
    prior = SlowStates(np.zeros(len(initial)), initial.copy())
    prior.values[DIPOLE.start - SLOW.start : DIPOLE.stop - SLOW.start] = dipole
    if LEARNED_AT not in learned:
        return prior, []
    age = utc - learned[LEARNED_AT].values[0]
    if not 0.0 <= age <= UNKNOWN_AGE:
        age = UNKNOWN_AGE
    grown = age * np.diag(walks) + changed**2 * initial
    problems = []
    for name, at in PARTS.items():
        if name not in learned:
            continue
        values, covariance = learned[name].arrays()
        if values.shape != at.shape:
            problems.append(f"{name} has {len(values)} values instead of {len(at)}")
            continue
        if not plausible(values - prior.values[at], initial.diagonal()[at]).all():
            problems.append(f"{name} {values.tolist()}: not within {PLAUSIBLE:g} sigma of the prior")
            continue
        prior.values[at] = values
        prior.covariance[np.ix_(at, at)] = covariance + grown[np.ix_(at, at)]
    prior.covariance[_TORQUES, _TORQUES] += age * density_walk(prior.values[_TORQUES])
    return prior, problems


FORGOTTEN_NS = 10_000_000_000
"""Time (ns) without a contradiction by the gyro after which the commanded dipoles are trusted again."""
_LONGEST = 2.0
_KNOWN_RATE = 0.01
"""Largest standard deviation (rad/s) with which a rate from the magnetometer is used to propagate a
direction."""
_MEASURED_SIGMA = 0.7
"""Standard deviation (rad) of the attitude below which a measured attitude updates the estimate linearly
instead of restarting the filter."""
_NEGLIGIBLE = 1e-9
"""Current (A) below which a coil counts as not driven."""
_EYE: FloatArray = np.eye(3)


@dataclass(frozen=True, slots=True, kw_only=True)
class OrbitFilterSettings:
    """Settings of the satellite's attitude filter: body, sensors and steps.

    Attributes:
        inertia: inertia matrix (3, 3), kg m^2.
        coils: map between the dipole and the currents of the coils.
        gyro_noise, field_noise: standard deviations per axis of a gyro sample (rad/s) and of a magnetometer
            sample (T).
        unknown_psd: power spectral density of the angular acceleration while there is no estimate, rad^2/s^3.
        settle_ns: time (ns) after switching the coils off until their field at the magnetometer has decayed.
        history_ns: age (ns) of the oldest measurement that can be applied.
        step_ns: longest duration of a filter step, ns.
        slow: the slow states that an earlier boot learned.
    """

    inertia: FloatArray
    coils: CoilMap
    gyro_noise: float
    field_noise: float
    unknown_psd: float
    settle_ns: int
    history_ns: int
    step_ns: int = SECOND_NS
    slow: SlowStates | None = None
    free: FreeFilterSettings = field(default_factory=FreeFilterSettings)

    @property
    def by_field(self) -> FieldRateSettings:
        """Settings of the filter that estimates the rate from the magnetometer if the gyro is silent."""
        return FieldRateSettings(
            inertia=self.inertia,
            field_sigma=self.field_noise,
            torque_walk=math.sqrt(self.unknown_psd),
            errors=self.free.errors,
        )

    @property
    def dipole_limit(self) -> float:
        """Largest dipole moment along a body axis, A m^2."""
        return float(self.coils.limits.max())


class StepReplay:
    """The filter, with a history of recent steps that can be processed again.

    Attributes:
        free: the filter, with the estimate at the end of the newest step.
        refused_gyros: number of consecutive steps whose mean gyro rate contradicts the estimated motion.
        contradicted: number of steps whose gyro contradicted the motion since the last agreement in a step
            with current in the coils; reset after `FORGOTTEN_NS` without a contradiction.
        refused_fields: number of consecutive field measurements that contradict the estimate.
        contradictions: texts about learned states that measurements have contradicted.
    """

    def __init__(self, settings: OrbitFilterSettings, dipoles: DipoleHistory) -> None:
        """`dipoles` contains the commanded dipoles during the history."""
        self._settings, self._dipoles = settings, dipoles
        self.free = FreeFilter(settings.inertia, settings.free, settings.slow)
        self.steps: deque[FilterStep] = deque()
        self.refused_gyros = self.refused_fields = self.contradicted = 0
        self.contradictions: list[str] = []
        self._checks = {name: PriorCheck() for name in states.LEARNED}
        # Names of the states tested by the newest gyro innovation, and its normalised square.
        self._innovation = states.BODY_NAMES, 0.0
        self._refused_ns = 0

    def add(self, step: FilterStep) -> None:
        """Append the newest step, discard steps older than the history, and process the step if possible."""
        self.steps.append(step)
        while self.steps[0].end_ns < step.end_ns - self._settings.history_ns:
            self.steps.popleft()
        if self.free.started:
            self.take_on(len(self.steps) - 1)
            if step.samples and step.doubt < self._settings.dipole_limit:
                self._check_learned(step.end_ns / SECOND_NS)

    def _check_learned(self, time: float) -> None:
        """Estimate learned states again if the gyro samples up to `time` (s) consistently contradict them."""
        name, square = self._innovation
        if self._checks[name].add(time, square):
            self.contradictions.append(f"the motion contradicts the estimated {name}: estimated again")
            self.free.widen(states.LEARNED[name], self._memories, drop=True)
            self.take_again(0)

    def follow_gyro(self) -> None:
        """Process the last two steps again with unknown dipoles if the gyro contradicts the dipoles.

        The earlier of the two steps is included, because the deviation may have begun during that step. The
        mean rate of that step shows only a part of the deviation. The gyro bias may have changed instead of
        the rate, so the bias counts as unknown too, until stars show which of the two has changed.
        """
        steps, refused = self.steps, self.refused_gyros > 0
        now_ns = steps[-1].end_ns
        if refused:
            self.contradicted, self._refused_ns = self.contradicted + 1, now_ns
        elif steps[-1].dipole.any() or now_ns - self._refused_ns >= FORGOTTEN_NS:
            self.contradicted = 0  # coils that are off between two commands give no evidence
        if refused and steps[-1].doubt < self._settings.dipole_limit:
            first = max(len(steps) - 2, 0)
            for k in range(first, len(steps)):
                steps[k].doubt = self._settings.dipole_limit
            steps[first].doubts_gyro = True
            self.take_again(first)

    def doubt_since(self, since_ns: int, *, gyro: bool = False) -> set[int]:
        """Process the steps since a time again with unknown dipoles; return the IDs of the measurements used.

        If `gyro` is true, the gyro bias may also have changed since this time.
        """
        steps = self.steps
        first = next((k for k, step in enumerate(steps) if step.end_ns > since_ns), len(steps))
        for k in range(first, len(steps)):
            steps[k].doubt = self._settings.dipole_limit
            steps[k].doubts_gyro |= gyro and k == first
        return self.take_again(first)

    def correct_coils(self, change: FloatArray, deviations: FloatArray) -> None:
        """Multiply the assumed dipoles of the coils by `change` (n,), and process the steps again.

        The dipoles of steps that drove these coils become unknown, because the coils may have changed.
        """
        coils, changed = self._settings.coils, np.flatnonzero(change != 1.0)
        for step in self.steps:
            currents = coils.currents(step.dipole)
            if (np.abs(currents[changed]) > _NEGLIGIBLE).any():
                step.doubt = self._settings.dipole_limit
            step.dipole = coils.dipole(change * currents)
            step.impulse = coils.dipole(change * coils.currents(step.impulse))
        if coils.is_redundant:
            self.take_again(0)
            return
        memories, inverse = self._memories, coils.per_dipole(np.eye(len(change)))
        for coil in changed.tolist():
            direction = coils.dipoles[:, coil] / np.linalg.norm(coils.dipoles[:, coil])
            dual = inverse[coil] / float(inverse[coil] @ direction)
            self.free.renew_coil(direction, dual, float(deviations[coil]), memories)
        self.take_again(0)

    @property
    def _memories(self) -> list[FreeMemory]:
        return [step.before for step in self.steps if step.before is not None]

    def renew_coils(self, covariance: FloatArray) -> None:
        """Reset the learned matrix of the coils to a covariance (9, 9), and process the steps again."""
        self.free.renew(states.COILS, covariance, self._memories)
        self.take_again(0)

    def renew_magnetometer(self) -> None:
        """Reset bias and matrix of the magnetometer, and discard the fields of the previous magnetometer."""
        for step in self.steps:
            step.field = None
        for block in (states.MAGNET, states.FIELD_MATRIX):
            self.free.renew(block, self.free.layout.prior[block, block], self._memories)

    def make_room(self, refused: AttitudeMeasurement, since_ns: int) -> set[int]:
        """Process the steps since `since_ns` again with unknown dipoles and gyro bias.

        The result is kept only if the gate then accepts the attitude `refused`, which it rejected before.
        Small dipole errors and changes of the gyro bias are not noticed in the gyro rates, but accumulate in
        the estimated attitude, which then contradicts the measured attitude. Returns the object IDs of the
        late measurements used.
        """
        doubts = [(step.doubt, step.doubts_gyro) for step in self.steps]
        used = self.doubt_since(min(since_ns, refused.time_ns), gyro=True)
        if id(refused) in used:
            return used
        for step, (doubt, doubts_gyro) in zip(self.steps, doubts, strict=True):
            step.doubt, step.doubts_gyro = doubt, doubts_gyro
        return self.take_again(0)

    def start(self, attitude: AttitudeMeasurement, place: int, doubted: bool) -> None:
        """Start from an attitude in the step with index `place`.

        If `doubted`, earlier estimates were contradicted.
        """
        first = self.steps[place]
        self.free.start(
            attitude.quaternion,
            attitude.covariance,
            first.gyro,
            by_stars=attitude.by_stars,
            doubted=doubted,
            spread=first.spread,
        )
        for k in range(place + 1):
            self.steps[k].before = None
            self.steps[k].late.clear()
        self._advance(first, attitude.time_ns, first.end_ns)
        self._end(first)
        self.take_on(place + 1)

    def place(self, time_ns: int) -> int | None:
        """Return the index of the step that contains a time, or None for a time outside the history."""
        for k, step in enumerate(self.steps):
            if step.begin_ns <= time_ns < step.end_ns:
                return k
        return None

    def newest_field(self) -> tuple[FieldMeasurement, FloatArray] | None:
        """Return the newest field and the mean gyro rate (3,), rad/s, of the same step; None without a field.

        The field's covariance includes the unknown magnetometer bias.
        """
        step = next((step for step in reversed(self.steps) if step.field is not None), None)
        if step is None or step.field is None:
            return None
        spread = self._settings.field_noise**2 + (2.0 * self._settings.free.magnet[0]) ** 2
        spread += step.around.field_sigma**2
        field = FieldMeasurement(step.field_ns, step.field, step.around.field, spread * _EYE)
        return field, step.gyro

    def turned(self, from_ns: int, to_ns: int) -> FloatArray | None:
        """Return the body's rotation (4,) between two times, from gyro data.

        Returns None if a time is outside the history, or if a rate from the magnetometer is too uncertain.
        """
        if to_ns < from_ns:
            back = self.turned(to_ns, from_ns)
            return None if back is None else conjugate(back)
        rotation, left_ns = np.array([0.0, 0.0, 0.0, 1.0]), to_ns - from_ns
        for step in self.steps:
            span_ns = min(step.end_ns, to_ns) - max(step.begin_ns, from_ns)
            if span_ns > 0:
                spread = step.spread
                if spread is not None and float(np.linalg.eigvalsh(spread)[-1]) > _KNOWN_RATE**2:
                    return None
                bias = self.free.gyro_bias if spread is None else 0.0
                turn = span_ns / SECOND_NS * (step.gyro - bias)
                rotation, left_ns = multiply(from_rotation_vector(turn), rotation), left_ns - span_ns
        return rotation if left_ns == 0 else None

    def take_again(self, first: int) -> set[int]:
        """Process all steps from step `first` again; return the object IDs of the late measurements used."""
        while first < len(self.steps) and self.steps[first].before is None:
            first += 1
        if first == len(self.steps):
            return set()
        then = self.steps[first].before
        assert then is not None
        self.free.recall(then)
        return self.take_on(first)

    def take_on(self, first: int) -> set[int]:
        """Process the steps from index `first` on; return the object IDs of the late measurements used."""
        used: set[int] = set()
        for k in range(first, len(self.steps)):
            step = self.steps[k]
            step.before = self.free.memory()
            self.free.begin_mean()
            time_ns = step.begin_ns
            for measurement in step.late:
                self._advance(step, time_ns, measurement.time_ns)
                time_ns = measurement.time_ns
                if self._apply(step, measurement):
                    used.add(id(measurement))
            self._advance(step, time_ns, step.end_ns)
            self._end(step)
        return used

    def _advance(self, step: FilterStep, from_ns: int, to_ns: int) -> None:
        seconds = (to_ns - from_ns) / SECOND_NS
        parts = math.ceil(seconds / _LONGEST)
        times_ns = [from_ns + (to_ns - from_ns) * k // parts for k in range(parts + 1)] if parts else []
        for begin_ns, end_ns in itertools.pairwise(times_ns):
            part = (end_ns - begin_ns) / SECOND_NS
            dipole, impulse = self._dipoles.mean(begin_ns, end_ns), self._dipoles.impulse(begin_ns, end_ns)
            # Double time integral (A m^2 s^2) of the dipole's deviation from its mean.
            uneven = part * (0.5 * part * dipole - impulse)
            self.free.advance(part, dipole, step.around, step.doubt, uneven)

    def _end(self, step: FilterStep) -> None:
        """Apply the mean gyro and magnetometer readings of a step at its end."""
        free, settings, refused = self.free, self._settings, False
        if step.doubts_gyro:
            free.widen(_GYRO_BIAS)
        if step.samples:
            since = (step.end_ns - step.gyro_ns) / SECOND_NS
            # A coil that is driven only during a part of the step does not change the rate uniformly.
            change = self._rate_change(step, since, step.impulse - free.impulse(since))
            noise = settings.gyro_noise**2 / step.samples
            spread = COIL_ERROR**2 * float(change @ change) + noise
            refused = not free.gyro(step.gyro, spread * _EYE, change, since)
            tested = states.ALL_NAMES if step.dipole.any() else states.BODY_NAMES
            self._innovation = tested, free.newest_square
        self.refused_gyros = self.refused_gyros + 1 if refused else 0
        if step.field is not None:
            ago = (step.end_ns - step.field_ns) / SECOND_NS
            turn = ago * (free.rate - 0.5 * ago * free.acceleration)
            now = attitude_matrix(from_rotation_vector(turn)) @ step.field
            used = free.field(now, step.around.field, settings.field_noise**2 / step.fields * _EYE)
            self.refused_fields = 0 if used else self.refused_fields + 1

    def _rate_change(self, step: FilterStep, since: float, impulse: FloatArray) -> FloatArray:
        """Return the present rate (3,), rad/s, minus the mean rate over an interval.

        The middle of the interval was `since` seconds ago. The present acceleration, which includes the
        torque of the newest dipole, is used for the whole interval. `impulse` (3,), A m^2 s, corrects for
        earlier dipoles: it is `DipoleHistory.impulse` minus the impulse of the newest dipole.
        """
        free = self.free
        shown = attitude_matrix(free.quaternion) @ step.around.field
        uneven = cross_product(free.coil_matrix @ impulse, shown)
        return np.asarray(since * free.acceleration + free.motion.inverse @ uneven)

    def _apply(self, step: FilterStep, measurement: Measurement) -> bool:
        """Apply a measurement to the estimate at its time, and return whether it passed the gate."""
        free = self.free
        if isinstance(measurement, AttitudeMeasurement):
            stars = measurement.by_stars
            return free.attitude(measurement.quaternion, measurement.covariance, by_stars=stars)
        if isinstance(measurement, MeanRateMeasurement):
            begin_ns, end_ns = measurement.since_ns, measurement.time_ns
            since = 0.5 * (end_ns - begin_ns) / SECOND_NS
            uneven = self._dipoles.impulse(begin_ns, end_ns) - since * free.driven
            change = self._rate_change(step, since, uneven)
            return free.mean_rate(measurement.rate, measurement.covariance, change, since)
        if isinstance(measurement, DirectionMeasurement):
            seen, cameras = measurement.observed, measurement.sun_cameras
            return free.direction(seen, measurement.reference, measurement.covariance, cameras)
        if isinstance(measurement, FieldMeasurement):
            return free.field(measurement.field, measurement.reference, measurement.covariance)
        return free.gyro(measurement.rate, measurement.covariance)


FIELD_STRENGTH = 5e-5
"""Largest magnetic field (T) in a low orbit."""
_GYRO_BIAS = np.arange(states.GYRO.start, states.GYRO.stop)
"""Indices of the gyro bias in the error state."""
REFUSALS_TO_RESTART = 3
"""Number of consecutive contradicting attitudes after which an accurate estimate is restarted."""


class OrbitFilter:
    """The satellite's filter; implements `flight.loop.body.Filter`.

    Attributes:
        restarts: number of estimates that were discarded.
        contradictions: texts about learned states that measurements have contradicted so far.
        field_at_rest: time (ns) and strength (T) of the newest magnetic field measured with the coils off.
    """

    def __init__(
        self, settings: OrbitFilterSettings, around: Callable[[int], FilterEnvironment | None]
    ) -> None:
        """Create a filter without an estimate; `around` returns the environment at a time, or None."""
        self._settings, self._around = settings, around
        # Dipoles are stored for longer than `history_ns`, because the oldest stored step may begin earlier.
        self._dipoles = DipoleHistory(settings.history_ns + 2 * settings.step_ns)
        self._replay = StepReplay(settings, self._dipoles)
        self.contradictions = self._replay.contradictions
        self._free, self._steps = self._replay.free, self._replay.steps
        self._propagated = EstimatePropagation(self._free)
        self._open: OpenStep | None = None
        self._field_check = StuckFieldCheck()
        self._refused_attitudes = 0
        self._shifted = 0.0  # additional dipole error (A m^2) of redundant coils in the present step
        self._shares = settings.coils.linear_shares(np.ones(len(settings.coils.current_limits), dtype=bool))
        self._placed_ns = 0  # time (ns) of the last attitude that was used
        self._by_field = FieldRate(settings.by_field)  # rate estimator for times without a gyro rate
        self._unknown_rate = settings.by_field.rate_start**2 * _EYE
        self.restarts = 0
        self.field_at_rest: tuple[int, float] | None = None

    @property
    def knowledge(self) -> Knowledge:
        """The quality of the attitude estimate."""
        return self._free.knowledge

    @property
    def worst_sigma(self) -> float:
        """The attitude's standard deviation (rad) about its worst axis; infinite without an estimate."""
        return self._free.worst_sigma if self._free.started else math.inf

    @property
    def started(self) -> bool:
        """Whether the attitude is known at least coarsely."""
        return self.knowledge is not Knowledge.LOST

    @property
    def runs(self) -> bool:
        """Whether the filter has started and accepts measurements, even if the attitude is lost."""
        return self._free.started

    @property
    def sun_misalignment(self) -> FloatArray:
        """Covariance (3, 3), rad^2, of the misalignment of a camera that has not yet measured the Sun."""
        return np.asarray(self._free.layout.prior[SUN_CAMERA, SUN_CAMERA])

    def newest_field(self) -> tuple[FieldMeasurement, FloatArray] | None:
        """Return the newest magnetic field and the gyro rate of the same step (`StepReplay.newest_field`)."""
        self._close()
        return self._replay.newest_field()

    def turned(self, from_ns: int, to_ns: int) -> FloatArray | None:
        """Return the body's rotation (4,) between two times, or None if unknown (`StepReplay.turned`)."""
        self._close()
        return self._replay.turned(from_ns, to_ns)

    @property
    def measured_ns(self) -> int:
        """The time (ns) of the newest reading."""
        return self._open.end_ns if self._open is not None else 0

    @property
    def doubts_commands(self) -> bool:
        """Whether the gyro contradicts the motion that the commanded dipoles would cause."""
        return self._replay.contradicted >= 2

    @property
    def refused(self) -> int:
        """The number of rejections by gates. A rejection is counted again if its step is processed again."""
        return self._free.refused

    @property
    def field_doubt(self) -> str:
        """The reason why the magnetometer is rejected; empty while the magnetometer is used."""
        return self._field_check.text(self._replay.refused_fields)

    @property
    def torque_sizes(self) -> FloatArray:
        """The estimated amplitudes (9,), N m, of the torques (`knightcube.astro.earth.disturbance`)."""
        return self._free.torque_sizes

    @property
    def inertia(self) -> FloatArray:
        """The estimated inertia tensor (3, 3), kg m^2, in body axes."""
        return self._free.inertia

    @property
    def coil_matrix(self) -> FloatArray:
        """Matrix (3, 3) from the commanded to the estimated dipole of the coils."""
        return self._free.coil_matrix

    @property
    def residual_dipole(self) -> FloatArray:
        """The residual dipole (3,), A m^2, in body axes, under the present illumination by the Sun."""
        lit = self._steps[-1].around.sunlit if self._steps else 0.0
        return self._free.residual_dipole(lit)

    @property
    def slow(self) -> SlowStates:
        """The slow states of body, coils and sensors."""
        return self._free.slow

    def description(self, time_ns: int) -> dict[str, FloatArray]:
        """Return the estimates of inertia, coils and sensors as fields of the description packet.

        The standard deviation of the star camera's attitude is propagated to `time_ns`.
        """
        newest = self._steps[-1]
        seconds, dipole = (time_ns - newest.end_ns) / SECOND_NS, self._dipoles.mean(newest.end_ns, time_ns)
        camera = self._propagated.camera_covariance(seconds, dipole, newest.around)
        return {**self._free.description(), "camera_attitude_sigma": np.sqrt(camera.diagonal())}

    def command(self, time_ns: int, currents: FloatArray, *, known: bool = True) -> None:
        """Record the coil currents (n,), A, from `time_ns` on, and whether they are certainly known."""
        coils, gain = self._settings.coils, self._settings.free.errors.coil_gain
        x, y, z = coils.dipole(currents).tolist()
        if coils.is_redundant:
            # The matrix of the coils is valid only for currents that are linear in the dipole.
            shifted = coils.dipoles * (currents - self._shares @ currents)
            self._shifted = max(self._shifted, gain * float(np.linalg.norm(shifted)) / 3.0)
        self._dipoles.record(time_ns, (x, y, z), known)

    def mark_unknown(self, since_ns: int) -> None:
        """Treat the coil currents since a time as unknown, and process the steps since that time again."""
        self._replay.doubt_since(since_ns)

    def correct_coils(self, change: FloatArray, deviations: FloatArray) -> None:
        """Reset the learned matrix of the coils whose assumed dipole was multiplied by `change` (n,).

        The relative standard deviations of the corrected dipoles are `deviations` (n,). Without a reset of
        the matrix, the filter would apply a correction twice, in the dipole and in the matrix that it learned
        before.
        """
        self._close()
        self._by_field.renew_coils()
        self._replay.correct_coils(change, deviations)
        self._dipoles.unknown_ns = max(self._dipoles.unknown_ns, self.measured_ns)

    def renew_coils(self, covariance: FloatArray, used: BoolArray) -> None:
        """Reset the learned matrix to a covariance (9, 9), because the coils `used` (n,) are in use now."""
        self._close()
        self._by_field.renew_coils()
        self._shares = self._settings.coils.linear_shares(used)
        self._replay.renew_coils(covariance)

    def renew_magnetometer(self) -> None:
        """Reset bias and matrix of the magnetometer, because a different magnetometer is read from now on."""
        self._close()
        self._by_field.restart()
        self._replay.renew_magnetometer()

    def accept(self, reading: ImuReading) -> bool:
        """Accept a reading, and return whether there is an estimate that agrees with the gyro."""
        if self._open is None:
            self._open = OpenStep(reading.time_ns, self._acts())
            return False
        if reading.time_ns <= self._open.end_ns:
            return False
        usable = self._field_check.accept(reading.field)
        rest_ns = self._dipoles.at_rest_since()
        settled = rest_ns is not None and reading.time_ns - rest_ns >= self._settings.settle_ns
        if settled and usable:
            self.field_at_rest = reading.time_ns, math.hypot(*reading.field.tolist())
        if reading.has_rate:
            self._by_field.restart()
        else:
            self._follow_field(reading, settled and usable)
        self._open.add(reading, self._dipoles.total(reading.time_ns), settled and usable)
        if self._open.is_over(self._acts(), self._settings.step_ns):
            self._close()
        return self.started and not self.doubts_commands

    def _follow_field(self, reading: ImuReading, listens: bool) -> None:
        """Estimate the rate from the magnetometer; a field is used only if it is valid (`listens`)."""
        assert self._open is not None
        since_ns, now_ns = self._open.end_ns, reading.time_ns
        self._by_field.advance(self._dipoles.mean(since_ns, now_ns), (now_ns - since_ns) / SECOND_NS)
        if listens:
            self._by_field.measure(reading.field)

    def rate_by_field(self) -> RateByField | None:
        """Return the present rate from the magnetometer, or None while it is unknown or the gyro works."""
        found, settings = self._by_field, self._settings
        if not found.started:
            return None
        # Largest rate change (rad/s) that the coils can cause during a step of one second.
        change = settings.dipole_limit * FIELD_STRENGTH / float(np.linalg.eigvalsh(settings.inertia)[0])
        return RateByField(found.rate, found.covariance[RATE, RATE] + change**2 * _EYE)

    def begin(self, attitude: AttitudeMeasurement, *, doubted: bool = False) -> bool:
        """Start from a finite attitude within the history, and return whether the attitude was used.

        If `doubted`, the previous estimate was contradicted, and its learned states are considered less
        accurate.
        """
        self._close()
        place = self._replay.place(attitude.time_ns)
        if place is None or not np.isfinite([*attitude.quaternion, *attitude.covariance.flat]).all():
            return False
        step = self._steps[place]
        if not (doubted or step.samples or step.before is None) and self.worst_sigma < _MEASURED_SIGMA:
            # Two consecutive attitudes determine the rate, which a new start would discard.
            self.measure_late([attitude], lambda _: None)
            return True
        self.restarts += self._free.started
        self._replay.start(attitude, place, doubted)
        self._refused_attitudes, self._placed_ns = 0, attitude.time_ns
        return True

    def measure_late(self, late: Sequence[Measurement], applied: Callable[[list[bool]], None]) -> None:
        """Apply measurements of past times, and call `applied` with flags: which of them passed the gate.

        Measurements that are older than the history are ignored.
        """
        self._close()
        places = [self._replay.place(m.time_ns) for m in late]
        inside = [k for k in places if k is not None and self._steps[k].before is not None]
        taken: list[bool] = [False] * len(late)
        if inside:
            known = {id(m) for m, k in zip(late, places, strict=True) if k in inside}
            for m, k in zip(late, places, strict=True):
                if k is not None and id(m) in known:
                    self._steps[k].late = sorted([*self._steps[k].late, m], key=lambda other: other.time_ns)
            used = self._replay.take_again(min(inside))
            for m in late:
                if not isinstance(m, AttitudeMeasurement) or id(m) not in known - used:
                    continue
                # Learned dipoles are wrong if an attitude more accurate than the estimate is rejected.
                sigma = math.sqrt(float(m.covariance.diagonal().max()))
                if self.knowledge is Knowledge.FINE and sigma < self._free.worst_sigma:
                    used = self._replay.make_room(m, self._placed_ns)
            taken = [id(m) in used for m in late]
        applied(taken)
        for m, k, was in zip(late, places, taken, strict=True):
            if k is None or not isinstance(m, AttitudeMeasurement):
                continue
            self._refused_attitudes = 0 if was else self._refused_attitudes + 1
            if was:
                self._placed_ns = m.time_ns
            # One contradicting attitude restarts a coarse estimate; a fine estimate needs several.
            patience = REFUSALS_TO_RESTART if self.knowledge is Knowledge.FINE else 1
            if self._refused_attitudes >= patience:
                self.begin(m, doubted=True)

    def catch_up(self, most: int | None = None) -> None:
        """Do nothing, because late measurements are applied at once, within two milliseconds."""

    def at(self, time_ns: int) -> Estimate:
        """Return the estimate propagated to `time_ns`, without changing the filter."""
        newest = self._steps[-1]
        dipole = self._dipoles.mean(newest.end_ns, time_ns)
        seconds = (time_ns - newest.end_ns) / SECOND_NS
        return self._propagated.now(time_ns, seconds, dipole, newest.around, self.measured_ns)

    def past(self, time_ns: int) -> Estimate | None:
        """Return the estimate at a past time, or None if the history has no estimate for this time."""
        if self._steps and time_ns >= self._steps[-1].end_ns:
            return self.at(time_ns) if time_ns <= self.measured_ns else None
        place = self._replay.place(time_ns)
        if place is None:
            return None
        step = self._steps[place]
        if step.before is None:
            return None
        seconds = (time_ns - step.begin_ns) / SECOND_NS
        return self._propagated.then(step.before, time_ns, seconds, step.dipole, step.around)

    def rates(self, begin_ns: int, end_ns: int) -> tuple[IntArray, FloatArray] | None:
        """Return the times (n,), ns, and rates (n, 3), rad/s, of an interval.

        Returns None if the history does not cover the interval.
        """
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

    def acceleration_psd(self, time_ns: int) -> FloatArray:
        """Return the power spectral density (3, 3), rad^2/s^3, of the acceleration noise at a time."""
        place = self._replay.place(time_ns) if self._free.started else None
        if place is None:
            return self._settings.unknown_psd * np.eye(3)
        step = self._steps[place]
        return self._free.rate_noise(step.dipole, step.around, step.doubt)

    def _acts(self) -> bool:
        return self._dipoles.at_rest_since() is None

    def _close(self) -> None:
        """End the present step at its newest reading, and process the step."""
        gathered = self._open
        if gathered is None or gathered.end_ns == gathered.begin_ns:
            return
        begin_ns, end_ns = gathered.begin_ns, gathered.end_ns
        self._open = OpenStep(end_ns, self._acts())
        around = self._around((begin_ns + end_ns) // 2)
        is_known = around is not None
        if around is None:
            if not self._steps:
                return
            # While the orbit is unknown, the estimate follows the gyro, the last field is used, and the
            # dipole counts as unknown. A missing step would make the attitude wrong.
            around = self._steps[-1].around
        dipoles_known = self._dipoles.is_known and self._dipoles.unknown_ns < begin_ns
        doubt = self._shifted if is_known and dipoles_known else self._settings.dipole_limit
        self._shifted = 0.0
        dipole = self._dipoles.mean(begin_ns, end_ns)
        unknown = RateByField(np.zeros(3), self._unknown_rate)
        step = gathered.close(dipole, doubt, around, self.rate_by_field() or unknown)
        if not is_known:
            step.field = None
        self._replay.add(step)
        self._replay.follow_gyro()
