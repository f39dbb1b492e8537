"""A multiplicative extended Kalman filter of attitude, rate and biases that accepts late measurements.

The filter applies each measurement at the time for which the measurement is valid. A late measurement is
inserted at its measurement time, and all later measurements are applied again, in one call or in several
calls while the filter continues without the late measurement (class `Replay`). The rate from a streaked image
is the mean rate during the exposure, so the filter stores the attitude at the start of an exposure until the
exposure ends. The filter can also estimate the age of the inertial unit's samples (module `mekf`). For a body
that hangs on the testbed's thread, the filter uses only the component of each measurement about the thread.
The torsion and the damping of the thread are either known or estimated by the filter. The filter can
distinguish the thread's torques from the estimated disturbance, because only the thread's torques depend on
the angle and the rate.

The class `CommandCheck` compares the gyro samples with the commands to check whether the coils carry the
commanded currents. With a broken coil, the innovations of the gyro become inconsistent with their covariance
within a few samples. The filter then treats the coil currents, including the currents of the last half
second, as unknown and follows the gyro. The gyro bias may have changed instead, so it counts as unknown, too,
until attitude measurements determine it. A change of the rate that no coil current can cause is not evidence
of wrong coil currents, because the gyro may be faulty. The filter uses the commanded currents again when the
rate follows the commands. The model z = b + g c is fitted to the gyro samples z of the last second, where c
is the change of the rate that the commands should cause. The commands are confirmed if the response g is well
determined and is 1 within its uncertainty, and if the residuals are white. While the coils are not driven,
the response is not determined. If the gyro is noisier than assumed, the check increases its limits and does
not raise an alarm.
"""

from __future__ import annotations

import bisect
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray, check_finite
from knightcube.astro.quaternion import compose, exponential, twist
from knightcube.errors import ArgumentError
from knightcube.gnc.estimation.error_state import (
    ErrorState,
    StateBlock,
    check_amounts,
    gate_bounds,
    joined,
)
from knightcube.gnc.estimation.estimate import (
    ATTITUDE,
    BIAS,
    LATENCY,
    RATE,
    SIZE,
    AttitudeMeasurement,
    Estimate,
    FilterState,
    MeanRateMeasurement,
    Measurement,
    RateMeasurement,
    SlowPrior,
)
from knightcube.gnc.estimation.mekf import (
    LONGEST_LATENCY,
    Checkpoint,
    CheckpointHistory,
    CommandHistory,
    PropagationModel,
    Replay,
)
from knightcube.gnc.estimation.rigid_body import ProcessNoise, RigidBody

_DEPARTURES = {1: 5.5, 4: 5.5, 16: 7.5}
"""Largest accepted mean innovation of the gyro, in standard deviations, by the number of averaged samples. A
strong coil fault is detected in one gyro sample, a weak coil fault only in the mean of many samples. In
flights without a fault, the mean innovations of 1, 4 and 16 samples reach 2.8, 4.0 and 7.0 standard
deviations."""
_SUMS = {count: limit * math.sqrt(count) for count, limit in _DEPARTURES.items()}
"""Largest accepted sum of innovations of the gyro, in standard deviations, by the number of samples."""
_BEFORE_NS = 500_000_000
"""Time (ns), before the first contradictory sample, during which the currents are also treated as unknown. A
weak fault affects the other states of the filter before it is detected. Treating the currents before the
contradictory sample as unknown corrects the other states."""
_MAXIMUM_CHANGE = 3.0
"""Largest innovation that a coil fault can explain, as a multiple of the largest rate change that unknown
coil currents can cause. A reversed coil causes an innovation of twice the commanded change, and the uncertain
age of a sample increases the innovation further."""
_SHORTEST_GAP, _LONGEST_GAP = 0.025, 0.25
"""Minimum and maximum time (s) between gyro samples during which wrong coil currents may have acted. If wrong
currents were assumed to act for a longer time, they could explain any innovation after a long gap."""
_PROOF = 1.0
"""Time span (s) of the gyro samples that must confirm the commands before the commands are trusted again."""
_SHARE_SIGMA = 0.2
"""Largest standard deviation of the fitted response g at which the commands can be confirmed."""
_WHITE = 0.5
"""Residuals count as white if half the mean square of their successive differences is at least this fraction
of their mean square. The expected fraction is one for white noise (von Neumann 1941) and near zero for a
drift."""
_SCALE_OVER = 64.0
"""Number of gyro samples over which the scale factor of the gyro noise is averaged."""
LONGEST_GAP_NS = 3_600_000_000_000
"""Longest time (ns) after the newest measurement to which the filter propagates its estimate."""
_SHARE_ERROR = 0.15
"""Largest deviation of the fitted response g from 1 that an error of the modelled coil gain can explain."""


class CommandCheck:
    """Check of the commanded coil currents against the gyro samples.

    The check is `active` while the coil currents are suspected to differ from the commanded currents. The
    last such suspicion ended at the time `ended_ns`.
    """

    def __init__(self, model: PropagationModel) -> None:
        self.active = False
        self.ended_ns = 0
        self._model = model
        self._scale = 1.0
        self._axes = slice(1, 2) if model.body.suspended else slice(3)
        # Times (ns) and cumulative sums, up to these times, of the innovations in standard deviations.
        self._totals: deque[tuple[int, list[float]]] = deque(maxlen=max(_DEPARTURES) + 1)
        self._samples: deque[tuple[int, FloatArray, FloatArray]] = deque()
        self._natural: FloatArray = np.zeros(1)
        self._commanded: FloatArray = np.zeros(1)

    def judge(self, newest: Checkpoint) -> int | None:
        """Return the time (ns) from which the currents are unknown, if the newest checkpoint raises an alarm.

        The result is None if there is no alarm. Only a checkpoint of a gyro rate can raise an alarm.
        """
        rate = newest.measurement
        if not isinstance(rate, RateMeasurement) or not self._model.noise.unknown_current:
            return None
        if self.active:
            self._test_recovery(newest.state, rate)
            return None
        assert newest.variance is not None  # only the first checkpoint has no variance
        variances, scale = newest.variance.diagonal().tolist(), self._scale
        before = self._totals[-1][1] if self._totals else [0.0] * len(variances)
        within, square, newly = True, 0.0, []
        for y, variance, total in zip(newest.innovation, variances, before, strict=True):
            departure = y / math.sqrt(variance)
            within = within and abs(departure) <= _DEPARTURES[1] * scale
            square += departure * departure
            newly.append(total + departure / scale)
        if not within and not self._explains(newest):
            return None
        if not self._totals:
            self._totals.append((newest.time_ns, before))
        self._totals.append((newest.time_ns, newly))
        size = min(square / len(newly), _DEPARTURES[1] ** 2)
        self._scale = math.sqrt(max(1.0, scale**2 + (size - scale**2) / _SCALE_OVER))
        for count, limit in _SUMS.items():
            # The sums of the last `count` innovations about each axis are compared with the limit.
            if count >= len(self._totals):
                break
            for total, earlier in zip(newly, self._totals[-1 - count][1], strict=True):
                if abs(total - earlier) > limit:
                    since_ns = self._totals[-count][0] - _BEFORE_NS
                    self.active = True
                    self._forget()
                    return since_ns
        return None

    def _explains(self, newest: Checkpoint) -> bool:
        """Return whether wrong coil currents and noise together can explain the newest innovation."""
        assert newest.variance is not None
        gap = (newest.time_ns - self._totals[-1][0]) * 1e-9 if self._totals else _SHORTEST_GAP
        # The variable `change` is the largest change of the rate (rad/s) that unknown currents can cause.
        state, model, duration = newest.state, self._model, min(max(gap, _SHORTEST_GAP), _LONGEST_GAP)
        idle = model.body.linearise(state.quaternion, state.rate, state.parameters, model.commands.idle, 0.0)
        change = model.noise.unknown_current * np.abs(idle.by_current).sum(axis=1) * duration
        most = np.asarray(change[self._axes])
        noise = _DEPARTURES[1] * self._scale * np.sqrt(newest.variance.diagonal())
        return bool((np.abs(newest.innovation) <= noise + _MAXIMUM_CHANGE * most).all())

    def _test_recovery(self, state: FilterState, rate: RateMeasurement) -> None:
        """Record a gyro sample, and trust the commands again if the rate follows the commands."""
        before_ns = self._samples[-1][0] if self._samples else rate.time_ns
        commanded, natural = np.zeros(3), np.zeros(3)
        for torquing, span_ns in self._model.commands.spans(before_ns, rate.time_ns):
            found = self._model.body.accelerate(state.quaternion, state.rate, state.parameters, torquing)
            by_coils = state.parameters.gain * np.array(found.by_parameters)[:, 2]
            commanded += span_ns * 1e-9 * by_coils
            natural += span_ns * 1e-9 * (np.array(found.acceleration) + state.disturbance - by_coils)
        commanded, natural = commanded[self._axes], natural[self._axes]
        self._natural = self._natural + natural
        self._commanded = self._commanded + commanded
        self._samples.append((rate.time_ns, rate.rate[self._axes] - self._natural, self._commanded))
        while rate.time_ns - self._samples[0][0] > _PROOF * 1e9:
            self._samples.popleft()
            if self._follows(self._variance(state, rate)):
                self.active, self.ended_ns = False, rate.time_ns
                self._forget()
                return

    def _follows(self, variance: FloatArray) -> bool:
        """Return whether the recorded rates are a constant plus the changes that the commands should cause.

        If the rates agree with the commands, the scale of the gyro noise is updated.
        """
        _, rates, commanded = zip(*self._samples, strict=True)
        weight = 1.0 / np.sqrt(variance)
        z, c = ((np.array(values) - np.mean(values, axis=0)) * weight for values in (rates, commanded))
        information = float((c * c).sum())
        if information * _SHARE_SIGMA**2 < 1.0:
            return False
        share = float((c * z).sum()) / information
        residual = z - share * c
        noise, jumps = float((residual**2).mean()), 0.5 * float((np.diff(residual, axis=0) ** 2).mean())
        scale = math.sqrt(max(1.0, noise))
        if jumps < _WHITE * noise or abs(share - 1.0) > _SHARE_ERROR + 3.0 * scale / math.sqrt(information):
            return False
        self._scale = scale
        return True

    def _forget(self) -> None:
        self._totals.clear()
        self._samples.clear()
        self._natural = self._commanded = np.zeros(1)

    def _variance(self, state: FilterState, rate: RateMeasurement) -> FloatArray:
        """Return the variance of a gyro sample plus the variance of the rate due to coil noise."""
        model = self._model
        idle = model.body.linearise(state.quaternion, state.rate, state.parameters, model.commands.idle, 0.0)
        by_coils = 0.5 * _PROOF * model.noise.current * (idle.by_current**2).sum(axis=1)
        return np.asarray((rate.covariance.diagonal() + by_coils)[self._axes])


@dataclass(frozen=True, slots=True, kw_only=True)
class AttitudeFilterSettings:
    """Noise and limits of the attitude filter.

    Attributes:
        current_noise: standard deviation of the current noise of a driven coil, A. The noise of different
            control cycles is independent.
        control_period: duration of a control cycle, s.
        disturbance_walk: random walk of the unmodelled angular acceleration, rad/s^2 per sqrt(s).
        disturbance_start: initial standard deviation of the unmodelled angular acceleration, rad/s^2.
        bias_walk: random walk of the gyro bias, rad/s per sqrt(s).
        bias_start: initial standard deviation of the gyro bias, rad/s.
        torsion_start: initial standard deviation of the thread's torsion, 1/s^2; zero if the torsion is
            known. A free body has no thread.
        damping_start: initial standard deviation of the thread's damping, 1/s; zero if the damping is known.
        gain_start: initial standard deviation of the coils' gain; zero if the gain is known.
        latency_start: initial standard deviation of the age of the inertial unit's samples, s; zero if the
            age is known.
        latency_walk: random walk of the age of the inertial unit's samples, s per sqrt(s).
        field_bias_start: initial standard deviation of the magnetometer bias, T; zero if there is no
            magnetometer.
        field_bias_walk: random walk of the magnetometer bias and of the field model's error, T per sqrt(s).
        rate_walk: random walk of the rate due to torque noise other than coil noise, rad/s per sqrt(s).
        unknown_current: current assumed for a coil whose current is unknown, A.
        gate_sigma: gate threshold in standard deviations; a measurement is rejected if its innovation is less
            probable than a one-dimensional deviation of this size.
        history_ns: largest delay of a measurement that is still used, ns.
    """

    current_noise: float
    control_period: float
    disturbance_walk: float
    disturbance_start: float = 0.02
    bias_walk: float = 1e-7
    bias_start: float
    torsion_start: float = 0.02
    damping_start: float = 4e-3
    gain_start: float = 0.15
    latency_start: float = 0.03
    latency_walk: float = 3e-3
    field_bias_start: float = 0.0
    field_bias_walk: float = 0.0
    rate_walk: float = 0.0
    unknown_current: float = 0.0
    gate_sigma: float = 15.0
    history_ns: int = 6_000_000_000

    def __post_init__(self) -> None:
        """Raise ArgumentError for a value that is negative or not a finite number.

        The duration of a control cycle and the gate threshold must be above zero.
        """
        check_amounts(self, "control_period", "gate_sigma")


def free_axes(body: RigidBody) -> FloatArray:
    """Return an array (3,) with 1 for the axes about which the body can rotate, and 0 for the other axes."""
    return np.array([0.0, 1.0, 0.0]) if body.suspended else np.ones(3)


def error_state(body: RigidBody, settings: AttitudeFilterSettings, prior: SlowPrior) -> ErrorState:
    """Return the error state for `body`. A block with a prior covariance of zero is not estimated."""
    free = free_axes(body)
    latency = np.array([[prior.latency_variance]])
    disturbance, walk = settings.disturbance_start * free, settings.disturbance_walk * free
    return ErrorState(
        [
            StateBlock("attitude", np.zeros(3)),
            StateBlock("rate", np.zeros(3)),
            StateBlock("gyro_bias", prior.bias_covariance, settings.bias_walk * free),
            StateBlock("disturbance", disturbance, walk),
            StateBlock("parameters", prior.parameters_covariance),
            StateBlock("latency", latency, settings.latency_walk),
            StateBlock("field_bias", np.full(3, settings.field_bias_start), settings.field_bias_walk),
        ]
    )


def process_noise(body: RigidBody, settings: AttitudeFilterSettings, layout: ErrorState) -> ProcessNoise:
    """Return the process noise of `body` for the error state `layout`."""
    return ProcessNoise(
        settings.current_noise**2 * settings.control_period,
        np.diag(settings.rate_walk**2 * free_axes(body)),
        layout.walks,
        settings.unknown_current,
    )


def slow_prior(body: RigidBody, settings: AttitudeFilterSettings) -> SlowPrior:
    """Return the prior of the slowly varying states before any measurement."""
    thread = (settings.torsion_start**2, settings.damping_start**2) if body.suspended else (0.0, 0.0)
    return SlowPrior(
        bias_covariance=np.diag(settings.bias_start**2 * free_axes(body)),
        parameters=body.parameters,
        parameters_covariance=np.diag([*thread, settings.gain_start**2]),
        latency_variance=settings.latency_start**2,
    )


def first_checkpoint(
    model: PropagationModel,
    layout: ErrorState,
    prior: SlowPrior,
    attitude: AttitudeMeasurement,
    rate: RateMeasurement,
) -> Checkpoint:
    """Return the filter's first checkpoint, at the time of the later of the two measurements.

    An attitude that is older than the rate is rotated to the time of the rate. For a suspended body, the
    measured attitude is reduced to the angle about the thread. Raises ArgumentError for an attitude that is
    not a unit quaternion, and for values that are not finite.
    """
    check_finite(quaternion=attitude.quaternion, rate=rate.rate)
    check_finite(attitude_covariance=attitude.covariance, rate_covariance=rate.covariance)
    suspended, free = model.body.suspended, free_axes(model.body)
    a, b, c, d = attitude.quaternion.tolist()
    quaternion = exponential(0.0, twist((a, b, c, d)), 0.0) if suspended else (a, b, c, d)
    x, y, z = (free * (rate.rate - prior.bias)).tolist()
    bx, by, bz = prior.bias.tolist()
    since = max(rate.time_ns - attitude.time_ns, 0) * 1e-9
    if since:
        quaternion = compose(exponential(since * x, since * y, since * z), quaternion)
    none = (0.0, 0.0, 0.0)
    state = FilterState(quaternion, (x, y, z), (bx, by, bz), none, prior.parameters, latency=prior.latency)
    newest: Measurement = attitude if attitude.time_ns >= rate.time_ns else rate
    alone = np.zeros((6, 6))
    alone[ATTITUDE, ATTITUDE] = attitude.covariance * np.outer(free, free)
    alone[RATE, RATE] = rate.covariance * np.outer(free, free)
    by_states = np.zeros((6, SIZE))
    # The gyro measures the sum of rate and bias, so the errors of the estimated rate and bias are opposite.
    by_states[RATE, BIAS] = -np.eye(3)
    if since:  # the error of the rate also changes the attitude
        by_states[ATTITUDE, BIAS] = -since * np.eye(3)
        alone[ATTITUDE, RATE] = alone[RATE, ATTITUDE] = since * alone[RATE, RATE]
        alone[ATTITUDE, ATTITUDE] += since**2 * alone[RATE, RATE]
    # The body moves during the age of the samples, so the errors of attitude, rate and age are correlated.
    change = model.rate_change(state, np.zeros((SIZE, SIZE)), newest.time_ns)
    by_states[ATTITUDE, LATENCY], by_states[RATE, LATENCY] = (x, y, z), change.acceleration
    return Checkpoint(newest, True, state, joined(layout.prior, by_states, alone))


OnApplied = Callable[[list[bool]], None]
"""Callback that receives, for each late measurement, whether the measurement passed the gate."""


@dataclass(slots=True, eq=False)
class _Branch:
    """A replay from the checkpoint `base` that includes late measurements and calls `applied` at the end."""

    base: Checkpoint
    replay: Replay
    late: Sequence[Measurement]
    applied: OnApplied


class AttitudeFilter:
    """The attitude filter with its recent checkpoints and the recent coil commands.

    Attributes:
        refused: number of measurements that did not pass the gate.
        late: number of measurements that were too late to be inserted.
        restarts: number of times that the filter discarded its estimate.
        nis: normalised innovation squared of the last measurement, or NaN if the measurement was not applied.
    """

    REJECTIONS_TO_RESTART = 40
    """Number of consecutive rejections of measurements of one kind after which the filter restarts."""
    REJECTIONS_AT_THE_START = 3
    """Number of consecutive rejections that restarts the filter while few measurements have been accepted.

    This number of rejections is small, because a wrong initial state should be discarded early.
    """

    def __init__(
        self, body: RigidBody, settings: AttitudeFilterSettings, prior: SlowPrior | None = None
    ) -> None:
        """Create a filter that has not started.

        By default, and after each restart, the prior of the slowly varying states follows from the settings.
        """
        self._settings = settings
        self._prior = prior or slow_prior(body, settings)
        self._commands = CommandHistory(body, settings.history_ns)
        self._layout = error_state(body, settings, self._prior)
        noise, gates = process_noise(body, settings, self._layout), gate_bounds(settings.gate_sigma)
        bias_prior = slow_prior(body, settings).bias_covariance
        self._model = PropagationModel(body, noise, self._commands, gates, bias_prior)
        self._check = CommandCheck(self._model)
        self._history = CheckpointHistory(settings.history_ns)
        self._branch: _Branch | None = None
        self._refused_in_a_row: dict[type[Measurement], int] = {}
        self._accepted: dict[type[Measurement], int] = {}
        self.refused = 0
        self.late = 0
        self.restarts = 0
        self.nis = math.nan

    def command(
        self, time_ns: int, currents: FloatArray, field: FloatArray | None = None, known: bool = True
    ) -> None:
        """Record the coil currents (3,), A, from `time_ns` on, and the field (3,), T, in reference axes.

        Commands must be recorded in order of time, each before the measurements that follow it. The default
        of `field` is the constant field of the body description. If `known` is false, the coils may carry
        other currents.
        """
        check = self._check
        self._commands.record(max(time_ns, check.ended_ns), currents, field, known and not check.active)

    def mark_unknown(self, since_ns: int, *, gyro: bool = False) -> None:
        """Treat the coil currents recorded since `since_ns` as unknown.

        If `gyro` is true, the gyro bias may also have changed at this time, and counts as unknown until
        attitude measurements determine it. The filter may have attributed the effect of wrong currents to a
        disturbance or a change of parameters. The measurements since `since_ns` are therefore applied again,
        a few at each call of `catch_up`. Raises ArgumentError for a time that is not finite.
        """
        check_finite(since_ns=since_ns)
        self.catch_up()
        index = max(self._history.index_before(since_ns), 1)
        if self._history:  # the replay must contain the time of the change
            since_ns = max(since_ns, self._history[index - 1].time_ns)
        self._commands.mark_unknown(since_ns, gyro=gyro)
        self._refused_in_a_row = {}
        again = self._history.measurements_from(index)
        if again:
            base = self._history[index - 1]
            self._branch = _Branch(base, Replay(self._model, base, again), (), lambda _: None)

    def start(self, attitude: AttitudeMeasurement, rate: RateMeasurement) -> None:
        """Start from an attitude and a gyro rate.

        For a suspended body, only the components of attitude and rate about the thread are used. Raises
        ArgumentError for values that are not finite.
        """
        first = first_checkpoint(self._model, self._layout, self._prior, attitude, rate)
        self._history.restart(first)
        self._discard_branch()
        self._refused_in_a_row = {}
        self._accepted = {}

    @property
    def started(self) -> bool:
        """Whether an estimate exists."""
        return bool(self._history)

    @property
    def measured_ns(self) -> int:
        """Time (ns) of the newest accepted measurement."""
        return self._history.newest_used.time_ns

    def measure(self, measurement: Measurement) -> bool:
        """Apply a measurement at its own time, and return False if it failed the gate or was too late.

        A measurement that follows the newest one by more than `LONGEST_GAP_NS` also fails the gate.
        """
        self.nis = math.nan
        # The comparison with `not` is also true for a time of NaN.
        if self._history and not measurement.time_ns - self._history.newest.time_ns <= LONGEST_GAP_NS:
            self._count(type(measurement), used=False)
            return False
        if self._branch is not None:
            if self._is_newest(measurement) and not isinstance(measurement, MeanRateMeasurement):
                self._branch.replay.add(measurement)
            else:
                self.catch_up()
        is_newest = self._is_newest(measurement)
        if is_newest and not isinstance(measurement, MeanRateMeasurement):
            newest = self._model.apply(self._history.newest, measurement)
            self._history.replace_from(len(self._history), (newest,))
            used, self.nis = newest.used, newest.nis
        elif is_newest:
            used = self._apply([measurement], measurement)
        elif (index := self._history.index_before(measurement.begin_ns)) > 0:
            # The first `index` checkpoints remain, and all later measurements are applied again.
            later = self._history.measurements_from(index)
            bisect.insort_right(later, measurement, key=lambda other: other.time_ns)
            self._history.replace_from(index, ())
            used = self._apply(later, measurement)
        else:
            self.late += 1
            return False
        self._count(type(measurement), used)
        if self._history and self._history.newest.measurement is measurement:
            since_ns = self._check.judge(self._history.newest)
            if since_ns is not None:
                self.mark_unknown(since_ns, gyro=True)
        if self._branch is None:  # the base checkpoint of a branch must not be dropped
            self._history.forget(measurement.time_ns)
        return used

    def measure_late(self, late: Sequence[Measurement], applied: OnApplied) -> None:
        """Insert late measurements at their measurement times, a few at each call of `catch_up`.

        The estimate continues without the late measurements until all are inserted. At the end of the replay,
        the callback `applied` receives, for each late measurement, whether the measurement passed the gate.
        """
        self.catch_up()
        index = self._history.index_before(min(m.begin_ns for m in late)) if self._history else 0
        if index == 0:
            self.late += len(late)
            applied([False] * len(late))
            return
        base = self._history[index - 1]
        again = [*self._history.measurements_from(index), *late]
        again.sort(key=lambda m: m.time_ns)
        self._branch = _Branch(base, Replay(self._model, base, again), late, applied)

    def catch_up(self, maximum: int | None = None) -> None:
        """Apply the next `maximum` measurements of an unfinished replay, by default all of them."""
        branch = self._branch
        if branch is None:
            return
        replay = branch.replay
        replay.advance(maximum)
        if not replay.done:
            return
        self._branch = None
        self._history.replace_from(self._history.index_of(branch.base) + 1, replay.checkpoints)
        used = [next(c.used for c in replay.checkpoints if c.measurement is m) for m in branch.late]
        for measurement, passed in zip(branch.late, used, strict=True):
            self._count(type(measurement), passed)
        branch.applied(used)

    def largest_dipole(self, begin_ns: int, end_ns: int) -> float:
        """Return the largest dipole moment (A m^2) that the coils may have had in an interval."""
        body, sizes = self._model.body, [0.0]
        for torquing, _ in self._commands.spans(begin_ns, end_ns):
            unknown = 0.0 if torquing.known else body.dipole_per_ampere * self._settings.unknown_current
            sizes.append(max(math.hypot(*torquing.dipole), unknown))
        return max(sizes)

    @property
    def doubts_commands(self) -> bool:
        """Whether the coil currents are treated as unknown because the motion contradicted the commands."""
        return self._check.active

    @property
    def latency(self) -> float:
        """Estimated age (s) of the inertial unit's samples, limited to plausible values."""
        found = self._history.newest.state.latency if self._history else self._prior.latency
        return min(max(found, 0.0), LONGEST_LATENCY)

    def at(self, time_ns: int) -> Estimate:
        """Return the newest estimate propagated to `time_ns`, without changing the filter.

        Raises ArgumentError if the filter has not started, or for a time more than `LONGEST_GAP_NS` after the
        newest measurement.
        """
        if not self._history:
            raise ArgumentError("time_ns", f"{time_ns}: the filter has not started: call start first")
        if not time_ns - self._history.newest.time_ns <= LONGEST_GAP_NS:
            raise ArgumentError(
                "time_ns",
                f"{time_ns}: more than an hour after the newest measurement at "
                f"{self._history.newest.time_ns} ns: give a time in ns near the measurements",
            )
        return self._model.estimate(self._history.newest, time_ns, self.measured_ns)

    def past(self, time_ns: int) -> Estimate | None:
        """Return the estimate at a past time, or None for a time before the recorded history."""
        then = self._history.at(time_ns)
        return None if then is None else self._model.estimate(then, time_ns, then.time_ns)

    def rates(self, begin_ns: int, end_ns: int) -> tuple[IntArray, FloatArray] | None:
        """Return times (n,) ns and rates (n, 3) rad/s of an interval, or None if the history is too short."""
        return self._history.rates(begin_ns, end_ns)

    def _is_newest(self, measurement: Measurement) -> bool:
        return bool(self._history) and measurement.begin_ns >= self._history.newest.time_ns

    def _apply(self, measurements: list[Measurement], asked: Measurement) -> bool:
        """Replay measurements in time order, and return whether the measurement `asked` passed."""
        replay = Replay(self._model, self._history.newest, measurements)
        replay.advance()
        self._history.replace_from(len(self._history), replay.checkpoints)
        mine = replay.checkpoints[-1]
        if mine.measurement is not asked:
            mine = next(c for c in replay.checkpoints if c.measurement is asked)
        self.nis = mine.nis
        return mine.used

    def _count(self, kind: type[Measurement], used: bool) -> None:
        """Count consecutive rejections, and restart after too many; mean rates cause no restart."""
        in_a_row = 0 if used else self._refused_in_a_row.get(kind, 0) + 1
        self._refused_in_a_row[kind] = in_a_row
        self.refused += not used
        accepted = self._accepted.get(kind, 0) + used
        self._accepted[kind] = accepted
        enough = min(max(accepted, self.REJECTIONS_AT_THE_START), self.REJECTIONS_TO_RESTART)
        if kind is not MeanRateMeasurement and in_a_row >= enough:
            self._history.restart(None)
            # The contradicted prior may be a wrong estimate from before the last boot.
            self._prior = slow_prior(self._model.body, self._settings)
            self._layout = error_state(self._model.body, self._settings, self._prior)
            self._refused_in_a_row = {}
            self.restarts += 1
            self._discard_branch()

    def _discard_branch(self) -> None:
        branch, self._branch = self._branch, None
        if branch is not None:
            branch.applied([False] * len(branch.late))
