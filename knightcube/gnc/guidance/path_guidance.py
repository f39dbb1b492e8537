"""Guidance about one axis, which checks plans, follows the last accepted path and holds its end attitude.

A plan is rejected if it arrives late or out of order, contains values that are not finite, exceeds the
limits, leads to another target, or does not start at the estimated state. The rejection states the reason. A
rejected plan does not change the commanded motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from knightcube.errors import UsageError
from knightcube.gnc.guidance.plant import Q2_LIMIT, PathSample, PolynomialPath, SingleAxisPlant, q2_of
from knightcube.gnc.guidance.vmc import StepPlan

_CHECKED_POINTS = 600
_SAME = 1e-6
"""Largest accepted difference between the end of a path and the target, both in the quaternion component q2
and in the rate (rad/s)."""


class GuidanceState(StrEnum):
    """The kind of motion that `PathGuidance` commands: a path, a held attitude, or no motion."""

    NONE = "none"
    FOLLOWING = "following"
    HOLDING = "holding"


@dataclass(frozen=True, slots=True)
class AcceptanceRules:
    """The conditions for the acceptance of a plan.

    Attributes:
        late_after: longest accepted delay of a plan, from the start time of its path to its arrival, s.
        angle_tolerance: largest difference between the start angle of a plan and the estimated angle, rad.
        rate_tolerance: largest difference between the start rate of a plan and the estimated rate, rad/s.
        q2_limit: upper bound of |q2|, which a path may exceed by 0.1 %.
        current_excess: largest excess of a path over the plant's current limit, as a fraction of the limit.
    """

    late_after: float
    angle_tolerance: float = 0.05
    rate_tolerance: float = 0.02
    q2_limit: float = Q2_LIMIT
    current_excess: float = 1e-3

    def __post_init__(self) -> None:
        """Raise UsageError for a limit that is not positive and finite."""
        for name in ("late_after", "angle_tolerance", "rate_tolerance", "q2_limit", "current_excess"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise UsageError(f"guidance {name} is {value}: it must be finite and positive")


@dataclass(frozen=True, slots=True)
class PlanVerdict:
    """Whether a plan was accepted.

    The text `reason` states why a plan was rejected, and is empty for an accepted plan.
    """

    accepted: bool
    reason: str = ""


class PathGuidance:
    """The guidance that follows accepted paths towards the current target."""

    def __init__(self, plant: SingleAxisPlant, rules: AcceptanceRules, arrives: bool = True) -> None:
        """Set up the guidance, which checks plans with the model `plant` and the acceptance rules.

        If `arrives` is true, paths must end at the target attitude, which is then held. If `arrives` is
        false, later plans normally replace a path before its end, so the path may end at another attitude.
        """
        self._plant = plant
        self._rules = rules
        self._arrives = arrives
        self._path: PolynomialPath | None = None
        self._sampled: tuple[PolynomialPath, int, PathSample] | None = None
        self._planned_ns: int | None = None
        self._target_q2: float | None = None
        self._target_rate = 0.0
        self._aimed_ns = 0

    @property
    def target_q2(self) -> float | None:
        """The target attitude as quaternion component q2, or None before the first target."""
        return self._target_q2

    @property
    def path(self) -> PolynomialPath | None:
        """The path that is followed or whose end attitude is held, or None if there is no path."""
        return self._path

    def aim(self, target_q2: float, target_rate: float = 0.0, now_ns: int = 0) -> None:
        """Set the target attitude and rate (rad/s); the present path is followed until a plan is accepted.

        Raises UsageError if a value is not finite or |target_q2| exceeds `AcceptanceRules.q2_limit`.
        """
        if not abs(target_q2) <= self._rules.q2_limit:  # NaN compares false
            raise UsageError(f"target q2 is {target_q2}: it must lie within +-{self._rules.q2_limit}")
        if not math.isfinite(target_rate):
            raise UsageError(f"target rate is {target_rate}: it must be finite")
        self._target_q2 = target_q2
        self._target_rate = target_rate
        self._aimed_ns = now_ns

    def hold(self, angle: float, now_ns: int) -> None:
        """Command the attitude `angle` (rad) from now on, and reject plans that start before `now_ns`.

        Raises UsageError when the angle is not finite.
        """
        if not math.isfinite(angle):
            raise UsageError(f"the angle to hold is {angle}: it must be finite")
        self._path = PolynomialPath.holding(angle, now_ns)
        self._planned_ns = now_ns - 1

    def release(self) -> None:
        """Stop following a path until the next accepted plan or the next call of `hold`."""
        self._path = None
        self._planned_ns = None

    def offer(
        self,
        plan: StepPlan,
        origin_ns: int,
        now_ns: int,
        estimate_angle: float,
        estimate_rate: float,
        disturbance: float = 0.0,
    ) -> PlanVerdict:
        """If `plan` satisfies the acceptance rules, follow its path from `origin_ns` on.

        The arguments `estimate_angle` (rad) and `estimate_rate` (rad/s) are the state at the start of the
        path. The current limit is checked for the estimated `disturbance` (rad/s^2).
        """
        reason = (
            self._untimely(origin_ns, now_ns)
            or self._unwanted(plan)
            or self._unflyable(plan.path, replace(self._plant, disturbance=disturbance))
            or self._displaced(plan.path, estimate_angle, estimate_rate)
        )
        if reason:
            return PlanVerdict(False, reason)
        self._path = plan.path.starting_at(origin_ns)
        self._planned_ns = origin_ns
        return PlanVerdict(True)

    def sample(self, now_ns: int) -> PathSample | None:
        """Return the commanded motion at `now_ns`, or None if there is no path."""
        path = self._path
        if path is None:
            return None
        # A control cycle requests the sample of the same instant several times.
        if self._sampled is None or self._sampled[0] is not path or self._sampled[1] != now_ns:
            self._sampled = path, now_ns, path.sample(now_ns)
        return self._sampled[2]

    def state(self, now_ns: int) -> GuidanceState:
        """Return the kind of the commanded motion at `now_ns`."""
        if self._path is None:
            return GuidanceState.NONE
        return GuidanceState.HOLDING if self._path.has_ended(now_ns) else GuidanceState.FOLLOWING

    def is_following(self, now_ns: int) -> bool:
        """Return whether a path is being followed and has not yet ended."""
        return self.state(now_ns) is GuidanceState.FOLLOWING

    def is_adrift(self, now_ns: int) -> bool:
        """Return whether an attitude is held because the path has ended and no new plan arrived in time."""
        if self._path is None or not self._path.has_ended(now_ns):
            return False
        if not self._arrives and self._path.horizon > 0.0:
            return True
        waited = (now_ns - self._aimed_ns) * 1e-9
        return not self._reaches_target(self._path) and waited > self._rules.late_after

    def remains(self, now_ns: int) -> PolynomialPath | None:
        """Return the path being followed to the target, with its origin relative to `now_ns`, or None."""
        path = self._path
        if path is None or path.has_ended(now_ns) or not self._reaches_target(path):
            return None
        return path.starting_at(path.origin_ns - now_ns)

    def _reaches_target(self, path: PolynomialPath) -> bool:
        if self._target_q2 is None:
            return False
        near = abs(q2_of(path.end_angle) - self._target_q2) <= _SAME
        return near and abs(path.end_rate - self._target_rate) <= _SAME

    def _untimely(self, origin_ns: int, now_ns: int) -> str:
        age = (now_ns - origin_ns) * 1e-9
        if age < 0.0:
            return f"the plan starts {-age:.3f} s in the future"
        if age > self._rules.late_after:
            return f"the plan is late: it started {age:.3f} s ago, {self._rules.late_after} s are allowed"
        if self._planned_ns is not None and origin_ns <= self._planned_ns:
            return "out of order: not newer than the path in use"
        return ""

    def _unwanted(self, plan: StepPlan) -> str:
        if self._target_q2 is None:
            return "no target is set"
        if not (abs(plan.target_q2 - self._target_q2) <= _SAME and self._reaches_target(plan.path)):
            ends = f"q2 {q2_of(plan.path.end_angle):.4f} at {plan.path.end_rate:.4f} rad/s"
            return f"it ends at {ends}, the target is {self._target_q2:.4f} at {self._target_rate:.4f} rad/s"
        return ""

    def _unflyable(self, path: PolynomialPath, plant: SingleAxisPlant) -> str:
        if not (math.isfinite(path.horizon) and path.horizon > 0.0):
            return f"not finite: its horizon is {path.horizon} s"
        # The path is checked until just before its end, because the held attitude begins exactly at the end.
        times = path.horizon * np.linspace(0.0, 1.0 - 1e-12, _CHECKED_POINTS)
        angle, rate, acceleration = path.motion(times)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            current = plant.currents(angle, rate, acceleration)
            peak_q2 = float(np.abs(np.sin(0.5 * angle)).max())
        peak = float(np.abs(current).max())
        if not (math.isfinite(peak) and math.isfinite(peak_q2)):
            return "not finite somewhere along the path"
        if peak > plant.current_limit * (1.0 + self._rules.current_excess):
            return f"needs {peak:.4f} A, the limit is {plant.current_limit} A"
        if peak_q2 > self._rules.q2_limit * (1.0 + 1e-3):
            return f"reaches |q2| {peak_q2:.4f}, the limit is {self._rules.q2_limit}"
        return ""

    def _displaced(self, path: PolynomialPath, angle: float, rate: float) -> str:
        start = path.sample(path.origin_ns)
        if not abs(start.angle - angle) <= self._rules.angle_tolerance:
            return f"starts at {start.angle:.4f} rad, the body was at {angle:.4f} rad"
        if not abs(start.rate - rate) <= self._rules.rate_tolerance:
            return f"starts at {start.rate:.4f} rad/s, the body moved at {rate:.4f} rad/s"
        return ""
