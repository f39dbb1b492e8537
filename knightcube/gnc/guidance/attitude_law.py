"""Attitude laws: the commanded attitude as a function of time, from two directions or a pointing target.

An attitude law aligns one body axis exactly with a first direction, and a second body axis with a second
direction as closely as possible (TRIAD: Black 1964). Possible directions are a direction fixed in inertial
axes, nadir, the velocity, the orbit normal, and the directions to the Sun and to a point on the ground.

The law of a pointing target aligns the pointing axis with the direction of the target, and the body axis
`across` with a second direction: the velocity for nadir and ground targets, nadir for the velocity target,
the celestial pole for the Sun. If a roll is given, the body is additionally rotated about the pointing axis.
If the roll is free, the body keeps its roll angle at the time at which the attitude law begins. The free roll
angle is measured from the celestial pole for the Sun, and from the orbit normal for all other targets. The
body then rotates little about the pointing axis. The line through the satellite along the orbit normal never
hits the Earth, so a ground target is never near the orbit normal, where the roll would change fast.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import erfa
import numpy as np

from knightcube.astro.arrays import (
    FloatArray,
    check_finite,
    check_numbers,
    finite_array,
    unit_quaternion,
    unit_vector,
)
from knightcube.astro.earth.ephemeris import Ephemeris
from knightcube.astro.earth.orientation import celestial_to_terrestrial
from knightcube.astro.earth.sun import DAY
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_matrix,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)
from knightcube.errors import UsageError
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget

Direction = Callable[[Ephemeris, FloatArray], FloatArray]
"""Function that returns unit vectors (n, 3), ICRS, for an ephemeris and times (n,), s."""
DIFFERENCE = 1.0
"""Time step (s) of the central differences from which rate and acceleration are computed."""
_HIGHEST = 1e5
"""Largest height (m) of a point on the ground above or below the ellipsoid."""
MINIMUM_SINE = 1e-3
"""Smallest permitted sine of the angle between the two directions, because nearly parallel directions do not
determine the roll."""


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeReference:
    """The commanded attitude (4,), rate (3,), rad/s, and acceleration (3,), rad/s^2, at one time.

    Rate and acceleration are in the axes of the commanded attitude.
    """

    quaternion: FloatArray
    rate: FloatArray
    acceleration: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeReferences:
    """The commanded motion at equally spaced times (n,), s.

    The attitudes (n, 4) rotate ICRS into body axes. The body rates (n, 3), rad/s, and angular accelerations
    (n, 3), rad/s^2, are in the axes of the commanded attitude.
    """

    times: FloatArray
    quaternion: FloatArray
    rate: FloatArray
    acceleration: FloatArray

    def position(self, time: float) -> tuple[int, float]:
        """Return the index of the last instant before `time`, s, and the fraction of the step since then."""
        begin, step = float(self.times[0]), float(self.times[1] - self.times[0])
        position = (time - begin) / step
        k = min(max(math.floor(position), 0), len(self.times) - 2)
        return k, min(max(position - k, 0.0), 1.0)

    def at(self, time: float) -> AttitudeReference:
        """Return the commanded motion at `time`, s; times outside the range are clamped to its ends."""
        k, share = self.position(time)
        near = k + round(share)
        since = (share - round(share)) * float(self.times[1] - self.times[0])
        rate, acceleration = self.rate[near], self.acceleration[near]
        turned = from_rotation_vector(since * rate + 0.5 * since * since * acceleration)
        return AttitudeReference(
            multiply(turned, self.quaternion[near]),
            (1.0 - share) * self.rate[k] + share * self.rate[k + 1],
            (1.0 - share) * self.acceleration[k] + share * self.acceleration[k + 1],
        )

    def until(self, count: int) -> AttitudeReferences:
        """Return the commanded motion at the first `count` instants only."""
        return self._part(slice(count))

    def since(self, position: int) -> AttitudeReferences:
        """Return the commanded motion without the instants before the index `position`."""
        return self._part(slice(position, None))

    def _part(self, part: slice) -> AttitudeReferences:
        return AttitudeReferences(
            self.times[part], self.quaternion[part], self.rate[part], self.acceleration[part]
        )


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeLaw:
    """An attitude law that aligns body `axis` (3,) with `first`, and body axis `across` (3,) with `second`.

    The alignment with `first` is exact, and the alignment with `second` is as close as possible. The axes are
    normalised. Raises ArgumentError for an axis that is zero or not finite.
    """

    axis: FloatArray
    first: Direction
    across: FloatArray
    second: Direction

    def __post_init__(self) -> None:
        for name in ("axis", "across"):
            object.__setattr__(self, name, unit_vector(name, getattr(self, name)))

    def attitudes(self, ephemeris: Ephemeris, times: FloatArray) -> FloatArray:
        """Return commanded attitudes (n, 4) at times (n,) s. Raises UsageError for parallel directions."""
        wanted = _frames(self.first(ephemeris, times), self.second(ephemeris, times))
        body = _frames(self.axis[None], self.across[None])[0]
        return from_matrix(body.T @ wanted)


Attitudes = Callable[[Ephemeris, FloatArray], FloatArray]
"""Function, such as an `AttitudeLaw`, that returns commanded attitudes (n, 4) for an ephemeris and times
(n,), s."""


def references(attitudes: Attitudes, ephemeris: Ephemeris, times: FloatArray) -> AttitudeReferences:
    """Return the commanded motion at times (n,), s, with rates and accelerations by central differences."""
    shifted = np.concatenate([times - DIFFERENCE, times, times + DIFFERENCE])
    before, now, after = np.split(attitudes(ephemeris, shifted), 3)
    back = to_rotation_vector(multiply(before, conjugate(now)))
    ahead = to_rotation_vector(multiply(after, conjugate(now)))
    return AttitudeReferences(times, now, (ahead - back) / (2.0 * DIFFERENCE), (ahead + back) / DIFFERENCE**2)


def nadir(ephemeris: Ephemeris, times: FloatArray) -> FloatArray:
    """Return the unit vectors (n, 3) from the satellite to the Earth's centre."""
    return _unit(-ephemeris.position_at(times))


def velocity(ephemeris: Ephemeris, times: FloatArray) -> FloatArray:
    """Return the unit vectors (n, 3) along the inertial velocity."""
    return _unit(ephemeris.velocity_at(times))


def orbit_normal(ephemeris: Ephemeris, times: FloatArray) -> FloatArray:
    """Return the unit vectors (n, 3) along the angular momentum of the orbit."""
    return _unit(np.cross(ephemeris.position_at(times), ephemeris.velocity_at(times)))


def sun(ephemeris: Ephemeris, times: FloatArray) -> FloatArray:
    """Return the unit vectors (n, 3) to the Sun."""
    return ephemeris.sun_at(times)


def inertial(vector: FloatArray) -> Direction:
    """Return the function of time that gives a direction (3,) fixed in inertial axes.

    Raises ArgumentError for a direction that is zero or not finite.
    """
    fixed = unit_vector("vector", vector)

    def at(_: Ephemeris, times: FloatArray) -> FloatArray:
        return np.broadcast_to(fixed, (len(times), 3))

    return at


def ground(latitude: float, longitude: float, height: float = 0.0) -> Direction:
    """Return the function of time that gives the direction from the satellite to a point on the ground.

    The geodetic coordinates are `latitude` and `longitude`, rad, and `height`, m above the WGS 84 ellipsoid.
    Raises UsageError for values out of range, such as angles in degrees.
    """
    check_numbers(latitude=latitude, longitude=longitude, height=height)
    possible = abs(latitude) <= 0.5 * math.pi and abs(longitude) <= 2.0 * math.pi and abs(height) <= _HIGHEST
    if not possible:
        raise UsageError(
            f"latitude {latitude}, longitude {longitude} rad, height {height} m is not a point on the Earth"
        )
    station = np.asarray(erfa.gd2gc(1, longitude, latitude, height))

    def at(ephemeris: Ephemeris, times: FloatArray) -> FloatArray:
        to_ground = celestial_to_terrestrial(ephemeris.julian_date + np.asarray(times) / DAY)
        return _unit(station @ to_ground - ephemeris.position_at(times))

    return at


def free_roll(
    axis: FloatArray,
    first: Direction,
    second: Direction,
    quaternion: FloatArray,
    ephemeris: Ephemeris,
    time: float,
) -> AttitudeLaw:
    """Return a law that aligns `axis` (3,) with `first` and keeps the roll of an attitude (4,) at `time`, s.

    The attitude is first rotated by the smallest rotation that aligns `axis`. The roll is then constant
    relative to the direction `second`. Raises ArgumentError for an impossible axis or quaternion.
    """
    axis, shown = unit_vector("axis", axis), attitude_matrix(unit_quaternion("quaternion", quaternion))
    when = np.array([time])
    kept = _turned(first(ephemeris, when)[0], shown.T @ axis, second(ephemeris, when)[0])
    return AttitudeLaw(axis, first, shown @ kept, second)


def passing(direction: FloatArray, velocity: FloatArray, since: float) -> Direction:
    """Return the function for the direction to an object that moves on a straight line relative to the body.

    At the time `since`, s, the unit vector `direction` (3,) points to the object. The argument `velocity`
    (3,), 1/s, is the object's velocity relative to the satellite, divided by the distance, and zero for a
    fixed direction. Raises ArgumentError for values that are not finite, and for a direction of zero.
    """
    direction, velocity = unit_vector("direction", direction), finite_array("velocity", velocity, (3,))
    check_finite(since=since)

    def at(_: Ephemeris, times: FloatArray) -> FloatArray:
        return _unit(direction + (np.asarray(times) - since)[:, None] * velocity)

    return at


def following(
    axis: FloatArray, direction: FloatArray, velocity: FloatArray, since: float, quaternion: FloatArray
) -> AttitudeLaw:
    """Return the law that points `axis` (3,) to a `passing` object, without a rotation about `axis`.

    The law starts with the given attitude (4,), rotated by the smallest rotation that aligns `axis`. Raises
    ArgumentError for an impossible axis or quaternion, and for values that `passing` refuses.
    """
    axis, shown = unit_vector("axis", axis), attitude_matrix(unit_quaternion("quaternion", quaternion))
    towards = passing(direction, velocity, since)
    direction = unit_vector("direction", direction)
    normal = np.cross(direction, velocity)
    size = float(np.linalg.norm(normal))
    now = shown.T @ axis
    normal = normal / size if size > 1e-9 else _turned(now, direction, shown.T @ _any_across(axis))
    across = shown @ _turned(direction, now, normal)
    return AttitudeLaw(axis, towards, across, inertial(normal))


def approach(
    attitudes: Attitudes, quaternion: FloatArray, rate: FloatArray, begin: float, end: float
) -> Attitudes:
    """Return the transition from an attitude (4,) with a body rate (3,), rad/s, to the motion `attitudes`.

    The transition lasts from `begin` to `end` s. The rotation vector relative to the attitude law is a
    quintic polynomial of time, which starts with the body's rate relative to the law and ends with zero rate.
    Raises UsageError unless `end` is after `begin`, and ArgumentError for an impossible attitude or rate.
    """
    quaternion, rate = unit_quaternion("quaternion", quaternion), finite_array("rate", rate, (3,))
    if not begin < end < math.inf:
        raise UsageError(f"an approach from {begin} to {end} s: the end must be after the start")

    def at(ephemeris: Ephemeris, times: FloatArray) -> FloatArray:
        wanted = attitudes(ephemeris, times)
        start = attitudes(ephemeris, begin + np.array([-DIFFERENCE, 0.0, DIFFERENCE]))
        left = to_rotation_vector(multiply(quaternion, conjugate(start[1])))
        law_rate = to_rotation_vector(multiply(start[2], conjugate(start[0]))) / (2.0 * DIFFERENCE)
        shown = attitude_matrix(from_rotation_vector(left)) @ law_rate
        # The polynomial is also evaluated just before the start, for the central differences at the start.
        share = np.minimum((np.asarray(times) - begin) / (end - begin), 1.0)[:, None]
        rest = 1.0 - share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        drift = (end - begin) * share * (1.0 - share) ** 3 * (1.0 + 3.0 * share)
        # The inverse left Jacobian of the rotation group gives the derivative of the rotation vector `left`.
        angle, relative = float(np.linalg.norm(left)), rate - shown
        second = 1.0 / 12.0 if angle < 1e-2 else (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2
        crossed = np.cross(left, relative)
        derivative = np.asarray(relative + 0.5 * crossed + second * np.cross(left, crossed))
        return multiply(from_rotation_vector(rest * left + drift * derivative), wanted)

    return at


def _turned(start: FloatArray, end: FloatArray, vector: FloatArray) -> FloatArray:
    """Return `vector` (3,) rotated by the shortest rotation from unit vector `start` to `end`."""
    axis = np.cross(start, end)
    cosine = float(start @ end)
    if cosine < -1.0 + 1e-9:  # opposite directions: any axis normal to both
        return vector
    return np.asarray(cosine * vector + np.cross(axis, vector) + axis * (axis @ vector) / (1.0 + cosine))


def _any_across(axis: FloatArray) -> FloatArray:
    """Return the unit vector (3,) normal to `axis` that is closest to a coordinate axis."""
    unit = np.eye(3)[int(np.argmin(np.abs(axis)))]
    return _unit(unit - axis * float(axis @ unit))


def _frames(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return right-handed frames (n, 3, 3) with rows `first`, the common normal, and their cross product."""
    normal = np.cross(first, second)
    sine = np.linalg.norm(normal, axis=1, keepdims=True)
    if float(np.min(sine)) < MINIMUM_SINE:
        raise UsageError(
            "the two directions of the attitude law are parallel, so that the roll is undetermined"
        )
    normal = normal / sine
    return np.stack([first, normal, np.cross(first, normal)], axis=1)


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


POLE = inertial(np.array([0.0, 0.0, 1.0]))
"""Direction of the celestial pole. The Sun is always at least 66 deg from the pole, so the two directions are
never parallel."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyAxes:
    """The pointing axis (3,) of a body, and the body axis `across` (3,) from which a roll is measured.

    The axes are normalised. Raises ArgumentError for an axis that is zero or not finite.
    """

    pointing: FloatArray
    across: FloatArray

    def __post_init__(self) -> None:
        for name in ("pointing", "across"):
            object.__setattr__(self, name, unit_vector(name, getattr(self, name)))


def law_of(
    target: PointingTarget, axes: BodyAxes, quaternion: FloatArray, ephemeris: Ephemeris, time: float
) -> Attitudes:
    """Return the attitude law of a target. A free roll angle is taken from the attitude (4,) at `time`, s."""
    if target.goal is Goal.INERTIAL:
        fixed = normalise(np.array(target.numbers))
        return lambda _, times: np.broadcast_to(fixed, (len(times), 4))
    first, second = directions_of(target)
    if target.roll is None:
        second = POLE if target.goal is Goal.SUN else orbit_normal
        return free_roll(axes.pointing, first, second, quaternion, ephemeris, time).attitudes
    turned = attitude_matrix(from_rotation_vector(target.roll * axes.pointing)) @ axes.across
    return AttitudeLaw(axes.pointing, first, turned, second).attitudes


def directions_of(target: PointingTarget) -> tuple[Direction, Direction]:
    """Return the functions for the direction of a goal and for the direction that defines zero roll.

    The goals INERTIAL, which is defined by a quaternion, and OBJECT are not supported.
    """
    if target.goal is Goal.GROUND:
        return ground(*target.numbers), velocity
    along = {Goal.NADIR: (nadir, velocity), Goal.VELOCITY: (velocity, nadir), Goal.SUN: (sun, POLE)}
    return along[target.goal]
