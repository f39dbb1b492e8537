"""The parts of a body that is not steered to an attitude: it brakes its tumble, or rests.

Such a body has no mode of `flight.link.modes.STEERING`, so nothing asks its planner for a path.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flight.gnc.errors import UsageError
from flight.gnc.estimation.estimate import Estimate
from flight.gnc.guidance.three_axes.pointing_target import PointingTarget
from flight.gnc.math.arrays import FloatArray
from flight.link.modes import STEERING, Mode
from flight.loop.control_output import CoilCommand, Target
from flight.loop.executive.jobs import JobResult
from flight.loop.executive.rate_group import Cycle

MODES = frozenset(Mode) - STEERING
"""The modes of a body that is not steered."""
_NOTHING: FloatArray = np.zeros(3)


class Unsteered:
    """Implements `Paths`, `Planner`, `Targets` and `Tracker` of `flight.loop.body`: no path, no target."""

    def sample(self, now_ns: int) -> Any | None:
        """Return None: there is no path."""
        return None

    def is_following(self, now_ns: int) -> bool:
        """Return False: no path is followed."""
        return False

    def is_adrift(self, now_ns: int) -> bool:
        """Return False: no attitude is held."""
        return False

    def release(self) -> None:
        """Discard the path: there is none."""

    def busy_since_ns(self) -> int | None:
        """Return None: nothing is planned."""
        return None

    def aim(self, target: Target, now_ns: int) -> None:
        """Plan nothing."""

    def request(self, now_ns: int) -> None:
        """Plan nothing."""

    def resume(self, now_ns: int) -> None:
        """Plan nothing."""

    def replan(self, cycle: Cycle) -> None:
        """Plan nothing."""

    def serve(self, estimate: Estimate | None, target: Target, now_ns: int) -> None:
        """Submit nothing."""

    def finish(self, result: JobResult, now_ns: int) -> None:
        """Accept nothing."""

    def counts(self) -> tuple[int, int]:
        """Return that no plan was accepted or refused."""
        return 0, 0

    def configured(self, mission_time_ns: int) -> Target:
        """Raise UsageError: there are no targets."""
        raise UsageError("this body is not steered: it has no targets")

    def commanded(self, wanted: float | PointingTarget, number: int) -> Target:
        """Raise UsageError: there are no targets."""
        raise UsageError("this body is not steered: it has no targets")

    def hold_here(self, estimate: Estimate, now_ns: int) -> Target:
        """Raise UsageError: there are no targets."""
        raise UsageError("this body is not steered: it has no targets")

    def can_hold(self, estimate: Estimate) -> bool:
        """Return False: no attitude can be held."""
        return False

    def speed(self, estimate: Estimate) -> float:
        """Return the rate, rad/s."""
        return float(np.linalg.norm(estimate.rate))

    def error(self, estimate: Estimate, target: Target) -> float:
        """Return 0: there are no targets."""
        return 0.0

    def error_when_due(self, estimate: Estimate, target: Target, now_ns: int) -> float | None:
        """Return None: nothing is due."""
        return None

    def command(self, estimate: Estimate, reference: Any) -> CoilCommand:
        """Return no current."""
        return CoilCommand(_NOTHING, _NOTHING)

    def reset(self) -> None:
        """Forget nothing."""
