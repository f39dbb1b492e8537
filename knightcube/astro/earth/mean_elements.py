"""Two-line elements that fit measured positions, by least squares with SGP4.

The fitted parameters are the mean motion, the eccentricity vector, the inclination, the node and the mean
argument of latitude, which remain well defined for circular orbits. The drag term is zero. The fit
begins with the first positions, and the span is extended step by step, so that no revolution is lost between
distant positions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from sgp4.api import WGS72, Satrec
from sgp4.exporter import export_tle

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from knightcube.astro.earth.orbit_knowledge import OrbitError, TwoLineElements
from knightcube.astro.earth.orientation import mean_equator_to_celestial
from knightcube.errors import UsageError

_SGP4_EPOCH = 2_433_281.5
"""Julian date from which SGP4 counts days."""
_FIRST_SPAN, _GROWTH = 2_500.0, 3.0
"""Span (s) of the positions of the first fit, and the factor by which each further fit extends the span."""
_FAILED = 1e6
"""Residual (km) of elements that SGP4 cannot propagate."""
_NUMBER = 99_999


@dataclass(frozen=True, slots=True, eq=False)
class FittedElements:
    """Fitted two-line elements.

    Attributes:
        lines: the two lines.
        residuals: (n,) distances of the positions from the elements, m.
    """

    lines: tuple[str, str]
    residuals: FloatArray


def fit_elements(dates: FloatArray, positions: FloatArray) -> FittedElements:
    """Return two-line elements, whose epoch is the first date, for measured positions.

    Raises UsageError if there are fewer than four positions, if they are not in order of time, or if no
    elements fit.

    Args:
        dates: (n,) Julian dates UTC, ascending, of which the first two are less than half a revolution apart.
        positions: (n, 3) geocentric positions in ICRS axes, m.
    """
    if len(dates) < 4:
        raise UsageError(f"{len(dates)} positions: elements need at least four positions")
    if not (np.all(np.isfinite(positions)) and np.all(np.diff(dates) > 0.0)):
        raise UsageError("the positions must be finite, and their times must ascend")
    epoch = float(dates[0])
    to_icrs = np.array([mean_equator_to_celestial(float(date)) for date in dates])
    mean_equator = 1e-3 * np.einsum("nji,nj->ni", to_icrs, positions)  # km, in the axes of SGP4
    minutes = (dates - epoch) * 1440.0
    parameters, span = _first_guess(mean_equator), _FIRST_SPAN / 60.0

    while True:
        count = max(4, int(np.searchsorted(minutes, span, side="right")))

        def residuals(values: FloatArray, count: int = count) -> FloatArray:
            made = _satellite(values, epoch)
            codes, found, _ = made.sgp4_array(
                np.full(count, made.jdsatepoch), made.jdsatepochF + minutes[:count] / 1440.0
            )
            off = np.where(codes[:, None] == 0, found - mean_equator[:count], _FAILED)
            return np.asarray(np.where(np.isfinite(off), off, _FAILED).ravel())

        parameters = least_squares(residuals, parameters, method="lm").x
        if count >= len(dates):
            break
        span *= _GROWTH
    first, second = export_tle(_satellite(parameters, epoch))
    return FittedElements((first, second), distances((first, second), dates, positions))


def distances(lines: tuple[str, str], dates: FloatArray, positions: FloatArray) -> FloatArray:
    """Return the distances (n,), m, of positions (n, 3) in ICRS axes at Julian dates (n,) from elements.

    Raises UsageError for elements that SGP4 cannot propagate to these dates.
    """
    known = TwoLineElements(*lines)
    try:
        found = np.array([known.at(float(date)).position for date in dates])
    except OrbitError as error:
        raise UsageError(f"no elements fit the positions: {error}") from error
    return np.asarray(np.linalg.norm(found - positions, axis=1))


def _first_guess(positions: FloatArray) -> FloatArray:
    """Return the parameters of a circular orbit through the first of the positions (n, 3), km."""
    normal = np.cross(positions[0], positions[1])
    length = float(np.linalg.norm(normal))
    if length < 1e-6 * float(positions[0] @ positions[0]):
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
    return np.array([motion, 0.0, 0.0, inclination, node, argument])


def _satellite(parameters: FloatArray, epoch: float) -> Satrec:
    """Return the satellite of the six parameters at the Julian date `epoch`."""
    motion, along, across, inclination, node, argument = parameters.tolist()
    if inclination < 0.0:  # the same plane, with the node on the other side
        inclination, node, argument = -inclination, node + math.pi, argument + math.pi
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
