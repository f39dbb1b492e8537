"""Interface between the loop and the body that it flies.

A body is a vehicle of some kind, such as a satellite or the testbed. The loop itself uses only attitudes,
rates and dipoles. The body defines its targets, the planning and tracking of paths to a target, and its own
telemetry packets. The bodies of this repository are in `flight.bodies`. A `BodyKind` of another package is
named in the configuration as `module:object`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

from flight.link.events import Mode
from flight.loop.coil_monitor import CoilMonitor
from flight.loop.executive import Cycle, JobResult
from flight.loop.facts import Services
from flight.loop.state import Learned, learned_of
from flight.schema.sections import Config
from hal.interfaces.devices import CoilState, Frame, GpsReading, ImuReading, StringReading
from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.gnc.estimation.estimate import (
    AttitudeMeasurement,
    Estimate,
    Knowledge,
    MeanRateMeasurement,
    Measurement,
)
from knightcube.gnc.guidance.pointing_target import PointingTarget
from knightcube.gnc.tracker import Track
from knightcube.vision.frame_job import StreakEstimator
from knightcube.vision.horizon_camera_job import HorizonCameraJob, HorizonCameraResult

COMMANDED = 1000
"""Number of the first commanded target."""
KEPT = -1
"""Number of a target that holds the present attitude; this number is never sent in packets."""


class Reference(Protocol):
    """Interface of a reference motion at one instant; each kind of body has its own class."""

    @property
    def quaternion(self) -> FloatArray:
        """Attitude quaternion (4,) from the reference frame to body axes."""

    @property
    def body_rate(self) -> FloatArray:
        """Angular rate (3,), rad/s, in body axes."""


class TargetLaw(Protocol):
    """Target attitude as a function of time, as implemented by each kind of body."""

    @property
    def text(self) -> str:
        """Description of the target for events."""

    def quaternion(self, now_ns: int) -> FloatArray:
        """Return the target attitude (4,) at `now_ns`, from the reference frame to body axes."""


@dataclass(frozen=True, slots=True)
class Target:
    """A target of a body.

    The attribute `index` is the number of a configured step, COMMANDED plus the number of a command, or KEPT.
    """

    index: int
    law: TargetLaw


class CoilCommand(NamedTuple):
    """A tracker's command: the dipole (3,), A m^2, and the currents (3,), A, that produce it."""

    dipole: FloatArray
    currents: FloatArray
    saturated: bool = False


class SteeringState(IntEnum):
    """State of steering; the values are the numbers in the control packet."""

    OFF = 0
    FOLLOWING = 1
    HOLDING = 2
    BRAKING = 3


class Steered(NamedTuple):
    """Result of steering in one control cycle.

    Attributes:
        reference: reference motion at the time of the cycle, or None if there is no path.
        dipole: commanded dipole (3,), A m^2.
        currents: currents (3,), A, sent to the driver, after reallocation and with the coil monitor's probe
            current. The sent currents are zero if a fault in this cycle switched the coils off.
    """

    state: SteeringState
    reference: Any | None
    dipole: FloatArray
    currents: FloatArray
    saturated: bool = False


class ControlOutput(NamedTuple):
    """Results of one control cycle.

    Attributes:
        estimate: state estimate, measured or propagated by the model, or None before the filter starts.
        target: target in force, or None before the first target.
        written: coil command that the PWM chip holds at the end of the cycle.
    """

    cycle: Cycle
    mode: Mode
    estimate: Estimate | None
    target: Target | None
    steered: Steered
    written: CoilState


PLANNER = "planner"
"""Name of the planner worker."""


class ReadingAgreement(NamedTuple):
    """Agreement of an inertial unit's reading with the estimate.

    Attributes:
        holds: whether at least one quantity of the reading agrees with the estimate; if so, the estimate
            counts as measured.
        objection: name of a quantity that contradicts the estimate; empty if all quantities agree.
    """

    holds: bool
    objection: str = ""


@dataclass(frozen=True, slots=True)
class FixVerdict:
    """Use of a GPS fix: used, refused for the reason `refusal`, or, by default, awaiting further fixes."""

    used: bool = False
    refusal: str = ""


class Filter(Protocol):
    """Estimates attitude and rate from measurements, each applied at its own time."""

    @property
    def started(self) -> bool:
        """Whether there is an estimate."""

    @property
    def measured_ns(self) -> int:
        """The time of the newest accepted measurement."""

    @property
    def doubts_commands(self) -> bool:
        """Whether the motion of the body contradicts the commands, which makes the coil currents unknown."""

    def command(self, time_ns: int, currents: FloatArray, *, known: bool = True) -> None:
        """Record the coil currents (3,), A, in force from `time_ns` on, and whether they are known."""

    def mark_unknown(self, since_ns: int) -> None:
        """Treat the coil currents recorded since a time as unknown."""

    def measure_late(self, late: Sequence[Measurement], applied: Callable[[list[bool]], None]) -> None:
        """Apply measurements of past times, and call `applied` with flags: which of them were accepted."""

    def catch_up(self, most: int | None = None) -> None:
        """Repeat the filter updates that follow a late measurement: all, or at most `most` of them."""

    def at(self, time_ns: int) -> Estimate:
        """Return the estimate propagated to `time_ns`, without changing the filter."""

    def past(self, time_ns: int) -> Estimate | None:
        """Return the estimate at a past time, or None if the time is before the stored history."""

    def rates(self, begin_ns: int, end_ns: int) -> tuple[IntArray, FloatArray] | None:
        """Return the times (n,), ns, and rates (n, 3), rad/s, of an interval.

        Returns None if the interval begins before the stored history.
        """


class ReadingFeed(Protocol):
    """Passes to the filter those quantities of a reading that the body uses."""

    def accept(self, reading: ImuReading) -> ReadingAgreement:
        """Start the filter from a reading, or apply the reading to a running filter."""

    def begin(self, attitude: AttitudeMeasurement) -> bool:
        """If the filter has no estimate, start it from a star fix; return whether it started."""


class WindowedLaw(Protocol):
    """A control law that uses only magnetometer and gyro, and switches the coils off to measure the field."""

    def begin(self, now_ns: int) -> None:
        """Begin without knowledge of the magnetic field."""

    def sample(self, time_ns: int, field: FloatArray, rate: FloatArray) -> None:
        """Accept a field (3,), T, and a gyro rate (3,), rad/s, if the coils' field has already decayed."""

    def command(self, now_ns: int) -> CoilCommand:
        """Return the present command, which is zero while the field is measured or the rate is unknown."""

    def sent(self, currents: FloatArray) -> None:
        """Accept the sent currents (3,), A, which differ from the command if a coil is excluded."""

    def field(self, now_ns: int) -> FloatArray | None:
        """Return the present magnetic field (3,), T, in body axes, or None before it is known."""


class Tracker(Protocol):
    """Computes a coil command from estimate and reference motion, once in each control cycle."""

    def command(self, estimate: Estimate, reference: Any) -> CoilCommand:
        """Return the command that keeps the body on the reference motion."""

    def reset(self) -> None:
        """Discard the integrated errors after a time without control."""


class FlownPaths(Protocol):
    """The path being flown."""

    def sample(self, now_ns: int) -> Any | None:
        """Return the reference motion at a time, or None if there is no path."""

    def is_following(self, now_ns: int) -> bool:
        """Return whether a path is being followed, as opposed to an attitude held after its end."""

    def is_adrift(self, now_ns: int) -> bool:
        """Return whether an attitude is held because no plan arrived in time."""

    def release(self) -> None:
        """Discard the path."""


class Planner(Protocol):
    """Requests paths from the planner worker, and passes them to guidance."""

    def busy_since_ns(self) -> int | None:
        """Return the time (ns) at which the worker began its present plan, or None while it is idle."""

    def aim(self, target: Target, now_ns: int) -> None:
        """Set a new target, and request a plan for it at once."""

    def request(self, now_ns: int) -> None:
        """Request a plan, which is made once there is an estimate and the worker is idle."""

    def resume(self, now_ns: int) -> None:
        """After a time without control, request a path for the remaining time to the target."""

    def replan(self, cycle: Cycle) -> None:
        """Request the periodic plan; called by the replanning rate group."""

    def serve(self, estimate: Estimate | None, target: Target, now_ns: int) -> None:
        """Submit the requested job to the planner worker, if it is due."""

    def finish(self, result: JobResult, now_ns: int) -> None:
        """Pass the planner worker's plan to guidance."""

    def counts(self) -> tuple[int, int]:
        """Return how many plans were accepted, and how many were rejected, since the start."""


class BodyTargets(Protocol):
    """The targets of a body, and the angle between body and target."""

    def configured(self, mission_time_ns: int) -> Target:
        """Return the configured target that is in force at a mission time."""

    def commanded(self, wanted: float | PointingTarget, number: int) -> Target:
        """Return the target `wanted` of the command with the number `number`.

        Raises UsageError for an unreachable target.
        """

    def hold_here(self, estimate: Estimate, now_ns: int) -> Target:
        """Return a target that holds the present attitude, or the nearest attitude that can be held."""

    def can_hold(self, estimate: Estimate) -> bool:
        """Return whether the coils can hold the present attitude."""

    def speed(self, estimate: Estimate) -> float:
        """Return the magnitude (rad/s) of the body rate that the coils can control."""

    def error(self, estimate: Estimate, target: Target) -> float:
        """Return the angle (rad) between body and target."""

    def error_when_due(self, estimate: Estimate, target: Target, now_ns: int) -> float | None:
        """Return the angle (rad) between the body and the attitude required now; None if none is required."""


class BodyView(Protocol):
    """Telemetry packets, event texts and progress texts of one kind of body."""

    def record_cycle(self, output: ControlOutput) -> None:
        """Record the packets of this kind of body for a control cycle."""

    def announce(self, target: Target, now_ns: int) -> None:
        """Record a new target, and report it as an event."""

    def mode_fields(self, wanted: Target | None) -> Mapping[str, float]:
        """Return the fields of the mode packet that belong to this kind of body."""

    def rate_text(self, rate: MeanRateMeasurement) -> str:
        """Return a rate measured from streaks as text, for the event of its rejection."""

    def progress(self, output: ControlOutput | None) -> str:
        """Return target and attitude as text for the progress line."""


class HorizonCameraUse(Protocol):
    """A body's use of the frames of the horizon cameras."""

    @property
    def needed(self) -> bool:
        """Whether the body needs horizon frames often, because its attitude is poorly known."""

    def job(self, frames: Mapping[int, Frame]) -> HorizonCameraJob:
        """Return the worker's job for `frames`, a mapping from camera numbers to frames."""

    def accept(self, time_ns: int, found: HorizonCameraResult) -> tuple[bool, bool]:
        """Accept the directions of Sun and nadir at a time; return whether each of them was used."""


class BodyEstimation(Protocol):
    """The estimation of a body, and the measurements that it uses.

    Each kind of body inherits from `BodyEstimation`, and implements the methods that have no default. The
    default methods suit a body that is not in orbit.

    Attributes:
        filter: filter that estimates attitude, rate and parameters of the body.
        feed: object that passes the inertial unit's readings to the filter.
        coil_monitor: monitor that detects broken coils.
        learned_problems: reasons why parameters that an earlier boot learned were rejected.
        uses_readings_without_rate: whether the feed accepts readings with an invalid rate.
        horizon_cameras: use of the horizon cameras' frames, or None if there are no horizon cameras.
    """

    filter: Filter
    feed: ReadingFeed
    coil_monitor: CoilMonitor
    learned_problems: list[str]
    uses_readings_without_rate: bool = False
    horizon_cameras: HorizonCameraUse | None = None

    def field(self, estimate: Estimate) -> FloatArray:
        """Return the magnetic field (3,), T, in body axes for the reallocation of currents."""

    def angular_acceleration_psd(self, time_ns: int) -> FloatArray:
        """Return the power spectral density (3, 3), rad^2/s^3, of the white angular acceleration."""

    def learned(self, estimate: Estimate) -> Mapping[str, Learned]:
        """Return the learned parameters, from which the next boot starts."""
        return learned_of(estimate)

    def coils_corrected(self, change: FloatArray, deviations: FloatArray) -> None:
        """Adapt to coil dipoles that were multiplied by `change` (n,).

        The relative standard deviations of the dipoles are `deviations` (n,). The default method does
        nothing; it suits a filter that does not estimate the coils separately.
        """
        del change, deviations

    def coils_used(self, used: BoolArray) -> None:
        """Adapt to the flags `used` (n,) of the coils in use; by default, do nothing."""
        del used

    def magnetometer_changed(self) -> None:
        """Discard the estimated errors of the previous magnetometer; by default, do nothing."""
        return

    def is_accurate(self, estimate: Estimate) -> bool:
        """Return whether an estimate made without a gyro is accurate enough for driving the coils."""
        return True

    def rate_without_gyro(self, time_ns: int) -> FloatArray | None:
        """Return the rate (3,), rad/s, that replaces the gyro's rate, or None, which is the default."""
        return None

    def fastest_by_field(self) -> float:
        """Return the largest likely body rate (rad/s), from the magnetometer; the default is infinity."""
        return math.inf

    def knowledge(self) -> Knowledge:
        """Return how well the attitude is known now."""
        return Knowledge.FINE

    def orbit(self, time_ns: int) -> OrbitState | None:
        """Return the state of the orbit at a time, or None while the orbit is unknown."""
        return None

    def velocity(self, time_ns: int) -> FloatArray | None:
        """Return the velocity (3,), m/s, relative to the Sun, or None for the configured velocity."""
        return None

    def accept_fix(self, reading: GpsReading) -> FixVerdict:
        """Accept a GPS fix, and return whether it is used."""
        return FixVerdict()

    def accept_sun(self, reading: StringReading) -> str | None:
        """Accept a solar cell reading; return its fault (empty for none), or None if it was not checked."""
        return None


class BodyControl(Protocol):
    """Guidance and control of a body.

    Each kind of body inherits from `BodyControl`. The default methods suit a body that does not follow
    objects.

    Attributes:
        modes: modes that exist for this kind of body.
        dipoles: dipole moment of each coil per ampere (3, n), m^2, body axes, one column per coil.
        free_axis: unit vector (3,) of the only axis about which the body can rotate, or None for a free body.
        detumbling: control law for detumbling.
        sun_acquisition: control law that turns the body to the Sun in SAFE, or None if the body has no such
            law.
    """

    modes: frozenset[Mode]
    dipoles: FloatArray
    free_axis: FloatArray | None
    targets: BodyTargets
    planner: Planner
    paths: FlownPaths
    tracker: Tracker
    detumbling: WindowedLaw
    sun_acquisition: WindowedLaw | None = None

    def follows_objects(self) -> bool:
        """Return whether the body searches for an object or follows one, which requires every frame."""
        return False

    def accept_tracks(self, tracks: Sequence[Track], now_ns: int) -> None:
        """Accept the confirmed tracks of objects after each frame that was searched for objects."""
        return

    def exposure_start(self, from_ns: int, exposure_ns: int) -> int:
        """Return the first start time, not before `from_ns`, of an exposure during which no coil switches."""
        return from_ns


@dataclass(frozen=True, slots=True)
class FlightBody:
    """A body ready to fly. The `streak_estimator` is None for the default estimator of rates from streaks."""

    estimation: BodyEstimation
    control: BodyControl
    view: BodyView
    streak_estimator: StreakEstimator | None = None


@dataclass(frozen=True, slots=True)
class BodyKind:
    """A kind of body.

    The function `plan` runs in the planner worker, and converts a job to a plan; `plan` is None for a body
    without a planner. The function `make` builds the body from a configuration and the parameters that an
    earlier boot learned.
    """

    plan: Callable[[Any], Any] | None
    make: Callable[[Config, Services, Mapping[str, Learned]], FlightBody]
