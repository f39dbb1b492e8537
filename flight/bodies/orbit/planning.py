"""Planning of a satellite: requests tables of the pointing law from the planner worker.

A table is made when a target is set, when the attitude is known again, where the body leaves its path, and
periodically: the orbit's prediction ages, and a free roll follows the body's own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from flight.bodies.orbit.object_aim import ObjectAim
from flight.bodies.orbit.paths import PointingPaths
from flight.bodies.orbit.surroundings import Surroundings
from flight.bodies.orbit.targets import target_of
from flight.link import events
from flight.loop.body import PLANNER
from flight.loop.control_output import Target
from flight.loop.executive.jobs import JobResult
from flight.loop.executive.rate_group import Cycle
from flight.loop.services import Services
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.control.three_axes.pointing_job import STEADY, PointingJob, SlewRequest
from knightcube.gnc.control.three_axes.pointing_table import PointingWeights
from knightcube.gnc.estimation.estimate import Estimate
from knightcube.gnc.guidance.three_axes.attitude_law import BodyAxes
from knightcube.gnc.guidance.three_axes.pointing_target import PointingTarget

AGAIN_NS = 10_000_000_000
"""After a plan that failed, or while no orbit is known, the next is asked for after this time."""


@dataclass(frozen=True, slots=True, eq=False)
class PlannedCraft:
    """What the planner believes of the craft.

    `inertia` (3, 3) kg m^2, body axes; `limit` A m^2 of each coil, mean over a window of pause and action;
    `slew` is how slews are wanted.
    """

    inertia: FloatArray
    axes: BodyAxes
    weights: PointingWeights
    limit: float
    slew: SlewRequest


class PointingPlanner:
    """Implements `flight.loop.body.Planner`."""

    def __init__(
        self,
        craft: PlannedCraft,
        paths: PointingPaths,
        surroundings: Surroundings,
        disturbed: Callable[[], tuple[FloatArray, FloatArray]],
        objects: ObjectAim,
        services: Services,
    ) -> None:
        """`disturbed` returns what is estimated now: torques (9,) N m and residual dipole (3,) A m^2."""
        self._craft, self._paths, self._surroundings = craft, paths, surroundings
        self._disturbed, self._objects = disturbed, objects
        self._jobs, self._events = services.jobs, services.events
        self._job: PointingJob | None = None
        self._wanted = self._held = False
        self._after_ns = 0
        self._count = self._accepted = self._refused = 0

    def busy_since_ns(self) -> int | None:
        """Return since when the worker has been planning, None while idle."""
        return None if self._job is None else self._job.origin_ns

    def aim(self, target: Target, now_ns: int) -> None:
        """Request a plan for a new target; the present path is flown until then."""
        self._wanted, self._after_ns = True, now_ns

    def request(self, now_ns: int) -> None:
        """Request a plan."""
        self._wanted = True

    def resume(self, now_ns: int) -> None:
        """Do nothing: the path goes on while there is no control."""

    def replan(self, cycle: Cycle) -> None:
        """Request the periodic plan: the task of the replanning rate group."""
        self._wanted = True

    def serve(self, estimate: Estimate | None, target: Target, now_ns: int) -> None:
        """Submit the requested job to the worker."""
        goal, astray = target_of(target), self._paths.astray
        self._objects.aim(goal)
        if astray.since is not None:
            self._hold_still(now_ns)
            if not astray.ready:
                return
        elif self._paths.is_slewing(now_ns, goal):
            return  # the rest of a slew planned again costs many times its heat
        if self._paths.has_arrived(now_ns):
            text = f"{math.degrees(self._paths.off):.2f} deg off its path"
            self._events.report(events.SLEW_ENDED, now_ns, text)
            self._wanted = True
        wanted = self._wanted or astray.ready or astray.leaving or self._objects.moved
        if estimate is None or not wanted or self._job is not None or now_ns < self._after_ns:
            return
        orbit, craft = self._surroundings.state(now_ns), self._craft
        if orbit is None:
            self._fail("no plan: the orbit is not known", now_ns)
            return
        sizes, residual = self._disturbed()
        job = PointingJob(
            self._count + 1,
            now_ns,
            orbit,
            craft.inertia,
            craft.axes,
            craft.weights,
            goal,
            estimate.quaternion,
            estimate.rate,
            sizes,
            craft.limit,
            self._slew(goal, residual, now_ns),
        )
        job = self._objects.directed(job)
        if self._jobs.submit(PLANNER, job):
            self._wanted, self._job, self._count = False, job, job.number
            self._after_ns = now_ns + (AGAIN_NS if job.span is STEADY else 0)

    def _slew(self, goal: PointingTarget, residual: FloatArray, now_ns: int) -> SlewRequest | None:
        """Return how a slew to a goal is wanted; None for a body on a path to it.

        A path leaves its goal for a time where it meets torques along the field: no reason for a slew.
        """
        on_path = self._paths.astray.since is None and self._paths.attitude(goal, now_ns) is not None
        return None if on_path else replace(self._craft.slew, residual=residual)

    def _hold_still(self, now_ns: int) -> None:
        """Report once that the body is held still."""
        if not self._held:
            text = f"{math.degrees(self._paths.off):.0f} deg off its path: held still, then planned for"
            self._events.report(events.ASTRAY, now_ns, text)
        self._held = True

    def finish(self, result: JobResult, now_ns: int) -> None:
        """Fly the worker's plan."""
        job, self._job = self._job, None
        if job is None:
            return
        if result.outcome != "done":
            self._fail(f"plan {job.number}: {result.outcome}: {result.error}", now_ns)
        elif self._paths.astray.since is not None and not self._paths.astray.ready:
            self._wanted = True  # planned before the body went astray: another one once it is slow
        elif reason := self._paths.offer(result.value, job.target, job.origin_ns):
            self._fail(f"plan {job.number}: {reason}", now_ns, AGAIN_NS if job.span is STEADY else 0)
        else:
            self._accepted, self._held = self._accepted + 1, False
            self._objects.judge(job, result.value, now_ns)
            if (slew := result.value.slew) is not None:
                fastest = math.degrees(float(np.linalg.norm(slew.rate, axis=1).max()))
                text = f"to {job.target.text} in {slew.horizon:.0f} s, {fastest:.2f} deg/s at most"
                self._events.report(events.SLEW_BEGUN, now_ns, text)

    def counts(self) -> tuple[int, int]:
        """Return how many plans were accepted and refused since the start."""
        return self._accepted, self._refused

    def _fail(self, text: str, now_ns: int, wait_ns: int = AGAIN_NS) -> None:
        """Report a plan that is not flown, and ask for another one after `wait_ns`: none for an object."""
        self._refused += 1
        self._wanted, self._after_ns = True, now_ns + wait_ns
        self._events.report(events.PLANNER_FAILED, now_ns, text)
