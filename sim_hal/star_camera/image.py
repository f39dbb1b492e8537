"""Parameters of the star camera, and the rendering of frames with stars and moving sources.

The attitude during an exposure is interpolated between samples by a rotation at constant rate. Sease, eq.
2.12, integrates one constant rate from the start of the exposure. This module uses samples of the true
attitude, so that acceleration and jitter appear in the streaks. The detector adds noise, saturates and
converts charge to counts (Sease, eqs. 2.10 and 2.11).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from hal.interfaces.errors import OutOfRange, check_limits
from knightcube.astro import quaternion
from knightcube.astro.arrays import Float32Array, FloatArray, Image, IntArray
from knightcube.vision.camera.lens import Pinhole
from sim_hal.star_camera.exposure import (
    DEVICE,
    OwnTimes,
    RollingShutter,
    Vectors,
    bilinear_gaussian,
    expose,
    expose_rolling,
    integrated_gaussian,
)

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
        aperture: diameter of the aperture, m.
        zero_magnitude_flux: charge rate from a source of V = 0, e-/s per m^2 of aperture (Sease, eq. 2.7,
            where 19,000 is per mm^2).
        read_noise: standard deviation of the read noise, e-.
        dark_current: dark current of each pixel, e-/s.
        gain: charge per count, e-, which the thesis calls quantum efficiency.
        pedestal: counts added before the analogue-to-digital conversion, so that negative noise is not
            clipped.
        bits: resolution of the analogue-to-digital converter, bits.
        full_well: charge capacity of a pixel, e-.
        psf_sigma: standard deviation of the Gaussian point spread function, px.
        psf: "integrated" integrates the Gaussian over each pixel. "bilinear" places the charge on four pixels
            and blurs it with a sampled 3 x 3 kernel (Sease, eqs. 2.5, 2.6, 2.9).
        noise: "poisson" is Poisson noise with Gaussian read noise. "uniform" is the uniform noise of Sease,
            eq. 2.11.
        hot_pixels: hot pixels, whose dark current is higher.
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

    def __post_init__(self) -> None:
        check_limits(DEVICE, self, _LIMITS)
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
        """Pinhole geometry of the camera (Sease, eqs. 2.3 and 2.4, corrected)."""
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
            raise OutOfRange(DEVICE, "turn between two attitude samples", greatest, 0.0, GREATEST_TURN, "rad")

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
        stride = 2
        while stride < 2 * last:
            thinned = np.append(np.arange(0, last, stride), last)
            guess = _interpolate(self.times[thinned], self.quaternions[thinned], self.times)
            if np.max(quaternion.angle_between(guess, self.quaternions)) > tolerance:
                break
            kept = thinned
            stride *= 2
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
"""Largest ratio of a faint pixel's charge (e-) to the variance of the background noise (e-^2)."""
GREATEST_SKEWNESS = 0.05
"""Largest skewness of noise that is drawn as Gaussian; by the Edgeworth series, the error is 0.004."""

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
        light = light + _stray_light(model)
    draw = _uniform if model.noise == "uniform" else _poisson
    signal = draw(model, light, exposure, rng)
    signal *= np.float32(1.0 / model.gain)
    signal += np.float32(model.pedestal + 0.5)  # adding 0.5 makes the truncation round to the nearest count
    np.clip(signal, 0.0, model.highest_count, out=signal)
    return np.asarray(signal.astype(model.count_type))


def _stray_light(model: StarCameraModel) -> Float32Array:
    across, down = model.background_gradient
    light = across * np.arange(model.columns) + down * np.arange(model.rows)[:, None]
    return np.asarray(model.gain * (light - light.min()), dtype=np.float32)


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
    signal *= _normal(light.shape, rng)
    signal += light
    signal += np.float32(dark)
    bright = np.flatnonzero(light > faint)
    signal.reshape(-1)[bright] = _exact(model, light.reshape(-1)[bright], dark, rng)
    return signal


def _normal(shape: tuple[int, ...], rng: np.random.Generator) -> Float32Array:
    """Return standard normal random numbers four times as fast as the generator of numpy.

    A 16-bit number selects one of 65,536 slices of equal probability, and the draw is the centre of the
    slice. In the outermost slices, which are wide, the draw is a random point of the slice, so that the tails
    of the distribution are correct.
    """
    count = int(np.prod(shape))
    words = rng.integers(0, 2**64, size=(count + 3) // 4, dtype=np.uint64)
    slices = words.view(np.uint16)[:count]
    normal = _slice_middles().take(slices)
    outer = np.flatnonzero((slices < OUTER_SLICES) | (slices >= SLICES - OUTER_SLICES))
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
    """Return the charge (e-) with added uniform noise as in the thesis.

    The noise is the sum of sqrt(signal) and sqrt(RN^2 + DC T), each multiplied by a uniform draw from 0 to 1.
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
        """Return the unit vectors (m, 3) to the source at `times` (m,), s, with extrapolation."""
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
    `quaternions` (k, 4), ICRS into camera, at `times` (k,), s, give the attitude from the start to the end of
    the exposure, which for a rolling shutter is the end of the last row's exposure. The model is a corrected
    version of Sease, eqs. 2.1 to 2.9 and 2.12. Raises ValueError for arrays of the wrong shape or with values
    that are not finite, and OutOfRange for an invalid attitude.
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
    """Return the indices of the stars that the field of view may cross along `boresights` (j, 3)."""
    middle = boresights.sum(axis=0)
    length = float(np.linalg.norm(middle))
    if length < 0.5 * len(boresights):
        return np.arange(len(directions))
    axis = middle / length
    sweep = np.arccos(np.clip(np.min(boresights @ axis), -1.0, 1.0))
    radius = camera.half_diagonal + sweep + LONGEST_TURN**2 + margin / camera.focal_length
    return np.flatnonzero(directions @ axis >= np.cos(min(radius, np.pi)))
