"""Two-line elements that fit measured positions and velocities, by least squares with SGP4.

The fitted parameters are the mean motion, the eccentricity vector, the inclination, the node and the mean
argument of latitude, which remain well defined for circular orbits. The drag term is zero. The fit begins
with the first positions and is extended in time step by step, so that revolutions between distant positions
are counted correctly. Positions whose residuals are far above the median are rejected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from sgp4.api import WGS72, Satrec
from sgp4.exporter import export_tle

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from knightcube.astro.earth.orbit_knowledge import OrbitError, TwoLineElements
from knightcube.astro.earth.orientation import mean_equator_to_celestial
from knightcube.errors import UsageError

_SGP4_EPOCH = 2_433_281.5
"""Julian date from which SGP4 counts days."""
_FIRST_SPAN, _GROWTH = 2_500.0, 3.0
"""Span (s) of the positions of the first fit, and the factor by which each further fit extends the span."""
_VELOCITY_TIME = 100.0
"""Ratio (s) of the standard deviations of positions and velocities that is assumed in the fit."""
_FAR, _NEAREST, _ROUNDS = 6.0, 300.0, 4
"""Rejection limits of a residual, as a multiple of the median and in m (the larger applies), and maximum
number of fits."""
_FIRST_ECCENTRICITY, _DIFFERENCE = 1e-3, 1e-6
"""Eccentricity of the initial guess, and step of the numerical derivatives as a fraction of the parameter.

SGP4 replaces eccentricities below 1e-6. Steps below 1e-6 would therefore give wrong derivatives for a
circular orbit. The fit adds 1 to each component of the eccentricity vector, so that a relative step of 1e-6
is also an absolute step of 1e-6.
"""
_SOON = 10.0
"""Time (s) after the first state for which a second position is extrapolated with the velocity of this
state."""
_PARAMETER = 1e-9 * GRAVITATIONAL_PARAMETER
"""Gravitational parameter, km^3/s^2."""
_FAILED = 1e6
"""Residual (km) assigned to elements that SGP4 cannot propagate."""
_NUMBER = 99_999
_FIRST_DATE, _LAST_DATE = 2_435_839.5, 2_472_364.5
"""Julian dates of 1957-01-01 and 2057-01-01, between which the two digits of the year are unique."""


@dataclass(frozen=True, slots=True, eq=False)
class FittedElements:
    """Fitted two-line elements.

    Attributes:
        lines: the two lines.
        residuals: (n,) distances between the given positions and the positions computed from the elements, m.
        used: (n,) whether each position was used in the fit.
        growth: standard deviation of the along-track error that accumulates in a day, m. The growth follows
            from the scatter of the residuals and excludes drag and other model errors.
    """

    lines: tuple[str, str]
    residuals: FloatArray
    used: BoolArray
    growth: float

    @property
    def rms(self) -> float:
        """Root mean square of the residuals of the used positions, m."""
        return float(np.sqrt(np.mean(self.residuals[self.used] ** 2)))


def fit_elements(
    dates: FloatArray, positions: FloatArray, velocities: FloatArray | None = None
) -> FittedElements:
    """Return two-line elements, whose epoch is the first date, for measured positions.

    The Julian dates UTC (n,) are ascending. Positions (n, 3), m, and velocities (n, 3), m/s, are geocentric
    and in ICRS axes. Without velocities, the first two dates must be less than half a revolution apart.
    Raises UsageError if fewer than four positions are given (fewer than two with velocities), if the
    positions are not in order of time, if their year is not 1957 to 2056, or if no elements fit.
    """
    least = 4 if velocities is None else 2
    if len(dates) < least:
        wanted = f"{least} positions" if velocities is None else f"{least} fixes with velocities"
        raise UsageError(f"elements need at least {wanted}; given: {len(dates)}")
    states = positions if velocities is None else np.hstack([positions, velocities])
    if not (np.all(np.isfinite(states)) and np.all(np.diff(dates) > 0.0)):
        raise UsageError("the positions must be finite, and their times must ascend")
    if not _FIRST_DATE <= float(dates[0]) < _LAST_DATE:
        problem = "the year of two-line elements has two digits: give times from 1957 to 2056"
        raise UsageError(f"the first position has the Julian date {float(dates[0]):.1f}: {problem}")
    fit = _Fit(dates, states)
    parameters, span = fit.first_guess(), _FIRST_SPAN / 60.0
    used = np.ones(len(dates), dtype=bool)
    while (count := max(least, int(np.searchsorted(fit.minutes, span, side="right")))) < len(dates):
        parameters = fit.solve(parameters, used & (np.arange(len(dates)) < count)).x
        span *= _GROWTH
    for _ in range(_ROUNDS):
        solution = fit.solve(parameters, used)
        parameters = solution.x
        lines = export_tle(_satellite(parameters, fit.epoch))
        found = distances(lines, dates, positions)
        limit = max(_FAR * float(np.median(found)), _NEAREST)
        if np.array_equal(used, found <= limit) or np.count_nonzero(found <= limit) < least:
            break
        used = found <= limit
    return FittedElements(lines, found, used, fit.growth(solution, positions))


class _Fit:
    """The least-squares fit of two-line elements to states (m, and m/s) in ICRS axes."""

    def __init__(self, dates: FloatArray, states: FloatArray) -> None:
        """Store the times and the `states`: positions (n, 3), or positions and velocities (n, 6)."""
        # In two-line elements, the epoch has eight decimals. An unrounded epoch just before the end of a year
        # would be written as a day after the last day of that year.
        self.epoch = round(float(dates[0]), 8)
        self.minutes = (dates - self.epoch) * 1440.0
        to_icrs = np.array([mean_equator_to_celestial(float(date)) for date in dates])
        parts = [
            1e-3 * np.einsum("nji,nj->ni", to_icrs, states[:, k : k + 3])
            for k in range(0, states.shape[1], 3)
        ]
        self._measured = np.hstack(parts)  # states in TEME axes, km and km/s
        self._scale = np.repeat([1.0, _VELOCITY_TIME], 3)[: states.shape[1]]

    def first_guess(self) -> FloatArray:
        """Return the parameters of a nearly circular orbit through the first state or first two positions."""
        first, second = self._measured[0], self._measured[1]
        if len(first) == 6:
            soon = first[:3] + _SOON * first[3:]
            guess = _first_guess(np.array([first[:3], soon]))
            energy = 0.5 * float(first[3:] @ first[3:]) - _PARAMETER / float(np.linalg.norm(first[:3]))
            if energy < 0.0:
                guess[0] = 60.0 * math.sqrt((-2.0 * energy) ** 3) / _PARAMETER
            return guess
        return _first_guess(np.array([first, second]))

    def solve(self, parameters: FloatArray, used: BoolArray) -> Any:
        """Return the least-squares solution for the states selected by `used`, started at `parameters`."""

        def residuals(values: FloatArray) -> FloatArray:
            made = _satellite(values, self.epoch)
            minutes = self.minutes[used]
            codes, found, speed = made.sgp4_array(
                np.full(len(minutes), made.jdsatepoch), made.jdsatepochF + minutes / 1440.0
            )
            modelled = np.hstack([found, speed])[:, : len(self._scale)]
            off = np.where(codes[:, None] == 0, (modelled - self._measured[used]) * self._scale, _FAILED)
            return np.asarray(np.where(np.isfinite(off), off, _FAILED).ravel())

        return least_squares(residuals, parameters, method="lm", diff_step=_DIFFERENCE)

    def growth(self, solution: Any, positions: FloatArray) -> float:
        """Return the standard deviation of the along-track error that accumulates in a day, m."""
        freedom = max(len(solution.fun) - len(solution.x), 1)
        covariance = (
            np.linalg.pinv(solution.jac.T @ solution.jac) * float(solution.fun @ solution.fun) / freedom
        )
        radius = float(np.mean(np.linalg.norm(positions, axis=1)))
        return radius * math.sqrt(max(float(covariance[0, 0]), 0.0)) * 1440.0


def distances(lines: tuple[str, str], dates: FloatArray, positions: FloatArray) -> FloatArray:
    """Return the distances (n,), m, between positions (n, 3), ICRS, m, and the positions by SGP4 at `dates`.

    Raises UsageError for elements that are not valid or that SGP4 cannot propagate to the given dates.
    """
    try:
        known = TwoLineElements(*lines)
        found = np.array([known.at(float(date)).position for date in dates])
    except (OrbitError, UsageError) as error:
        raise UsageError(f"no elements fit the positions, which must be in m: {error}") from error
    return np.asarray(np.linalg.norm(found - positions, axis=1))


def _first_guess(positions: FloatArray) -> FloatArray:
    """Return the parameters of a nearly circular orbit through the first two of the positions (n, 3), km."""
    normal = np.cross(positions[0], positions[1])
    length = float(np.linalg.norm(normal))
    if length <= 1e-6 * float(positions[0] @ positions[0]):
        raise UsageError("the first two positions are equal or opposite: they define no orbital plane")
    normal = normal / length
    inclination = math.acos(max(-1.0, min(1.0, float(normal[2]))))
    node = math.atan2(float(normal[0]), -float(normal[1]))
    towards_node = np.array([math.cos(node), math.sin(node), 0.0])
    argument = math.atan2(
        float(positions[0] @ np.cross(normal, towards_node)), float(positions[0] @ towards_node)
    )
    radius = 1e3 * float(np.mean(np.linalg.norm(positions[:2], axis=1)))
    motion = 60.0 * math.sqrt(GRAVITATIONAL_PARAMETER / radius**3)
    return np.array([motion, 1.0 + _FIRST_ECCENTRICITY, 1.0, inclination, node, argument])


def _satellite(parameters: FloatArray, epoch: float) -> Satrec:
    """Return the SGP4 satellite with the six fitted parameters and the Julian date `epoch` as its epoch."""
    motion, along, across, inclination, node, argument = parameters.tolist()
    if inclination < 0.0:  # the same orbital plane, described by a positive inclination
        inclination, node, argument = -inclination, node + math.pi, argument + math.pi
    along, across = along - 1.0, across - 1.0
    eccentricity, perigee = min(math.hypot(along, across), 0.95), math.atan2(across, along)
    made = Satrec()
    made.sgp4init(
        WGS72,
        "i",
        _NUMBER,
        epoch - _SGP4_EPOCH,
        0.0,
        0.0,
        0.0,
        eccentricity,
        perigee % math.tau,
        min(inclination, math.pi),
        (argument - perigee) % math.tau,
        motion,
        node % math.tau,
    )
    made.classification = "U"
    made.intldesg = f"{made.epochyr % 100:02d}001A"
    return made
