"""Measurements of the attitude filter: attitudes, gyro rates, mean rates, directions and fields.

`latency` belongs to a unit whose samples are older than their time stamps by an age that the filter
estimates. It is the time (s) that was subtracted from the stamp to give `time_ns`. None marks a known time.
"""

from __future__ import annotations

from dataclasses import dataclass

from knightcube.astro.arrays import FloatArray


class _AtOneTime:
    """A measurement of the state at the single time `time_ns`."""

    __slots__ = ()
    time_ns: int

    @property
    def begin_ns(self) -> int:
        """The first time that the measurement depends on."""
        return self.time_ns


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeMeasurement(_AtOneTime):
    """An attitude: quaternion (4,) reference into body, covariance (3, 3) rad^2 of small rotations, body."""

    time_ns: int
    quaternion: FloatArray
    covariance: FloatArray
    latency: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RateMeasurement(_AtOneTime):
    """A gyro's body rate (3,) rad/s, bias included, and its covariance (3, 3)."""

    time_ns: int
    rate: FloatArray
    covariance: FloatArray
    latency: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MeanRateMeasurement:
    """The mean body rate (3,) rad/s of an exposure, free of the gyro's bias, and its covariance (3, 3).

    It is the constant rate that takes the attitude at `since_ns` to that at `time_ns`.
    """

    since_ns: int
    time_ns: int
    rate: FloatArray
    covariance: FloatArray

    @property
    def begin_ns(self) -> int:
        """The start of the exposure."""
        return self.since_ns


@dataclass(frozen=True, slots=True, eq=False)
class DirectionMeasurement(_AtOneTime):
    """A direction observed from the body, such as of the Sun or nadir.

    `observed` (3,) in body axes and `reference` (3,) in reference axes are unit vectors. `covariance` (3, 3)
    rad^2 is that of `observed` in body axes; its part along the direction has no effect.
    """

    time_ns: int
    observed: FloatArray
    reference: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FieldMeasurement(_AtOneTime):
    """A magnetometer's `field` (3,) T in body axes, bias included, and the model's `reference` (3,) T.

    `covariance` (3, 3) T^2, body axes, is that of the white noise; the filter estimates the constant part.
    """

    time_ns: int
    field: FloatArray
    reference: FloatArray
    covariance: FloatArray


Measurement = (
    AttitudeMeasurement | RateMeasurement | MeanRateMeasurement | DirectionMeasurement | FieldMeasurement
)
