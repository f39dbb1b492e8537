"""A torque coil on two inputs of an SN754410: current to PWM counts and back (Sease 2013, Table 5.2, 5.33).

A signed count gives direction and duty: +n drives input A for n/4096 of the period with input B low, -n the
reverse, 0 keeps both low. The coil's L/R of 0.1 ms is far below the 20 ms period, so the mean current over a
period follows from the mean voltage: n/4096 V/R.
"""

from __future__ import annotations

import math

from hal.drivers.pca9685 import COUNTS, FULL_OFF, FULL_ON, PwmCounts


def current_step(resistance: float, supply_voltage: float) -> float:
    """Return the mean current in A of one count, V/R/4096, from ohm and volt."""
    return supply_voltage / resistance / COUNTS


def largest_counts(step: float, current_limit: float) -> int:
    """Return the largest count whose current exceeds neither the limit in A nor V/R."""
    # A limit that is a whole number of steps must not lose one to rounding.
    return min(COUNTS, math.floor(current_limit / step * (1.0 + 1e-12)))


def counts_for(current: float, step: float, largest: int) -> tuple[int, bool]:
    """Return the signed counts nearest to a mean current in A, and whether it was limited.

    Raises ValueError for NaN.
    """
    bound = largest * step
    if current > bound:
        return largest, True
    if current < -bound:
        return -largest, True
    return round(current / step), False


def mean_current(counts: int, step: float) -> float:
    """Return the mean current in A of signed counts."""
    return counts * step


def inputs_for(counts: int) -> tuple[PwmCounts, PwmCounts]:
    """Return the PWM counts of inputs A and B; the idle one is low the whole period (Table 5.2)."""
    if counts > 0:
        return _pulse(counts), FULL_OFF
    if counts < 0:
        return FULL_OFF, _pulse(-counts)
    return FULL_OFF, FULL_OFF


def brake() -> tuple[PwmCounts, PwmCounts]:
    """Return the PWM counts of both inputs that hold a coil at zero although a leg is stuck high.

    Both ends of the coil are then at the upper rail, for either leg and for a sound bridge.
    """
    return FULL_ON, FULL_ON


def enable_for(counts: int) -> PwmCounts:
    """Return the PWM counts of a wired enable input: low at zero, so that the coil floats, not brakes."""
    return FULL_ON if counts else FULL_OFF


def _pulse(counts: int) -> PwmCounts:
    return FULL_ON if counts >= COUNTS else (0, counts)
