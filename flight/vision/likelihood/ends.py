"""Whether streaks end where the motion says: light up to each end, and none beyond.

The fit sees only a few pixels beyond the ends. A turn too small by a fifth can fit what it is given, one end
of every streak and the middle; the frame beyond the other end tells.
"""

from __future__ import annotations

import numpy as np

from flight.arrays import FloatArray
from flight.pinhole import Pinhole
from flight.vision.likelihood.exposed_frame import ExposedFrame
from flight.vision.likelihood.motion import Motion, paths
from flight.vision.likelihood.scene import path_lengths

# Looked at is a stretch of this part of the path, at least so long, from so far before or beyond the end, px.
_STRETCH = 0.1
_LEAST_STRETCH = 8.0
_FROM_END = 4.0
_SAMPLES = 24
_ASIDE = np.array([-1.0, 0.0, 1.0])
# The part of a streak's light per px of length that each of the middle three pixels across has.
_MIDDLE = 0.287
_HALF = 0.5
_LEAST_VALID = 0.7


def true_ends(
    frame: ExposedFrame,
    pinhole: Pinhole,
    motion: Motion,
    stars: FloatArray,
    light: FloatArray,
    times: FloatArray,
) -> FloatArray:
    """Return 1 for each end on the detector that is where it should be, else 0, in one row (k,).

    `times` (n, 2) are when stars (n, 2) of `light` (n,) counts begin and end to be exposed. Streaks too short
    to tell have no ends here.
    """
    length = path_lengths(pinhole, motion, stars)
    long = length > 2.0 * (_FROM_END + _LEAST_STRETCH)
    if not long.any():
        return np.empty(0)
    stars, light, times, length = stars[long], light[long], times[long], length[long]
    stretch = np.maximum(_STRETCH * length, _LEAST_STRETCH)
    verdicts = []
    for end, outward in ((0, -1.0), (1, 1.0)):
        within = _brightness(frame, pinhole, motion, stars, times[:, end], -outward, stretch)
        beyond = _brightness(frame, pinhole, motion, stars, times[:, end], outward, stretch)
        expected = _MIDDLE * light / length
        told = np.isfinite(within) & np.isfinite(beyond)
        verdicts.append(((within > _HALF * expected) & (beyond < _HALF * expected))[told])
    return np.concatenate(verdicts).astype(float)


def _brightness(
    frame: ExposedFrame,
    pinhole: Pinhole,
    motion: Motion,
    stars: FloatArray,
    end: FloatArray,
    outward: float,
    stretch: FloatArray,
) -> FloatArray:
    """Return the mean counts (n,) of the pixels along a stretch off an end; NaN where too few are seen."""
    velocity = paths(pinhole, motion, stars, end).velocity
    speed = np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), 1e-3)
    distance = _FROM_END + np.linspace(0.0, 1.0, _SAMPLES) * stretch[:, None]
    time = end[:, None] + outward * distance / speed[:, None]
    there = paths(pinhole, motion, np.repeat(stars, _SAMPLES, axis=0), time.reshape(-1))
    way = there.velocity / np.maximum(np.linalg.norm(there.velocity, axis=1, keepdims=True), 1e-3)
    normal = np.stack([-way[:, 1], way[:, 0]], axis=-1)
    points = there.position[:, None] + _ASIDE[:, None] * normal[:, None]
    pixel = np.rint(points).astype(np.int64)
    seen = pinhole.contains(pixel.astype(float))
    index = np.where(seen, pixel[..., 1] * pinhole.columns + pixel[..., 0], 0)
    seen &= ~frame.bad[index]
    values = np.where(seen, frame.signal[index], 0.0).reshape(len(stars), -1).sum(axis=1)
    count = seen.reshape(len(stars), -1).sum(axis=1)
    enough = count >= _LEAST_VALID * _SAMPLES * len(_ASIDE)
    return np.where(enough, values / np.maximum(count, 1), np.nan)
