"""Measurements of the attitude filter: attitudes, gyro rates, mean rates, directions and fields.

A measurement has a `latency` if it comes from an inertial unit whose samples are older than their time stamps
and if the filter estimates the age of the samples. The latency is the assumed age (s) that was subtracted
from the time stamp to give `time_ns`. The latency is None if the time of the sample is known.
"""

from __future__ import annotations

from dataclasses import dataclass

from knightcube.astro.arrays import FloatArray


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

    The flag `by_stars` is true for an attitude of the star camera, whose misalignment is not included in the
    covariance.
    """

    time_ns: int
    quaternion: FloatArray
    covariance: FloatArray
    latency: float | None = None
    by_stars: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class RateMeasurement(_AtOneTime):
    """A body rate (3,), rad/s, measured by a gyro and including the gyro bias, with covariance (3, 3)."""

    time_ns: int
    rate: FloatArray
    covariance: FloatArray
    latency: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MeanRateMeasurement:
    """The mean body rate (3,) rad/s during an exposure, measured without the gyro, and its covariance (3, 3).

    The mean rate is the constant rate that rotates the attitude at `since_ns` into the attitude at `time_ns`.
    """

    since_ns: int
    time_ns: int
    rate: FloatArray
    covariance: FloatArray

    @property
    def begin_ns(self) -> int:
        """Start of the exposure, ns."""
        return self.since_ns


@dataclass(frozen=True, slots=True, eq=False)
class DirectionMeasurement(_AtOneTime):
    """A direction observed from the body, such as the direction of the Sun or nadir.

    `observed` (3,) in body axes and `reference` (3,) in reference axes are unit vectors. The matrix
    `covariance` (3, 3), rad^2, is the covariance of `observed` in body axes; its component along the
    direction has no effect.
    """

    time_ns: int
    observed: FloatArray
    reference: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FieldMeasurement(_AtOneTime):
    """A magnetic field (3,) T measured in body axes, which contains the magnetometer's bias.

    The field model gives the field `reference` (3,), T, in reference axes. The white noise of the measurement
    has the covariance `covariance` (3, 3), T^2, in body axes. The filter estimates the bias.
    """

    time_ns: int
    field: FloatArray
    reference: FloatArray
    covariance: FloatArray


Measurement = (
    AttitudeMeasurement | RateMeasurement | MeanRateMeasurement | DirectionMeasurement | FieldMeasurement
)
