"""What the filter takes in: attitudes, rates of the gyro, mean rates, directions, fields; each with its time.

`latency` is for a unit whose samples are older than their stamp says, by how much the filter is estimating:
the s that have been taken off the stamp to make `time_ns`. None: the time is known.
"""

from __future__ import annotations

from dataclasses import dataclass

from flight.gnc.math.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeMeasurement:
    """An attitude: quaternion (4,) reference into body, covariance (3, 3) rad^2 of small turns, body axes."""

    time_ns: int
    quaternion: FloatArray
    covariance: FloatArray
    latency: float | None = None

    @property
    def begin_ns(self) -> int:
        """The first time it says something about."""
        return self.time_ns


@dataclass(frozen=True, slots=True, eq=False)
class RateMeasurement:
    """A gyro's body rate (3,) rad/s, bias included, and its covariance (3, 3)."""

    time_ns: int
    rate: FloatArray
    covariance: FloatArray
    latency: float | None = None

    @property
    def begin_ns(self) -> int:
        """The first time it says something about."""
        return self.time_ns


@dataclass(frozen=True, slots=True, eq=False)
class MeanRateMeasurement:
    """The mean body rate (3,) rad/s of an exposure, free of the gyro's bias, and its covariance (3, 3).

    It is the one constant rate that turns the attitude at `since_ns` into that at `time_ns`.
    """

    since_ns: int
    time_ns: int
    rate: FloatArray
    covariance: FloatArray

    @property
    def begin_ns(self) -> int:
        """The first time it says something about."""
        return self.since_ns


@dataclass(frozen=True, slots=True, eq=False)
class DirectionMeasurement:
    """A direction seen from the body: of the Sun, of nadir.

    `observed` (3,) in body axes and `reference` (3,) in reference axes are unit vectors; `covariance` (3, 3)
    rad^2 is of the observed in body axes, and what it holds along the direction does not count.
    """

    time_ns: int
    observed: FloatArray
    reference: FloatArray
    covariance: FloatArray

    @property
    def begin_ns(self) -> int:
        """The first time it says something about."""
        return self.time_ns


@dataclass(frozen=True, slots=True, eq=False)
class FieldMeasurement:
    """A magnetometer's `field` (3,) T in body axes, bias included, where a model has `reference` (3,) T.

    `covariance` (3, 3) T^2, body axes, is of noise that is new each time; what stays is the filter's to find.
    """

    time_ns: int
    field: FloatArray
    reference: FloatArray
    covariance: FloatArray

    @property
    def begin_ns(self) -> int:
        """The first time it says something about."""
        return self.time_ns


Measurement = (
    AttitudeMeasurement | RateMeasurement | MeanRateMeasurement | DirectionMeasurement | FieldMeasurement
)
