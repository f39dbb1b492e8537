"""Guidance of a satellite: targets, the flown path, and plans from the planner worker.

A path is a table of feedback gains and reference motion for the pointing law. A path is planned when a target
is set, when the attitude becomes known again, and when the body leaves its path. Paths are also planned
periodically, for two reasons: the orbit prediction loses accuracy, and a roll angle that the target leaves
free is adapted to the present roll of the body.

During a slew, the remainder of the slew is planned again every few seconds from the newest estimate, with the
estimated inertia, residual dipole and torques. The running path is followed until the new path begins. If a
new path arrives late, the satellite skips the part of the path that lies in the past.

A satellite that follows an object points to the search direction first, then to the track of the object.
While there is no track, the boresight stays at the search direction. If there are several tracks, the
satellite follows the brightest object until its track ends. The satellite follows the predicted direction of
the track, so it follows the object also between detections.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from flight.bodies.orbit.environment import EstimatedEnvironment
from flight.link import events
from flight.loop.body import COMMANDED, KEPT, PLANNER, Target
from flight.loop.executive import Cycle, JobResult
from flight.loop.facts import EventLog, Services
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.earth.disturbance import box_areas
from knightcube.astro.quaternion import angle_between, attitude_matrix
from knightcube.errors import UsageError
from knightcube.gnc.control.coil_map import CoilMap
from knightcube.gnc.control.pointing_job import STEADY, ObjectDirection, PointingJob, RunningSlew, SlewRequest
from knightcube.gnc.control.pointing_law import PathRecovery, PointingLaw
from knightcube.gnc.control.pointing_table import PointingTable, PointingWeights
from knightcube.gnc.estimation.estimate import Estimate
from knightcube.gnc.guidance.attitude_law import AttitudeReference, BodyAxes
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from knightcube.gnc.guidance.slew_model import SlewPath
from knightcube.gnc.tracker import Track


@dataclass(frozen=True, slots=True, eq=False)
class PathPoint:
    """The planned motion at one time, `seconds` after the start of the path; implements `Reference`."""

    paths: PointingPaths
    law: PointingLaw
    time_ns: int
    seconds: float

    @property
    def motion(self) -> AttitudeReference:
        """The planned motion."""
        return self.law.reference(self.seconds)

    @property
    def quaternion(self) -> FloatArray:
        """Attitude quaternion (4,) from ICRS to body axes."""
        return self.motion.quaternion

    @property
    def body_rate(self) -> FloatArray:
        """Angular rate (3,), rad/s, in body axes."""
        return self.motion.rate


REST = 0.3
"""Final fraction of a slew in which the slew is not planned again. The feedback gains correct small errors
near the end, because the time is too short for a new plan."""


@dataclass(frozen=True, slots=True, eq=False)
class _Followed:
    """A path that is followed from `begin_ns` on; its times count from `origin_ns`. `slew` may be None."""

    law: PointingLaw
    origin_ns: int
    begin_ns: int
    slew: SlewPath | None


class PointingPaths:
    """The path that the satellite follows; implements `flight.loop.body.FlownPaths`.

    The angle (rad) between body and path at the last command is `off`. The attribute `astray` controls
    damping and replanning of a body far off its path.
    """

    def __init__(self, limit: float | FloatArray, fastest: float) -> None:
        """Start without a path; mean dipoles are limited to `limit` (A m^2), rates to `fastest` (rad/s)."""
        self._limit, self._fastest = limit, fastest
        self._followed: _Followed | None = None
        self._next: _Followed | None = None
        self._target: PointingTarget | None = None
        self._slew_ns = 0
        self._arrival_ns: int | None = None
        self.off = 0.0
        self.astray = PathRecovery()

    def offer(
        self, table: PointingTable, target: PointingTarget, origin_ns: int, *, continues: bool = False
    ) -> str:
        """Follow the part of a new path table in which the body rate does not exceed the limit.

        Return why the path is rejected, or an empty text if the path is followed. If `continues` is true, the
        table continues the present slew, and is followed once its first time is reached. Any other table is
        followed at once.
        """
        parts = (table.gain, table.dipole, table.torque_part, table.path.quaternion)
        if not all(np.isfinite(part).all() for part in parts):
            return "the path contains values that are not finite"
        flown = table.below(self._fastest)
        if flown is None:
            turn, most = np.rad2deg([table.fastest, self._fastest])
            limit = f"but above {most:.2f} deg/s it is detumbled or the camera pauses"
            return f"the path rotates the body at {turn:.2f} deg/s, {limit}"
        law = PointingLaw(flown, self._limit)
        begin_ns = origin_ns + round(law.span[0] * SECOND_NS)
        found = _Followed(law, origin_ns, begin_ns, table.slew)
        if continues:
            self._next = found
            return ""
        self._followed, self._next, self._target = found, None, target
        self.off, self._arrival_ns = 0.0, None
        self.astray.planned()
        if table.slew is not None:
            self._slew_ns = begin_ns
            self._arrival_ns = begin_ns + round(table.slew.horizon * SECOND_NS)
        return ""

    def led(self, turn: FloatArray, rate: FloatArray, now_ns: int) -> bool:
        """Record the deviation of the body from its path, and return whether the body still follows the path.

        The deviation is the rotation vector `turn` (3,), rad, and the body rate is `rate` (3,), rad/s.
        """
        self.off = float(np.linalg.norm(turn))
        self.astray.update(self.off, float(np.linalg.norm(rate)), now_ns / SECOND_NS)
        return self.astray.since is None

    def is_slewing(self, now_ns: int, target: PointingTarget) -> bool:
        """Return whether a slew to a target is under way."""
        return self._arrival_ns is not None and now_ns < self._arrival_ns and target == self._target

    def running(self, now_ns: int) -> RunningSlew | None:
        """Return the slew whose remainder may be replanned; None if no slew runs, or if its end is near."""
        point, followed = self.sample(now_ns), self._followed
        if point is None or followed is None or followed.slew is None or self._next is not None:
            return None
        if self._arrival_ns is None or now_ns < followed.begin_ns:
            return None
        if self._arrival_ns - now_ns < REST * (self._arrival_ns - self._slew_ns):
            return None
        return RunningSlew(followed.slew, (now_ns - followed.begin_ns) / SECOND_NS)

    def has_arrived(self, now_ns: int) -> bool:
        """Return whether a slew has ended since the last call."""
        over = self._arrival_ns is not None and now_ns >= self._arrival_ns
        if over:
            self._arrival_ns = None
        return over

    def sample(self, now_ns: int) -> PathPoint | None:
        """Return the planned motion at this time, or None if there is no path or the path has ended."""
        if self._next is not None and now_ns >= self._next.begin_ns:
            self._followed, self._next, self.off = self._next, None, 0.0
        followed = self._followed
        if followed is None:
            return None
        seconds, law = (now_ns - followed.origin_ns) / SECOND_NS, followed.law
        return PathPoint(self, law, now_ns, seconds) if seconds <= law.span[1] else None

    def attitude(self, target: PointingTarget, now_ns: int) -> FloatArray | None:
        """Return the planned attitude (4,) of a target, or None while no path to this target is followed."""
        point = self.sample(now_ns)
        if point is None or target != self._target:
            return None
        return point.law.wanted(point.seconds).quaternion

    def is_following(self, now_ns: int) -> bool:
        """Return whether a path is being followed."""
        return self.sample(now_ns) is not None

    def is_adrift(self, now_ns: int) -> bool:
        """Return False, because no attitude is held after the end of a path: the coils are then at zero."""
        return False

    def release(self) -> None:
        """Discard the path."""
        self._followed = self._next = self._target = self._arrival_ns = None
        self.astray.planned()


@dataclass(frozen=True, slots=True)
class PointingTargetLaw:
    """The planned attitude of a target as a function of time; implements `flight.loop.body.TargetLaw`."""

    target: PointingTarget
    paths: PointingPaths

    @property
    def text(self) -> str:
        """The target as text."""
        return self.target.text

    def quaternion(self, now_ns: int) -> FloatArray:
        """Return the attitude (4,), ICRS to body, with NaN before the first path to the target."""
        found = self.paths.attitude(self.target, now_ns)
        return np.full(4, np.nan) if found is None else found


def target_of(target: Target) -> PointingTarget:
    """Return the `PointingTarget` that a satellite's `Target` contains."""
    law = target.law
    assert isinstance(law, PointingTargetLaw), "the planner accepts only targets of a satellite"
    return law.target


class PointingTargets:
    """The configured and commanded targets of a satellite; implements `flight.loop.body.BodyTargets`."""

    def __init__(
        self, timed: Sequence[tuple[float, PointingTarget]], paths: PointingPaths, looks_for_objects: bool
    ) -> None:
        """Accept the configured targets in order of their mission times (s), which begin at 0."""
        self._looks_for_objects, self._paths = looks_for_objects, paths
        self._times = [round(at * 1e9) for at, _ in timed]
        self._steps = [Target(k, PointingTargetLaw(target, paths)) for k, (_, target) in enumerate(timed)]

    def configured(self, mission_time_ns: int) -> Target:
        """Return the configured target that is in force at a mission time."""
        return self._steps[max(bisect.bisect_right(self._times, mission_time_ns) - 1, 0)]

    def commanded(self, wanted: float | PointingTarget, number: int) -> Target:
        """Return the target `wanted` of the command with the number `number`.

        Raises UsageError for a q2, which only the testbed accepts.
        """
        if not isinstance(wanted, PointingTarget):
            raise UsageError("a satellite needs a pointing goal; a target q2 is for the testbed")
        if wanted.goal is Goal.OBJECT and not self._looks_for_objects:
            raise UsageError("the star camera does not search for objects: add `camera: {objects: {}}`")
        return Target(COMMANDED + number, PointingTargetLaw(wanted, self._paths))

    def hold_here(self, estimate: Estimate, now_ns: int) -> Target:
        """Return a target that keeps the present attitude."""
        qx, qy, qz, qw = estimate.quaternion.tolist()
        return Target(KEPT, PointingTargetLaw(PointingTarget(Goal.INERTIAL, (qx, qy, qz, qw)), self._paths))

    def can_hold(self, estimate: Estimate) -> bool:
        """Return True: averaged over an orbit, the coils can produce the torque that holds any attitude."""
        return True

    def speed(self, estimate: Estimate) -> float:
        """Return the rate, rad/s."""
        return float(np.linalg.norm(estimate.rate))

    def error(self, estimate: Estimate, target: Target) -> float:
        """Return the angle (rad) between body and target, or zero before there is a path."""
        wanted = target.law.quaternion(estimate.time_ns)
        return 0.0 if np.isnan(wanted[0]) else float(angle_between(estimate.quaternion, wanted))

    def error_when_due(self, estimate: Estimate, target: Target, now_ns: int) -> float | None:
        """Return None, because the arrival time depends on the magnetic field."""
        return None


EFFORT = 0.25
"""Dipole, as a fraction of the coils' limit, that has unit cost while the satellite follows an object."""
ROLL = math.radians(20.0)
"""Roll error (rad) about the boresight that has unit cost; the value is large, because roll hardly moves the
object in the image."""
RATE = math.radians(1.0)
"""Rate error (rad/s) that has unit cost, chosen because a fast roll blurs the stars at the edge of the
image."""
FORESIGHT = 30.0
"""Prediction time (s) of a track: an exit from the field of view within this time is reported."""


@dataclass(frozen=True, slots=True, eq=False)
class Sensor:
    """The star camera: boresight (3,), body axes, and angle (rad) from the boresight to the nearest edge."""

    boresight: FloatArray
    half_field: float


class ObjectAim:
    """Adapts the planner's jobs to an object that the satellite searches for or follows.

    The flag `seeks` states whether the target is an object, and `moved` whether its track has changed since
    the last plan.
    """

    def __init__(self, sensor: Sensor | None, limit: float, log: EventLog) -> None:
        """Start without an object; `sensor` is None if there is no search. `limit` (A m^2) limits dipoles."""
        self._sensor, self._limit, self._events = sensor, limit, log
        self._target: PointingTarget | None = None
        self._place: FloatArray | None = None
        self._tracks: tuple[Track, ...] = ()
        self._followed = 0
        self._escapes = self.seeks = self.moved = False

    def aim(self, target: PointingTarget) -> None:
        """Set the target."""
        if target == self._target:
            return
        self._target, self._place = target, None
        self._followed, self._escapes, self.moved = 0, False, False
        self.seeks = target.goal is Goal.OBJECT and self._sensor is not None

    def accept(self, tracks: Sequence[Track], now_ns: int) -> None:
        """Accept the confirmed tracks after a frame, and choose the track to follow."""
        self._tracks = tuple(tracks)
        if not self.seeks:
            return
        before = self._followed
        if self._track() is None:
            found = min(tracks, key=lambda track: np.nan_to_num(track.magnitude, nan=99.0), default=None)
            self._followed, self._escapes = 0 if found is None else found.number, False
            if found is not None:
                text = f"object {found.number}, brightness unknown"
                if math.isfinite(found.magnitude):
                    text = f"object {found.number}, V {found.magnitude:.1f} +- {found.magnitude_sigma:.1f}"
                self._events.report(events.OBJECT_FOLLOWED, now_ns, text)
            elif before:
                # Search again in the commanded direction, or where the camera points if none is commanded.
                self._place = None
        self.moved = self.moved or before > 0 or self._followed > 0

    def directed(self, job: PointingJob) -> PointingJob:
        """Return the job or, for an object as target, a job that points at its track or search direction."""
        sensor = self._sensor
        self.moved = False
        if not self.seeks or sensor is None:
            return job
        boresight = sensor.boresight
        axes = BodyAxes(boresight, np.eye(3)[int(np.argmin(np.abs(boresight)))])
        track = self._track()
        if track is None:
            place = self._searched(job.quaternion)
            # The cost weights refer to the boresight, because its direction matters more than the roll angle.
            weights = replace(job.weights, roll=ROLL, axis=boresight)
            return replace(
                job, axes=axes, weights=weights, slew=None, sight=ObjectDirection(place, np.zeros(3), 0.0)
            )
        line = track.line
        weights = replace(job.weights, dipole=EFFORT * self._limit, roll=ROLL, rate=RATE, axis=boresight)
        since = (line.time_ns - job.origin_ns) / SECOND_NS
        sight = ObjectDirection(line.direction, line.velocity, since)
        return replace(job, axes=axes, weights=weights, slew=None, sight=sight)

    def judge(self, job: PointingJob, table: PointingTable, now_ns: int) -> None:
        """Report an event if, along the path in `table`, the object will leave the field of view."""
        sensor, sight = self._sensor, job.sight
        if sensor is None or sight is None or not sight.velocity.any():
            return
        near = table.path.times <= FORESIGHT
        shown, wanted = (
            attitude_matrix(motion.quaternion[near]).transpose(0, 2, 1) @ sensor.boresight
            for motion in (table.path, table.wanted)
        )
        off = np.arccos(np.clip(np.sum(shown * wanted, axis=1), -1.0, 1.0))
        outside = np.flatnonzero(off > sensor.half_field)
        if len(outside) and not self._escapes:
            first = int(outside[0])
            fastest, needed, made = np.degrees(
                [
                    np.linalg.norm(values[near], axis=1).max()
                    for values in (table.wanted.rate, table.wanted.acceleration, table.path.acceleration)
                ]
            )
            text = (
                f"object {self._followed} leaves the field of view in {table.path.times[first]:.0f} s: "
                f"it needs {fastest:.2f} deg/s and {needed:.4f} deg/s^2, the body reaches {made:.4f} deg/s^2"
            )
            self._events.report(events.OBJECT_ESCAPES, now_ns, text)
        self._escapes = bool(len(outside))

    def _track(self) -> Track | None:
        """Return the track that is followed, or None if no track is followed or the track has ended."""
        return next((track for track in self._tracks if track.number == self._followed > 0), None)

    def _searched(self, quaternion: FloatArray) -> FloatArray:
        """Return the commanded search direction (3,), or the camera's direction when the search began."""
        if self._place is None:
            assert self._target is not None
            assert self._sensor is not None
            if self._target.numbers:
                right, up = self._target.numbers
                across = math.cos(up)
                place = [across * math.cos(right), across * math.sin(right), math.sin(up)]
                self._place = np.array(place)
            else:
                self._place = attitude_matrix(quaternion).T @ self._sensor.boresight
        return self._place


AGAIN_NS = 10_000_000_000
"""Time (ns) until the next planning request after a failed plan, or while the orbit is unknown."""
REST_AGAIN_NS = 5_000_000_000
"""Shortest time (ns) between two plans for the remainder of a slew."""
MOST_WAITS = 4
"""Longest time, in units of `REST_AGAIN_NS`, until the remainder of a slew is planned again. The time grows
by one unit with each plan that does not improve the present plan, because most later plans do not improve it
either. If a coil fails or is used again, the remainder of the slew is planned at once."""
_SMALLEST = 0.5
"""Smallest plausible principal moment of inertia, relative to the smallest configured moment."""


@dataclass(frozen=True, slots=True, eq=False)
class LearnedBody:
    """Properties of the body, estimated by the filter, that the planner uses.

    Attributes:
        inertia: inertia tensor (3, 3) in body axes, kg m^2.
        sizes: amplitudes (9,) of the disturbance torques, N m.
        residual: residual dipole (3,), A m^2.
    """

    inertia: FloatArray
    sizes: FloatArray
    residual: FloatArray


ACROSS = 0.03
"""Limit for slews with only two usable coils: largest dipole moment normal to the plane of the coils, as a
fraction of the weakest coil's dipole moment. The limit reduces the torque little, because a dipole moment in
the plane of the two coils can produce nearly every possible torque."""


@dataclass(frozen=True, slots=True, eq=False)
class PlannedCraft:
    """The planner's model of the satellite, with the inertia tensor (3, 3), kg m^2, in body axes.

    The coils are driven in the fraction `duty` of a control window; `slew` contains the constraints of slews.
    """

    inertia: FloatArray
    axes: BodyAxes
    weights: PointingWeights
    coils: CoilMap
    duty: float
    slew: SlewRequest


class PointingPlanner:
    """Requests plans from the planner worker; implements `flight.loop.body.Planner`."""

    def __init__(
        self,
        craft: PlannedCraft,
        paths: PointingPaths,
        environment: EstimatedEnvironment,
        learned: Callable[[], LearnedBody],
        usable: Callable[[], BoolArray],
        objects: ObjectAim,
        services: Services,
    ) -> None:
        """Start without a plan.

        `learned` returns body properties, `usable` returns the flags of coils in use.
        """
        self._craft, self._paths, self._environment = craft, paths, environment
        self._learned, self._usable, self._objects = learned, usable, objects
        self._areas = box_areas(craft.inertia)
        self._smallest = _SMALLEST * float(np.linalg.eigvalsh(craft.inertia)[0])
        self._jobs, self._events = services.jobs, services.events
        self._job: PointingJob | None = None
        self._planned_with = usable()
        self._wanted = self._held = False
        self._after_ns = self._count = self._accepted = self._refused = self._unimproved = 0

    def busy_since_ns(self) -> int | None:
        """Return the time (ns) at which the worker began its plan, or None while the worker is idle."""
        return None if self._job is None else self._job.origin_ns

    def aim(self, target: Target, now_ns: int) -> None:
        """Request a plan for a new target; the present path is followed until the plan arrives."""
        self._wanted, self._after_ns = True, now_ns

    def request(self, now_ns: int) -> None:
        """Request a plan."""
        self._wanted = True

    def resume(self, now_ns: int) -> None:
        """Do nothing, because the path continues while the coils are not controlled."""

    def replan(self, cycle: Cycle) -> None:
        """Request the periodic plan; called by the replanning rate group."""
        self._wanted = True

    def serve(self, estimate: Estimate | None, target: Target, now_ns: int) -> None:
        """Submit the requested job to the worker, if it is due."""
        goal, astray = target_of(target), self._paths.astray
        self._objects.aim(goal)
        if astray.since is not None:
            if not self._held:
                degrees = math.degrees(self._paths.off)
                text = (
                    f"the attitude is {degrees:.0f} deg from its path: damping the rotation before a new plan"
                )
                self._events.report(events.ASTRAY, now_ns, text)
            self._held = True
            if not astray.ready:
                return
        elif self._paths.is_slewing(now_ns, goal):
            if estimate is not None and self._job is None and self._rest_is_due(now_ns):
                self._plan_rest(estimate, goal, now_ns)
            return
        if self._paths.has_arrived(now_ns):
            text = f"{math.degrees(self._paths.off):.2f} deg from its path"
            self._events.report(events.SLEW_ENDED, now_ns, text)
            self._wanted = True
        wanted = self._wanted or astray.ready or astray.leaving or self._objects.moved
        if estimate is None or not wanted or self._job is not None or now_ns < self._after_ns:
            return
        try:
            job = self._new_job(estimate, goal, now_ns)
        except UsageError as error:
            self._fail(f"no plan: {error}", now_ns)
            return
        if job is None:
            self._fail("no plan: the orbit is not known", now_ns)
            return
        # Without a slew: disturbance torques along the field move the body off a reached target only
        # temporarily.
        if self._paths.astray.since is None and self._paths.attitude(goal, now_ns) is not None:
            job = replace(job, slew=None)
        job = self._objects.directed(job)
        if self._jobs.submit(PLANNER, job):
            self._wanted, self._job, self._count = False, job, job.number
            self._after_ns = now_ns + (AGAIN_NS if job.span is STEADY else 0)

    def _rest_is_due(self, now_ns: int) -> bool:
        return now_ns >= self._after_ns or not np.array_equal(self._usable(), self._planned_with)

    def _plan_rest(self, estimate: Estimate, goal: PointingTarget, now_ns: int) -> None:
        """Submit a job that plans the remainder of the running slew, unless the slew is near its end."""
        running = self._paths.running(now_ns)
        job = None
        with suppress(UsageError):  # the running plan is kept
            job = None if running is None else self._new_job(estimate, goal, now_ns)
        if job is not None and self._jobs.submit(PLANNER, job := replace(job, running=running)):
            self._job, self._count = job, job.number
            self._after_ns = now_ns + REST_AGAIN_NS

    def _new_job(self, estimate: Estimate, goal: PointingTarget, now_ns: int) -> PointingJob | None:
        """Return a job, or None if the orbit is unknown. Raises UsageError for parallel usable coils."""
        orbit, craft = self._environment.state(now_ns), self._craft
        if orbit is None:
            return None
        learned = self._learned()
        usable, duty = self._usable(), craft.duty
        self._planned_with = usable
        limit, slewing = craft.coils.working(usable).limits, craft.coils.working(usable, ACROSS)
        wish = replace(craft.slew, residual=learned.residual, heat=slewing.heat, limit=duty * slewing.limits)
        # A physically impossible inertia tensor is not used.
        is_plausible = float(np.linalg.eigvalsh(learned.inertia)[0]) > self._smallest
        return PointingJob(
            self._count + 1,
            now_ns,
            orbit,
            learned.inertia if is_plausible else craft.inertia,
            craft.axes,
            craft.weights,
            goal,
            estimate.quaternion,
            estimate.rate,
            learned.sizes,
            duty * limit,
            self._areas,
            wish,
        )

    def finish(self, result: JobResult, now_ns: int) -> None:
        """Fly the worker's plan."""
        job, self._job = self._job, None
        if job is None:
            return
        if result.outcome != "done":
            self._fail(f"plan {job.number}: {result.outcome}: {result.error}", now_ns)
        elif job.running is not None:
            self._continue(job, result.value, now_ns)
        elif self._paths.astray.since is not None and not self._paths.astray.ready:
            self._wanted = True  # replace a plan that was requested before the damping
        elif reason := self._paths.offer(result.value, job.target, job.origin_ns):
            self._fail(f"plan {job.number}: {reason}", now_ns, AGAIN_NS if job.span is STEADY else 0)
        else:
            self._accepted, self._held, self._unimproved = self._accepted + 1, False, 0
            self._objects.judge(job, result.value, now_ns)
            if (slew := result.value.slew) is not None:
                fastest = math.degrees(float(np.linalg.norm(slew.rate, axis=1).max()))
                text = f"to {job.target.text} in {slew.horizon:.0f} s, {fastest:.2f} deg/s at most"
                self._events.report(events.SLEW_BEGUN, now_ns, text)

    def _continue(self, job: PointingJob, table: PointingTable | None, now_ns: int) -> None:
        """Follow a new plan for the remainder of the slew; if there is none, keep the present plan."""
        paths = self._paths
        self._unimproved = 0 if table is not None else self._unimproved + 1
        self._after_ns = job.origin_ns + min(1 + self._unimproved, MOST_WAITS) * REST_AGAIN_NS
        if table is None or paths.astray.since is not None or not paths.is_slewing(now_ns, job.target):
            return
        if reason := paths.offer(table, job.target, job.origin_ns, continues=True):
            self._fail(f"plan {job.number}: {reason}", now_ns)
        else:
            self._accepted += 1

    def counts(self) -> tuple[int, int]:
        """Return how many plans were accepted, and how many were rejected, since the start."""
        return self._accepted, self._refused

    def _fail(self, text: str, now_ns: int, wait_ns: int = AGAIN_NS) -> None:
        """Report a plan that cannot be followed, and request another plan after `wait_ns`."""
        self._refused += 1
        self._wanted, self._after_ns = True, now_ns + wait_ns
        self._events.report(events.PLANNER_FAILED, now_ns, text)
