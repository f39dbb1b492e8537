"""Inputs and outputs that all controllers of the angle about the thread share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from knightcube.errors import UsageError
from knightcube.gnc.guidance.one_axis.path import Sample


@dataclass(frozen=True, slots=True)
class CoilCommand:
    """A controller's command to the coil.

    Attributes:
        current: A, within the limit.
        demanded: A, before the limit; zero without authority.
        saturated: the limit was applied.
        authority: cos(theta) was large enough to make a torque; when False the current is zero.
        error: theta_p - theta in rad, as measured, in [-pi, pi].
        held: the error exceeded the largest allowed and was clamped to it.
    """

    current: float
    demanded: float
    saturated: bool
    authority: bool
    error: float
    held: bool = False

    @classmethod
    def within(cls, limit: float, demanded: float, error: float, held: bool = False) -> CoilCommand:
        """Return the command for `demanded` A, limited to +-`limit` A."""
        current = min(max(demanded, -limit), limit)
        return cls(current, demanded, current != demanded, True, error, held)

    @classmethod
    def without_authority(cls, error: float) -> CoilCommand:
        """Return the zero command for an angle at which no current turns the body."""
        return cls(0.0, 0.0, False, False, error)


class Controller(Protocol):
    """Computes a coil current from the commanded and the estimated motion, once per control cycle."""

    def command(self, wanted: Sample, angle: float, rate: float, disturbance: float = 0.0) -> CoilCommand:
        """Return the command at `angle` rad, `rate` rad/s under `disturbance` rad/s^2, all estimated.

        Raises UsageError when an input is not finite.
        """

    def reset(self) -> None:
        """Clear integrated state, after the coils were off or the state was lost."""


def attitude_error(wanted: Sample, angle: float, rate: float, disturbance: float) -> float:
    """Return theta_p - theta in [-pi, pi], rad; raises UsageError when an input is not finite."""
    total = wanted.angle + wanted.rate + wanted.acceleration + angle + rate + disturbance
    if not math.isfinite(total):
        raise UsageError(
            f"controller input is not finite: {wanted}, angle {angle}, rate {rate}, disturbance {disturbance}"
        )
    return math.remainder(wanted.angle - angle, 2.0 * math.pi)
