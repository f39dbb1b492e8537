"""The motion of a rigid body as the filters model it: Euler's equation and propagation with covariance.

The equation of motion is J w' = -w x J w + m x A(q) B + thread torque (Sease, eq. (5.2), corrected), where m
is the dipole moment of the coils. A body suspended from the testbed's thread rotates only about its y axis.
For such a suspended body, a torque T causes the acceleration T_y / J22 about y, and the thread adds the
torque -k theta - c w (Sease, eq. (5.4)).

The function `propagate` integrates state and covariance. The attitude error is a small rotation about the
body axes. Unmodelled angular accelerations are represented by random walks.

Without torque the angular acceleration is a quadratic form of the rate, w' = Q p(w), where p are the six
products of the rate's components. Errors of the inertia tensor, and of the gyro's scale and alignment, only
change the coefficients Q. A fit that estimates the errors of Q as nuisance parameters is therefore
insensitive to errors of inertia and gyro (Psiaki 2005, JGCD 28(4), and Pittelkau 2001, JGCD 24(6)). The
function `fitted_gains` fits the gains of the coils together with such nuisance parameters.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_matrices
from knightcube.astro.quaternion import (
    Matrix,
    Quaternion,
    Vector,
    added,
    attitude_matrix,
    compose,
    cross,
    exponential,
    from_rotation_vector,
    matrix,
    rows_of,
    skew,
    times,
    twist,
)
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.errors import UsageError
from knightcube.gnc.estimation.error_state import check_amounts, propagated
from knightcube.gnc.estimation.estimate import (
    ATTITUDE,
    DISTURBANCE,
    LATENCY,
    PARAMETERS,
    RATE,
    SIZE,
    FilterState,
    Parameters,
)


class Torquing(NamedTuple):
    """The coils' dipole moment (A m^2, body axes) and the magnetic field (T, reference axes).

    The vector `driven` is 1 for each driven coil and 0 for other coils. The flag `known` is false while any
    coil may carry an unknown current, for example while the PWM chip does not respond to commands.
    """

    dipole: Vector
    field: Vector
    driven: Vector
    known: bool = True


class Accelerated(NamedTuple):
    """Angular acceleration w' (rad/s^2) and its derivatives (3, 3).

    The derivatives `by_parameters` are with respect to torsion, damping and coil gain.
    """

    acceleration: Vector
    by_parameters: Matrix


class Linearised(NamedTuple):
    """Angular acceleration w' (rad/s^2) and its derivatives.

    `by_attitude`, `by_rate` and `by_current` (3, 3) are the derivatives of the angular acceleration with
    respect to a small rotation about the body axes, to the rate and to the coil currents (A). `by_parameters`
    (3, 3) are the derivatives with respect to torsion, damping and coil gain.
    """

    acceleration: Vector
    by_parameters: Matrix
    by_attitude: FloatArray
    by_rate: FloatArray
    by_current: FloatArray


BodyConstants = tuple[Matrix, Matrix, float, bool]
"""Inertia tensor and its inverse as rows, dipole moment per ampere, and whether the body is suspended."""


@dataclass(frozen=True, slots=True, eq=False)
class RigidBody:
    """The constants of the body, its coils, the magnetic field and the thread.

    Attributes:
        inertia: inertia tensor (3, 3) in body axes, kg m^2.
        dipole_per_ampere: dipole moment per current of each coil (turns times area), m^2.
        field: magnetic field (3,), T, in reference axes; the default field of a command.
        suspended: whether the body hangs on the thread and rotates only about its y axis.
        stiffness: nominal torsion stiffness k of the thread, N m/rad.
        damping: nominal damping constant c of the thread, N m s/rad.
    """

    inertia: FloatArray
    dipole_per_ampere: float
    field: FloatArray
    suspended: bool = False
    stiffness: float = 0.0
    damping: float = 0.0
    constants: BodyConstants = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        """Raise UsageError for constants that are physically impossible."""
        inertia = np.asarray(self.inertia, dtype=float)
        if inertia.shape != (3, 3) or not np.all(np.isfinite(inertia)):
            raise UsageError(f"inertia {inertia.tolist()} must be (3, 3) and finite")
        moments = np.linalg.eigvalsh(inertia)
        is_symmetric = bool(np.allclose(inertia, inertia.T, atol=1e-6 * np.abs(inertia).max()))
        if not is_symmetric or moments[0] <= 0.0 or 2.0 * moments[2] > (1.0 + _FLAT) * moments.sum():
            raise UsageError(
                f"inertia {inertia.tolist()} must be symmetric and positive, and no principal moment may "
                "exceed the sum of the other two"
            )
        if np.shape(self.field) != (3,) or not np.all(np.isfinite(self.field)):
            raise UsageError(f"field {self.field} must be (3,) and finite")
        for name in ("dipole_per_ampere", "stiffness", "damping"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise UsageError(f"{name} is {value}: it must be finite and not negative")
        if not self.suspended and (self.stiffness or self.damping):
            raise UsageError("stiffness and damping of a thread need a suspended body")
        response: FloatArray = np.asarray(np.linalg.inv(inertia), dtype=float)
        if self.suspended:
            response = np.diag([0.0, 1.0 / inertia[1, 1], 0.0])
        constants = rows_of(inertia), rows_of(response), float(self.dipole_per_ampere), bool(self.suspended)
        object.__setattr__(self, "constants", constants)

    def torquing(
        self, currents: FloatArray, reference_field: FloatArray | None = None, known: bool = True
    ) -> Torquing:
        """Return the dipole that coil currents (3,), A, cause, and the field (3,), T, in reference axes.

        The field is `reference_field`, by default the constant field of the body description.
        """
        x, y, z = np.asarray(currents, dtype=float).tolist()
        field = self.field if reference_field is None else reference_field
        bx, by, bz = np.asarray(field, dtype=float).tolist()
        n = self.dipole_per_ampere
        return Torquing(
            (n * x, n * y, n * z), (bx, by, bz), (float(x != 0.0), float(y != 0.0), float(z != 0.0)), known
        )

    @property
    def parameters(self) -> Parameters:
        """The nominal parameters."""
        response = self.constants[1][1][1]
        return Parameters(self.stiffness * response, self.damping * response)

    def linearise(
        self, q: Quaternion, rate: Vector, parameters: Parameters, torquing: Torquing, ahead: float
    ) -> Linearised:
        """Return the angular acceleration at attitude `q` for the coil state `torquing`, with derivatives.

        The gyroscopic torque is computed for the predicted rate `ahead` seconds later. With the predicted
        rate, the error of the midpoint rule for a tumbling body is of third order per step.
        """
        return _linearised(self.constants, q, rate, parameters, torquing.dipole, torquing.field, ahead)

    def accelerate(
        self, q: Quaternion, rate: Vector, parameters: Parameters, torquing: Torquing
    ) -> Accelerated:
        """Return the angular acceleration at the attitude `q` for the coil state `torquing`."""
        return Accelerated(
            *_accelerated(self.constants, q, rate, parameters, torquing.dipole, torquing.field)
        )


@loop_helper
def _accelerated(
    body: BodyConstants, q: Quaternion, rate: Vector, parameters: Vector, dipole: Vector, field: Vector
) -> tuple[Vector, Matrix]:
    """Return the elements of `Accelerated`. The arguments are those of `RigidBody.accelerate` as tuples."""
    inertia, response, _, suspended = body
    torsion, damping, gain = parameters
    cx, cy, cz = times(response, cross(dipole, times(matrix(q), field)))
    fx, fy, fz = times(response, cross(times(inertia, rate), rate))
    angle = twist(q) if suspended else 0.0
    thread = -torsion * angle - damping * rate[1]
    acceleration = (gain * cx + fx, gain * cy + fy + thread, gain * cz + fz)
    return acceleration, ((0.0, 0.0, cx), (-angle, -rate[1], cy), (0.0, 0.0, cz))


@loop_helper
def _ahead(body: BodyConstants, rate: Vector, seconds: float) -> Vector:
    """Return the rate `seconds` later, predicted from the gyroscopic torque."""
    x, y, z = times(body[1], cross(times(body[0], rate), rate))
    return rate[0] + seconds * x, rate[1] + seconds * y, rate[2] + seconds * z


@loop_helper
def _torque_by_attitude(dipole: Vector, field: Vector) -> Matrix:
    """Return the derivative of the coils' torque with respect to a small rotation of the body.

    A rotation e of the body changes m x B by m x (B x e) = B m.e - e m.B, with the field B in body axes.
    """
    (mx, my, mz), (bx, by, bz) = dipole, field
    dot = mx * bx + my * by + mz * bz
    return (
        (bx * mx - dot, bx * my, bx * mz),
        (by * mx, by * my - dot, by * mz),
        (bz * mx, bz * my, bz * mz - dot),
    )


@loop_helper
def _torque_by_rate(inertia: Matrix, rate: Vector) -> Matrix:
    """Return the derivative of -w x J w with respect to w, which is [J w x] - [w x] J."""
    (a, b, c), (d, e, f), (g, h, i) = inertia
    x, y, z = rate
    jx, jy, jz = times(inertia, rate)
    return (
        (z * d - y * g, -jz + z * e - y * h, jy + z * f - y * i),
        (jz + x * g - z * a, x * h - z * b, -jx + x * i - z * c),
        (-jy + y * a - x * d, jx + y * b - x * e, y * c - x * f),
    )


def _linearised(
    body: BodyConstants,
    q: Quaternion,
    rate: Vector,
    parameters: Vector,
    dipole: Vector,
    field: Vector,
    ahead: float,
) -> Linearised:
    """Return the result of `RigidBody.linearise`, whose arguments are passed as tuples."""
    inertia, response, dipole_per_ampere, _ = body
    rate = _ahead(body, rate, ahead)
    acceleration, by_parameters = _accelerated(body, q, rate, parameters, dipole, field)
    field = times(matrix(q), field)
    parts = zip(_torque_by_attitude(dipole, field), _torque_by_rate(inertia, rate), skew(field), strict=True)
    derivatives = np.array(response).dot(np.array([(*turned, *spun, *coil) for turned, spun, coil in parts]))
    by_attitude, by_rate, by_field = derivatives[:, :3], derivatives[:, 3:6], derivatives[:, 6:]
    torsion, damping, gain = parameters
    by_attitude *= gain
    by_attitude[1, 1] -= torsion
    by_rate[1, 1] -= damping
    by_current = -gain * dipole_per_ampere * by_field
    return Linearised(acceleration, by_parameters, by_attitude, by_rate, by_current)


LONGEST_STEP = 0.025
"""Longest propagation step (s), equal to the control period of the testbed."""
_LARGEST_ROTATION = 0.01
"""Largest rotation (rad) of the body in one propagation step. The relative error of the midpoint rule is
about a 24th of the squared rotation (rad^2) of a step."""
_FASTEST = 10.0
"""Rate (rad/s) above which the propagation steps are not shortened further."""
_UNKNOWN_FOR = 0.3
"""Correlation time (s) of an unknown coil current, from which the spectral density of an equivalent white
noise follows. The correlation time exceeds the delay after which the guardian switches off the coils of a
hung control loop."""


class ProcessNoise(NamedTuple):
    """Spectral densities of the process noise, and the assumed magnitude of an unknown coil current.

    The attribute `current` is the spectral density of the current noise of one driven coil, A^2 s. `rate` (3,
    3), rad^2/s^3, is the spectral density of the unmodelled angular acceleration. The array `walks` (19,)
    contains the variances that the components of the error state gain per second by random walks.
    `unknown_current` (A) is the current assumed for each coil while its current is unknown.
    """

    current: float
    rate: FloatArray
    walks: FloatArray
    unknown_current: float = 0.0


def propagate(
    body: RigidBody,
    noise: ProcessNoise,
    state: FilterState,
    covariance: FloatArray,
    torquing: Torquing,
    duration: float,
) -> tuple[FilterState, FloatArray]:
    """Propagate over `duration` s under one coil command.

    A step lasts at most `LONGEST_STEP` s, and the body rotates by at most `_LARGEST_ROTATION` in a step. To
    limit the number of steps, the steps are not shortened further at rates above `_FASTEST`, which no body
    reaches.
    """
    speed = min(math.hypot(*state.rate), _FASTEST)
    steps = math.ceil(duration * max(1.0 / LONGEST_STEP, speed / _LARGEST_ROTATION) - 1e-9) or 1
    steady = 0.0 if torquing.known else noise.unknown_current**2 * _UNKNOWN_FOR
    x, y, z = torquing.driven
    quaternion, rate, covariance = _propagated(
        body.constants,
        state.quaternion,
        state.rate,
        state.disturbance,
        state.parameters[:],  # numba accepts a tuple faster than a NamedTuple
        torquing.dipole,
        torquing.field,
        (noise.current * x + steady, noise.current * y + steady, noise.current * z + steady),
        noise.rate,
        noise.walks,
        covariance,
        duration / steps,
        steps,
    )
    # The attitudes stored for exposures do not change.
    return FilterState(quaternion, rate, *state[2:]), covariance


def _propagated_numpy(
    body: BodyConstants,
    quaternion: Quaternion,
    rate: Vector,
    disturbance: Vector,
    parameters: Vector,
    dipole: Vector,
    field: Vector,
    currents: Vector,
    density: FloatArray,
    walks: FloatArray,
    covariance: FloatArray,
    dt: float,
    steps: int,
) -> tuple[Quaternion, Vector, FloatArray]:
    """Return quaternion, rate and covariance (n, n) after `steps` steps of `dt` s.

    The spectral density of the angular acceleration is the sum of `density` (3, 3), rad^2/s^3, and the effect
    of the coil currents, which have the spectral densities `currents`, A^2 s. The states have the random
    walks `walks` (19,). The other arguments are those of `propagate` as tuples.
    """
    half = 0.5 * dt
    for _ in range(steps):  # midpoint rule
        wx, wy, wz = rate
        middle = compose(exponential(half * wx, half * wy, half * wz), quaternion)
        model = _linearised(body, middle, rate, parameters, dipole, field, half)
        ax, ay, az = added(model.acceleration, disturbance)
        moved = exponential(dt * (wx + half * ax), dt * (wy + half * ay), dt * (wz + half * az))
        # For the attitude error e, the dynamics are e' = -w x e + rate error.
        flow = _FLOW.copy()
        flow[ATTITUDE, ATTITUDE] = ((0.0, wz, -wy), (-wz, 0.0, wx), (wy, -wx, 0.0))
        flow[RATE, ATTITUDE] = model.by_attitude
        flow[RATE, RATE] = model.by_rate
        flow[RATE, PARAMETERS] = model.by_parameters
        noise = density
        if any(currents):
            noise = density + (model.by_current * np.array(currents)).dot(model.by_current.T)
        covariance = propagated(covariance, flow, dt, noise, walks)
        quaternion, rate = compose(moved, quaternion), (wx + dt * ax, wy + dt * ay, wz + dt * az)
    return quaternion, rate, covariance


_FLOW: FloatArray = np.zeros((6, SIZE))
_FLOW[ATTITUDE, RATE] = np.eye(3)
_FLOW[RATE, DISTURBANCE] = np.eye(3)


@compiled_form_of(_propagated_numpy)
def _propagated(
    body: BodyConstants,
    quaternion: Quaternion,
    rate: Vector,
    disturbance: Vector,
    parameters: Vector,
    dipole: Vector,
    field: Vector,
    currents: Vector,
    density: FloatArray,
    walks: FloatArray,
    covariance: FloatArray,
    dt: float,
    steps: int,
) -> tuple[Quaternion, Vector, FloatArray]:
    """See `_propagated_numpy`."""
    inertia, response, dipole_per_ampere, _ = body
    (torsion, damping, gain), half = parameters, 0.5 * dt
    # The first columns of `flow` are attitude, rate, gyro bias, disturbance and parameters.
    flow, by_current, noise = np.zeros((6, 15)), np.empty((3, 3)), np.empty((3, 3))
    for _ in range(steps):
        wx, wy, wz = rate
        middle = compose(exponential(half * wx, half * wy, half * wz), quaternion)
        later, coils = _ahead(body, rate, half), times(matrix(middle), field)
        acceleration, by_parameters = _accelerated(body, middle, later, parameters, dipole, field)
        ax, ay, az = added(acceleration, disturbance)
        by_attitude, by_rate = _torque_by_attitude(dipole, coils), _torque_by_rate(inertia, later)
        across, by_field = skew(rate), skew(coils)
        for i in range(3):
            for j in range(3):
                of_attitude, of_rate, of_field = 0.0, 0.0, 0.0
                for k in range(3):
                    of_attitude += response[i][k] * by_attitude[k][j]
                    of_rate += response[i][k] * by_rate[k][j]
                    of_field += response[i][k] * by_field[k][j]
                flow[i, j] = -across[i][j]
                flow[3 + i, j], flow[3 + i, 3 + j] = gain * of_attitude, of_rate
                flow[3 + i, 12 + j] = by_parameters[i][j]
                by_current[i, j] = -gain * dipole_per_ampere * of_field
            flow[i, 3 + i] = flow[3 + i, 9 + i] = 1.0
        flow[4, 1], flow[4, 4] = flow[4, 1] - torsion, flow[4, 4] - damping
        for i in range(3):
            for j in range(3):
                noise[i, j] = density[i, j]
                for k in range(3):
                    noise[i, j] += currents[k] * by_current[i, k] * by_current[j, k]
        covariance = _propagated_covariance(covariance, flow, dt, noise, walks)
        moved = exponential(dt * (wx + half * ax), dt * (wy + half * ay), dt * (wz + half * az))
        quaternion, rate = compose(moved, quaternion), (wx + dt * ax, wy + dt * ay, wz + dt * az)
    return quaternion, rate, covariance


@loop_helper
def _propagated_covariance(
    covariance: FloatArray, flow: FloatArray, dt: float, noise: FloatArray, walks: FloatArray
) -> FloatArray:
    """Return the result of `error_state.propagated`, computed with loops."""
    rows, size = flow.shape
    transition, moved, after = dt * flow, np.zeros((rows, len(covariance))), covariance.copy()
    for i in range(rows):
        for j in range(size):
            for k in range(rows):
                transition[i, j] += 0.5 * dt * dt * flow[i, k] * flow[k, j]
        transition[i, i] += 1.0
        for k in range(size):
            for j in range(len(covariance)):
                moved[i, j] += transition[i, k] * covariance[k, j]
        for j in range(len(covariance)):
            after[i, j] = after[j, i] = moved[i, j]
    for i in range(rows):
        for j in range(rows):
            among = 0.0
            for k in range(size):
                among += moved[i, k] * transition[j, k]
            after[i, j] = among
    for i in range(3):
        for j in range(3):
            after[i, j] += dt**3 / 3.0 * noise[i, j]
            after[i, 3 + j] += 0.5 * dt * dt * noise[i, j]
            after[3 + i, j] += 0.5 * dt * dt * noise[i, j]
            after[3 + i, 3 + j] += dt * noise[i, j]
    for i in range(len(walks)):
        after[i, i] += dt * walks[i]
    return after


class RateChange(NamedTuple):
    """The angular acceleration (rad/s^2) at the time of a sample, and its uncertainty.

    `uncertainty` (3, 3) rad^2/s^2 is the covariance of the sampled rate due to effects not linear in the age.
    """

    acceleration: Vector
    uncertainty: FloatArray


def rate_change(
    body: RigidBody, state: FilterState, covariance: FloatArray, before: Torquing, after: Torquing
) -> RateChange:
    """Return the angular acceleration at the time of a gyro sample whose age is uncertain.

    The arguments `before` and `after` are the coil states half a standard deviation of the age before and
    after the sample. The two accelerations differ if a coil command begins or ends between their times. Half
    the difference of the two accelerations, and the product of the errors of age and acceleration, are
    treated as noise.
    """
    coils = before.dipole, before.field, after.dipole, after.field
    motion = state.quaternion, state.rate, state.disturbance, state.parameters[:]
    return RateChange(*_rate_change(body.constants, *motion, *coils, covariance))


def _rate_change_numpy(
    body: BodyConstants,
    quaternion: Quaternion,
    rate: Vector,
    disturbance: Vector,
    parameters: Vector,
    dipole: Vector,
    field: Vector,
    later_dipole: Vector,
    later_field: Vector,
    covariance: FloatArray,
) -> tuple[Vector, FloatArray]:
    """Return the elements of `RateChange`. The arguments are those of `rate_change` as tuples."""
    before, by_before = _accelerated(body, quaternion, rate, parameters, dipole, field)
    after, by_after = _accelerated(body, quaternion, rate, parameters, later_dipole, later_field)
    x, y, z = (0.5 * (a + b) + d for a, b, d in zip(before, after, disturbance, strict=True))
    rows = np.hstack([np.eye(3), 0.5 * (np.array(by_before) + by_after)])
    bend = 0.5 * (np.array(after) - before)
    spread = rows @ covariance[_ACCELERATIONS, _ACCELERATIONS] @ rows.T + np.outer(bend, bend)
    return (x, y, z), covariance[LATENCY, LATENCY] * spread


_ACCELERATIONS = slice(DISTURBANCE.start, PARAMETERS.stop)


@compiled_form_of(_rate_change_numpy)
def _rate_change(
    body: BodyConstants,
    quaternion: Quaternion,
    rate: Vector,
    disturbance: Vector,
    parameters: Vector,
    dipole: Vector,
    field: Vector,
    later_dipole: Vector,
    later_field: Vector,
    covariance: FloatArray,
) -> tuple[Vector, FloatArray]:
    """See `_rate_change_numpy`. The states 9 to 15 are disturbance, parameters and age."""
    before, by_before = _accelerated(body, quaternion, rate, parameters, dipole, field)
    after, by_after = _accelerated(body, quaternion, rate, parameters, later_dipole, later_field)
    rows, spread = np.eye(3, 6), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            rows[i, 3 + j] = 0.5 * (by_before[i][j] + by_after[i][j])
    for i in range(3):
        for j in range(3):
            total = 0.25 * (after[i] - before[i]) * (after[j] - before[j])
            for k in range(6):
                for m in range(6):
                    total += rows[i, k] * covariance[9 + k, 9 + m] * rows[j, m]
            spread[i, j] = covariance[15, 15] * total
    x, y, z = added(before, after)
    return added((0.5 * x, 0.5 * y, 0.5 * z), disturbance), spread


_FIRST, _SECOND = (0, 1, 2, 1, 2, 0), (0, 1, 2, 2, 0, 1)
"""Axes of the first and of the second factor of the six rate products xx, yy, zz, yz, zx and xy."""
_DRAWS = 2000
"""Number of random inertia tensors from which the covariance of the coefficients Q is computed. The six
largest principal components of Q for 1000 and for 4000 random tensors agree within 5 %."""
_FLAT = 2e-6
"""Largest excess of a moment of inertia over the sum of the other two due to rounding, relative to the trace.
"""
_NEGLIGIBLE = 1e-6
"""Variance below which a principal component of Q is omitted, as a fraction of the largest variance."""


@dataclass(frozen=True, slots=True)
class BodyErrors:
    """Largest errors of the description of a body and its devices.

    Random errors are uniformly distributed between minus and plus the largest errors.

    Attributes:
        moments: largest relative error of the principal moments of inertia.
        axes: largest rotation of the principal axes about each body axis, rad.
        gyro_scale: largest relative error of the gyro's scale factors.
        gyro_alignment: largest misalignment of each gyro axis toward each other axis, rad.
        coil_gain: largest relative error of the dipole of each coil.
        coil_axes: largest misalignment of each coil toward each other axis, rad.
        field_matrix: largest error of each element of the magnetometer's matrix.
        camera: largest rotation of the star camera about each body axis, rad.
        horizon: largest rotation of each horizon camera about each body axis, rad.
    """

    moments: float = 0.1
    axes: float = math.radians(5.0)
    gyro_scale: float = 3e-3
    gyro_alignment: float = 2e-3
    coil_gain: float = 0.2
    coil_axes: float = math.radians(3.0)
    field_matrix: float = 0.01
    camera: float = math.radians(0.1)
    horizon: float = math.radians(0.1)

    def __post_init__(self) -> None:
        """Raise ArgumentError for an error that is negative or not a finite number."""
        check_amounts(self)


def rate_products(rates: FloatArray) -> FloatArray:
    """Return the products xx, yy, zz, yz, zx and xy (n, 6) of the components of the rates (n, 3)."""
    return rates[:, _FIRST] * rates[:, _SECOND]


def gyroscopic_coefficients(inertia: FloatArray) -> FloatArray:
    """Return the coefficients Q (..., 3, 6) of inertia tensors; Q p(w) is the torque-free acceleration."""
    return _folded(_quadratic(inertia))


def coefficient_modes(inertia: FloatArray, errors: BodyErrors) -> FloatArray:
    """Return the principal components (k, 3, 6) of Q over random bodies near an assumed `inertia` (3, 3).

    The error of Q is a sum of the principal components with independent weights of variance 1. Random tensors
    that violate the triangle inequality are omitted. The random bodies are drawn with a fixed seed.
    """
    generator = np.random.default_rng(0)
    tensors = _random_tensors(inertia, errors, generator)
    count = len(tensors)
    gyro = errors.gyro_alignment * generator.uniform(-1.0, 1.0, (count, 3, 3))
    gyro[:, range(3), range(3)] = 1.0 + errors.gyro_scale * generator.uniform(-1.0, 1.0, (count, 3))
    back = np.linalg.inv(gyro)
    measured = np.einsum("nil,nlmo,nmj,nok->nijk", gyro, _quadratic(tensors), back, back, optimize=True)
    changes = (_folded(measured) - gyroscopic_coefficients(inertia)).reshape(count, 18)
    variances, vectors = np.linalg.eigh(changes.T @ changes / count)
    kept = variances > _NEGLIGIBLE * variances[-1]
    return np.asarray((vectors[:, kept] * np.sqrt(variances[kept])).T.reshape(-1, 3, 6))


def tensor(elements: FloatArray) -> FloatArray:
    """Return the symmetric tensor (3, 3) with the elements (6,) xx, yy, zz, yz, zx, xy."""
    xx, yy, zz, yz, zx, xy = elements.tolist()
    return np.array(((xx, xy, zx), (xy, yy, yz), (zx, yz, zz)))


def by_inertia(vector: FloatArray) -> FloatArray:
    """Return the derivative (3, 6) of J v for a vector v (3,).

    The derivative is with respect to the elements xx, yy, zz, yz, zx and xy of J.
    """
    x, y, z = vector.tolist()
    return np.array(((x, 0.0, 0.0, 0.0, z, y), (0.0, y, 0.0, z, 0.0, x), (0.0, 0.0, z, y, x, 0.0)))


def inertia_covariance(inertia: FloatArray, errors: BodyErrors) -> FloatArray:
    """Return the covariance (6, 6) of the elements xx, yy, zz, yz, zx, xy of a tensor, relative to its trace.

    The covariance is computed from random tensors near an assumed `inertia` (3, 3), drawn with a fixed seed.
    """
    tensors = _random_tensors(inertia, errors, np.random.default_rng(0))
    changes = (tensors - inertia)[:, _FIRST, _SECOND] / np.trace(inertia)
    return np.asarray(changes.T @ changes / len(changes))


def _random_tensors(inertia: FloatArray, errors: BodyErrors, generator: np.random.Generator) -> FloatArray:
    """Return random tensors (n, 3, 3) near `inertia` (3, 3) that satisfy the triangle inequality."""
    moments, axes = np.linalg.eigh(inertia)
    drawn = moments * (1.0 + errors.moments * generator.uniform(-1.0, 1.0, (_DRAWS, 3)))
    # The tolerance accepts a flat body whose moments are known exactly.
    drawn = drawn[2.0 * drawn.max(axis=1) < (1.0 + _FLAT) * drawn.sum(axis=1)]
    rotations = from_rotation_vector(errors.axes * generator.uniform(-1.0, 1.0, (len(drawn), 3)))
    principal = attitude_matrix(rotations) @ axes
    return np.asarray(np.einsum("nij,nj,nkj->nik", principal, drawn, principal))


def _quadratic(inertia: FloatArray) -> FloatArray:
    """Return T (..., 3, 3, 3) of inertia tensors, with w'_i = T_ijk w_j w_k in torque-free motion."""
    crosses = cross_matrices(np.eye(3))
    return np.asarray(-np.einsum("...il,jlm,...mk->...ijk", np.linalg.inv(inertia), crosses, inertia))


def _folded(quadratic: FloatArray) -> FloatArray:
    """Return the coefficients Q (..., 3, 6) of the six rate products from T (..., 3, 3, 3)."""
    folded = quadratic[..., _FIRST, _SECOND] + quadratic[..., _SECOND, _FIRST]
    folded[..., :3] *= 0.5
    return np.asarray(folded)


def per_trace(inertia: FloatArray, coils: FloatArray) -> FloatArray:
    """Return the Jacobian (15, 15) of inertia and coil matrix, each divided by the trace of the inertia.

    The array `inertia` (6,) contains the elements xx, yy, zz, yz, zx and xy, relative to the trace of the
    assumed inertia. The array `coils` (9,) contains the matrix of the coils row by row. Only the ratios of
    inertia and dipole are observable from the motion of a satellite, because a body with twice the inertia
    and twice the dipole moves in the same way.
    """
    trace = inertia[:3].sum()
    rows: FloatArray = np.eye(15) / trace
    rows[:6, :3] -= inertia[:, None] / trace**2
    rows[6:, :3] -= coils[:, None] / trace**2
    return rows


def by_matrix(vector: FloatArray) -> FloatArray:
    """Return the derivative (3, 9) of M v, for a vector v (3,), with respect to the elements of M (3, 3)."""
    rows = np.zeros((3, 3, 3))
    rows[_INDICES, _INDICES] = vector
    return rows.reshape(3, 9)


_INDICES = np.arange(3)


@functools.lru_cache(maxsize=256)
def whitenings(counts: tuple[int, ...], independent: float, variance: float, walk: float) -> FloatArray:
    """Return matrices (w, m, m) like that of `_whitening`, one for each number of newest differences.

    `counts` contains the number of differences for each matrix, and m is the first of these numbers. The
    elements for earlier differences are zero. The other arguments are those of `_whitening`.
    """
    matrices = np.zeros((len(counts), counts[0], counts[0]))
    for place, count in enumerate(counts):
        matrices[place, -count:, -count:] = _whitening(count, independent, variance, walk)
    return matrices


def _whitening(count: int, independent: float, variance: float, walk: float) -> FloatArray:
    """Return the matrix (m, m) that whitens the differences of bins and removes their constant part.

    Args:
        count: number m of differences between bins.
        independent: variance of the independent errors of the differences.
        variance: variance of the rate of a bin, divided by the squared time between bins.
        walk: variance that the random walk of the disturbance adds per bin.
    """
    covariance = (independent + 2.0 * variance) * np.eye(count)
    covariance -= variance * (np.eye(count, k=1) + np.eye(count, k=-1))
    number = np.arange(1, count + 1)
    covariance += walk * np.minimum(number[:, None], number)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    constant = whitening.sum(axis=1)
    constant /= math.sqrt(float(constant @ constant))
    return np.asarray(whitening - np.outer(constant, constant @ whitening))


def _fitted_gains_numpy(
    normal: FloatArray, prior: FloatArray, weights: FloatArray, expected: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Fit n coil gains and p other parameters under k hypotheses, separately for w sets of equations.

    The observed accelerations are linear in the gains and in other parameters, such as errors of the inertia.
    The other parameters are eliminated, which leaves normal equations for the gains. A hypothesis states the
    expected gain of each coil and the prior weight (inverse variance) of this gain. The cost of a hypothesis
    is the weighted sum of the squared residuals of its fit.

    Args:
        normal: matrices A^T A (w, p + n + 1, p + n + 1), where the columns of A are the whitened coefficients
            of the other parameters, those of the gains, and the whitened right-hand side.
        prior: prior weights (p,) of the other parameters, whose expected values are zero.
        weights: prior weights (k, n) of the gains.
        expected: expected gains (k, n), 1 or -1.

    Returns:
        Gains (w, k, n), variances (w, k, n) of the gains, costs (w, k), and the other parameters (w, p) for
        the first hypothesis. A cost includes the deviations from the expected values.
    """
    others, coils = len(prior), weights.shape[1]
    mixed = normal[:, :others, others:]
    coupling = np.linalg.solve(normal[:, :others, :others] + np.diag(prior), mixed)
    reduced = normal[:, others:, others:] - mixed.transpose(0, 2, 1) @ coupling
    # The weighted sum of squares at gains g is g S g - 2 t g + c. The matrix `reduced` contains S, the vector
    # t as last row and column, and c as last element.
    matrices = reduced[:, None, :coils, :coils] + weights[:, :, None] * np.eye(coils)
    covariance = np.linalg.inv(matrices)
    rights = reduced[:, None, coils, :coils] + weights * expected
    gains = (covariance @ rights[..., None])[..., 0]
    # The prior adds weight * (gain - expected)^2 to the cost for each gain.
    # Expected gains are 1 or -1, so the term weight * expected^2 equals the weight.
    costs = reduced[:, coils, coils, None] + weights.sum(axis=1) - (rights * gains).sum(axis=2)
    other = coupling[:, :, coils] - (coupling[:, :, :coils] @ gains[:, 0, :, None])[..., 0]
    variances: FloatArray = np.array(covariance.diagonal(axis1=2, axis2=3), dtype=np.float64)
    return gains, variances, costs, other


@compiled_form_of(_fitted_gains_numpy)
def fitted_gains(
    normal: FloatArray, prior: FloatArray, weights: FloatArray, expected: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """See `_fitted_gains_numpy`."""
    others, (count, coils) = len(prior), weights.shape
    gains, variances = np.zeros((len(normal), count, coils)), np.zeros((len(normal), count, coils))
    costs, other = np.zeros((len(normal), count)), np.zeros((len(normal), others))
    for place in range(len(normal)):
        rows = normal[place].copy()
        for i in range(others):
            rows[i, i] += prior[i]
        _eliminate(rows, others)
        right = rows[others:-1, -1]
        for k in range(count):
            covariance = rows[others:-1, others:-1].copy()
            for i in range(coils):
                covariance[i, i] += weights[k, i]
            _invert(covariance)
            costs[place, k] = rows[-1, -1]
            for i in range(coils):
                for j in range(coils):
                    gains[place, k, i] += covariance[i, j] * (right[j] + weights[k, j] * expected[k, j])
                variances[place, k, i] = covariance[i, i]
                costs[place, k] += weights[k, i]
                costs[place, k] -= (right[i] + weights[k, i] * expected[k, i]) * gains[place, k, i]
        for i in range(others - 1, -1, -1):
            value = rows[i, -1]
            for j in range(i + 1, others):
                value -= rows[i, j] * other[place, j]
            for j in range(coils):
                value -= rows[i, others + j] * gains[place, 0, j]
            other[place, i] = value / rows[i, i]
    return gains, variances, costs, other


@loop_helper
def _eliminate(rows: FloatArray, count: int) -> None:
    """Eliminate the first `count` unknowns of symmetric equations (m, m) in place, without pivoting."""
    for k in range(count):
        for i in range(k + 1, len(rows)):
            factor = rows[i, k] / rows[k, k]
            for j in range(k + 1, len(rows)):
                rows[i, j] -= factor * rows[k, j]


@loop_helper
def _invert(matrix: FloatArray) -> None:
    """Invert a positive definite matrix (n, n) in place by the Gauss-Jordan method, without pivoting."""
    for k in range(len(matrix)):
        pivot = matrix[k, k]
        matrix[k, k] = 1.0
        for j in range(len(matrix)):
            matrix[k, j] /= pivot
        for i in range(len(matrix)):
            factor = matrix[i, k]
            if i != k:
                matrix[i, k] = 0.0
                for j in range(len(matrix)):
                    matrix[i, j] -= factor * matrix[k, j]
