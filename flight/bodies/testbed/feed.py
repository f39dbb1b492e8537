"""The testbed's feed: attitude and rate of the inertial unit, whose own filter knows the vertical."""

from __future__ import annotations

import numpy as np

from flight.loop.body import Agreement
from flight.schema.devices import InertialUnit
from hal.interfaces.readings import ImuReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import angle_about_axis_y
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter
from knightcube.gnc.estimation.measurements import AttitudeMeasurement, RateMeasurement


class UnitFeed:
    """Implements `flight.loop.body.Feed`: starts the filter from attitude and rate, and applies both."""

    def __init__(self, filter_: AttitudeFilter, unit: InertialUnit) -> None:
        self._filter = filter_
        self._angle_covariance: FloatArray = np.eye(3) * unit.angle_noise**2
        self._rate_covariance: FloatArray = np.eye(3) * unit.rate_noise**2

    def accept(self, reading: ImuReading) -> Agreement:
        """Start the filter from a reading, or apply its attitude and its rate."""
        latency = self._filter.latency
        time_ns = reading.time_ns - round(latency * SECOND_NS)
        attitude = AttitudeMeasurement(time_ns, reading.quaternion, self._angle_covariance, latency)
        rate = RateMeasurement(time_ns, reading.rate, self._rate_covariance, latency)
        if not self._filter.started:
            self._filter.start(attitude, rate)
            return Agreement(True)
        # Gated separately: a correct gyro keeps the rate while the attitude is rejected.
        turned = self._filter.measure(attitude)
        moved = self._filter.started and self._filter.measure(rate)
        if turned and moved:
            return Agreement(True)
        angle = angle_about_axis_y(reading.quaternion)
        return Agreement(turned or moved, f"angle {angle:.4f} rad, rate {reading.rate[1]:.5f} rad/s")

    def begin(self, attitude: AttitudeMeasurement) -> bool:
        """Return False: the unit's own attitude starts the filter."""
        return False
