"""Sun direction and attitude from the currents of solar cells (Meller et al., chapter 2).

A solar string is a series connection of solar cells on one face of the body, so that all its cells carry the
same current. The current is proportional to the cosine of the angle between the Sun and the string's normal,
and zero if the Sun is behind the string. The Earth also illuminates the strings, with at most a third of the
intensity of the Sun. A string with the normal n receives the fraction (1 + n.e)/2 of the light from the half
of the sky that is centred on nadir e. Light from the Earth causes correlated errors of the strings, which the
covariance of the Sun direction includes. If the nadir direction is known, the correlation is computed;
otherwise its mean over all nadir directions is used.

The class `FieldAndStrings` computes the attitude from the magnetic field and the solar strings, even if one
string fails in any way. The magnetic field does not determine the rotation about the field direction. The
estimator therefore tests rotations by all angles about the field direction, and predicts for each the
illumination of the strings by Sun and Earth. A trial rotation is possible if no string contradicts it, or if
a single string contradicts it and this string is the same in all readings. Between readings, the possible
rotations are propagated with the gyro. The covariance of the attitude includes all possible rotations
(solution separation as in receivers of satellite navigation, Brown 1992, Navigation 39).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from functools import lru_cache

import numpy as np

from knightcube.astro import chi_square
from knightcube.astro.arrays import (
    FloatArray,
    brief,
    check_finite,
    checked_deviation,
    finite_array,
    real_number,
    tangent_basis,
    unit_quaternion,
    unit_vector,
)
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.errors import ArgumentError, UsageError

_MOST_STEPS, _FULL_STEPS = 30, 8
"""Maximum number of Gauss-Newton steps, and number of initial steps that may increase chi-square."""
_SOFT = 0.05
"""Width of the range of the incidence angle's cosine in which the modelled current rises smoothly from zero.

The smooth rise makes the derivative nonzero for faces that are parallel to the Sun direction.
"""
_MOST_LIGHT = 100.0
"""Upper limit of a current as a fraction of the peak current. No illumination explains larger currents, and
the limit keeps their squares finite."""
_RARE = 3.09
"""Deviation (standard deviations) that a normal variable exceeds with a probability of 1 in 1,000."""


class CoarseSunStatus(Enum):
    """Outcome of the estimation of the Sun direction from solar strings."""

    FOUND = "found"
    DARK = "dark"
    """No string has a significant current, because of an eclipse or failed strings."""
    UNCERTAIN = "uncertain"
    """No Sun direction explains the currents, whatever the amount of light from the Earth.

    A failed string often cannot be distinguished from a string on a dark face.
    """


@dataclass(frozen=True, slots=True, eq=False)
class SolarStringModel:
    """The solar strings of a satellite, by default one on each face of a cube.

    Attributes:
        normals: outward unit vectors (n, 3) of the strings, in body axes.
        peaks: currents (n,) in full sunlight at normal incidence, A.
        sigma: standard deviation of a reading, as a fraction of the peak current, including departures from
            the cosine law.
        albedo: mean illumination by an Earth that would fill half the sky, as a fraction of the illumination
            by the Sun.
        albedo_sigma: standard deviation of the albedo, from clouds and the elevation of the Sun.
        dark: fraction of the peak current below which a string counts as dark.

    Raises:
        UsageError: if a value is out of range. The subclass ArgumentError is raised for arrays that do not
            contain finite numbers.
    """

    normals: FloatArray = field(default_factory=lambda: np.concatenate([np.eye(3), -np.eye(3)]))
    peaks: FloatArray = field(default_factory=lambda: np.ones(6))
    sigma: float = 0.025
    albedo: float = 0.15
    albedo_sigma: float = 0.15
    dark: float = 0.1

    def __post_init__(self) -> None:
        normals, peaks = finite_array("normals", self.normals), finite_array("peaks", self.peaks)
        if normals.ndim != 2 or normals.shape[1] != 3 or len(normals) < 4:
            raise UsageError(f"solar strings: normals of shape {normals.shape}: give (n, 3), n of 4 or more")
        if not np.all(np.abs(np.linalg.norm(normals, axis=1) - 1.0) < 1e-6):
            raise UsageError("solar strings: normals must be unit vectors")
        if peaks.shape != (len(normals),) or not np.all(peaks > 0.0):
            raise UsageError(f"solar strings: peaks {peaks}: give one positive current per string, in A")
        for name in ("sigma", "albedo", "albedo_sigma", "dark"):
            if not 0.0 < real_number(getattr(self, name)) < 1.0:
                text = f"{brief(getattr(self, name))}: must lie between 0 and 1"
                raise UsageError(f"solar strings: {name} {text}")
        object.__setattr__(self, "normals", normals)
        object.__setattr__(self, "peaks", peaks)


@dataclass(frozen=True, slots=True, eq=False)
class CoarseSun:
    """Sun direction from the solar strings.

    Attributes:
        status: outcome of the estimation.
        direction: unit vector (3,) to the Sun in body axes, or None unless the status is FOUND.
        basis: two unit vectors (2, 3) that are normal to the direction and to each other.
        tangent_covariance: covariance (2, 2) of the direction error along `basis`, rad^2.
        reason: reason why no direction was found.
    """

    status: CoarseSunStatus
    direction: FloatArray | None = None
    basis: FloatArray | None = None
    tangent_covariance: FloatArray | None = None
    reason: str = ""

    @property
    def sigma(self) -> float:
        """The standard deviation per axis, rad. Without a direction, the standard deviation is infinite."""
        covariance = self.tangent_covariance
        return float("inf") if covariance is None else float(np.sqrt(0.5 * np.trace(covariance)))


def coarse_sun(currents: FloatArray, strings: SolarStringModel, nadir: FloatArray | None = None) -> CoarseSun:
    """Return the Sun direction in body axes from the currents (n,) of the solar strings, A.

    The nadir direction (3,) is in body axes; an error of ten degrees has little effect. Raises ArgumentError
    if the currents are not n finite numbers, or if the nadir direction is zero or not finite.
    """
    shares = _shares(currents, strings)
    nadir = None if nadir is None else unit_vector("nadir", nadir)
    if shares.max() < strings.dark:
        return CoarseSun(CoarseSunStatus.DARK, reason=f"no string has {strings.dark:g} of its peak current")
    earth, information, averaging = _constants(strings)
    if nadir is not None:
        earth, covariance = _earthlight(strings, nadir)
        information = np.asarray(np.linalg.inv(covariance), dtype=float)
    readings = shares - earth
    # The initial guess is the mean of the normals, weighted by the currents of the strings.
    normals = strings.normals
    total = averaging @ np.maximum(shares, 0.0)
    length = float(np.linalg.norm(total))
    if not length > 0.5 * strings.dark:
        return CoarseSun(CoarseSunStatus.UNCERTAIN, reason="the currents of opposite strings cancel")
    direction, basis, inverse = _fitted_direction(total / length, readings, normals, information)
    left = readings - _sunlight(normals @ direction)[0]
    square, freedom = float(left @ information @ left), len(shares) - 2
    # The chi-square of correct currents exceeds this limit with probability 0.001 (Wilson, Hilferty 1931).
    ninth = 2.0 / (9.0 * freedom)
    if square > float(freedom * (1.0 - ninth + _RARE * np.sqrt(ninth)) ** 3):
        reason = f"no Sun direction explains the currents: chi-square {square:.0f} of {freedom}"
        return CoarseSun(CoarseSunStatus.UNCERTAIN, reason=reason)
    return CoarseSun(CoarseSunStatus.FOUND, direction, basis, inverse)


def _shares(currents: FloatArray, strings: SolarStringModel) -> FloatArray:
    """Return the currents (n,), A, as fractions of the peak currents, limited to `_MOST_LIGHT`.

    Raises ArgumentError unless the currents are n finite numbers.
    """
    return np.minimum(finite_array("currents", currents, strings.peaks.shape) / strings.peaks, _MOST_LIGHT)


def _fitted_direction(
    direction: FloatArray, readings: FloatArray, normals: FloatArray, information: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return direction (3,), tangent basis (2, 3) and covariance (2, 2) of the Sun with least chi-square.

    The Gauss-Newton iteration starts from `direction` (3,). The `readings` (n,) are the currents of strings
    with `normals` (n, 3), without earthlight and as fractions of the peak currents. The `information` (n, n)
    is the inverse of their covariance.
    """
    best, share = math.inf, 1.0
    for number in range(_MOST_STEPS):
        modelled, gradient = _sunlight(normals @ direction)
        left = readings - modelled
        square = float(left @ information @ left)
        if number < _FULL_STEPS or square <= best:
            best, start, basis = square, direction, tangent_basis(direction)
            slopes = gradient[:, None] * (normals @ basis.T)
            weighted = slopes.T @ information
            inverse = np.linalg.inv(weighted @ slopes + 1e-6 * np.eye(2))
            step = inverse @ (weighted @ left)
            # Steps are limited to 0.5 rad, because the linearisation is inaccurate far from the solution.
            step *= min(share, 0.5 / max(float(np.hypot(*step)), 1e-12))
        else:
            # Without shorter steps, the search can alternate between two directions.
            share, step = 0.5 * share, 0.5 * step
        direction = start + step @ basis
        direction = direction / np.linalg.norm(direction)
        if np.hypot(*step) < 1e-6:
            break
    return direction, basis, np.asarray(inverse)


def _sunlight(cosines: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the currents of strings as fractions of the peak currents, and their derivatives by `cosines`.

    The argument `cosines` (...) contains the cosines of the angles between the Sun and the normals of the
    strings. The current is 0 if the Sun is behind the string.
    """
    root = np.sqrt(cosines**2 + _SOFT**2)
    return 0.5 * (cosines + root), 0.5 * (1.0 + cosines / root)


def _earthlight(strings: SolarStringModel, nadir: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Return the mean currents (n,) due to Earth albedo, and the covariance (n, n) of the readings.

    Currents and readings are normalised to the peak currents.
    """
    normals, square = strings.normals, strings.albedo_sigma**2
    own = strings.sigma**2 * np.eye(len(normals))
    if nadir is not None:
        pattern = 0.5 * (1.0 + normals @ nadir)
        return strings.albedo * pattern, own + square * np.outer(pattern, pattern)
    # Averaged over all nadir directions e, (1 + n.e)/2 is 1/2, and (1 + n.e)(1 + m.e)/4 is 1/4 + n.m/12.
    even = np.full(len(normals), 0.5)
    second = 0.25 + normals @ normals.T / 12.0
    covariance = (strings.albedo**2 + square) * second - strings.albedo**2 * np.outer(even, even)
    return strings.albedo * even, own + covariance


@lru_cache(maxsize=8)
def _constants(strings: SolarStringModel) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return earthlight (n,), information (n, n) without a nadir, and the matrix (3, n) of the first guess.

    The earthlight is a fraction of the peak currents; the information is the inverse of the covariance of the
    readings. The product of the matrix and the sunlight (n,) is the initial guess of the Sun direction, not
    normalised.
    """
    earth, covariance = _earthlight(strings, None)
    normals = strings.normals
    information = np.asarray(np.linalg.inv(covariance), dtype=float)
    return earth, information, np.linalg.pinv(normals.T @ normals) @ normals.T


_TURNS = 180
"""Number of trial rotations about the direction of the magnetic field, two degrees apart."""
_IMPROBABLE = 1e-4
"""Probability of the measured currents below which a trial rotation is rejected."""
_MEMORY = 120.0
"""Time (s) in which the evidence against a trial rotation decays from its upper limit to zero."""
_MOST_VIOLATION = 3.0
"""Upper limit of a trial rotation's accumulated excess chi-square, as a multiple of the rejection limit."""
_CERTAIN = 5.0
"""Number of standard deviations from the estimated rotation angle to the farthest possible rotation angle."""
_COMMON = 0.02
"""Error common to all strings, as a fraction of their currents, due to Sun distance and temperature."""
_STEP = 2.0 * math.pi / _TURNS
_ANGLES = _STEP * np.arange(_TURNS)


@dataclass(frozen=True, slots=True, eq=False)
class KnownDirections:
    """Magnetic field, Sun and nadir in inertial axes, and the brightness of the Earth.

    Attributes:
        field: magnetic field vector (3,), T.
        sun, nadir: unit vectors (3,) to the Sun and to nadir.
        light: illumination by an Earth that would fill half the sky, as a fraction of the illumination by the
            Sun.
        light_sigma: standard deviation of `light`.

    Raises:
        ArgumentError: for a field or a direction that is zero or not finite, and for another value that is
            not finite or negative.
    """

    field: FloatArray
    sun: FloatArray
    nadir: FloatArray
    light: float
    light_sigma: float

    def __post_init__(self) -> None:
        unit_vector("field", self.field)
        object.__setattr__(self, "field", np.asarray(self.field, dtype=float))
        for name in ("sun", "nadir"):
            object.__setattr__(self, name, unit_vector(name, getattr(self, name)))
        check_finite(light=self.light)
        checked_deviation("light_sigma", self.light_sigma, "of the sunlight")


@dataclass(frozen=True, slots=True, eq=False)
class StringFix:
    """An attitude (4,), inertial to body axes, from the magnetic field and the solar strings.

    The covariance (3, 3), rad^2, is in body axes. The rotation about the field direction `axis` (3,), body
    axes, has the standard deviation `about`, rad.
    """

    quaternion: FloatArray
    covariance: FloatArray
    axis: FloatArray
    about: float


class FieldAndStrings:
    """Attitude estimator that stores which rotations about the magnetic field are possible.

    The text `wrong` describes a fault that the last reading shows, or is empty.
    """

    def __init__(self, strings: SolarStringModel) -> None:
        self._strings = strings
        count = len(strings.peaks)
        self._bounds = [chi_square.bound(_IMPROBABLE, n) for n in (1, count - 1, count)]
        self._against: FloatArray = np.zeros((count, _TURNS))
        self._base: FloatArray | None = None
        self.wrong = ""

    def forget(self) -> None:
        """Mark all rotations about the field as possible, for instance after a rotation without gyro data."""
        self._base = None
        self._against[:] = 0.0

    def turn(self, rotation: FloatArray, seconds: float) -> None:
        """Propagate the possible rotations over a `rotation` (4,) of the body within `seconds`, s.

        Raises ArgumentError for an impossible rotation, and for a time that is negative or not finite.
        """
        rotation = unit_quaternion("rotation", rotation)
        if not 0.0 <= real_number(seconds) < math.inf:
            raise ArgumentError("seconds", f"{brief(seconds)}: give a finite time of 0 s or more")
        if self._base is not None:
            self._base = multiply(rotation, self._base)
        self._against = np.maximum(self._against - _MOST_VIOLATION * seconds / _MEMORY, 0.0)

    def accept(
        self, currents: FloatArray, field: FloatArray, sigma: float, sky: KnownDirections, blur: float = 0.0
    ) -> StringFix | None:
        """Return the attitude from one reading of the currents (n,), A, or None if it is not determined.

        The magnetic field (3,), body axes, T, has the standard deviation `sigma` per component, and the body
        rotates by `blur` rad during the reading. Returns None if no rotation is possible, or if the possible
        rotations span more than half a circle. Raises ArgumentError for values that are not finite, and for a
        field of zero.
        """
        shares, axis = _shares(currents, self._strings), unit_vector("field", field)
        for name, value, unit in (("sigma", sigma, "T"), ("blur", blur, "rad")):
            check_finite(**{name: checked_deviation(name, value, unit)})
        strength = float(np.linalg.norm(sky.field))
        across, blur = min(sigma / strength, math.pi), min(blur, math.pi)
        self.wrong = ""
        if shares.max() < self._strings.dark:
            self.wrong = f"no string has {self._strings.dark:g} of its peak current"
            self.forget()
            return None
        base = self._aligned(axis, sky.field / strength)
        whole, without = self._misfits(attitude_matrix(base), shares, axis, math.hypot(across, blur), sky)
        # Excess chi-square is accumulated for each pair of a trial rotation and an assumed failed string.
        one, fewer, all_ = self._bounds
        least = without.min(axis=1)
        against = np.maximum(without / fewer, (without - least[:, None]) / one)
        self._against = np.maximum(self._against, np.minimum(against, _MOST_VIOLATION))
        if whole.min() > all_:
            self.wrong = f"string {least.argmin() + 1} contradicts the other strings or the field"
        possible = np.flatnonzero((self._against <= 1.0).any(axis=0))
        if not len(possible):
            self.wrong = self.wrong or "no rotation about the field explains the string currents"
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
        """Return an attitude (4,) that rotates the inertial field direction `known` onto the body `axis`."""
        base = np.array([0.0, 0.0, 0.0, 1.0]) if self._base is None else self._base
        shown = attitude_matrix(base) @ known
        if float(shown @ axis) < -0.99:
            # If the two directions are nearly opposite, the base attitude is first rotated by 180 deg.
            base = multiply(np.array([*tangent_basis(axis)[0], 0.0]), base)
            shown = attitude_matrix(base) @ known
        shortest = normalise(np.array([*np.cross(axis, shown), 1.0 + float(shown @ axis)]))
        self._base = multiply(shortest, base)
        return self._base

    def _misfits(
        self, base: FloatArray, shares: FloatArray, axis: FloatArray, tilt: float, sky: KnownDirections
    ) -> tuple[FloatArray, FloatArray]:
        """Return the chi-squares of the currents of the solar strings for t trial rotations.

        The values `shares` (n,) are the currents of the strings, divided by their peak currents. The first
        returned array (t,) uses all strings, and each row of the second array (n, t) omits one string.
        """
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
    """Return an inertial direction (3,) in body axes after each of t rotations about `axis`, as (t, 3)."""
    along = float(vector @ axis) * axis
    return np.asarray(
        along + np.outer(np.cos(_ANGLES), vector - along) - np.outer(np.sin(_ANGLES), np.cross(axis, vector))
    )
