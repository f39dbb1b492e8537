"""The brake of a satellite in orbit: the momentum plan in the measured field."""

from __future__ import annotations

from flight.gnc.control.three_axes.field_detumbler import FieldDetumbler
from flight.gnc.math.arrays import FloatArray
from flight.loop.control_output import CoilCommand


class FieldBrake:
    """Commands the detumbler's dipole; implements `flight.loop.body.Brake`."""

    def __init__(self, detumbler: FieldDetumbler, dipole_per_ampere: float) -> None:
        """Take n A of each coil, m^2."""
        self.detumbler = detumbler
        self._dipole_per_ampere = dipole_per_ampere

    def begin(self, now_ns: int) -> None:
        """Begin with no knowledge of the field."""
        self.detumbler.begin(now_ns)

    def sample(self, time_ns: int, field: FloatArray) -> None:
        """Accept a field (3,) T measured at `time_ns`."""
        self.detumbler.sample(time_ns, field)

    def command(self, now_ns: int) -> CoilCommand:
        """Return the command now."""
        dipole = self.detumbler.dipole(now_ns)
        return CoilCommand(dipole, dipole / self._dipole_per_ampere)

    def sent(self, currents: FloatArray) -> None:
        """Let the rate follow the currents (3,) A that flow: a coil that is left out turns nothing."""
        self.detumbler.acts(currents * self._dipole_per_ampere)

    def field(self, now_ns: int) -> FloatArray | None:
        """Return the field (3,) T in body axes at the last command; None before it is known."""
        return self.detumbler.field
