"""Orbits about the Earth: Keplerian elements, two bodies, and the Earth's oblateness J2 (Sease 2.13, 2.14).

Positions are in metres in the Earth-centred inertial frame of the stars, ICRS; its pole stands for the
Earth's, from which it has moved by 0.15 deg since J2000. No drag, no other bodies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
from scipy.integrate import OdeSolution, solve_ivp

from hal.interfaces.errors import OutOfRange
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS, GRAVITATIONAL_PARAMETER, J2

DEVICE = "orbit"
_TOLERANCE = 1e-12
"""Relative, of the integration: centimetres after ten low orbits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeplerianElements:
    """The osculating ellipse at an instant; angles in rad, the semi-major axis in m."""

    semi_major_axis: float
    eccentricity: float = 0.0
    inclination: float = 0.0
    ascending_node: float = 0.0
    argument_of_perigee: float = 0.0
    true_anomaly: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not math.isfinite(value):
                raise OutOfRange(DEVICE, field.name, value, -math.inf, math.inf, "")
        if self.semi_major_axis <= 0.0:
            raise OutOfRange(DEVICE, "semi_major_axis", self.semi_major_axis, 0.0, math.inf, "m")
        if not 0.0 <= self.eccentricity < 1.0:
            raise OutOfRange(DEVICE, "eccentricity", self.eccentricity, 0.0, 1.0, "")

    def state(self) -> tuple[FloatArray, FloatArray]:
        """Return position (3,) m and velocity (3,) m/s (Vallado, Algorithm 10)."""
        node, inclination = self.ascending_node, self.inclination
        towards_node = np.array([math.cos(node), math.sin(node), 0.0])
        across = np.array(
            [
                -math.cos(inclination) * math.sin(node),
                math.cos(inclination) * math.cos(node),
                math.sin(inclination),
            ]
        )
        argument = self.argument_of_perigee
        perigee = math.cos(argument) * towards_node + math.sin(argument) * across
        ahead = math.cos(argument) * across - math.sin(argument) * towards_node
        parameter = self.semi_major_axis * (1.0 - self.eccentricity**2)
        cosine, sine = math.cos(self.true_anomaly), math.sin(self.true_anomaly)
        radius = parameter / (1.0 + self.eccentricity * cosine)
        speed = math.sqrt(GRAVITATIONAL_PARAMETER / parameter)
        position = radius * (cosine * perigee + sine * ahead)
        velocity = speed * ((self.eccentricity + cosine) * ahead - sine * perigee)
        return position, velocity

    @property
    def period(self) -> float:
        """The time once round without J2, s."""
        return 2.0 * math.pi * math.sqrt(self.semi_major_axis**3 / GRAVITATIONAL_PARAMETER)


@dataclass(frozen=True, slots=True, eq=False)
class Orbit:
    """A body's way from time 0 to `duration` s, integrated once and read at any time between."""

    duration: float
    solution: OdeSolution

    def states_at(self, times: FloatArray) -> FloatArray:
        """Return positions (m) and velocities (m/s), (m, 6), at `times` (m,) s.

        Raises OutOfRange for times before 0 or after `duration`.
        """
        times = np.asarray(times, dtype=float)
        for end in (np.min(times, initial=0.0), np.max(times, initial=0.0)):
            if not 0.0 <= end <= self.duration:
                raise OutOfRange(DEVICE, "time", float(end), 0.0, self.duration, "s")
        return np.asarray(self.solution(times).T) if times.size else np.zeros((0, 6))

    def positions_at(self, times: FloatArray) -> FloatArray:
        """Return positions (m, 3) in m at `times` (m,) s."""
        return self.states_at(times)[:, :3]


class Start(Protocol):
    """Where an orbit starts: elements, or a state."""

    def state(self) -> tuple[FloatArray, FloatArray]:
        """Return position (3,) m and velocity (3,) m/s."""


def propagate(elements: Start, duration: float, j2: float = J2) -> Orbit:
    """Return the orbit that starts at `elements` at time 0, over `duration` s (Sease 2.13, 2.14).

    By the Runge-Kutta method of order 8 of Dormand and Prince, whose own interpolant gives what lies between
    its steps. `j2` = 0 leaves the two bodies alone. Raises OutOfRange when `duration` is not positive.
    """
    if not 0.0 < duration < math.inf:
        raise OutOfRange(DEVICE, "duration", duration, 0.0, math.inf, "s")
    oblateness = 1.5 * j2 * GRAVITATIONAL_PARAMETER * EARTH_RADIUS**2

    def derivative(_: float, state: FloatArray) -> list[float]:
        # Plain floats: for three components numpy costs five times as much.
        x, y, z, vx, vy, vz = state.tolist()
        squared = x * x + y * y + z * z
        cubed = squared * math.sqrt(squared)
        central = -GRAVITATIONAL_PARAMETER / cubed
        flat = oblateness / (cubed * squared)
        tilt = 5.0 * z * z / squared
        equatorial = central - flat * (1.0 - tilt)
        return [vx, vy, vz, equatorial * x, equatorial * y, (central - flat * (3.0 - tilt)) * z]

    position, velocity = elements.state()
    scale = np.repeat([np.linalg.norm(position), np.linalg.norm(velocity)], 3)
    result = solve_ivp(
        derivative,
        (0.0, duration),
        np.concatenate([position, velocity]),
        method="DOP853",
        rtol=_TOLERANCE,
        atol=_TOLERANCE * scale,
        dense_output=True,
    )
    return Orbit(float(duration), result.sol)
