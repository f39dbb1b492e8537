"""A camera that the streaks show to be a little other than described: its axis, scale and distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import Pinhole

# Rounds of the contraction that takes a lens' errors out of a place: they are parts of a hundred.
_ROUNDS = 6


@dataclass(frozen=True, slots=True)
class BentPinhole(Pinhole):
    """A pinhole whose picture is displaced: by `shift` px, `scale` of the radius, `cubic` of a corner's.

    Directions and projections of the base class stay those of the pinhole; `paths` of stars are bent.
    """

    shift: tuple[float, float]
    scale: float
    cubic: float

    @property
    def _share(self) -> float:
        return self.cubic / float(np.hypot(*self.centre)) ** 2

    def bent(self, places: FloatArray) -> FloatArray:
        """Return where the lens puts what a pinhole would put at `places` (m, 2) px."""
        away = places - np.array(self.centre)
        grown = self.scale + self._share * np.sum(away**2, axis=1, keepdims=True)
        return np.asarray(places + np.array(self.shift) + grown * away)

    def straight(self, places: FloatArray) -> FloatArray:
        """Return where a pinhole would put what the lens puts at `places` (m, 2) px."""
        seen = places - np.array(self.centre) - np.array(self.shift)
        away = seen
        for _ in range(_ROUNDS):
            away = seen / (1.0 + self.scale + self._share * np.sum(away**2, axis=1, keepdims=True))
        return np.asarray(away + np.array(self.centre))

    def slopes(self, places: FloatArray) -> FloatArray:
        """Return the derivatives (m, 2, 2) of `bent` at `places` (m, 2)."""
        away = places - np.array(self.centre)
        grown = 1.0 + self.scale + self._share * np.sum(away**2, axis=1)
        outer = away[:, :, None] * away[:, None, :]
        return np.asarray(grown[:, None, None] * np.eye(2) + 2.0 * self._share * outer)

    def curving(self, places: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return the acceleration (m, 2) that the lens gives to what moves evenly at `places` (m, 2)."""
        away = places - np.array(self.centre)
        closing = np.sum(away * velocity, axis=1, keepdims=True)
        square = np.sum(velocity**2, axis=1, keepdims=True)
        return np.asarray(2.0 * self._share * (2.0 * closing * velocity + square * away))
