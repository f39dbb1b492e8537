"""By what angle all stars turn about a known axis, from the light of the whole frame.

For frames in which a few regions do not give the angle: faint streaks that come in pieces, bright ones that
all are cut by the border. A box along a circle about the axis is compared with the pixels before and behind
it, as long together as the box: a streak stands out whole when the box is as long as it is, and hardly as a
piece of itself, with more light beside it, or with darkness in the box. The squared significance of all that
stand out is largest for the true length.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import ExposedFrame, Float32Array
from knightcube.vision.streaks.maximum_likelihood.motion import Motion
from knightcube.vision.streaks.maximum_likelihood.polar_grid import polar_grid
from knightcube.vision.streaks.maximum_likelihood.running_sums import totals

# Lengths tried differ by this factor, from this many samples on.
_FACTOR = 1.1
_SHORTEST = 5
# One circle in this many suffices.
_SPARSE = 2
# Noise of a sum of samples over a pixel's and the root of their number: nine pixels each, which overlap.
_SAMPLE_NOISE = 3.1
_LEAST_SIGMAS = 5.0
# No streak counts more than this many sigmas.
_ENOUGH = 40.0


def frame_angles(frame: ExposedFrame, pinhole: Pinhole, turn: FloatArray, most: int) -> list[float]:
    """Return the `most` likeliest angles, rad, about the axis of `turn` (3,), the likeliest first."""
    # A turn by one radian has the longest steps and the widest circles.
    grid = polar_grid(pinhole, Motion.steady(turn / np.linalg.norm(turn)), _SPARSE)
    step = grid.angle / grid.length
    held = totals(frame.sums, pinhole, grid)
    held *= np.float32(1.0 / (_SAMPLE_NOISE * np.sqrt(np.median(frame.floor[::97]))))
    longest = min(len(grid.azimuth) // 2, int(np.pi / step))
    if longest < 2 * _SHORTEST:
        return []
    count = int(np.log(longest / _SHORTEST) / np.log(_FACTOR)) + 1
    widths = np.unique(np.rint(_SHORTEST * _FACTOR ** np.arange(count)).astype(np.int64))
    room = int(sharper_widths(int(widths[-1]), longest)[-1]) // 2
    # Azimuth by azimuth, so that what is compared lies side by side.
    padded = np.pad(np.ascontiguousarray(held.T), ((room, room), (0, 0)), mode="edge")
    score = np.array([_standing_out(padded, room, int(width)) for width in widths])
    before, after = np.append(0.0, score[:-1]), np.append(score[1:], 0.0)
    peak = np.flatnonzero((score > before) & (score >= after))
    peak = peak[np.argsort(-score[peak], kind="stable")][:most]
    return [_sharpened(padded, room, sharper_widths(int(widths[index]), longest)) * step for index in peak]


def _standing_out(padded: Float32Array, room: int, width: int) -> float:
    """Return the squared significance of the boxes of `width` samples that stand out most.

    `padded` (c, r) are the totals by azimuth, with `room` more on either side.
    """
    stretches = (len(padded) - 2 * room - width) // width
    outer, inner, behind, beyond = (
        padded[room + offset : room + offset + stretches * width]
        for offset in (-(width // 2), 0, width, width + width // 2)
    )
    light = behind - inner
    light *= np.float32(2.0)
    light -= beyond
    light += outer
    # The highest box of each stretch of a circle, if none beside it is higher.
    best = light.reshape(stretches, width, -1).max(axis=1)
    best *= np.float32(1.0 / np.sqrt(2.0 * width))
    around = np.pad(best, 1)
    highest = best >= _LEAST_SIGMAS
    for down in (0, 1, 2):
        for beside in (0, 1, 2):
            highest &= best >= around[down : down + stretches, beside : beside + best.shape[1]]
    return float(np.sum(np.minimum(best[highest], _ENOUGH) ** 2))


def sharper_widths(width: int, longest: int) -> IntArray:
    """Return the widths within half a step of `width`, none over `longest`."""
    room = max(1, round(0.6 * (_FACTOR - 1.0) * width))
    return np.arange(max(width - room, 2), min(width + room, longest) + 1)


def _sharpened(padded: Float32Array, room: int, widths: IntArray) -> int:
    """Return the best of the widths."""
    score = [_standing_out(padded, room, int(each)) for each in widths]
    return int(widths[int(np.argmax(score))])
