"""A PID controller of the angle about the thread, for comparison (Sease 2013, ch. 5: 0.15 W on the testbed).

The gains are free, or place three poles of a double integrator at -w: 3 w, 3 w^2 and w^3 on rate, angle and
its integral. The reference enters the proportional part with a weight b (two degrees of freedom, Astrom and
Hagglund 1995, 3.4): with b = 0 a step of the target makes no step of the current and no overshoot. The
integral stops while the limit is applied and the error would push it further (conditional integration). Of
the plant the controller uses only the ratio of inertia to torque constant, which scales the gains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from knightcube.errors import UsageError
from knightcube.gnc.control.one_axis.controller import CoilCommand, attitude_error
from knightcube.gnc.guidance.one_axis.path import Sample
from knightcube.gnc.guidance.one_axis.plant import SingleAxisPlant


@dataclass(frozen=True, slots=True)
class PidGains:
    """The gains on angle (1/s^2), its integral (1/s^3) and the rate (1/s)."""

    proportional: float
    integral: float
    derivative: float

    def __post_init__(self) -> None:
        """Raise UsageError for gains that are not finite and positive."""
        for name in ("proportional", "integral", "derivative"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise UsageError(f"PID {name} gain is {value}: it must be finite and positive")

    @classmethod
    def placed(cls, bandwidth: float) -> PidGains:
        """Return the gains that place three poles at -`bandwidth` rad/s."""
        return cls(3.0 * bandwidth**2, bandwidth**3, 3.0 * bandwidth)


class PidController:
    """Owns the integral of the error, rad s."""

    def __init__(self, plant: SingleAxisPlant, period: float, gains: PidGains, target_weight: float) -> None:
        """Control `plant` every `period` s.

        Raises UsageError when a value is outside its range.
        """
        if not (math.isfinite(period) and period > 0.0):
            raise UsageError(f"PID period is {period}: it must be finite and positive")
        if not 0.0 <= target_weight <= 1.0:
            raise UsageError(f"PID target_weight is {target_weight}: it must lie between 0 and 1")
        self._scale = plant.inertia / plant.torque_constant
        self._limit = plant.current_limit
        self._period = period
        self._weight = target_weight
        self._gains = gains
        self._sum: float | None = None

    def command(self, wanted: Sample, angle: float, rate: float, disturbance: float = 0.0) -> CoilCommand:
        """Return the command at `angle` rad and `rate` rad/s; an estimated disturbance is not used.

        Raises UsageError when an input is not finite.
        """
        error = attitude_error(wanted, angle, rate, disturbance)
        # The integral starts with the part of the target that the proportional part leaves out, so that the
        # first command at rest is zero.
        unweighted = (1.0 - self._weight) * wanted.angle
        if self._sum is None:
            self._sum = self._gains.proportional / self._gains.integral * ((1.0 - self._weight) * angle)
        total = self._sum + self._period * error
        acceleration = (
            self._gains.proportional * (error - unweighted)
            + self._gains.integral * total
            + self._gains.derivative * (wanted.rate - rate)
            + wanted.acceleration
        )
        made = CoilCommand.within(self._limit, self._scale * acceleration, error)
        if not (made.saturated and made.demanded * error > 0.0):
            self._sum = total
        return made

    def reset(self) -> None:
        """Clear the integral."""
        self._sum = None
