"""The LQ tracker: the attitude error made linear by feedback, then a linear-quadratic regulator.

Sease 2013, 5.16-5.32. With p the path and q the body, 5.17-5.20 give e = sin(theta_p - theta) exactly
(5.21), and 5.24-5.27 corrected are

    e'  = cos(d) (theta_p' - w)
    e'' = cos(d) (theta_p'' - w') - sin(d) (theta_p' - w)^2,     d = theta_p - theta.

e'' = v is solved for w' and the plant gives the current; v = -K (e', e) with K from the Riccati equation.

e is monotone in d only to 90 degrees. Beyond `largest_error` d is held there, its sign kept: the tracker
then turns the body back at a bounded demand instead of giving up its grip as sin(d) falls again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_continuous_are

from flight.errors import UsageError
from flight.guidance.path import Sample
from flight.plant import SingleAxisPlant

LARGEST_ERROR = 1.0
LEAST_AUTHORITY = 0.05


@dataclass(frozen=True, slots=True)
class TrackerCommand:
    """What the tracker wants of the coil.

    Attributes:
        current: A, within the limit.
        demanded: A, before the limit; zero without authority.
        saturated: the limit was in force.
        authority: cos(theta) was large enough to do anything; when False the current is zero.
        error: theta_p - theta in rad, as measured, in [-pi, pi].
        held: the error was beyond the largest and taken as that.
    """

    current: float
    demanded: float
    saturated: bool
    authority: bool
    error: float
    held: bool


class LqTracker:
    """Gains and plant; keeps nothing from call to call.

    Attributes:
        error_gain, rate_gain: K on e in 1/s^2 and on e' in 1/s.
    """

    def __init__(
        self,
        plant: SingleAxisPlant,
        state_weight: float = 20.0,
        input_weight: float = 1.0,
        largest_error: float = LARGEST_ERROR,
        least_authority: float = LEAST_AUTHORITY,
    ) -> None:
        """Solve the Riccati equation for Q = state_weight I and R = input_weight (5.28-5.32).

        `largest_error` is in rad, below pi/2; `least_authority` bounds |cos(theta)|. Raises UsageError when
        a value is outside its range.
        """
        for name, value in (("Q", state_weight), ("R", input_weight)):
            if not (math.isfinite(value) and value > 0.0):
                raise UsageError(f"LQ weight {name} is {value}: it must be finite and positive")
        if not 0.0 < largest_error < 0.5 * math.pi:
            raise UsageError(f"largest_error is {largest_error} rad: it must lie between 0 and pi/2")
        if not 0.0 < least_authority < 1.0:
            raise UsageError(f"least_authority is {least_authority}: it must lie between 0 and 1")
        self._plant = plant
        self._largest_error = largest_error
        self._least_authority = least_authority
        self.rate_gain, self.error_gain = lq_gains(state_weight, input_weight)

    def command(self, wanted: Sample, angle: float, rate: float) -> TrackerCommand:
        """Return the command at `angle` rad and `rate` rad/s.

        Raises UsageError when an input is not finite.
        """
        lag = wanted.rate - rate
        if not math.isfinite(angle + lag + wanted.angle + wanted.acceleration):
            raise UsageError(f"tracker input is not finite: {wanted}, angle {angle}, rate {rate}")
        error = math.remainder(wanted.angle - angle, 2.0 * math.pi)
        if abs(math.cos(angle)) < self._least_authority:
            return TrackerCommand(0.0, 0.0, False, False, error, False)
        held = abs(error) > self._largest_error
        used = math.copysign(self._largest_error, error) if held else error
        sine, cosine = math.sin(used), math.cos(used)
        v = -(self.rate_gain * cosine * lag + self.error_gain * sine)
        acceleration = wanted.acceleration - (v + sine * lag * lag) / cosine
        demanded = self._plant.current(angle, rate, acceleration)
        limit = self._plant.current_limit
        current = min(max(demanded, -limit), limit)
        return TrackerCommand(current, demanded, current != demanded, True, error, held)


def lq_gains(state_weight: float, input_weight: float) -> tuple[float, float]:
    """Return K, on e' in 1/s and on e in 1/s^2, for Q = state_weight I and R = input_weight (5.28-5.32)."""
    a = np.array([[0.0, 0.0], [1.0, 0.0]])
    b = np.array([[1.0], [0.0]])
    riccati = solve_continuous_are(a, b, state_weight * np.eye(2), np.array([[input_weight]]))
    gain = (b.T @ riccati)[0] / input_weight
    return float(gain[0]), float(gain[1])
