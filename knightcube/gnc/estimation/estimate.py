"""Measurements, state, prior and estimate of the attitude filter.

A measurement has a `latency` if it comes from an inertial unit whose samples are older than their time stamps
and if the filter estimates the age of the samples. The latency is the assumed age (s) that was subtracted
from the time stamp to give `time_ns`. The latency is None if the exact time of the sample is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

import numpy as np

from knightcube.astro.arrays import FloatArray, check_finite, float_rows
from knightcube.astro.quaternion import Quaternion, Vector
from knightcube.errors import ArgumentError
from knightcube.gnc.estimation.error_state import slices


def _check_arrays(measurement: Measurement, **shapes: tuple[int, ...]) -> None:
    """Convert the attributes named in `shapes` to arrays of floats. Raises ArgumentError for other shapes.

    Values that are not finite are permitted, because the filter rejects them.
    """
    for name, shape in shapes.items():
        value = getattr(measurement, name)
        if not isinstance(value, np.ndarray) or value.dtype != float:
            value = float_rows(name, value, shape[-1])
            object.__setattr__(measurement, name, value)
        _check_shape(name, value, shape)


def _check_shape(name: str, value: FloatArray, shape: tuple[int, ...]) -> None:
    if np.shape(value) != shape:
        raise ArgumentError(name, f"an array of shape {np.shape(value)}: give numbers of shape {shape}")


_LENGTH = 0.1
"""Largest accepted difference between one and the length of a measured quaternion or direction."""


_ROUNDING = 1e-6
"""Largest difference between one and the length of a measurement that is not normalised. A quaternion of
numbers with single precision has errors of 1e-7."""


def of_unit_length(name: str, value: FloatArray) -> FloatArray:
    """Return a measured quaternion or direction with length one. NaN is permitted, as in `_check_arrays`.

    Raises ArgumentError for a length that differs from one by more than a tenth.
    """
    length = math.hypot(*value.tolist())
    error = abs(length - 1.0)
    if error > _LENGTH:
        kind = "quaternion" if len(value) == 4 else "vector"
        raise ArgumentError(name, f"{value.tolist()}: length {length:g}: give a {kind} of length 1")
    return np.asarray(value / length) if error > _ROUNDING else value


def check_measured(covariance: FloatArray, *, finite: bool = False, **measured: FloatArray) -> None:
    """Raise ArgumentError unless the covariance is (3, 3), and the arrays `measured` are vectors (3,).

    An array called `quaternion` must be (4,). Values that are not finite are permitted unless `finite` is
    true.
    """
    if finite:
        check_finite(covariance=covariance, **measured)
    _check_shape("covariance", covariance, (3, 3))
    for name, value in measured.items():
        _check_shape(name, value, (4,) if name == "quaternion" else (3,))


def check_span(seconds: float, **given: FloatArray | float) -> None:
    """Raise ArgumentError unless a propagation time (s) is finite and not negative, and `given` is finite."""
    if not 0.0 <= seconds < math.inf:
        raise ArgumentError("seconds", f"{seconds}: give a finite time of 0 s or more")
    check_finite(**given)


class _AtOneTime:
    """A measurement that depends on the state at one time only, `time_ns`."""

    __slots__ = ()
    time_ns: int

    @property
    def begin_ns(self) -> int:
        """Earliest time (ns) on which the measurement depends."""
        return self.time_ns


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeMeasurement(_AtOneTime):
    """A measured attitude (4,), reference to body axes, with covariance (3, 3), rad^2, in body axes.

    The flag `by_stars` marks an attitude of the star camera. The covariance excludes the misalignment of the
    camera.
    """

    time_ns: int
    quaternion: FloatArray
    covariance: FloatArray
    latency: float | None = None
    by_stars: bool = False

    def __post_init__(self) -> None:
        """Raise ArgumentError for arrays of another shape, and for a quaternion whose length is not one."""
        _check_arrays(self, quaternion=(4,), covariance=(3, 3))
        object.__setattr__(self, "quaternion", of_unit_length("quaternion", self.quaternion))


@dataclass(frozen=True, slots=True, eq=False)
class RateMeasurement(_AtOneTime):
    """A body rate (3,), rad/s, measured by a gyro and including the gyro bias, with covariance (3, 3).

    The filter estimates the bias, so the covariance is that of the gyro's white noise only.
    """

    time_ns: int
    rate: FloatArray
    covariance: FloatArray
    latency: float | None = None

    def __post_init__(self) -> None:
        """Raise ArgumentError for arrays of another shape."""
        _check_arrays(self, rate=(3,), covariance=(3, 3))


@dataclass(frozen=True, slots=True, eq=False)
class MeanRateMeasurement:
    """The mean body rate (3,) rad/s during an exposure, measured without the gyro, and its covariance (3, 3).

    The mean rate is the constant rate that rotates the attitude at `since_ns` into the attitude at `time_ns`.
    """

    since_ns: int
    time_ns: int
    rate: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        """Raise ArgumentError for arrays of another shape, and for an exposure without duration."""
        _check_arrays(self, rate=(3,), covariance=(3, 3))
        if not self.since_ns < self.time_ns:
            raise ArgumentError(
                "since_ns", f"{self.since_ns}: the exposure must begin before its end at {self.time_ns} ns"
            )

    @property
    def begin_ns(self) -> int:
        """Start of the exposure, ns."""
        return self.since_ns


@dataclass(frozen=True, slots=True, eq=False)
class DirectionMeasurement(_AtOneTime):
    """A direction observed from the body, such as the direction of the Sun or nadir.

    `observed` (3,) in body axes and `reference` (3,) in reference axes are unit vectors. The `covariance` (3,
    3), rad^2, is that of `observed`; its component along the direction is ignored. If horizon cameras
    observed the Sun, `sun_cameras` is their bit mask, otherwise 0.
    """

    time_ns: int
    observed: FloatArray
    reference: FloatArray
    covariance: FloatArray
    sun_cameras: int = 0

    def __post_init__(self) -> None:
        """Raise ArgumentError for arrays of another shape, and for vectors whose length is not one."""
        _check_arrays(self, observed=(3,), reference=(3,), covariance=(3, 3))
        for name in ("observed", "reference"):
            object.__setattr__(self, name, of_unit_length(name, getattr(self, name)))


@dataclass(frozen=True, slots=True, eq=False)
class FieldMeasurement(_AtOneTime):
    """A magnetic field (3,), T, measured in body axes and including the magnetometer's bias.

    The field model gives the field `reference` (3,), T, in reference axes. The white noise of the measurement
    has the covariance `covariance` (3, 3), T^2, in body axes. The filter estimates the bias.
    """

    time_ns: int
    field: FloatArray
    reference: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        """Raise ArgumentError for arrays of another shape."""
        _check_arrays(self, field=(3,), reference=(3,), covariance=(3, 3))


Measurement = (
    AttitudeMeasurement | RateMeasurement | MeanRateMeasurement | DirectionMeasurement | FieldMeasurement
)

BLOCKS = {
    "attitude": 3,
    "rate": 3,
    "gyro_bias": 3,
    "disturbance": 3,
    "parameters": 3,
    "latency": 1,
    "field_bias": 3,
}
"""Number of elements of each block of the error state, in order."""
ATTITUDE, RATE, BIAS, DISTURBANCE, PARAMETERS, _AGE, FIELD_BIAS = slices(BLOCKS)
"""Indices of the blocks of the error state in the covariance (19, 19)."""
LATENCY = _AGE.start
"""Index, in the error state, of the age of the inertial unit's samples."""
SIZE = FIELD_BIAS.stop
"""Number of elements of the error state."""


class Parameters(NamedTuple):
    """Uncertain parameters of the body's model, which the filter may estimate.

    Attributes:
        torsion: stiffness k of the thread divided by the moment of inertia J22, 1/s^2.
        damping: damping constant c of the thread divided by the moment of inertia J22, 1/s.
        gain: ratio of the true to the modelled angular acceleration by the coils.
    """

    torsion: float = 0.0
    damping: float = 0.0
    gain: float = 1.0


NOMINAL = Parameters()


class Knowledge(Enum):
    """Accuracy class of the attitude estimate."""

    FINE = "fine"
    COARSE = "coarse"
    LOST = "lost"


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The estimate of the attitude filter at the time `time_ns`.

    Attributes:
        quaternion: attitude (4,), from reference axes into body axes.
        rate: body rate (3,) in body axes, rad/s.
        bias: gyro bias (3,) in body axes, rad/s.
        disturbance: unmodelled angular acceleration (3,), rad/s^2.
        parameters: estimated torsion and damping of the thread, and gain of the coils.
        covariance: covariance (19, 19) of the error state, in the order of `BLOCKS`: the first six elements
            are attitude error and rate error. The attitude error is a rotation in body axes.
        measured_ns: time of the newest accepted measurement, ns.
        latency: age of the inertial unit's samples (delay between measurement and time stamp), s.
        field_bias: magnetometer bias (3,) in body axes, T.
    """

    time_ns: int
    quaternion: FloatArray
    rate: FloatArray
    bias: FloatArray
    disturbance: FloatArray
    parameters: Parameters
    covariance: FloatArray
    measured_ns: int
    latency: float = 0.0
    field_bias: FloatArray = field(default_factory=np.zeros(3).copy)


class FilterState(NamedTuple):
    """The state of the filter at one time, as tuples of floats.

    Attributes:
        kept: attitude at the start of each unfinished exposure, with the mean rate measured in that exposure.
        latency: age of the inertial unit's samples (delay between measurement and time stamp), s.
        field_bias: magnetometer bias in body axes, T.
    """

    quaternion: Quaternion
    rate: Vector
    bias: Vector
    disturbance: Vector
    parameters: Parameters
    kept: tuple[tuple[MeanRateMeasurement, Quaternion], ...] = ()
    latency: float = 0.0
    field_bias: Vector = (0.0, 0.0, 0.0)

    def kept_index(self, measurement: MeanRateMeasurement) -> int:
        """Return the index, in `kept`, of the attitude at the start of an exposure."""
        return next(index for index, (owner, _) in enumerate(self.kept) if owner is measurement)


@dataclass(frozen=True, slots=True, eq=False)
class SlowPrior:
    """Prior of constant and slowly changing states; a state with a prior variance of zero is not estimated.

    Attributes:
        bias: gyro bias (3,), rad/s, with the covariance `bias_covariance` (3, 3).
        parameters: parameters of the body's model, with the covariance `parameters_covariance` (3, 3).
        latency: age of the inertial unit's samples (delay between measurement and time stamp), s.
    """

    bias: FloatArray = field(default_factory=np.zeros(3).copy)
    bias_covariance: FloatArray = field(default_factory=np.zeros((3, 3)).copy)
    parameters: Parameters = NOMINAL
    parameters_covariance: FloatArray = field(default_factory=np.zeros((3, 3)).copy)
    latency: float = 0.0
    latency_variance: float = 0.0
