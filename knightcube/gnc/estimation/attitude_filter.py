"""A MEKF of attitude, rate, gyro bias and disturbance that accepts late measurements.

Each measurement is applied at its own time. A late measurement is inserted at its own time, and all later
measurements are applied again. This is done at once, or in small steps while the filter continues without the
late measurement (module `replay`). A rate from a streaked image is the mean over the exposure: the attitude
at the start of the exposure is kept until its end. The age of the inertial unit's samples may be estimated
(module `mekf`). On the testbed's thread the same filter uses the component of each measurement about the
thread, and all other states stay constant. Torsion and damping of the thread are known, or estimated beside
the disturbance, from which they differ by their dependence on angle and rate.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from knightcube.astro import chi_square
from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.gnc.estimation.command_check import CommandCheck
from knightcube.gnc.estimation.estimate import (
    ATTITUDE,
    BIAS,
    DISTURBANCE,
    FIELD_BIAS,
    LATENCY,
    PARAMETERS,
    RATE,
    SIZE,
    Estimate,
    FilterState,
    SlowPrior,
)
from knightcube.gnc.estimation.measurements import (
    AttitudeMeasurement,
    MeanRateMeasurement,
    Measurement,
    RateMeasurement,
)
from knightcube.gnc.estimation.mekf import LONGEST_LATENCY
from knightcube.gnc.estimation.replay import (
    Checkpoint,
    CheckpointHistory,
    CommandHistory,
    PropagationModel,
    Replay,
)
from knightcube.gnc.estimation.rigid_body import LONGEST_STEP, ProcessNoise, RigidBody
from knightcube.gnc.estimation.rotation import exponential, twist


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterSettings:
    """Noise and limits of the filter.

    Attributes:
        current_noise: A, standard deviation of a driven coil's current, independent in each control cycle.
        control_period: s, duration of a control cycle.
        disturbance_walk: rad/s^2 per sqrt(s), random walk of the unmodelled acceleration.
        disturbance_start: rad/s^2, standard deviation of the unmodelled acceleration at the start.
        bias_walk: rad/s per sqrt(s), random walk of the gyro bias.
        bias_start: rad/s, standard deviation of the gyro bias at the start.
        torsion_start: 1/s^2, standard deviation of the thread's torsion at the start; zero if it is known.
        damping_start: 1/s, standard deviation of the thread's damping at the start; zero if it is known.
        gain_start: standard deviation of the coils' gain at the start; zero if it is known.
        latency_start: s, standard deviation of the age of the inertial unit's samples; zero if it is known.
        latency_walk: s per sqrt(s), random walk of that age.
        field_bias_start: T, standard deviation of the magnetometer bias at the start; zero without one.
        field_bias_walk: T per sqrt(s), random walk of the magnetometer bias and of the field model's error.
        rate_walk: rad/s per sqrt(s), white acceleration in addition to that of the coils.
        unknown_current: A, current assumed for each coil while it is unknown.
        gate_sigma: gate; a measurement less likely than this many sigma of one component is rejected.
        history_ns: largest delay of a measurement that is still used.
        longest_step: s, longest step of propagation; a slowly rotating body permits longer steps.
    """

    current_noise: float
    control_period: float
    disturbance_walk: float
    disturbance_start: float = 0.02
    bias_walk: float = 1e-7
    bias_start: float
    torsion_start: float
    damping_start: float
    gain_start: float
    latency_start: float
    latency_walk: float
    field_bias_start: float = 0.0
    field_bias_walk: float = 0.0
    rate_walk: float = 0.0
    unknown_current: float = 0.0
    gate_sigma: float
    history_ns: int
    longest_step: float = LONGEST_STEP

    def gates(self) -> dict[int, float]:
        """Return the chi-square bounds of the gate by degrees of freedom, 1 to 3."""
        chance = math.erfc(self.gate_sigma / math.sqrt(2.0))
        return {degrees: chi_square.bound(chance, degrees) for degrees in (1, 2, 3)}


def free_axes(body: RigidBody) -> FloatArray:
    """Return an array (3,) with 1 for each axis about which the body can rotate, and 0 for other axes."""
    return np.array([0.0, 1.0, 0.0]) if body.suspended else np.ones(3)


def process_noise(body: RigidBody, settings: FilterSettings) -> ProcessNoise:
    """Return the process noise of a body."""
    free = free_axes(body)
    walks = np.zeros(SIZE)
    walks[BIAS] = settings.bias_walk**2 * free
    walks[DISTURBANCE] = settings.disturbance_walk**2 * free
    walks[LATENCY] = settings.latency_walk**2
    walks[FIELD_BIAS] = settings.field_bias_walk**2
    return ProcessNoise(
        settings.current_noise**2 * settings.control_period,
        np.diag(settings.rate_walk**2 * free),
        walks,
        settings.unknown_current,
    )


def slow_prior(body: RigidBody, settings: FilterSettings) -> SlowPrior:
    """Return the prior of the slow states before any measurement."""
    thread = (settings.torsion_start**2, settings.damping_start**2) if body.suspended else (0.0, 0.0)
    return SlowPrior(
        bias_covariance=np.diag(settings.bias_start**2 * free_axes(body)),
        parameters=body.parameters,
        parameters_covariance=np.diag([*thread, settings.gain_start**2]),
        latency_variance=settings.latency_start**2,
    )


def first_checkpoint(
    model: PropagationModel,
    settings: FilterSettings,
    prior: SlowPrior,
    attitude: AttitudeMeasurement,
    rate: RateMeasurement,
) -> Checkpoint:
    """Return the first checkpoint, at the later measurement.

    For a suspended body, only the angle about the thread is taken from the measured attitude.
    """
    suspended, free = model.body.suspended, free_axes(model.body)
    a, b, c, d = attitude.quaternion.tolist()
    quaternion = exponential(0.0, twist((a, b, c, d)), 0.0) if suspended else (a, b, c, d)
    x, y, z = (free * (rate.rate - prior.bias)).tolist()
    bias_variance = prior.bias_covariance
    covariance = np.zeros((SIZE, SIZE))
    covariance[ATTITUDE, ATTITUDE] = attitude.covariance * np.outer(free, free)
    # The gyro measures the sum of rate and bias, so their errors are opposite.
    covariance[RATE, RATE] = rate.covariance * np.outer(free, free) + bias_variance
    covariance[RATE, BIAS] = covariance[BIAS, RATE] = -bias_variance
    covariance[BIAS, BIAS] = bias_variance
    covariance[DISTURBANCE, DISTURBANCE] = np.diag(settings.disturbance_start**2 * free)
    covariance[PARAMETERS, PARAMETERS] = prior.parameters_covariance
    covariance[FIELD_BIAS, FIELD_BIAS] = settings.field_bias_start**2 * np.eye(3)
    bx, by, bz = prior.bias.tolist()
    none = (0.0, 0.0, 0.0)
    state = FilterState(quaternion, (x, y, z), (bx, by, bz), none, prior.parameters, latency=prior.latency)
    newest: Measurement = attitude if attitude.time_ns >= rate.time_ns else rate
    # The body moves by the age of the samples: the errors of attitude, rate and age are correlated.
    age = np.zeros(SIZE)
    age[ATTITUDE], age[RATE] = (x, y, z), model.rate_change(state, covariance, newest.time_ns).acceleration
    age[LATENCY] = 1.0
    covariance += prior.latency_variance * np.outer(age, age)
    return Checkpoint(newest, True, state, covariance)


OnApplied = Callable[[list[bool]], None]
"""Function that receives one flag per late measurement: whether the measurement passed the gate."""


@dataclass(slots=True, eq=False)
class _Branch:
    """A replay with late measurements from the checkpoint `base` on; `applied` is called at its end."""

    base: Checkpoint
    replay: Replay
    late: Sequence[Measurement]
    applied: OnApplied


class AttitudeFilter:
    """Owns the estimate, its recent checkpoints and the recent commands.

    Attributes:
        refused: number of measurements that did not pass the gate.
        late: number of measurements that were too late to be inserted.
        restarts: number of times that the filter discarded its estimate.
        nis: normalised innovation squared of the last measurement, NaN without one.
    """

    REJECTIONS_TO_RESTART = 40
    """Number of rejections of attitudes, or of rates, in a row after which the filter restarts."""
    REJECTIONS_AT_THE_START = 3
    """Number of consecutive rejections after which the filter restarts while it has not accepted more
    measurements than it rejected, because its start may be wrong."""

    def __init__(self, body: RigidBody, settings: FilterSettings, prior: SlowPrior | None = None) -> None:
        """Use `prior` for the slow states of `body`; by default it follows from the settings."""
        self._settings = settings
        self._prior = prior or slow_prior(body, settings)
        self._commands = CommandHistory(body, settings.history_ns)
        noise = process_noise(body, settings)
        self._model = PropagationModel(body, noise, self._commands, settings.longest_step, settings.gates())
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
        """Record the coil currents (3,) A in force from `time_ns` on, and the field (3,) T, reference axes.

        Commands come in order of time, each before the measurements that follow it. Without `field` the field
        of the body is used. Currents that are not `known` are a guess.
        """
        check = self._check
        self._commands.record(max(time_ns, check.ended_ns), currents, field, known and not check.active)

    def mark_unknown(self, since_ns: int) -> None:
        """Treat the currents recorded since then as unknown: the coils may not have carried them.

        The measurements since then are applied again, a part at each `catch_up`: an apparent disturbance or
        change of parameters may have been caused by a current.
        """
        self.catch_up()
        self._commands.mark_unknown(since_ns)
        self._refused_in_a_row = {}
        index = max(self._history.index_before(since_ns), 1)
        again = self._history.measurements_from(index)
        if again:
            base = self._history[index - 1]
            self._branch = _Branch(base, Replay(self._model, base, again), (), lambda _: None)

    def start(self, attitude: AttitudeMeasurement, rate: RateMeasurement) -> None:
        """Start from one attitude and one rate; a suspended body uses their components about the thread."""
        first = first_checkpoint(self._model, self._settings, self._prior, attitude, rate)
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
        """Time of the newest accepted measurement."""
        return self._history.newest_used.time_ns

    def measure(self, measurement: Measurement) -> bool:
        """Apply a measurement at its own time; return False if it failed the gate or was too late."""
        self.nis = math.nan
        if self._branch is not None:
            if self._is_newest(measurement) and not isinstance(measurement, MeanRateMeasurement):
                self._branch.replay.add(measurement)
            else:
                self.catch_up()
        if self._is_newest(measurement):
            used = self._apply([measurement], measurement)
        elif (index := self._history.index_before(measurement.begin_ns)) > 0:
            # Return to the first `index` checkpoints and apply the later measurements again.
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
                self.mark_unknown(since_ns)
        if self._branch is None:  # a branch needs its base
            self._history.forget(measurement.time_ns)
        return used

    def measure_late(self, late: Sequence[Measurement], applied: OnApplied) -> None:
        """Insert late measurements at their own times, a part of the work at each `catch_up`.

        `applied` is called at the end with one flag per measurement: whether it passed the gate. Until then
        the estimate continues without them.
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
        """Continue a replay by `maximum` measurements, or to its end, where it becomes the estimate."""
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

    @property
    def doubts_commands(self) -> bool:
        """Whether the motion contradicts the commands, so that the coil currents are unknown."""
        return self._check.active

    @property
    def latency(self) -> float:
        """Estimated age of the inertial unit's samples at their time stamp, s, within plausible limits."""
        found = self._history.newest.state.latency if self._history else self._prior.latency
        return min(max(found, 0.0), LONGEST_LATENCY)

    def at(self, time_ns: int) -> Estimate:
        """Return the estimate propagated to `time_ns`; the filter does not change."""
        return self._model.estimate(self._history.newest, time_ns, self.measured_ns)

    def past(self, time_ns: int) -> Estimate | None:
        """Return the estimate at a past time; None before the first checkpoint of the history."""
        then = self._history.at(time_ns)
        return None if then is None else self._model.estimate(then, time_ns, then.time_ns)

    def rates(self, begin_ns: int, end_ns: int) -> tuple[IntArray, FloatArray] | None:
        """Return times (n,) ns and rates (n, 3) rad/s that span an interval; None outside the history."""
        return self._history.rates(begin_ns, end_ns)

    def _is_newest(self, measurement: Measurement) -> bool:
        return bool(self._history) and measurement.begin_ns >= self._history.newest.time_ns

    def _apply(self, measurements: list[Measurement], asked: Measurement) -> bool:
        """Apply measurements in order of time after the newest checkpoint.

        Return whether `asked` was used.
        """
        replay = Replay(self._model, self._history.newest, measurements)
        replay.advance()
        self._history.replace_from(len(self._history), replay.checkpoints)
        mine = next(c for c in replay.checkpoints if c.measurement is asked)
        self.nis = mine.nis
        return mine.used

    def _count(self, kind: type[Measurement], used: bool) -> None:
        """Count consecutive rejections, and restart the filter after too many rejections.

        Mean rates are too rare to restart the filter.
        """
        in_a_row = 0 if used else self._refused_in_a_row.get(kind, 0) + 1
        self._refused_in_a_row[kind] = in_a_row
        self.refused += not used
        accepted = self._accepted.get(kind, 0) + used
        self._accepted[kind] = accepted
        enough = min(max(accepted, self.REJECTIONS_AT_THE_START), self.REJECTIONS_TO_RESTART)
        if kind is not MeanRateMeasurement and in_a_row >= enough:
            self._history.restart(None)
            self._refused_in_a_row = {}
            self.restarts += 1
            self._discard_branch()

    def _discard_branch(self) -> None:
        branch, self._branch = self._branch, None
        if branch is not None:
            branch.applied([False] * len(branch.late))
