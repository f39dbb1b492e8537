"""The brake of a satellite in orbit: the momentum plan in the measured field, or in that expected ahead."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flight.bodies.orbit.field_doubt import FieldDoubt
from flight.bodies.orbit.filter import OrbitFilter
from flight.bodies.orbit.surroundings import Surroundings
from flight.loop.control_output import CoilCommand
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.field_ahead import FieldAhead
from knightcube.astro.quaternion import attitude_matrix
from knightcube.gnc.control.three_axes.field_detumbler import FieldDetumbler


class FieldBrake:
    """Commands the detumbler's dipole; implements `flight.loop.body.Brake`."""

    def __init__(self, detumbler: FieldDetumbler, dipole_per_ampere: float) -> None:
        """Take n A of each coil, m^2."""
        self.detumbler = detumbler
        self._dipole_per_ampere = dipole_per_ampere
        self._doubt = FieldDoubt()

    def begin(self, now_ns: int) -> None:
        """Begin with no knowledge of the field."""
        self.detumbler.begin(now_ns)

    def sample(self, time_ns: int, field: FloatArray, rate: FloatArray) -> None:
        """Accept a field (3,) T and the gyro's rate (3,) rad/s measured at `time_ns`; none that is stuck."""
        if self._doubt.sees(field):
            self.detumbler.sample(time_ns, field, rate)

    def command(self, now_ns: int) -> CoilCommand:
        """Return the command now: zero where the magnetometer is stuck."""
        dipole = self.detumbler.dipole(now_ns)
        if self._doubt.stuck:
            dipole = np.zeros(3)
            self.detumbler.acts(dipole)
        return CoilCommand(dipole, dipole / self._dipole_per_ampere)

    def sent(self, currents: FloatArray) -> None:
        """Let the rate follow the currents (3,) A that flow: a coil that is left out turns nothing."""
        self.detumbler.acts(currents * self._dipole_per_ampere)

    def field(self, now_ns: int) -> FloatArray | None:
        """Return the field (3,) T in body axes at the last command; None before it is known."""
        return self.detumbler.field


def expected_field(
    filter_: OrbitFilter, surroundings: Surroundings, instants: FloatArray
) -> Callable[[int], FloatArray | None]:
    """Return what gives the field (n, 3) T at `instants` (n,) s after a time, in the body axes of then.

    It gives None while attitude or orbit are not known.
    """
    field = FieldAhead()

    def expected(now_ns: int) -> FloatArray | None:
        state = surroundings.state(now_ns)
        if state is None or surroundings.at(now_ns) is None or not filter_.started:
            return None
        ahead = field.along(state, instants)
        return np.asarray(ahead @ attitude_matrix(filter_.at(now_ns).quaternion).T)

    return expected
