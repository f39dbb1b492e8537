"""Orbit determination of an object from directions alone, measured on a satellite in a known orbit.

The six unknowns at the middle of the arc are two angles of the direction, the relative velocity divided by
the distance, and the logarithm of the distance. The sightings of one pass determine the distance poorly and
the other five unknowns well. The distance of an object in free fall near the observer can be determined only
from the curvature of the path that gravity causes. The distance is therefore scanned (as over the admissible
region of Milani et al., Celestial Mechanics 90, 2004). For each distance the other five unknowns are fitted
by the Gauss-Newton method, and all six unknowns of the best fit are then refined. The arc is long enough for
an orbit if the 95 % confidence interval of the distance, which follows from chi-square, is short. Gauss's
method finds the same distance, but uses only three sightings and is therefore noisier.

The forces are the gravity of a spherical Earth and J2. The directions of an object are measured relative to
catalogue directions of stars. Light time and aberration therefore shift the apparent direction according to
the object's velocity relative to the Sun.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, tangent_basis
from knightcube.astro.chi_square import bound
from knightcube.astro.earth.figure import EARTH_RADIUS, GRAVITATIONAL_PARAMETER, J2
from knightcube.astro.earth.sun import SPEED_OF_LIGHT
from knightcube.errors import KnightCubeError

_LONGEST_STEP = 10.0
_SMOOTHING_ROUNDS = 3
_STATE_STEPS = np.repeat([1.0, 1e-3], 3)
"""Steps of position (m) and velocity (m/s) for finite differences."""


def smoothed(
    times: FloatArray, states: FloatArray, sigma: FloatArray, middle: int
) -> tuple[FloatArray, FloatArray]:
    """Return the states (n, 6) of the orbit that best fits measured positions.

    The function also returns the covariance (6, 6) of the state at the instant `middle`. The standard
    deviation of each position is `sigma` (n,), m, along each axis. The velocities of `states` are only the
    initial guess.
    """
    state = states[middle]
    covariance = np.eye(6)
    weights = np.repeat(1.0 / sigma, 3)
    for _ in range(_SMOOTHING_ROUNDS):
        shifts = np.concatenate([np.zeros((1, 6)), np.diag(_STATE_STEPS), -np.diag(_STATE_STEPS)])
        flown = propagate_about(state + shifts, times, middle)[..., :3]
        off = (flown[:, 0] - states[:, :3]).ravel() * weights
        slope = (flown[:, 1:7] - flown[:, 7:]) / (2.0 * _STATE_STEPS[:, None])
        jacobian = np.swapaxes(slope, 1, 2).reshape(-1, 6) * weights[:, None]
        scaled = jacobian / np.linalg.norm(jacobian, axis=0)
        size = np.linalg.norm(jacobian, axis=0)
        covariance = np.linalg.inv(scaled.T @ scaled) / np.outer(size, size)
        state = state - covariance @ (jacobian.T @ off)
    return propagate_about(state[None], times, middle)[:, 0], covariance


def propagate_about(start: FloatArray, times: FloatArray, middle: int) -> FloatArray:
    """Return states (n, k, 6) at increasing times (n,) s from the states (k, 6) at `times[middle]`."""
    ahead, behind = trajectories(start, times[middle:]), trajectories(start, times[middle::-1])
    return np.concatenate([behind[:0:-1], ahead])


def trajectories(start: FloatArray, times: FloatArray) -> FloatArray:
    """Return states (n, k, 6) at monotonic times (n,) s from the states (k, 6) at the first time."""
    found = [start]
    for before, after in itertools.pairwise(times):
        steps = max(1, math.ceil(abs(after - before) / _LONGEST_STEP))
        state, step = found[-1], (after - before) / steps
        for _ in range(steps):
            a = _derivative(state)
            b = _derivative(state + 0.5 * step * a)
            c = _derivative(state + 0.5 * step * b)
            d = _derivative(state + step * c)
            state = state + step / 6.0 * (a + 2.0 * (b + c) + d)
        found.append(state)
    return np.array(found)


def _derivative(state: FloatArray) -> FloatArray:
    """Return the time derivatives (k, 6) of states (k, 6), which are velocities and accelerations."""
    position = state[:, :3]
    # A lower bound of the radius limits the acceleration of hypothetical objects inside the Earth.
    square = np.maximum(np.sum(position**2, axis=1, keepdims=True), (0.5 * EARTH_RADIUS) ** 2)
    flat = 1.5 * J2 * EARTH_RADIUS**2 / square
    tilt = 5.0 * position[:, 2:] ** 2 / square
    scale = 1.0 + flat * (np.array([1.0, 1.0, 3.0]) - tilt)
    return np.hstack([state[:, 3:], -GRAVITATIONAL_PARAMETER / square**1.5 * scale * position])


MINIMUM_SIGHTINGS = 6
RATIO = 1.5
"""Largest accepted ratio of the upper to the lower end of the confidence interval of the distance."""
GROUND_CLEARANCE = 80e3
"""Smallest perigee height (m) of an orbit that does not hit the Earth."""
_NEAREST, _FARTHEST, _GRID = 1e3, 6e7, 90
"""Nearest and farthest distance (m) of the scan, and the number of logarithmically spaced distances."""
_DEGREES_95 = 3.841
"""95 % quantile of chi-square with one degree of freedom."""
_STEPS = np.array([1e-6, 1e-6, 1e-7, 1e-7, 1e-6, 1e-4])
"""Steps of the six unknowns in central differences: direction (rad), velocity divided by distance (1/s), and
logarithm of the distance."""
_LONGEST_STEPS = np.array([0.05, 0.05, 0.02, 0.02, 0.02])
"""Limits of the Gauss-Newton steps of the five unknowns other than the distance. The limits keep poor
hypotheses from diverging."""
_ROUNDS, _FINAL_ROUNDS = 6, 20
_MISFIT = 1e-6
"""Smallest accepted probability of the chi-square of a fit. A smaller probability indicates that the object
is not in free fall, or that the sightings have larger errors than their standard deviations."""


class ArcError(KnightCubeError):
    """Error raised if the sightings do not determine an orbit; the message states the reason with values."""


@dataclass(frozen=True, slots=True, eq=False)
class Bearings:
    """Directions observed from a known orbit.

    Attributes:
        times: increasing times (n,) of the sightings, s.
        directions: unit vectors (n, 3) from the observer to the object, ICRS.
        sigma: standard deviation (n,) of the directions along each axis, rad.
        observer: geocentric position and velocity (n, 6) of the observer, ICRS, m and m/s.
        earth: velocity (3,) of the Earth relative to the Sun, ICRS, m/s.
    """

    times: FloatArray
    directions: FloatArray
    sigma: FloatArray
    observer: FloatArray
    earth: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FirstOrbit:
    """An orbit at one time.

    Attributes:
        time: time of the state, s.
        state: position and velocity (6,) of the object relative to the Earth's centre, ICRS, m and m/s.
        covariance: covariance (6, 6) of the state due to errors of the directions only.
        distance: distance of the object from the observer at the time of the state, m.
        interval: ends of the 95 % confidence interval of the distance, m.
        lasts: whether the orbit `state`, the most likely one, is bound to the Earth and does not hit the
            Earth. If not, another orbit with a distance in `interval` is bound to the Earth and does not hit
            the Earth.
        chi_square: chi-square of the sightings, with `degrees` degrees of freedom.
        degrees: number of degrees of freedom of the chi-square.
    """

    time: float
    state: FloatArray
    covariance: FloatArray
    distance: float
    interval: tuple[float, float]
    lasts: bool
    chi_square: float
    degrees: int


def first_orbit(seen: Bearings) -> FirstOrbit:
    """Return the orbit of a sighted object.

    Raises ArcError if the sightings do not determine an orbit.
    """
    count = len(seen.times)
    if count < MINIMUM_SIGHTINGS:
        raise ArcError(f"{count} sightings: an orbit needs {MINIMUM_SIGHTINGS} or more")
    fit = _ArcFit(seen)
    logarithms = np.linspace(math.log(_NEAREST), math.log(_FARTHEST), _GRID)
    inner, _ = _within(logarithms, fit.chi_square(fit.scan(logarithms)))
    step = logarithms[1] - logarithms[0]
    logarithms = np.linspace(inner[0] - step, inner[1] + step, _GRID)
    tried = fit.scan(logarithms)
    chi_square = fit.chi_square(tried)
    _, (low, high) = _within(logarithms, chi_square)
    possible = fit.admissible(tried) & (logarithms >= low) & (logarithms <= high)
    if high - low > math.log(RATIO):
        span = float(seen.times[-1] - seen.times[0])
        raise ArcError(_too_short(span, (low, high), logarithms[possible]))
    unknowns, covariance = fit.refine(tried[int(np.argmin(chi_square))])
    smallest = float(fit.chi_square(unknowns[None])[0])
    degrees = 2 * count - 6
    if smallest > bound(_MISFIT, degrees):
        raise ArcError(
            f"no ballistic orbit fits the sightings: "
            f"chi-square {smallest:.0f} with {degrees} degrees of freedom"
        )
    if not possible.any():
        near, far = 1e-3 * np.exp([low, high])
        raise ArcError(
            f"every orbit at a distance of {near:.4g} to {far:.4g} km escapes the Earth or hits it"
        )
    state = fit.states(unknowns[None])[0]
    jacobian = fit.state_jacobian(unknowns)
    spread = jacobian @ covariance @ jacobian.T
    return FirstOrbit(
        fit.time,
        state,
        0.5 * (spread + spread.T),
        math.exp(unknowns[5]),
        (math.exp(low), math.exp(high)),
        bool(fit.admissible(unknowns[None])[0]),
        smallest,
        degrees,
    )


def _within(
    logarithms: FloatArray, chi_square: FloatArray
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the interval of distances in which chi-square is less than `_DEGREES_95` above its minimum.

    The arguments are the `logarithms` of the tried distances and the chi-square at each distance. The first
    result contains the smallest and the largest tried logarithm of the distance inside the interval. The
    second result contains the two ends of the interval, interpolated between tried logarithms.
    """
    excess = chi_square - chi_square.min() - _DEGREES_95
    first, last = (int(position) for position in np.flatnonzero(excess < 0.0)[[0, -1]])
    ends = []
    for position, outer in ((first, first - 1), (last, last + 1)):
        end = float(logarithms[position])
        if 0 <= outer < len(logarithms):
            share = excess[position] / (excess[position] - excess[outer])
            end += float(share * (logarithms[outer] - logarithms[position]))
        ends.append(end)
    return (float(logarithms[first]), float(logarithms[last])), (ends[0], ends[1])


def _too_short(arc: float, interval: tuple[float, float], lasting: FloatArray) -> str:
    """Return the message for an arc (s) that is too short.

    The argument `lasting` contains the logarithms of those tried distances at which the fitted orbit is bound
    to the Earth and does not hit the Earth.
    """
    low, high = (1e-3 * math.exp(end) for end in interval)
    text = f"the arc of {arc:.0f} s is too short: the distance is {low:.3g} to {high:.3g} km (95 %)"
    if len(lasting):
        low, high = (1e-3 * math.exp(end) for end in (lasting.min(), lasting.max()))
        text += f", {low:.3g} to {high:.3g} km for closed orbits that do not hit the Earth"
    return text + f"; these limits must lie within a factor of {RATIO:g}"


class _ArcFit:
    """The least-squares fit of an orbit to the sightings, computed simultaneously for several hypotheses."""

    def __init__(self, seen: Bearings) -> None:
        self._seen = seen
        self._middle = len(seen.times) // 2
        self.time = float(seen.times[self._middle])
        self._axis = seen.directions[self._middle]
        self._basis = tangent_basis(self._axis)
        self._across = np.array([tangent_basis(direction) for direction in seen.directions])

    def states(self, unknowns: FloatArray) -> FloatArray:
        """Return the states (k, 6) of k hypotheses at the middle of the arc."""
        position = self._axis + unknowns[:, :2] @ self._basis
        position = position / np.linalg.norm(position, axis=1, keepdims=True)
        moved = unknowns[:, 2:4] @ self._basis + unknowns[:, 4:5] * self._axis
        return np.asarray(
            self._seen.observer[self._middle]
            + np.exp(unknowns[:, 5:6]) * np.concatenate([position, moved], axis=1)
        )

    def residuals(self, unknowns: FloatArray) -> FloatArray:
        """Return the residuals (k, 2 n) of n sightings, divided by the standard deviations."""
        seen, middle = self._seen, self._middle
        start = self.states(unknowns)
        states = propagate_about(start, seen.times, middle)
        way = states[..., :3] - seen.observer[:, None, :3]
        distance = np.linalg.norm(way, axis=2, keepdims=True)
        way = way - distance * (states[..., 3:] + seen.earth) / SPEED_OF_LIGHT
        way /= np.linalg.norm(way, axis=2, keepdims=True)
        off = np.einsum("nij,nkj->kni", self._across, way)
        # Without the lower bound of the cosine, directions behind the observer would have small residuals.
        facing = np.einsum("nj,nkj->kn", seen.directions, way)
        off = off / np.maximum(facing, 1e-3)[:, :, None]
        return np.asarray((off / seen.sigma[:, None]).reshape(len(unknowns), -1))

    def chi_square(self, unknowns: FloatArray) -> FloatArray:
        """Return chi-square (k,)."""
        return np.asarray(np.sum(self.residuals(unknowns) ** 2, axis=1))

    def admissible(self, unknowns: FloatArray) -> BoolArray:
        """Return whether each hypothetical orbit (k,) is bound to the Earth and does not hit the Earth."""
        states = self.states(unknowns)
        position, motion = states[:, :3], states[:, 3:]
        radius = np.linalg.norm(position, axis=1)
        energy = 0.5 * np.sum(motion**2, axis=1) - GRAVITATIONAL_PARAMETER / radius
        latus_rectum = np.sum(np.cross(position, motion) ** 2, axis=1) / GRAVITATIONAL_PARAMETER
        size = -0.5 * GRAVITATIONAL_PARAMETER / np.where(energy < 0.0, energy, -1.0)
        eccentricity = np.sqrt(np.maximum(1.0 - latus_rectum / size, 0.0))
        clear = size * (1.0 - eccentricity) > EARTH_RADIUS + GROUND_CLEARANCE
        return np.asarray((energy < 0.0) & clear)

    def scan(self, logarithms: FloatArray) -> FloatArray:
        """Return the best-fit unknowns (k, 6) for each logarithm (k,) of the distance."""
        unknowns = np.zeros((len(logarithms), 6))
        unknowns[:, 5] = logarithms
        times = self._seen.times - self.time
        # The initial guess of the velocity is the mean rate of change of the observed direction.
        weights = (times - times.mean()) / np.sum((times - times.mean()) ** 2)
        unknowns[:, 2:4] = (weights @ self._seen.directions) @ self._basis.T
        for _ in range(_ROUNDS):
            residual, jacobian = self._linear(unknowns)
            step = _solved(residual, jacobian[:, :, :5])[0]
            unknowns[:, :5] -= np.clip(step, -_LONGEST_STEPS, _LONGEST_STEPS)
        return unknowns

    def refine(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the best-fit unknowns (6,) near a guess, and the covariance (6, 6) of the unknowns."""
        covariance = np.eye(6)
        for _ in range(_FINAL_ROUNDS):
            residual, jacobian = self._linear(unknowns[None])
            (step,), (covariance,) = _solved(residual, jacobian)
            # Shorten long steps of the logarithm of the distance, over which the fit is not linear.
            unknowns = unknowns - step * min(1.0, 0.3 / max(abs(float(step[5])), 1e-12))
            if abs(float(step[5])) < 1e-4 * math.sqrt(float(covariance[5, 5])):
                break
        return unknowns, covariance

    def state_jacobian(self, unknowns: FloatArray) -> FloatArray:
        """Return the derivatives (6, 6) of the state with respect to the unknowns (6,)."""
        shifts = np.diag(_STEPS)
        ahead, behind = self.states(unknowns + shifts), self.states(unknowns - shifts)
        return np.asarray(((ahead - behind) / (2.0 * _STEPS[:, None])).T)

    def _linear(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the residuals (k, m), and their derivatives (k, m, 6) with respect to the unknowns."""
        shifts = np.concatenate([np.zeros((1, 6)), np.diag(_STEPS), -np.diag(_STEPS)])
        many = (unknowns[None] + shifts[:, None]).reshape(-1, 6)
        found = self.residuals(many).reshape(13, len(unknowns), -1)
        slope = (found[1:7] - found[7:]) / (2.0 * _STEPS[:, None, None])
        return found[0], np.moveaxis(slope, 0, 2)


def _solved(residual: FloatArray, jacobian: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Gauss-Newton steps (k, p) of p unknowns for k hypotheses, and covariances (k, p, p)."""
    normal = np.swapaxes(jacobian, 1, 2) @ jacobian
    size = np.sqrt(np.maximum(np.einsum("kii->ki", normal), 1e-300))
    scaled = normal / size[:, :, None] / size[:, None, :]
    inverse = np.linalg.pinv(scaled, rcond=1e-14, hermitian=True) / size[:, :, None] / size[:, None, :]
    pull = np.einsum("kmp,km->kp", jacobian, residual)
    return np.einsum("kpq,kq->kp", inverse, pull), inverse
