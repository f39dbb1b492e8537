"""The Sun's direction and the attitude from the currents of solar cells (Meller et al., chapter 2).

A solar string is a series connection of solar cells on one face of the body; it has one current. That current
is proportional to the cosine of the Sun's angle from the string's normal, and zero if the Sun is behind. The
Earth illuminates the strings as well, up to a third as strongly as the Sun, from half the sky: with the share
(1 + n e)/2 on a string of normal n, where e is nadir. This correlates the strings' errors, in one known
pattern if nadir is known, otherwise in the mean pattern over all directions. The covariance includes either
pattern.

`FieldAndStrings` gives the attitude from the magnetic field and the strings, while any one string may fail in
any way. The field leaves the rotation about it open. All rotations are tried at once: each predicts the light
of Sun and Earth on the strings. A rotation is possible if there is one string without which the other strings
agree with it, the same string in each reading; between readings the gyro propagates the rotations. The
covariance covers all rotations that are possible (solution separation, as receivers check satellite
navigation: Brown 1992, Navigation 39).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from knightcube.astro import chi_square
from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import tangent_basis
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
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
class SolarStringModel:
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


def coarse_sun(currents: FloatArray, strings: SolarStringModel, nadir: FloatArray | None = None) -> CoarseSun:
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


def _start(shares: FloatArray, strings: SolarStringModel) -> FloatArray | None:
    """Return the unit vector (3,) that the normals, weighted by their currents, point to; or None."""
    total = np.linalg.pinv(strings.normals.T @ strings.normals) @ strings.normals.T @ np.maximum(shares, 0.0)
    length = float(np.linalg.norm(total))
    return total / length if length > 0.5 * strings.dark else None


def received(cosines: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the shares of peak current at `cosines` (...), none from behind, and their slopes."""
    root = np.sqrt(cosines**2 + _SOFT**2)
    return 0.5 * (cosines + root), 0.5 * (1.0 + cosines / root)


def _earthlight(strings: SolarStringModel, nadir: FloatArray | None) -> tuple[FloatArray, FloatArray]:
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


TURNS = 180
"""Number of rotations about the field that are tried, two degrees apart."""
IMPROBABLE = 1e-4
"""Probability of the currents below which a rotation is impossible."""
MEMORY = 120.0
"""Time (s) for which an impossible rotation stays impossible: the gyro drifts."""
MOST = 3.0
"""Largest violation of the bound that is remembered, as a multiple of the bound."""
CERTAIN = 5.0
"""Distance from the attitude to the farthest possible rotation, in standard deviations of the result."""
COMMON = 0.02
"""Relative error that all strings have in common: the Sun's distance, temperature."""
_STEP = 2.0 * math.pi / TURNS
_ANGLES = _STEP * np.arange(TURNS)


@dataclass(frozen=True, slots=True, eq=False)
class KnownDirections:
    """The directions in inertial axes: field (3,) T; Sun and nadir (3,), unit vectors.

    `light` is the brightness of an Earth that fills half the sky over the Sun's, `light_sigma` its error.
    """

    field: FloatArray
    sun: FloatArray
    nadir: FloatArray
    light: float
    light_sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class StringFix:
    """An attitude: quaternion (4,), and the covariance (3, 3) rad^2 of small turns, body axes.

    `axis` (3,) is the field's direction in body axes, `about` rad the standard deviation about it.
    """

    quaternion: FloatArray
    covariance: FloatArray
    axis: FloatArray
    about: float


class FieldAndStrings:
    """Owns which turns about the field are possible.

    Attributes:
        wrong: what the newest reading shows to be wrong; empty where all strings agree.
    """

    def __init__(self, strings: SolarStringModel) -> None:
        self._strings = strings
        count = len(strings.peaks)
        self._bounds = [chi_square.bound(IMPROBABLE, n) for n in (1, count - 1, count)]
        self._against: FloatArray = np.zeros((count, TURNS))
        self._base: FloatArray | None = None
        self.wrong = ""

    def forget(self) -> None:
        """Forget which turns are possible: the body has turned without a gyro."""
        self._base = None
        self._against[:] = 0.0

    def turn(self, rotation: FloatArray, seconds: float) -> None:
        """Carry the turns on by a rotation (4,) of the body in `seconds`."""
        if self._base is not None:
            self._base = multiply(rotation, self._base)
        self._against = np.maximum(self._against - MOST * seconds / MEMORY, 0.0)

    def accept(
        self, currents: FloatArray, field: FloatArray, sigma: float, sky: KnownDirections, blur: float = 0.0
    ) -> StringFix | None:
        """Return the attitude by currents (n,) A and the field (3,) T of their time, body axes.

        `sigma` T is the error of an axis of the field, `blur` rad by which the body turned meanwhile. None
        where no turn is possible, or turns on more than half a circle are.
        """
        strength = float(np.linalg.norm(sky.field))
        axis, across = field / np.linalg.norm(field), sigma / strength
        shares = currents / self._strings.peaks
        self.wrong = ""
        if shares.max() < self._strings.dark:
            self.wrong = f"no string has {self._strings.dark:g} of its peak current"
            self.forget()
            return None
        self._align(axis, sky.field / strength)
        self._judge(*self._misfits(shares, axis, math.hypot(across, blur), sky))
        return self._fix(axis, across)

    def _align(self, axis: FloatArray, known: FloatArray) -> None:
        """Turn the base the shortest way so that it shows the field as measured."""
        if self._base is None:
            self._base = np.array([0.0, 0.0, 0.0, 1.0])
        shown = attitude_matrix(self._base) @ known
        if float(shown @ axis) < -0.99:
            # The shortest way from there is any: turn half about an axis across first.
            self._base = multiply(np.array([*tangent_basis(axis)[0], 0.0]), self._base)
            shown = attitude_matrix(self._base) @ known
        shortest = normalise(np.array([*np.cross(axis, shown), 1.0 + float(shown @ axis)]))
        self._base = multiply(shortest, self._base)

    def _misfits(
        self, shares: FloatArray, axis: FloatArray, tilt: float, sky: KnownDirections
    ) -> tuple[FloatArray, FloatArray]:
        """Return chi-squares of the shares (n,) for each turn: of all (TURNS,), without each (n, TURNS)."""
        strings = self._strings
        assert self._base is not None
        base = attitude_matrix(self._base)
        sunlight, slopes = received(_turned(base @ sky.sun, axis) @ strings.normals.T)
        earthlight = 0.5 * (1.0 + _turned(base @ sky.nadir, axis) @ strings.normals.T)
        left = shares - sunlight - sky.light * earthlight
        own = strings.sigma**2 + (tilt**2 + _STEP**2 / 12.0) * slopes**2
        covariance = own[:, :, None] * np.eye(len(shares))
        covariance += COMMON**2 * sunlight[:, :, None] * sunlight[:, None, :]
        covariance += sky.light_sigma**2 * earthlight[:, :, None] * earthlight[:, None, :]
        weights = np.linalg.inv(covariance)
        weighted = np.einsum("tij,tj->ti", weights, left)
        whole = np.einsum("ti,ti->t", weighted, left)
        share = weighted**2 / np.einsum("tii->ti", weights)
        return whole, np.asarray((whole[:, None] - share).T)

    def _judge(self, whole: FloatArray, without: FloatArray) -> None:
        """Count against each turn by how much it exceeds what is probable, for each failed string."""
        one, fewer, all_ = self._bounds
        least = without.min(axis=1)
        against = np.maximum(without / fewer, (without - least[:, None]) / one)
        self._against = np.maximum(self._against, np.minimum(against, MOST))
        if whole.min() > all_:
            self.wrong = f"string {least.argmin() + 1} does not fit the others, or the field"

    def _fix(self, axis: FloatArray, across: float) -> StringFix | None:
        """Return the middle of the shortest arc that has all possible turns."""
        possible = np.flatnonzero((self._against <= 1.0).any(axis=0))
        if not len(possible):
            self.wrong = self.wrong or "no turn about the field explains the strings"
            self.forget()
            return None
        gaps = np.diff(possible, append=possible[0] + TURNS)
        widest = int(gaps.argmax())
        arc = _STEP * (TURNS - int(gaps[widest]) + 1)
        if arc > math.pi:
            return None
        middle = _STEP * int(possible[(widest + 1) % len(possible)]) + 0.5 * (arc - _STEP)
        about = 0.5 * arc / CERTAIN
        assert self._base is not None
        attitude = multiply(from_rotation_vector(middle * axis), self._base)
        along = np.outer(axis, axis)
        return StringFix(attitude, about**2 * along + across**2 * (np.eye(3) - along), axis, about)


def _turned(vector: FloatArray, axis: FloatArray) -> FloatArray:
    """Return (TURNS, 3): a vector (3,), fixed in space, seen by a body turned about its unit `axis` (3,)."""
    along = float(vector @ axis) * axis
    return np.asarray(
        along + np.outer(np.cos(_ANGLES), vector - along) - np.outer(np.sin(_ANGLES), np.cross(axis, vector))
    )
