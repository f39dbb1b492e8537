"""The targets of the testbed: steps of q2 over mission time, commanded slews, attitudes that are held."""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass

from flight.bodies.testbed.planning import Planning
from flight.bodies.testbed.thread_estimate import ThreadReader
from flight.bodies.testbed.thread_law import ThreadLaw, law_of
from flight.loop.control_output import COMMANDED, KEPT, Target
from knightcube.errors import UsageError
from knightcube.gnc.estimation.estimate import Estimate
from knightcube.gnc.guidance.one_axis.guidance import PathGuidance
from knightcube.gnc.guidance.one_axis.plant import Q2_LIMIT, angle_of
from knightcube.gnc.guidance.three_axes.pointing_target import PointingTarget


@dataclass(frozen=True, slots=True)
class TimedStep:
    """From mission time `at` s on reach `q2` at `rate` rad/s."""

    at: float
    q2: float
    rate: float


class ThreadTargets:
    """Implements `flight.loop.body.Targets`."""

    def __init__(
        self, steps: Sequence[TimedStep], reader: ThreadReader, guidance: PathGuidance, planning: Planning
    ) -> None:
        """Take the configured steps in order of time; the first is at 0."""
        self._steps = [Target(i, ThreadLaw(step.q2, step.rate)) for i, step in enumerate(steps)]
        self._times = [round(step.at * 1e9) for step in steps]
        self._read = reader.read
        self._guidance = guidance
        self._planning = planning

    def configured(self, mission_time_ns: int) -> Target:
        """Return the configured target in force at a mission time."""
        return self._steps[max(bisect.bisect_right(self._times, mission_time_ns) - 1, 0)]

    def commanded(self, wanted: float | PointingTarget, number: int) -> Target:
        """Return the target of slew `number` to q2 `wanted`. Raises UsageError beyond the limit."""
        if isinstance(wanted, PointingTarget):
            raise UsageError("the testbed goes to a q2, not to a direction")
        if not abs(wanted) <= Q2_LIMIT:  # NaN compares false
            raise UsageError(f"q2 {wanted} is not within +-{Q2_LIMIT}")
        return Target(COMMANDED + number, ThreadLaw(wanted))

    def hold_here(self, estimate: Estimate, now_ns: int) -> Target:
        """Hold the present angle, within the limit; return it as a target."""
        q2 = min(max(self._read(estimate).q2, -Q2_LIMIT), Q2_LIMIT)
        self._guidance.hold(angle_of(q2), now_ns)
        return Target(KEPT, ThreadLaw(q2))

    def can_hold(self, estimate: Estimate) -> bool:
        """Return whether the coil has authority where the body is."""
        return abs(self._read(estimate).q2) < Q2_LIMIT

    def speed(self, estimate: Estimate) -> float:
        """Return the rate about the thread, rad/s, not negative."""
        return abs(self._read(estimate).rate)

    def error(self, estimate: Estimate, target: Target) -> float:
        """Return the angle between body and target, rad."""
        return self._off(estimate, angle_of(law_of(target).q2))

    def error_when_due(self, estimate: Estimate, target: Target, now_ns: int) -> float | None:
        """Return the angle to the attitude due by now, rad; None before one is due."""
        due = self._planning.due_angle(law_of(target), now_ns)
        return None if due is None else self._off(estimate, due)

    def _off(self, estimate: Estimate, wanted: float) -> float:
        return abs(math.remainder(wanted - self._read(estimate).angle, 2.0 * math.pi))
