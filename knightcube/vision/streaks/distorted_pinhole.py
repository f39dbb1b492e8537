"""Pinhole camera of the streak fit with small errors of its calibration."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import FOURTH_AS, CameraKnowledge, CameraModel, Lens, Pinhole

# Number of iterations for the inversion of the distortion, which is about 1 % of the image radius.
_ROUNDS = 6


@dataclass(frozen=True, slots=True)
class DistortedPinhole(Pinhole):
    """A pinhole camera with small calibration errors: image centre, focal length and cubic distortion.

    The inherited methods project without distortion. Only the functions `paths` and `positions` apply the
    distortion.

    Attributes:
        shift: displacement (x, y) of the image centre, px.
        scale: relative error of the focal length.
        cubic: cubic distortion at the corner of the image, as a fraction of the corner's distance from the
            centre.
    """

    shift: tuple[float, float]
    scale: float
    cubic: float

    @classmethod
    def of(cls, lens: Lens) -> DistortedPinhole:
        """Return the pinhole camera with the image centre and the radial distortion of `lens`.

        The second distortion term is approximated by a cubic term and a change of scale (least squares over
        the image).
        """
        middle = lens.ideal.centre
        square = (math.hypot(*middle) / lens.focal_length) ** 2
        constant, quadratic = FOURTH_AS
        last = lens.k2 * square**2
        shift = lens.centre[0] - middle[0], lens.centre[1] - middle[1]
        cubic = lens.k1 * square + quadratic * last
        return cls(lens.columns, lens.rows, lens.focal_length, shift, constant * last, cubic)

    def binned(self, columns: int, rows: int, size: int) -> DistortedPinhole:
        """Return the camera of `columns` x `rows` bins of `size` x `size` px."""
        shift = self.shift[0] / size, self.shift[1] / size
        return DistortedPinhole(columns, rows, self.focal_length / size, shift, self.scale, self.cubic)

    @property
    def _per_square(self) -> float:
        return self.cubic / float(np.hypot(*self.centre)) ** 2

    def distorted(self, points: FloatArray) -> FloatArray:
        """Return the image positions (m, 2), px, with lens distortion, of ideal `points` (m, 2), px."""
        away = points - np.array(self.centre)
        grown = self.scale + self._per_square * np.sum(away**2, axis=1, keepdims=True)
        return np.asarray(points + np.array(self.shift) + grown * away)

    def undistorted(self, points: FloatArray) -> FloatArray:
        """Return the ideal positions (m, 2), px, of image `points` (m, 2), px, that have lens distortion."""
        shifted = points - np.array(self.centre) - np.array(self.shift)
        away = shifted
        for _ in range(_ROUNDS):
            away = shifted / (1.0 + self.scale + self._per_square * np.sum(away**2, axis=1, keepdims=True))
        return np.asarray(away + np.array(self.centre))

    def jacobian(self, points: FloatArray) -> FloatArray:
        """Return the Jacobian (m, 2, 2) of the lens distortion at ideal `points` (m, 2) px."""
        away = points - np.array(self.centre)
        grown = 1.0 + self.scale + self._per_square * np.sum(away**2, axis=1)
        outer = away[:, :, None] * away[:, None, :]
        return np.asarray(grown[:, None, None] * np.eye(2) + 2.0 * self._per_square * outer)

    def curvature(self, points: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return the acceleration (m, 2), px per exposure^2, of image points due to the distortion.

        The ideal `points` (m, 2), px, move with a constant `velocity` (m, 2), px per exposure.
        """
        away = points - np.array(self.centre)
        closing = np.sum(away * velocity, axis=1, keepdims=True)
        square = np.sum(velocity**2, axis=1, keepdims=True)
        return np.asarray(2.0 * self._per_square * (2.0 * closing * velocity + square * away))


def streak_pinhole(camera: CameraModel, knowledge: CameraKnowledge) -> Pinhole:
    """Return the camera model of the streak fit; it includes the distortion only of an estimated lens."""
    if knowledge.covariance is None or not isinstance(camera, Lens):
        return camera.ideal
    return DistortedPinhole.of(camera)
