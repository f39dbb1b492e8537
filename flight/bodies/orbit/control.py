"""The control laws of a satellite in orbit: detumbling, turning to the Sun in SAFE, and pointing.

Detumbling follows a minimum-time plan of the angular momentum in the measured magnetic field, or in the
predicted field if attitude and orbit are known. In SAFE the satellite turns to the Sun with solar cells, gyro
and magnetometer only; orbit, attitude and clock may be unknown. Pointing follows a path with the pointing
law. Far off the path, the rotation is damped before a new path is planned (`PathRecovery` and
`damping_dipole` of `knightcube.gnc.control.pointing_law`).

While pointing, the coils are off at the beginning of each control window, so that the magnetometer can be
read. At the end of the pause of a control window, one dipole is computed, which is commanded until the window
ends. The dipole of a control window is increased, so that its mean over the window is the dipole that the law
requires.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flight.bodies.orbit.environment import EstimatedEnvironment, StuckFieldCheck
from flight.bodies.orbit.filter import OrbitFilter
from flight.bodies.orbit.guidance import PathPoint
from flight.link import events
from flight.loop.body import CoilCommand
from flight.loop.facts import EventLog
from hal.interfaces.devices import StringReading
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.ephemeris import FieldAhead
from knightcube.astro.quaternion import attitude_matrix
from knightcube.gnc.control.coil_map import CoilMap, limited
from knightcube.gnc.control.detumble import WindowSchedule
from knightcube.gnc.control.field_detumbler import FieldDetumbler, FieldPrediction
from knightcube.gnc.control.pointing_law import damping_dipole
from knightcube.gnc.control.sun_acquisition import SunAcquisition
from knightcube.gnc.estimation.estimate import Estimate
from knightcube.vision.solar_cells import SolarStringModel, coarse_sun


class _MagneticLaw:
    """A control law that needs only magnetometer and gyro; implements `flight.loop.body.WindowedLaw`."""

    def __init__(self, law: FieldDetumbler | SunAcquisition, coils: CoilMap) -> None:
        """`coils` maps dipole moments to currents."""
        self._law, self._coils = law, coils
        self._field_check = StuckFieldCheck()

    def begin(self, now_ns: int) -> None:
        """Begin without knowledge of the magnetic field."""
        self._law.begin(now_ns)

    def sample(self, time_ns: int, field: FloatArray, rate: FloatArray) -> None:
        """Accept a field (3,), T, and the gyro's rate (3,), rad/s, unless the magnetometer is stuck."""
        if self._field_check.accept(field):
            self._law.sample(time_ns, field, rate)

    def command(self, now_ns: int) -> CoilCommand:
        """Return the present command for the coils, which is zero if the magnetometer is stuck."""
        dipole = self._law.dipole(now_ns)
        if self._field_check.stuck:
            dipole = np.zeros(3)
            self._law.acts(dipole)
        return CoilCommand(dipole, self._coils.currents(dipole))

    def sent(self, currents: FloatArray) -> None:
        """Propagate the estimated rate with the present currents (3,), A, of the coils."""
        self._law.acts(self._coils.dipole(currents))

    def field(self, now_ns: int) -> FloatArray | None:
        """Return the field (3,), T, in body axes at the last command, or None before the field is known."""
        return self._law.field


class FieldDetumblingLaw(_MagneticLaw):
    """Detumbles the body; the `detumbler` attribute contains the estimated rate and field."""

    def __init__(self, detumbler: FieldDetumbler, coils: CoilMap) -> None:
        """`coils` maps dipole moments to currents."""
        super().__init__(detumbler, coils)
        self.detumbler = detumbler


def expected_field(
    filter_: OrbitFilter, environment: EstimatedEnvironment, instants: FloatArray
) -> Callable[[int], FieldPrediction | None]:
    """Return a function that predicts the magnetic field at `instants` (n,), s, after a time.

    The field is in body axes, or in ICRS while the attitude is unknown. The result is None if the orbit is
    unknown.
    """
    field = FieldAhead()

    def expected(now_ns: int) -> FieldPrediction | None:
        state = environment.state(now_ns)
        if state is None or environment.at(now_ns) is None:
            return None
        ahead = field.along(state, instants)
        if not filter_.started:
            return FieldPrediction(ahead, False)
        return FieldPrediction(ahead @ attitude_matrix(filter_.at(now_ns).quaternion).T, True)

    return expected


class SunAcquisitionLaw(_MagneticLaw):
    """Turns the body to the Sun, and reports whether the solar cells measure a Sun direction."""

    def __init__(self, law: SunAcquisition, strings: SolarStringModel, coils: CoilMap, log: EventLog) -> None:
        """`coils` maps dipole moments to currents."""
        super().__init__(law, coils)
        self._acquisition, self._strings = law, strings
        self._events = log
        self._found: bool | None = None
        self._reason = "the solar strings deliver no readings"

    def update_sun(self, reading: StringReading) -> None:
        """Accept a reading of the solar cells, in any mode."""
        found = coarse_sun(reading.currents, self._strings)
        self._reason = found.reason
        if found.direction is not None:
            self._acquisition.update_sun(reading.time_ns, found.direction)

    def command(self, now_ns: int) -> CoilCommand:
        """Return the present command, which only damps the rotation if the Sun direction is unknown."""
        found = self._acquisition.sun is not None
        if found is not self._found:
            self._found = found
            if found:
                self._events.report(events.SUN_FOUND, now_ns, "by the solar strings")
            else:
                self._events.report(events.SUN_MISSED, now_ns, self._reason)
        return super().command(now_ns)


_NOTHING: FloatArray = np.zeros(3)
_LARGEST_COIL_ERROR = 0.3
"""Largest error of an element of the coil matrix that is compensated; the limit keeps the matrix
invertible."""


def commanded(dipole: FloatArray, coils: FloatArray) -> FloatArray:
    """Return the command (3,) that produces a dipole (3,), A m^2; `coils` (3, 3) maps commands to dipoles."""
    errors = np.clip(coils - np.eye(3), -_LARGEST_COIL_ERROR, _LARGEST_COIL_ERROR)
    return np.asarray(np.linalg.solve(np.eye(3) + errors, dipole))


class PointingTracker:
    """Tracks a path with the pointing law; implements `flight.loop.body.Tracker`."""

    def __init__(
        self,
        filter_: OrbitFilter,
        environment: EstimatedEnvironment,
        pauses: WindowSchedule,
        coils: CoilMap,
        inertia: FloatArray,
    ) -> None:
        """Create the tracker for coils and the inertia tensor `inertia` (3, 3), kg m^2, in body axes."""
        self._inertia = inertia
        self._filter, self._environment = filter_, environment
        self._pauses, self._coils = pauses, coils
        self._nothing = CoilCommand(_NOTHING, coils.currents(_NOTHING))
        self._held = self._nothing
        self._window: tuple[int, object] | None = None

    def command(self, estimate: Estimate, reference: PathPoint) -> CoilCommand:
        """Return the command of the present control window, which is zero during the window's pause."""
        pauses, now_ns = self._pauses, reference.time_ns
        if now_ns % pauses.period_ns < pauses.settle_ns + pauses.measure_ns:
            return self._nothing
        window = (now_ns // pauses.period_ns, reference.law)
        if window != self._window:
            self._window, self._held = window, self._command(estimate, reference)
        return self._held

    def reset(self) -> None:
        """Discard the command of the present control window."""
        self._window = None

    def _command(self, estimate: Estimate, reference: PathPoint) -> CoilCommand:
        around = self._environment.field(reference.time_ns)
        if around is None:
            return self._nothing
        residual = self._filter.residual_dipole
        field = attitude_matrix(estimate.quaternion) @ around
        quaternion, rate = estimate.quaternion, estimate.rate
        found = reference.law.command(
            reference.seconds, quaternion, rate, field, residual, self._filter.torque_sizes
        )
        dipole = found.dipole
        if not reference.paths.led(found.rotation, rate, reference.time_ns):
            dipole = damping_dipole(self._inertia, rate, field) - residual
        dipole = commanded(dipole, self._filter.coil_matrix)
        # The factor makes the mean dipole over the window equal to the required dipole.
        dipole = dipole * (self._pauses.period_ns / self._pauses.act_ns)
        held = limited(dipole, self._coils.limits)
        return CoilCommand(held, self._coils.currents(held), held is not dipole)
