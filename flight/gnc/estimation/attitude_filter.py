"""Attitude, rate, gyro bias and disturbance from measurements that may come late: a MEKF with a memory.

Each measurement is applied at its own time: one that arrives late is put where it belongs and those after it
are applied again, at once or a few at a time beside the estimate that goes on
(`flight.gnc.estimation.replay`). A rate from a streaked image is the mean over its exposure: the attitude at
the exposure's start is kept until
its end. The age that the inertial unit's samples have at their stamp may be estimated too
(`flight.gnc.estimation.latency`). On the testbed's thread the same filter runs suspended: it takes of every
measurement what it says about the thread, and all else stays exactly what it was; the thread's torsion
and damping are known, or estimated beside the disturbance, from which they differ in that they go with the
angle and the rate.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flight.gnc.estimation.commands import CommandHistory
from flight.gnc.estimation.estimate import (
    BIAS,
    DISTURBANCE,
    FIELD_BIAS,
    LATENCY,
    PARAMETERS,
    RATE,
    TURN,
    Estimate,
)
from flight.gnc.estimation.latency import LONGEST_LATENCY
from flight.gnc.estimation.measurements import (
    AttitudeMeasurement,
    MeanRateMeasurement,
    Measurement,
    RateMeasurement,
)
from flight.gnc.estimation.propagation import LONGEST_STEP, ProcessNoise
from flight.gnc.estimation.replay import Checkpoint, Model, Replay
from flight.gnc.estimation.rigid_body import RigidBody
from flight.gnc.estimation.slow_prior import SlowPrior
from flight.gnc.estimation.state import SIZE, State
from flight.gnc.estimation.turn import exponential, twist
from flight.gnc.math import chi_square
from flight.gnc.math.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """Noise and bounds of the filter.

    Attributes:
        current_noise: A, standard deviation of a driven coil's current about its command, one draw a cycle.
        control_period: s, the length of such a cycle.
        disturbance_walk: rad/s^2 per sqrt(s), the random walk of the unmodelled acceleration.
        disturbance_start: rad/s^2, standard deviation of that acceleration at the start.
        bias_walk: rad/s per sqrt(s), the random walk of the gyro's bias.
        bias_start: rad/s, standard deviation of that bias at the start.
        torsion_start: 1/s^2, standard deviation of the thread's torsion at the start, zero when it is known.
        damping_start: 1/s, of its damping, likewise.
        gain_start: of the coils' gain, likewise.
        latency_start: s, of the age that the inertial unit's samples have at their stamp, likewise.
        latency_walk: s per sqrt(s), the random walk of that age.
        field_bias_start: T, standard deviation of the magnetometer's bias at the start, zero without one.
        field_bias_walk: T per sqrt(s), the random walk of that bias, and of the field model's error with it.
        rate_walk: rad/s per sqrt(s), white acceleration beside that of the coils.
        unknown_current: A, of each coil while it is not known what they carry.
        gate_sigma: a measurement is refused that is less likely than this many sigma of one component.
        history_ns: how late a measurement may come and still be used.
        longest_step: s, between measurements; a body that turns slowly may take longer ones.
    """

    current_noise: float
    control_period: float
    disturbance_walk: float
    disturbance_start: float = 0.02
    bias_walk: float = 1e-7
    bias_start: float = 1e-3
    torsion_start: float = 0.0
    damping_start: float = 0.0
    gain_start: float = 0.0
    latency_start: float = 0.0
    latency_walk: float = 0.0
    field_bias_start: float = 0.0
    field_bias_walk: float = 0.0
    rate_walk: float = 0.0
    unknown_current: float = 0.0
    gate_sigma: float = 5.0
    history_ns: int = 6_000_000_000
    longest_step: float = LONGEST_STEP


_UNKNOWN_FOR = 1.0
"""s: a current that is not known is taken for white noise that wanders as far in this time as it would."""

Told = Callable[[list[bool]], None]
"""Is told of measurements that came late which of them passed the gate."""


@dataclass(slots=True, eq=False)
class _CatchingUp:
    """A branch from the checkpoint `base` on, with measurements that came late, and who is to be told."""

    base: Checkpoint
    replay: Replay
    late: Sequence[Measurement]
    told: Told


class AttitudeFilter:
    """Holds the estimate, its recent measurements and the recent commands.

    Attributes:
        refused: how many measurements did not pass their gate.
        late: how many came too late to be put where they belong.
        restarts: how often it gave up its estimate.
        nis: normalised innovation squared of the measurement last given, NaN when there was none.
    """

    REJECTIONS_TO_RESTART = 40
    """After so many refusals of attitudes, or of rates, in a row it is the filter that is wrong."""
    REJECTIONS_AT_THE_START = 3
    """So many are enough when it has taken in no more than it refuses: it began with what is no more true."""

    def __init__(self, body: RigidBody, settings: FilterSettings, prior: SlowPrior | None = None) -> None:
        """Take the body; `prior` is what is known of it by now, by default what the settings say."""
        self._body = body
        self._settings = settings
        free = np.array([0.0, 1.0, 0.0]) if body.suspended else np.ones(3)
        self._free = free
        self._prior = prior or slow_prior(body, settings)
        noise = ProcessNoise(
            settings.current_noise**2 * settings.control_period,
            np.diag(settings.rate_walk**2 * free),
            np.array(
                [
                    *settings.bias_walk**2 * free,
                    *settings.disturbance_walk**2 * free,
                ]
            ),
            settings.latency_walk**2,
            settings.field_bias_walk**2,
            settings.unknown_current**2 * _UNKNOWN_FOR,
        )
        self._commands = CommandHistory(body, settings.history_ns)
        gate = {degrees: _gate(settings.gate_sigma, degrees) for degrees in (1, 2, 3)}
        self._model = Model(body, noise, self._commands, settings.longest_step, gate)
        self._history: list[Checkpoint] = []
        self._catching_up: _CatchingUp | None = None
        self._refused_in_a_row: dict[type[Measurement], int] = {}
        self._taken: dict[type[Measurement], int] = {}
        self.refused = 0
        self.late = 0
        self.restarts = 0
        self.nis = math.nan

    def command(
        self, time_ns: int, currents: FloatArray, field: FloatArray | None = None, known: bool = True
    ) -> None:
        """Note the coil currents (3,) A in force from `time_ns` on, and the field (3,) T, reference axes.

        Commands come in order of time, each before the measurements taken under it. Without `field` the
        body's own is meant. Currents that are not `known` are no more than a guess.
        """
        self._commands.note(time_ns, currents, field, known)

    def doubt(self, since_ns: int) -> None:
        """Learn that the currents noted since then may not have flown.

        What was measured since is applied once more, a part of the work at each `catch_up`: what looked like
        a disturbance, or like a plant of other parameters, may have been a current.
        """
        self.catch_up()
        self._commands.doubt(since_ns)
        self._refused_in_a_row = {}
        index = max(self._index_before(since_ns), 1)
        again = [checkpoint.measurement for checkpoint in self._history[index:]]
        if again:
            base = self._history[index - 1]
            self._catching_up = _CatchingUp(base, Replay(self._model, base, again), (), lambda _: None)

    def start(self, attitude: AttitudeMeasurement, rate: RateMeasurement) -> None:
        """Begin from one attitude and one rate; of a suspended body, from what they say about the thread."""
        settings, free = self._settings, self._free
        a, b, c, d = attitude.quaternion.tolist()
        quaternion = exponential(0.0, twist((a, b, c, d)), 0.0) if self._body.suspended else (a, b, c, d)
        prior = self._prior
        x, y, z = (free * (rate.rate - prior.bias)).tolist()
        turn_variance = attitude.covariance * np.outer(free, free)
        rate_variance = rate.covariance * np.outer(free, free)
        bias_variance = prior.bias_covariance
        covariance = np.zeros((SIZE, SIZE))
        covariance[TURN, TURN] = turn_variance
        # The gyro gives the sum of rate and bias: what one has too much the other has too little.
        covariance[RATE, RATE] = rate_variance + bias_variance
        covariance[RATE, BIAS] = covariance[BIAS, RATE] = -bias_variance
        covariance[BIAS, BIAS] = bias_variance
        covariance[DISTURBANCE, DISTURBANCE] = np.diag(settings.disturbance_start**2 * free)
        covariance[PARAMETERS, PARAMETERS] = prior.parameters_covariance
        covariance[FIELD_BIAS, FIELD_BIAS] = settings.field_bias_start**2 * np.eye(3)
        bx, by, bz = prior.bias.tolist()
        none = (0.0, 0.0, 0.0)
        state = State(quaternion, (x, y, z), (bx, by, bz), none, prior.parameters, latency=prior.latency)
        newest: Measurement = attitude if attitude.time_ns >= rate.time_ns else rate
        # The older both are, the further the body has gone on: the errors of all three go together.
        age = np.zeros(SIZE)
        age[TURN], age[RATE] = (x, y, z), self._model.motion(state, covariance, newest.time_ns).acceleration
        age[LATENCY] = 1.0
        covariance += prior.latency_variance * np.outer(age, age)
        self._history = [Checkpoint(newest, True, state, covariance)]
        self._give_up_branch()
        self._refused_in_a_row = {}
        self._taken = {}

    @property
    def started(self) -> bool:
        """Whether there is an estimate at all."""
        return bool(self._history)

    @property
    def measured_ns(self) -> int:
        """When a measurement was last taken in."""
        newest = next((c for c in reversed(self._history) if c.used), self._history[-1])
        return _time_of(newest)

    def measure(self, measurement: Measurement) -> bool:
        """Apply a measurement at its own time; tell whether it passed the gate (or was too late)."""
        self.nis = math.nan
        if self._catching_up is not None:
            if self._is_newest(measurement) and not isinstance(measurement, MeanRateMeasurement):
                self._catching_up.replay.add(measurement)
            else:
                self.catch_up()
        if self._is_newest(measurement):
            used = self._apply([measurement], measurement)
        elif (index := self._index_before(measurement.begin_ns)) > 0:
            used = self._insert(index, measurement)
        else:
            self.late += 1
            return False
        self._count(type(measurement), used)
        self._forget(measurement.time_ns)
        return used

    def _is_newest(self, measurement: Measurement) -> bool:
        return bool(self._history) and measurement.begin_ns >= self._history[-1].time_ns

    def measure_in_turn(self, late: Sequence[Measurement], told: Told) -> None:
        """Put measurements that came late where they belong, a part of the work at each `catch_up`.

        `told` is called when that is done, with which of them passed the gate; until then the estimate is
        that without them.
        """
        if self._catching_up is not None:
            self.catch_up()
        index = self._index_before(min(m.begin_ns for m in late)) if self._history else 0
        if index == 0:
            self.late += len(late)
            told([False] * len(late))
            return
        base = self._history[index - 1]
        again = [*(c.measurement for c in self._history[index:]), *late]
        again.sort(key=lambda m: m.time_ns)
        self._catching_up = _CatchingUp(base, Replay(self._model, base, again), late, told)

    def catch_up(self, most: int | None = None) -> None:
        """Go on with what `measure_in_turn` began, by `most` measurements, or to its end."""
        branch = self._catching_up
        if branch is None:
            return
        branch.replay.go_on(most)
        if not branch.replay.done:
            return
        self._catching_up = None
        place = next(i for i in range(len(self._history) - 1, -1, -1) if self._history[i] is branch.base)
        self._history[place + 1 :] = branch.replay.taken
        used = [next(c.used for c in branch.replay.taken if c.measurement is m) for m in branch.late]
        for measurement, passed in zip(branch.late, used, strict=True):
            self._count(type(measurement), passed)
        branch.told(used)

    @property
    def latency(self) -> float:
        """By how much the inertial unit's samples are older than they say, s, within reason."""
        found = self._history[-1].state.latency if self._history else self._prior.latency
        return min(max(found, 0.0), LONGEST_LATENCY)

    def at(self, time_ns: int) -> Estimate:
        """Return the estimate propagated to `time_ns`; the filter itself stays where it is."""
        return self._estimate(self._history[-1], time_ns, self.measured_ns)

    def past(self, time_ns: int) -> Estimate | None:
        """Return the estimate as it stood at a past time, None when that is before all it remembers."""
        index = bisect.bisect_right(self._history, time_ns, key=_time_of)
        if index == 0:
            return None
        then = self._history[index - 1]
        return self._estimate(then, time_ns, then.measurement.time_ns)

    def _estimate(self, then: Checkpoint, time_ns: int, measured_ns: int) -> Estimate:
        state, covariance = self._model.propagate(then.state, then.covariance, _time_of(then), time_ns)
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

    def _insert(self, index: int, measurement: Measurement) -> bool:
        """Go back to the first `index` checkpoints; apply what came after once more, with `measurement`."""
        later = [checkpoint.measurement for checkpoint in self._history[index:]]
        place = bisect.bisect_right(later, measurement.time_ns, key=lambda other: other.time_ns)
        later.insert(place, measurement)
        del self._history[index:]
        return self._apply(later, measurement)

    def _index_before(self, begin_ns: int) -> int:
        """Return how many checkpoints stand up to `begin_ns`, or up to the begin of a mean that spans it."""
        while True:
            index = bisect.bisect_right(self._history, begin_ns, key=_time_of)
            spanning = [c.measurement.begin_ns for c in self._history[index:]]
            earliest = min(spanning, default=begin_ns)
            if earliest >= begin_ns:
                return index
            begin_ns = earliest

    def _apply(self, measurements: list[Measurement], asked: Measurement) -> bool:
        """Apply measurements in order of time from the last checkpoint on; tell whether `asked` was used."""
        replay = Replay(self._model, self._history[-1], measurements)
        replay.go_on()
        self._history += replay.taken
        mine = next(c for c in replay.taken if c.measurement is asked)
        self.nis = mine.nis
        return mine.used

    def _count(self, kind: type[Measurement], used: bool) -> None:
        """Count refusals. Mean rates come too seldom to tell who is wrong, and restart nothing."""
        in_a_row = 0 if used else self._refused_in_a_row.get(kind, 0) + 1
        self._refused_in_a_row[kind] = in_a_row
        self.refused += not used
        taken = self._taken.get(kind, 0) + used
        self._taken[kind] = taken
        enough = min(max(taken, self.REJECTIONS_AT_THE_START), self.REJECTIONS_TO_RESTART)
        if kind is not MeanRateMeasurement and in_a_row >= enough:
            self._history.clear()
            self._refused_in_a_row = {}
            self.restarts += 1
            self._give_up_branch()

    def _give_up_branch(self) -> None:
        branch, self._catching_up = self._catching_up, None
        if branch is not None:
            branch.told([False] * len(branch.late))

    def _forget(self, now_ns: int) -> None:
        """Drop what is too old to be of use, now and then; not what a branch stands on."""
        if self._catching_up is not None:
            return
        horizon_ns = now_ns - self._settings.history_ns
        if len(self._history) > 2 and _time_of(self._history[0]) < horizon_ns - 1_000_000_000:
            keep = bisect.bisect_left(self._history, horizon_ns, key=_time_of)
            del self._history[: min(keep, len(self._history) - 1)]


def slow_prior(body: RigidBody, settings: FilterSettings) -> SlowPrior:
    """Return what the settings say of the slow parts of a body that nothing was learned of."""
    free = np.array([0.0, 1.0, 0.0]) if body.suspended else np.ones(3)
    thread = (settings.torsion_start**2, settings.damping_start**2) if body.suspended else (0.0, 0.0)
    return SlowPrior(
        bias_covariance=np.diag(settings.bias_start**2 * free),
        parameters=body.parameters,
        parameters_covariance=np.diag([*thread, settings.gain_start**2]),
        latency_variance=settings.latency_start**2,
    )


def _time_of(checkpoint: Checkpoint) -> int:
    return checkpoint.measurement.time_ns


def _gate(sigma: float, degrees: int) -> float:
    """Return the chi-square bound of `degrees` that is passed as seldom as `sigma` of one component."""
    return chi_square.bound(math.erfc(sigma / math.sqrt(2.0)), degrees)
