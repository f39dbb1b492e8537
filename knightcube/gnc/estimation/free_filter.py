"""The navigation filter of a free satellite whose mass properties and sensor errors are not exactly known.

A multiplicative extended Kalman filter integrates Euler's equation with the dipole of the coils, the gravity
gradient and the estimated disturbances, in steps of a second or two. Gyro samples are measurements. The
filter does not replay late samples, unlike `attitude_filter`: a late attitude is propagated to the present
with the present rate, and the innovation includes the error of this rate. The propagated attitude is accurate
for some seconds if the body rotates slowly enough for star images. Besides attitude and rate, the error state
(see `error_state`) contains these blocks:

- `inertia`: errors of the inertia tensor, relative to the trace, in which Euler's equation is linear. In a
  tumble about more than one axis, the ratios of the moments of inertia and the principal axes are observable
  (Psiaki 2005, JGCD 28(4)). The common scale is observable only relative to the dipole moment of the coils.

- `coils`: matrix of gain errors and misalignments, which converts the commanded dipole to the dipole's error.

- `gyro_matrix`, `field_matrix`: scale errors and misalignments of both sensors (Pittelkau 2001, JGCD 24(6)).

- `camera`: misalignment of the star camera, whose attitude is known better than the attitude of the body.

- `horizon`: misalignment of the horizon cameras that measure nadir. When the body rotates, different cameras
  measure nadir, so this block is a Gauss-Markov process with a long correlation time.

- `sun_camera`: misalignment of the horizon camera that measures the Sun, reset if another camera measures it.

- `coil_variation`: relative variation of the dipole along each body axis, for example with the supply
  voltage, as a Gauss-Markov process with a correlation time of tens of seconds.

- `field_error`: error of the field model, correlated over minutes, as a Gauss-Markov process of first order
  in body axes. While the attitude is known accurately, its standard deviation is estimated by expectation
  maximisation (Dempster, Laird & Rubin 1977), from the square and the variance of the estimated error.

- Biases of gyro and magnetometer, the residual dipole in shadow, its increase in sunlight, and the components
  of the disturbance torques of `knightcube.astro.earth.disturbance`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import (
    FloatArray,
    IntArray,
    check_type,
    cross_matrix,
    cross_product,
    finite_array,
    tangent_basis,
)
from knightcube.astro.earth.disturbance import AIR, SIZES, Pressures, box_areas
from knightcube.astro.inertia import checked_inertia
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.gnc.estimation.error_state import (
    ErrorState,
    Role,
    StateBlock,
    check_amounts,
    direction_error,
    gate_bounds,
    joined,
    keep_scale,
    plausible,
    propagated,
    reset,
    slices,
    updated,
    weigh,
    widen,
    with_role,
)
from knightcube.gnc.estimation.estimate import Knowledge, check_measured, check_span, of_unit_length
from knightcube.gnc.estimation.free_motion import Bodies, step
from knightcube.gnc.estimation.rigid_body import (
    BodyErrors,
    by_matrix,
    inertia_covariance,
    per_trace,
    tensor,
)

BLOCKS = {
    "attitude": 3,
    "rate": 3,
    "gyro_bias": 3,
    "dipole": 3,
    "sunlit_dipole": 3,
    "field_bias": 3,
    "torques": SIZES,
    "inertia": 6,
    "coils": 9,
    "gyro_matrix": 9,
    "field_matrix": 9,
    "camera": 3,
    "horizon": 3,
    "field_error": 3,
    "coil_variation": 3,
    "sun_camera": 3,
}
"""Number of elements of each block of the error state, in order. Matrices (3, 3) are stored row by row."""
(
    ATTITUDE,
    RATE,
    GYRO,
    DIPOLE,
    SUNLIT,
    MAGNET,
    TORQUES,
    INERTIA,
    COILS,
    GYRO_MATRIX,
    FIELD_MATRIX,
    CAMERA,
    HORIZON,
    FIELD,
    VARIATION,
    SUN_CAMERA,
) = slices(BLOCKS)
"""Indices of the blocks of the error state."""
SLOW = slice(GYRO.start, CAMERA.stop)
"""Indices of the slowly varying states, which are stored for the next boot."""
STATES = SUN_CAMERA.stop
"""Number of elements of the error state."""
_MOVING: IntArray = np.r_[ATTITUDE, RATE, DIPOLE, SUNLIT, TORQUES, INERTIA, COILS, VARIATION]
"""Indices of the states on which the angular acceleration depends, in the order of `MotionStep.slopes`."""


@dataclass(frozen=True, slots=True, eq=False)
class FilterEnvironment:
    """The environment of the satellite at one time, in ICRS axes.

    The environment consists of the magnetic field `field` (3,) T, the `position` (3,) m, the `pressures` of
    air and sunlight, and the visible fraction `sunlit` of the Sun. The error of the field has a standard
    deviation of at least `field_sigma` (T per axis).
    """

    field: FloatArray
    position: FloatArray
    pressures: Pressures
    sunlit: float
    field_sigma: float = 0.0


class FreeMotion:
    """Euler's equation of an orbiting satellite whose inertia differs from the assumed inertia."""

    def __init__(self, inertia: FloatArray) -> None:
        """Use the assumed inertia tensor `inertia` (3, 3), kg m^2, body axes.

        Raises ArgumentError for a physically impossible tensor.
        """
        self._assumed: FloatArray = checked_inertia("inertia", inertia)
        self.trace = float(np.trace(self._assumed))
        """Trace of the assumed inertia, kg m^2."""
        self.elements: FloatArray = self._assumed[_ROWS, _COLUMNS] / self.trace
        """Elements (6,) of the assumed inertia, relative to its trace."""
        self._areas = box_areas(self._assumed)
        self._error: FloatArray = np.full(6, math.nan)
        self.correct(np.zeros(6))

    def correct(self, error: FloatArray) -> None:
        """Set the inertia to the assumed inertia plus an error.

        The error (6,) contains the elements xx, yy, zz, yz, zx and xy of a tensor, relative to the trace.
        """
        if np.array_equal(error, self._error):
            return
        self._error = error.copy()
        self.inertia: FloatArray = self._assumed + self.trace * tensor(error)
        self.inverse: FloatArray = np.asarray(np.linalg.inv(self.inertia), dtype=float)
        self.by_torque: FloatArray = self.inverse @ self.inverse
        """Covariance (3, 3) of the angular acceleration due to a torque of unit variance per axis."""

    @property
    def body(self) -> Bodies:
        """The properties of the body on which its motion depends."""
        return self.inertia, self.inverse, self._areas, self.trace

    def stiffness(self, rate: FloatArray) -> FloatArray:
        """Return the derivative (3, 3) of the angular acceleration with respect to the rate (3,) rad/s."""
        slope = cross_matrix(self.inertia @ rate) - cross_matrix(rate) @ self.inertia
        return np.asarray(self.inverse @ slope)


_ROWS, _COLUMNS = (0, 1, 2, 1, 2, 0), (0, 1, 2, 2, 0, 1)
"""Rows and columns of the elements xx, yy, zz, yz, zx, xy of a tensor."""


LASTING = 20.0
"""Correlation time (s) of uncertain coil dipoles and of field errors of a body at rest, used for the
equivalent white noise."""
CURVATURE = 6.0
"""Correlation time (s) of the angular acceleration that is of second order in the error of the inertia."""
CONSTANT_SHARE, AIR_SHARE, LIGHT_SHARE = 0.03, 1.0, 0.5
"""Expected magnitudes of the constant, aerodynamic and solar radiation torques, as multiples of the
aerodynamic torque. The constant torque is assumed to be small, because the error of the inertia has its own
states, and because an aerodynamic torque attributed to the constant torque would be wrong at every other
attitude."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FreeFilterSettings:
    """Noise and limits of the filter.

    Each pair of values contains the initial standard deviation and the random walk per sqrt(s).

    Attributes:
        gyro: initial standard deviation and random walk of the gyro bias, rad/s.
        dipole, sunlit: initial standard deviation and random walk of the residual dipole in shadow
            (`dipole`), and of its increase in sunlight (`sunlit`), A m^2.
        magnet: initial standard deviation and random walk of the magnetometer bias, T.
        field: initial standard deviation of the field model's error, T per axis.
        torque: expected magnitude and random walk of the aerodynamic torque, N m. The expected magnitudes of
            the solar radiation torque and of the constant torque are fixed fractions of `torque`.
        coil_noise: density of the white noise of each coil's dipole while it is driven, A m^2 sqrt(s).
        errors: largest errors of the description of body and sensors.
        coils: initial covariance (9, 9) of the coils' matrix, whose elements are listed row by row; None for
            coils along the body axes, whose covariance follows from `errors`.
        roles: roles of the blocks whose role differs from the default, by name of the block.
        gate_sigma: gate threshold in standard deviations; a measurement is rejected if its innovation is less
            probable than a one-dimensional deviation of this size.
    """

    gyro: tuple[float, float] = (1e-3, 2e-6)
    dipole: tuple[float, float] = (1e-3, 1.5e-6)
    sunlit: tuple[float, float] = (3e-4, 2e-7)
    magnet: tuple[float, float] = (3e-7, 3e-10)
    field: float = 5e-8
    torque: tuple[float, float] = (3e-9, 5e-12)
    coil_noise: float = 0.0
    errors: BodyErrors = dataclasses.field(default_factory=BodyErrors)
    coils: FloatArray | None = None
    roles: Mapping[str, Role] = dataclasses.field(default_factory=dict)
    gate_sigma: float = 5.0

    def __post_init__(self) -> None:
        """Raise ArgumentError for a value out of its range, and for a covariance of another shape."""
        check_amounts(self, "gate_sigma")
        check_type("errors", self.errors, BodyErrors)
        if self.coils is not None:
            finite_array("coils", self.coils, (9, 9))

    def error_state(self, inertia: FloatArray) -> ErrorState:
        """Return the error state of the filter for a body with the inertia tensor `inertia` (3, 3) kg m^2."""
        start, walk = self.torque
        torques = np.repeat([CONSTANT_SHARE * start, AIR_SHARE * start, LIGHT_SHARE * start], 3)
        errors, ones, coils = self.errors, np.ones(3), self.coils
        if coils is None:
            coils = _matrix_errors(errors.coil_gain, errors.coil_axes)
        blocks = [
            StateBlock("attitude", np.zeros(3)),
            StateBlock("rate", np.zeros(3)),
            StateBlock("gyro_bias", self.gyro[0] * ones, self.gyro[1]),
            StateBlock("dipole", self.dipole[0] * ones, self.dipole[1]),
            StateBlock("sunlit_dipole", self.sunlit[0] * ones, self.sunlit[1]),
            StateBlock("field_bias", self.magnet[0] * ones, self.magnet[1]),
            StateBlock("torques", torques, walk),
            StateBlock("inertia", inertia_covariance(inertia, errors)),
            StateBlock("coils", coils, COIL_WALK),
            StateBlock("gyro_matrix", _matrix_errors(errors.gyro_scale, errors.gyro_alignment)),
            StateBlock("field_matrix", _matrix_errors(errors.field_matrix, errors.field_matrix)),
            StateBlock("camera", _UNIFORM * errors.camera * ones),
            StateBlock("horizon", _UNIFORM * errors.horizon * ones),
            StateBlock("field_error", self.field * ones),
            StateBlock("coil_variation", COIL_ERROR * ones),
            StateBlock("sun_camera", _UNIFORM * errors.horizon * ones),
        ]
        return ErrorState(with_role(blocks, self.roles))


_UNIFORM = 1.0 / math.sqrt(3.0)
"""Standard deviation of a uniformly distributed error whose largest value is one."""


def _matrix_errors(scale: float, alignment: float) -> FloatArray:
    """Return standard deviations (9,) of a matrix from its largest errors on and off the diagonal."""
    return _UNIFORM * np.where(np.eye(3, dtype=bool), scale, alignment).ravel()


LARGEST_ROTATION = 0.1
"""Largest rotation (rad) of the body in one integration step."""
FINE, COARSE = math.radians(0.1), math.radians(5.0)
"""Largest standard deviations (rad) of a FINE and of a COARSE attitude about the least certain axis."""
RATE_START = 1e-3
"""Initial standard deviation (rad/s) of a rate that the gyro measured."""
TORQUE_NOISE = 1e-9
"""Density (N m sqrt(s)) of the white noise of all torques that are not estimated."""
FIELD_MEMORY = 600.0
"""Correlation time (s) of the field model's error."""
FIELD_LEARNED = 2_000.0
"""Averaging time (s) of the estimated variance of the field model's error."""
HORIZON_MEMORY = 3_000.0
"""Correlation time (s) of the misalignment of the horizon cameras."""
COIL_ERROR, COIL_MEMORY = 0.005, 20.0
"""Relative standard deviation and correlation time (s) of the variation of the coils' dipoles."""
COIL_WALK = 1e-4
"""Random walk per sqrt(s) of the elements of the coils' matrix, for example due to temperature."""
INERTIA_WALK = 5e-5
"""Random walk of the inertia's error, relative to the trace, per sqrt(s) and per angular rate in rad/s. The
random walk represents flexible parts, which are loaded only while the body rotates. It also prevents the
uncertainty of the inertia from becoming too small."""
MINIMUM_FIELD_ERROR = 1e-8
"""Minimum standard deviation (T per axis) of the field model's error. The error also represents slow
variations of the magnetometer's errors."""
CURRENTS = 1e-7
"""Standard deviation (T per axis) of the magnetic field of auroral currents. The standard deviation of
auroral fields is added to the measurement noise, so that field measurements in auroral zones pass the
gate."""
AIR_WALK = 6e-3
"""Random walk of the air density, relative to the density, per sqrt(s): 15 % in ten minutes."""
_EYE: FloatArray = np.eye(3)
_BODY = slice(INERTIA.start, COILS.stop)
_INERTIA_DIAGONAL = slice(INERTIA.start * (STATES + 1), INERTIA.stop * (STATES + 1), STATES + 1)


@dataclass(frozen=True, slots=True, eq=False)
class SlowStates:
    """The `values` (n,) of the slowly varying states and their covariance (n, n), in the order of `SLOW`."""

    values: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FreeMemory:
    """A copy of the attributes of the filter that form the estimate."""

    quaternion: FloatArray
    rate: FloatArray
    acceleration: FloatArray
    driven: FloatArray
    constants: FloatArray
    covariance: FloatArray
    field_error: float
    sun_cameras: int


class FreeFilter:
    """The navigation filter of a free satellite, with its present estimate.

    The class has over 350 lines, because all propagations and measurements change the same estimate.

    Attributes:
        layout: blocks of the error state.
        quaternion: attitude (4,), from ICRS into body axes.
        rate: body rate (3,) in body axes, rad/s.
        acceleration: angular acceleration (3,) in body axes during the last step, rad/s^2.
        driven: commanded dipole (3,) of the coils in body axes during the last step, A m^2.
        covariance: covariance (STATES, STATES) of the error state.
        field_error: standard deviation of the field model's error, T per axis.
        sun_cameras: bit mask of the cameras that measured the Sun most recently; 0 if none has measured it.
        changes: number of changes of the estimate so far.
        refused: number of measurements that did not pass the gate.
        newest_square: normalised square of the newest innovation.
    """

    def __init__(
        self, inertia: FloatArray, settings: FreeFilterSettings, slow: SlowStates | None = None
    ) -> None:
        """Use the assumed inertia tensor `inertia` (3, 3), kg m^2, body axes.

        The prior of the slowly varying states is `slow`, whose default is the prior of the settings.
        """
        self.motion = FreeMotion(inertia)
        self.layout = settings.error_state(inertia)
        self._settings = settings
        self._gates = gate_bounds(settings.gate_sigma)
        self._constants: FloatArray = np.zeros(STATES)
        self.acceleration: FloatArray = np.zeros(3)
        self.driven: FloatArray = np.zeros(3)
        # `_slope` is the derivative of the angular acceleration with respect to the states.
        self._slope: FloatArray = np.zeros((3, STATES))
        # `_lag` (rad) is the integral of the difference between the present and the past rate.
        self._lag: FloatArray = np.zeros(3)
        # `_given` (A m^2 s^2) is the integral of the commanded dipole times the time since `begin_mean`.
        self._given: FloatArray = np.zeros(3)
        self._since = 0.0  # duration (s) of the integrals `_lag` and `_given`
        self.started = False
        self.refused = 0
        self.changes, self.newest_square = 0, 0.0
        self.quaternion: FloatArray = np.array([0.0, 0.0, 0.0, 1.0])
        self.rate: FloatArray = np.zeros(3)
        self.covariance: FloatArray = self.layout.prior.copy()
        self.field_error, self.sun_cameras = settings.field, 0
        self._reset_field()
        if slow is not None:
            self._constants[SLOW], self.covariance[SLOW, SLOW] = slow.values, slow.covariance

    def start(
        self,
        quaternion: FloatArray,
        covariance: FloatArray,
        gyro: FloatArray,
        *,
        by_stars: bool = False,
        doubted: bool = False,
        spread: FloatArray | None = None,
    ) -> None:
        """Start from an attitude (4,), covariance (3, 3) rad^2, body axes, and a gyro rate (3,) rad/s.

        If the rate was not measured by the gyro, its covariance is `spread` (3, 3), rad^2/s^2. If `by_stars`
        is true, the attitude was measured by the star camera, otherwise by the horizon cameras. The slowly
        varying states keep their estimated values. If measurements contradicted the previous estimate
        (`doubted`), the covariance of the slow states is reset to the prior of the settings, and implausible
        values are set to zero.
        """
        check_measured(covariance, finite=True, quaternion=quaternion, gyro=gyro)
        quaternion = of_unit_length("quaternion", quaternion)
        self.changes += 1
        if doubted:
            self.widen(np.arange(SLOW.start, SLOW.stop))
            self.field_error = max(self.field_error, self._settings.field)
            self._reset_field()
        # The errors of the first attitude and rate depend on misalignments, gyro bias and gyro matrix.
        first = np.zeros((6, STATES))
        misaligned = CAMERA if by_stars else HORIZON
        self.quaternion = multiply(from_rotation_vector(-self._constants[misaligned]), quaternion)
        first[ATTITUDE, misaligned] = -_EYE
        self.rate = gyro
        alone = np.zeros((6, 6))
        alone[ATTITUDE, ATTITUDE], alone[RATE, RATE] = covariance, RATE_START**2 * _EYE
        if spread is None:
            measured = gyro - self._constants[GYRO]
            self.rate = np.asarray(np.linalg.solve(_EYE + self._matrix(GYRO_MATRIX), measured), dtype=float)
            first[RATE, GYRO], first[RATE, GYRO_MATRIX] = -_EYE, -by_matrix(self.rate)
        else:
            alone[RATE, RATE] = finite_array("spread", spread, (3, 3))
        self.covariance = joined(self.covariance, first, alone)
        self.begin_mean()
        self.started = True

    @property
    def knowledge(self) -> Knowledge:
        """Accuracy class of the attitude."""
        if not self.started or (sigma := self.worst_sigma) > COARSE:
            return Knowledge.LOST
        return Knowledge.FINE if sigma <= FINE else Knowledge.COARSE

    @property
    def worst_sigma(self) -> float:
        """Standard deviation of the attitude of the body about its least certain axis, rad."""
        covariance = self.covariance
        return math.sqrt(max(covariance[0, 0], covariance[1, 1], covariance[2, 2]))

    @property
    def camera_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the attitude of the star camera in body axes, rad^2."""
        return np.asarray(_CAMERA_ROWS @ self.covariance @ _CAMERA_ROWS.T)

    @property
    def slow(self) -> SlowStates:
        """The slowly varying states and their covariance."""
        return SlowStates(self._constants[SLOW].copy(), self.covariance[SLOW, SLOW].copy())

    def memory(self) -> FreeMemory:
        """Return a copy of the estimate, for `recall`."""
        return FreeMemory(
            self.quaternion,
            self.rate,
            self.acceleration,
            self.driven,
            self._constants.copy(),
            self.covariance.copy(),
            self.field_error,
            self.sun_cameras,
        )

    def recall(self, then: FreeMemory) -> None:
        """Restore an earlier estimate from its copy `then`."""
        self.changes += 1
        self.quaternion, self.rate = then.quaternion, then.rate
        self.acceleration, self.driven = then.acceleration, then.driven
        self._constants, self.covariance = then.constants.copy(), then.covariance.copy()
        self.field_error, self.sun_cameras = then.field_error, then.sun_cameras

    def renew_coil(
        self, direction: FloatArray, dual: FloatArray, deviation: float, memories: Sequence[FreeMemory] = ()
    ) -> None:
        """Reset the estimated matrix of the coils for one coil.

        The coil has the unit vector `direction` (3,) in body axes; the vector `dual` (3,) is normal to the
        other coils and has the scalar product 1 with `direction`. The estimate and its copies `memories` are
        changed. The reset is necessary after the sign or the gain of the coil was corrected, because the
        estimated matrix refers to the dipole before the correction. The error of the corrected dipole is set
        to zero, and its correlations with other states are deleted. The settings give the new relative
        standard deviation of the corrected dipole; the component along the coil is at least `deviation`.
        """
        self.changes += 1
        kept = np.eye(STATES)
        kept[COILS, COILS] = np.kron(_EYE, (_EYE - np.outer(direction, dual)).T)
        along = np.kron(_EYE, direction)
        error = along @ self.layout.prior[COILS, COILS] @ along.T
        least = deviation**2 - float(direction @ error @ direction)
        if error.any() and least > 0.0:
            error = error + least * np.outer(direction, direction)
        spread = np.kron(_EYE, dual[:, None])
        fresh = spread @ error @ spread.T
        for constants, covariance in self._with(memories):
            constants[COILS] = kept[COILS, COILS] @ constants[COILS]
            covariance[:] = kept @ covariance @ kept.T
            covariance[COILS, COILS] += fresh

    def renew(self, at: slice, covariance: FloatArray, memories: Sequence[FreeMemory] = ()) -> None:
        """Reset the block `at` of slowly varying states (n,) to zero, with a given covariance (n, n).

        The estimate and its copies `memories` are changed. The reset is necessary when the block describes
        another magnetometer, or coils among which the currents are allocated differently.
        """
        self.changes += 1
        estimated = self.layout.prior[at, at].any()
        for constants, whole in self._with(memories):
            constants[at] = whole[at] = whole[:, at] = 0.0
            whole[at, at] = covariance if estimated else 0.0

    def widen(self, at: IntArray, memories: Sequence[FreeMemory] = (), *, drop: bool = False) -> None:
        """Reset the covariance of the states with indices `at` (k,) to the prior of the settings.

        The estimate and its copies `memories` are changed. The reset is necessary if measurements contradict
        the estimated values. Implausible values are set to zero. If `drop` is true, the estimated errors of
        inertia and coils are set to zero as well.
        """
        self.changes += 1
        prior = self.layout.prior[np.ix_(at, at)]
        for constants, covariance in self._with(memories):
            values = constants[at]
            dropped = drop & (at >= INERTIA.start) & (at < COILS.stop)
            constants[at] = np.where(plausible(values, prior.diagonal()) & ~dropped, values, 0.0)
            widen(covariance, at, prior)

    def _with(self, memories: Sequence[FreeMemory]) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Yield constant states and covariance of the present estimate, and then of each of its copies."""
        yield self._constants, self.covariance
        for memory in memories:
            yield memory.constants, memory.covariance

    @property
    def gyro_bias(self) -> FloatArray:
        """Gyro bias (3,) rad/s."""
        return self._constants[GYRO].copy()

    @property
    def torque_sizes(self) -> FloatArray:
        """Estimated components (9,), N m, of the disturbance torques."""
        return self._constants[TORQUES].copy()

    @property
    def inertia(self) -> FloatArray:
        """Inertia tensor (3, 3) kg m^2, body axes."""
        self.motion.correct(self._constants[INERTIA])
        return self.motion.inertia

    @property
    def coil_matrix(self) -> FloatArray:
        """Matrix (3, 3) that converts the commanded dipole of the coils to the estimated dipole."""
        return _EYE + self._matrix(COILS)

    def description(self) -> dict[str, FloatArray]:
        """Return the estimated parameters of body and sensors, with their standard deviations, by name.

        The entry `inertia` (6,), kg m^2, contains the elements xx, yy, zz, yz, zx and xy of the inertia
        tensor. The entries `coils`, `gyro` and `field` (9,) are the matrices of coils, gyro and magnetometer,
        row by row. The entry `camera` (3,), rad, is the rotation vector of the star camera's misalignment.
        The entries `dipole` and `sunlit_dipole` (3,), A m^2, are the residual dipole in shadow and its
        increase in sunlight. The name of each standard deviation ends with `_sigma`. The entry
        `camera_attitude_sigma` (3,), rad, is the standard deviation of the attitude of the star camera, and
        is smaller than that of the body. The standard deviations of inertia and coils relative to the trace
        (`per_trace`) are `inertia_ratio_sigma` and `coils_ratio_sigma`.
        """
        self.motion.correct(self._constants[INERTIA])
        sigma = np.sqrt(self.covariance.diagonal())
        found = {
            "inertia": self.motion.inertia[_ROWS, _COLUMNS],
            "inertia_sigma": self.motion.trace * sigma[INERTIA],
        }
        for name, at in (("coils", COILS), ("gyro", GYRO_MATRIX), ("field", FIELD_MATRIX)):
            found |= {name: _EYE.ravel() + self._constants[at], f"{name}_sigma": sigma[at]}
        for name, at in (
            ("camera", CAMERA),
            ("gyro_bias", GYRO),
            ("field_bias", MAGNET),
            ("dipole", DIPOLE),
            ("sunlit_dipole", SUNLIT),
        ):
            found |= {name: self._constants[at].copy(), f"{name}_sigma": sigma[at]}
        rows = per_trace(found["inertia"] / self.motion.trace, found["coils"])
        variances = (rows @ self.covariance[_BODY, _BODY] @ rows.T).diagonal()
        # A known ratio has zero variance, which rounding can make negative.
        ratios = np.sqrt(np.maximum(variances, 0.0))
        return found | {
            "camera_attitude_sigma": np.sqrt(self.camera_covariance.diagonal()),
            "inertia_ratio_sigma": ratios[:6],
            "coils_ratio_sigma": ratios[6:],
        }

    def residual_dipole(self, sunlit: float) -> FloatArray:
        """Return the residual dipole (3,) A m^2, body axes, for the visible fraction `sunlit` of the Sun."""
        return np.asarray(self._constants[DIPOLE] + sunlit * self._constants[SUNLIT])

    def advance(
        self,
        seconds: float,
        dipole: FloatArray,
        around: FilterEnvironment,
        doubt: float = 0.0,
        uneven: FloatArray | None = None,
    ) -> None:
        """Propagate over the time `seconds`, with the mean commanded dipole (3,), A m^2, in body axes.

        The standard deviation per axis of a dipole that may differ from the command is `doubt`, A m^2. If the
        dipole changes, `uneven` (3,), A m^2 s^2, is the double time integral of its deviation from the mean.
        """
        check_span(seconds, dipole=dipole, field=around.field, doubt=doubt)
        before = self.rate
        steps = max(1, math.ceil(math.sqrt(float(before @ before)) * seconds / LARGEST_ROTATION))
        for _ in range(steps):
            self._step(seconds / steps, dipole, around, doubt)
        if uneven is not None:
            changed, rate = self.coil_matrix @ uneven, 0.5 * (before + self.rate)
            field = attitude_matrix(self.quaternion) @ around.field
            slope = cross_product(rate, field)
            rotation = self.motion.inverse @ cross_product(changed, field + 0.5 * seconds * slope)
            # Field and gyroscopic torque change during the step, so the time of each dipole matters.
            change = self.motion.inverse @ cross_product(changed, slope)
            self.rate = self.rate + change + self.motion.stiffness(rate) @ rotation
            self.quaternion = multiply(from_rotation_vector(rotation), self.quaternion)

    def begin_mean(self) -> None:
        """Begin the interval over which gyro samples are averaged."""
        self._lag, self._given, self._since = np.zeros(3), np.zeros(3), 0.0

    def impulse(self, since: float) -> FloatArray:
        """Return the integral (3,), A m^2 s, of the dipole until now, averaged over its start times.

        The start times cover the averaging interval of the gyro samples, whose middle is `since` s ago.
        """
        if self._since == 0.0:
            return since * self.driven
        return np.asarray(self._given / self._since + (since - 0.5 * self._since) * self.driven)

    def gyro(
        self, rate: FloatArray, covariance: FloatArray, change: FloatArray | None = None, since: float = 0.0
    ) -> bool:
        """Apply a gyro rate (3,), rad/s, with covariance (3, 3), and return whether the rate passed the gate.

        If the gyro rate is an average over an interval whose middle is `since` s ago, `change` (3,), rad/s,
        is the change of the rate since that middle at the acceleration of the last step. The averaged rate is
        corrected for the change of the acceleration since `begin_mean`.
        """
        check_measured(covariance, rate=rate)
        matrix = _EYE + self._matrix(GYRO_MATRIX)
        then = self.rate
        if change is not None:
            then = then - change
            if self._since > 0.0:
                then = then - (self._lag / self._since - 0.5 * self._since * self.acceleration)
        rows = -since * (matrix @ self._slope)
        rows[:, RATE] += matrix
        rows[:, GYRO] += _EYE
        rows[:, GYRO_MATRIX] += by_matrix(then)
        return self._update(rate - matrix @ then - self._constants[GYRO], rows, covariance)

    def mean_rate(
        self, rate: FloatArray, covariance: FloatArray, change: FloatArray, since: float = 0.0
    ) -> bool:
        """Apply a rate (3,) rad/s that the star camera measured, with its covariance (3, 3).

        The change of the rate since the middle of the exposure, `since` s ago, is `change` (3,), rad/s.
        """
        check_measured(covariance, rate=rate, change=change)
        rows = -since * self._slope
        rows[:, RATE] += _EYE
        rows[:, CAMERA] += cross_matrix(self.rate)
        turned = attitude_matrix(from_rotation_vector(self._constants[CAMERA])) @ self.rate
        return self._update(rate + change - turned, rows, covariance)

    def attitude(
        self, quaternion: FloatArray, covariance: FloatArray, age: float = 0.0, *, by_stars: bool = True
    ) -> bool:
        """Apply an attitude (4,) measured `age` s ago.

        If `by_stars` is true, the attitude was measured by the star camera, otherwise by the horizon cameras.
        The covariance (3, 3), rad^2, is given in the present body axes.
        """
        check_measured(covariance, quaternion=quaternion)
        since = from_rotation_vector(age * self.rate - 0.5 * age**2 * self.acceleration)
        rows = np.zeros((3, STATES))
        # The rotation since the measurement is estimated from the rate, and has an error due to the rate.
        rows[:, ATTITUDE], rows[:, RATE] = _EYE, -age * _EYE
        misaligned = CAMERA if by_stars else HORIZON
        rows[:, misaligned] = _EYE
        expected = multiply(from_rotation_vector(self._constants[misaligned]), self.quaternion)
        error = multiply(multiply(since, of_unit_length("quaternion", quaternion)), conjugate(expected))
        return self._update(to_rotation_vector(error), rows, covariance)

    def direction(
        self, observed: FloatArray, reference: FloatArray, covariance: FloatArray, sun_cameras: int = 0
    ) -> bool:
        """Apply an observed direction; the arguments are attributes of `DirectionMeasurement`."""
        check_measured(covariance, observed=observed, reference=reference)
        observed, reference = of_unit_length("observed", observed), of_unit_length("reference", reference)
        if sun_cameras and sun_cameras != self.sun_cameras:
            self.renew(SUN_CAMERA, self.layout.prior[SUN_CAMERA, SUN_CAMERA])
            self.sun_cameras = sun_cameras
        expected = attitude_matrix(self.quaternion) @ reference
        across = tangent_basis(expected)
        rows = np.zeros((2, STATES))
        misaligned = SUN_CAMERA if sun_cameras else HORIZON
        rows[:, ATTITUDE] = rows[:, misaligned] = across @ cross_matrix(expected)
        offset = rows[:, misaligned] @ self._constants[misaligned]
        value = direction_error(observed, expected, across) - offset
        return self._update(value, rows, across @ covariance @ across.T)

    def field(self, measured: FloatArray, reference: FloatArray, covariance: FloatArray) -> bool:
        """Apply a measured magnetic field (3,) T in body axes, with its covariance (3, 3) T^2.

        The field `reference` (3,), T, in ICRS axes is that of the field model.
        """
        check_measured(covariance, measured=measured, reference=reference)
        expected = attitude_matrix(self.quaternion) @ reference
        matrix = _EYE + self._matrix(FIELD_MATRIX)
        rows = np.zeros((3, STATES))
        rows[:, ATTITUDE], rows[:, FIELD_MATRIX] = matrix @ cross_matrix(expected), by_matrix(expected)
        rows[:, MAGNET] = rows[:, FIELD] = _EYE
        bias = self._constants[MAGNET] + self._constants[FIELD]
        return self._update(measured - matrix @ expected - bias, rows, covariance + CURRENTS**2 * _EYE)

    def _matrix(self, at: slice) -> FloatArray:
        return self._constants[at].reshape(3, 3)

    def _reset_field(self) -> None:
        """Set the estimated error of the field model to zero, and keep its standard deviation."""
        self._constants[FIELD] = 0.0
        self.covariance[FIELD] = self.covariance[:, FIELD] = 0.0
        self.covariance[FIELD, FIELD] = self.field_error**2 * _EYE

    def _propagate_field_error(self, dt: float, least: float) -> None:
        """Let the field model's error decay, and estimate its standard deviation while the attitude is FINE.

        The estimated standard deviation is at least `least` (T per axis).
        """
        covariance, error = self.covariance, self._constants[FIELD]
        if self.worst_sigma <= FINE:
            square = (float(error @ error) + float(covariance[FIELD, FIELD].trace())) / 3.0
            variance = self.field_error**2 + dt / FIELD_LEARNED * (square - self.field_error**2)
            self.field_error = max(math.sqrt(variance), MINIMUM_FIELD_ERROR)
        self._decay(FIELD, dt / FIELD_MEMORY, max(self.field_error, least) ** 2 * _EYE)

    def _decay(self, at: slice, part: float, prior: FloatArray) -> None:
        """Propagate a Gauss-Markov process of stationary covariance `prior` for `part` correlation times."""
        kept = math.exp(-part)
        self._constants[at] *= kept
        self.covariance[at] *= kept
        self.covariance[:, at] *= kept
        self.covariance[at, at] += (1.0 - kept**2) * prior

    def _step(self, dt: float, driven: FloatArray, around: FilterEnvironment, doubt: float) -> None:
        """Propagate state and covariance by one step of the classical Runge-Kutta method.

        The error of the midpoint rule would be equivalent to a relative inertia error of 4e-4.
        """
        self.changes += 1
        motion, rate = self.motion, self.rate
        motion.correct(self._constants[INERTIA])
        whole = self.coil_matrix @ driven + self._constants[VARIATION] * driven
        whole += self.residual_dipole(around.sunlit)
        moved = step(
            motion.body,
            self.quaternion,
            rate,
            (driven, whole),
            self._constants[TORQUES],
            (around.field, around.position, around.pressures.air, around.pressures.light),
            around.sunlit,
            dt,
        )
        flow = np.zeros((6, STATES))
        flow[0:3, ATTITUDE], flow[0:3, RATE] = -cross_matrix(moved.middle), _EYE
        flow[3:6, _MOVING] = moved.slopes
        self._slope = flow[3:6].copy()
        self._lag = self._lag + self._since * (moved.rate - rate) + dt * moved.rate - moved.swept
        self._given = self._given + dt * (self._since + 0.5 * dt) * driven
        self._since += dt
        self.quaternion, self.rate = moved.quaternion, moved.rate
        self.acceleration, self.driven = moved.acceleration, driven
        noise = self.rate_noise(driven, around, doubt) + self._curvature(flow[3:6, INERTIA])
        self.covariance = propagated(self.covariance, flow, dt, noise, self.layout.walks)
        self.covariance[TORQUES, TORQUES] += dt * density_walk(self._constants[TORQUES])
        if self.layout.prior[INERTIA, INERTIA].any():
            flexed = INERTIA_WALK**2 * float(rate @ rate)
            self.covariance.reshape(-1)[_INERTIA_DIAGONAL] += dt * flexed
        self._propagate_field_error(dt, around.field_sigma)
        self._decay(HORIZON, dt / HORIZON_MEMORY, self.layout.prior[HORIZON, HORIZON])
        self._decay(VARIATION, dt / COIL_MEMORY, self.layout.prior[VARIATION, VARIATION])

    def _curvature(self, by_inertia: FloatArray) -> FloatArray:
        """Return the density (3, 3), rad^2/s^3, of the noise that is quadratic in the error of the inertia.

        The derivative of the acceleration with respect to the error is `by_inertia` (3, 6). Without this
        noise, which represents neglected second-order terms, the uncertainty of an unknown inertia would
        become too small in the first seconds of a fast tumble.
        """
        spread = self.covariance[INERTIA, INERTIA]
        relative = _inertia_variance(spread, self.motion)
        return np.asarray(2.0 * CURVATURE * relative * (by_inertia @ spread @ by_inertia.T))

    def rate_noise(
        self,
        dipole: FloatArray,
        around: FilterEnvironment,
        doubt: float = 0.0,
        then: FreeMemory | None = None,
        motion: FreeMotion | None = None,
    ) -> FloatArray:
        """Return the noise density (3, 3) of the angular acceleration, rad^2/s^3.

        The noise density depends on the coils' dipole (3,) A m^2, on the error of the field model, and on the
        standard deviation `doubt` (A m^2) of an uncertain dipole. Errors of the dipole cause no torque along
        the field, but the error of the field model causes a torque along the field. The angular acceleration
        due to an uncertain dipole also has errors parallel to the field, because the field's direction and
        the inertia are not known exactly. The noise density is computed for the estimate `then` and the
        equation of motion `motion`, by default for the present estimate and equation.
        """
        motion, square = motion or self.motion, float(dipole @ dipole)
        at = then or self
        coils = LASTING * doubt**2 + (self._settings.coil_noise**2 if square else 0.0)
        density = TORQUE_NOISE**2 * motion.by_torque
        error = max(at.field_error, around.field_sigma)
        if coils:
            field = attitude_matrix(at.quaternion) @ around.field
            across = motion.inverse @ cross_matrix(field) @ self.coil_matrix
            density = density + coils * (across @ across.T)
            if doubt:
                relative = _inertia_variance(at.covariance[INERTIA, INERTIA], motion)
                relative += error**2 / float(field @ field)
                mean_square = 0.5 * float(np.sum(across**2))
                density = density + LASTING * doubt**2 * relative * mean_square * _EYE
        if square:
            across = motion.inverse @ cross_matrix(dipole)
            # While the body rotates, the two components of the field error normal to the rate average out.
            rotated = 1.0 + 0.25 * LASTING**2 * float(at.rate @ at.rate)
            density = density + LASTING * (1.0 + 2.0 / rotated) / 3.0 * error**2 * (across @ across.T)
        return np.asarray(density)

    def _update(self, value: FloatArray, rows: FloatArray, noise: FloatArray) -> bool:
        """Apply an innovation (k,), and return whether it passed the gate.

        The innovation has the Jacobian `rows` (k, STATES) and the noise covariance `noise` (k, k).
        """
        square, gain, cross, spread = weigh(self.covariance, value, rows, noise)
        self.newest_square = square
        if not 0.0 <= square <= self._gates[len(value)]:  # a NaN does not pass
            self.refused += 1
            return False
        self.changes += 1
        gain = self.layout.estimated(gain)
        self.covariance = updated(self.covariance, gain, cross, spread)
        error = gain @ value
        keep_scale(self.covariance, INERTIA, self.motion.elements + self._constants[INERTIA], error * _SCALED)
        reset(self.covariance, ATTITUDE, error[ATTITUDE].tolist())
        self.quaternion = multiply(from_rotation_vector(error[ATTITUDE]), self.quaternion)
        self.rate = self.rate + error[RATE]
        self._constants[6:] += error[6:]
        return True


BODY: IntArray = np.r_[DIPOLE, SUNLIT, TORQUES, INERTIA]
BODY_NAMES, ALL_NAMES = "inertia, dipole and torques", "coils, inertia, dipole and torques"
LEARNED = {BODY_NAMES: BODY, ALL_NAMES: np.r_[BODY, COILS]}
"""Indices of the estimated states that the motion can contradict: without coil currents the states of the
body (`BODY_NAMES`), with coil currents also the states of the coils (`ALL_NAMES`)."""
# Inertia, dipoles and torques have a common scale: doubling all these states does not change the motion.
_SCALED: FloatArray = np.zeros(STATES)
_SCALED[LEARNED[ALL_NAMES]] = 1.0
_CAMERA_ROWS: FloatArray = np.zeros((3, STATES))
_CAMERA_ROWS[:, ATTITUDE] = _CAMERA_ROWS[:, CAMERA] = _EYE


def _inertia_variance(spread: FloatArray, motion: FreeMotion) -> float:
    """Return the largest relative variance of a moment of inertia from the covariance (6, 6)."""
    relative = spread.diagonal()[:3] * (motion.trace / motion.inertia.diagonal()) ** 2
    return float(relative.max())


def density_walk(sizes: FloatArray) -> FloatArray:
    """Return the increase (9, 9) per second of the covariance of the disturbance components `sizes` (9,).

    The random walk is a fraction of the air density, so its effect is proportional to the aerodynamic torque.
    """
    walk = np.zeros((SIZES, SIZES))
    walk[AIR, AIR] = AIR_WALK**2 * np.outer(sizes[AIR], sizes[AIR])
    return walk
