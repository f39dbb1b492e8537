"""Filter of the line of sight to one object, from directions alone.

The state is the relative position and velocity divided by the present range: y, a unit vector, and z. Free of
forces z is constant and y moves on a straight line, so a pass at any rate is linear but for the measurement;
the range divides out and is renewed to one after each step. These are the modified polar coordinates of
Aidala and Hammel (IEEE Trans. Automatic Control 28, 1983) in vectors. The part of z across the line is the
angular rate v, the part along it s = (range rate) / range, and the angular acceleration is -2 s v.

Both fall about the Earth: the gravity gradient at the observer's place, where that is known, gives the
acceleration of one against the other but for terms of the distance over the orbit's radius.

Process noise: the tides of two low orbits, which turn with the line, are taken for white accelerations of
density `Motion.wander`, and what the gradient leaves of them for those of `Motion.left`. The range's part
also follows what is no straight line, as an object on a great circle at a constant rate, whose s would change
by rate^2: a density of (`Motion.bend` rate^2)^2 / rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import tangent_basis
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER


@dataclass(frozen=True, slots=True)
class Motion:
    """What is believed of the objects' motion.

    Attributes:
        rate: rad/s, standard deviation of each component before the second sighting.
        closing: 1/s, the same of (range rate) / range.
        wander: 1/s^3, density of scaled accelerations. Tides in low orbit reach 1.5 n^2 = 1.8e-6 1/s^2; the
            density is the one whose errors of place and rate are as large as their covariance says in passes
            of 0.05 to 0.6 deg/s at up to 5,000 km.
        left: 1/s^3, the same where the gravity gradient is known, from the same passes.
        bend: part of rate^2 by which the closing rate changes otherwise than on a straight line.
    """

    rate: float = 0.01
    closing: float = 0.01
    wander: float = 1.6e-12
    left: float = 4e-13
    bend: float = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class LineOfSight:
    """A line of sight and its motion at one time.

    Attributes:
        time_ns: of the state.
        direction: (3,) unit vector, ICRS.
        velocity: (3,) 1/s, z: of its parts, across the line is the angular rate, along it the closing rate.
        covariance: (6, 6) of direction and velocity; nothing along the direction.
    """

    time_ns: int
    direction: FloatArray
    velocity: FloatArray
    covariance: FloatArray

    @property
    def rate(self) -> FloatArray:
        """How the direction changes (3,), rad/s, at right angles to it."""
        return self.velocity - (self.velocity @ self.direction) * self.direction

    @property
    def acceleration(self) -> FloatArray:
        """How the rate changes (3,), rad/s^2, at right angles to the direction."""
        return -2.0 * float(self.velocity @ self.direction) * self.rate


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """A direction against the predicted one: residual (2,) rad, its covariance and chi-square."""

    residual: FloatArray
    covariance: FloatArray
    observation: FloatArray
    chi_square: float


def begin(time_ns: int, direction: FloatArray, covariance: FloatArray, motion: Motion) -> LineOfSight:
    """Return the line of sight after one sighting of `covariance` (3, 3) rad^2; its rate is unknown."""
    along = np.outer(direction, direction)
    across = np.eye(3) - along
    start = np.zeros((6, 6))
    start[:3, :3] = across @ covariance @ across
    start[3:, 3:] = motion.rate**2 * across + motion.closing**2 * along
    return LineOfSight(time_ns, direction, np.zeros(3), start)


def tides(observer: FloatArray) -> FloatArray:
    """Return the gravity gradient (3, 3) 1/s^2 at an observer's place (3,) m from the Earth's centre, ICRS.

    What falls beside the observer is accelerated against it by this times its place, to first order.
    """
    distance = float(np.linalg.norm(observer))
    up = observer / distance
    return np.asarray(GRAVITATIONAL_PARAMETER / distance**3 * (3.0 * np.outer(up, up) - np.eye(3)))


def predict(state: LineOfSight, time_ns: int, motion: Motion, tide: FloatArray | None = None) -> LineOfSight:
    """Return the line of sight at another time, not before its own; `tide` (3, 3) 1/s^2 where it is known."""
    step = (time_ns - state.time_ns) * 1e-9
    if step == 0.0:
        return state
    if step < 0.0:
        raise ValueError(f"time_ns = {time_ns}: give one from {state.time_ns} on")
    transition = np.eye(6)
    transition[:3, 3:] = step * np.eye(3)
    if tide is not None:
        transition[:3, :3] += 0.5 * step**2 * tide
        transition[3:, :3] = step * tide
    spread = transition @ state.covariance @ transition.T + _noise(state, step, motion, tide is not None)
    moved = transition @ np.concatenate([state.direction, state.velocity])
    return _at_unit_range(time_ns, moved[:3], moved[3:], spread)


def compare(state: LineOfSight, direction: FloatArray, covariance: FloatArray) -> Innovation:
    """Return a direction (3,), of `covariance` (3, 3) rad^2, against the state at the same time."""
    basis = tangent_basis(state.direction)
    residual = basis @ direction / max(float(direction @ state.direction), 1e-3)
    observation = np.hstack([basis, np.zeros((2, 3))])
    expected = observation @ state.covariance @ observation.T + basis @ covariance @ basis.T
    return Innovation(residual, expected, observation, float(residual @ np.linalg.solve(expected, residual)))


def update(state: LineOfSight, direction: FloatArray, covariance: FloatArray) -> LineOfSight:
    """Return the state with a sighting (3,), of `covariance` (3, 3) rad^2, at the same time."""
    seen = compare(state, direction, covariance)
    gain = np.linalg.solve(seen.covariance, seen.observation @ state.covariance).T
    change = gain @ seen.residual
    kept = np.eye(6) - gain @ seen.observation
    basis = tangent_basis(state.direction)
    noise = basis @ covariance @ basis.T
    spread = kept @ state.covariance @ kept.T + gain @ noise @ gain.T
    place, velocity = state.direction + change[:3], state.velocity + change[3:]
    return _at_unit_range(state.time_ns, place, velocity, spread)


def _at_unit_range(
    time_ns: int, place: FloatArray, velocity: FloatArray, covariance: FloatArray
) -> LineOfSight:
    """Return the state divided by its range, |place|."""
    size = float(np.linalg.norm(place))
    direction, scaled = place / size, velocity / size
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = (np.eye(3) - np.outer(direction, direction)) / size
    jacobian[3:, :3] = -np.outer(scaled, direction) / size
    jacobian[3:, 3:] = np.eye(3) / size
    spread = jacobian @ covariance @ jacobian.T
    return LineOfSight(time_ns, direction, scaled, 0.5 * (spread + spread.T))


def _noise(state: LineOfSight, step: float, motion: Motion, known: bool) -> FloatArray:
    """Return the covariance (6, 6) of white accelerations over `step` s; `known`: the gradient is."""
    along = np.outer(state.direction, state.direction)
    rate = float(np.linalg.norm(state.rate))
    wander = motion.left if known else motion.wander
    density = wander * np.eye(3) + motion.bend**2 * rate**3 * along
    return np.block(
        [[density * step**3 / 3.0, density * step**2 / 2.0], [density * step**2 / 2.0, density * step]]
    )
