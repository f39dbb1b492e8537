"""The navigation filter of a free satellite: attitude, rate, biases, residual dipole and torques.

A multiplicative extended Kalman filter that integrates Euler's equation over the coils' dipole, the gravity
gradient and the estimated disturbances, a second or two at a step; gyros are measurements. That is leaner
than the filter of the testbed (`attitude_filter`), which replays each late sample at its own time: here a
late attitude is turned on to now by the present rate, and its innovation knows that rate's error: right for
the seconds in which a body slow enough for star images turns evenly. One step with its gyro sample takes 0.3
ms.

The residual dipole has a constant part and a part that comes and goes with sunlight. The other torques have
the shapes of `knightcube.astro.earth.disturbance`; their sizes are states, and so is a small turn of the
principal axes from those believed: while a body tumbles its gyroscopic torque would else pass for a bias of
the gyros.

The field is off its model by a vector that keeps its sign for minutes: a Gauss-Markov process of first order
in body axes. How large it is, is learned as in expectation maximisation (Dempster, Laird & Rubin 1977):
its variance follows the square of the estimate and the estimate's own variance, which tell nothing where
the attitude is not known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro import chi_square
from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import tangent_basis
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.gnc.estimation.estimate import Knowledge
from knightcube.gnc.estimation.free_motion import (
    AXES,
    DIPOLE,
    FIELD,
    GYRO,
    MAGNET,
    RATE,
    SLOW,
    STATES,
    SUNLIT,
    TORQUES,
    TURN,
    Around,
    FreeMotion,
    crossed,
)
from knightcube.gnc.estimation.free_settings import FreeFilterSettings, acceleration_noise

LARGEST_TURN = 0.1
"""rad, of a step of integration."""
FIELD_LEARNED = 2_000.0
"""s over which the size of the field's error is averaged."""
LEAST_FIELD = 1e-8
"""T, of an axis of that error at least: a magnetometer's own errors change as much."""
CURRENTS = 1e-7
"""T of an axis: of currents in the aurora, which change from field to field; it is not refused over them."""
_EYE: FloatArray = np.eye(3)
_FIELD_DIAGONAL = slice(FIELD.start * (STATES + 1), None, STATES + 1)


@dataclass(frozen=True, slots=True, eq=False)
class SlowStates:
    """The states after the rate: `values` (24,) and their covariance (24, 24)."""

    values: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FreeMemory:
    """An estimate of the filter: its attributes of these names."""

    quaternion: FloatArray
    rate: FloatArray
    acceleration: FloatArray
    constants: FloatArray
    covariance: FloatArray
    field_error: float


class FreeFilter:
    """Owns the estimate. `refused` counts the measurements that did not pass their gate.

    More than 200 lines: a method for each kind of measurement, and a property for each thing estimated.

    Attributes:
        quaternion: (4,) ICRS into body.
        rate: (3,) rad/s, body axes.
        acceleration: (3,) rad/s^2, body axes, of the last step.
        covariance: (33, 33) of the errors (TURN, RATE, ...).
        field_error: T of an axis, of the field's model.
        knowledge: how well the attitude is known.
        changes: counts the changes of the estimate.
    """

    def __init__(
        self, inertia: FloatArray, settings: FreeFilterSettings, slow: SlowStates | None = None
    ) -> None:
        """`inertia` (3, 3) kg m^2, body axes; `slow` is what is known of the slow states before the start."""
        self.motion = FreeMotion(inertia)
        self._settings = settings
        tail = math.erfc(settings.gate_sigma / math.sqrt(2.0))
        self._walks = settings.of_slow(1) ** 2
        self._gates = {n: chi_square.bound(tail, n) for n in (1, 2, 3)}
        self._constants: FloatArray = np.zeros(STATES)
        self.acceleration: FloatArray = np.zeros(3)
        self._slope: FloatArray = np.zeros((3, STATES))  # of the acceleration, by the states
        self.started = False
        self.refused = 0
        self.changes = 0
        self.quaternion: FloatArray = np.array([0.0, 0.0, 0.0, 1.0])
        self.rate: FloatArray = np.zeros(3)
        self.covariance: FloatArray = np.zeros((STATES, STATES))
        self.covariance[SLOW, SLOW] = np.diag(settings.of_slow(0) ** 2)
        self.field_error = settings.field
        self._doubt_field()
        if slow is not None:
            self._constants[SLOW], self.covariance[SLOW, SLOW] = slow.values, slow.covariance

    def start(
        self, quaternion: FloatArray, covariance: FloatArray, gyro: FloatArray, *, doubted: bool = False
    ) -> None:
        """Start from an attitude (4,), covariance (3, 3) rad^2, body axes, and a gyro's rate (3,) rad/s.

        What was learned of the slow states is kept; `doubted`: the estimate was contradicted, so how well
        they are claimed to be known is not, nor what is farther off than is believed of a start.
        """
        self.changes += 1
        if doubted:
            slow, known = self._constants[SLOW], self._settings.of_slow(0)
            slow[~self._settings.believes(slow)] = 0.0
            self.covariance[SLOW, SLOW] = np.diag(known**2)
            self.field_error = max(self.field_error, self._settings.field)
            self._doubt_field()
        self.covariance[:6] = self.covariance[:, :6] = 0.0
        self.covariance[TURN, TURN] = covariance
        bias = self.covariance[GYRO, GYRO]
        self.covariance[RATE, RATE] = bias + self._settings.rate_start**2 * _EYE
        # The gyro measures the sum of rate and bias, so their errors are opposite.
        self.covariance[RATE, GYRO] = self.covariance[GYRO, RATE] = -bias
        self.quaternion, self.rate = quaternion, gyro - self._constants[GYRO]
        self.started = True

    @property
    def knowledge(self) -> Knowledge:
        """How well the attitude is known."""
        if not self.started or (sigma := self.worst_sigma) > self._settings.coarse:
            return Knowledge.LOST
        return Knowledge.FINE if sigma <= self._settings.fine else Knowledge.COARSE

    @property
    def worst_sigma(self) -> float:
        """The attitude's standard deviation about its worst axis, rad."""
        covariance = self.covariance
        return math.sqrt(max(covariance[0, 0], covariance[1, 1], covariance[2, 2]))

    @property
    def slow(self) -> SlowStates:
        """What is known of the states that change slowly or not at all."""
        return SlowStates(self._constants[SLOW].copy(), self.covariance[SLOW, SLOW].copy())

    def memory(self) -> FreeMemory:
        """Return the estimate as it stands, for `recall`."""
        constants, covariance = self._constants.copy(), self.covariance.copy()
        return FreeMemory(
            self.quaternion, self.rate, self.acceleration, constants, covariance, self.field_error
        )

    def recall(self, then: FreeMemory) -> None:
        """Return to an earlier estimate."""
        self.changes += 1
        self.quaternion, self.rate, self.acceleration = then.quaternion, then.rate, then.acceleration
        self._constants, self.covariance = then.constants.copy(), then.covariance.copy()
        self.field_error = then.field_error

    @property
    def gyro_bias(self) -> FloatArray:
        """The gyros' bias (3,) rad/s."""
        return self._constants[GYRO].copy()

    @property
    def magnet_bias(self) -> FloatArray:
        """The magnetometer's bias (3,) T, body axes."""
        return self._constants[MAGNET].copy()

    @property
    def torque_sizes(self) -> FloatArray:
        """The sizes (9,) N m of the torques."""
        return self._constants[TORQUES].copy()

    @property
    def axes_turn(self) -> FloatArray:
        """The turn (3,) rad of the principal axes from those believed, body axes."""
        return self._constants[AXES].copy()

    def residual_dipole(self, sunlit: float) -> FloatArray:
        """Return the residual dipole (3,) A m^2 in a share of sunlight, body axes."""
        return np.asarray(self._constants[DIPOLE] + sunlit * self._constants[SUNLIT])

    def advance(self, seconds: float, dipole: FloatArray, around: Around, doubt: float = 0.0) -> None:
        """Propagate by `seconds` under the coils' dipole (3,) A m^2, body axes; a second or two at once.

        `doubt` A m^2 is the standard deviation of an axis of a dipole that may not have flown.
        """
        speed = math.sqrt(float(self.rate @ self.rate))
        steps = max(1, math.ceil(speed * seconds / LARGEST_TURN))
        for _ in range(steps):
            self._step(seconds / steps, dipole, around, doubt)

    def gyro(
        self, rate: FloatArray, covariance: FloatArray, change: FloatArray | None = None, since: float = 0.0
    ) -> bool:
        """Accept a gyro's rate (3,) rad/s and its covariance (3, 3).

        Of a mean over the past, `change` (3,) is by how much the rate has changed since its middle, `since` s
        ago, by the last step's acceleration.
        """
        rows = -since * self._slope
        rows[:, RATE] += _EYE
        rows[:, GYRO] += _EYE
        value = rate - self.rate - self._constants[GYRO]
        return self._update(value if change is None else value + change, rows, covariance)

    def mean_rate(self, rate: FloatArray, covariance: FloatArray, change: FloatArray) -> bool:
        """Accept a rate (3,) rad/s without the gyros' bias, such as of streaks, and its covariance (3, 3).

        `change` (3,) is by how much the rate has changed since.
        """
        rows = np.zeros((3, STATES))
        rows[:, RATE] = _EYE
        return self._update(rate + change - self.rate, rows, covariance)

    def attitude(self, quaternion: FloatArray, covariance: FloatArray, age: float = 0.0) -> bool:
        """Accept an attitude (4,) measured `age` s ago, covariance (3, 3) rad^2, body axes of now."""
        since = from_rotation_vector(age * self.rate - 0.5 * age**2 * self.acceleration)
        rows = np.zeros((3, STATES))
        # The turn since then has the error of the rate.
        rows[:, TURN], rows[:, RATE] = _EYE, -age * _EYE
        error = multiply(multiply(since, quaternion), conjugate(self.quaternion))
        return self._update(to_rotation_vector(error), rows, covariance)

    def direction(self, observed: FloatArray, reference: FloatArray, covariance: FloatArray) -> bool:
        """Accept a direction: unit vectors (3,) in body axes and ICRS, covariance (3, 3) rad^2, body axes."""
        expected = attitude_matrix(self.quaternion) @ reference
        across = tangent_basis(expected)
        rows = np.zeros((2, STATES))
        rows[:, TURN] = across @ crossed(expected)
        return self._update(across @ observed, rows, across @ covariance @ across.T)

    def field(self, measured: FloatArray, reference: FloatArray, covariance: FloatArray) -> bool:
        """Accept the field (3,) T of now in body axes, the model's (3,) T, ICRS; covariance (3, 3) T^2."""
        expected = attitude_matrix(self.quaternion) @ reference
        rows = np.zeros((3, STATES))
        rows[:, TURN], rows[:, MAGNET], rows[:, FIELD] = crossed(expected), _EYE, _EYE
        wrong = self._constants[MAGNET] + self._constants[FIELD]
        return self._update(measured - expected - wrong, rows, covariance + CURRENTS**2 * _EYE)

    def _doubt_field(self) -> None:
        """Know nothing of the field's error but its size."""
        self._constants[FIELD] = 0.0
        self.covariance[FIELD] = self.covariance[:, FIELD] = 0.0
        self.covariance[FIELD, FIELD] = self.field_error**2 * _EYE

    def _age_field(self, dt: float) -> None:
        """Let the field's error fade, and learn its size where the attitude is fine."""
        covariance, error = self.covariance, self._constants[FIELD]
        if self.worst_sigma <= self._settings.fine:
            square = (float(error @ error) + float(covariance[FIELD, FIELD].trace())) / 3.0
            variance = self.field_error**2 + dt / FIELD_LEARNED * (square - self.field_error**2)
            self.field_error = max(math.sqrt(variance), LEAST_FIELD)
        kept = math.exp(-dt / self._settings.field_memory)
        error *= kept
        covariance[FIELD] *= kept
        covariance[:, FIELD] *= kept
        covariance.reshape(-1)[_FIELD_DIAGONAL] += (1.0 - kept**2) * self.field_error**2

    def _step(self, dt: float, dipole: FloatArray, around: Around, doubt: float) -> None:
        """Take one step of the midpoint rule, with its covariance."""
        self.changes += 1
        motion = self.motion
        motion.turn_axes(self._constants[AXES])
        middle = multiply(from_rotation_vector(0.5 * dt * self.rate), self.quaternion)
        whole = dipole + self.residual_dipole(around.sunlit)
        torque, flow = motion.torque(middle, whole, self._constants[TORQUES], around)
        half = self.rate + 0.5 * dt * motion.acceleration(self.rate, torque)
        acceleration = motion.acceleration(half, torque)
        flow[0:3, TURN], flow[0:3, RATE] = -crossed(half), _EYE
        flow[3:6, RATE] = motion.stiffness(half)
        flow[3:6, AXES] += motion.by_axes(half, acceleration)
        self._slope = flow[3:6].copy()
        turn = from_rotation_vector(dt * (self.rate + 0.5 * dt * acceleration))
        self.quaternion = multiply(turn, self.quaternion)
        self.acceleration = acceleration
        self.rate = self.rate + dt * acceleration
        flow *= dt
        flow += 0.5 * (flow[:, :6] @ flow)
        flow[:, :6] += np.eye(6)
        covariance = self.covariance
        covariance[:6] = flow @ covariance
        covariance[:, :6] = covariance @ flow.T
        self._add_noise(dt, dipole, around, doubt)

    def rate_noise(self, dipole: FloatArray, around: Around, doubt: float = 0.0) -> FloatArray:
        """Return the density (3, 3) rad^2/s^3 of the acceleration's noise under the coils' dipole (3,)."""
        field = attitude_matrix(self.quaternion) @ around.field
        return acceleration_noise(self._settings, self.motion, self.rate, field, dipole, doubt)

    def _add_noise(self, dt: float, dipole: FloatArray, around: Around, doubt: float) -> None:
        density = dt * self.rate_noise(dipole, around, doubt)
        covariance = self.covariance
        covariance[RATE, RATE] += density
        covariance[TURN, TURN] += dt * dt / 3.0 * density
        covariance[TURN, RATE] += 0.5 * dt * density
        covariance[RATE, TURN] += 0.5 * dt * density
        diagonal = covariance.reshape(-1)[:: STATES + 1]
        diagonal[SLOW] += dt * self._walks
        self._age_field(dt)

    def _update(self, value: FloatArray, rows: FloatArray, noise: FloatArray) -> bool:
        """Correct by an innovation (k,), derivative (k, 33) and noise (k, k); return whether it was used."""
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
        self.quaternion = multiply(from_rotation_vector(error[TURN]), self.quaternion)
        self.rate = self.rate + error[RATE]
        self._constants[6:] += error[6:]
        return True
