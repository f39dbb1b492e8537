"""Star images: the stars and moving sources that a camera sees over an exposure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray, Image, IntArray
from knightcube.vision.camera.lens import Pinhole
from sim_hal.star_camera import detector
from sim_hal.star_camera.attitude_history import AttitudeHistory
from sim_hal.star_camera.exposure import Vectors, expose
from sim_hal.star_camera.model import StarCameraModel
from sim_hal.star_camera.point_spread import Float32Array, bilinear_gaussian, integrated_gaussian
from sim_hal.star_camera.rolling_shutter import OwnTimes, RollingShutter, expose_rolling

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
    return detector.counts(model, light, model.exposure_within(history.span), rng)


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
