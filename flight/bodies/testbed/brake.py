"""The testbed's brake: B-dot on the magnetometer."""

from __future__ import annotations

from flight.loop.control_output import CoilCommand
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.control.detumble import Detumbler


class BdotBrake:
    """Commands the detumbler's currents; implements `flight.loop.body.Brake`."""

    def __init__(self, detumbler: Detumbler, dipole_per_ampere: float) -> None:
        """Take n A of each coil, m^2."""
        self._detumbler = detumbler
        self._dipole_per_ampere = dipole_per_ampere

    def begin(self, now_ns: int) -> None:
        """Begin with no knowledge of the field."""
        self._detumbler.begin(now_ns)

    def sample(self, time_ns: int, field: FloatArray, rate: FloatArray) -> None:
        """Accept a field (3,) T measured at `time_ns`; the law needs no rate of the gyro."""
        self._detumbler.sample(time_ns, field)

    def command(self, now_ns: int) -> CoilCommand:
        """Return the command now."""
        currents = self._detumbler.current(now_ns)
        return CoilCommand(currents * self._dipole_per_ampere, currents)

    def sent(self, currents: FloatArray) -> None:
        """Do nothing: B-dot needs no model of the motion."""

    def field(self, now_ns: int) -> FloatArray | None:
        """Return the field (3,) T in body axes now; None before it is known."""
        return self._detumbler.field(now_ns)
