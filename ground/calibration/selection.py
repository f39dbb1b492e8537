"""Which frames a calibration may use: those of one lens.

A picture of another focus or zoom, or a wrongly solved one, pulls the lens of all. Such a frame disagrees
with the majority about the focal length, or has most of its matches left out by the fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ground.calibration.calibration import Calibration, calibrate
from ground.calibration.lens_fit import MatchedFrame
from ground.calibration.terms import FixedTerms, fit_terms
from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import CameraModel

# Part of its matches that a frame of the lens has believed.
_BELIEVED_PART = 0.5
# Sigmas, and a part of the focal length, by which a frame's own may differ from the median.
_SIGMAS, _PART = 5.0, 0.01
LEAST_STARS = 24
"""Believed matches that a lens must rest on: three for each of its parameters and of a frame's turns."""


@dataclass(frozen=True, slots=True, eq=False)
class Selected:
    """A lens of the terms that the stars fix, and why frames were left out: reason by number of the frame."""

    terms: FixedTerms
    left_out: dict[int, str]

    @property
    def calibration(self) -> Calibration:
        """The lens and its errors."""
        return self.terms.calibration

    @property
    def stars(self) -> int:
        """How many matches were believed."""
        return sum(int(np.count_nonzero(used)) for used in self.calibration.used)


def calibrate_one_lens(
    frames: Sequence[MatchedFrame],
    initial: CameraModel,
    focal_lengths: FloatArray,
    sigmas: FloatArray,
) -> Selected:
    """Return the lens of the frames that agree on one, begun from `initial`.

    `focal_lengths` (m,) px of each frame alone, with `sigmas` (m,) px. Raises as `calibrate`.
    """
    left_out: dict[int, str] = {}
    usual = float(np.median(focal_lengths))
    for number in np.flatnonzero(
        np.abs(focal_lengths - usual) > np.maximum(_SIGMAS * sigmas, _PART * usual)
    ).tolist():
        own = focal_lengths[number]
        left_out[number] = f"its focal length of {own:.1f} px is not {usual:.1f}"
    while True:
        kept = [number for number in range(len(frames)) if number not in left_out]
        found = calibrate([frames[number] for number in kept], initial)
        parts = np.array([used.mean() for used in found.used])
        worst = int(parts.argmin())
        if parts[worst] >= _BELIEVED_PART or len(kept) == 1:
            return Selected(fit_terms([frames[number] for number in kept], initial), left_out)
        left_out[kept[worst]] = f"the lens of the others fits {parts[worst]:.0%} of its stars"
