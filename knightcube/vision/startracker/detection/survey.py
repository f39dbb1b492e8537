"""The first pass over a frame: its sky, the connected areas above the noise, and whether they are streaks.

`survey` smooths the frame, finds the pixels above the noise (`sky`) and joins them into areas. The shapes of
the brightest areas tell a frame of points from a frame of streaks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Literal, get_args

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.vision.frame.regions import label_pixels, moments
from knightcube.vision.frame.saturation import saturation_of_bright
from knightcube.vision.startracker.detection.sky import (
    BrightPixels,
    Sky,
    find_bright,
    in_counts,
    measure_sky,
    without_hot_pixels,
)

Method = Literal["psf", "window", "weighted", "gaussian", "iterative"]


CENTROIDS: tuple[Method, ...] = get_args(Method)


@dataclass(frozen=True, slots=True)
class DetectionSettings:
    """Settings of star detection; the defaults suit a camera of which nothing is known.

    Attributes:
        method: `psf` fits the point spread function, `window` takes the centre of mass (eq. 12-21), and the
            other methods weigh the pixels of the window differently (`measurement`).
        threshold_sigmas: minimum height of a peak of the smoothed frame, in units of its measured noise.
        most_stars: maximum number of stars, the brightest; the number from any sixteenth of the frame is
            limited to a quarter of it.
        psf_sigma: width of the PSF, px. None: measured from the frame, which needs several stars; give it for
            tracking windows with few stars.
        gain: electrons per count. None: measured from the residuals of the stars.
        saturation: counts at which a pixel saturates. None: the highest count of the frame if several pixels
            share it, otherwise the maximum of the integer type.
        window: side length of the centroid window, px, odd (a_ROI of eq. 12-15).
        search_radius: radius around a prediction in which `measure_near` searches, px.
    """

    method: Method = "psf"
    threshold_sigmas: float = 5.0
    most_stars: int = 60
    psf_sigma: float | None = None
    gain: float | None = None
    saturation: float | None = None
    window: int = 7
    search_radius: float = 4.0

    def __post_init__(self) -> None:
        if self.method not in CENTROIDS:
            raise ValueError(f"method = {self.method!r}: use {', '.join(CENTROIDS)}")
        for name, low, high in (
            ("threshold_sigmas", 1.0, 100.0),
            ("most_stars", 1, 10_000),
            ("psf_sigma", 0.3, 6.0),
            ("gain", 1e-6, 1e6),
            ("saturation", 1e-6, 1e9),
            ("search_radius", 1.0, 50.0),
        ):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ValueError(f"{name} = {value!r}: give {low} .. {high}")
        if self.window % 2 == 0 or not 5 <= self.window <= 31:
            raise ValueError(f"window = {self.window!r}: give an odd number of pixels, 5 .. 31")

    def in_units_of(self, unit: float) -> DetectionSettings:
        """Return the settings for a frame whose counts were divided by `unit`."""
        if unit == 1.0:
            return self
        saturation = None if self.saturation is None else self.saturation / unit
        return replace(self, saturation=saturation, gain=None if self.gain is None else self.gain * unit)


_BLOCK = 32


class FrameKind(Enum):
    """The content of a frame: stars at rest, stars drawn out to streaks, or neither."""

    POINTS = "points"
    STREAKS = "streaks"
    NEITHER = "neither"


@dataclass(frozen=True, slots=True)
class FrameShape:
    """The kind of a frame, and the median length of its streaks, px (about 0 for points)."""

    kind: FrameKind
    length: float


@dataclass(frozen=True, slots=True, eq=False)
class Areas:
    """The n connected areas of bright pixels of a frame, and their m pixels.

    Attributes:
        row, column: position of each pixel (m,).
        owner: number of the area of each pixel (m,).
        smooth: counts of the smoothed frame above its background at each pixel (m,).
        peak: whether no neighbour of the pixel is higher (m,).
        saturated: whether the pixel is saturated (m,).
        ceiling: counts at which pixels saturate; infinite if unknown.
        pixels: number of pixels of each area (n,).
        flux: sum of the counts above the background (n,).
        centre: centre of light (n, 2), px.
        length: length of a uniform line with the moments of the area, without the PSF (n,), px.
        thickness: rms width across that line (n,), px.
        direction: angle of that line to the rows (n,), rad.
        shape: rows and columns of the frame.
    """

    row: IntArray
    column: IntArray
    owner: IntArray
    smooth: FloatArray
    peak: BoolArray
    saturated: BoolArray
    ceiling: float
    pixels: IntArray
    flux: FloatArray
    centre: FloatArray
    length: FloatArray
    thickness: FloatArray
    direction: FloatArray
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.flux)


def find_areas(pixels: Image, sky: Sky, bright: BrightPixels, saturation: float | None) -> Areas:
    """Return the 8-connected areas of `bright` pixels, with the moments of `pixels` above the background."""
    owner, count = label_pixels(bright.index, bright.shape[1])
    row, column = np.divmod(bright.index, bright.shape[1])
    counts = pixels[row, column].astype(np.float64)
    light = np.maximum(counts - sky.level.at(column, row), 0.0)
    found = moments(owner, column, row, light, count)
    ceiling = saturation_of_bright(counts, pixels, saturation)
    return Areas(
        row,
        column,
        owner,
        bright.smooth,
        _peaks(bright.smooth, *_adjoining(bright.index, bright.shape[1])),
        counts >= ceiling,
        ceiling,
        np.bincount(owner, minlength=count),
        found.flux,
        found.centre,
        found.length,
        found.thickness,
        found.direction,
        bright.shape,
    )


def cluttered(areas: Areas, place: IntArray, share: float) -> BoolArray:
    """Return which pixels `place` (p, 2) lie in a 32 px block of which areas fill more than `share`.

    Blocks shifted by half a block in each direction are tested too, so that the result does not depend on
    where the blocks begin.
    """
    down, across = areas.shape[0] // _BLOCK + 2, areas.shape[1] // _BLOCK + 2
    found = np.zeros(len(place), dtype=bool)
    for shift_y in (0, _BLOCK // 2):
        for shift_x in (0, _BLOCK // 2):
            block = (areas.row + shift_y) // _BLOCK * across + (areas.column + shift_x) // _BLOCK
            filled = np.bincount(block, minlength=down * across)
            own = (place[:, 1] + shift_y) // _BLOCK * across + (place[:, 0] + shift_x) // _BLOCK
            found |= filled[own] > share * _BLOCK**2
    return found


def _adjoining(index: IntArray, columns: int) -> tuple[IntArray, IntArray]:
    """Return pairs (p,), (p,) of adjacent pixels, as positions in the increasing flat numbers `index` (m,).

    The outermost columns hold no bright pixel, so pixels at opposite borders of the frame are never paired.
    """
    pairs = []
    for step in (1, columns - 1, columns, columns + 1):
        other = np.searchsorted(index, index + step)
        other[other == len(index)] = 0
        first = np.flatnonzero(index[other] == index + step) if len(index) else other
        pairs.append((first, other[first]))
    return np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])


def _peaks(smooth: FloatArray, first: IntArray, second: IntArray) -> BoolArray:
    """Return which pixels (m,) are higher than all adjacent pixels; of equal neighbours, the last one is.

    Pixels below the noise threshold are lower than those above it.
    """
    best = np.ones(len(smooth), dtype=bool)
    best[first[smooth[first] <= smooth[second]]] = False
    best[second[smooth[second] < smooth[first]]] = False
    return best


# Number of the brightest areas that decide; a rotation streaks all of them, except those on its axis.
_LOOKED_AT = 20
_LEAST_PIXELS = 4
_SHORTEST_STREAK = 5.0
_SLENDER = 3.5
_LEAST_STREAKS = 4
_STREAKED_PART = 0.4
_ROUND = 3.0
_THICKEST = 6.0
# Maximum median sine between streaks and the flow of one rotation; lines of a foreground exceed it.
_CROOKED = 0.12


def is_streak(areas: Areas) -> BoolArray:
    """Return which areas (n,) are long and thin."""
    return np.asarray((areas.length > _SHORTEST_STREAK) & (areas.length > _SLENDER * areas.thickness))


def frame_shape(areas: Areas) -> FrameShape:
    """Return the kind of the frame: streaks if four, and 40 % of the brightest areas, are streaks."""
    chosen = np.argsort(-areas.flux, kind="stable")[: 3 * _LOOKED_AT]
    usable = (areas.pixels[chosen] >= _LEAST_PIXELS) & (areas.thickness[chosen] < _THICKEST)
    chosen = chosen[usable][:_LOOKED_AT]
    streaks = is_streak(areas)[chosen]
    points = areas.length[chosen] < _ROUND * np.maximum(areas.thickness[chosen], 1.0)
    long, short = int(np.count_nonzero(streaks)), int(np.count_nonzero(points & ~streaks))
    if (
        long >= _LEAST_STREAKS
        and long >= _STREAKED_PART * (long + short)
        and share_one_rotation(areas.centre[chosen][streaks], areas.direction[chosen][streaks])
    ):
        return FrameShape(FrameKind.STREAKS, float(np.median(areas.length[chosen][streaks])))
    if short:
        return FrameShape(FrameKind.POINTS, float(np.median(areas.length[chosen][points & ~streaks])))
    return FrameShape(FrameKind.NEITHER, 0.0)


def share_one_rotation(centre: FloatArray, direction: FloatArray) -> bool:
    """Return whether lines at `centre` (n, 2) px, `direction` (n,) rad, follow one rotation of the camera.

    Near the boresight the flow of a rotation is t + w (-y, x), and lines that follow it have no component of
    it along their normals. The best t and w are the smallest right singular vector of the products of the
    normals with the flow.
    """
    middle = centre.mean(axis=0)
    scale = float(np.abs(centre - middle).max()) or 1.0
    x, y = ((centre - middle) / scale).T
    normal = np.stack([-np.sin(direction), np.cos(direction)], axis=-1)
    products = np.column_stack([normal, normal[:, 1] * x - normal[:, 0] * y])
    tx, ty, turn = np.linalg.svd(products)[2][-1]
    flow = np.stack([tx - turn * y, ty + turn * x], axis=-1)
    speed = np.maximum(np.linalg.norm(flow, axis=1), 1e-12)
    return bool(np.median(np.abs(np.sum(flow * normal, axis=1)) / speed) < _CROOKED)


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """The first pass over a frame: its sky background and the areas above the noise.

    Attributes:
        pixels: the frame (rows, columns) in counts; hot pixels are replaced if there are many.
        unit: size of one count in the original unit of the frame.
        settings: detection settings, in counts.
        sky: the sky background.
        areas: the connected areas above the noise.
    """

    pixels: Image
    unit: float
    settings: DetectionSettings
    sky: Sky
    areas: Areas

    @property
    def shape(self) -> FrameShape:
        """Whether the areas are points or streaks."""
        return frame_shape(self.areas)


def survey(pixels: Image, settings: DetectionSettings | None = None) -> Survey:
    """Return sky and areas above the noise of a frame (rows, columns). Raises ValueError as `detect`."""
    pixels, unit = in_counts(pixels)
    settings = (settings or DetectionSettings()).in_units_of(unit)
    pixels = without_hot_pixels(pixels, settings.most_stars)
    sky = measure_sky(pixels)
    bright = find_bright(pixels, sky, settings.threshold_sigmas)
    return Survey(pixels, unit, settings, sky, find_areas(pixels, sky, bright, settings.saturation))


def kind_of_frame(pixels: Image, settings: DetectionSettings | None = None) -> FrameShape:
    """Return whether a frame (rows, columns) shows points, streaks or neither, and the median length.

    Raises ValueError as `detect`.
    """
    return survey(pixels, settings).shape
