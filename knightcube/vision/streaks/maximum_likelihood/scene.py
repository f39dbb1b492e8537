"""The unknowns of the fit: a motion, a point spread, stars."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray, select
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.motion import Motion, positions
from knightcube.vision.streaks.maximum_likelihood.shutter import Shutter

PIXEL_VARIANCE = 1.0 / 12.0


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The unknowns of the fit.

    Attributes:
        motion: of the camera.
        width: px, of the point spread and the pixel's own square together.
        stars: (n, 2) px at mid-exposure.
        light: (n,) counts over the exposure.
        sky: (n,) counts a pixel about the star, beside the frame's background.
        trusted: (n,) whether the star helps to determine the shared parameters; of others only light and
            place are fitted.
    """

    motion: Motion
    width: float
    stars: FloatArray
    light: FloatArray
    sky: FloatArray
    trusted: BoolArray

    @property
    def sigma(self) -> float:
        """The standard deviation of the point spread without the pixel's square, px."""
        return float(np.sqrt(max(self.width**2 - PIXEL_VARIANCE, 0.01)))

    def select(self, chosen: BoolArray | IntArray) -> Scene:
        """Return the scene with the stars that `chosen` picks, by mask or index."""
        return select(self, chosen, "motion", "width")

    def with_stars(self, stars: FloatArray, light: FloatArray) -> Scene:
        """Return the scene with more stars (m, 2) of `light` (m,), untrusted."""
        return replace(
            self,
            stars=np.concatenate([self.stars, stars]),
            light=np.concatenate([self.light, light]),
            sky=np.concatenate([self.sky, np.zeros(len(light))]),
            trusted=np.concatenate([self.trusted, np.zeros(len(light), dtype=np.bool_)]),
        )


def window_times(pinhole: Pinhole, motion: Motion, shutter: Shutter, stars: FloatArray) -> FloatArray:
    """Return when each star (n, 2) begins and ends to be exposed, (n, 2), in exposures from mid-exposure."""
    times = np.tile([-0.5, 0.5], (len(stars), 1))
    if shutter.delay_per_row == 0.0:
        return times
    # The row of each end depends on its time: a contraction, since readout is slow beside the star.
    for _ in range(4):
        for end, nominal in enumerate((-0.5, 0.5)):
            row = positions(pinhole, motion, stars, times[:, end])[:, 1]
            times[:, end] = nominal + shutter.delay(np.clip(row, 0.0, pinhole.rows - 1.0))
    return times


def mid_exposure(pinhole: Pinhole, motion: Motion, shutter: Shutter, middles: FloatArray) -> FloatArray:
    """Return where stars are at mid-exposure whose streaks have the middles of their length at `middles`.

    All are (n, 2) px.
    """
    if not len(middles):
        return middles
    if not motion.constant:
        middles = positions(pinhole, Motion.steady(motion.middle), middles, np.full(len(middles), -1.0))
    if shutter.delay_per_row == 0.0:
        return middles
    return positions(pinhole, motion, middles, -np.asarray(shutter.delay(middles[:, 1])))


def path_lengths(pinhole: Pinhole, motion: Motion, stars: FloatArray) -> FloatArray:
    """Return the length (n,) px of the paths of `stars` (n, 2)."""
    samples = 9
    time = np.tile(np.linspace(-0.5, 0.5, samples), len(stars))
    there = positions(pinhole, motion, np.repeat(stars, samples, axis=0), time).reshape(-1, samples, 2)
    step = np.diff(there, axis=1)
    return np.asarray(np.hypot(step[..., 0], step[..., 1]).sum(axis=1))
