"""The satellite's filter behind the loop's Protocol: `FreeFilter` in steps of a second at most.

A step is taken when it is over, with the mean dipole that was on the wire and the mean of the gyro's samples.
Between steps the estimate is propagated by the model. A measurement of a past time, such as an attitude of
the stars, is applied at that time: the filter returns to the step's beginning and takes it and the later
steps again.

The learned states are stored for the next boot in two parts, without their cross-covariance: `attitude-
errors` has the biases of gyro and magnetometer and the rotation of the principal axes, `attitude-torques` the
residual dipole in shadow and sunlight and the torques. A third, `learned-at`, is the time (UTC, s) to which
their covariance refers. Until the next boot each state walks on as in flight, and may have changed by a
fraction of its standard deviation at the start: a unit that was switched off has another bias.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flight.bodies.orbit.filter_steps import DipoleHistory, OpenStep, OrbitFilterSettings, StepReplay
from flight.loop.body import ReadingAgreement
from flight.loop.state.content import Learned
from hal.interfaces.devices import ImuReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.directions import cross_product
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.gnc.estimation import estimate as form
from knightcube.gnc.estimation import free_filter as states
from knightcube.gnc.estimation.estimate import FIELD_BIAS, Estimate, Knowledge, Parameters
from knightcube.gnc.estimation.free_filter import (
    AXES,
    DIPOLE,
    GYRO,
    MAGNET,
    PLAUSIBLE,
    SUNLIT,
    TORQUES,
    FilterEnvironment,
    FreeFilter,
    FreeFilterSettings,
    FreeMemory,
    SlowStates,
)
from knightcube.gnc.estimation.measurements import (
    AttitudeMeasurement,
    FieldMeasurement,
    Measurement,
)

STUCK, CONTRADICTED = 20, 4
"""Readings in a row with the same field, whose noise never repeats; fields that contradict the estimate."""


class StuckFieldCheck:
    """Counts readings with the same field."""

    def __init__(self) -> None:
        self._last: list[float] = []
        self._same = 0

    @property
    def stuck(self) -> bool:
        """Whether the field has been the same for `STUCK` readings."""
        return self._same >= STUCK

    def accept(self, field: FloatArray) -> bool:
        """Take the field (3,) of a reading; return whether it may be used: it is not stuck."""
        values = field.tolist()
        self._same, self._last = (self._same + 1 if values == self._last else 0), values
        return not self.stuck

    def text(self, refused: int) -> str:
        """Return why the magnetometer is rejected, empty while it is used; `refused` fields in a row were."""
        if self.stuck:
            return "the magnetometer gives the same field in every reading"
        return f"{refused} fields in a row contradict the estimate" if refused >= CONTRADICTED else ""


_FROM = np.r_[states.ATTITUDE, states.RATE, states.GYRO, states.MAGNET]
_TO = np.r_[form.ATTITUDE, form.RATE, form.BIAS, form.FIELD_BIAS]
_PICKED, _PLACED = np.ix_(_FROM, _FROM), np.ix_(_TO, _TO)
_SIZE = FIELD_BIAS.stop
_PARAMETERS = Parameters()
_NONE: FloatArray = np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class _Beginning:
    """An estimate at the end of a step, and the terms that all its propagations share.

    Attributes:
        spread: (19, 19) the covariance in the loop's order.
        mixed: (3, 3) rad^2/s, of turn and rate, with its transpose.
        field, residual: (3,) T and A m^2, body axes.
    """

    around: FilterEnvironment
    quaternion: FloatArray
    rate: FloatArray
    bias: FloatArray
    magnet: FloatArray
    spread: FloatArray
    mixed: FloatArray
    field: FloatArray
    residual: FloatArray


class EstimatePropagation:
    """Propagates estimates of a filter; 0.03 ms each."""

    def __init__(self, free: FreeFilter) -> None:
        self._free = free
        self._newest: _Beginning | None = None
        self._changes = -1

    def now(
        self, time_ns: int, seconds: float, dipole: FloatArray, around: FilterEnvironment, measured_ns: int
    ) -> Estimate:
        """Return the newest estimate `seconds` s later under a dipole (3,) A m^2."""
        free, newest = self._free, self._newest
        if newest is None or self._changes != free.changes or newest.around is not around:
            bias, magnet = free.gyro_bias, free.magnet_bias
            newest = self._beginning(free.quaternion, free.rate, bias, magnet, free.covariance, around)
            self._newest, self._changes = newest, free.changes
        return self._carry(newest, time_ns, seconds, dipole, measured_ns)

    def then(
        self, memory: FreeMemory, time_ns: int, seconds: float, dipole: FloatArray, around: FilterEnvironment
    ) -> Estimate:
        """Return an earlier estimate `seconds` s later under a dipole (3,) A m^2."""
        bias, magnet = memory.constants[states.GYRO], memory.constants[states.MAGNET]
        begun = self._beginning(memory.quaternion, memory.rate, bias, magnet, memory.covariance, around)
        return self._carry(begun, time_ns, seconds, dipole, time_ns)

    def _beginning(
        self,
        quaternion: FloatArray,
        rate: FloatArray,
        bias: FloatArray,
        magnet: FloatArray,
        covariance: FloatArray,
        around: FilterEnvironment,
    ) -> _Beginning:
        spread = np.zeros((_SIZE, _SIZE))
        spread[_PLACED] = covariance[_PICKED]
        mixed = spread[form.ATTITUDE, form.RATE]
        field = attitude_matrix(quaternion) @ around.field
        residual = self._free.residual_dipole(around.sunlit)
        return _Beginning(around, quaternion, rate, bias, magnet, spread, mixed + mixed.T, field, residual)

    def _carry(
        self, begun: _Beginning, time_ns: int, seconds: float, dipole: FloatArray, measured_ns: int
    ) -> Estimate:
        free = self._free
        torque = cross_product(dipole + begun.residual, begun.field)
        acceleration = free.motion.acceleration(begun.rate, torque)
        turn = seconds * (begun.rate + 0.5 * seconds * acceleration)
        grown = seconds * free.rate_noise(dipole, begun.around)
        spread = begun.spread.copy()
        widened = seconds**2 * (begun.spread[form.RATE, form.RATE] + grown / 3.0)
        spread[form.ATTITUDE, form.ATTITUDE] += seconds * begun.mixed + widened
        spread[form.RATE, form.RATE] += grown
        return Estimate(
            time_ns=time_ns,
            quaternion=multiply(from_rotation_vector(turn), begun.quaternion),
            rate=begun.rate + seconds * acceleration,
            bias=begun.bias,
            disturbance=_NONE,
            parameters=_PARAMETERS,
            covariance=spread,
            measured_ns=measured_ns,
            field_bias=begun.magnet,
        )


REFUSALS_TO_RESTART = 3
"""Attitudes in a row that contradict the estimate: the estimate is wrong."""


class OrbitFilter:
    """Implements `flight.loop.body.Filter`; `begin` starts it.

    More than 200 lines: one short method for each thing that loop, feeds and telemetry ask of a filter.

    Attributes:
        restarts: how often an estimate was discarded for a new one.
    """

    def __init__(
        self, settings: OrbitFilterSettings, around: Callable[[int], FilterEnvironment | None]
    ) -> None:
        """`around` returns the orbit environment at a time of the clock; None while it is not known."""
        self._settings = settings
        self._around = around
        self._replay = StepReplay(settings)
        self._free, self._steps = self._replay.free, self._replay.steps
        self._propagated = EstimatePropagation(self._free)
        self._dipoles = DipoleHistory(settings.history_ns)
        self._open: OpenStep | None = None
        self._field_check = StuckFieldCheck()
        self._refused_attitudes = 0
        self._placed_ns = 0  # time of the last attitude that was used
        self.restarts = 0

    @property
    def knowledge(self) -> Knowledge:
        """How well the attitude is known."""
        return self._free.knowledge

    @property
    def worst_sigma(self) -> float:
        """The attitude's standard deviation about its worst axis, rad; infinite before a start."""
        return self._free.worst_sigma if self._free.started else math.inf

    @property
    def started(self) -> bool:
        """Whether there is an estimate: not while the attitude is lost."""
        return self.knowledge is not Knowledge.LOST

    @property
    def runs(self) -> bool:
        """Whether the filter accepts measurements, also while the attitude is lost."""
        return self._free.started

    def newest_field(self) -> tuple[FieldMeasurement, FloatArray] | None:
        """Return the newest field and the gyro's rate (`StepReplay.newest_field`)."""
        self._close()
        return self._replay.newest_field()

    def turned(self, from_ns: int, to_ns: int) -> FloatArray | None:
        """Return the body's rotation (4,) between two times by the gyro; None beyond the history."""
        self._close()
        return self._replay.turned(from_ns, to_ns)

    @property
    def measured_ns(self) -> int:
        """The time of the newest reading."""
        return self._open.end_ns if self._open is not None else 0

    @property
    def doubts_commands(self) -> bool:
        """Whether the gyro contradicts the motion that the commanded dipoles make."""
        return self._replay.contradicted >= 2

    @property
    def refused(self) -> int:
        """The number of measurements that did not pass their gate, replays included."""
        return self._free.refused

    @property
    def field_doubt(self) -> str:
        """Why the magnetometer is rejected; empty while it is used."""
        return self._field_check.text(self._replay.refused_fields)

    @property
    def torque_sizes(self) -> FloatArray:
        """The sizes (9,) N m of the torques (`knightcube.astro.earth.disturbance`)."""
        return self._free.torque_sizes

    @property
    def residual_dipole(self) -> FloatArray:
        """The residual dipole (3,) A m^2 in the present light, body axes."""
        lit = self._steps[-1].around.sunlit if self._steps else 0.0
        return self._free.residual_dipole(lit)

    @property
    def slow(self) -> SlowStates:
        """The states of biases, dipole, torques and axes."""
        return self._free.slow

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
        self._replay.doubt_since(since_ns)

    def accept(self, reading: ImuReading) -> bool:
        """Accept a reading; return whether there is an estimate with which the gyro agrees."""
        if self._open is None:
            self._open = OpenStep(reading.time_ns, self._acts())
            return False
        if reading.time_ns <= self._open.end_ns:
            return False
        usable = self._field_check.accept(reading.field)
        rest_ns = self._dipoles.at_rest_since()
        settled = rest_ns is not None and reading.time_ns - rest_ns >= self._settings.settle_ns
        self._open.add(reading, self._dipoles.total(reading.time_ns), settled and usable)
        if self._open.is_over(self._acts(), self._settings.step_ns):
            self._close()
        return self.started and not self.doubts_commands

    def begin(self, attitude: AttitudeMeasurement, *, doubted: bool = False) -> bool:
        """Start from an attitude; return False where no step was taken at its time.

        `doubted`: the estimate was contradicted, so its learned states are less accurate than stated.
        A non-finite attitude starts nothing.
        """
        self._close()
        place = self._replay.place(attitude.time_ns)
        if place is None or not np.isfinite([*attitude.quaternion, *attitude.covariance.flat]).all():
            return False
        self.restarts += self._free.started
        self._replay.start(attitude, place, doubted)
        self._refused_attitudes, self._placed_ns = 0, attitude.time_ns
        return True

    def measure_late(self, late: Sequence[Measurement], applied: Callable[[list[bool]], None]) -> None:
        """Apply measurements of past times; `applied` is called with which of them passed the gate."""
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
                if isinstance(m, AttitudeMeasurement) and id(m) in known - used and self._should_yield(m):
                    used = self._replay.make_room(m, self._placed_ns)
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
        return self._propagated.now(time_ns, seconds, dipole, newest.around, self.measured_ns)

    def past(self, time_ns: int) -> Estimate | None:
        """Return the estimate at a past time, None beyond the history."""
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

    def acceleration_psd(self, time_ns: int) -> FloatArray:
        """Return the density (3, 3) rad^2/s^3 of the acceleration's noise then."""
        place = self._replay.place(time_ns) if self._free.started else None
        if place is None:
            return self._settings.unknown_psd * np.eye(3)
        step = self._steps[place]
        return self._free.rate_noise(step.dipole, step.around, step.doubt)

    def _acts(self) -> bool:
        return self._dipoles.at_rest_since() is None

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
        doubt = self._settings.dipole_limit if self._dipoles.unknown_ns >= begin_ns else 0.0
        step = gathered.close(self._dipoles.mean(begin_ns, end_ns), doubt, around)
        self._replay.add(step)
        self._replay.follow_gyro()

    def _should_yield(self, refused: AttitudeMeasurement) -> bool:
        """Return whether a refused attitude is better known than a fine estimate."""
        known = math.sqrt(float(refused.covariance.diagonal().max()))
        return self.knowledge is Knowledge.FINE and known < self._free.worst_sigma

    def _judge(self, attitude: AttitudeMeasurement, used: bool) -> None:
        """Begin again after too many attitudes that contradict the estimate; a coarse one yields at once."""
        self._refused_attitudes = 0 if used else self._refused_attitudes + 1
        if used:
            self._placed_ns = attitude.time_ns
        patience = REFUSALS_TO_RESTART if self.knowledge is Knowledge.FINE else 1
        if self._refused_attitudes >= patience:
            self.begin(attitude, doubted=True)


class OrbitFeed:
    """Implements `flight.loop.body.Feed`: gyro and magnetometer of a reading; the stars give the attitude."""

    def __init__(self, filter_: OrbitFilter) -> None:
        self._filter = filter_

    def accept(self, reading: ImuReading) -> ReadingAgreement:
        """Gather rate and field for the filter's next step."""
        return ReadingAgreement(self._filter.accept(reading))

    def begin(self, attitude: AttitudeMeasurement) -> bool:
        """Start the filter from an attitude of the stars; return whether it did."""
        return self._filter.begin(attitude)


ERRORS, SOURCES, LEARNED_AT = "attitude-errors", "attitude-torques", "learned-at"
UNKNOWN_AGE = 86_400.0
"""Largest age (s) of learned states, also used if the clock was set back."""


def _places(*parts: slice) -> IntArray:
    """Return where parts of the filter's state stand among the slow states."""
    return np.concatenate([np.arange(part.start, part.stop) for part in parts]) - GYRO.start


PARTS = {ERRORS: _places(GYRO, MAGNET, AXES), SOURCES: _places(DIPOLE, SUNLIT, TORQUES)}


def learned_of(slow: SlowStates, utc: float) -> dict[str, Learned]:
    """Return the slow states by name, as known at a time (UTC, s)."""
    found = {name: Learned.of(slow.values[at], slow.covariance[np.ix_(at, at)]) for name, at in PARTS.items()}
    return {**found, LEARNED_AT: Learned((utc,), ((0.0,),))}


def start_from(
    learned: Mapping[str, Learned], settings: FreeFilterSettings, changed: float, utc: float
) -> tuple[SlowStates, list[str]]:
    """Return the filter's prior at a time (UTC, s), and why learned states were rejected.

    Since then a state may have changed by the part `changed` of its deviation at the start.
    """
    start, walks = settings.of_slow(0), settings.of_slow(1)
    prior = SlowStates(np.zeros(len(start)), np.diag(start**2))
    if LEARNED_AT not in learned:
        return prior, []
    age = utc - learned[LEARNED_AT].values[0]
    if not 0.0 <= age <= UNKNOWN_AGE:
        age = UNKNOWN_AGE
    grown = walks**2 * age + (changed * start) ** 2
    problems = []
    for name, at in PARTS.items():
        if name not in learned:
            continue
        values, covariance = learned[name].arrays()
        if values.shape != at.shape or not settings.plausible(values, at).all():
            problems.append(f"{name} {values.tolist()}: not within {PLAUSIBLE:g} sigma of what is expected")
            continue
        prior.values[at] = values
        prior.covariance[np.ix_(at, at)] = covariance + np.diag(grown[at])
    return prior, problems
