"""Local maxima of a frame's areas: where stars may be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.frame.regions import label_pixels
from knightcube.vision.records import select
from knightcube.vision.startracker.detection.areas import Areas

# Real optics leave bumps on a star's wings: light falls no faster than (1 + (d / a)^2)^-b of the peak's.
_WING_SCALE, _WING_POWER, _WING_SHARE = 2.0, 2.0, 0.7
_WINGS_END = 60.0
_CELLS = 4
_MOST_COMPARED = 500


@dataclass(frozen=True, slots=True, eq=False)
class Peaks:
    """Local maxima of the smoothed frame, highest first.

    Attributes:
        place: (p, 2) px, column and row.
        height: (p,) counts of the smoothed frame.
        area: (p,) number of the area it stands on.
        core: (p,) px, radius of the saturated disc about it; 0 for none.
    """

    place: IntArray
    height: FloatArray
    area: IntArray
    core: FloatArray

    def select(self, chosen: BoolArray | IntArray) -> Peaks:
        """Return those that `chosen` picks."""
        return select(self, chosen)

    def __len__(self) -> int:
        return len(self.height)


def find_peaks(areas: Areas) -> Peaks:
    """Return the local maxima of the areas; a saturated disc counts as one, at its centre."""
    top = areas.peak
    place = np.stack([areas.column[top], areas.row[top]], axis=-1)
    peaks = Peaks(place, areas.smooth[top], areas.owner[top], np.zeros(len(place)))
    if areas.saturated.any():
        peaks = _with_cores(peaks, areas)
    return peaks.select(np.argsort(-peaks.height, kind="stable"))


def worth_measuring(peaks: Peaks, open_sky: BoolArray, shape: tuple[int, ...], most: int) -> IntArray:
    """Return which peaks (p,) to measure, highest first, without bumps on brighter stars' wings.

    Of those in the `open_sky` (p,) `most`, and of a cell of a sixteenth of `shape` a quarter of them at most,
    so that a cloud that is brighter than all stars leaves room for the stars beside it. As many of the others
    show what the sources of the foreground look like, and take no star's place.
    """
    compared = np.sort(
        np.concatenate([np.flatnonzero(part)[:_MOST_COMPARED] for part in (open_sky, ~open_sky)])
    )
    compared = compared[~on_wings(peaks.select(compared))]
    parts = (compared[open_sky[compared]], compared[~open_sky[compared]])
    return np.sort(np.concatenate([part[_spread(peaks.select(part), shape, most)] for part in parts]))


def _spread(peaks: Peaks, shape: tuple[int, ...], most: int) -> IntArray:
    """Return the first `most` of the peaks, of a cell of a sixteenth of `shape` a quarter of them at most."""
    row, column = (peaks.place[:, k] * _CELLS // shape[1 - k] for k in (1, 0))
    cell = row * _CELLS + column
    order = np.argsort(cell, kind="stable")
    rank = np.empty(len(peaks), dtype=np.int64)
    rank[order] = np.arange(len(peaks)) - np.searchsorted(cell[order], cell[order])
    return np.flatnonzero(rank < max(4, most // 4))[:most]


def on_wings(peaks: Peaks) -> BoolArray:
    """Return which peaks (p,), highest first, are no higher than a brighter one's wings might be there."""
    x, y = peaks.place.T.astype(np.float32)
    square = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2
    # Only a few pairs are near enough to ask: at 60 px wings are a millionth of the peak.
    lower, higher = np.nonzero(np.tri(len(x), k=-1, dtype=bool) & (square < _WINGS_END**2))
    # A saturated disc's wings begin at its rim.
    apart = np.maximum(np.sqrt(square[lower, higher]) - peaks.core[higher], 0.0)
    wing = _WING_SHARE * (1.0 + (apart / _WING_SCALE) ** 2) ** -_WING_POWER
    hidden = peaks.height[lower] < peaks.height[higher] * wing
    return np.bincount(lower[hidden], minlength=len(x)) > 0


def _with_cores(peaks: Peaks, areas: Areas) -> Peaks:
    """Return the peaks with one at each saturated disc's centre, and none else on the disc or its rim."""
    row, column = areas.row[areas.saturated], areas.column[areas.saturated]
    owner, count = label_pixels(row * areas.shape[1] + column, areas.shape[1])
    size = np.bincount(owner, minlength=count)
    x, y = np.bincount(owner, column, count) / size, np.bincount(owner, row, count) / size
    radius = np.sqrt(size / np.pi)
    apart = np.hypot(peaks.place[:, 0, None] - x, peaks.place[:, 1, None] - y)
    kept = ~np.any(apart < 2.0 * radius + 2.5, axis=1)
    area = np.zeros(count, dtype=np.int64)
    area[owner] = areas.owner[areas.saturated]
    height = np.zeros(count)
    np.maximum.at(height, owner, areas.smooth[areas.saturated])
    return Peaks(
        np.concatenate([peaks.place[kept], np.rint(np.stack([x, y], axis=-1)).astype(np.int64)]),
        np.concatenate([peaks.height[kept], height * np.maximum(1.0, radius**2)]),
        np.concatenate([peaks.area[kept], area]),
        np.concatenate([peaks.core[kept], radius]),
    )
