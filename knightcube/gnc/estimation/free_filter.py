"""The navigation filter of a free satellite: attitude, rate, biases, residual dipole and torques.

A multiplicative extended Kalman filter integrates Euler's equation with the coils' dipole moment, the gravity
gradient and the estimated disturbances, in steps of a second or two. Gyro samples are treated as
measurements. The filter propagates a late attitude to the present with the present rate, whose error enters
the innovation. This is accurate for some seconds, because the rate of a body that rotates slowly enough for
star images is nearly constant in that time. The module `attitude_filter` instead applies each late sample at
its own time. A filter step with one gyro sample takes 0.3 ms.

The residual dipole moment has a constant part and a part proportional to the sunlight. The sizes of the
disturbance torques of `knightcube.astro.earth.disturbance` are states of the filter. A small rotation of the
principal axes from the assumed axes is a further state. In a fast spinning long body, wrong principal axes
cause the largest unknown torque, which would otherwise be attributed to the gyro bias.

The error of the field model is correlated over minutes and is modelled as a first-order Gauss-Markov process
in body axes. While the attitude is known accurately, the standard deviation of this error is estimated by
expectation maximisation (Dempster, Laird & Rubin 1977), from the squared estimate and its variance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro import chi_square
from knightcube.astro.arrays import BoolArray, FloatArray, IntArray, cross_matrix, tangent_basis
from knightcube.astro.earth.disturbance import SIZES, Pressures, box_areas, shapes
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.gnc.estimation.estimate import Knowledge

ATTITUDE, RATE, GYRO, DIPOLE, SUNLIT, MAGNET = (slice(3 * k, 3 * k + 3) for k in range(6))
TORQUES = slice(18, 18 + SIZES)
AXES = slice(18 + SIZES, 21 + SIZES)
SLOW = slice(GYRO.start, AXES.stop)
FIELD = slice(21 + SIZES, 24 + SIZES)
STATES = 24 + SIZES
"""Indices of the components of the error state. The slice SLOW contains the slowly varying states, from GYRO
to AXES."""


@dataclass(frozen=True, slots=True, eq=False)
class FilterEnvironment:
    """The environment of the satellite at one time, ICRS axes.

    `field` (3,) is the magnetic field (T), `position` (3,) the position (m), `pressures` the pressures of air
    and sunlight, and `sunlit` the visible fraction of the Sun's disk.
    """

    field: FloatArray
    position: FloatArray
    pressures: Pressures
    sunlit: float


class FreeMotion:
    """Euler's equation of a satellite in orbit, with principal axes that can be corrected."""

    def __init__(self, inertia: FloatArray) -> None:
        """Create the equation for an assumed inertia tensor (3, 3) kg m^2 in body axes."""
        self._assumed: FloatArray = np.asarray(inertia, dtype=float)
        moments = np.linalg.eigvalsh(self._assumed)
        self.largest_difference = float(moments[-1] - moments[0])
        """Largest difference between two principal moments of inertia, kg m^2."""
        self._areas = box_areas(self._assumed)
        self._rotation: FloatArray = np.zeros(3)
        self._set_inertia(self._assumed)

    def rotate_axes(self, rotation: FloatArray) -> None:
        """Set the principal axes to the assumed axes rotated by a rotation vector (3,) rad, body axes."""
        if np.array_equal(rotation, self._rotation):
            return
        self._rotation = rotation.copy()
        back = attitude_matrix(from_rotation_vector(rotation))
        self._set_inertia(np.asarray(back.T @ self._assumed @ back, dtype=float))

    def _set_inertia(self, inertia: FloatArray) -> None:
        self.inertia: FloatArray = inertia
        self.inverse: FloatArray = np.asarray(np.linalg.inv(inertia), dtype=float)
        self.by_torque: FloatArray = self.inverse @ self.inverse
        """Covariance (3, 3) of the angular acceleration per variance of each torque component."""

    def acceleration(self, rate: FloatArray, torque: FloatArray) -> FloatArray:
        """Return the angular acceleration (3,) rad/s^2 at a rate (3,) rad/s under a torque (3,) N m."""
        return np.asarray(self.inverse @ (torque - cross_matrix(rate) @ (self.inertia @ rate)))

    def stiffness(self, rate: FloatArray) -> FloatArray:
        """Return the derivative (3, 3) of the angular acceleration with respect to the rate (3,) rad/s."""
        return np.asarray(
            self.inverse @ (cross_matrix(self.inertia @ rate) - cross_matrix(rate) @ self.inertia)
        )

    def torque(
        self, quaternion: FloatArray, dipole: FloatArray, sizes: FloatArray, around: FilterEnvironment
    ) -> tuple[FloatArray, FloatArray]:
        """Return the torque (3,) N m, and the error dynamics (6, 33) without the columns of rate and axes.

        `dipole` (3,) A m^2 is the sum of the coils' and the residual dipole moment. `sizes` (9,) are the
        sizes (N m) of the disturbance torques.
        """
        to_body = attitude_matrix(quaternion)
        field, position = to_body @ around.field, to_body @ around.position
        radius = math.sqrt(float(position @ position))
        up = position / radius
        stiff = self.inertia @ up
        strength = 3.0 * GRAVITATIONAL_PARAMETER / radius**3
        shape = shapes(around.pressures.facing(self._areas, to_body[None]), to_body[None])[0]
        across, upright = cross_matrix(field), cross_matrix(up)
        torque = -across @ dipole + strength * upright @ stiff + shape @ sizes
        flow = np.zeros((6, STATES))
        stiffness = strength * (upright @ self.inertia - cross_matrix(stiff)) @ upright
        flow[3:6, ATTITUDE] = self.inverse @ (cross_matrix(dipole) @ across + stiffness)
        flow[3:6, DIPOLE] = -self.inverse @ across
        flow[3:6, SUNLIT] = around.sunlit * flow[3:6, DIPOLE]
        flow[3:6, TORQUES] = self.inverse @ shape
        flow[3:6, AXES] = strength * self.inverse @ upright @ self._by_rotation(up)
        return torque, flow

    def by_axes(self, rate: FloatArray, acceleration: FloatArray) -> FloatArray:
        """Return the derivative (3, 3) of the gyroscopic acceleration by a rotation of the principal axes."""
        return np.asarray(
            -self.inverse @ (cross_matrix(rate) @ self._by_rotation(rate) + self._by_rotation(acceleration))
        )

    def _by_rotation(self, vector: FloatArray) -> FloatArray:
        """Return the derivative (3, 3) of J v by a small rotation d of J, which adds d x J v - J (d x v)."""
        return np.asarray(self.inertia @ cross_matrix(vector) - cross_matrix(self.inertia @ vector))


LASTING = 20.0
"""Correlation time (s) of coil and inertia errors, for the white noise that models these errors."""
CONSTANT_SHARE, AIR_SHARE, LIGHT_SHARE = 0.03, 1.0, 0.5
"""Expected sizes of the constant, air and sunlight torques, relative to the size of the air torque. The
expected constant torque is small, because wrong principal axes have their own states. At one attitude the
torques cannot be distinguished. Air torque that is attributed to the constant torque is wrong at every other
attitude."""
PLAUSIBLE = 4.0
"""Largest plausible value of a slow state, in initial standard deviations of the state."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FreeFilterSettings:
    """Noise and limits of the filter.

    Each pair of values holds the initial standard deviation of a state and its random walk per sqrt(s).

    Attributes:
        gyro: rad/s, gyro bias.
        dipole, sunlit: constant and sunlit part of the residual dipole moment, A m^2.
        magnet: magnetometer bias, T.
        field: initial standard deviation per axis of the field model's error, T.
        field_memory: correlation time of the field model's error, s.
        torque: size of the air torque, N m; it also scales the other disturbance torques.
        torque_noise: white noise of all unmodelled torques, N m sqrt(s).
        coil_error: relative error of the coils' dipole moment in any direction, correlated over tens of
            seconds.
        coil_noise: white noise of each coil's dipole moment while the coils are driven, A m^2 sqrt(s).
        axes: rotation of the principal axes from the assumed axes, rad.
        inertia_error: relative error of the gyroscopic torque, without the effect of wrong principal axes.
        rate_start: standard deviation of the initial rate apart from the gyro bias, rad/s.
        fine, coarse: largest standard deviation of the worst axis of a fine and of a coarse attitude, rad.
        gate_sigma: a measurement less likely than a deviation of this many sigma in one component is
            rejected.
    """

    gyro: tuple[float, float] = (1e-3, 2e-6)
    dipole: tuple[float, float] = (1e-3, 1.5e-6)
    sunlit: tuple[float, float] = (3e-4, 2e-7)
    magnet: tuple[float, float] = (3e-7, 3e-10)
    field: float = 5e-8
    field_memory: float = 600.0
    torque: tuple[float, float] = (3e-9, 5e-12)
    torque_noise: float = 1e-9
    coil_error: float = 0.04
    coil_noise: float = 0.0
    axes: tuple[float, float] = (0.03, 0.0)
    inertia_error: float = 0.003
    rate_start: float = 1e-3
    fine: float = math.radians(0.1)
    coarse: float = math.radians(5.0)
    gate_sigma: float = 5.0

    def of_slow(self, which: int) -> FloatArray:
        """Return the initial deviations (`which` = 0) or the random walks (1) of the slow states (24,)."""
        start, walk = self.torque
        torques = [(share * start, walk) for share in (CONSTANT_SHARE, AIR_SHARE, LIGHT_SHARE)]
        pairs = [self.gyro, self.dipole, self.sunlit, self.magnet, *torques, self.axes]
        return np.repeat([pair[which] for pair in pairs], 3)

    def plausible(self, values: FloatArray, at: IntArray | slice = slice(None)) -> BoolArray:
        """Return whether each value (k,) of the slow states with the indices `at` is plausible."""
        return np.asarray(np.abs(values) <= PLAUSIBLE * self.of_slow(0)[at])


LARGEST_ROTATION = 0.1
"""Largest rotation (rad) of the body in one integration step."""
FIELD_LEARNED = 2_000.0
"""Averaging time (s) of the estimated variance of the field model's error."""
MINIMUM_FIELD_ERROR = 1e-8
"""Minimum standard deviation (T per axis) of the field model's error, as large as the magnetometer's own
errors."""
CURRENTS = 1e-7
"""Field (T per axis) of auroral currents; it is added to the noise so that no measurement is rejected because
of it."""
_EYE: FloatArray = np.eye(3)
_FIELD_DIAGONAL = slice(FIELD.start * (STATES + 1), None, STATES + 1)


@dataclass(frozen=True, slots=True, eq=False)
class SlowStates:
    """The values (24,) of the slowly varying states and their covariance (24, 24)."""

    values: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FreeMemory:
    """A copy of the filter's estimate; the attributes have the names that they have in the filter."""

    quaternion: FloatArray
    rate: FloatArray
    acceleration: FloatArray
    constants: FloatArray
    covariance: FloatArray
    field_error: float


class FreeFilter:
    """The navigation filter; `refused` counts the measurements that did not pass the gate.

    Attributes:
        quaternion: attitude (4,), from ICRS into body axes.
        rate: body rate (3,) in body axes, rad/s.
        acceleration: angular acceleration (3,) of the last step in body axes, rad/s^2.
        covariance: covariance (33, 33) of the error state, in the order ATTITUDE, RATE, ..., FIELD.
        field_error: standard deviation per axis of the field model's error, T.
        changes: number of times that the estimate changed.
    """

    def __init__(
        self, inertia: FloatArray, settings: FreeFilterSettings, slow: SlowStates | None = None
    ) -> None:
        """Create a filter for the assumed inertia tensor (3, 3) kg m^2 in body axes.

        The prior of the slow states is `slow`, or follows from the settings by default.
        """
        self.motion = FreeMotion(inertia)
        self._settings = settings
        tail = math.erfc(settings.gate_sigma / math.sqrt(2.0))
        self._walks = settings.of_slow(1) ** 2
        self._gates = {n: chi_square.bound(tail, n) for n in (1, 2, 3)}
        self._constants: FloatArray = np.zeros(STATES)
        self.acceleration: FloatArray = np.zeros(3)
        self._slope: FloatArray = np.zeros((3, STATES))  # derivative of the acceleration by the states
        self.started = False
        self.refused = 0
        self.changes = 0
        self.quaternion: FloatArray = np.array([0.0, 0.0, 0.0, 1.0])
        self.rate: FloatArray = np.zeros(3)
        self.covariance: FloatArray = np.zeros((STATES, STATES))
        self.covariance[SLOW, SLOW] = np.diag(settings.of_slow(0) ** 2)
        self.field_error = settings.field
        self._reset_field()
        if slow is not None:
            self._constants[SLOW], self.covariance[SLOW, SLOW] = slow.values, slow.covariance

    def start(
        self, quaternion: FloatArray, covariance: FloatArray, gyro: FloatArray, *, doubted: bool = False
    ) -> None:
        """Start from an attitude (4,) with covariance (3, 3) rad^2 in body axes, and a gyro rate (3,) rad/s.

        The slow states are kept. If measurements contradicted the estimate (`doubted`), the covariance of the
        slow states is reset to the settings, and implausible values are set to zero.
        """
        self.changes += 1
        if doubted:
            slow, known = self._constants[SLOW], self._settings.of_slow(0)
            slow[~self._settings.plausible(slow)] = 0.0
            self.covariance[SLOW, SLOW] = np.diag(known**2)
            self.field_error = max(self.field_error, self._settings.field)
            self._reset_field()
        self.covariance[:6] = self.covariance[:, :6] = 0.0
        self.covariance[ATTITUDE, ATTITUDE] = covariance
        bias = self.covariance[GYRO, GYRO]
        self.covariance[RATE, RATE] = bias + self._settings.rate_start**2 * _EYE
        # The gyro measures the sum of rate and bias, so the errors of both estimates are opposite.
        self.covariance[RATE, GYRO] = self.covariance[GYRO, RATE] = -bias
        self.quaternion, self.rate = quaternion, gyro - self._constants[GYRO]
        self.started = True

    @property
    def knowledge(self) -> Knowledge:
        """Accuracy class of the attitude estimate."""
        if not self.started or (sigma := self.worst_sigma) > self._settings.coarse:
            return Knowledge.LOST
        return Knowledge.FINE if sigma <= self._settings.fine else Knowledge.COARSE

    @property
    def worst_sigma(self) -> float:
        """Standard deviation of the attitude about the least certain axis, rad."""
        covariance = self.covariance
        return math.sqrt(max(covariance[0, 0], covariance[1, 1], covariance[2, 2]))

    @property
    def slow(self) -> SlowStates:
        """Values and covariance of the slowly varying states."""
        return SlowStates(self._constants[SLOW].copy(), self.covariance[SLOW, SLOW].copy())

    def memory(self) -> FreeMemory:
        """Return a copy of the estimate that `recall` can restore."""
        constants, covariance = self._constants.copy(), self.covariance.copy()
        return FreeMemory(
            self.quaternion, self.rate, self.acceleration, constants, covariance, self.field_error
        )

    def recall(self, then: FreeMemory) -> None:
        """Restore an earlier estimate from the copy `then`."""
        self.changes += 1
        self.quaternion, self.rate, self.acceleration = then.quaternion, then.rate, then.acceleration
        self._constants, self.covariance = then.constants.copy(), then.covariance.copy()
        self.field_error = then.field_error

    @property
    def gyro_bias(self) -> FloatArray:
        """Gyro bias (3,) rad/s."""
        return self._constants[GYRO].copy()

    @property
    def magnet_bias(self) -> FloatArray:
        """Magnetometer bias (3,) in body axes, T."""
        return self._constants[MAGNET].copy()

    @property
    def torque_sizes(self) -> FloatArray:
        """Sizes (9,) of the disturbance torques, N m."""
        return self._constants[TORQUES].copy()

    @property
    def axes_rotation(self) -> FloatArray:
        """Rotation vector (3,) of the principal axes from the assumed axes, in body axes, rad."""
        return self._constants[AXES].copy()

    def residual_dipole(self, sunlit: float) -> FloatArray:
        """Return the residual dipole moment (3,) A m^2, body axes, for a visible fraction of the Sun."""
        return np.asarray(self._constants[DIPOLE] + sunlit * self._constants[SUNLIT])

    def advance(
        self, seconds: float, dipole: FloatArray, around: FilterEnvironment, doubt: float = 0.0
    ) -> None:
        """Propagate by `seconds`, a second or two, under the coils' dipole moment (3,) A m^2 in body axes.

        `doubt` (A m^2) is the standard deviation per axis of the dipole moment if it may differ from the
        command.
        """
        speed = math.sqrt(float(self.rate @ self.rate))
        steps = max(1, math.ceil(speed * seconds / LARGEST_ROTATION))
        for _ in range(steps):
            self._step(seconds / steps, dipole, around, doubt)

    def gyro(
        self, rate: FloatArray, covariance: FloatArray, change: FloatArray | None = None, since: float = 0.0
    ) -> bool:
        """Apply a gyro rate (3,) rad/s with its covariance (3, 3); return whether it passed the gate.

        For a mean over a past interval, `since` (s) is the age of the middle of the interval. `change` (3,)
        rad/s is then the change of the rate since that time by the acceleration of the last step.
        """
        rows = -since * self._slope
        rows[:, RATE] += _EYE
        rows[:, GYRO] += _EYE
        value = rate - self.rate - self._constants[GYRO]
        return self._update(value if change is None else value + change, rows, covariance)

    def mean_rate(self, rate: FloatArray, covariance: FloatArray, change: FloatArray) -> bool:
        """Apply a rate (3,) rad/s measured without the gyro, such as from streaks, with covariance (3, 3).

        `change` (3,) rad/s is the change of the body rate since the measurement.
        """
        rows = np.zeros((3, STATES))
        rows[:, RATE] = _EYE
        return self._update(rate + change - self.rate, rows, covariance)

    def attitude(self, quaternion: FloatArray, covariance: FloatArray, age: float = 0.0) -> bool:
        """Apply an attitude (4,) that is `age` s old, with covariance (3, 3) rad^2, present body axes."""
        since = from_rotation_vector(age * self.rate - 0.5 * age**2 * self.acceleration)
        rows = np.zeros((3, STATES))
        # The rotation since the measurement is computed from the rate and has its error.
        rows[:, ATTITUDE], rows[:, RATE] = _EYE, -age * _EYE
        error = multiply(multiply(since, quaternion), conjugate(self.quaternion))
        return self._update(to_rotation_vector(error), rows, covariance)

    def direction(self, observed: FloatArray, reference: FloatArray, covariance: FloatArray) -> bool:
        """Apply a direction given in body axes and ICRS, with covariance (3, 3) rad^2 in body axes."""
        expected = attitude_matrix(self.quaternion) @ reference
        across = tangent_basis(expected)
        rows = np.zeros((2, STATES))
        rows[:, ATTITUDE] = across @ cross_matrix(expected)
        return self._update(across @ observed, rows, across @ covariance @ across.T)

    def field(self, measured: FloatArray, reference: FloatArray, covariance: FloatArray) -> bool:
        """Apply a measured field (3,) T in body axes, given the modelled field (3,) T in ICRS axes."""
        expected = attitude_matrix(self.quaternion) @ reference
        rows = np.zeros((3, STATES))
        rows[:, ATTITUDE], rows[:, MAGNET], rows[:, FIELD] = cross_matrix(expected), _EYE, _EYE
        bias = self._constants[MAGNET] + self._constants[FIELD]
        return self._update(measured - expected - bias, rows, covariance + CURRENTS**2 * _EYE)

    def _reset_field(self) -> None:
        """Reset the estimated error of the field model, but keep its standard deviation."""
        self._constants[FIELD] = 0.0
        self.covariance[FIELD] = self.covariance[:, FIELD] = 0.0
        self.covariance[FIELD, FIELD] = self.field_error**2 * _EYE

    def _propagate_field_error(self, dt: float) -> None:
        """Propagate the error of the field model, and estimate its variance while the attitude is fine."""
        covariance, error = self.covariance, self._constants[FIELD]
        if self.worst_sigma <= self._settings.fine:
            square = (float(error @ error) + float(covariance[FIELD, FIELD].trace())) / 3.0
            variance = self.field_error**2 + dt / FIELD_LEARNED * (square - self.field_error**2)
            self.field_error = max(math.sqrt(variance), MINIMUM_FIELD_ERROR)
        kept = math.exp(-dt / self._settings.field_memory)
        error *= kept
        covariance[FIELD] *= kept
        covariance[:, FIELD] *= kept
        covariance.reshape(-1)[_FIELD_DIAGONAL] += (1.0 - kept**2) * self.field_error**2

    def _step(self, dt: float, dipole: FloatArray, around: FilterEnvironment, doubt: float) -> None:
        """Propagate state and covariance by one step of the midpoint rule."""
        self.changes += 1
        motion = self.motion
        motion.rotate_axes(self._constants[AXES])
        middle = multiply(from_rotation_vector(0.5 * dt * self.rate), self.quaternion)
        whole = dipole + self.residual_dipole(around.sunlit)
        torque, flow = motion.torque(middle, whole, self._constants[TORQUES], around)
        half = self.rate + 0.5 * dt * motion.acceleration(self.rate, torque)
        acceleration = motion.acceleration(half, torque)
        flow[0:3, ATTITUDE], flow[0:3, RATE] = -cross_matrix(half), _EYE
        flow[3:6, RATE] = motion.stiffness(half)
        flow[3:6, AXES] += motion.by_axes(half, acceleration)
        self._slope = flow[3:6].copy()
        rotation = from_rotation_vector(dt * (self.rate + 0.5 * dt * acceleration))
        self.quaternion = multiply(rotation, self.quaternion)
        self.acceleration = acceleration
        self.rate = self.rate + dt * acceleration
        flow *= dt
        flow += 0.5 * (flow[:, :6] @ flow)
        flow[:, :6] += np.eye(6)
        covariance = self.covariance
        covariance[:6] = flow @ covariance
        covariance[:, :6] = covariance @ flow.T
        density = dt * self.rate_noise(dipole, around, doubt)
        covariance[RATE, RATE] += density
        covariance[ATTITUDE, ATTITUDE] += dt * dt / 3.0 * density
        covariance[ATTITUDE, RATE] += 0.5 * dt * density
        covariance[RATE, ATTITUDE] += 0.5 * dt * density
        covariance.reshape(-1)[:: STATES + 1][SLOW] += dt * self._walks
        self._propagate_field_error(dt)

    def rate_noise(self, dipole: FloatArray, around: FilterEnvironment, doubt: float = 0.0) -> FloatArray:
        """Return the noise density (3, 3) rad^2/s^3 of the acceleration for a dipole moment of the coils."""
        settings, motion, square = self._settings, self.motion, float(dipole @ dipole)
        coils = LASTING * (settings.coil_error**2 * square / 3.0 + doubt**2)
        coils += settings.coil_noise**2 if square else 0.0
        # The error of the gyroscopic torque is correlated while the body rotates by less than two radians.
        speed = math.sqrt(float(self.rate @ self.rate))
        gyroscopic = speed**2 * settings.inertia_error * motion.largest_difference
        lasting = LASTING if LASTING * speed < 2.0 else 2.0 / speed
        density = (settings.torque_noise**2 + lasting * gyroscopic**2) * motion.by_torque
        if coils:
            field = attitude_matrix(self.quaternion) @ around.field
            across = motion.inverse @ cross_matrix(field)
            density = density + coils * (across @ across.T)
        return np.asarray(density)

    def _update(self, value: FloatArray, rows: FloatArray, noise: FloatArray) -> bool:
        """Correct by an innovation (k,), if it passes the gate, and return whether it passed."""
        cross = self.covariance @ rows.T
        weight = np.linalg.inv(rows @ cross + noise)
        if not 0.0 <= float(value @ weight @ value) <= self._gates[len(value)]:  # a NaN does not pass
            self.refused += 1
            return False
        self.changes += 1
        gain = cross @ weight
        error = gain @ value
        covariance = self.covariance - gain @ cross.T
        self.covariance = 0.5 * (covariance + covariance.T)
        self.quaternion = multiply(from_rotation_vector(error[ATTITUDE]), self.quaternion)
        self.rate = self.rate + error[RATE]
        self._constants[6:] += error[6:]
        return True
