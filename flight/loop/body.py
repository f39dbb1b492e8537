"""The body seam: the interface between the loop and the body that it flies.

A body is a kind of vehicle. The loop itself uses only attitudes, rates and dipoles. The body defines the form
of its targets, how a path to a target is planned and tracked, and its own packets. `flight.bodies` contains
the bodies. The configuration names the `BodyKind` of another package as `module:object`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol

from flight.link.modes import Mode
from flight.loop.coil_monitor import CoilMonitor
from flight.loop.executive import Cycle, JobResult
from flight.loop.facts import Services
from flight.loop.state import Learned, learned_of
from flight.schema.sections import Config
from hal.interfaces.devices import CoilState, Frame, GpsReading, ImuReading, StringReading
from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.gnc.estimation.estimate import Estimate, Knowledge
from knightcube.gnc.estimation.measurements import AttitudeMeasurement, MeanRateMeasurement, Measurement
from knightcube.gnc.guidance.three_axes.pointing_target import PointingTarget
from knightcube.gnc.tracker import Track
from knightcube.vision.frame_job import StreakEstimator
from knightcube.vision.horizon_camera_job import HorizonCameraJob, HorizonCameraResult

COMMANDED = 1000
"""Number of the first commanded slew."""
KEPT = -1
"""Number of a target that holds the present attitude; packets never contain this number."""


class Reference(Protocol):
    """The reference motion at one instant; each body has its own implementation."""

    @property
    def quaternion(self) -> FloatArray:
        """Attitude quaternion (4,), reference frame into body axes."""

    @property
    def body_rate(self) -> FloatArray:
        """Angular rate (3,) rad/s, body axes."""


class TargetLaw(Protocol):
    """The wanted attitude as a function of time; each kind of body has its own implementation."""

    @property
    def text(self) -> str:
        """Description of the target, for events."""

    def quaternion(self, now_ns: int) -> FloatArray:
        """Return the wanted attitude (4,) at `now_ns`, reference frame into body axes."""


@dataclass(frozen=True, slots=True)
class Target:
    """A target with its number in packets: the number of a configured step, COMMANDED or higher, or KEPT."""

    index: int
    law: TargetLaw


@dataclass(frozen=True, slots=True, eq=False)
class CoilCommand:
    """A tracker's command: the dipole (3,) A m^2, and the currents (3,) A that produce it."""

    dipole: FloatArray
    currents: FloatArray
    saturated: bool = False


class SteeringState(IntEnum):
    """The use of the coils; the values are the numbers in the control packet."""

    OFF = 0
    FOLLOWING = 1
    HOLDING = 2
    BRAKING = 3


@dataclass(frozen=True, slots=True, eq=False)
class Steered:
    """The result of steering in one cycle.

    Attributes:
        reference: the reference motion at this time; None without a path.
        dipole: commanded dipole (3,) A m^2.
        currents: currents (3,) A that were sent to the driver, after reallocation and including the probe of
            the coil monitor. They are zero if a fault in this cycle switched the coils off.
    """

    state: SteeringState
    reference: Any | None
    dipole: FloatArray
    currents: FloatArray
    saturated: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class ControlOutput:
    """The results of one control cycle.

    Attributes:
        estimate: state estimate, from measurements or propagated by the model alone; None without an
            estimate.
        target: target in force; None before the first target.
        written: coil command that the PWM chip holds at the end of the cycle.
    """

    cycle: Cycle
    mode: Mode
    estimate: Estimate | None
    target: Target | None
    steered: Steered
    written: CoilState


PLANNER = "planner"
"""The planner worker's name."""


@dataclass(frozen=True, slots=True)
class ReadingAgreement:
    """How a reading of the inertial unit agrees with the estimate.

    Attributes:
        holds: whether at least one quantity of the reading agrees, so that the estimate counts as measured.
        objection: the quantity that does not agree, as text; empty if all quantities agree.
    """

    holds: bool
    objection: str = ""


class Filter(Protocol):
    """Estimates attitude and rate from measurements, each at its own time."""

    @property
    def started(self) -> bool:
        """Whether there is an estimate."""

    @property
    def measured_ns(self) -> int:
        """The time of the newest accepted measurement."""

    @property
    def doubts_commands(self) -> bool:
        """Whether the motion of the body contradicts the commands, so that the coil currents are unknown."""

    def command(self, time_ns: int, currents: FloatArray, *, known: bool = True) -> None:
        """Record the coil currents (3,) A in force from `time_ns` on, and whether they are known."""

    def mark_unknown(self, since_ns: int) -> None:
        """Treat the currents recorded since a time as unknown."""

    def measure_late(self, late: Sequence[Measurement], applied: Callable[[list[bool]], None]) -> None:
        """Apply measurements of past times; `applied` is called with whether each passed its gate."""

    def catch_up(self, most: int | None = None) -> None:
        """Apply up to `most` of the measurements after a late measurement again, or all of them."""

    def at(self, time_ns: int) -> Estimate:
        """Return the estimate propagated to `time_ns`; the filter itself does not change."""

    def past(self, time_ns: int) -> Estimate | None:
        """Return the estimate at a past time; None beyond the history."""

    def rates(self, begin_ns: int, end_ns: int) -> tuple[IntArray, FloatArray] | None:
        """Return times (n,) ns and rates (n, 3) rad/s that span an interval; None beyond the history."""


class ReadingFeed(Protocol):
    """Passes those quantities of a reading that this kind of body uses to the filter."""

    def accept(self, reading: ImuReading) -> ReadingAgreement:
        """Start the filter from a reading, or apply the reading to a running filter."""

    def begin(self, attitude: AttitudeMeasurement) -> bool:
        """Start a filter that has no estimate from a star fix; return whether the filter started."""


class WindowedLaw(Protocol):
    """A control law that uses magnetometer and gyro only, in windows that begin with the coils off."""

    def begin(self, now_ns: int) -> None:
        """Begin without knowledge of the magnetic field."""

    def sample(self, time_ns: int, field: FloatArray, rate: FloatArray) -> None:
        """Accept a field (3,) T and a gyro's rate (3,) rad/s measured at `time_ns`.

        The sample is ignored unless the coils were off and their field had decayed.
        """

    def command(self, now_ns: int) -> CoilCommand:
        """Return the command now, which is zero while the field is measured or the rate is unknown."""

    def sent(self, currents: FloatArray) -> None:
        """Accept the currents (3,) A that were sent. They differ from the command if a coil is excluded."""

    def field(self, now_ns: int) -> FloatArray | None:
        """Return the present magnetic field (3,) T in body axes; None before it is known."""


class Tracker(Protocol):
    """Computes a coil command from estimate and reference motion, once in each control cycle."""

    def command(self, estimate: Estimate, reference: Any) -> CoilCommand:
        """Return the command that keeps the body on the reference motion."""

    def reset(self) -> None:
        """Reset the integrated errors after an interval with the coils off or without an estimate."""


class FlownPaths(Protocol):
    """The path being flown."""

    def sample(self, now_ns: int) -> Any | None:
        """Return the reference motion at this time; None without a path."""

    def is_following(self, now_ns: int) -> bool:
        """Return whether a path is being followed, rather than its end held."""

    def is_adrift(self, now_ns: int) -> bool:
        """Return whether an attitude is held because no plan arrived in time."""

    def release(self) -> None:
        """Discard the path."""


class Planner(Protocol):
    """Requests paths from the planner worker and passes them to guidance."""

    def busy_since_ns(self) -> int | None:
        """Return the time (ns) at which the worker began the present plan; None while the worker is idle."""

    def aim(self, target: Target, now_ns: int) -> None:
        """Set a new target, and request a plan for it at once."""

    def request(self, now_ns: int) -> None:
        """Request a plan, which starts as soon as there is an estimate and the worker is idle."""

    def resume(self, now_ns: int) -> None:
        """Request a path for the remaining time to the target after an interval without control."""

    def replan(self, cycle: Cycle) -> None:
        """Request the periodic plan: the task of the replanning rate group."""

    def serve(self, estimate: Estimate | None, target: Target, now_ns: int) -> None:
        """Submit the requested job to the worker."""

    def finish(self, result: JobResult, now_ns: int) -> None:
        """Pass the worker's plan to guidance."""

    def counts(self) -> tuple[int, int]:
        """Return how many plans were accepted and how many were refused since the start."""


class BodyTargets(Protocol):
    """The targets of a body, and the angle between body and target."""

    def configured(self, mission_time_ns: int) -> Target:
        """Return the configured target at a mission time."""

    def commanded(self, wanted: float | PointingTarget, number: int) -> Target:
        """Return the target that a command describes. Raises UsageError if this body cannot fly to it."""

    def hold_here(self, estimate: Estimate, now_ns: int) -> Target:
        """Return a target that holds the present attitude, or the nearest attitude that can be held."""

    def can_hold(self, estimate: Estimate) -> bool:
        """Return whether the coils could hold the present attitude."""

    def speed(self, estimate: Estimate) -> float:
        """Return the magnitude (rad/s) of the body rate that the coils control."""

    def error(self, estimate: Estimate, target: Target) -> float:
        """Return the angle between body and target, rad."""

    def error_when_due(self, estimate: Estimate, target: Target, now_ns: int) -> float | None:
        """Return the angle (rad) to the attitude that is due now; None while no attitude is due."""


class BodyView(Protocol):
    """The packets and texts that a kind of body adds."""

    def record_cycle(self, output: ControlOutput) -> None:
        """Record the body's own packet of a control cycle."""

    def announce(self, target: Target, now_ns: int) -> None:
        """Record a new target, and report it as an event."""

    def mode_fields(self, wanted: Target | None) -> Mapping[str, float]:
        """Return the body's fields of the mode packet."""

    def rate_text(self, rate: MeanRateMeasurement) -> str:
        """Return a rate from streaks as text, for the event of its rejection."""

    def progress(self, output: ControlOutput | None) -> str:
        """Return target and attitude as text, for the progress line."""


class HorizonCameraUse(Protocol):
    """The use of the horizon cameras' frames by a body."""

    @property
    def needed(self) -> bool:
        """Whether frames are needed often, because the attitude is poorly known."""

    def job(self, frames: Mapping[int, Frame]) -> HorizonCameraJob:
        """Return the worker's job for frames, given by the number of their camera."""

    def accept(self, time_ns: int, found: HorizonCameraResult) -> tuple[bool, bool]:
        """Accept the directions of Sun and nadir at a time; return for each whether it was used."""


class BodyEstimation(Protocol):
    """The estimate of a body, and the measurements that it uses.

    A body inherits from this class and implements the methods without a default. The defaults are those of a
    body without an orbit.

    Attributes:
        filter: estimates attitude, rate and the body's parameters.
        feed: passes the readings of the inertial unit to the filter.
        coil_monitor: detects broken coils.
        learned_problems: why parameters that an earlier boot learned were rejected.
        horizon_cameras: use of the horizon cameras' frames; None without these cameras.
    """

    filter: Filter
    feed: ReadingFeed
    coil_monitor: CoilMonitor
    learned_problems: list[str]
    horizon_cameras: HorizonCameraUse | None = None

    def field(self, estimate: Estimate) -> FloatArray:
        """Return the magnetic field (3,) T in body axes at an estimate, for the reallocation of currents."""

    def angular_acceleration_psd(self, time_ns: int) -> FloatArray:
        """Return the spectral density (3, 3) rad^2/s^3 of the white angular acceleration, body axes."""

    def learned(self, estimate: Estimate) -> Mapping[str, Learned]:
        """Return the parameters from which the next boot starts."""
        return learned_of(estimate)

    def knowledge(self) -> Knowledge:
        """Return how well the attitude is known now."""
        return Knowledge.FINE

    def orbit(self, time_ns: int) -> OrbitState | None:
        """Return the orbit's state at a time; None while the orbit is unknown."""
        return None

    def velocity(self, time_ns: int) -> FloatArray | None:
        """Return the velocity (3,) m/s about the Sun, reference axes, for the aberration of starlight.

        The result is None if the configured velocity is to be used.
        """
        return None

    def accept_fix(self, reading: GpsReading) -> bool:
        """Accept a valid GPS reading; return whether the body uses it."""
        return False

    def accept_sun(self, reading: StringReading) -> str | None:
        """Accept a reading of the solar cells; return its fault or an empty text; None if not checked."""
        return None


class BodyControl(Protocol):
    """Guidance and control of a body.

    A body inherits from this class. The defaults are those of a body that follows no objects.

    Attributes:
        modes: the modes that exist for this body.
        dipole_per_ampere: turns times area of each coil, m^2.
        free_axis: (3,) the only axis about which the body can rotate; None for a free body.
        detumbling: the control law for detumbling.
        sun_acquisition: turns the body to the Sun without an attitude, in SAFE; None if the body cannot.
    """

    modes: frozenset[Mode]
    dipole_per_ampere: float
    free_axis: FloatArray | None
    targets: BodyTargets
    planner: Planner
    paths: FlownPaths
    tracker: Tracker
    detumbling: WindowedLaw
    sun_acquisition: WindowedLaw | None = None

    def follows_objects(self) -> bool:
        """Return whether an object is searched for or followed, so that every frame is needed."""
        return False

    def accept_tracks(self, tracks: Sequence[Track], now_ns: int) -> None:
        """Accept the confirmed tracks of objects, after each frame that was searched for objects."""
        return

    def exposure_start(self, from_ns: int, exposure_ns: int) -> int:
        """Return the first time from `from_ns` on with constant coil currents over an exposure."""
        return from_ns


@dataclass(frozen=True, slots=True)
class FlightBody:
    """A body ready to fly.

    Attributes:
        streak_estimator: the estimator that `camera.estimator` names; None for the default estimator.
    """

    estimation: BodyEstimation
    control: BodyControl
    view: BodyView
    streak_estimator: StreakEstimator | None = None


@dataclass(frozen=True, slots=True)
class BodyKind:
    """A kind of body.

    Attributes:
        plan: function that the planner worker runs, from a job to a plan; None without a planner.
        make: builds the body from a configuration and the parameters that an earlier boot learned.
    """

    plan: Callable[[Any], Any] | None
    make: Callable[[Config, Services, Mapping[str, Learned]], FlightBody]
