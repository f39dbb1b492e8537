"""The Sun's direction and the attitude from the currents of solar cells (Meller et al., chapter 2).

A solar string is a series connection of solar cells on one face of the body; it has one current. That current
is proportional to the cosine of the Sun's angle from the string's normal, and zero if the Sun is behind. The
Earth illuminates the strings as well, up to a third as strongly as the Sun, from half the sky: with the share
(1 + n e)/2 on a string of normal n, where e is nadir. This correlates the strings' errors, in one known
pattern if nadir is known, otherwise in the mean pattern over all directions. The covariance includes either
pattern.

`FieldAndStrings` gives the attitude from the magnetic field and the strings, while any one string may fail in
any way. The field does not determine the rotation about itself. All rotations about the field are tried at
once, and each predicts the light of Sun and Earth on the strings. A rotation is possible if all strings
except at most one agree with it, with the same exception in each reading. Between readings, the gyro
propagates the rotations. The covariance covers all rotations that are possible (solution separation, as
receivers check satellite navigation: Brown 1992, Navigation 39).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from knightcube.astro import chi_square
from knightcube.astro.arrays import FloatArray, tangent_basis
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.errors import UsageError

_MOST_STEPS = 15
_SOFT = 0.05
"""Range of the cosine in which a string's current rises smoothly from zero. Its slope there is needed for a
Sun normal to a face."""
_RARE = 3.09
"""Standard deviations that one reading in a thousand exceeds."""


class CoarseSunStatus(Enum):
    """The outcome of the strings' solution."""

    FOUND = "found"
    DARK = "dark"
    """No string has a current: eclipse, or failed strings."""
    UNCERTAIN = "uncertain"
    """No Sun explains these currents, with any light of the Earth. A dead string often looks like a dark
    face."""


@dataclass(frozen=True, slots=True, eq=False)
class SolarStringModel:
    """The solar strings of a satellite; the default are the six faces of a cube.

    Attributes:
        normals: outward unit vectors (n, 3) in body axes.
        peaks: currents in full sunlight at normal incidence (n,), A.
        sigma: standard deviation of a reading, relative to its peak: calibration, and departures from the
            cosine law.
        albedo: brightness of an Earth that fills half the sky, relative to the Sun; the mean over day and
            night.
        albedo_sigma: standard deviation of the albedo, due to clouds and the elevation of the Sun.
        dark: fraction of the peak below which a reading is darkness.

    Raises:
        UsageError: if a value is out of range.
    """

    normals: FloatArray = field(default_factory=lambda: np.concatenate([np.eye(3), -np.eye(3)]))
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
    """The Sun's direction from the strings.

    Attributes:
        status: the outcome.
        direction: unit vector (3,) in body axes; None unless the status is FOUND.
        basis: two unit vectors (2, 3) normal to the direction and to each other.
        tangent_covariance: covariance (2, 2) of the direction's error along `basis`, rad^2.
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


def coarse_sun(currents: FloatArray, strings: SolarStringModel, nadir: FloatArray | None = None) -> CoarseSun:
    """Return the Sun's direction in body axes from the currents of the strings.

    Args:
        currents: currents (n,), A.
        strings: the strings.
        nadir: unit vector (3,) in body axes, if it is known; an error of ten degrees is harmless.

    Raises:
        ValueError: if the currents are not n finite numbers.
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
    # The first guess is the direction of the normals, weighted with their currents.
    normals = strings.normals
    total = np.linalg.pinv(normals.T @ normals) @ normals.T @ np.maximum(shares, 0.0)
    length = float(np.linalg.norm(total))
    if not length > 0.5 * strings.dark:
        return CoarseSun(CoarseSunStatus.UNCERTAIN, reason="the currents cancel one another")
    direction = total / length
    for _ in range(_MOST_STEPS):
        basis = tangent_basis(direction)
        modelled, gradient = _sunlight(normals @ direction)
        slopes = gradient[:, None] * (normals @ basis.T)
        weighted = slopes.T @ information
        inverse = np.linalg.inv(weighted @ slopes + 1e-6 * np.eye(2))
        step = inverse @ (weighted @ (readings - modelled))
        # The step is limited to half a radian: far from the solution the slopes mislead.
        step *= min(1.0, 0.5 / max(float(np.hypot(*step)), 1e-12))
        direction = direction + step @ basis
        direction = direction / np.linalg.norm(direction)
        if np.hypot(*step) < 1e-6:
            break
    left = readings - _sunlight(normals @ direction)[0]
    square, freedom = float(left @ information @ left), len(shares) - 2
    # The chi-square that is exceeded once in a thousand times (Wilson and Hilferty 1931).
    ninth = 2.0 / (9.0 * freedom)
    if square > float(freedom * (1.0 - ninth + _RARE * np.sqrt(ninth)) ** 3):
        reason = f"the currents fit no Sun: chi-square {square:.0f} of {freedom}"
        return CoarseSun(CoarseSunStatus.UNCERTAIN, reason=reason)
    return CoarseSun(CoarseSunStatus.FOUND, direction, basis, np.asarray(inverse))


def _sunlight(cosines: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return string currents relative to the peak current, and their derivatives, at cosines of incidence.

    `cosines` (...) are the cosines of the angles between the Sun and the string's normals. The current is 0
    if the Sun is behind the string.
    """
    root = np.sqrt(cosines**2 + _SOFT**2)
    return 0.5 * (cosines + root), 0.5 * (1.0 + cosines / root)


def _earthlight(strings: SolarStringModel, nadir: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Return the mean share (n,) of the Earth in the readings, and the covariance (n, n) of the readings."""
    normals, square = strings.normals, strings.albedo_sigma**2
    own = strings.sigma**2 * np.eye(len(normals))
    if nadir is not None:
        pattern = 0.5 * (1.0 + normals @ nadir)
        return strings.albedo * pattern, own + square * np.outer(pattern, pattern)
    # Over all directions e, (1 + n e)/2 has the mean 1/2, and the product of two has the mean 1/4 + n n'/12.
    even = np.full(len(normals), 0.5)
    second = 0.25 + normals @ normals.T / 12.0
    covariance = (strings.albedo**2 + square) * second - strings.albedo**2 * np.outer(even, even)
    return strings.albedo * even, own + covariance


_TURNS = 180
"""Number of rotations about the field that are tried, two degrees apart."""
_IMPROBABLE = 1e-4
"""Probability of the currents below which a rotation is impossible."""
_MEMORY = 120.0
"""Time (s) for which a rejected rotation stays rejected, limited by the drift of the gyro."""
_MOST_VIOLATION = 3.0
"""Largest violation of the bound that is remembered, as a multiple of the bound."""
_CERTAIN = 5.0
"""Distance from the result to the farthest possible rotation, in standard deviations of the result."""
_COMMON = 0.02
"""Relative error that all strings have in common: the Sun's distance, temperature."""
_STEP = 2.0 * math.pi / _TURNS
_ANGLES = _STEP * np.arange(_TURNS)


@dataclass(frozen=True, slots=True, eq=False)
class KnownDirections:
    """Magnetic field, Sun and nadir in inertial axes, and the brightness of the Earth.

    Attributes:
        field: magnetic field (3,), T.
        sun, nadir: unit vectors (3,).
        light: brightness of an Earth that fills half the sky, relative to the Sun.
        light_sigma: standard deviation of `light`.
    """

    field: FloatArray
    sun: FloatArray
    nadir: FloatArray
    light: float
    light_sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class StringFix:
    """An attitude from field and strings.

    Attributes:
        quaternion: attitude (4,).
        covariance: covariance (3, 3) of small rotations, rad^2, body axes.
        axis: direction of the field (3,), body axes.
        about: standard deviation of the rotation about the field, rad.
    """

    quaternion: FloatArray
    covariance: FloatArray
    axis: FloatArray
    about: float


class FieldAndStrings:
    """The rotations about the field that are possible.

    Attributes:
        wrong: the fault that the newest reading shows; empty if all strings agree.
    """

    def __init__(self, strings: SolarStringModel) -> None:
        self._strings = strings
        count = len(strings.peaks)
        self._bounds = [chi_square.bound(_IMPROBABLE, n) for n in (1, count - 1, count)]
        self._against: FloatArray = np.zeros((count, _TURNS))
        self._base: FloatArray | None = None
        self.wrong = ""

    def forget(self) -> None:
        """Make all rotations possible again, after the body has rotated without a gyro."""
        self._base = None
        self._against[:] = 0.0

    def turn(self, rotation: FloatArray, seconds: float) -> None:
        """Propagate the rotations over a `rotation` (4,) of the body in `seconds`."""
        if self._base is not None:
            self._base = multiply(rotation, self._base)
        self._against = np.maximum(self._against - _MOST_VIOLATION * seconds / _MEMORY, 0.0)

    def accept(
        self, currents: FloatArray, field: FloatArray, sigma: float, sky: KnownDirections, blur: float = 0.0
    ) -> StringFix | None:
        """Return the attitude from one reading; None if no rotation is possible, or more than half a circle.

        Args:
            currents: currents of the strings (n,), A.
            field: magnetic field at the same time (3,), T, body axes.
            sigma: standard deviation of each component of the field, T.
            sky: known directions in inertial axes.
            blur: rotation of the body during the reading, rad.
        """
        strength = float(np.linalg.norm(sky.field))
        axis, across = field / np.linalg.norm(field), sigma / strength
        shares = currents / self._strings.peaks
        self.wrong = ""
        if shares.max() < self._strings.dark:
            self.wrong = f"no string has {self._strings.dark:g} of its peak current"
            self.forget()
            return None
        base = self._aligned(axis, sky.field / strength)
        whole, without = self._misfits(attitude_matrix(base), shares, axis, math.hypot(across, blur), sky)
        # Each rotation accumulates the excess over what is probable, for each string that may have failed.
        one, fewer, all_ = self._bounds
        least = without.min(axis=1)
        against = np.maximum(without / fewer, (without - least[:, None]) / one)
        self._against = np.maximum(self._against, np.minimum(against, _MOST_VIOLATION))
        if whole.min() > all_:
            self.wrong = f"string {least.argmin() + 1} does not fit the others, or the field"
        possible = np.flatnonzero((self._against <= 1.0).any(axis=0))
        if not len(possible):
            self.wrong = self.wrong or "no turn about the field explains the strings"
            self.forget()
            return None
        # The attitude is the middle of the shortest arc that contains all possible rotations.
        gaps = np.diff(possible, append=possible[0] + _TURNS)
        widest = int(gaps.argmax())
        arc = _STEP * (_TURNS - int(gaps[widest]) + 1)
        if arc > math.pi:
            return None
        middle = _STEP * int(possible[(widest + 1) % len(possible)]) + 0.5 * (arc - _STEP)
        about = 0.5 * arc / _CERTAIN
        attitude = multiply(from_rotation_vector(middle * axis), base)
        along = np.outer(axis, axis)
        return StringFix(attitude, about**2 * along + across**2 * (np.eye(3) - along), axis, about)

    def _aligned(self, axis: FloatArray, known: FloatArray) -> FloatArray:
        """Return the base (4,) after the shortest rotation of the `known` field to the direction `axis`."""
        base = np.array([0.0, 0.0, 0.0, 1.0]) if self._base is None else self._base
        shown = attitude_matrix(base) @ known
        if float(shown @ axis) < -0.99:
            # For opposite directions, a half turn about any normal axis is applied first.
            base = multiply(np.array([*tangent_basis(axis)[0], 0.0]), base)
            shown = attitude_matrix(base) @ known
        shortest = normalise(np.array([*np.cross(axis, shown), 1.0 + float(shown @ axis)]))
        self._base = multiply(shortest, base)
        return self._base

    def _misfits(
        self, base: FloatArray, shares: FloatArray, axis: FloatArray, tilt: float, sky: KnownDirections
    ) -> tuple[FloatArray, FloatArray]:
        """Return the chi-squares of the shares (n,) for t rotations: of all (t,), and without each (n, t)."""
        strings = self._strings
        sunlight, slopes = _sunlight(_rotated_about(base @ sky.sun, axis) @ strings.normals.T)
        earthlight = 0.5 * (1.0 + _rotated_about(base @ sky.nadir, axis) @ strings.normals.T)
        left = shares - sunlight - sky.light * earthlight
        own = strings.sigma**2 + (tilt**2 + _STEP**2 / 12.0) * slopes**2
        covariance = own[:, :, None] * np.eye(len(shares))
        covariance += _COMMON**2 * sunlight[:, :, None] * sunlight[:, None, :]
        covariance += sky.light_sigma**2 * earthlight[:, :, None] * earthlight[:, None, :]
        weights = np.linalg.inv(covariance)
        weighted = np.einsum("tij,tj->ti", weights, left)
        whole = np.einsum("ti,ti->t", weighted, left)
        share = weighted**2 / np.einsum("tii->ti", weights)
        return whole, np.asarray((whole[:, None] - share).T)


def _rotated_about(vector: FloatArray, axis: FloatArray) -> FloatArray:
    """Return a fixed direction (3,) in the axes of a body after each rotation about its `axis` (t, 3)."""
    along = float(vector @ axis) * axis
    return np.asarray(
        along + np.outer(np.cos(_ANGLES), vector - along) - np.outer(np.sin(_ANGLES), np.cross(axis, vector))
    )
