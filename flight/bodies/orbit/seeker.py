"""SAFE's way to the Sun: solar strings, gyro and measured field, without orbit, attitude or clock."""

from __future__ import annotations

import numpy as np

from flight.bodies.orbit.field_doubt import FieldDoubt
from flight.link import events
from flight.loop.control_output import CoilCommand
from flight.loop.fdir.event_log import EventLog
from hal.interfaces.readings import StringReading
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.control.three_axes.sun_acquisition import SunAcquisition
from knightcube.vision.sun.strings import SolarStrings, coarse_sun


class StringSeeker:
    """Commands the seeker's dipole and says whether it has a Sun; implements `flight.loop.body.Brake`."""

    def __init__(
        self, seeker: SunAcquisition, strings: SolarStrings, dipole_per_ampere: float, log: EventLog
    ) -> None:
        """Take n A of each coil, m^2."""
        self._seeker, self._strings = seeker, strings
        self._dipole_per_ampere = dipole_per_ampere
        self._doubt = FieldDoubt()
        self._events = log
        self._found: bool | None = None
        self._reason = "the strings give no readings"

    def begin(self, now_ns: int) -> None:
        """Begin with no knowledge of the field."""
        self._seeker.begin(now_ns)

    def see(self, reading: StringReading) -> None:
        """Accept a reading of the strings, whatever the mode."""
        found = coarse_sun(reading.currents, self._strings)
        self._reason = found.reason
        if found.direction is not None:
            self._seeker.see(reading.time_ns, found.direction)

    def sample(self, time_ns: int, field: FloatArray, rate: FloatArray) -> None:
        """Accept a field (3,) T and the gyro's rate (3,) rad/s measured at `time_ns`; none that is stuck."""
        if self._doubt.sees(field):
            self._seeker.sample(time_ns, field, rate)

    def command(self, now_ns: int) -> CoilCommand:
        """Return the command now; without a Sun it only holds the body still, by a stuck field nothing."""
        found = self._seeker.sun is not None
        if found is not self._found:
            self._found = found
            if found:
                self._events.report(events.SUN_FOUND, now_ns, "by the solar strings")
            else:
                self._events.report(events.SUN_MISSED, now_ns, self._reason)
        dipole = self._seeker.dipole(now_ns)
        if self._doubt.stuck:
            dipole = np.zeros(3)
            self._seeker.acts(dipole)
        return CoilCommand(dipole, dipole / self._dipole_per_ampere)

    def sent(self, currents: FloatArray) -> None:
        """Take what went to the coils (3,) A."""
        self._seeker.acts(currents * self._dipole_per_ampere)

    def field(self, now_ns: int) -> FloatArray | None:
        """Return the field (3,) T in body axes at the last reading; None before it is known."""
        return self._seeker.field
