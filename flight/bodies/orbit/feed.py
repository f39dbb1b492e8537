"""The feed of a satellite in orbit: in free fall the inertial unit's own attitude has no meaning."""

from __future__ import annotations

from flight.bodies.orbit.filter import OrbitFilter
from flight.loop.body import Agreement
from hal.interfaces.readings import ImuReading
from knightcube.gnc.estimation.measurements import AttitudeMeasurement


class OrbitFeed:
    """Implements `flight.loop.body.Feed`: gyro and magnetometer of a reading; the stars give the attitude."""

    def __init__(self, filter_: OrbitFilter) -> None:
        self._filter = filter_

    def accept(self, reading: ImuReading) -> Agreement:
        """Gather rate and field for the filter's next step."""
        return Agreement(self._filter.accept(reading))

    def begin(self, attitude: AttitudeMeasurement) -> bool:
        """Start the filter from an attitude of the stars; return whether it did."""
        return self._filter.begin(attitude)
