"""The control laws of the testbed: B-dot detumbling, a controller about the thread, and the Helmholtz cage.

The cage renders an orbit's field, as the flight predicts the field. It shows the body the field that a
satellite on the orbit meets in its local frame: x along the flight, z down, y against the orbit's normal,
which is the thread's axis. The rotation about the thread is therefore the pitch of a satellite that looks
down, in a field that turns once a revolution and changes its strength. The cage renders the two components of
that field normal to the thread, `scale` times as strong. The third makes no torque about the thread, and the
thread bears the torque that it makes with a coil: its pair stays off.

The field is the flight's own prediction (WMM along the elements), by UTC; the cage's control computer and the
flight's agree on UTC. The coil on body x alone has no torque if the field is parallel to it: the torque about
the thread is made by the coils on x and z together, with the least current.
"""

from __future__ import annotations

import math

import numpy as np

from flight.bodies.testbed.guidance import ThreadReader
from flight.loop.body import CoilCommand, Tracker
from flight.schema.document import ConfigError
from flight.schema.testbed import Cage, Control, Identification
from hal.interfaces.wires import SECOND_NS, Clock
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.ephemeris import Ephemeris, predict
from knightcube.astro.earth.geomagnetism import GeomagneticError, field
from knightcube.astro.earth.orbit_knowledge import OrbitError, TwoLineElements
from knightcube.astro.earth.sun import DAY
from knightcube.astro.quaternion import about_axis_y, attitude_matrix
from knightcube.errors import UsageError
from knightcube.gnc.control.detumble import Detumbler
from knightcube.gnc.control.one_axis.excitation import ExcitationController, ExcitationSettings
from knightcube.gnc.control.one_axis.lq_tracker import AngleController, LqTracker
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter, FilterSettings
from knightcube.gnc.estimation.estimate import Estimate, SlowPrior
from knightcube.gnc.estimation.rigid_body import RigidBody
from knightcube.gnc.guidance.one_axis.path import PathSample
from knightcube.gnc.guidance.one_axis.plant import SingleAxisPlant
from knightcube.reference.control import AdaptiveController, AdaptiveSettings, PidController, PidSettings


class BdotLaw:
    """B-dot detumbling; implements `flight.loop.body.WindowedLaw`."""

    def __init__(self, detumbler: Detumbler, dipole_per_ampere: float) -> None:
        """`dipole_per_ampere` is n A of each coil (m^2)."""
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
        """Do nothing, because B-dot needs no model of the motion."""

    def field(self, now_ns: int) -> FloatArray | None:
        """Return the field (3,) T in body axes now; None before it is known."""
        return self._detumbler.field(now_ns)


def controller_of(
    section: Control,
    plant: SingleAxisPlant,
    period: float,
    identification: Identification,
) -> AngleController:
    """Return the controller of `plant` that `section` selects, for a period (s)."""
    if section.tracker == "excitation":
        move = identification
        return ExcitationController(
            plant, period, ExcitationSettings(move.current_share, move.largest_q2, move.swing)
        )
    if section.tracker == "pid":
        free = section.gains
        gains = (
            PidSettings.placed(section.bandwidth)
            if free is None
            else PidSettings(free.proportional, free.integral, free.derivative)
        )
        return PidController(plant, period, gains, section.target_weight)
    if section.tracker == "adaptive":
        settings = AdaptiveSettings(section.bandwidth, section.adaptation, section.reference_bandwidth)
        return AdaptiveController(plant, period, settings)
    return LqTracker(
        plant, section.state_weight, section.control_weight, as_in_thesis=section.tracker == "thesis"
    )


class ThreadTracker:
    """Tracks a path with the coil on body x (Sease 5.4); implements `flight.loop.body.Tracker`."""

    def __init__(self, controller: AngleController, reader: ThreadReader, dipole_per_ampere: float) -> None:
        self._controller = controller
        self._read = reader.read
        self._dipole = dipole_per_ampere

    def command(self, estimate: Estimate, reference: PathSample) -> CoilCommand:
        """Return the command that keeps the body on the reference."""
        now = self._read(estimate)
        wanted = self._controller.command(reference, now.angle, now.rate, now.disturbance)
        currents = np.array([wanted.current, 0.0, 0.0])
        return CoilCommand(self._dipole * currents, currents, wanted.saturated)

    def reset(self) -> None:
        """Discard integrated errors."""
        self._controller.reset()


AHEAD = 20.0
"""Span (s) of one prediction, which takes a millisecond or two."""
_UNIX_EPOCH = 2_440_587.5
_ROUND = 6_000.0, 60.0
"""Span (s) of about one revolution, and step (s), of the search for the weakest field."""
_ACROSS: FloatArray = np.array([1.0, 0.0, 1.0])
"""Mask of the field components that the cage renders."""


class CageField:
    """Predicts the cage's field at any time of the clock."""

    def __init__(self, section: Cage, weakest: float, clock: Clock) -> None:
        """Raise ConfigError for malformed elements, or a field that falls below `weakest` (T)."""
        try:
            self._elements = TwoLineElements(*section.elements)
        except UsageError as error:
            raise ConfigError("cage.elements", f"are no two-line elements: {error}") from error
        self._scale = section.scale
        self._date_zero = _UNIX_EPOCH + (clock.utc_ns() - clock.now_ns()) / (DAY * SECOND_NS)
        self._near: Ephemeris | None = None
        self._local: FloatArray = np.zeros((0, 3))
        least = self._weakest(clock.now_ns())
        if least < weakest:
            raise ConfigError(
                "plant.field",
                f"is {weakest:g}: the cage's field falls to {least:.3g} T, plans may count on no more",
            )

    def at(self, now_ns: int) -> FloatArray:
        """Return the field (3,) T, reference axes, at a time of the clock."""
        near = self._near
        seconds = math.inf if near is None else (self._date(now_ns) - near.julian_date) * DAY
        if near is None or not 0.0 <= seconds <= AHEAD:
            # The prediction begins a second earlier, for late measurements.
            state = self._elements.at(self._date(now_ns) - 1.0 / DAY)
            near = self._near = predict(state, AHEAD)
            self._local = np.array(
                [
                    local_frame(*place) @ there
                    for *place, there in zip(near.position, near.velocity, near.field, strict=True)
                ]
            )
            seconds = 1.0
        step = float(near.times[1])
        before = min(int(seconds / step), len(self._local) - 2)
        share = seconds / step - before
        return np.asarray(
            self._scale * _ACROSS * ((1.0 - share) * self._local[before] + share * self._local[before + 1])
        )

    def _date(self, now_ns: int) -> float:
        return self._date_zero + now_ns / (DAY * SECOND_NS)

    def _weakest(self, now_ns: int) -> float:
        """Return the minimum strength (T) of the rendered field over a revolution from now on."""
        least = math.inf
        for seconds in np.arange(0.0, *_ROUND):
            date = self._date(now_ns) + float(seconds) / DAY
            try:
                state = self._elements.at(date)
                there = local_frame(state.position, state.velocity) @ field(date, state.position)
            except (OrbitError, GeomagneticError) as error:
                raise ConfigError("cage.elements", f"give no field at {date:.4f} (UTC): {error}") from error
            least = min(least, self._scale * math.hypot(there[0], there[2]))
        return least


def local_frame(position: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return the matrix (3, 3) into the local frame: x along the flight, y against the normal, z down."""
    down = -position / np.linalg.norm(position)
    across = np.cross(velocity, position)
    across = across / np.linalg.norm(across)
    return np.stack([np.cross(across, down), across, down])


class CageFilter(AttitudeFilter):
    """The testbed's filter, which uses the cage's field at the time of each command."""

    def __init__(
        self, cage: CageField, body: RigidBody, settings: FilterSettings, prior: SlowPrior | None = None
    ) -> None:
        """Start the filter of `body` in the field of `cage`."""
        super().__init__(body, settings, prior)
        self._cage = cage

    def command(
        self, time_ns: int, currents: FloatArray, field: FloatArray | None = None, known: bool = True
    ) -> None:
        """Record the coil currents (3,) A in force from `time_ns` on, with the cage's field at that time."""
        super().command(time_ns, currents, self._cage.at(time_ns) if field is None else field, known)


class CageTracker:
    """Makes the torque of another tracker for coil x with the coils x and z in the cage's field."""

    def __init__(
        self,
        inner: Tracker,
        reader: ThreadReader,
        plant: SingleAxisPlant,
        field: CageField,
        dipole: float,
    ) -> None:
        """`inner` assumes the field of `plant`; `dipole` is n A of each coil, m^2."""
        self._inner = inner
        self._read = reader.read
        self._plant = plant
        self._field = field
        self._dipole = dipole

    def command(self, estimate: Estimate, reference: PathSample) -> CoilCommand:
        """Return the command that makes the torque with the least current."""
        wanted = self._inner.command(estimate, reference)
        angle = self._read(estimate).angle
        torque = self._plant.torque_constant * float(wanted.currents[0]) * math.cos(angle)
        bx, _, bz = (attitude_matrix(about_axis_y(angle)) @ self._field.at(estimate.time_ns)).tolist()
        # The torque about body y is m_z b_x - m_x b_z: most of it from a dipole normal to the field.
        each = torque / (self._dipole * (bx * bx + bz * bz))
        currents = np.array([-each * bz, 0.0, each * bx])
        excess = float(np.abs(currents).max()) / self._plant.current_limit
        if excess > 1.0:
            currents = currents / excess
        return CoilCommand(self._dipole * currents, currents, wanted.saturated or excess > 1.0)

    def reset(self) -> None:
        """Discard integrated errors."""
        self._inner.reset()
