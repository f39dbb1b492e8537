"""Frames of a wide point spread, read in larger pixels.

Where the point spread is several pixels wide, neighbours say the same: summed they are as exact for the
motion, a fraction of the work, and streaks look as the checks of a motion expect them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import at_least
from knightcube.vision.streaks.maximum_likelihood.result import MotionResult
from knightcube.vision.streaks.maximum_likelihood.settings import LikelihoodSettings

# The point spread, px, that is left where pixels are summed.
_NARROWEST = 1.0


@dataclass(frozen=True, slots=True)
class Binning:
    """How pixels are summed: `size` x `size` of them, from pixel `first` (x, y) on, into `pinhole`'s."""

    size: int
    first: tuple[int, int]
    pinhole: Pinhole

    @classmethod
    def suited(cls, pinhole: Pinhole, psf_sigma: float) -> Binning:
        """Return the binning for a point spread of `psf_sigma` px: of single pixels where it is narrow.

        As many pixels are left out on either side, so that the optical axis stays in the middle.
        """
        for size in range(int(psf_sigma / _NARROWEST), 1, -1):
            columns, rows = (_even(length, size) for length in (pinhole.columns, pinhole.rows))
            left = pinhole.columns - size * columns, pinhole.rows - size * rows
            if min(columns, rows) > 0 and not left[0] % 2 and not left[1] % 2:
                small = Pinhole(columns, rows, pinhole.focal_length / size)
                return cls(size, (left[0] // 2, left[1] // 2), small)
        return cls(1, (0, 0), pinhole)

    def frame(self, pixels: Image, top: float) -> tuple[Image, float]:
        """Return the sums of `pixels`, and the sum that stands where any of its pixels reaches `top`."""
        if self.size == 1:
            return pixels, top
        x, y = self.first
        shape = self.pinhole.rows, self.size, self.pinhole.columns, self.size
        cut = pixels[y : y + shape[0] * self.size, x : x + shape[2] * self.size].reshape(shape)
        # A count of the frame's, so that all sums keep to the steps of its counts.
        full = max(int(cut.max()), int(np.ceil(top))) * self.size**2
        sums = cut.sum(axis=(1, 3), dtype=np.uint64)
        sums[at_least(cut, top).any(axis=(1, 3))] = full
        return sums, float(full)

    def settings(self, settings: LikelihoodSettings) -> LikelihoodSettings:
        """Return settings of the full frame as they are of the sums."""
        if self.size == 1:
            return settings
        return replace(
            settings,
            psf_sigma=settings.psf_sigma / self.size,
            line_time=None if settings.line_time is None else settings.line_time * self.size,
            knowledge=replace(
                settings.knowledge,
                centre=settings.knowledge.centre / self.size,
                line_time=settings.line_time_sigma * self.size,
            ),
        )

    def in_pixels(self, result: MotionResult) -> MotionResult:
        """Return the result of the sums in pixels of the full frame."""
        size = self.size
        if size == 1:
            return result
        square = float(size**2)
        return replace(
            result,
            length=size * result.length,
            endpoints=self._places(result.endpoints),
            stars=self._places(result.stars),
            faint_endpoints=self._places(result.faint_endpoints),
            star_covariance=square * result.star_covariance,
            endpoint_covariance=square * result.endpoint_covariance,
            psf_sigma=size * result.psf_sigma,
            reason=f"{result.reason}, in pixels summed {size} x {size}" if result.reason else "",
        )

    def _places(self, points: FloatArray) -> FloatArray:
        return np.asarray(self.size * points + (np.array(self.first) + 0.5 * (self.size - 1)))


def _even(length: int, size: int) -> int:
    """Return how many sums of `size` fit into `length`, one less where that leaves an even rest."""
    count = length // size
    return count - 1 if (length - size * count) % 2 and size % 2 else count
