"""Paths of stars over the detector of a rotating camera, and the derivatives of these paths.

Times are in units of the exposure time, and are zero at mid-exposure. With the rate u at mid-exposure and the
angular acceleration g in camera axes, the rate at time t is u + g t, and the direction v of a star obeys v' =
-(u + g t) x v. The rotation vector is described in `camera_motion`. A star is identified by its pixel
coordinates at mid-exposure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray, cross_product, select
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import DistortedPinhole, Pinhole
from knightcube.vision.streaks.camera_motion import TINY, CameraMotion, cross

PIXEL_VARIANCE = 1.0 / 12.0
"""Variance (px^2) of a uniform distribution over one pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class StarPaths:
    """Position (m, 2), velocity (m, 2) and acceleration (m, 2) of m points on the paths of stars.

    The position is in px, the velocity in px per exposure, and the acceleration in px per exposure^2.
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray

    def at_lines(self, shape: tuple[int, ...]) -> PointsAtLines:
        """Return position, velocity and acceleration of the m points, reshaped to arrays (2, *shape)."""
        x = np.ascontiguousarray(self.position.T).reshape(2, *shape)
        v = np.ascontiguousarray(self.velocity.T).reshape(2, *shape)
        return x, v, np.ascontiguousarray(self.acceleration.T).reshape(2, *shape)


PointsAtLines = tuple[FloatArray, FloatArray, FloatArray]
"""Position, velocity and acceleration, each (2, b, LINES), of stars at the lines of b blocks of pixels."""


def paths(pinhole: Pinhole, motion: CameraMotion, stars: FloatArray, time: FloatArray) -> StarPaths:
    """Return points at `time` (m,) on the paths of stars that are at `stars` (m, 2), px, at mid-exposure."""
    view, terms, ideal, time = _ideal_arguments(pinhole, motion, stars, time)
    shaken = motion.vibration.exists
    found = _paths_of(view, motion, ideal, time) if shaken else _ideal_paths(view, terms, ideal, time)
    if not isinstance(pinhole, DistortedPinhole):
        return StarPaths(*found)
    return StarPaths(*pinhole.image_motion(*found))


def positions(pinhole: Pinhole, motion: CameraMotion, stars: FloatArray, time: FloatArray) -> FloatArray:
    """Return the positions (m, 2), px, of the points that `paths` returns, but in less time."""
    view, terms, ideal, time = _ideal_arguments(pinhole, motion, stars, time)
    shaken = motion.vibration.exists
    points = (
        _positions_of(view, motion, ideal, time) if shaken else _ideal_positions(view, terms, ideal, time)
    )
    return pinhole.distorted(points) if isinstance(pinhole, DistortedPinhole) else points


def image_flow(pinhole: Pinhole, points: FloatArray) -> FloatArray:
    """Return the image-flow matrices B (n, 2, 3), px/rad, at `points` (n, 2), px.

    If the camera rotates at the rate u (rad per exposure), the image of a star moves at B u (px per
    exposure).
    """
    view = (pinhole.focal_length, *pinhole.centre)
    if not isinstance(pinhole, DistortedPinhole):
        return _flow(pinhole.focal_length, _directions(view, points)[:2]).transpose(2, 0, 1)
    ideal = pinhole.undistorted(points)
    flow = _flow(pinhole.focal_length, _directions(view, ideal)[:2]).transpose(2, 0, 1)
    return np.asarray(pinhole.jacobian(ideal) @ flow)


def sensitivities(
    pinhole: Pinhole, motion: CameraMotion, stars: FloatArray, time: FloatArray, growing: bool = True
) -> FloatArray:
    """Return the derivatives (m, 2, 8) of star positions at `time` (m,), see `sensitivities_and_velocity`."""
    return sensitivities_and_velocity(pinhole, motion, stars, time, growing)[0]


def sensitivities_and_velocity(
    pinhole: Pinhole, motion: CameraMotion, stars: FloatArray, time: FloatArray, growing: bool = True
) -> tuple[FloatArray, FloatArray]:
    """Return derivatives (m, 2, 8) of star positions at `time` (m,), and velocities (m, 2), px per exposure.

    The derivatives are with respect to rate (3), acceleration (3) and the star's position at mid-exposure
    (2). The derivatives with respect to the rate and to the position at mid-exposure are exact. The
    derivatives with respect to the acceleration have an error of second order in the rotation angle, and are
    zero unless the acceleration is fitted (`growing`).
    """
    view, terms, ideal, time = _ideal_arguments(pinhole, motion, stars, time)
    if motion.vibration.exists:
        change, pace = _sensitivities_of(view, motion, ideal, time, growing)
    else:
        change, pace = _ideal_sensitivities(view, terms, ideal, time, growing)
    if isinstance(pinhole, DistortedPinhole):
        jacobian = pinhole.jacobian(_positions_of(view, motion, ideal, time))
        change, pace = jacobian @ change, (jacobian @ pace[..., None])[..., 0]
        # Positions at mid-exposure include distortion, so that their derivatives need the inverse Jacobian.
        change[..., 6:] = change[..., 6:] @ np.linalg.inv(pinhole.jacobian(ideal))
    return change, pace


_View = tuple[float, float, float]
"""Focal length and image centre (x, y) of a pinhole, px."""
_Terms = tuple[FloatArray, FloatArray, FloatArray]
"""Rate (3,), acceleration (3,) and higher terms (k, 3) of a motion without vibration."""


def _ideal_arguments(
    pinhole: Pinhole, motion: CameraMotion, stars: FloatArray, time: FloatArray
) -> tuple[_View, _Terms, FloatArray, FloatArray]:
    """Return camera model, motion, undistorted `stars` (m, 2) and `time` (m,), all as contiguous arrays."""
    if isinstance(pinhole, DistortedPinhole):
        stars = pinhole.undistorted(stars)
    each = motion.rate, motion.acceleration, motion.higher_terms, stars, time
    rate, acceleration, higher, stars, time = (np.ascontiguousarray(one) for one in each)
    return (pinhole.focal_length, *pinhole.centre), (rate, acceleration, higher), stars, time


# The compiled forms do not include a vibration, which is rare.
# The numpy forms compute with arrays of m vectors (..., 3, m), and return transposed views.
# None of these functions applies the distortion.


def _positions_of(view: _View, motion: CameraMotion, stars: FloatArray, time: FloatArray) -> FloatArray:
    """Return the positions (m, 2), px, at `time` (m,) of `stars` (m, 2), px."""
    v = _rotated(motion.rotation_until(time), _directions(view, stars))
    return _pixels(view, v[:2] / v[2])


def _ideal_positions_numpy(view: _View, terms: _Terms, stars: FloatArray, time: FloatArray) -> FloatArray:
    return _positions_of(view, CameraMotion(*terms), stars, time)


@compiled_form_of(_ideal_positions_numpy)
def _ideal_positions(view: _View, terms: _Terms, stars: FloatArray, time: FloatArray) -> FloatArray:
    out, (rate, acceleration, higher), places = np.empty((2, len(time))), terms, stars.T.copy()
    if len(higher) == 0 and _is_small(rate, acceleration, time):
        for m in range(len(time)):
            turn, w, change = _motion_at(rate, acceleration, time[m])
            turned = _turned(turn, _small_turn(_inner(turn, turn)), _direction(view, places, m))
            out[0, m], out[1, m], _, _, _, _ = _projected(view, turned, w, change)
    else:
        for m in range(len(time)):
            turn, w, change = _any_motion_at(rate, acceleration, higher, time[m])
            turned = _turned(turn, _any_turn(_inner(turn, turn)), _direction(view, places, m))
            out[0, m], out[1, m], _, _, _, _ = _projected(view, turned, w, change)
    return out.T


def _paths_of(
    view: _View, motion: CameraMotion, stars: FloatArray, time: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the position, velocity and acceleration (m, 2) of `stars` (m, 2), px."""
    v = _rotated(motion.rotation_until(time), _directions(view, stars))
    w = motion.rate_at(time)
    velocity = cross(v, w)  # -omega x v
    bent = cross(velocity, w)
    if not motion.constant:
        bent += cross(v, motion.acceleration[:, None] + motion.higher(time, 2))
    inverse = 1.0 / v[2]
    there = v[:2] * inverse
    pace = (velocity[:2] - there * velocity[2]) * inverse
    bend = (bent[:2] - there * bent[2] - 2.0 * pace * velocity[2]) * inverse
    return _pixels(view, there), (view[0] * pace).T, (view[0] * bend).T


def _ideal_paths_numpy(
    view: _View, terms: _Terms, stars: FloatArray, time: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    return _paths_of(view, CameraMotion(*terms), stars, time)


@compiled_form_of(_ideal_paths_numpy)
def _ideal_paths(
    view: _View, terms: _Terms, stars: FloatArray, time: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    out, (rate, acceleration, higher), places = np.empty((6, len(time))), terms, stars.T.copy()
    if len(higher) == 0 and _is_small(rate, acceleration, time):
        # The compiled form of the branch for small rotations uses the processor's vector instructions.
        for m in range(len(time)):
            turn, w, change = _motion_at(rate, acceleration, time[m])
            turned = _turned(turn, _small_turn(_inner(turn, turn)), _direction(view, places, m))
            point = _projected(view, turned, w, change)
            out[0, m], out[1, m], out[2, m], out[3, m], out[4, m], out[5, m] = point
    else:
        for m in range(len(time)):
            turn, w, change = _any_motion_at(rate, acceleration, higher, time[m])
            turned = _turned(turn, _any_turn(_inner(turn, turn)), _direction(view, places, m))
            point = _projected(view, turned, w, change)
            out[0, m], out[1, m], out[2, m], out[3, m], out[4, m], out[5, m] = point
    return out[0:2].T, out[2:4].T, out[4:6].T


def _sensitivities_of(
    view: _View, motion: CameraMotion, stars: FloatArray, time: FloatArray, growing: bool
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives (m, 2, 8) and velocities (m, 2) of `sensitivities_and_velocity`."""
    turned = motion.rotation_until(time)
    v = _rotated(turned, _directions(view, stars))
    there = v[:2] / v[2]
    out = np.zeros((2, 8, len(time)))
    # A change of the rate rotates the camera by a small vector psi, so that a direction v changes by v x psi.
    # The vector psi at the time t is the integral over t' of the rotation from t' to t.
    flow = _flow(view[0], there)
    # The mean rate since mid-exposure is used in the integral, which causes an error of higher order.
    mean = motion.rate[:, None] + 0.5 * time * motion.acceleration[:, None]
    if motion.higher_terms.any() or motion.vibration.exists:
        mean += motion.higher(time) / np.where(np.abs(time) < TINY, 1.0, time)
    angle = np.sqrt(np.sum(mean * mean, axis=0))
    axis = mean / np.maximum(angle, TINY)
    phi = angle * time
    sine = time * np.sinc(phi / np.pi)
    versine = 0.5 * time * phi * np.sinc(0.5 * phi / np.pi) ** 2
    about = cross(flow, axis)
    out[:, :3] = sine * flow - versine * about
    out[:, :3] += (((time - sine) * np.sum(flow * axis, axis=1))[:, None]) * axis
    if growing:
        out[:, 3:6] = (0.5 * time**2) * flow - (time * time * time / 6.0 * angle) * about
    for column, unit in ((6, np.array([[1.0], [0.0], [0.0]])), (7, np.array([[0.0], [1.0], [0.0]]))):
        beside = _rotated(turned, unit)
        out[:, column] = (beside[:2] - there * beside[2]) / v[2]
    velocity = np.sum(flow * motion.rate_at(time), axis=1)
    return out.transpose(2, 0, 1), velocity.T


def _ideal_sensitivities_numpy(
    view: _View, terms: _Terms, stars: FloatArray, time: FloatArray, growing: bool
) -> tuple[FloatArray, FloatArray]:
    return _sensitivities_of(view, CameraMotion(*terms), stars, time, growing)


@compiled_form_of(_ideal_sensitivities_numpy)
def _ideal_sensitivities(
    view: _View, terms: _Terms, stars: FloatArray, time: FloatArray, growing: bool
) -> tuple[FloatArray, FloatArray]:
    focal, (rate, acceleration, higher), places = view[0], terms, stars.T.copy()
    out, velocity = np.zeros((len(time), 2, 8)), np.empty((len(time), 2))
    for m in range(len(time)):
        t = time[m]
        turn, w, _ = _any_motion_at(rate, acceleration, higher, t)
        trig = _any_turn(_inner(turn, turn))
        v = _turned(turn, trig, _direction(view, places, m))
        x, y = v[0] / v[2], v[1] / v[2]
        flow = (x * y, -1.0 - x * x, y), (1.0 + y * y, -x * y, -x)
        mean = _mean_rate(rate, acceleration, higher, t)
        square = t * t * _inner(mean, mean)
        sine, versine = _any_turn(square)
        rest = (1.0 - sine) / square if square > _SMALL_SQUARE else 1.0 / 6.0 - square / 120.0
        beside = _turned(turn, trig, (1.0, 0.0, 0.0)), _turned(turn, trig, (0.0, 1.0, 0.0))
        for i in range(2):
            about, along = _product(flow[i], mean), t * t * rest * _inner(flow[i], mean)
            for k in range(3):
                part = sine * flow[i][k] - t * versine * about[k] + along * mean[k]
                out[m, i, k] = focal * t * part
                if growing:
                    out[m, i, 3 + k] = focal * t * t * (0.5 * flow[i][k] - t / 6.0 * about[k])
            for k in range(2):
                out[m, i, 6 + k] = (beside[k][i] - (y if i else x) * beside[k][2]) / v[2]
            velocity[m, i] = focal * _inner(flow[i], w)
    return out, velocity


_Vector = tuple[float, float, float]

# Squared rotation angle (rad^2) below which two terms of a power series are exact to rounding.
_SMALL_SQUARE = 1e-4
# Largest squared rotation angle (rad^2) for which the power series of sine and cosine are exact to rounding.
_LARGEST_SQUARE = 4.0


@loop_helper
def _product(a: _Vector, b: _Vector) -> _Vector:
    """Return the cross product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@loop_helper
def _inner(a: _Vector, b: _Vector) -> float:
    """Return the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@loop_helper
def _direction(view: _View, places: FloatArray, m: int) -> _Vector:
    """Return the direction of the star at `places[:, m]`, scaled to z = 1."""
    return (places[0, m] - view[1]) * (1.0 / view[0]), (places[1, m] - view[2]) * (1.0 / view[0]), 1.0


@loop_helper
def _motion_at(rate: FloatArray, acceleration: FloatArray, t: float) -> tuple[_Vector, _Vector, _Vector]:
    """Return rotation vector since mid-exposure, rate and angular acceleration at the time `t`."""
    half, cube = 0.5 * t * t, t * t * t * (1.0 / 12.0)
    x = t * rate[0] + half * acceleration[0] + cube * (rate[1] * acceleration[2] - rate[2] * acceleration[1])
    y = t * rate[1] + half * acceleration[1] + cube * (rate[2] * acceleration[0] - rate[0] * acceleration[2])
    z = t * rate[2] + half * acceleration[2] + cube * (rate[0] * acceleration[1] - rate[1] * acceleration[0])
    return (
        (x, y, z),
        (rate[0] + t * acceleration[0], rate[1] + t * acceleration[1], rate[2] + t * acceleration[2]),
        (acceleration[0], acceleration[1], acceleration[2]),
    )


@loop_helper
def _any_motion_at(
    rate: FloatArray, acceleration: FloatArray, higher: FloatArray, t: float
) -> tuple[_Vector, _Vector, _Vector]:
    """Return the result of `_motion_at` for a motion with higher terms of the rotation vector."""
    (x, y, z), (wx, wy, wz), (gx, gy, gz) = _motion_at(rate, acceleration, t)
    power = t
    for term in range(len(higher)):
        p = term + 3.0
        a, b, c = higher[term, 0] * power, higher[term, 1] * power, higher[term, 2] * power
        x, y, z = x + a * t * t, y + b * t * t, z + c * t * t
        wx, wy, wz = wx + p * a * t, wy + p * b * t, wz + p * c * t
        gx, gy, gz = gx + p * (p - 1.0) * a, gy + p * (p - 1.0) * b, gz + p * (p - 1.0) * c
        power *= t
    return (x, y, z), (wx, wy, wz), (gx, gy, gz)


@loop_helper
def _mean_rate(rate: FloatArray, acceleration: FloatArray, higher: FloatArray, t: float) -> _Vector:
    """Return the mean rate between mid-exposure and the time `t`."""
    x = rate[0] + 0.5 * t * acceleration[0]
    y = rate[1] + 0.5 * t * acceleration[1]
    z = rate[2] + 0.5 * t * acceleration[2]
    power = t * t
    for term in range(len(higher)):
        x, y, z = x + higher[term, 0] * power, y + higher[term, 1] * power, z + higher[term, 2] * power
        power *= t
    return x, y, z


@loop_helper
def _is_small(rate: FloatArray, acceleration: FloatArray, time: FloatArray) -> bool:
    """Return whether the power series of sine and cosine are exact to rounding at every `time`."""
    latest = 0.0
    for m in range(len(time)):
        latest = max(latest, abs(time[m]))
    u = math.sqrt(rate[0] * rate[0] + rate[1] * rate[1] + rate[2] * rate[2])
    g = math.sqrt(acceleration[0] ** 2 + acceleration[1] ** 2 + acceleration[2] ** 2)
    angle = latest * (u + latest * (0.5 * g + latest * u * g / 12.0))
    return angle * angle < _LARGEST_SQUARE


@loop_helper
def _small_turn(q: float) -> tuple[float, float]:
    """Return sin(a)/a and (1 - cos(a))/a^2 for the squared angle q = a^2 by their power series."""
    sine = 1.0 - q * (1 / 272) * (1.0 - q * (1 / 342) * (1.0 - q * (1 / 420)))
    sine = 1.0 - q * (1 / 110) * (1.0 - q * (1 / 156) * (1.0 - q * (1 / 210) * sine))
    sine = 1.0 - q * (1 / 20) * (1.0 - q * (1 / 42) * (1.0 - q * (1 / 72) * sine))
    versine = 1.0 - q * (1 / 306) * (1.0 - q * (1 / 380) * (1.0 - q * (1 / 462)))
    versine = 1.0 - q * (1 / 132) * (1.0 - q * (1 / 182) * (1.0 - q * (1 / 240) * versine))
    versine = 1.0 - q * (1 / 30) * (1.0 - q * (1 / 56) * (1.0 - q * (1 / 90) * versine))
    return 1.0 - q * (1 / 6) * sine, 0.5 - q * (1 / 24) * versine


@loop_helper
def _any_turn(q: float) -> tuple[float, float]:
    """Return the result of `_small_turn` for any squared angle q."""
    if q < _LARGEST_SQUARE:
        return _small_turn(q)
    angle = math.sqrt(q)
    return math.sin(angle) / angle, (1.0 - math.cos(angle)) / q


@loop_helper
def _turned(turn: _Vector, trig: tuple[float, float], v: _Vector) -> _Vector:
    """Return the inertially fixed direction `v` in camera axes after the rotation `turn`."""
    about = _product(v, turn)
    along = trig[1] * _inner(turn, v)
    still = 1.0 - trig[1] * _inner(turn, turn)
    return (
        still * v[0] + trig[0] * about[0] + along * turn[0],
        still * v[1] + trig[0] * about[1] + along * turn[1],
        still * v[2] + trig[0] * about[2] + along * turn[2],
    )


@loop_helper
def _projected(
    view: _View, v: _Vector, w: _Vector, change: _Vector
) -> tuple[float, float, float, float, float, float]:
    """Return position, velocity and acceleration in the image of a star in the direction `v`.

    The camera has the rate `w` and the angular acceleration `change`.
    """
    first = _product(v, w)
    second, third = _product(first, w), _product(v, change)
    inverse = 1.0 / v[2]
    x, y = v[0] * inverse, v[1] * inverse
    dx, dy = (first[0] - x * first[2]) * inverse, (first[1] - y * first[2]) * inverse
    down = second[2] + third[2]
    bx = (second[0] + third[0] - x * down - 2.0 * dx * first[2]) * inverse
    by = (second[1] + third[1] - y * down - 2.0 * dy * first[2]) * inverse
    focal = view[0]
    return focal * x + view[1], focal * y + view[2], focal * dx, focal * dy, focal * bx, focal * by


def _flow(focal_length: float, there: FloatArray) -> FloatArray:
    """Return image-flow matrices (2, 3, m), px/rad, at the normalised image coordinates `there` (2, m)."""
    x, y = there
    xy = x * y
    out = np.empty((2, 3, len(x)))
    out[0, 0], out[0, 1], out[0, 2] = xy, -1.0 - x * x, y
    out[1, 0], out[1, 1], out[1, 2] = 1.0 + y * y, -xy, -x
    out *= focal_length
    return out


def _directions(view: _View, stars: FloatArray) -> FloatArray:
    """Return the directions (3, m) of undistorted pixels `stars` (m, 2), scaled to z = 1."""
    out = np.ones((3, len(stars)))
    out[:2] = stars.T
    out[:2] -= np.array(view[1:])[:, None]
    out[:2] /= view[0]
    return out


def _pixels(view: _View, there: FloatArray) -> FloatArray:
    """Return the ideal image positions (m, 2), px, of normalised coordinates `there` (2, m), x/z and y/z."""
    pixel = view[0] * there
    pixel += np.array(view[1:])[:, None]
    return pixel.T


def _rotated(rotation: tuple[FloatArray, FloatArray, FloatArray], v: FloatArray) -> FloatArray:
    """Return the inertially fixed directions `v` (3, m) in camera axes after `rotation`."""
    a, sine, cosine = rotation
    along = (a * a.T) @ v if a.shape[1] == 1 else a * np.sum(a * v, axis=0)
    out = (v - along) * cosine
    out += cross(v, a) * sine
    out += along
    return np.asarray(out)


@dataclass(frozen=True, slots=True)
class Shutter:
    """Exposure delays of the rows of a detector, in units of the exposure time; 0 for a global shutter.

    The mid-exposure of the row with the index `middle` is at time zero.
    """

    delay_per_row: float = 0.0
    middle: float = 0.0

    def delay(self, rows: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.floating[Any]]:
        """Return the exposure delay of `rows` relative to the middle row, in units of the exposure time."""
        # Scalars get the type of `rows`, so that float32 arrays are not converted to float64.
        return np.asarray((rows - rows.dtype.type(self.middle)) * rows.dtype.type(self.delay_per_row))


# Number of polynomial coefficients that represent the rate over an exposure.
_COURSE_TERMS = 7
# Departure (px) of a star from uniform motion during the exposure below which the departure is neglected.
_UNEVEN = 0.05
# Number of instants of the exposure at which the departure from uniform motion is evaluated.
_INSTANTS = 65
# Largest uncertainty (px per exposure) of the navigation filter's motion that the fit accepts.
_MOST_VAGUE = 3.0
# Error of a fitted mean rate that a `Course` causes, as a fraction of the rate error of the `Course`.
_COURSE_SHARE = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Rotation over the exposure as a polynomial in time, predicted from gyro and commanded torque.

    The pixels of the frame determine the rate and the linear change of the rate. Higher-order terms, for
    example of a step of the rate, are better known from the navigation filter and are not fitted.

    The `terms` (k, 3), rad, are the coefficients of t, t^2, ... in the rotation vector since mid-exposure, in
    camera axes. The attribute `sigma`, rad, is the standard deviation of the rate multiplied by the exposure
    time.
    """

    terms: FloatArray
    sigma: float

    @classmethod
    def of_rates(cls, rates: FloatArray, exposure: float, sigma: float) -> Course:
        """Return the rotation during the exposure for `rates` (n, 3), rad/s, at n equidistant times.

        The exposure is in s, and `sigma` is the standard deviation of the rates, rad/s.
        """
        times = np.linspace(-0.5, 0.5, len(rates))[:, None]
        powers = np.arange(_COURSE_TERMS)
        fitted = np.linalg.lstsq(times**powers, rates, rcond=None)[0]
        missed = float(np.sqrt(np.mean(np.sum((rates - times**powers @ fitted) ** 2, axis=1))))
        return cls(fitted * exposure / (powers[:, None] + 1.0), exposure * float(np.hypot(sigma, missed)))

    def motion(self, focal_length: float) -> CameraMotion | None:
        """Return the initial motion of a fit, or None if this rotation is uncertain or nearly uniform."""
        motion = CameraMotion(self.terms[0], 2.0 * self.terms[1], self.terms[2:])
        time = np.linspace(-0.5, 0.5, _INSTANTS)
        uneven = (motion.progress(time) - time) * float(np.linalg.norm(motion.rotation)) * focal_length
        return motion if np.ptp(uneven) > _UNEVEN and self.sigma * focal_length < _MOST_VAGUE else None

    def covariance(self, exposure: float) -> FloatArray:
        """Return the covariance (3, 3), rad^2/s^2, of a fitted mean rate due to errors of this rotation."""
        return np.eye(3) * (_COURSE_SHARE * self.sigma / exposure) ** 2


@dataclass(frozen=True, slots=True)
class PsfProfile:
    """Profile of the point spread function (PSF), equal in all directions: a sum of concentric Gaussians.

    Attributes:
        widths: standard deviation of each Gaussian, as a fraction of the width of the scene.
        shares: fraction of the flux in each Gaussian; the sum is 1. The image of a defocused star has a dark
            centre, so that shares may be negative.
    """

    widths: tuple[float, ...]
    shares: tuple[float, ...]


GAUSSIAN = PsfProfile((1.0,), (1.0,))
"""The profile of a PSF that is one Gaussian."""


def without_pixel(width: float) -> float:
    """Return the standard deviation (px) of a PSF that has the `width` (px) after convolution with a pixel.

    The result is at least 0.1 px.
    """
    return math.sqrt(max(width**2 - PIXEL_VARIANCE, 0.01))


@dataclass(frozen=True, slots=True, eq=False)
class StreakScene:
    """The unknowns of the fit: the motion, the width of the point spread function (PSF), and the stars.

    Attributes:
        motion: rotation of the camera over the exposure.
        width: standard deviation of the PSF convolved with a pixel, px; the unit of the widths in `profile`.
        stars: positions of the n stars at mid-exposure (n, 2), px.
        light: flux of each star over the exposure (n,), counts.
        sky: sky level around each star minus the frame's background (n,), counts per pixel.
        trusted: mask (n,) of the stars that contribute to the fit of motion and PSF width.
        profile: profile of the PSF.
    """

    motion: CameraMotion
    width: float
    stars: FloatArray
    light: FloatArray
    sky: FloatArray
    trusted: BoolArray
    profile: PsfProfile = GAUSSIAN

    @classmethod
    def of(cls, motion: CameraMotion, sigma: float, stars: FloatArray, light: FloatArray) -> StreakScene:
        """Return a scene of trusted stars, with a PSF of standard deviation `sigma` (px)."""
        count, width = len(stars), float(np.hypot(sigma, 0.29))
        return cls(motion, width, stars, light, np.zeros(count), np.ones(count, dtype=np.bool_))

    @property
    def sigma(self) -> float:
        """The standard deviation (px) of the PSF without pixel convolution."""
        return without_pixel(self.width)

    def select(self, chosen: BoolArray | IntArray) -> StreakScene:
        """Return the scene with only the `chosen` stars, given as a mask or as indices."""
        return select(self, chosen, "motion", "width", "profile")

    def without_vibration(self, pinhole: Pinhole) -> StreakScene:
        """Return the scene without vibration, with stars whose paths are the means of the vibrating paths."""
        vibration = self.motion.vibration
        if not vibration.exists:
            return self
        shift = image_flow(pinhole, self.stars) @ -vibration.cosine.sum(axis=0)
        return replace(self, motion=self.motion.smooth, stars=self.stars + shift)

    def with_stars(self, stars: FloatArray, light: FloatArray) -> StreakScene:
        """Return the scene with m more stars at `stars` (m, 2), px, that do not affect the motion fit."""
        return replace(
            self,
            stars=np.concatenate([self.stars, stars]),
            light=np.concatenate([self.light, light]),
            sky=np.concatenate([self.sky, np.zeros(len(light))]),
            trusted=np.concatenate([self.trusted, np.zeros(len(light), dtype=np.bool_)]),
        )


# Start and end of the exposure, and the instants at which a path is sampled for its length.
_EXPOSURE, _SAMPLED = (-0.5, 0.5), np.linspace(-0.5, 0.5, 9)


def exposure_bounds(
    pinhole: Pinhole, motion: CameraMotion, shutter: Shutter, stars: FloatArray
) -> FloatArray:
    """Return the start and end times (n, 2) between which each of `stars` (n, 2), px, is exposed."""
    times = np.empty((len(stars), 2))
    times[:] = _EXPOSURE
    if shutter.delay_per_row == 0.0:
        return times
    # Each end time and the row of the star at that time are found by fixed-point iteration.
    for _ in range(4):
        for end, nominal in enumerate((-0.5, 0.5)):
            row = positions(pinhole, motion, stars, times[:, end])[:, 1]
            times[:, end] = nominal + shutter.delay(np.clip(row, 0.0, pinhole.rows - 1.0))
    return times


def complete_streaks(
    pinhole: Pinhole, motion: CameraMotion, shutter: Shutter, stars: FloatArray, margin: float = 0.0
) -> BoolArray:
    """Return which of the streaks of `stars` (n, 2), px, have both ends on the detector.

    The ends must be `margin` px or more inside the border of the detector.
    """
    complete = np.ones(len(stars), dtype=np.bool_)
    for time in exposure_bounds(pinhole, motion, shutter, stars).T:
        complete &= pinhole.contains(positions(pinhole, motion, stars, time), -margin)
    return complete


def mid_exposure_positions(
    pinhole: Pinhole, motion: CameraMotion, shutter: Shutter, middles: FloatArray
) -> FloatArray:
    """Return the star positions (n, 2), px, at mid-exposure for streaks centred at `middles` (n, 2), px."""
    if not len(middles):
        return middles
    if not motion.constant:
        back = CameraMotion.steady(motion.halfway)
        middles = positions(pinhole, back, middles, np.full(len(middles), -1.0))
    if shutter.delay_per_row == 0.0:
        return middles
    return positions(pinhole, motion, middles, -np.asarray(shutter.delay(middles[:, 1])))


def path_lengths(pinhole: Pinhole, motion: CameraMotion, stars: FloatArray) -> FloatArray:
    """Return the lengths (n,), px, of the paths of stars at `stars` (n, 2), px, during the exposure."""
    samples, count = len(_SAMPLED), len(stars)
    repeated, time = np.concatenate([stars] * samples), np.repeat(_SAMPLED, count)
    there = positions(pinhole, motion, repeated, time).reshape(samples, count, 2)
    step = there[1:] - there[:-1]
    return np.asarray(np.hypot(step[..., 0], step[..., 1]).sum(axis=0))


def polar_angles(pinhole: Pinhole, motion: CameraMotion, stars: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the angles (n,), rad, of `stars` (n, 2), px, from the rotation axis, and their azimuths (n,)."""
    axis = motion.rotation / max(float(np.linalg.norm(motion.rotation)), 1e-12)
    first = cross_product(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first = first / np.linalg.norm(first)
    local = pinhole.unit_vectors(stars) @ np.stack([first, cross_product(axis, first), axis]).T
    return np.arccos(np.clip(local[:, 2], -1.0, 1.0)), np.arctan2(local[:, 1], local[:, 0])


def azimuth_differences(azimuth: FloatArray, other: FloatArray) -> FloatArray:
    """Return the absolute differences (n,), at most pi, between `azimuth` (n,) and `other` (n,), rad."""
    return np.asarray(np.abs(np.remainder(azimuth - other + np.pi, 2.0 * np.pi) - np.pi))


def near_streaks(
    pinhole: Pinhole, motion: CameraMotion, stars: FloatArray, others: FloatArray, distance: float
) -> BoolArray:
    """Return which streaks of `stars` (n, 2), px, pass within `distance` px of any of `others` (m, 2)."""
    polar, azimuth = polar_angles(pinhole, motion, stars)
    other_polar, other_azimuth = polar_angles(pinhole, motion, others)
    one, other = np.nonzero(np.abs(polar[:, None] - other_polar) < distance / pinhole.focal_length)
    room = distance / (pinhole.focal_length * np.maximum(np.sin(other_polar), 1e-3))
    apart = azimuth_differences(azimuth[one], other_azimuth[other]) - room[other]
    return np.bincount(one[apart < np.linalg.norm(motion.rotation)], minlength=len(stars)) > 0
