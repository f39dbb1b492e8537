"""A camera that the streaks show to be a little other than described: its axis, scale and distortion."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray, select
from knightcube.vision.camera.lens import Pinhole

# Rounds of the contraction that takes a lens' errors out of a place: they are parts of a hundred.
_ROUNDS = 6


@dataclass(frozen=True, slots=True)
class BentPinhole(Pinhole):
    """A pinhole whose picture is displaced: by `shift` px, `scale` of the radius, `cubic` of a corner's.

    Directions and projections of the base class stay those of the pinhole; `paths` of stars are bent.
    """

    shift: tuple[float, float]
    scale: float
    cubic: float

    @property
    def _share(self) -> float:
        return self.cubic / float(np.hypot(*self.centre)) ** 2

    def bent(self, places: FloatArray) -> FloatArray:
        """Return where the lens puts what a pinhole would put at `places` (m, 2) px."""
        away = places - np.array(self.centre)
        grown = self.scale + self._share * np.sum(away**2, axis=1, keepdims=True)
        return np.asarray(places + np.array(self.shift) + grown * away)

    def straight(self, places: FloatArray) -> FloatArray:
        """Return where a pinhole would put what the lens puts at `places` (m, 2) px."""
        seen = places - np.array(self.centre) - np.array(self.shift)
        away = seen
        for _ in range(_ROUNDS):
            away = seen / (1.0 + self.scale + self._share * np.sum(away**2, axis=1, keepdims=True))
        return np.asarray(away + np.array(self.centre))

    def slopes(self, places: FloatArray) -> FloatArray:
        """Return the derivatives (m, 2, 2) of `bent` at `places` (m, 2)."""
        away = places - np.array(self.centre)
        grown = 1.0 + self.scale + self._share * np.sum(away**2, axis=1)
        outer = away[:, :, None] * away[:, None, :]
        return np.asarray(grown[:, None, None] * np.eye(2) + 2.0 * self._share * outer)

    def curving(self, places: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return the acceleration (m, 2) that the lens gives to what moves evenly at `places` (m, 2)."""
        away = places - np.array(self.centre)
        closing = np.sum(away * velocity, axis=1, keepdims=True)
        square = np.sum(velocity**2, axis=1, keepdims=True)
        return np.asarray(2.0 * self._share * (2.0 * closing * velocity + square * away))


_TINY = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The camera's rotation over one exposure.

    Attributes:
        turn: (3,) rad, rate at mid-exposure times the exposure.
        growth: (3,) rad, change of the rate over the exposure times the exposure.
        shape: (k, 3) rad, known terms of t^3, t^4, ... of the rotation vector.
    """

    turn: FloatArray
    growth: FloatArray
    shape: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def steady(cls, turn: FloatArray) -> Motion:
        """Return the motion at constant rate."""
        return cls(np.asarray(turn, dtype=float), np.zeros(3))

    @classmethod
    def between(cls, whole: FloatArray, growth: FloatArray, shape: FloatArray) -> Motion:
        """Return the motion that turns by `whole` (3,) from start to end."""
        unscaled = cls(np.zeros(3), growth, shape)
        return replace(unscaled, turn=whole - unscaled.whole)

    @property
    def constant(self) -> bool:
        """Whether the rate does not change."""
        return not (self.growth.any() or self.shape.any())

    def along(self, sense: FloatArray) -> Motion:
        """Return the motion in that direction of time in which it turns along `sense` (3,), not against it.

        The change of the rate keeps its sign.
        """
        if self.whole @ sense >= 0.0:
            return self
        odd = (-1.0) ** np.arange(3, 3 + len(self.shape))
        return Motion(-self.turn, self.growth, odd[:, None] * self.shape)

    def scaled_to(self, whole: FloatArray) -> Motion:
        """Return the motion with another rotation (3,) from start to end, or its opposite."""
        sign = -1.0 if self.whole @ whole < 0.0 else 1.0
        return replace(self, turn=self.turn + sign * whole - self.whole)

    @property
    def whole(self) -> FloatArray:
        """The rotation (3,) from start to end, rad: the mean rate times the exposure."""
        return np.asarray(self.turn + self.known(np.array([-0.5, 0.5])) @ np.array([-1.0, 1.0]))

    @property
    def middle(self) -> FloatArray:
        """The rotation (3,) rad from mid-exposure to halfway between start and end."""
        return np.asarray(self.growth / 8.0 + self.known(np.array([-0.5, 0.5])) @ np.array([0.5, 0.5]))

    @property
    def relative_growth(self) -> float:
        """The change of the rate along its axis over the exposure, in mean rates: 2 from rest."""
        square = float(self.whole @ self.whole)
        rate = self.known(np.array([-0.5, 0.5]), 1)
        change = self.growth + rate[:, 1] - rate[:, 0]
        return float(self.whole @ change) / square if square else 0.0

    def progress(self, time: FloatArray) -> FloatArray:
        """Return what part of `whole` has been turned along its axis between mid-exposure and `time` (m,)."""
        vector = self.turn[:, None] * time + 0.5 * self.growth[:, None] * time**2 + self.known(time)
        return np.asarray(self.whole @ vector / max(float(self.whole @ self.whole), _TINY))

    def pace(self, time: FloatArray, derivative: int = 0) -> FloatArray:
        """Return the rate along its axis over the mean rate at `time` (m,), or its change per exposure."""
        vector = _rate(self, time) if derivative == 0 else self.growth[:, None] + self.known(time, 2)
        pace = self.whole @ vector / max(float(self.whole @ self.whole), _TINY)
        return np.asarray(np.broadcast_to(pace, time.shape))

    def known(self, time: FloatArray, derivative: int = 0) -> FloatArray:
        """Return the terms of `shape` (3, m), or their first or second derivative, at `time` (m,)."""
        out = np.zeros((3, len(time)))
        for power, term in enumerate(self.shape, start=3):
            factor = (1, power, power * (power - 1))[derivative]
            out += factor * term[:, None] * time ** (power - derivative)
        return out


@dataclass(frozen=True, slots=True, eq=False)
class Paths:
    """Points on paths, (m,) of them: where, how fast, how bent, in px and exposures.

    Attributes:
        position, velocity, acceleration: (m, 2).
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


def paths(pinhole: Pinhole, motion: Motion, stars: FloatArray, time: FloatArray) -> Paths:
    """Return where the stars that are at pixels `stars` (m, 2) at mid-exposure are at `time` (m,)."""
    v = _rotated(_turning(motion, time), _directions(pinhole, stars))
    w = _rate(motion, time)
    velocity = _cross(v, w)  # -omega x v
    acceleration = _cross(velocity, w)
    if not motion.constant:
        acceleration += _cross(v, motion.growth[:, None] + motion.known(time, 2))
    focal = pinhole.focal_length
    inverse = 1.0 / v[2]
    there = v[:2] * inverse
    pace = (velocity[:2] - there * velocity[2]) * inverse
    bent = (acceleration[:2] - there * acceleration[2] - 2.0 * pace * velocity[2]) * inverse
    drawn = Paths(_pixels(pinhole, there), (focal * pace).T, (focal * bent).T)
    return _through(pinhole, drawn) if isinstance(pinhole, BentPinhole) else drawn


def positions(pinhole: Pinhole, motion: Motion, stars: FloatArray, time: FloatArray) -> FloatArray:
    """Return the positions (m, 2) of `paths`, and nothing else."""
    v = _rotated(_turning(motion, time), _directions(pinhole, stars))
    places = _pixels(pinhole, v[:2] / v[2])
    return pinhole.bent(places) if isinstance(pinhole, BentPinhole) else places


def image_flow(pinhole: Pinhole, points: FloatArray) -> FloatArray:
    """Return B (n, 2, 3), px per rad: the velocity of stars at `points` (n, 2) is B times the turn."""
    return _flow(pinhole, _directions(pinhole, points)[:2]).transpose(2, 0, 1)


def sensitivities(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, time: FloatArray, growing: bool = True
) -> FloatArray:
    """Return d(pixel at `time`)/d(turn, growth, star's pixel at mid-exposure): (m, 2, 8)."""
    return moving(pinhole, motion, stars, time, growing)[0]


def moving(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, time: FloatArray, growing: bool = True
) -> tuple[FloatArray, FloatArray]:
    """Return the sensitivities (m, 2, 8), and the velocities (m, 2) of `paths`.

    Exact in the turn and the star; in the growth to second order of the angle turned, and left zero unless
    `growing`.
    """
    turning = _turning(motion, time)
    v = _rotated(turning, _directions(pinhole, stars))
    there = v[:2] / v[2]
    out = np.zeros((2, 8, len(time)))
    # A change of turn or growth is a small rotation psi against the camera, the integral of the rotation from
    # t' to t over t'. It moves the star by v x psi: the flow of its place, times psi.
    flow = _flow(pinhole, there)
    # The mean rate since mid-exposure: what changes beyond it is of higher order.
    mean = motion.turn[:, None] + 0.5 * time * motion.growth[:, None]
    if motion.shape.any():
        mean += motion.known(time) / np.where(np.abs(time) < _TINY, 1.0, time)
    angle = np.sqrt(np.sum(mean * mean, axis=0))
    axis = mean / np.maximum(angle, _TINY)
    phi = angle * time
    sine = time * np.sinc(phi / np.pi)
    versine = 0.5 * time * phi * np.sinc(0.5 * phi / np.pi) ** 2
    about = _cross(flow, axis)
    out[:, :3] = sine * flow - versine * about
    out[:, :3] += (((time - sine) * np.sum(flow * axis, axis=1))[:, None]) * axis
    if growing:
        out[:, 3:6] = (0.5 * time**2) * flow - (time * time * time / 6.0 * angle) * about
    for column, unit in ((6, np.array([[1.0], [0.0], [0.0]])), (7, np.array([[0.0], [1.0], [0.0]]))):
        beside = _rotated(turning, unit)
        out[:, column] = (beside[:2] - there * beside[2]) / v[2]
    velocity = np.sum(flow * _rate(motion, time), axis=1)
    change, pace = out.transpose(2, 0, 1), velocity.T
    if isinstance(pinhole, BentPinhole):
        slopes = pinhole.slopes(_pixels(pinhole, there))
        change, pace = slopes @ change, (slopes @ pace[..., None])[..., 0]
        # The star's own pixel is one of the lens' picture.
        change[..., 6:] = change[..., 6:] @ np.linalg.inv(pinhole.slopes(pinhole.straight(stars)))
    return change, pace


def _through(pinhole: BentPinhole, drawn: Paths) -> Paths:
    """Return the paths that a lens makes of those that a pinhole would draw."""
    slopes = pinhole.slopes(drawn.position)
    velocity, acceleration = (
        (slopes @ each[..., None])[..., 0] for each in (drawn.velocity, drawn.acceleration)
    )
    acceleration += pinhole.curving(drawn.position, drawn.velocity)
    return Paths(pinhole.bent(drawn.position), velocity, acceleration)


# Below, vectors are (..., 3, m), components before points: they then lie together in memory. What is returned
# above is a transposed view of such arrays.


def _flow(pinhole: Pinhole, there: FloatArray) -> FloatArray:
    """Return (2, 3, m) px per rad, by which small rotations move what is at `there` (2, m), x/z and y/z."""
    x, y = there
    xy = x * y
    out = np.empty((2, 3, len(x)))
    out[0, 0], out[0, 1], out[0, 2] = xy, -1.0 - x * x, y
    out[1, 0], out[1, 1], out[1, 2] = 1.0 + y * y, -xy, -x
    out *= pinhole.focal_length
    return out


def _directions(pinhole: Pinhole, stars: FloatArray) -> FloatArray:
    """Return directions (3, m), not normalised (z is 1), of pixels (m, 2)."""
    if isinstance(pinhole, BentPinhole):
        stars = pinhole.straight(stars)
    out = np.ones((3, len(stars)))
    out[:2] = stars.T
    out[:2] -= np.array(pinhole.centre)[:, None]
    out[:2] /= pinhole.focal_length
    return out


def _pixels(pinhole: Pinhole, there: FloatArray) -> FloatArray:
    """Return the pixels (m, 2) of x/z and y/z (2, m)."""
    pixel = pinhole.focal_length * there
    pixel += np.array(pinhole.centre)[:, None]
    return pixel.T


def _rate(motion: Motion, time: FloatArray) -> FloatArray:
    """Return the turn's rate (3, 1), or (3, m) where it changes with `time`."""
    if motion.constant:
        return motion.turn[:, None]
    return motion.turn[:, None] + motion.growth[:, None] * time + motion.known(time, 1)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a x b of vectors (..., 3, m) and (3, m), or of one vector (3, 1)."""
    if b.shape[1] == 1:
        x, y, z = b[:, 0]
        return np.asarray(np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]) @ a)
    after, before = [1, 2, 0], [2, 0, 1]
    return np.asarray(a[..., after, :] * b[before] - a[..., before, :] * b[after])


def _turning(motion: Motion, time: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the axis (3, 1) or (3, m) of the rotation until `time` (m,), sine and cosine of its angle."""
    if motion.constant:
        angle = float(np.linalg.norm(motion.turn))
        a = (motion.turn / max(angle, _TINY))[:, None]
        phi = angle * time
    else:
        twist = np.cross(motion.turn, motion.growth) / 12.0
        parts = np.stack([motion.turn, 0.5 * motion.growth, twist], axis=1)
        square = time * time
        vector = parts @ np.stack([time, square, square * time]) + motion.known(time)
        phi = np.sqrt(np.sum(vector**2, axis=0))
        a = vector / np.maximum(phi, _TINY)
    return a, np.sin(phi), np.cos(phi)


def _rotated(turning: tuple[FloatArray, FloatArray, FloatArray], v: FloatArray) -> FloatArray:
    """Return fixed directions (3, m) in the axes of a camera that has turned by `turning`.

    They are v cos - (a x v) sin + a (a.v)(1 - cos), about the unit vector a of the rotation until then.
    """
    a, sine, cosine = turning
    along = (a * a.T) @ v if a.shape[1] == 1 else a * np.sum(a * v, axis=0)
    out = (v - along) * cosine
    out += _cross(v, a) * sine
    out += along
    return np.asarray(out)


@dataclass(frozen=True, slots=True)
class Shutter:
    """Row r is exposed from `(r - middle) delay_per_row` - 1/2 on, for one exposure; global when that is 0.

    Attributes:
        delay_per_row: exposures from one row's start to the next's.
        middle: row whose mid-exposure is the frame's.
    """

    delay_per_row: float = 0.0
    middle: float = 0.0

    def delay(self, rows: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.floating[Any]]:
        """Return how much later than the middle row `rows` are exposed, exposures."""
        # Scalars of the rows' own type, so that float32 stays float32.
        return np.asarray((rows - rows.dtype.type(self.middle)) * rows.dtype.type(self.delay_per_row))


_DEGREE = 7
# A course within this many px of a constant rate counts as constant; it is sampled at _INSTANTS.
_UNEVEN = 0.05
_INSTANTS = 65
# Its rate must be known to this many px an exposure.
_MOST_VAGUE = 3.0
# Taken as known, it shifts the mean rate by this part of its deviation.
_SHARE = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """A known turn.

    Attributes:
        terms: (k, 3) rad, coefficients of t, t^2, ... of the rotation vector since mid-exposure, t in
            exposures, camera axes.
        sigma: rad, standard deviation of the rate times the exposure.
    """

    terms: FloatArray
    sigma: float

    @classmethod
    def of_rates(cls, rates: FloatArray, exposure: float, sigma: float) -> Course:
        """Return the course of `rates` (n, 3) rad/s, known to `sigma`, at even times over `exposure` s."""
        times = np.linspace(-0.5, 0.5, len(rates))[:, None]
        powers = np.arange(_DEGREE)
        fitted = np.linalg.lstsq(times**powers, rates, rcond=None)[0]
        missed = float(np.sqrt(np.mean(np.sum((rates - times**powers @ fitted) ** 2, axis=1))))
        return cls(fitted * exposure / (powers[:, None] + 1.0), exposure * float(np.hypot(sigma, missed)))

    def motion(self, focal_length: float) -> Motion | None:
        """Return the motion for a camera of `focal_length` px; None where vague, or as good as constant."""
        motion = Motion(self.terms[0], 2.0 * self.terms[1], self.terms[2:])
        time = np.linspace(-0.5, 0.5, _INSTANTS)
        uneven = (motion.progress(time) - time) * float(np.linalg.norm(motion.whole)) * focal_length
        return motion if np.ptp(uneven) > _UNEVEN and self.sigma * focal_length < _MOST_VAGUE else None

    def covariance(self, exposure: float) -> FloatArray:
        """Return what taking the course as known adds to the covariance (3, 3) rad^2/s^2 of the mean rate."""
        return np.eye(3) * (_SHARE * self.sigma / exposure) ** 2


PIXEL_VARIANCE = 1.0 / 12.0


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The unknowns of the fit.

    Attributes:
        motion: of the camera.
        width: px, of the point spread and the pixel's own square together.
        stars: (n, 2) px at mid-exposure.
        light: (n,) counts over the exposure.
        sky: (n,) counts a pixel about the star, beside the frame's background.
        trusted: (n,) whether the star helps to determine the shared parameters; of others only light and
            place are fitted.
    """

    motion: Motion
    width: float
    stars: FloatArray
    light: FloatArray
    sky: FloatArray
    trusted: BoolArray

    @property
    def sigma(self) -> float:
        """The standard deviation of the point spread without the pixel's square, px."""
        return float(np.sqrt(max(self.width**2 - PIXEL_VARIANCE, 0.01)))

    def select(self, chosen: BoolArray | IntArray) -> Scene:
        """Return the scene with the stars that `chosen` picks, by mask or index."""
        return select(self, chosen, "motion", "width")

    def with_stars(self, stars: FloatArray, light: FloatArray) -> Scene:
        """Return the scene with more stars (m, 2) of `light` (m,), untrusted."""
        return replace(
            self,
            stars=np.concatenate([self.stars, stars]),
            light=np.concatenate([self.light, light]),
            sky=np.concatenate([self.sky, np.zeros(len(light))]),
            trusted=np.concatenate([self.trusted, np.zeros(len(light), dtype=np.bool_)]),
        )


def window_times(pinhole: Pinhole, motion: Motion, shutter: Shutter, stars: FloatArray) -> FloatArray:
    """Return when each star (n, 2) begins and ends to be exposed, (n, 2), in exposures from mid-exposure."""
    times = np.tile([-0.5, 0.5], (len(stars), 1))
    if shutter.delay_per_row == 0.0:
        return times
    # The row of each end depends on its time: a contraction, since readout is slow beside the star.
    for _ in range(4):
        for end, nominal in enumerate((-0.5, 0.5)):
            row = positions(pinhole, motion, stars, times[:, end])[:, 1]
            times[:, end] = nominal + shutter.delay(np.clip(row, 0.0, pinhole.rows - 1.0))
    return times


def mid_exposure(pinhole: Pinhole, motion: Motion, shutter: Shutter, middles: FloatArray) -> FloatArray:
    """Return where stars are at mid-exposure whose streaks have the middles of their length at `middles`.

    All are (n, 2) px.
    """
    if not len(middles):
        return middles
    if not motion.constant:
        middles = positions(pinhole, Motion.steady(motion.middle), middles, np.full(len(middles), -1.0))
    if shutter.delay_per_row == 0.0:
        return middles
    return positions(pinhole, motion, middles, -np.asarray(shutter.delay(middles[:, 1])))


def path_lengths(pinhole: Pinhole, motion: Motion, stars: FloatArray) -> FloatArray:
    """Return the length (n,) px of the paths of `stars` (n, 2)."""
    samples = 9
    time = np.tile(np.linspace(-0.5, 0.5, samples), len(stars))
    there = positions(pinhole, motion, np.repeat(stars, samples, axis=0), time).reshape(-1, samples, 2)
    step = np.diff(there, axis=1)
    return np.asarray(np.hypot(step[..., 0], step[..., 1]).sum(axis=1))


# Pieces lie within this many px of one circle, are this many turns apart, and differ in light by this factor.
_ASIDE = 1.3
_NEXT = (0.55, 1.7)
_ALIKE = 2.5


def circles(pinhole: Pinhole, motion: Motion, stars: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the angles (n,) rad of stars at pixels (n, 2) from the axis of rotation, and about it."""
    axis = motion.whole / max(float(np.linalg.norm(motion.whole)), 1e-12)
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first = first / np.linalg.norm(first)
    local = pinhole.unit_vectors(stars) @ np.stack([first, np.cross(axis, first), axis]).T
    return np.arccos(np.clip(local[:, 2], -1.0, 1.0)), np.arctan2(local[:, 1], local[:, 0])


def apart(azimuth: FloatArray, other: FloatArray) -> FloatArray:
    """Return the differences (n, m) of angles (n,) and (m,) rad, at most pi."""
    return np.asarray(np.abs(np.remainder(azimuth[:, None] - other + np.pi, 2.0 * np.pi) - np.pi))


def in_chains(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, light: FloatArray, asked: int | None = None
) -> BoolArray:
    """Return which stars (n, 2) of `light` (n,) have another like them before or behind on their circle.

    Only the first `asked` of them are judged, when that is given.
    """
    polar, azimuth = circles(pinhole, motion, stars)
    turns = apart(azimuth[:asked], azimuth) / max(float(np.linalg.norm(motion.whole)), 1e-12)
    aside = np.abs(polar[:asked, None] - polar) * pinhole.focal_length
    ratio = light[:asked, None] / np.maximum(light, 1e-9)
    joined = (aside < _ASIDE) & (turns > _NEXT[0]) & (turns < _NEXT[1])
    return np.asarray((joined & (ratio < _ALIKE) & (ratio > 1.0 / _ALIKE)).any(axis=1))


def close_by(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, others: FloatArray, distance: float
) -> BoolArray:
    """Return which of `stars` (n, 2) draw streaks within `distance` px of a streak of `others` (m, 2)."""
    polar, azimuth = circles(pinhole, motion, stars)
    other_polar, other_azimuth = circles(pinhole, motion, others)
    beside = np.abs(polar[:, None] - other_polar) * pinhole.focal_length < distance
    room = distance / (pinhole.focal_length * np.maximum(np.sin(other_polar), 1e-3))
    angle = float(np.linalg.norm(motion.whole))
    return np.asarray((beside & (apart(azimuth, other_azimuth) < angle + room)).any(axis=1))
