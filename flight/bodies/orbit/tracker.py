"""The tracker of a satellite: the pointing law along its path, and the pauses of the coils.

Far off its path the body is held still instead (`knightcube.gnc.control.three_axes.pointing_law`).

The coils pause at the begin of each window, so that the magnetometer is read without their field; then one
dipole, computed at the pause's end, is held. It is raised by what the pause takes from its mean.
"""

from __future__ import annotations

import numpy as np

from flight.bodies.orbit.filter import OrbitFilter
from flight.bodies.orbit.paths import PathPoint
from flight.bodies.orbit.surroundings import Surroundings
from flight.loop.control_output import CoilCommand
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix
from knightcube.gnc.control.detumble import WindowSchedule
from knightcube.gnc.control.three_axes.pointing_law import damping_dipole
from knightcube.gnc.estimation.estimate import Estimate

_NOTHING: FloatArray = np.zeros(3)


class PointingTracker:
    """Implements `flight.loop.body.Tracker`."""

    def __init__(
        self,
        filter_: OrbitFilter,
        surroundings: Surroundings,
        pauses: WindowSchedule,
        limit: float,
        dipole_per_ampere: float,
        inertia: FloatArray,
    ) -> None:
        """`limit` A m^2 and `dipole_per_ampere` m^2 of each coil; `inertia` (3,) kg m^2 of the body axes."""
        self._inertia = inertia
        self._filter, self._surroundings = filter_, surroundings
        self._pauses, self._limit, self._dipole_per_ampere = pauses, limit, dipole_per_ampere
        self._held = CoilCommand(_NOTHING, _NOTHING)
        self._window: tuple[int, object] | None = None

    def command(self, estimate: Estimate, reference: PathPoint) -> CoilCommand:
        """Return the command of the present window: zero in its pause."""
        pauses, now_ns = self._pauses, reference.time_ns
        if now_ns % pauses.period_ns < pauses.settle_ns + pauses.measure_ns:
            return CoilCommand(_NOTHING, _NOTHING)
        window = (now_ns // pauses.period_ns, reference.law)
        if window != self._window:
            self._window, self._held = window, self._command(estimate, reference)
        return self._held

    def reset(self) -> None:
        """Forget the command that is held."""
        self._window = None

    def _command(self, estimate: Estimate, reference: PathPoint) -> CoilCommand:
        around = self._surroundings.at(reference.time_ns)
        if around is None:
            return CoilCommand(_NOTHING, _NOTHING)
        residual = self._filter.residual_dipole
        field = attitude_matrix(estimate.quaternion) @ around.field
        quaternion, rate = estimate.quaternion, estimate.rate
        found = reference.law.command(
            reference.seconds, quaternion, rate, field, residual, self._filter.torque_sizes
        )
        dipole = found.dipole
        if not reference.paths.led(found.turn, rate, reference.time_ns):
            dipole = damping_dipole(self._inertia, rate, field) - residual
        # The mean over the window is what was asked for.
        dipole = dipole * (self._pauses.period_ns / self._pauses.act_ns)
        largest = float(np.abs(dipole).max())
        saturated = largest > self._limit
        if saturated:
            dipole = dipole * (self._limit / largest)
        return CoilCommand(dipole, dipole / self._dipole_per_ampere, saturated)
