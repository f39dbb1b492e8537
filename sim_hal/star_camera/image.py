"""Parameters of the star camera, and the rendering of frames with stars and moving sources.

The attitude during an exposure is interpolated between samples by a rotation at constant rate. Sease, eq.
2.12, integrates one constant rate from the start of the exposure. This module uses samples of the true
attitude, so that acceleration and jitter appear in the streaks. The detector adds noise, saturates and
converts charge to counts (Sease, eqs. 2.10 and 2.11).

Sease renders a still image for each of many short steps of the exposure and adds the images. This module
divides each path into spans of a few pixels and integrates the charge of a span over time by Gauss-Legendre
quadrature. Because the point spread function is separable, the charge of all samples on a small patch of
pixels is the product of two matrices, (rows, samples) and (samples, columns), so that many samples take
little computing time.

With a rolling shutter, the exposure of row r begins r line times after the exposure of row 0. Light that
reaches row r at time t is collected if the row time u = t - start - r * line_time is within the exposure. The
integration over a source's path uses u as its variable: the source is on row y at the time start + u + y *
line_time. Neighbouring rows are exposed to the source a few line times earlier or later, at another point of
its path, so the image of the source is sheared and stretched. The quadrature converges as fast as for a
global shutter, because the integrand has no discontinuity inside the integration interval.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from typing import Literal, Self

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, ndtri

from hal.interfaces.errors import OutOfRange, check_limits
from knightcube.astro import quaternion
from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, Image, IntArray
from knightcube.vision.camera.lens import Lens, Pinhole, streak_camera

DEVICE = "star camera model"

STEPS = 256
"""Rows per pixel of the point spread table, whose interpolation error is less than 1e-5 of the peak."""


@dataclass(frozen=True, slots=True)
class PointSpread:
    """A separable point spread function.

    The function `profile` returns the fraction of a source's charge on a pixel, from the distance (px)
    between the source and the pixel's centre. Charge is deposited up to `reach` whole px from the source's
    pixel. A path up to `patch` px long is integrated as one span, with `quadrature`(length) samples.
    """

    profile: Callable[[FloatArray], FloatArray]
    reach: int
    patch: float
    quadrature: Callable[[float], int]

    def shares(self, positions: FloatArray, size: int) -> Float32Array:
        """Return the charge fractions of sources on a row or column of pixels.

        The sources are at `positions` (...), px. The result (..., size) is for the first `size` pixels.
        """
        table, rise = _table(self, size)
        entry, beyond = _entries(positions)
        shares = table.take(entry, axis=0)
        shares += beyond[..., None] * rise.take(entry, axis=0)
        return np.asarray(shares)

    def own_shares(self, positions: FloatArray) -> Float32Array:
        """Return the charge fraction on each pixel of a row or column, given a source position per pixel."""
        pixel = np.arange(positions.shape[-1])
        table, rise = _table(self, len(pixel))
        entry, beyond = _entries(positions)
        return np.asarray(table[entry, pixel] + beyond * rise[entry, pixel])


@lru_cache(maxsize=8)
def integrated_gaussian(sigma: float) -> PointSpread:
    """Return a Gaussian point spread function of `sigma` px, integrated over each pixel."""

    def profile(offset: FloatArray) -> FloatArray:
        return np.asarray(ndtr((offset + 0.5) / sigma) - ndtr((offset - 0.5) / sigma))

    def quadrature(length: float) -> int:
        # About one sample per sigma is needed; 0.95 per sigma gives errors of 1e-4 of the peak.
        return 1 if length < 0.02 * sigma else math.ceil(1.5 + 0.95 * length / sigma)

    return PointSpread(profile, math.ceil(4.0 * sigma), max(4.0, 8.0 * sigma), quadrature)


@lru_cache(maxsize=8)
def bilinear_gaussian(sigma: float) -> PointSpread:
    """Return the point spread function of Sease 2013.

    The point spread function places the charge on the four nearest pixels (Sease, eqs. 2.5 and 2.6) and blurs
    it by a 3 x 3 kernel (Sease, eq. 2.9).
    """
    taps = np.exp(-0.5 * (np.array([-1.0, 0.0, 1.0]) / sigma) ** 2)
    taps /= taps.sum()

    def profile(offset: FloatArray) -> FloatArray:
        distance = np.abs(np.asarray(offset)[..., None] - np.array([-1.0, 0.0, 1.0]))
        return np.asarray(np.clip(1.0 - distance, 0.0, None) @ taps)

    def quadrature(length: float) -> int:
        # The slope of the profile is discontinuous, so the spacing of samples must be far below a pixel.
        return 1 if length < 1e-3 else math.ceil(2.0 + 8.0 * length)

    return PointSpread(profile, 2, 8.0, quadrature)


def _entries(positions: FloatArray) -> tuple[IntArray, Float32Array]:
    """Return the index of the table row below each position, and the fraction (0 to 1) to the next row."""
    scaled = positions * STEPS
    entry = scaled.astype(np.intp)
    return entry, (scaled - entry).astype(np.float32)


@lru_cache(maxsize=32)
def _table(spread: PointSpread, size: int) -> tuple[Float32Array, Float32Array]:
    """Return the table (size * STEPS + 1, size) of charge fractions, and the differences between its rows.

    Neighbouring table rows are for source positions that differ by 1/STEPS px.
    """
    positions = np.arange(size * STEPS + 2) / STEPS
    table = spread.profile(np.arange(size) - positions[:, None])
    # Each row is normalised, so that charge beyond the reach of the point spread function is not lost.
    shares = np.asarray(table / table.sum(axis=1, keepdims=True), dtype=np.float32)
    return shares[:-1], np.diff(shares, axis=0)


Vectors = Callable[[FloatArray], FloatArray]
"""Function that returns the directions (m, n, 3) of n sources in the camera frame at times (m,)."""


@dataclass(frozen=True, slots=True)
class Span:
    """Quadrature samples (m,) of a short interval of the exposure, in segments of smooth motion.

    The arrays `starts` and `ends` contain the start and end (s) of each sample's segment. The samples'
    positions `nodes` range from 0 to 1 within a segment, and the quadrature weights of a segment add up to 1.
    """

    starts: FloatArray
    ends: FloatArray
    nodes: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, segments: list[tuple[float, float, FloatArray, FloatArray]]) -> Self:
        """Return the samples of `segments`, each of which is a tuple (start, end, nodes, weights)."""
        starts, ends, nodes, weights = zip(*segments, strict=True)
        counts = [len(part) for part in nodes]
        times = np.repeat(starts, counts), np.repeat(ends, counts)
        return cls(*times, np.concatenate(nodes), np.concatenate(weights))


def expose(
    image: Float32Array,
    camera: Pinhole,
    spread: PointSpread,
    vectors: Vectors,
    electrons: FloatArray,
    knots: FloatArray,
) -> None:
    """Add the charge (e-) of sources that move smoothly between `knots` (j,), s, to `image` (rows, columns).

    `electrons` (n,) is the charge from each source over the whole exposure, from `knots[0]` to `knots[-1]`.
    """
    rate = electrons / (knots[-1] - knots[0])
    for span in spans(knots, path_lengths(camera, spread, vectors(knots)), spread):
        duration = span.ends - span.starts
        points = camera.project(vectors(span.starts + span.nodes * duration))
        _deposit(image, spread, points, (span.weights * duration)[:, None] * rate)


def spans(knots: FloatArray, lengths: FloatArray, spread: PointSpread) -> Iterator[Span]:
    """Divide the exposure into spans in which no path is longer than a patch.

    `lengths` (j - 1,) px is the longest path between consecutive `knots` (j,) s. Long intervals are divided
    and short intervals are combined, but no segment crosses a knot.
    """
    segments: list[tuple[float, float, FloatArray, FloatArray]] = []
    covered = 0.0
    for start, end, length in zip(knots[:-1].tolist(), knots[1:].tolist(), lengths.tolist(), strict=True):
        count = max(1, math.ceil(length / spread.patch))
        step, advance = (end - start) / count, length / count
        nodes, weights = _gauss_legendre(spread.quadrature(advance))
        for number in range(count):
            if segments and covered + advance > spread.patch:
                yield Span.of(segments)
                segments, covered = [], 0.0
            segments.append((start + number * step, start + (number + 1) * step, nodes, weights))
            covered += advance
    yield Span.of(segments)


@lru_cache(maxsize=128)
def _gauss_legendre(count: int) -> tuple[FloatArray, FloatArray]:
    """Return the Gauss-Legendre nodes (count,) between 0 and 1 and the weights, which add up to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1.0), 0.5 * weights


def path_lengths(camera: Pinhole, spread: PointSpread, vectors: FloatArray) -> FloatArray:
    """Return the longest path (j - 1,), px, of any source on the detector between consecutive knots."""
    points = camera.project(vectors)
    start, end = points[:-1], points[1:]
    low, high = np.minimum(start, end), np.maximum(start, end)
    on = touches(low, high, camera.columns, camera.rows, spread.reach + 2)
    length = np.hypot(end[..., 0] - start[..., 0], end[..., 1] - start[..., 1])
    return np.asarray(np.max(np.where(on, length, 0.0), axis=1, initial=0.0))


def touches(low: FloatArray, high: FloatArray, columns: int, rows: int, margin: float) -> BoolArray:
    """Return whether boxes with corners `low` and `high` (..., 2) are within `margin` px of the detector.

    A box with a NaN corner counts as outside the detector.
    """
    x = (high[..., 0] >= -margin) & (low[..., 0] <= columns - 1 + margin)
    y = (high[..., 1] >= -margin) & (low[..., 1] <= rows - 1 + margin)
    return np.asarray(x & y)


def _deposit(image: Float32Array, spread: PointSpread, points: FloatArray, electrons: FloatArray) -> None:
    """Add `electrons` (m, n) at `points` (m, n, 2), px, where the m points of a source are close together."""
    rows, columns = image.shape
    low = np.floor(points.min(axis=0) + 0.5)
    high = np.floor(points.max(axis=0) + 0.5)
    seen = np.flatnonzero(touches(low, high, columns, rows, spread.reach))
    if not seen.size:
        return
    corner = low[seen] - spread.reach
    size = int(np.max(high[seen] - low[seen])) + 2 * spread.reach + 1
    across = spread.shares(points[:, seen, 0].T - corner[:, :1], size)
    down = spread.shares(points[:, seen, 1].T - corner[:, 1:], size)
    down *= electrons[:, seen].T[..., None].astype(np.float32)
    patches = np.matmul(down.transpose(0, 2, 1), across)
    add_patches(image, patches, corner)


def add_patches(image: Float32Array, patches: Float32Array, corner: FloatArray) -> None:
    """Add `patches` (n, size, size) to `image` with their top-left pixels at `corner` (n, 2), x and y."""
    rows, columns = image.shape
    size = patches.shape[1]
    whole = np.all((corner >= 0.0) & (corner <= (columns - size, rows - size)), axis=1)
    origin = corner.astype(np.intp)
    pixel = (np.arange(size)[:, None] * columns + np.arange(size)).reshape(-1)
    index = (origin[whole, 1] * columns + origin[whole, 0])[:, None] + pixel
    np.add.at(image.reshape(-1), index.reshape(-1), patches[whole].reshape(-1))
    for patch, (left, top) in zip(patches[~whole], origin[~whole].tolist(), strict=True):
        right, bottom = min(left + size, columns), min(top + size, rows)
        skip_x, skip_y = max(0, -left), max(0, -top)
        part = patch[skip_y : bottom - top, skip_x : right - left]
        image[top + skip_y : bottom, left + skip_x : right] += part


OwnTimes = Callable[[FloatArray, IntArray], FloatArray]
"""Function from times (m, k) or (m, 1) and source indices (k,) to camera-frame directions (m, k, 3)."""

FASTEST = 0.25
"""Largest speed (px per line time) of a source; the rolling shutter moves at a speed of 1."""
SETTLED = 1e-4
"""Tolerance (line times) of the iterated time at which the row of a source is exposed."""


@dataclass(frozen=True, slots=True)
class RollingShutter:
    """A rolling shutter, which exposes row r from `start` + r * `line_time` for `exposure` s."""

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
    """Add the charge (e-) of sources that move smoothly between `knots` (j,), s, to `image` (rows, columns).

    `electrons` (n,) is the charge from each source over the exposure. Raises OutOfRange for a source on the
    detector that moves more than a quarter of a pixel in a line time.
    """
    everyone = np.arange(len(electrons))
    lengths = path_lengths(camera, spread, vectors(knots[:, None], everyone))
    fastest = float(np.max(lengths / np.diff(knots))) * shutter.line_time
    if fastest > FASTEST:
        raise OutOfRange(DEVICE, "motion of a source in a line time", fastest, 0.0, FASTEST, "px")
    # The image of a source that moves by v rows per line time is stretched by the factor 1 / (1 - v).
    reach = math.ceil(spread.reach / (1.0 - fastest))
    # A source just outside the first or last row still adds charge to that row.
    knots = knots.copy()
    knots[[0, -1]] += np.array([-1.0, 1.0]) * (reach + 1) * shutter.line_time
    phases = 0.0, shutter.exposure
    first, last = (_passes(camera, reach, vectors, everyone, shutter, phase) for phase in phases)
    for span in spans(knots, lengths, spread):
        near = _near(camera, reach + spread.patch, vectors, everyone, span)
        near = near[(last[near] > span.starts[0]) & (first[near] < span.ends[-1])]
        if near.size:
            starts = np.clip(span.starts[:, None], first[near], last[near])
            ends = np.clip(span.ends[:, None], first[near], last[near])
            times = starts + span.nodes[:, None] * (ends - starts)
            points = camera.project(vectors(times, near))
            shift = camera.project(vectors(times + shutter.line_time, near)) - points
            # The factor 1 - v conserves the charge of a source that moves down by v rows per line time.
            light = span.weights[:, None] * (ends - starts) * (1.0 - shift[..., 1]) / shutter.exposure
            _deposit_rows(image, spread, reach, points, shift, light * electrons[near])


def _passes(
    camera: Pinhole, reach: int, vectors: OwnTimes, sources: IntArray, shutter: RollingShutter, phase: float
) -> FloatArray:
    """Return the times (n,), s, at which the row of each source has been exposed for `phase` s."""
    outside = reach + 1.0
    times = np.full(len(sources), shutter.start + phase + 0.5 * camera.rows * shutter.line_time)
    # For sources on the detector, each iteration reduces the time error to a quarter or less.
    for _ in range(math.ceil(math.log(SETTLED / camera.rows) / math.log(FASTEST)) + 1):
        row = camera.project(vectors(times[None], sources))[0, :, 1]
        row = np.clip(np.nan_to_num(row, nan=-outside), -outside, camera.rows + outside)
        before, times = times, shutter.start + phase + row * shutter.line_time
        if np.max(np.abs(times - before), initial=0.0) <= SETTLED * shutter.line_time:
            break
    return times


def _near(camera: Pinhole, margin: float, vectors: OwnTimes, sources: IntArray, span: Span) -> IntArray:
    """Return the indices of sources whose path during `span` comes within `margin` px of the detector."""
    ends = camera.project(vectors(np.array([span.starts[:1], span.ends[-1:]]), sources))
    return np.flatnonzero(touches(ends.min(axis=0), ends.max(axis=0), camera.columns, camera.rows, margin))


def _deposit_rows(
    image: Float32Array,
    spread: PointSpread,
    reach: int,
    points: FloatArray,
    shift: FloatArray,
    electrons: FloatArray,
) -> None:
    """Add `electrons` (m, k) at `points` (m, k, 2), px, of sources that move by `shift` px per line time."""
    low = np.floor(points.min(axis=0) + 0.5)
    high = np.floor(points.max(axis=0) + 0.5)
    seen = np.flatnonzero(touches(low, high, image.shape[1], image.shape[0], reach))
    if not seen.size:
        return
    shift = shift[:, seen]
    corner = low[seen] - reach
    size = int(np.max(high[seen] - low[seen])) + 2 * reach + 1
    place = points[:, seen] - corner
    # `later` (m, k, size): delay (line times) of each patch row's exposure after that of the source's row.
    later = np.arange(size) - place[..., 1:]
    across = spread.shares(np.clip(place[..., :1] + later * shift[..., :1], 0.0, size), size)
    down = spread.own_shares(np.clip(place[..., 1:] + later * shift[..., 1:], 0.0, size))
    down *= electrons[:, seen, None].astype(np.float32)
    patches = np.einsum("mkr,mkrc->krc", down, across)
    add_patches(image, patches, corner)


HotPixel = tuple[int, int, float]
"""Column and row of a hot pixel, and its dark current (e-/s) in excess of the other pixels."""

# Minimum, maximum and unit of each camera parameter.
_LIMITS: dict[str, tuple[float, float, str]] = {
    "columns": (1, 16_384, "px"),
    "rows": (1, 16_384, "px"),
    "field_of_view": (1e-4, 2.8, "rad"),
    "aperture": (1e-4, 10.0, "m"),
    "zero_magnitude_flux": (1.0, 1e13, "e-/s/m^2"),
    "read_noise": (0.0, 1e5, "e-"),
    "dark_current": (0.0, 1e8, "e-/s"),
    "gain": (1e-3, 1e5, "e-/count"),
    "pedestal": (0.0, 65_535.0, "counts"),
    "bits": (1, 16, "bit"),
    "full_well": (1.0, 1e9, "e-"),
    "psf_sigma": (0.2, 20.0, "px"),
    "line_time": (0.0, 0.01, "s"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class StarCameraModel:
    """A star camera; the defaults describe a CubeSat camera with 1024 x 1024 px over 20 degrees.

    Attributes:
        columns: number of pixel columns.
        rows: number of pixel rows.
        field_of_view: angle across the columns, from edge to edge, rad.
        lens: camera geometry with distortion, which replaces the pinhole of `field_of_view` unless None.
        aperture: diameter of the aperture, m.
        zero_magnitude_flux: charge rate from a source of V = 0, e-/s per m^2 of aperture (Sease, eq. 2.7,
            where 19,000 is per mm^2).
        read_noise: standard deviation of the read noise, e-.
        dark_current: dark current of each pixel, e-/s.
        gain: charge per count, e-, which Sease 2013 calls quantum efficiency.
        pedestal: counts added before the analogue-to-digital conversion, so that negative noise is not
            clipped.
        bits: resolution of the analogue-to-digital converter, bits.
        full_well: charge capacity of a pixel, e-.
        psf_sigma: standard deviation of the Gaussian point spread function, px.
        psf: "integrated" integrates the Gaussian over each pixel. "bilinear" places the charge on four pixels
            and blurs it with a sampled 3 x 3 kernel (Sease, eqs. 2.5, 2.6, 2.9).
        noise: "poisson" is Poisson noise with Gaussian read noise. "uniform" is the uniform noise of Sease,
            eq. 2.11.
        hot_pixels: position and excess dark current of each hot pixel (`HotPixel`).
        line_time: time between the exposures of consecutive rows, s; 0 is a global shutter.
        background_gradient: gradient of the stray light along x and y, counts/px; the stray light is zero in
            the darkest corner of the image.
    """

    columns: int = 1024
    rows: int = 1024
    field_of_view: float = math.radians(20.0)
    aperture: float = 0.025
    zero_magnitude_flux: float = 1.9e10
    read_noise: float = 10.0
    dark_current: float = 50.0
    gain: float = 1.0
    pedestal: float = 100.0
    bits: int = 12
    full_well: float = 20_000.0
    psf_sigma: float = 1.0
    psf: Literal["integrated", "bilinear"] = "integrated"
    noise: Literal["poisson", "uniform"] = "poisson"
    hot_pixels: tuple[HotPixel, ...] = ()
    line_time: float = 0.0
    background_gradient: tuple[float, float] = (0.0, 0.0)
    lens: Lens | None = None

    def __post_init__(self) -> None:
        check_limits(DEVICE, self, _LIMITS)
        if self.lens is not None and (self.lens.rows, self.lens.columns) != (self.rows, self.columns):
            raise ValueError(
                f"{DEVICE}: {self.columns} x {self.rows} pixels behind a lens of "
                f"{self.lens.columns} x {self.lens.rows}: give both the same"
            )
        for name, choices in (("psf", ("integrated", "bilinear")), ("noise", ("poisson", "uniform"))):
            if getattr(self, name) not in choices:
                raise ValueError(f"{DEVICE}: {name} = {getattr(self, name)!r}: use {' or '.join(choices)}")
        for slope in self.background_gradient:
            if not -100.0 <= slope <= 100.0:
                raise OutOfRange(DEVICE, "background_gradient", slope, -100.0, 100.0, "counts/px")
        for column, row, current in self.hot_pixels:
            if not 0 <= column < self.columns:
                raise OutOfRange(DEVICE, "hot pixel's column", column, 0, self.columns - 1, "px")
            if not 0 <= row < self.rows:
                raise OutOfRange(DEVICE, "hot pixel's row", row, 0, self.rows - 1, "px")
            if not 0.0 <= current <= 1e8:
                raise OutOfRange(DEVICE, "hot pixel's dark current", current, 0.0, 1e8, "e-/s")

    @property
    def pinhole(self) -> Pinhole:
        """Geometry of the camera (Sease, eqs. 2.3 and 2.4, corrected), with the distortion of its lens."""
        if self.lens is not None:
            return streak_camera(self.lens)
        return Pinhole.from_field_of_view(self.columns, self.rows, self.field_of_view)

    @property
    def highest_count(self) -> int:
        """Count at which the analogue-to-digital converter saturates."""
        return (1 << self.bits) - 1

    @property
    def count_type(self) -> type[np.uint8] | type[np.uint16]:
        """Smallest unsigned integer type that holds a count."""
        return np.uint8 if self.bits <= 8 else np.uint16

    def exposure_within(self, span: float) -> float:
        """Return the exposure (s) of each row if all rows together take `span` s.

        With a rolling shutter, `span` consists of the exposure and one line time per row. Raises OutOfRange
        if `span` is not longer than the line times of all rows.
        """
        readout = self.rows * self.line_time
        if not span > readout:
            raise OutOfRange(DEVICE, "the attitude history's length", span, readout, math.inf, "s")
        return span - readout

    def electrons(self, magnitudes: npt.ArrayLike, exposure: float) -> FloatArray:
        """Return the charge (e-) from sources of Johnson V `magnitudes` in `exposure` s (Sease, eq. 2.8)."""
        area = 0.25 * math.pi * self.aperture**2
        brightness = 10.0 ** (-0.4 * np.asarray(magnitudes, dtype=float))
        return np.asarray(self.zero_magnitude_flux * area * exposure * brightness)


def scatter_hot_pixels(
    model: StarCameraModel, count: int, mean_current: float, rng: np.random.Generator
) -> StarCameraModel:
    """Return `model` with `count` random hot pixels.

    The dark currents are exponentially distributed with the mean `mean_current` (e-/s).
    """
    places = rng.choice(model.columns * model.rows, size=count, replace=False)
    currents = rng.exponential(mean_current, size=count)
    hot = tuple(
        (int(place % model.columns), int(place // model.columns), float(current))
        for place, current in zip(places, currents, strict=True)
    )
    return replace(model, hot_pixels=hot)


GREATEST_TURN = 0.5 * np.pi
"""Largest rotation (rad) between attitude samples; beyond pi, interpolation would reverse the rotation."""


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeHistory:
    """Attitudes (k, 4), ICRS into camera, at `times` (k,), s, from the start to the end of the exposure."""

    times: FloatArray
    quaternions: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", np.asarray(self.times, dtype=float))
        object.__setattr__(self, "quaternions", np.asarray(self.quaternions, dtype=float))
        count = len(self.times) if self.times.ndim == 1 else 0
        if count < 2 or self.quaternions.shape != (count, 4):
            raise ValueError(
                f"{DEVICE}: times {self.times.shape} and quaternions {self.quaternions.shape}: "
                "give (k,) and (k, 4), k of 2 or more, from the start to the end of the exposure"
            )
        step = np.diff(self.times)
        if not np.all((step > 0.0) & np.isfinite(step)):
            raise OutOfRange(
                DEVICE, "time between two attitude samples", float(np.min(step)), 0.0, np.inf, "s"
            )
        length = np.linalg.norm(self.quaternions, axis=1)
        worst = float(length[np.argmax(np.abs(length - 1.0))])
        if not abs(worst - 1.0) < 1e-6:
            raise OutOfRange(DEVICE, "norm of an attitude quaternion", worst, 1.0 - 1e-6, 1.0 + 1e-6, "")
        greatest = float(np.max(_turns(self.quaternions)))
        if greatest > GREATEST_TURN:
            raise OutOfRange(
                DEVICE, "rotation between two attitude samples", greatest, 0.0, GREATEST_TURN, "rad"
            )

    @property
    def span(self) -> float:
        """Time (s) from the first attitude sample to the last."""
        return float(self.times[-1] - self.times[0])

    def at(self, times: FloatArray) -> FloatArray:
        """Return the attitudes (m, 4) at `times` (m,), s, extrapolated beyond the first and last sample."""
        return _interpolate(self.times, self.quaternions, times)

    def matrices_at(self, times: FloatArray) -> FloatArray:
        """Return the attitude matrices (m, 3, 3), ICRS into camera, at `times` (m,), s."""
        return quaternion.attitude_matrix(self.at(times))

    def knots(self, tolerance: float, longest_turn: float) -> FloatArray:
        """Return the knots (j,), s: times between which the rotation is small and its rate is constant.

        Between two knots the attitude is within `tolerance` rad of a rotation at constant rate, and the
        rotation is at most `longest_turn` rad. The number of knots depends on the motion and not on the
        number of samples.
        """
        last = len(self.times) - 1
        kept = np.arange(last + 1)
        # The longest intervals are tried first, because the rate is nearly constant in most exposures.
        for power in range((last - 1).bit_length(), 0, -1):
            thinned = np.append(np.arange(0, last, 1 << power), last)
            guess = _interpolate(self.times[thinned], self.quaternions[thinned], self.times)
            if np.max(quaternion.angle_between(guess, self.quaternions)) <= tolerance:
                kept = thinned
                break
        times = self.times[kept]
        parts = np.maximum(1, np.ceil(_turns(self.quaternions[kept]) / longest_turn)).astype(int)
        within = np.concatenate([np.arange(part) / part for part in parts])
        starts = np.repeat(times[:-1], parts) + within * np.repeat(np.diff(times), parts)
        return np.append(starts, times[-1])


def _interpolate(times: FloatArray, quaternions: FloatArray, wanted: FloatArray) -> FloatArray:
    before = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, len(times) - 2)
    start, end = quaternions[before], quaternions[before + 1]
    turn = quaternion.to_rotation_vector(quaternion.multiply(end, quaternion.conjugate(start)))
    share = (wanted - times[before]) / (times[before + 1] - times[before])
    return quaternion.multiply(quaternion.from_rotation_vector(share[:, None] * turn), start)


def _turns(quaternions: FloatArray) -> FloatArray:
    return quaternion.angle_between(quaternions[1:], quaternions[:-1])


FAINT_SHARE = 0.25
"""Largest ratio of charge (e-) to background noise variance (e-^2) for drawing all noise as one Gaussian."""
GREATEST_SKEWNESS = 0.05
"""Largest skewness of noise that is drawn as Gaussian.

By the Edgeworth series, the error of a probability is then below 0.004.
"""

SLICES, OUTER_SLICES = 1 << 16, 64
"""Number of equally probable slices of the normal distribution, and number of tail slices on each side."""


def counts(
    model: StarCameraModel, electrons: Float32Array, exposure: float, rng: np.random.Generator
) -> Image:
    """Return the frame (rows, columns), counts, for `electrons` (rows, columns) after `exposure` s."""
    light = electrons
    if model.hot_pixels:
        light = electrons.copy()
        column, row, current = np.array(model.hot_pixels).T
        np.add.at(light, (row.astype(int), column.astype(int)), (current * exposure).astype(np.float32))
    if any(model.background_gradient):
        across, down = model.background_gradient
        stray = across * np.arange(model.columns) + down * np.arange(model.rows)[:, None]
        light = light + (model.gain * (stray - stray.min())).astype(np.float32)
    draw = _uniform if model.noise == "uniform" else _poisson
    signal = draw(model, light, exposure, rng)
    signal *= np.float32(1.0 / model.gain)
    signal += np.float32(model.pedestal + 0.5)  # adding 0.5 makes the truncation round to the nearest count
    np.clip(signal, 0.0, model.highest_count, out=signal)
    return np.asarray(signal.astype(model.count_type))


def _poisson(
    model: StarCameraModel, light: Float32Array, exposure: float, rng: np.random.Generator
) -> Float32Array:
    """Return the charge (e-) with shot noise and read noise, clipped at the full well.

    Poisson and Gaussian noise replace the uniform noise of Sease, eqs. 2.10 and 2.11. In pixels with little
    light and nearly Gaussian background noise, one Gaussian with the total mean and variance is drawn.
    """
    dark = model.dark_current * exposure
    variance = model.read_noise**2 + dark
    faint = FAINT_SHARE * variance
    gaussian = all(dark + mean <= GREATEST_SKEWNESS * (variance + mean) ** 1.5 for mean in (0.0, faint))
    roomy = model.full_well > dark + faint + 10.0 * np.sqrt(dark + faint)
    if not (gaussian and roomy):
        return _exact(model, light.reshape(-1), dark, rng).reshape(light.shape)
    signal = light + np.float32(variance)
    np.sqrt(signal, out=signal)
    signal *= standard_normal(light.shape, rng)
    signal += light
    signal += np.float32(dark)
    bright = np.flatnonzero(light > faint)
    signal.reshape(-1)[bright] = _exact(model, light.reshape(-1)[bright], dark, rng)
    return signal


def standard_normal(shape: tuple[int, ...], rng: np.random.Generator) -> Float32Array:
    """Return standard normal random numbers four times as fast as the generator of numpy.

    A 16-bit number selects one of 65,536 slices of equal probability, and the draw is the centre of the
    slice. In the outermost slices, which are wide, the draw is a random point of the slice, so that the tails
    of the distribution are correct.
    """
    count = int(np.prod(shape))
    words = rng.integers(0, 2**64, size=(count + 3) // 4, dtype=np.uint64)
    slices = words.view(np.uint16)[:count]
    normal = _slice_middles().take(slices)
    # The 16-bit sum wraps around, so that only the slices of both tails give sums below 2 * OUTER_SLICES.
    outer = np.flatnonzero(slices + np.uint16(OUTER_SLICES) < 2 * OUTER_SLICES)
    chance = (slices[outer] + rng.uniform(2.0**-32, 1.0, size=len(outer))) / SLICES
    normal[outer] = ndtri(chance)
    return np.asarray(normal.reshape(shape))


@cache
def _slice_middles() -> Float32Array:
    return np.asarray(ndtri((np.arange(SLICES) + 0.5) / SLICES), dtype=np.float32)


def _exact(
    model: StarCameraModel, light: Float32Array, dark: float, rng: np.random.Generator
) -> npt.NDArray[np.float32]:
    # A mean of ten full wells plus 1,000 e- always saturates, and a larger mean would overflow `rng.poisson`.
    mean = np.minimum(light.astype(np.float64) + dark, 10.0 * model.full_well + 1000.0)
    collected = np.minimum(rng.poisson(mean), model.full_well).astype(np.float32)
    collected += np.float32(model.read_noise) * rng.standard_normal(light.shape, dtype=np.float32)
    return np.asarray(collected)


def _uniform(
    model: StarCameraModel, light: Float32Array, exposure: float, rng: np.random.Generator
) -> Float32Array:
    """Return the charge (e-) with added uniform noise as in Sease 2013.

    The noise is the sum of sqrt(signal) and sqrt(read noise^2 + dark charge), each multiplied by a uniform
    draw from 0 to 1.
    """
    rest = np.sqrt(model.read_noise**2 + model.dark_current * exposure)
    signal = light + np.sqrt(light) * rng.random(light.shape, dtype=np.float32)
    signal += np.float32(rest) * rng.random(light.shape, dtype=np.float32)
    return np.minimum(signal, np.float32(model.full_well))


SMOOTHNESS = 0.01
"""Largest error (px at the boresight) that the assumption of a constant rate between knots causes."""
LONGEST_TURN = 0.05
"""Largest rotation (rad) between knots; an arc of this angle is 0.01 % longer than its chord."""


@dataclass(frozen=True, slots=True, eq=False)
class SourceTrack:
    """A moving point source of Johnson V `magnitude`, with directions (k, 3), ICRS, at `times` (k,), s.

    Between two samples the source moves uniformly along the chord. The samples must cover the exposure.
    """

    times: FloatArray
    directions: FloatArray
    magnitude: float

    def __post_init__(self) -> None:
        times, directions = np.asarray(self.times, dtype=float), np.asarray(self.directions, dtype=float)
        if times.ndim != 1 or len(times) < 2 or directions.shape != (len(times), 3):
            raise ValueError(
                f"source track: times {times.shape} and directions {directions.shape}: "
                "give (k,) and (k, 3), k of 2 or more"
            )
        if not (np.all(np.diff(times) > 0.0) and np.all(np.isfinite(times))):
            raise ValueError("source track: its times must be finite and increase")
        if not np.all(np.abs(np.linalg.norm(directions, axis=1) - 1.0) < 1e-6):
            raise ValueError("source track: its directions must be finite unit vectors")
        if not np.isfinite(self.magnitude):
            raise ValueError(f"source track: magnitude {self.magnitude!r} must be finite")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "directions", directions)

    def directions_at(self, times: FloatArray) -> FloatArray:
        """Return the unit vectors (m, 3) to the source at `times` (m,), s, extrapolated if needed."""
        before = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        share = (times - self.times[before]) / (self.times[before + 1] - self.times[before])
        start, end = self.directions[before], self.directions[before + 1]
        chord = start + share[:, None] * (end - start)
        return np.asarray(chord / np.linalg.norm(chord, axis=-1, keepdims=True))


def expected_electrons(
    model: StarCameraModel,
    directions: FloatArray,
    magnitudes: npt.ArrayLike,
    times: FloatArray,
    quaternions: FloatArray,
    extra: Sequence[SourceTrack] = (),
) -> FloatArray:
    """Return the charge (rows, columns) of an exposure, e-, without noise, dark current and saturation.

    `directions` (n, 3) are ICRS unit vectors to the stars and `magnitudes` (n,) their Johnson V magnitudes.
    `quaternions` (k, 4), ICRS into camera, are the attitudes at `times` (k,), s, from the start to the end of
    the exposure. The exposure of a rolling shutter ends with the exposure of the last row. The model is a
    corrected version of Sease, eqs. 2.1 to 2.9 and 2.12. Raises ValueError for arrays of the wrong shape or
    with values that are not finite, and OutOfRange for an invalid attitude.
    """
    history = AttitudeHistory(times, quaternions)
    return _light(model, directions, magnitudes, history, extra).astype(np.float64)


def render(
    model: StarCameraModel,
    directions: FloatArray,
    magnitudes: npt.ArrayLike,
    times: FloatArray,
    quaternions: FloatArray,
    rng: np.random.Generator,
    extra: Sequence[SourceTrack] = (),
) -> Image:
    """Return the camera's frame (rows, columns) as uint8 for up to 8 bits, else as uint16.

    The arguments are those of `expected_electrons`. All noise is drawn from `rng`.
    """
    history = AttitudeHistory(times, quaternions)
    light = _light(model, directions, magnitudes, history, extra)
    return counts(model, light, model.exposure_within(history.span), rng)


def _light(
    model: StarCameraModel,
    directions: FloatArray,
    magnitudes: npt.ArrayLike,
    history: AttitudeHistory,
    extra: Sequence[SourceTrack],
) -> Float32Array:
    directions, magnitude = np.asarray(directions, dtype=float), np.asarray(magnitudes, dtype=float)
    if directions.ndim != 2 or directions.shape[1] != 3 or magnitude.shape != directions.shape[:1]:
        raise ValueError(f"stars {directions.shape} and magnitudes {magnitude.shape}: give (n, 3) and (n,)")
    # A sum is finite only if every term is finite, so checking the sum is sufficient and needs no array.
    if not (np.isfinite(directions.sum()) and np.isfinite(magnitude.sum())):
        raise ValueError("star directions and magnitudes must be finite")
    camera = model.pinhole
    spread = (integrated_gaussian if model.psf == "integrated" else bilinear_gaussian)(model.psf_sigma)
    exposure = model.exposure_within(history.span)
    shutter = RollingShutter(float(history.times[0]), exposure, model.line_time)
    knots = history.knots(SMOOTHNESS / camera.focal_length, LONGEST_TURN)
    image = np.zeros((model.rows, model.columns), dtype=np.float32)
    near = _near_the_field(camera, directions, history.matrices_at(knots)[:, 2], spread.reach + 2)
    stars, electrons = directions[near], model.electrons(magnitude[near], exposure)
    if model.line_time > 0.0:
        own = _at_own_times(history, lambda _, sources: stars[sources])
        expose_rolling(image, camera, spread, own, electrons, knots, shutter)
    else:
        expose(image, camera, spread, _stars_seen_by(history, stars), electrons, knots)
    for track in extra:
        if track.times[0] > history.times[0] or track.times[-1] < history.times[-1]:
            raise ValueError(
                f"source track from {track.times[0]} to {track.times[-1]} s: it must cover the exposure, "
                f"{history.times[0]} to {history.times[-1]} s"
            )
        inside = track.times[(track.times > knots[0]) & (track.times < knots[-1])]
        bends = np.union1d(knots, inside)
        electrons = model.electrons([track.magnitude], exposure)
        own = _at_own_times(history, partial(_of_track, track))
        if model.line_time > 0.0:
            expose_rolling(image, camera, spread, own, electrons, bends, shutter)
        else:
            expose(image, camera, spread, partial(_alone, own), electrons, bends)
    return image


def _stars_seen_by(history: AttitudeHistory, directions: FloatArray) -> Vectors:
    def vectors(times: FloatArray) -> FloatArray:
        # One matrix product for all times with the stars along the innermost memory axis is fast.
        seen = history.matrices_at(times).reshape(-1, 3) @ directions.T
        return np.swapaxes(seen.reshape(len(times), 3, -1), 1, 2)

    return vectors


def _at_own_times(history: AttitudeHistory, directions: OwnTimes) -> OwnTimes:
    """Return a function that rotates ICRS `directions` into the camera frame at the time of each source."""

    def vectors(times: FloatArray, sources: IntArray) -> FloatArray:
        matrices = history.matrices_at(times.reshape(-1)).reshape(*times.shape, 3, 3)
        return np.asarray((matrices @ directions(times, sources)[..., None])[..., 0])

    return vectors


def _of_track(track: SourceTrack, times: FloatArray, _: IntArray) -> FloatArray:
    return track.directions_at(times.reshape(-1)).reshape(*times.shape, 3)


def _alone(own: OwnTimes, times: FloatArray) -> FloatArray:
    return own(times[:, None], np.zeros(1, dtype=np.int64))


def _near_the_field(camera: Pinhole, directions: FloatArray, boresights: FloatArray, margin: int) -> IntArray:
    """Return the indices of the stars that are possibly in view along the path of the `boresights` (j, 3)."""
    middle = boresights.sum(axis=0)
    length = float(np.linalg.norm(middle))
    if length < 0.5 * len(boresights):
        return np.arange(len(directions))
    axis = middle / length
    sweep = np.arccos(np.clip(np.min(boresights @ axis), -1.0, 1.0))
    radius = camera.half_diagonal + sweep + LONGEST_TURN**2 + margin / camera.focal_length
    return np.flatnonzero(directions @ axis >= np.cos(min(radius, np.pi)))
