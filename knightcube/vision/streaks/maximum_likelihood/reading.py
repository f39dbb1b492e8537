"""A frame read in the pixels that suit it, without what is no star, unlike pixels evened."""

from __future__ import annotations

from dataclasses import dataclass

from knightcube.astro.arrays import Image
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.binning import Binning
from knightcube.vision.streaks.maximum_likelihood.blobs import Blobs, find_blobs
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import ExposedFrame, expose_frame
from knightcube.vision.streaks.maximum_likelihood.glare import without_glare
from knightcube.vision.streaks.maximum_likelihood.mosaic import without_mosaic
from knightcube.vision.streaks.maximum_likelihood.seen_spread import seen_sigma
from knightcube.vision.streaks.maximum_likelihood.settings import LikelihoodSettings

_MOST_BLOBS = 48
# Least width, px, and least ratio to the described width, of a point spread that the frame shows and that is
# believed: pixels are summed for it.
_WIDE = 2.2
_WIDER = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """A frame in the pixels of `binning`, its bright regions, and `sigma`, the point spread in those, px."""

    binning: Binning
    frame: ExposedFrame
    blobs: Blobs
    sigma: float


def read_frame(pixels: Image, pinhole: Pinhole, saturation: float, settings: LikelihoodSettings) -> Reading:
    """Return `pixels` (rows, columns) as they are read: as described, or as wide as they show their stars."""
    read = _read(pixels, pinhole, saturation, settings, settings.psf_sigma)
    if read.binning.size > 1:
        return read
    sigma = seen_sigma(read.frame, read.blobs)
    if sigma is None or sigma <= max(_WIDE, _WIDER * settings.psf_sigma):
        return read
    return _read(pixels, pinhole, saturation, settings, sigma)


def _read(
    pixels: Image, pinhole: Pinhole, saturation: float, settings: LikelihoodSettings, sigma: float
) -> Reading:
    """Return a frame as it is read for a point spread of `sigma` px."""
    binning = Binning.suited(pinhole, sigma)
    frame = expose_frame(*binning.frame(pixels, saturation), binning.settings(settings).gain)
    blobs = find_blobs(frame, settings.threshold_sigmas, _MOST_BLOBS)
    for without in (without_mosaic, without_glare):
        clear = without(frame, blobs)
        if clear is not None:
            frame, blobs = clear, find_blobs(clear, settings.threshold_sigmas, _MOST_BLOBS)
    return Reading(binning, frame, blobs, sigma / binning.size)
