"""Whether streaks are as long as the motion implies: light from end to end, and none beyond.

The fit sees only a few pixels beyond the ends. A turn too small by a fifth can fit what it is given, one end
of every streak and the middle; the frame beyond the other end shows it. A turn too large has stretches
without light, which a fit makes little of that lays several streaks end to end, or the far end outside the
frame.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import ExposedFrame
from knightcube.vision.streaks.maximum_likelihood.motion import Motion, paths, positions
from knightcube.vision.streaks.maximum_likelihood.scene import path_lengths

# The stretch judged: part of the path, its least length and its distance from the end, px.
_STRETCH = 0.1
_LEAST_STRETCH = 8.0
_FROM_END = 4.0
_SAMPLES = 24
# Within the path as many stretches are looked at.
_WITHIN = 10
_WITHIN_SAMPLES = 10
_ASIDE = np.array([-1.0, 0.0, 1.0])
# The part of a streak's light per px of length that each of the middle three pixels across has.
_MIDDLE = 0.287
_HALF = 0.5
_LEAST_VALID = 0.7
# A stretch can be judged when the light expected exceeds this many deviations of its mean.
_TELLING = 4.0
# Instants at which the progress along a path is taken.
_INSTANTS = 65
# Where a star is slower than this part of its rate, the point spread hides how much brighter its path is.
_SLOW = 0.5
# Light beyond an end is a trail from this part of the streak's mean brightness on.
_TRAIL = 0.08
# Part of a streak that may be dark for reasons of its own.
_DARK = 0.15


def true_ends(
    frame: ExposedFrame,
    pinhole: Pinhole,
    motion: Motion,
    stars: FloatArray,
    light: FloatArray,
    times: FloatArray,
) -> FloatArray:
    """Return (n, 2) 1 for the ends that are where they should be, 0 for those that are not.

    `times` (n, 2) are when stars (n, 2) of `light` (n,) counts begin and end to be exposed. Ends that are not
    on the detector, and those of streaks too short to judge, are NaN.
    """
    out = np.full((len(stars), 2), np.nan)
    length = path_lengths(pinhole, motion, stars)
    long = length > 2.0 * (_FROM_END + _LEAST_STRETCH)
    if not long.any():
        return out
    stars, light, times, length = stars[long], light[long], times[long], length[long]
    stretch = np.maximum(_STRETCH * length, _LEAST_STRETCH)
    away = _FROM_END + np.linspace(0.0, 1.0, _SAMPLES) * stretch[:, None]
    for end, sign in ((0, -1.0), (1, 1.0)):
        steady, there, speed = ending(pinhole, motion, stars, times[:, end])
        part = relative_brightness(motion, sign, _FROM_END / speed, (_FROM_END + stretch) / speed)
        expected = expected_brightness(light, length) * part
        time = sign * away / speed[:, None]
        within, beyond = (brightness(frame, pinhole, steady, there, t)[0] for t in (-time, time))
        known = np.isfinite(within) & np.isfinite(beyond)
        true = (within > _HALF * expected) & (beyond < _HALF * expected)
        out[long, end] = np.where(known, true, np.nan)
    return out


def trailing(
    frame: ExposedFrame,
    pinhole: Pinhole,
    motion: Motion,
    stars: FloatArray,
    light: FloatArray,
    times: FloatArray,
) -> float:
    """Return the part of the stars that can be judged whose light goes on, faintly, beyond an end.

    Arguments as of `true_ends`. A rate that changes otherwise than assumed leaves a short streak with a dim
    tail.
    """
    faint = _TRAIL * expected_brightness(light, path_lengths(pinhole, motion, stars))
    away = _FROM_END + np.linspace(0.0, 1.0, _SAMPLES) * _LEAST_STRETCH
    judged, lit = np.zeros(len(stars), dtype=np.bool_), np.zeros(len(stars), dtype=np.bool_)
    for end, sign in ((0, -1.0), (1, 1.0)):
        steady, there, speed = ending(pinhole, motion, stars, times[:, end])
        mean, deviation = brightness(frame, pinhole, steady, there, sign * away / speed[:, None])
        known = np.isfinite(mean) & (faint > _TELLING * deviation)
        judged |= known
        lit |= known & (mean > faint)
    return float(np.mean(lit[judged])) if judged.any() else 0.0


def ending(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, times: FloatArray
) -> tuple[Motion, FloatArray, FloatArray]:
    """Return a steady motion through ends of paths, where those are (n, 2) px, and its speed (n,) there.

    `times` (n,) are those of the ends. Where the rate changes the path itself may be at rest there.
    """
    there = positions(pinhole, motion, stars, times)
    steady = Motion.steady(motion.whole)
    velocity = paths(pinhole, steady, there, np.zeros(len(there))).velocity
    return steady, there, np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), 1e-3)


def relative_brightness(motion: Motion, sign: float, near: FloatArray, far: FloatArray) -> FloatArray:
    """Return how bright (n,) the path is from `near` to `far` (n,) of its end, over its mean.

    Distances are in parts of the path; `sign` is 1 for the last end, -1 for the first.
    """
    time = np.linspace(-0.5, 0.5, _INSTANTS)
    progress = np.maximum.accumulate(motion.progress(time))
    # A little more with time, so that a rest has its duration.
    progress += 1e-9 * np.arange(_INSTANTS)
    end = progress[-1 if sign > 0.0 else 0]
    begin, stop = (np.interp(end - sign * distance, progress, time) for distance in (near, far))
    return np.asarray(np.abs(stop - begin) / np.maximum(far - near, 1e-9))


def unbroken(
    frame: ExposedFrame,
    pinhole: Pinhole,
    motion: Motion,
    stars: FloatArray,
    light: FloatArray,
    times: FloatArray,
) -> FloatArray:
    """Return 1 for each star that is bright all along its path on the detector, else 0, in one row (k,).

    Arguments as of `true_ends`; stars too short or too faint to judge are left out.
    """
    length = path_lengths(pinhole, motion, stars)
    long = length > _WITHIN * _LEAST_STRETCH
    if not long.any():
        return np.empty(0)
    stars, light, times, length = stars[long], light[long], times[long], length[long]
    share = (np.arange(_WITHIN * _WITHIN_SAMPLES) + 0.5) / (_WITHIN * _WITHIN_SAMPLES)
    time = times[:, :1] + (times[:, 1:] - times[:, :1]) * share
    each = np.repeat(stars, _WITHIN, axis=0)
    mean, deviation = brightness(frame, pinhole, motion, each, time.reshape(len(each), _WITHIN_SAMPLES))
    rate = np.clip(motion.pace(time.reshape(-1)), _SLOW, None).reshape(len(each), _WITHIN_SAMPLES)
    expected = np.repeat(expected_brightness(light, length), _WITHIN) * np.mean(1.0 / rate, axis=1)
    known = np.isfinite(mean) & (expected > _TELLING * deviation)
    dark = (known & (mean < _HALF * expected)).reshape(-1, _WITHIN).sum(axis=1)
    known_of = known.reshape(-1, _WITHIN).sum(axis=1)
    judged = known_of > 0
    return np.asarray(dark[judged] <= _DARK * known_of[judged], dtype=float)


def expected_brightness(light: FloatArray, length: FloatArray) -> FloatArray:
    """Return the mean counts (n,) that `brightness` finds on streaks of `light` (n,) and `length` (n,) px."""
    return np.asarray(_MIDDLE * light / length)


def brightness(
    frame: ExposedFrame, pinhole: Pinhole, motion: Motion, stars: FloatArray, time: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the mean counts (n,) of pixels about a stretch of the path, at `time` (n, s), and its deviation.

    NaN where too few are seen.
    """
    samples = time.shape[1]
    there = paths(pinhole, motion, np.repeat(stars, samples, axis=0), time.reshape(-1))
    way = there.velocity / np.maximum(np.linalg.norm(there.velocity, axis=1, keepdims=True), 1e-3)
    normal = np.stack([-way[:, 1], way[:, 0]], axis=-1)
    points = there.position[:, None] + _ASIDE[:, None] * normal[:, None]
    pixel = np.rint(points).astype(np.int64)
    seen = pinhole.contains(pixel.astype(float))
    index = np.where(seen, pixel[..., 1] * pinhole.columns + pixel[..., 0], 0)
    seen &= ~frame.bad[index]
    count = seen.reshape(len(stars), -1).sum(axis=1)
    enough = count >= _LEAST_VALID * samples * len(_ASIDE)
    total = np.where(seen, frame.signal[index], 0.0).reshape(len(stars), -1).sum(axis=1)
    variance = np.where(seen, frame.floor[index], 0.0).reshape(len(stars), -1).sum(axis=1)
    count = np.maximum(count, 1)
    return np.where(enough, total / count, np.nan), np.sqrt(variance) / count
