"""The attitude by the magnetic field and solar strings, while any one string may fail in any way.

The field leaves the turn about it open. All turns are tried at once: each lets Sun and Earth shine on the
strings in its own way. A turn is possible if there is a string without which the others agree with it, the
same string in each reading; between readings the gyro carries the turns on. A string is therefore trusted as
far as the others, the field, or a rotation that has shown it the Sun vouch for it, and the claim covers all
turns that are possible (solution separation, as receivers check satellite navigation: Brown 1992, Navigation
39).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro import chi_square
from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import tangent_basis
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.vision.sun.strings import SolarStrings, received

TURNS = 180
"""Turns about the field that are tried, two degrees apart."""
IMPROBABLE = 1e-4
"""Chance of currents by which a turn is impossible."""
MEMORY = 120.0
"""s, for which an impossible turn stays impossible: the gyro drifts."""
MOST = 3.0
"""By how many times a turn can fail to be possible."""
CERTAIN = 5.0
"""Sigmas of the claim from the attitude to the farthest possible turn."""
COMMON = 0.02
"""Share by which all strings differ from their peaks together: the Sun's distance, temperature."""
_STEP = 2.0 * math.pi / TURNS
_ANGLES = _STEP * np.arange(TURNS)


@dataclass(frozen=True, slots=True, eq=False)
class Sky:
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

    def __init__(self, strings: SolarStrings) -> None:
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
        self, currents: FloatArray, field: FloatArray, sigma: float, sky: Sky, blur: float = 0.0
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
        self, shares: FloatArray, axis: FloatArray, tilt: float, sky: Sky
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
