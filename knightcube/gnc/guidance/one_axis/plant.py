"""The single-axis plant: a rigid body on a thread, rotated by one torque coil in a fixed horizontal field.

Sease 2013, 5.4 with the thread and a constant disturbance d added: J (w' - d) = n A B I cos(theta) - k theta
- c w, where theta is the angle about the thread and q2 = sin(theta/2) (5.5, 5.6). Planner, tracker and
estimator share these relations, so that the tracker can follow the planned path.

Functions with singular names (`current`) take floats and use `math` because they run in the 40 Hz loop;
functions with plural names (`currents`) take arrays of one shape.

`PathCost` is the power that a path minimises: the coil's heat, or the power taken from the supply. A coil on
a chopped supply carries full current for a part of each PWM period, because its L/R of 0.1 ms is short
against the period of 20 ms. A mean current I then takes V |I| from the supply, V = R Imax. R I^2, the cost of
the thesis (Sease 5.1), is the heat of a steady current I.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.errors import UsageError
from knightcube.gnc.coil_power import steady_heat, supply_power

Q2_LIMIT = 0.68
"""Largest |q2| of any path. cos(theta) is 0.075 there; at 0.707 no current rotates the body."""


SQUARE_Q2_WITHOUT_AUTHORITY = 0.5
"""cos(theta) = 1 - 2 q2^2 is zero here: the coil's axis lies along the field (5.15 corrected)."""


@dataclass(frozen=True, slots=True)
class SingleAxisPlant:
    """The constants of the motion about the thread.

    Attributes:
        inertia: J, kg m^2.
        torque_constant: n A B, N m/A: the torque of one ampere at theta = 0.
        resistance: of the coil, ohm.
        current_limit: largest |I|, A.
        stiffness: k of the thread, N m/rad.
        damping: c, N m s/rad.
        disturbance: d, rad/s^2: the acceleration that the other terms do not explain, from the estimator.
    """

    inertia: float
    torque_constant: float
    resistance: float
    current_limit: float
    stiffness: float = 0.0
    damping: float = 0.0
    disturbance: float = 0.0

    def __post_init__(self) -> None:
        """Raise UsageError for constants out of range."""
        for name in ("inertia", "torque_constant", "resistance", "current_limit"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise UsageError(f"plant {name} is {value}: it must be finite and positive")
        for name in ("stiffness", "damping"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise UsageError(f"plant {name} is {value}: it must be finite and not negative")
        if not math.isfinite(self.disturbance):
            raise UsageError(f"plant disturbance is {self.disturbance}: it must be finite")

    def current(self, angle: float, rate: float, acceleration: float) -> float:
        """Return the current in A that gives `acceleration` rad/s^2 at `angle` rad and `rate` rad/s (5.5)."""
        torque = (
            self.inertia * (acceleration - self.disturbance) + self.stiffness * angle + self.damping * rate
        )
        return torque / (self.torque_constant * math.cos(angle))

    def acceleration(self, angle: float, rate: float, current: float) -> float:
        """Return the angular acceleration in rad/s^2 under `current` A (5.4)."""
        torque = self.torque_constant * current * math.cos(angle) - self.stiffness * angle
        return (torque - self.damping * rate) / self.inertia + self.disturbance

    def currents(self, angle: FloatArray, rate: FloatArray, acceleration: FloatArray) -> FloatArray:
        """Return `current` for arrays (n,)."""
        torque = (
            self.inertia * (acceleration - self.disturbance) + self.stiffness * angle + self.damping * rate
        )
        return np.asarray(torque / (self.torque_constant * np.cos(angle)))


def angle_of(q2: float) -> float:
    """Return theta = 2 asin(q2) in rad."""
    return 2.0 * math.asin(q2)


def q2_of(angle: float) -> float:
    """Return q2 = sin(theta/2)."""
    return math.sin(0.5 * angle)


def rate_of(q2: float, q2_rate: float) -> float:
    """Return the body rate in rad/s: w = 2 q2' / sqrt(1 - q2^2) (5.9; 5.13 corrected)."""
    return 2.0 * q2_rate / math.sqrt(1.0 - q2 * q2)


def q2_rate_of(q2: float, rate: float) -> float:
    """Return q2' = w sqrt(1 - q2^2) / 2 in 1/s (5.9)."""
    return 0.5 * rate * math.sqrt(1.0 - q2 * q2)


def acceleration_of(q2: float, q2_rate: float, q2_acceleration: float) -> float:
    """Return w' in rad/s^2, the exact derivative of 5.9: 2 q2''/u + 2 q2 q2'^2/u^3, u = sqrt(1 - q2^2)."""
    square = 1.0 - q2 * q2
    return 2.0 * (q2_acceleration + q2 * q2_rate * q2_rate / square) / math.sqrt(square)


def motion_of(
    q2: FloatArray, q2_rate: FloatArray, q2_acceleration: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return theta, w and w' (n,) of q2 and its two time derivatives (n,)."""
    square = 1.0 - q2 * q2
    root = np.sqrt(square)
    acceleration = 2.0 * (q2_acceleration + q2 * q2_rate * q2_rate / square) / root
    return 2.0 * np.arcsin(q2), 2.0 * q2_rate / root, acceleration


def current_and_slopes(
    plant: SingleAxisPlant, q2: FloatArray, q2_rate: FloatArray, q2_acceleration: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the current (n,) in A and its partial derivatives by q2, q2' and q2'' (n,) each.

    5.6 with the exact w' in place of a differentiated polynomial of w, the thread and the disturbance.
    """
    square = 1.0 - q2 * q2
    by_acceleration = 2.0 / np.sqrt(square)  # dw'/dq2'', and dw/dq2' as well
    turn = q2_rate / square
    swing = q2 * turn
    cosine = 1.0 - 2.0 * q2 * q2
    scale = 1.0 / (plant.torque_constant * cosine)

    acceleration = by_acceleration * (q2_acceleration + q2_rate * swing)
    torque = plant.inertia * (acceleration - plant.disturbance)
    torque_by_q2 = plant.inertia * (
        acceleration * q2 / square + by_acceleration * (q2_rate * turn * (1.0 + q2 * q2) / square)
    )
    torque_by_rate = plant.inertia * 2.0 * by_acceleration * swing
    if plant.stiffness:
        torque = torque + plant.stiffness * 2.0 * np.arcsin(q2)
        torque_by_q2 = torque_by_q2 + plant.stiffness * by_acceleration
    if plant.damping:
        torque = torque + plant.damping * by_acceleration * q2_rate
        torque_by_q2 = torque_by_q2 + plant.damping * by_acceleration * swing
        torque_by_rate = torque_by_rate + plant.damping * by_acceleration
    current = torque * scale
    by_q2 = torque_by_q2 * scale + current * (4.0 * q2 / cosine)
    return current, by_q2, torque_by_rate * scale, plant.inertia * by_acceleration * scale


_ROUNDED = 0.1
"""Rounding e of |I| relative to Imax: the minimised |I| is sqrt(I^2 + e^2) - e, whose slope is continuous."""


class PathCost(StrEnum):
    """The power whose integral is minimised along a path."""

    HEAT = "heat"
    SUPPLY = "supply"

    def power(self, plant: SingleAxisPlant, current: FloatArray) -> FloatArray:
        """Return the power in W for mean currents (m,) in A."""
        if self is PathCost.HEAT:
            return steady_heat(current, plant.resistance)
        return supply_power(current, plant.resistance * plant.current_limit)

    def smooth(self, plant: SingleAxisPlant, current: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the smoothed power, W, to minimise, and its derivative, W/A, for currents (m,) in A."""
        if self is PathCost.HEAT:
            pull = plant.resistance * current
            return pull * current, 2.0 * pull
        voltage, rounding = plant.resistance * plant.current_limit, _ROUNDED * plant.current_limit
        size = np.sqrt(current * current + rounding * rounding)
        return voltage * (size - rounding), voltage * current / size
