"""The coarse Sun: from the currents of solar strings on the body's faces (Meller et al., chapter 2).

A string's current is proportional to the cosine of the Sun's angle from its normal, zero from behind. The
Earth shines on the strings, too, up to a third as strongly as the Sun, from half the sky: with the share (1 +
n e)/2 on a string of normal n, e being nadir. This correlates the strings' errors: in one known pattern if
nadir is known, else in the mean pattern over all directions. Either is part of the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import tangent_basis
from knightcube.errors import UsageError

_STEPS = 15
_SOFT = 0.05
"""Cosine over which a string's current sets in: the slope there determines a Sun normal to a face."""
_RARE = 3.09
"""Standard deviations that one reading in a thousand exceeds."""


def _cube() -> FloatArray:
    """Return the outward normals (6, 3) of a cube's faces: +x, +y, +z, -x, -y, -z."""
    return np.concatenate([np.eye(3), -np.eye(3)])


class CoarseSunStatus(Enum):
    """The outcome of the strings' solution."""

    FOUND = "found"
    DARK = "dark"
    """No string has a current: eclipse, or failed strings."""
    UNCERTAIN = "uncertain"
    """No Sun with any Earth makes these currents. A dead string often looks like a dark face."""


@dataclass(frozen=True, slots=True, eq=False)
class SolarStrings:
    """The strings of a satellite.

    Attributes:
        normals: (n, 3) unit vectors, outward, in body axes.
        peaks: (n,) A, of the full Sun straight upon each.
        sigma: of a reading over its peak: calibration, and departures from the cosine law.
        albedo: brightness of an Earth that fills half the sky over the Sun's; the mean over day and night.
        albedo_sigma: by which it varies, with the clouds and the Sun's height.
        dark: share of a peak below which a reading is darkness.
    """

    normals: FloatArray = field(default_factory=_cube)
    peaks: FloatArray = field(default_factory=lambda: np.ones(6))
    sigma: float = 0.025
    albedo: float = 0.15
    albedo_sigma: float = 0.15
    dark: float = 0.1

    def __post_init__(self) -> None:
        normals, peaks = np.asarray(self.normals, dtype=float), np.asarray(self.peaks, dtype=float)
        if normals.ndim != 2 or normals.shape[1] != 3 or len(normals) < 4:
            raise UsageError(f"solar strings: normals of shape {normals.shape}: give (n, 3), n of 4 or more")
        if not np.all(np.abs(np.linalg.norm(normals, axis=1) - 1.0) < 1e-6):
            raise UsageError("solar strings: normals must be finite unit vectors")
        if peaks.shape != (len(normals),) or not np.all((peaks > 0.0) & np.isfinite(peaks)):
            raise UsageError(f"solar strings: peaks {peaks}: give one positive current a string, in A")
        for name in ("sigma", "albedo", "albedo_sigma", "dark"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise UsageError(f"solar strings: {name} {getattr(self, name)}: must lie between 0 and 1")
        object.__setattr__(self, "normals", normals)
        object.__setattr__(self, "peaks", peaks)


@dataclass(frozen=True, slots=True, eq=False)
class CoarseSun:
    """The Sun's direction by the strings.

    Attributes:
        direction: (3,) unit vector in body axes, when the status is FOUND.
        basis: (2, 3), two unit vectors normal to it and to one another.
        tangent_covariance: (2, 2) rad^2, of the direction's error along `basis`.
        reason: why there is no direction.
    """

    status: CoarseSunStatus
    direction: FloatArray | None = None
    basis: FloatArray | None = None
    tangent_covariance: FloatArray | None = None
    reason: str = ""

    @property
    def sigma(self) -> float:
        """The root of the mean variance over the two axes, rad; infinite without a direction."""
        covariance = self.tangent_covariance
        return float("inf") if covariance is None else float(np.sqrt(0.5 * np.trace(covariance)))


def coarse_sun(currents: FloatArray, strings: SolarStrings, nadir: FloatArray | None = None) -> CoarseSun:
    """Return the Sun's direction in body axes from `currents` (n,) A, those of `strings`.

    `nadir` (3,), if known, is a unit vector in body axes; an error of ten degrees is harmless. Raises
    ValueError for currents of another number or not finite.
    """
    currents = np.asarray(currents, dtype=float)
    if currents.shape != strings.peaks.shape or not np.all(np.isfinite(currents)):
        raise ValueError(f"currents {currents}: give {len(strings.peaks)} finite numbers, A")
    shares = currents / strings.peaks
    if shares.max() < strings.dark:
        return CoarseSun(CoarseSunStatus.DARK, reason=f"no string has {strings.dark:g} of its peak current")
    earth, covariance = _earthlight(strings, nadir)
    information = np.linalg.inv(covariance)
    readings = shares - earth
    direction = _start(shares, strings)
    if direction is None:
        return CoarseSun(CoarseSunStatus.UNCERTAIN, reason="the currents cancel one another")
    for _ in range(_STEPS):
        basis = tangent_basis(direction)
        modelled, gradient = received(strings.normals @ direction)
        slopes = gradient[:, None] * (strings.normals @ basis.T)
        weighted = slopes.T @ information
        inverse = np.linalg.inv(weighted @ slopes + 1e-6 * np.eye(2))
        step = inverse @ (weighted @ (readings - modelled))
        # At most half a radian: far from the solution the slopes mislead.
        step *= min(1.0, 0.5 / max(float(np.hypot(*step)), 1e-12))
        direction = direction + step @ basis
        direction = direction / np.linalg.norm(direction)
        if np.hypot(*step) < 1e-6:
            break
    left = readings - received(strings.normals @ direction)[0]
    square = float(left @ information @ left)
    if square > _chi_square(len(shares) - 2):
        reason = f"the currents fit no Sun: chi-square {square:.0f} of {len(shares) - 2}"
        return CoarseSun(CoarseSunStatus.UNCERTAIN, reason=reason)
    return CoarseSun(CoarseSunStatus.FOUND, direction, basis, np.asarray(inverse))


def _start(shares: FloatArray, strings: SolarStrings) -> FloatArray | None:
    """Return the unit vector (3,) that the normals, weighted by their currents, point to; or None."""
    total = np.linalg.pinv(strings.normals.T @ strings.normals) @ strings.normals.T @ np.maximum(shares, 0.0)
    length = float(np.linalg.norm(total))
    return total / length if length > 0.5 * strings.dark else None


def received(cosines: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the shares of peak current at `cosines` (...), none from behind, and their slopes."""
    root = np.sqrt(cosines**2 + _SOFT**2)
    return 0.5 * (cosines + root), 0.5 * (1.0 + cosines / root)


def _earthlight(strings: SolarStrings, nadir: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Return the Earth's mean share (n,) in the readings and the readings' covariance (n, n)."""
    normals, square = strings.normals, strings.albedo_sigma**2
    own = strings.sigma**2 * np.eye(len(normals))
    if nadir is not None:
        pattern = 0.5 * (1.0 + normals @ nadir)
        return strings.albedo * pattern, own + square * np.outer(pattern, pattern)
    # Over all directions e, (1 + n e)/2 has the mean 1/2 and the product's mean 1/4 + n n'/12.
    even = np.full(len(normals), 0.5)
    second = 0.25 + normals @ normals.T / 12.0
    covariance = (strings.albedo**2 + square) * second - strings.albedo**2 * np.outer(even, even)
    return strings.albedo * even, own + covariance


def _chi_square(freedom: int) -> float:
    """Return the chi-square that is exceeded once in a thousand times (Wilson and Hilferty 1931)."""
    ninth = 2.0 / (9.0 * freedom)
    return float(freedom * (1.0 - ninth + _RARE * np.sqrt(ninth)) ** 3)
