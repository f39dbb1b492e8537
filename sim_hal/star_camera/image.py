"""Star images: the stars and moving sources that a camera records over an exposure.

The attitude during an exposure is interpolated between samples by a rotation at constant rate. Sease 2.12
integrates one constant rate from the start of the exposure; here the true attitude is given, so that the
acceleration of a slew or a jitter shows in the streak. The detector adds noise and saturation and makes
counts (Sease 2.10, 2.11).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from hal.interfaces.errors import OutOfRange
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray, Image, IntArray
from knightcube.vision.camera.lens import Pinhole
from sim_hal.star_camera.exposure import (
    Float32Array,
    OwnTimes,
    RollingShutter,
    Vectors,
    bilinear_gaussian,
    expose,
    expose_rolling,
    integrated_gaussian,
)
from sim_hal.star_camera.model import StarCameraModel

DEVICE = "star camera model"
GREATEST_TURN = 0.5 * np.pi
"""Between two samples, rad. Beyond pi the shorter rotation would be the wrong one."""


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeHistory:
    """Attitudes (k, 4), ICRS into camera, at `times` (k,) s; the first and the last bound the exposure."""

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
        """The time from the first sample to the last, s."""
        return float(self.times[-1] - self.times[0])

    def at(self, times: FloatArray) -> FloatArray:
        """Return the attitudes (m, 4) at `times` (m,); extrapolated beyond the ends."""
        return _interpolate(self.times, self.quaternions, times)

    def matrices_at(self, times: FloatArray) -> FloatArray:
        """Return the attitude matrices (m, 3, 3), ICRS into camera, at `times` (m,)."""
        return quaternion.attitude_matrix(self.at(times))

    def knots(self, tolerance: float, longest_turn: float) -> FloatArray:
        """Return times (j,) from start to end between which the motion is smooth and short.

        Between two knots the attitude stays within `tolerance` rad of a turn at constant rate, and turns by
        `longest_turn` rad at most. Smooth motion needs no more knots for being sampled finely.
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
"""A pixel is faint while its light adds at most this share to the variance of the background."""
GREATEST_SKEWNESS = 0.05
"""Below it noise may be drawn as Gaussian: its distribution function is then off by 0.004 (Edgeworth)."""

SLICES = 1 << 16
OUTER_SLICES = 64


def counts(
    model: StarCameraModel, electrons: Float32Array, exposure: float, rng: np.random.Generator
) -> Image:
    """Return the frame (rows, columns) of counts that `electrons` of light in `exposure` s give."""
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
    signal += np.float32(model.pedestal + 0.5)  # truncation below then rounds to the nearest count
    np.clip(signal, 0.0, model.highest_count, out=signal)
    return np.asarray(signal.astype(model.count_type))


def _stray_light(model: StarCameraModel) -> Float32Array:
    """Return e- (rows, columns) that grow evenly across and down, from none in the darkest corner."""
    across, down = model.background_gradient
    light = across * np.arange(model.columns) + down * np.arange(model.rows)[:, None]
    return np.asarray(model.gain * (light - light.min()), dtype=np.float32)


def _poisson(
    model: StarCameraModel, light: Float32Array, exposure: float, rng: np.random.Generator
) -> Float32Array:
    """Return e- with shot noise of light and dark current, filled to the well at most, and read noise.

    2.10 and 2.11 corrected: Poisson and Gaussian instead of uniform. Where light is faint beside a background
    whose noise is all but Gaussian, the sum of the three is drawn as one Gaussian of the same mean and
    variance; everywhere else each is drawn as what it is.
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
    """Return standard normal draws, four times as fast as the generator's own.

    A 16-bit number picks one of 65,536 slices of equal probability and gives its middle; of the outermost
    slices, where they are wide, it gives a point drawn within. So the tails are as long as they should be.
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
    # Ten wells and a thousand electrons fill the well for certain; the draw overflows far beyond.
    mean = np.minimum(light.astype(np.float64) + dark, 10.0 * model.full_well + 1000.0)
    collected = np.minimum(rng.poisson(mean), model.full_well).astype(np.float32)
    collected += np.float32(model.read_noise) * rng.standard_normal(light.shape, dtype=np.float32)
    return np.asarray(collected)


def _uniform(
    model: StarCameraModel, light: Float32Array, exposure: float, rng: np.random.Generator
) -> Float32Array:
    """Return e- with the thesis's draw: sqrt(signal) and sqrt(RN^2 + DC T), each times a uniform 0 .. 1."""
    rest = np.sqrt(model.read_noise**2 + model.dark_current * exposure)
    signal = light + np.sqrt(light) * rng.random(light.shape, dtype=np.float32)
    signal += np.float32(rest) * rng.random(light.shape, dtype=np.float32)
    return np.minimum(signal, np.float32(model.full_well))


SMOOTHNESS = 0.01
"""px at the boresight: departures from smooth motion larger than this are followed sample by sample."""
LONGEST_TURN = 0.05
"""rad between knots: an arc then exceeds its chord by 0.01 %."""


@dataclass(frozen=True, slots=True, eq=False)
class SourceTrack:
    """A point that moves in the sky (an RSO): directions (k, 3) ICRS at `times` (k,) s, and its Johnson V.

    Between samples it moves along the chord, evenly. The samples must cover the exposure.
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
        """Return unit vectors (m, 3) at `times` (m,); extrapolated beyond the ends."""
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
    """Return the light (rows, columns) in e- of an exposure: no noise, no dark current, no saturation.

    `directions` (n, 3) are ICRS unit vectors, `magnitudes` (n,) Johnson V; `times` (k,) s and `quaternions`
    (k, 4), ICRS into camera, are the attitude from the start to the end of the exposure; with a rolling
    shutter from the start of the first row's until `model.rows` line times after that exposure's end. Sease
    2.1-2.9 and 2.12, corrected. Raises ValueError for arrays of the wrong shape or not finite, OutOfRange
    for an attitude that cannot be.
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
    """Return the camera's frame (rows, columns): uint8 to 8 bits, uint16 above.

    Arguments as for `expected_electrons`; all noise is drawn from `rng`.
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
    directions, magnitude = _checked(directions, magnitudes)
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
        _check_cover(track, history)
        inside = track.times[(track.times > knots[0]) & (track.times < knots[-1])]
        bends = np.union1d(knots, inside)
        electrons = model.electrons([track.magnitude], exposure)
        own = _at_own_times(history, _directions_of(track))
        if model.line_time > 0.0:
            expose_rolling(image, camera, spread, own, electrons, bends, shutter)
        else:
            expose(image, camera, spread, _track_seen_by(own), electrons, bends)
    return image


def _stars_seen_by(history: AttitudeHistory, directions: FloatArray) -> Vectors:
    def vectors(times: FloatArray) -> FloatArray:
        # One product for all times; the stars stay innermost in memory, where the arithmetic is fast.
        seen = history.matrices_at(times).reshape(-1, 3) @ directions.T
        return np.swapaxes(seen.reshape(len(times), 3, -1), 1, 2)

    return vectors


def _at_own_times(history: AttitudeHistory, directions: OwnTimes) -> OwnTimes:
    """Return `directions` (..., 3), ICRS, of sources at their own times, as the camera then sees them."""

    def vectors(times: FloatArray, sources: IntArray) -> FloatArray:
        matrices = history.matrices_at(times.reshape(-1)).reshape(*times.shape, 3, 3)
        return np.asarray((matrices @ directions(times, sources)[..., None])[..., 0])

    return vectors


def _track_seen_by(own: OwnTimes) -> Vectors:
    return lambda times: own(times[:, None], np.zeros(1, dtype=np.int64))


def _directions_of(track: SourceTrack) -> OwnTimes:
    def directions(times: FloatArray, _: IntArray) -> FloatArray:
        return track.directions_at(times.reshape(-1)).reshape(*times.shape, 3)

    return directions


def _near_the_field(camera: Pinhole, directions: FloatArray, boresights: FloatArray, margin: int) -> IntArray:
    """Return the indices of the stars that the field may sweep over, between `boresights` (j, 3) too."""
    middle = boresights.sum(axis=0)
    length = float(np.linalg.norm(middle))
    if length < 0.5 * len(boresights):
        return np.arange(len(directions))
    axis = middle / length
    sweep = np.arccos(np.clip(np.min(boresights @ axis), -1.0, 1.0))
    radius = camera.half_diagonal + sweep + LONGEST_TURN**2 + margin / camera.focal_length
    return np.flatnonzero(directions @ axis >= np.cos(min(radius, np.pi)))


def _checked(directions: FloatArray, magnitudes: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    directions = np.asarray(directions, dtype=float)
    magnitude = np.asarray(magnitudes, dtype=float)
    if directions.ndim != 2 or directions.shape[1] != 3 or magnitude.shape != directions.shape[:1]:
        raise ValueError(f"stars {directions.shape} and magnitudes {magnitude.shape}: give (n, 3) and (n,)")
    # A sum is finite only when every term is: one pass, no array of flags.
    if not (np.isfinite(directions.sum()) and np.isfinite(magnitude.sum())):
        raise ValueError("star directions and magnitudes must be finite")
    return directions, magnitude


def _check_cover(track: SourceTrack, history: AttitudeHistory) -> None:
    if track.times[0] > history.times[0] or track.times[-1] < history.times[-1]:
        raise ValueError(
            f"source track from {track.times[0]} to {track.times[-1]} s: it must cover the exposure, "
            f"{history.times[0]} to {history.times[-1]} s"
        )
