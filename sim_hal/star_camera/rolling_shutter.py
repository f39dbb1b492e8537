"""The light of point sources under a rolling shutter, whose row r exposes r line times later than row 0.

Light on row r at time t counts when u = t - start - r * line_time lies within the exposure. A source is
followed in u along its own way: at u it is at y, its time start + u + y * line_time. The rows beside it see
it a few line times earlier or later, when it was that much further on; so on the detector its image is
sheared and stretched. The quadrature stays as smooth as a global shutter's: no sample is at a shutter's edge.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hal.interfaces.errors import OutOfRange
from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from sim_hal.star_camera.exposure import Span, add_patches, path_lengths, spans, touches
from sim_hal.star_camera.model import DEVICE
from sim_hal.star_camera.point_spread import Float32Array, PointSpread

OwnTimes = Callable[[FloatArray, IntArray], FloatArray]
"""Directions (m, k, 3) of sources number (k,) in the camera frame, at times (m, k) or for all (m, 1)."""

FASTEST = 0.25
"""px a line time: a source that keeps pace with the shutter is on no row, or on all of them, at once."""
SETTLED = 1e-4
"""Line times."""


@dataclass(frozen=True, slots=True)
class RollingShutter:
    """Row r exposes from `start` + r `line_time` for `exposure` s."""

    start: float
    exposure: float
    line_time: float


def expose_rolling(
    image: Float32Array,
    camera: Pinhole,
    spread: PointSpread,
    vectors: OwnTimes,
    electrons: FloatArray,
    knots: FloatArray,
    shutter: RollingShutter,
) -> None:
    """Add to `image` (rows, columns) the e- of sources that move smoothly between `knots` (j,) s.

    `electrons` (n,) is what each gives over the exposure. Raises OutOfRange when one on the detector crosses
    more than a quarter of a pixel in a line time.
    """
    everyone = np.arange(len(electrons))
    lengths = path_lengths(camera, spread, vectors(knots[:, None], everyone))
    fastest = float(np.max(lengths / np.diff(knots))) * shutter.line_time
    if fastest > FASTEST:
        raise OutOfRange(DEVICE, "a source's way in a line time", fastest, 0.0, FASTEST, "px")
    # The stretched image reaches further by 1 / (1 - speed).
    reach = math.ceil(spread.reach / (1.0 - fastest))
    # A source just above the first row or below the last lights them, but follows rows that are not there.
    knots = knots.copy()
    knots[[0, -1]] += np.array([-1.0, 1.0]) * (reach + 1) * shutter.line_time
    first, last = (
        _passes(camera, reach, vectors, everyone, shutter, phase) for phase in (0.0, shutter.exposure)
    )
    for span in spans(knots, lengths, spread):
        near = _near(camera, reach + spread.patch, vectors, everyone, span)
        near = near[(last[near] > span.starts[0]) & (first[near] < span.ends[-1])]
        if near.size:
            starts = np.clip(span.starts[:, None], first[near], last[near])
            ends = np.clip(span.ends[:, None], first[near], last[near])
            times = starts + span.nodes[:, None] * (ends - starts)
            points = camera.project(vectors(times, near))
            shift = camera.project(vectors(times + shutter.line_time, near)) - points
            # u passes more slowly than t while the source runs down after the shutter.
            light = span.weights[:, None] * (ends - starts) * (1.0 - shift[..., 1]) / shutter.exposure
            _deposit(image, spread, reach, points, shift, light * electrons[near])


def _passes(
    camera: Pinhole,
    reach: int,
    vectors: OwnTimes,
    sources: IntArray,
    shutter: RollingShutter,
    phase: float,
) -> FloatArray:
    """Return when (n,) the row that each source is on is `phase` s into its exposure."""
    outside = reach + 1.0
    times = np.full(len(sources), shutter.start + phase + 0.5 * camera.rows * shutter.line_time)
    # Each round leaves a quarter of the error or less, of those that are on the detector.
    for _ in range(math.ceil(math.log(SETTLED / camera.rows) / math.log(FASTEST)) + 1):
        row = camera.project(vectors(times[None], sources))[0, :, 1]
        row = np.clip(np.nan_to_num(row, nan=-outside), -outside, camera.rows + outside)
        before, times = times, shutter.start + phase + row * shutter.line_time
        if np.max(np.abs(times - before), initial=0.0) <= SETTLED * shutter.line_time:
            break
    return times


def _near(camera: Pinhole, margin: float, vectors: OwnTimes, sources: IntArray, span: Span) -> IntArray:
    """Return the sources that come within `margin` px of the detector at an end of `span`."""
    ends = camera.project(vectors(np.array([span.starts[:1], span.ends[-1:]]), sources))
    return np.flatnonzero(touches(ends.min(axis=0), ends.max(axis=0), camera.columns, camera.rows, margin))


def _deposit(
    image: Float32Array,
    spread: PointSpread,
    reach: int,
    points: FloatArray,
    shift: FloatArray,
    electrons: FloatArray,
) -> None:
    """Add `electrons` (m, k) at `points` (m, k, 2), shifted by `shift` (m, k, 2) px with every row."""
    low = np.floor(points.min(axis=0) + 0.5)
    high = np.floor(points.max(axis=0) + 0.5)
    seen = np.flatnonzero(touches(low, high, image.shape[1], image.shape[0], reach))
    if not seen.size:
        return
    shift = shift[:, seen]
    corner = low[seen] - reach
    size = int(np.max(high[seen] - low[seen])) + 2 * reach + 1
    place = points[:, seen] - corner
    # How many lines later than the source's own row each row of the patch is exposed: (m, k, size).
    later = np.arange(size) - place[..., 1:]
    across = spread.shares(np.clip(place[..., :1] + later * shift[..., :1], 0.0, size), size)
    down = spread.own_shares(np.clip(place[..., 1:] + later * shift[..., 1:], 0.0, size))
    down *= electrons[:, seen, None].astype(np.float32)
    patches = np.einsum("mkr,mkrc->krc", down, across)
    add_patches(image, patches, corner)
