"""A frame made ready for the fit: light above the background, its noise, and which pixels to leave out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import (
    at_least,
    box_sum,
    estimate_background,
    find_hot_pixels,
    in_steps,
    label_pixels,
    moments,
    saturation_count,
)
from knightcube.vision.streaks.geometry import PIXEL_VARIANCE
from knightcube.vision.streaks.settings import LikelihoodSettings
from knightcube.vision.streaks.streak_result import MotionResult

Float32Array = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class ExposedFrame:
    """A frame of (rows, columns), its arrays flat; a count is a step of the converter's.

    Attributes:
        shape: rows, columns.
        signal: counts above the background; sums: of it, over 3 x 3 pixels.
        floor: counts^2, variance of a pixel without a star.
        counts: as the camera gave them; top: at which a pixel saturates.
        bad: pixels to leave out: saturated or hot.
        gain: electrons a count.
        hot_pixels: how many of `bad` are hot.
    """

    shape: tuple[int, int]
    signal: Float32Array
    sums: Float32Array
    floor: Float32Array
    counts: Image
    top: float
    bad: BoolArray
    gain: float
    hot_pixels: int


def expose_frame(pixels: Image, saturation: float | None, gain: float) -> ExposedFrame:
    """Return `pixels` (rows, columns) ready for the fit, in steps of their counts.

    `saturation` in counts and `gain` in e- a count of `pixels`; a saturation of None takes the highest count
    of the frame when many pixels share it, else the top of the integer type.
    """
    top = saturation_count(pixels) if saturation is None else saturation
    pixels, step, offset = in_steps(pixels)
    top, gain = (top - offset) / step, gain * step
    background = estimate_background(pixels)
    # Written over itself: fresh megabytes cost more than the arithmetic.
    signal = background.map(background.level)
    np.subtract(pixels, signal, out=signal)
    floor = background.map(np.square(background.noise))
    bad = at_least(pixels, top)
    hot = find_hot_pixels(signal, floor)
    signal[hot] = 0.0
    bad[hot] = True
    return ExposedFrame(
        (pixels.shape[0], pixels.shape[1]),
        signal.reshape(-1),
        box_sum(signal).reshape(-1),
        floor.reshape(-1),
        pixels.reshape(-1),
        top,
        bad.reshape(-1),
        gain,
        len(hot[0]),
    )


# One noise peak fills nine pixels of the 3 x 3 sum.
_LEAST_AREA = 12
# Threshold and point spread widen a region by about this at each end, px.
_BORDER = 3


@dataclass(frozen=True, slots=True, eq=False)
class Blobs:
    """Regions, brightest first, and their pixels.

    Attributes:
        centre: (n, 2) px, of light.
        normal: (n, 2) unit vector across the region.
        length: (n,) px, of the uniform line with the region's moments.
        flux: (n,) counts.
        cut: (n,) whether the region reaches the frame's border.
        owner: (m,) region of each pixel; column, row, light: (m,) of it.
        lit: part of the frame's pixels that lie in regions, chosen or not.
    """

    centre: FloatArray
    normal: FloatArray
    length: FloatArray
    flux: FloatArray
    cut: BoolArray
    owner: IntArray
    column: IntArray
    row: IntArray
    light: FloatArray
    lit: float

    def __len__(self) -> int:
        return len(self.flux)


def find_blobs(frame: ExposedFrame, sigmas: float, most: int) -> Blobs:
    """Return the `most` brightest regions whose 3 x 3 sum exceeds `sigmas` of its noise."""
    pixel = _above(frame.sums, frame.floor, 3.0 * sigmas)
    number, count = label_pixels(pixel, frame.shape[1])
    light = np.maximum(frame.signal[pixel], 0.0).astype(np.float64)
    area = np.bincount(number, minlength=count)
    flux = np.bincount(number, light, count)
    flux[area < _LEAST_AREA] = 0.0
    chosen = np.argsort(-flux, kind="stable")[:most]
    chosen = chosen[flux[chosen] > 0.0]
    rank = np.full(count, -1)
    rank[chosen] = np.arange(len(chosen))
    owner = rank[number]
    kept = np.flatnonzero(owner >= 0)
    row, column = np.divmod(pixel[kept], frame.shape[1])
    lit = len(pixel) / frame.signal.size
    return _measured(frame, owner[kept], column, row, light[kept], len(chosen), lit)


def _above(sums: Float32Array, floor: Float32Array, sigmas: float) -> IntArray:
    """Return where (m,) flat `sums` exceed `sigmas` times the root of `floor`, ascending."""
    pixel = np.flatnonzero(sums > np.float32(sigmas * np.sqrt(floor.min())))
    return pixel[sums[pixel] > np.float32(sigmas) * np.sqrt(floor[pixel])]


def _measured(
    frame: ExposedFrame,
    owner: IntArray,
    column: IntArray,
    row: IntArray,
    light: FloatArray,
    count: int,
    lit: float,
) -> Blobs:
    found = moments(owner, column, row, light, count)
    rows, columns = frame.shape
    edge = (row < _BORDER) | (row >= rows - _BORDER) | (column < _BORDER) | (column >= columns - _BORDER)
    return Blobs(
        found.centre,
        np.stack([-np.sin(found.direction), np.cos(found.direction)], axis=-1),
        found.length,
        found.flux,
        np.bincount(owner, edge.astype(float), count) > 0.0,
        owner,
        column,
        row,
        light,
        lit,
    )


# Mean width, px, from which on a region may be solid: the brightest stars have half of it.
_BROAD = 25.0
_LEAST_LENGTH = 40.0
# Side, px, of the square that must find room in a solid region.
_SOLID = 31
# px about a solid region that are left out, too.
_ABOUT = 12


def without_glare(frame: ExposedFrame, blobs: Blobs) -> ExposedFrame | None:
    """Return `frame` without the solid ones of its regions; None when none is solid."""
    area = np.bincount(blobs.owner, minlength=len(blobs))
    broad = area > _BROAD * np.maximum(blobs.length, _LEAST_LENGTH)
    if not broad.any():
        return None
    from scipy import ndimage  # noqa: PLC0415 - few frames need it

    # What lies beyond the frame's border is as what lies at it.
    room = ndimage.minimum_filter(_drawn(frame, blobs, broad), _SOLID)
    solid = np.bincount(blobs.owner, room[blobs.row, blobs.column], len(blobs)) > 0.0
    if not solid.any():
        return None
    out = ndimage.maximum_filter(_drawn(frame, blobs, solid), 2 * _ABOUT + 1).reshape(-1)
    signal = np.where(out, np.float32(0.0), frame.signal)
    sums = box_sum(signal.reshape(frame.shape)).reshape(-1)
    return replace(frame, signal=signal, sums=sums, bad=frame.bad | out)


def _drawn(frame: ExposedFrame, blobs: Blobs, which: BoolArray) -> BoolArray:
    """Return on which pixels (rows, columns) the regions `which` (n,) lie."""
    within = which[blobs.owner]
    mask = np.zeros(frame.shape, dtype=np.bool_)
    mask[blobs.row[within], blobs.column[within]] = True
    return mask


# Brightest regions by which the responses are measured, at most and at least.
_MOST_CELL = 24
_LEAST_CELL_PIXELS = 6
# A response differs from the mean where it is this far off it, by this number of its deviations.
_UNEVEN = 0.06
_SURE = 8.0
# Deviation of a normal distribution in its quartiles' distance; error of a median over that of a mean.
_QUARTILES = 1.35
_MEDIAN = 1.25


def without_mosaic(frame: ExposedFrame, blobs: Blobs) -> ExposedFrame | None:
    """Return `frame` with all its pixels of one response; None where they have one."""
    response = _responses(blobs)
    if response is None:
        return None
    rows, columns = frame.shape
    share = np.tile(response.reshape(2, 2), (rows // 2 + 1, columns // 2 + 1))[:rows, :columns]
    each = share.astype(np.float32)
    signal = frame.signal.reshape(frame.shape) / each
    return replace(
        frame,
        signal=signal.reshape(-1),
        sums=box_sum(signal).reshape(-1),
        floor=(frame.floor / np.square(each).reshape(-1)).astype(np.float32),
    )


def _responses(blobs: Blobs) -> FloatArray | None:
    """Return the responses (4,), of mean 1, of even and odd columns of even rows, then of odd rows."""
    count = min(len(blobs), _MOST_CELL)
    if count < _LEAST_CELL_PIXELS:
        return None
    place = 4 * blobs.owner + 2 * (blobs.row % 2) + blobs.column % 2
    light = np.bincount(place, blobs.light, 4 * len(blobs)).reshape(-1, 4)[:count]
    share = light / np.mean(light, axis=1, keepdims=True)
    low, middle, high = np.quantile(share, (0.25, 0.5, 0.75), axis=0)
    off = np.abs(middle - 1.0)
    error = _MEDIAN * (high - low) / _QUARTILES / np.sqrt(count)
    if not np.any((off > _UNEVEN) & (off > _SURE * error)) or np.any(middle <= 0.0):
        return None
    return np.asarray(middle / middle.mean())


_NEAR, _FAR = 1, 3
# Brightest regions by which the width is measured, at most and at least.
_MOST_SPREAD_BLOBS = 12
_LEAST_SPREAD_PIXELS = 3


def seen_sigma(frame: ExposedFrame, blobs: Blobs) -> float | None:
    """Return the standard deviation, px, of the point spread without the pixel's square; None if unseen.

    The median of the brightest regions: another star's light beside a streak, or a bright limb, is not most.
    """
    chosen = np.flatnonzero(blobs.owner < _MOST_SPREAD_BLOBS)
    owner, columns = blobs.owner[chosen], frame.shape[1]
    pixel = blobs.row[chosen] * columns + blobs.column[chosen]
    count = min(len(blobs), _MOST_SPREAD_BLOBS)
    light = blobs.light[chosen]
    fallen = np.zeros(count)
    with np.errstate(divide="ignore", invalid="ignore"):
        for step in (1, columns):
            alike = []
            for distance in (_NEAR * step, _FAR * step):
                beside = frame.signal.take(pixel + distance, mode="clip")
                beside = beside + frame.signal.take(pixel - distance, mode="clip")
                alike.append(np.bincount(owner, light * beside, count))
            fallen += np.log(alike[0] / alike[1])
        variance = (_FAR**2 - _NEAR**2) / (4.0 * fallen)
    known = variance[np.isfinite(variance) & (variance > 0.0)]
    if len(known) < _LEAST_SPREAD_PIXELS:
        return None
    return float(np.sqrt(max(float(np.median(known)) - PIXEL_VARIANCE, 0.0)))


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
