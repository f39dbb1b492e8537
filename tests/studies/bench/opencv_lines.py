"""OpenCV's line detectors as sources of streak endpoints: its LSD and its probabilistic Hough transform.

Both get the frame less its local background, the noise being what a grey level is measured by: LSD 8 bits of
0 to 16 sigma (without refinement, which breaks streaks that noise or a turn bends), Hough the pixels above
4 sigma. Both return pieces, and several beside one another: pieces that touch and are parallel are one
streak, its ends the mean of those farthest out. Importing this needs the extra `bench`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components

from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.vision.frame import estimate_background

_WHITE_SIGMAS = 16.0
_MASK_SIGMAS = 4.0
# Hough: pixel, angle, votes, least length and widest gap, px.
_RHO, _ANGLE, _VOTES, _LEAST, _GAP = 1.0, np.pi / 360.0, 25, 20.0, 6.0
# Pieces that are one streak: so parallel, rad, and so near, px.
_PARALLEL = np.radians(8.0)
_TOUCHING = 5.0
# Ends of pieces so near to the farthest along the streak are averaged, px.
_SAME_END = 3.0
_BORDER = 6


@dataclass(frozen=True, slots=True)
class Prepared:
    """A frame without its background: counts (rows, columns), and its noise, counts."""

    signal: Image
    noise: float


def prepare(pixels: Image) -> Prepared:
    """Return a frame (rows, columns) less its local background."""
    background = estimate_background(pixels)
    signal = pixels.astype(np.float32) - background.map(background.level)
    return Prepared(signal, float(np.median(background.noise)))


def lsd(frame: Prepared) -> FloatArray:
    """Return the segments (n, 2, 2) px of OpenCV's line segment detector."""
    grey = np.clip(frame.signal * (255.0 / (_WHITE_SIGMAS * frame.noise)), 0.0, 255.0).astype(np.uint8)
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_NONE).detect(grey)[0]
    return _segments(found)


def hough(frame: Prepared) -> FloatArray:
    """Return the segments (n, 2, 2) px of OpenCV's probabilistic Hough transform."""
    mask = (frame.signal > _MASK_SIGMAS * frame.noise).astype(np.uint8)
    return _segments(cv2.HoughLinesP(mask, _RHO, _ANGLE, _VOTES, None, _LEAST, _GAP))


DETECTORS: dict[str, Callable[[Prepared], FloatArray]] = {"opencv-lsd": lsd, "opencv-hough": hough}


def one_thread() -> None:
    """Keep OpenCV to one core, as the others."""
    cv2.setNumThreads(1)


def _segments(found: Image | None) -> FloatArray:
    empty = np.empty((0, 2, 2))
    return empty if found is None else np.asarray(found, dtype=float).reshape(-1, 2, 2)


def merge(segments: FloatArray, frame: Prepared) -> FloatArray:
    """Return streaks (m, 2, 2) px that segments (n, 2, 2) are pieces of, strongest first.

    Streaks that touch the border are left out: their ends may lie outside.
    """
    if not len(segments):
        return segments
    count, group = connected_components(_touching(segments), directed=False)
    ends = np.array([_farthest_ends(segments[group == one]) for one in range(count)])
    rows, columns = frame.signal.shape
    smooth = cv2.blur(frame.signal, (5, 5))
    middle = np.rint(segments.mean(axis=1)).astype(int)
    bright = smooth[np.clip(middle[:, 1], 0, rows - 1), np.clip(middle[:, 0], 0, columns - 1)]
    mean = np.bincount(group, bright, count) / np.bincount(group, minlength=count)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    limit = np.array([columns, rows]) - 1 - _BORDER
    inside = np.all((ends > _BORDER) & (ends < limit), axis=(1, 2)) & (length > 0.0)
    order = np.argsort(-(mean * length), kind="stable")
    return np.asarray(ends[order[inside[order]]])


def _touching(segments: FloatArray) -> BoolArray:
    """Return which segments (n, n) are parallel and have an end at the other."""
    chord = segments[:, 1] - segments[:, 0]
    angle = np.arctan2(chord[:, 1], chord[:, 0])
    apart = np.abs((angle[:, None] - angle + 0.5 * np.pi) % np.pi - 0.5 * np.pi)
    length = np.maximum(np.hypot(*chord.T), 1e-6)
    along = chord / length[:, None]
    # Ends (n, 2) of each against the line of each other: distance to its nearest point.
    offset = segments[:, None] - segments[None, :, :1]
    forward = np.einsum("ijek,jk->ije", offset, along)
    beyond = forward - np.clip(forward, 0.0, length[:, None])
    across = offset[..., 1] * along[None, :, None, 0] - offset[..., 0] * along[None, :, None, 1]
    near = np.hypot(beyond, across).min(axis=2) < _TOUCHING
    return np.asarray((near | near.T) & (apart < _PARALLEL))


def _farthest_ends(pieces: FloatArray) -> FloatArray:
    """Return the ends (2, 2) of the streak that `pieces` (k, 2, 2) make up."""
    points = pieces.reshape(-1, 2)
    centre = points.mean(axis=0)
    axis = np.linalg.eigh((points - centre).T @ (points - centre))[1][:, 1]
    along = (points - centre) @ axis
    return np.stack(
        [
            points[along <= along.min() + _SAME_END].mean(axis=0),
            points[along >= along.max() - _SAME_END].mean(axis=0),
        ]
    )
