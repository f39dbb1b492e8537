"""The feed of a satellite in orbit: in free fall the inertial unit's own attitude has no meaning."""

from __future__ import annotations

from flight.loop.body import Agreement
from hal.interfaces.readings import ImuReading


class MagnetometerFeed:
    """Implements `flight.loop.body.Feed`: the unit gives no attitude; the brake takes the field itself."""

    def accept(self, reading: ImuReading) -> Agreement:
        """Leave the filter as it is."""
        return Agreement(True)
