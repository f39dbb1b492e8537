"""The targets of a satellite: those of the configuration over mission time, and commanded ones."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flight.bodies.orbit.paths import PointingPaths
from flight.loop.control_output import COMMANDED, KEPT, Target
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import angle_between
from knightcube.errors import UsageError
from knightcube.gnc.estimation.estimate import Estimate
from knightcube.gnc.guidance.three_axes.pointing_target import Goal, PointingTarget


@dataclass(frozen=True, slots=True)
class PointingLawOf:
    """The attitude of a target over time, by the path that is flown to it; implements `AttitudeLaw`."""

    target: PointingTarget
    paths: PointingPaths

    @property
    def text(self) -> str:
        """The target as text."""
        return self.target.text

    def quaternion(self, now_ns: int) -> FloatArray:
        """Return the attitude (4,), ICRS into body; NaN before the first path to the target."""
        found = self.paths.attitude(self.target, now_ns)
        return np.full(4, np.nan) if found is None else found


def target_of(target: Target) -> PointingTarget:
    """Return the pointing target of a target of this body."""
    law = target.law
    assert isinstance(law, PointingLawOf), "only the satellite's own targets reach its planner"
    return law.target


class PointingTargets:
    """Implements `flight.loop.body.Targets`."""

    def __init__(
        self, timed: Sequence[tuple[float, PointingTarget]], paths: PointingPaths, looks_for_objects: bool
    ) -> None:
        """Take the configured targets, each with its mission time in s, in order; the first is at 0."""
        self._looks_for_objects = looks_for_objects
        self._paths = paths
        self._times = [round(at * 1e9) for at, _ in timed]
        self._steps = [Target(k, PointingLawOf(target, paths)) for k, (_, target) in enumerate(timed)]

    def configured(self, mission_time_ns: int) -> Target:
        """Return the configured target in force at a mission time."""
        return self._steps[max(bisect.bisect_right(self._times, mission_time_ns) - 1, 0)]

    def commanded(self, wanted: float | PointingTarget, number: int) -> Target:
        """Return the target of command `number`. Raises UsageError for a q2."""
        if not isinstance(wanted, PointingTarget):
            raise UsageError("a satellite points to a goal, not to a q2")
        if wanted.goal is Goal.OBJECT and not self._looks_for_objects:
            raise UsageError("no star camera looks for objects: `camera: {star_tracker: {}, objects: {}}`")
        return Target(COMMANDED + number, PointingLawOf(wanted, self._paths))

    def hold_here(self, estimate: Estimate, now_ns: int) -> Target:
        """Return the present attitude as a target."""
        qx, qy, qz, qw = estimate.quaternion.tolist()
        return Target(KEPT, PointingLawOf(PointingTarget(Goal.INERTIAL, (qx, qy, qz, qw)), self._paths))

    def can_hold(self, estimate: Estimate) -> bool:
        """Return True: every attitude can be held in the mean over a revolution."""
        return True

    def speed(self, estimate: Estimate) -> float:
        """Return the rate, rad/s."""
        return float(np.linalg.norm(estimate.rate))

    def error(self, estimate: Estimate, target: Target) -> float:
        """Return the angle between body and target, rad; zero before there is a path."""
        wanted = target.law.quaternion(estimate.time_ns)
        return 0.0 if np.isnan(wanted[0]) else float(angle_between(estimate.quaternion, wanted))

    def error_when_due(self, estimate: Estimate, target: Target, now_ns: int) -> float | None:
        """Return None: coils alone reach a target when the field allows."""
        return None
