"""Detumbling of a free satellite with the magnetometer, and with gyro and attitude if available.

The field of the coils disturbs the magnetometer. The coils are therefore switched off periodically, until
their field has decayed and the field is measured. The driven phase between two pauses is short while the
estimated rate is uncertain. The filter `knightcube.gnc.estimation.field_rate` uses the field samples in the
coil pauses to estimate all components of the body rate and the rotation of the field in inertial axes. A gyro
sample shows the rate along the field immediately.

The momentum plan uses the field predicted along the orbit, if the orbit is known. If the attitude is unknown,
the predicted field is rotated so that its direction and change agree with the measured field. If the orbit is
unknown, the measured field is assumed to continue to rotate at the present rate. In an orbit near the
equator, however, the field's direction only oscillates by some 20 deg. In contrast to B-dot control, this
detumbler also removes a spin along the field as soon as the field has rotated. The coils stay off until
`TRUSTED` consecutive samples, also samples outside the pauses, agree with the prediction of the filter and
the standard deviation of the rate across the field is below `BOUNDED`. Without a gyro, the coils also stay
off during the time `LISTENED` after the begin. A plan needs the direction in which the field rotates, and
continuous samples show this direction much sooner than samples in pauses. A plan with a wrong direction adds
momentum. The coils are switched off again if no sample was accepted for `SILENT_PERIODS` periods, because a
restarted sensor may give only unusable fields.

The filter also estimates the bias of the magnetometer and the matrix of the coils, so a dead or reversed coil
falsifies neither the rate nor the plan. If the measured field usually changes during the pauses, the field of
the coils decays more slowly than configured. The pauses then become longer.

The plan stops the body in the minimum time with the predicted field. In inertial axes the angular momentum h
obeys h' = m x B, where m is the dipole moment and B the field. This equation contains neither the inertia nor
the attitude. By Pontryagin's principle, the dipole moment of minimum time has the maximum magnitude L and the
direction of -B x y, where the costate y is a constant vector. The momentum can be reduced to at most r within
the time T if and only if every vector y satisfies the inequality

    h . y <= L (integral of |B x y| over the time T) + r |y|.

The minimum time is the smallest T for which every vector y satisfies this inequality, and the planned costate
is the vector y for which both sides are equal. For this costate, A(y) y is parallel to h, where A is the
integral of L (B^2 I - B B^T) / |B x y| plus r / |y|. The costate is found by iteratively reweighted least
squares: in each iteration, A is computed from the previous costate, and the next costate from A. Momentum
along the field can be removed only after the field has rotated, so the plan may first add momentum across the
field. The plan leaves a residual momentum r, because the removal of the last momentum along a slowly rotating
field would take most of the time.

If a body spins along the field, the minimum-time plan first accelerates the body about an axis across the
field. The settings `gentle` and `spin_up` therefore give upper bounds of the rate and of the kinetic energy.
At a bound, the commanded dipole moment does not increase the rate or the energy. If the bounds equal the
initial rate and energy, detumbling takes longer, because a spin along the field is then stopped only after
the field has rotated by a right angle.

The magnetometer alone shows the rate along the field only after the field has rotated. Until all components
of the rate are known, the coils therefore do no positive work. The work of the coils depends on the rate
across the field, but neither on the rate along the field nor on the inertia tensor. Without a torque, the
rate of a body with unequal moments of inertia changes, but its kinetic energy does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np

from knightcube.astro.arrays import (
    FloatArray,
    brief,
    check_finite,
    cross_matrix,
    cross_product,
    finite_array,
    float_rows,
    unit_vector,
)
from knightcube.astro.quaternion import (
    attitude_matrix,
    compose,
    from_rotation_vector,
    inverse,
    matrix,
    times,
)
from knightcube.errors import ArgumentError, UsageError
from knightcube.gnc.control.detumble import WindowSchedule
from knightcube.gnc.estimation.error_state import check_amounts
from knightcube.gnc.estimation.field_rate import RATE, FieldRate, FieldRateSettings

ITERATIONS = 12
LIMIT_GAIN = 1.5
"""Dipole moment of three saturated coils along a direction, averaged over all directions and divided by the
mean limit of the body axes."""
STEEP = 12.0
"""Gain of the dipole moment: a coil reaches the dipole limit if |B x y| (field B, costate y) exceeds the mean
of |B x y| divided by this gain. The minimum-time plan would always saturate all coils, but noise of B would
then reverse the coil currents when B x y is small."""
FLAT = 0.02
"""Lower bound of |B x y| (field B, costate y), as a fraction of the largest |B x y|. The bound keeps the
weights of the iteration finite."""
FINENESS = 60
"""Ratio of the minimum time to the tolerance of the search for this time."""


@dataclass(frozen=True, slots=True, eq=False)
class MomentumPlan:
    """A plan that removes the momentum in minimum time.

    Attributes:
        costate: scaled costate y (3,), inertial axes, A m^2/T, or zero for a body at rest. In the field B,
            the commanded dipole moment of coils without errors is -B x y, clipped at the limit of each coil.
        horizon: time until the body is at rest, s.
    """

    costate: FloatArray
    horizon: float


def momentum_plan(
    momentum: FloatArray, field: FloatArray, times: FloatArray, limit: float, rest: float
) -> MomentumPlan:
    """Return the plan that reduces the momentum (3,), N m s, to the magnitude `rest`, N m s, in minimum time.

    The predicted field after `times` (n,), s, is `field` (n, 3), T, in the inertial axes of the momentum. The
    mean dipole limit of the body axes is `limit`, A m^2. If the field prediction ends too early, the plan
    removes as much momentum as possible until the end of the prediction. Raises UsageError for fewer than
    three instants, and ArgumentError for values that are not finite, for a field that is always zero, for
    times that do not increase, and for a limit that is not positive.
    """
    if len(field) < 3:
        raise UsageError(f"a momentum plan needs the field at three instants, not {len(field)}")
    check_finite(momentum=momentum, field=field, times=times, limit=limit, rest=rest)
    if not field.any():
        raise ArgumentError("field", "zero at all instants: give the field in T")
    if not (np.diff(times) > 0.0).all():
        raise ArgumentError("times", f"{brief(times.tolist())}: give increasing times in s")
    if limit <= 0.0:
        raise ArgumentError("limit", f"{limit}: give a dipole limit above zero A m^2")
    size = math.sqrt(float(momentum @ momentum))
    if size <= rest:
        return MomentumPlan(np.zeros(3), 0.0)
    spans = np.diff(times, append=2.0 * times[-1] - times[-2])
    square = np.einsum("ni,ni->n", field, field)
    effect = square[:, None, None] * np.eye(3) - field[:, :, None] * field[:, None, :]
    ahead = _FieldPreview(field, (effect * spans[:, None, None]).reshape(-1, 9), LIMIT_GAIN * limit, rest)
    short, long = 2, len(field)
    costate = ahead.worst(momentum, long, momentum / size)
    while long - short > 1 and times[long - 1] - times[short - 1] > times[short - 1] / FINENESS:
        middle = (short + long) // 2
        found = ahead.worst(momentum, middle, costate)
        if float(momentum @ found) > float(found @ ahead.matrix(found, middle) @ found):
            short = middle
        else:
            costate, long = found, middle
    mean = float(ahead.across(costate, long) @ spans[:long]) / float(spans[:long].sum())
    return MomentumPlan(costate * (STEEP * limit / mean), float(times[long - 1] + spans[long - 1]))


_NO_DIPOLE: FloatArray = np.zeros(3)
_IDENTITY: FloatArray = np.eye(3)


def braking_dipole(
    costate: FloatArray, field: FloatArray, limit: float | FloatArray, coils: FloatArray = _IDENTITY
) -> FloatArray:
    """Return the dipole moment (3,), A m^2, that a plan commands in a field (3,), T, body axes.

    Each component is clipped separately at the limit of its body axis, because each coil removes momentum
    independently of the other coils. The matrix C (3, 3) from the commanded dipole moment m to the actual
    dipole moment is `coils`. The torque C m x B in the field B reduces the momentum along the costate y at
    the rate m . C' (y x B). Raises ArgumentError for values that are not finite.
    """
    wanted = coils.T @ cross_product(costate, field)
    if not math.isfinite(float(wanted @ wanted)):
        check_finite(costate=costate, field=field, coils=coils)
    check_finite(limit=limit)
    return np.asarray(np.minimum(np.maximum(wanted, -limit), limit))


def without_growth(dipole: FloatArray, grows: Sequence[FloatArray]) -> FloatArray:
    """Return the dipole moment (3,) without the part that increases bounded quantities such as the rate.

    Each element (3,) of `grows` is the derivative of the growth rate of one quantity with respect to the
    dipole moment. The argument `grows` has at most two elements. No component of the result is larger than
    the largest component of the given dipole moment.
    """
    for one in chain([dipole], (_orthogonal(dipole, vector) for vector in grows)):
        limits = [_ROUNDING * math.sqrt(float(one @ one) * float(vector @ vector)) for vector in grows]
        if all(float(one @ vector) <= limit for vector, limit in zip(grows, limits, strict=True)):
            return one
    return _NO_DIPOLE


def _orthogonal(dipole: FloatArray, vector: FloatArray) -> FloatArray:
    """Return the part (3,) of a dipole moment that is orthogonal to a vector (3,).

    The result is scaled down if one of its components would exceed the largest component of `dipole`.
    """
    square = float(vector @ vector)
    if square == 0.0:
        return dipole
    left = dipole - vector * (float(dipole @ vector) / square)
    largest, before = float(np.abs(left).max()), float(np.abs(dipole).max())
    return left if largest <= before else left * (before / largest)


def rotating_field(field: FloatArray, change: FloatArray, times: FloatArray) -> FloatArray:
    """Return the predicted field (n, 3), T, after `times` (n,), s, if the field rotates at its present rate.

    The field (3,), T, and the time derivative `change` (3,), T/s, of the field are in inertial axes. The
    field strength is assumed to be constant. Raises ArgumentError for a field that is zero or not finite.
    """
    along, strength = unit_vector("field", field), math.sqrt(float(field @ field))
    across = change - along * float(along @ change)
    speed = math.sqrt(float(across @ across)) / strength
    if speed == 0.0:
        return np.broadcast_to(field, (len(times), 3)).copy()
    angle = speed * times[:, None]
    return np.asarray(strength * np.cos(angle) * along + np.sin(angle) * across / speed)


def aligned_to(fields: FloatArray, field: FloatArray) -> FloatArray:
    """Return `fields` (n, 3), rotated so that the first predicted field has the direction of `field` (3,).

    The measured field is more accurate than fields predicted with a coarse attitude. Raises ArgumentError for
    a field that is zero or not finite.
    """
    first, wanted = unit_vector("fields", fields[0]), unit_vector("field", field)
    middle = first + wanted
    square = float(middle @ middle)
    if square < 1.0:  # a predicted direction with an error of more than 120 deg is not corrected
        return fields
    # The rotation is the product of two rotations by 180 deg, about the bisector and the final direction.
    halves = 2.0 * np.outer(middle, middle) / square - np.eye(3)
    back = 2.0 * np.outer(wanted, wanted) - np.eye(3)
    return np.asarray(fields @ (back @ halves).T)


def aligned_to_change(
    fields: FloatArray, times: FloatArray, field: FloatArray, change: FloatArray
) -> FloatArray:
    """Return `fields` (n, 3), rotated to the direction and the change of the present field.

    The fields are predictions for `times` (n,), s from now, in any inertial axes. The first field of the
    result has the direction of `field` (3,), and the following fields rotate in the direction of the time
    derivative `change` (3,).
    """
    soon = min(int(np.searchsorted(times, CHANGED)), len(times) - 1)
    predicted = _axes(fields[0], fields[soon] - fields[0])
    return np.asarray(fields @ predicted.T @ _axes(field, change))


def _axes(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return orthonormal axes (3, 3) as rows, the first along `first` (3,), the second towards `second`."""
    along = first / math.sqrt(float(first @ first))
    across = second - along * float(along @ second)
    if not across.any():  # for a field that does not rotate, any second axis is suitable
        across = cross_product(along, np.eye(3)[int(np.abs(along).argmin())])
    across /= math.sqrt(float(across @ across))
    return np.array([along, across, cross_product(along, across)])


def _agree(predicted: FloatArray, measured: FloatArray) -> bool:
    """Return whether the strengths of two fields (3,) differ by less than the fraction `STRENGTH`."""
    ratio = math.sqrt(float(predicted @ predicted) / float(measured @ measured))
    return abs(ratio - 1.0) < STRENGTH


@dataclass(frozen=True, slots=True, eq=False)
class _FieldPreview:
    """The predicted magnetic field during a momentum plan, in the axes of the plan.

    Attributes:
        field: predicted magnetic field (n, 3), T.
        effect: elements (n, 9) of the matrices B^2 I - B B^T, each multiplied by the time step.
        reach: maximum magnitude L of the dipole moment, A m^2.
        rest: residual momentum r of the plan, N m s.
    """

    field: FloatArray
    effect: FloatArray
    reach: float
    rest: float

    def across(self, y: FloatArray, count: int) -> FloatArray:
        """Return |B x y| at the first `count` instants, bounded below by a small positive value."""
        found = self.field[:count] @ cross_matrix(y)
        across = np.sqrt(np.einsum("ni,ni->n", found, found))
        strength = math.sqrt(float(self.field[0] @ self.field[0]))
        return np.asarray(np.maximum(across, FLAT * max(float(across.max()), FLAT * strength)))

    def matrix(self, y: FloatArray, count: int) -> FloatArray:
        """Return A(y) (3, 3) of the first `count` instants, which maps the next costate to the momentum."""
        weight = self.reach / self.across(y, count)
        return np.asarray((weight @ self.effect[:count]).reshape(3, 3) + self.rest * _IDENTITY)

    def worst(self, momentum: FloatArray, count: int, guess: FloatArray) -> FloatArray:
        """Return the direction (3,) along which coils remove the least momentum in `count` instants."""
        y = guess
        for _ in range(ITERATIONS):
            found = np.linalg.solve(self.matrix(y, count), momentum)
            y = np.asarray(found / math.sqrt(float(found @ found)))
        return y


TRUSTED = 4
"""Number of consecutive samples that must agree with the filter before the coils are driven."""
BOUNDED = 0.02
"""Largest standard deviation (rad/s) of the rate across the field at which the coils may be driven."""
LISTENED = 10_000_000_000
"""Time (ns) after `begin` in which the coils stay off, unless the standard deviation of every rate component
is already below `KNOWN`. A gyro causes such a small standard deviation."""
SILENT_PERIODS = 2
"""Number of coil pauses without an accepted sample after which the coils are switched off again."""
DRIFT = 0.015
"""Largest rotation error (rad) that one standard deviation of the rate may cause in a driven phase. The error
of a measured field's direction is about as large, so the predicted field is nearly as accurate as a measured
field."""
SHORTEST = 9
"""Shortest driven phase while the rate is uncertain, as a multiple of the coil pause."""
PAUSES, DECAYING, LARGEST_CHANGE = 8, 4.0, 12.0
"""Number of coil pauses over which the normalised square of the field change during a pause is averaged, mean
square above which the pauses become longer, and value at which each square is clipped, so that two outliers
do not lengthen the pauses. Noise alone causes a mean square of 1."""
OLDEST_NS = 100_000_000
"""Largest age (ns) of an accepted sample; a late sample is propagated to the present with the body rate."""
CHANGED = 30.0
"""Time (s) over which the predicted change of the field shows the direction in which the field rotates."""
STRENGTH = 0.2
"""Difference between predicted and measured field strength above which the orbit counts as wrong, as a
fraction of the measured strength."""
INSTANTS = 150
DENSER = 1.5
"""Exponent of the power law that makes the times of the field prediction denser at the start. For a
prediction over 1,500 s, the first time step is 1 s and the last time step 15 s."""
LEFT = 0.9
"""Residual momentum of a plan, as a fraction of the momentum at which a body counts as detumbled."""
FEW, SOON = 4.0, 5.0
"""Largest momentum in the last phase of detumbling, as a multiple of the residual momentum of a plan, and
duration (s) of this phase. A momentum below 4 times (FEW) the residual momentum is removed within 5 s (SOON)
if its component along the field is below the residual momentum."""
KNOWN, KNOWN_SHARE = 2e-3, 0.1
"""Standard deviation of the least certain rate component below which the upper bounds of rate and energy are
set, in rad/s (first value) or as a fraction of the rate (second value)."""
_SECOND = 1e-9
_ROUNDING = 1e-9
"""Rounding error of a scalar product that should be zero, divided by the lengths of both vectors."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldDetumblerSettings:
    """Settings of the field detumbler.

    Attributes:
        limit: dipole limit (A m^2) along each body axis, one number for all axes or an array (3,).
        horizon: duration of the field prediction, about a quarter of an orbit, s.
        replan: time between momentum plans, s.
        gentle: largest initial rate that is itself the upper bound of the rate, rad/s.
        spin_up: ratio of the upper bound of the rate to the initial rate if the initial rate is above
            `gentle`.
        slow: rate below which a body counts as detumbled, rad/s.
    """

    limit: float | FloatArray
    horizon: float
    replan: float
    gentle: float
    spin_up: float
    slow: float

    def __post_init__(self) -> None:
        """Raise ArgumentError for settings that are not finite and positive."""
        check_amounts(self, "limit", "horizon", "replan", "gentle", "spin_up", "slow")

    @property
    def instants(self) -> FloatArray:
        """Times (n,), s, after the start of a plan, at which the field is predicted; denser at the start."""
        return np.asarray(self.horizon * (np.arange(INSTANTS) / INSTANTS) ** DENSER, dtype=float)


class FieldPrediction(NamedTuple):
    """The magnetic field (n, 3), T, predicted at the instants of a plan, in body axes or in inertial axes."""

    field: FloatArray
    in_body_axes: bool


class _Pause(NamedTuple):
    """The first field after a driven phase, with the estimates at that time.

    Attributes:
        time_ns: time of the first field, ns.
        field: first field (3,) T without the estimated bias, body axes.
        rate: estimated body rate (3,), rad/s.
        bias: estimated bias (3,) of the magnetometer, T.
        square: normalised square of the change from the first to the newest field, or None for one field. Its
            mean is 1 for noise.
    """

    time_ns: int
    field: FloatArray
    rate: FloatArray
    bias: FloatArray
    square: float | None = None


class FieldDetumbler:
    """A detumbler that accepts magnetometer samples and computes the dipole moment of each cycle."""

    def __init__(
        self,
        schedule: WindowSchedule,
        braking: FieldDetumblerSettings,
        settings: FieldRateSettings,
        expected: Callable[[int], FieldPrediction | None] = lambda _: None,
    ) -> None:
        """Create a detumbler whose rate filter has not started.

        The function `expected` predicts the field at `braking.instants` after a given time. The axes are the
        body axes at that time or, if the attitude is unknown, inertial axes. The function `expected` returns
        None while the orbit is unknown.
        """
        self._schedule = schedule
        self._braking = braking
        self._expected = expected
        self._filter = FieldRate(settings)
        self._sigma, self._sigma_of = math.inf, self._filter.covariance
        # A residual momentum causes the fastest rotation about the axis of the smallest moment of inertia.
        self._rest = LEFT * braking.slow * float(np.linalg.eigvalsh(settings.inertia)[0])
        self._settle_ns = schedule.settle_ns  # longer if the coil field decays more slowly than configured
        self._unsettled = 1.0  # mean normalised square of the field change within a pause
        self.begin(0)

    def begin(self, now_ns: int) -> None:
        """Begin the first pause without knowledge of the field."""
        self._begun_ns = self._time_ns = self._commanded_ns = now_ns
        self._listened_ns = now_ns + LISTENED
        self._dipole = _NO_DIPOLE
        self._plan: MomentumPlan | None = None
        self._planned_ns = now_ns
        self._planned_rotation = _NO_DIPOLE
        self._agreed = 0
        self._bounded = False
        self._driven_ns = now_ns  # another flight mode may have driven the coils until now
        self._accepted_ns = now_ns
        self._fastest = self._most_energy = math.inf
        self._initial_known = False
        self._act_ns = self._shortest_ns
        self._pause: _Pause | None = None
        self._filter.restart()

    def renew_coils(self) -> None:
        """Forget the estimated matrix of the coils, because the coils or their assumed signs have changed."""
        self._filter.renew_coils()

    def renew_magnetometer(self) -> None:
        """Estimate the rate again, because a different magnetometer is read from now on."""
        self._filter.restart()
        self._distrust()

    def listens(self, time_ns: int) -> bool:
        """Return whether the coils were off and their field had decayed at `time_ns`."""
        if not self.trusted and time_ns - self._driven_ns >= self._settle_ns:
            return True
        phase_ns = (time_ns - self._begun_ns) % (self._pause_ns + self._act_ns)
        return time_ns >= self._begun_ns and self._settle_ns <= phase_ns < self._pause_ns

    def sample(self, time_ns: int, field: FloatArray, rate: FloatArray | None = None) -> None:
        """Accept a field (3,), T, measured at `time_ns`, or ignore it if the coils disturbed the measurement.

        The argument `rate` (3,), rad/s, is the gyro rate measured at the same time, or None. The sample may
        be older than the last command.
        """
        age_ns, field = self._time_ns - time_ns, float_rows("field", field, 3)
        if not self.listens(time_ns) or age_ns > OLDEST_NS:
            return
        starts, revisions = self._filter.restarts, self._filter.revisions
        if age_ns < 0:
            self._advance(time_ns)
        self._watch_decay(time_ns, field)
        accepted = self._filter.measure(field, max(age_ns, 0) * _SECOND)
        if accepted:
            self._accepted_ns = time_ns
        if accepted and self._filter.started:
            self._agreed += 1
            if rate is not None and self._agreed >= TRUSTED:
                self._filter.measure_rate(rate)
            if not self._bounded:
                self._bounded = self._agreed >= TRUSTED and self._is_bounded(time_ns)
        if self._filter.restarts != starts or (not accepted and not self.trusted):
            self._distrust()
        elif self._filter.revisions != revisions:
            self._plan = None  # the plan belongs to the rotation of another estimate
        longest_ns = DRIFT / self.rate_sigma / _SECOND
        self._act_ns = round(min(self._schedule.act_ns, max(longest_ns, self._shortest_ns)))

    def _is_bounded(self, time_ns: int) -> bool:
        """Return whether the estimated rate at `time_ns` is accurate enough for the coils to be driven."""
        measured, spread = self._filter.field, self._filter.covariance[RATE, RATE]
        if time_ns < self._listened_ns and float(np.linalg.eigvalsh(spread)[-1]) >= KNOWN**2:
            return False
        across = np.eye(3) - np.outer(measured, measured) / float(measured @ measured)
        return float(np.linalg.eigvalsh(across @ spread @ across)[-1]) < BOUNDED**2

    def dipole(self, now_ns: int) -> FloatArray:
        """Return the dipole moment (3,), A m^2: zero while the field is measured or the rate is unknown."""
        schedule = self._schedule
        if self._filter.started:  # until the filter has started, its time is that of the newest sample
            self._advance(max(now_ns, self._time_ns))
        if self.trusted and now_ns - self._accepted_ns > SILENT_PERIODS * schedule.period_ns:
            self._distrust()
        phase_ns = (now_ns - self._begun_ns) % (self._pause_ns + self._act_ns)
        self._begun_ns = (
            now_ns - phase_ns
        )  # the duration of the driven phase varies, so time is counted from the last pause
        acting = phase_ns >= self._pause_ns
        if acting:
            self._judge_decay()
        self._commanded_ns = now_ns
        self.acts(self._braking_dipole(now_ns) if acting and self.trusted else _NO_DIPOLE)
        return self._dipole

    def acts(self, dipole: FloatArray) -> None:
        """Set the dipole moment (3,), A m^2, of the currents sent to the coils until the next command.

        Raises ArgumentError for a dipole moment that is not finite.
        """
        dipole = finite_array("dipole", dipole, (3,))
        if self._dipole.any() or dipole.any():
            self._driven_ns = self._commanded_ns
        self._dipole = dipole

    @property
    def next_pause_ns(self) -> int:
        """Time (ns) of the next coil pause for a field measurement, as planned at the last command."""
        return self._begun_ns + self._pause_ns + self._act_ns

    def _watch_decay(self, time_ns: int, field: FloatArray) -> None:
        """Compare a field (3,) T with the first field of the pause, propagated with the body rate."""
        found, pause = self._filter, self._pause
        if not found.started or not np.isfinite(field).all():
            return
        if pause is None:
            if self.trusted:  # otherwise the coils were off, and their field has decayed
                self._pause = _Pause(time_ns, field - found.bias, found.rate, found.bias)
            return
        rotation = from_rotation_vector((time_ns - pause.time_ns) * _SECOND * pause.rate)
        change = field - pause.bias - attitude_matrix(rotation) @ pause.field
        square = float(change @ change) / (6.0 * found.field_sigma**2)
        self._pause = pause._replace(square=square)

    def _judge_decay(self) -> None:
        """End a pause, and lengthen the pauses if the coil field usually decays during the measurement."""
        pause, schedule = self._pause, self._schedule
        self._pause = None
        if pause is None or pause.square is None:
            return
        self._unsettled += (min(pause.square, LARGEST_CHANGE) - self._unsettled) / PAUSES
        if self._unsettled > DECAYING and 2 * self._settle_ns < schedule.act_ns:
            self._settle_ns += max(schedule.settle_ns, schedule.measure_ns)
            self._unsettled = 1.0

    @property
    def _pause_ns(self) -> int:
        return self._settle_ns + self._schedule.measure_ns

    @property
    def _shortest_ns(self) -> int:
        return min(self._schedule.act_ns, SHORTEST * self._pause_ns)

    @property
    def trusted(self) -> bool:
        """Whether enough samples agreed with the filter and the estimated rate is accurate enough."""
        return self._bounded

    @property
    def rate(self) -> FloatArray | None:
        """Body rate (3,), rad/s, or None while the rate is unknown."""
        return self._filter.rate if self.trusted else None

    @property
    def field(self) -> FloatArray | None:
        """Estimated present field (3,) in body axes, T, or None while the rate is unknown."""
        return self._filter.field if self.trusted else None

    @property
    def rate_sigma(self) -> float:
        """Standard deviation (rad/s) of the least certain rate component; infinite for an unknown rate."""
        if not self.trusted:
            return math.inf
        covariance = self._filter.covariance
        if covariance is not self._sigma_of:
            self._sigma_of = covariance
            self._sigma = math.sqrt(float(np.linalg.eigvalsh(covariance[RATE, RATE])[-1]))
        return self._sigma

    @property
    def restarts(self) -> int:
        """Number of restarts of the rate filter after contradictory or noisy samples, as in a fast spin."""
        return self._filter.restarts

    def _distrust(self) -> None:
        """Switch the coils off until enough magnetometer samples agree with the prediction of the filter."""
        self._agreed, self._bounded = 0, False
        self._plan = None

    def _advance(self, time_ns: int) -> None:
        self._filter.advance(self._dipole, (time_ns - self._time_ns) * _SECOND)
        self._time_ns = time_ns

    def _braking_dipole(self, now_ns: int) -> FloatArray:
        found, braking = self._filter, self._braking
        field, rate, momentum = found.field, found.rate, found.momentum
        coils = found.coil_matrix
        dipole = braking_dipole(self._costate(now_ns), field, braking.limit, coils)
        speed, energy = math.sqrt(float(rate @ rate)), 0.5 * float(rate @ momentum)
        sigma, works = self.rate_sigma, coils.T @ cross_product(field, rate)
        if not self._initial_known:
            if sigma >= max(KNOWN, KNOWN_SHARE * speed):
                return without_growth(dipole, [works])
            self._initial_known = True
            multiple = braking.spin_up if speed > braking.gentle else 1.0
            self._fastest, self._most_energy = multiple * speed, multiple * multiple * energy
        # Each bound is compared with the estimate plus one standard deviation of the rate.
        upper = speed + sigma
        grows = [works] if energy * upper**2 >= self._most_energy * speed**2 else []
        if upper >= self._fastest:
            grows.append(coils.T @ cross_product(field, found.inverse @ rate))
        return without_growth(dipole, grows)

    def _costate(self, now_ns: int) -> FloatArray:
        """Return the costate (3,) A m^2/T of the plan in the present body axes."""
        found = self._filter
        field, momentum = found.field, found.momentum
        square, along = float(field @ field), float(momentum @ field)
        little = float(momentum @ momentum) <= (FEW * self._rest) ** 2
        if little and along * along <= square * self._rest**2:
            return np.asarray(momentum / (square * SOON))
        if self._plan is None or (now_ns - self._planned_ns) * _SECOND >= self._braking.replan:
            self._plan, self._planned_ns, self._planned_rotation = (
                self._planned(now_ns),
                now_ns,
                found.rotation,
            )
        # The costate is constant in inertial axes, so it is rotated into the present body axes.
        a, b, c, d = found.rotation.tolist()
        e, f, g, h = self._planned_rotation.tolist()
        x, y, z = self._plan.costate.tolist()
        return np.array(times(matrix(compose((a, b, c, d), inverse((e, f, g, h)))), (x, y, z)))

    def _planned(self, now_ns: int) -> MomentumPlan:
        """Return a momentum plan in the present body axes."""
        found, times = self._filter, self._braking.instants
        expected = self._expected(now_ns)
        if expected is None or not (expected.in_body_axes or _agree(expected.field[0], found.field)):
            ahead = rotating_field(found.field, found.change, times)
        elif expected.in_body_axes:
            ahead = aligned_to(expected.field, found.field)
        else:
            ahead = aligned_to_change(expected.field, times, found.field, found.change)
        share = self._act_ns / (self._pause_ns + self._act_ns)
        limit = share * float(np.mean(self._braking.limit))
        return momentum_plan(found.momentum, ahead, times, limit, self._rest)
