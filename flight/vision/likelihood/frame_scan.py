"""By what angle all stars turn about a known axis, from the light of the whole frame.

For frames of which no few regions tell the angle: faint streaks that come in pieces, bright ones that all
are cut by the border. A box along a circle about the axis is held against what lies before and behind it, as
long together as the box: a streak stands out whole when the box is as long as it is, and hardly as a piece of
itself, with more light beside it, or with darkness in the box. The squared significance of all that stand out
is largest for the true length.
"""

from __future__ import annotations

import numpy as np

from flight.arrays import FloatArray
from flight.pinhole import Pinhole
from flight.vision.likelihood.exposed_frame import ExposedFrame, Float32Array
from flight.vision.likelihood.motion import Motion
from flight.vision.likelihood.polar_grid import polar_grid, totals
from flight.vision.segmentation import box_sum

# Lengths tried differ by this factor, from so many samples on.
_FACTOR = 1.1
_SHORTEST = 5
# Every so many circles do.
_SPARSE = 2
# Noise of a sum of samples over a pixel's and the root of their number: nine pixels each, which overlap.
_SAMPLE_NOISE = 3.1
_LEAST_SIGMAS = 5.0
# No streak counts more than so many sigmas.
_ENOUGH = 40.0


def frame_angles(frame: ExposedFrame, pinhole: Pinhole, turn: FloatArray, most: int) -> list[float]:
    """Return the `most` likeliest angles, rad, about the axis of `turn` (3,), the likeliest first."""
    # A turn by one radian has the longest steps and the widest circles.
    grid = polar_grid(pinhole, Motion.steady(turn / np.linalg.norm(turn)), _SPARSE)
    step = grid.angle / grid.length
    held = totals(box_sum(frame.signal.reshape(frame.shape).copy()), pinhole, grid)
    held *= np.float32(1.0 / (_SAMPLE_NOISE * np.sqrt(np.median(frame.floor[::97]))))
    longest = min(len(grid.azimuth) // 2, int(np.pi / step))
    if longest < 2 * _SHORTEST:
        return []
    count = int(np.log(longest / _SHORTEST) / np.log(_FACTOR)) + 1
    widths = np.unique(np.rint(_SHORTEST * _FACTOR ** np.arange(count)).astype(np.int64))
    score = np.array([_standing_out(held, int(width)) for width in widths])
    before, after = np.append(0.0, score[:-1]), np.append(score[1:], 0.0)
    peak = np.flatnonzero((score > before) & (score >= after))
    peak = peak[np.argsort(-score[peak], kind="stable")][:most]
    return [_sharpened(held, int(widths[index])) * step for index in peak]


def _standing_out(held: Float32Array, width: int) -> float:
    """Return the squared significance of the boxes of `width` samples that stand out most."""
    half = width // 2
    padded = np.pad(held, ((0, 0), (half, half)), mode="edge")
    size = held.shape[1] - width
    first, last = padded[:, half : half + size], padded[:, half + width : half + width + size]
    light = (last - first) * np.float32(2.0)
    light -= padded[:, 2 * half + width : 2 * half + width + size]
    light += padded[:, :size]
    # The highest box of each stretch of a circle, if none beside it is higher.
    stretches = size // width
    best = light[:, : stretches * width].reshape(len(light), stretches, width).max(axis=2)
    best *= np.float32(1.0 / np.sqrt(2.0 * width))
    around = np.pad(best, 1)
    highest = best >= _LEAST_SIGMAS
    for down in (-1, 0, 1):
        for beside in (-1, 0, 1):
            rows, columns = slice(1 + down, 1 + down + len(best)), slice(1 + beside, 1 + beside + stretches)
            highest &= best >= around[rows, columns]
    return float(np.sum(np.minimum(best[highest], _ENOUGH) ** 2))


def _sharpened(held: Float32Array, width: int) -> int:
    """Return the best width within half a step of those tried."""
    room = max(1, round(0.6 * (_FACTOR - 1.0) * width))
    widths = range(max(width - room, 2), width + room + 1)
    return widths[int(np.argmax([_standing_out(held, each) for each in widths]))]
