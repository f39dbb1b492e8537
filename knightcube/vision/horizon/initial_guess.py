"""Initial guess of a horizon: the cone with which most edges agree, and the camera's rotation about nadir.

All rays u to the limb of a sphere make the same angle rho with the nadir n. The limb therefore satisfies the
equation u.g = 1, which is linear in g = n / cos rho (Christian & Robinson 2016). Two rays to the limb
determine the nadir up to two solutions if rho is known, and three rays determine rho and the nadir. Trial
cones are computed from all pairs of edges, or from all triples if the altitude is unknown. If there are too
many pairs or triples, an evenly spaced selection is used. An edge agrees with a cone if it lies near the cone
and its bright side is towards nadir. The edges of the best cone are removed and the search is repeated, so
that the terminator, a coast or a band of clouds gives a separate cone. The search is a sample consensus
(Fischler & Bolles 1981) without random selection.

A horizon does not determine the rotation about nadir. This rotation is needed to predict the flattening of
the limb, which depends on the direction of the pole, and the illumination, which depends on the direction of
the Sun. The rotation is derived from a rough attitude, the coarse direction of the Sun or the magnetic field.
The angle between nadir and each known direction is also known, so that a nadir at a different angle is
rejected.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray, select, tangent_basis
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS, SEMI_MINOR_AXIS
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.horizon.edges import EdgeRays, Observation
from knightcube.vision.horizon.illumination import agreement
from knightcube.vision.horizon.limb import (
    MEAN_RADIUS,
    UNIT_DEPTH_HEIGHT,
    UNKNOWN,
    Ellipsoid,
    LimbView,
    earth,
    mean_sphere,
    turn,
)
from knightcube.vision.horizon.settings import HorizonKnowledge, HorizonSettings

_PARALLEL = 1e-12
"""Squared sine of the angle between two rays below which the rays count as parallel."""


def nadirs_of_pairs(first: FloatArray, second: FloatArray, cosine: float) -> FloatArray:
    """Return the two directions (2, n, 3) that make a given angle with both rays of each pair (n, 3).

    `cosine` is the cosine of the angle. The directions are NaN if the rays of a pair are parallel, or if the
    angle between the two rays is more than twice the given angle.
    """
    dot = np.einsum("ij,ij->i", first, second)
    normal = np.cross(first, second)
    square = np.einsum("ij,ij->i", normal, normal)
    share = cosine / (1.0 + np.maximum(dot, -1.0 + _PARALLEL))
    inside = 1.0 - 2.0 * cosine * share
    sound = (inside >= 0.0) & (square > _PARALLEL)
    height = np.where(sound, np.sqrt(np.abs(inside) / np.where(sound, square, 1.0)), np.nan)
    middle = share[:, None] * (first + second)
    aside = height[:, None] * normal
    return np.stack([middle + aside, middle - aside])


def nadirs_of_triples(
    first: FloatArray, second: FloatArray, third: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the cones through triples of rays (n, 3): their axes (n, 3) and half-angle cosines (n,).

    Axis and cosine are NaN if two rays of a triple are equal.
    """
    normal = np.cross(second - first, third - first)
    size = np.linalg.norm(normal, axis=1)
    directions = normal / np.where(size > _PARALLEL, size, np.nan)[:, None]
    cosines = np.einsum("ij,ij->i", directions, first)
    # Nadir is the normal within 90 deg of the rays, because the limb is within 90 deg of nadir.
    sign = np.where(cosines < 0.0, -1.0, 1.0)
    return directions * sign[:, None], cosines * sign


@dataclass(frozen=True, slots=True, eq=False)
class ConeCandidate:
    """Axis (3,), cosine of the half-angle and mask of the edges (n,) of a cone that may be a horizon."""

    direction: FloatArray
    cosine: float
    members: BoolArray


def best_cone(
    edges: EdgeRays, free: BoolArray, cosines: tuple[float, float], tolerance: float, tries: int
) -> ConeCandidate | None:
    """Return the cone with which most edges in the mask `free` (n,) agree, or None if no cone can be formed.

    The limits `cosines` of the cosine of the cone's half-angle are equal if the angle is known. An edge
    agrees with a cone if it lies within `tolerance` px of the cone. At most `tries` pairs or triples of edges
    are tried.
    """
    chosen = np.flatnonzero(free)
    if cosines[0] == cosines[1]:
        first, second = _pairs(len(chosen), tries)
        one, other = chosen[first], chosen[second]
        directions = nadirs_of_pairs(edges.rays[one], edges.rays[other], cosines[0])
        # A cone is dropped if the bright sides of its two edges are not towards its axis.
        sides = edges.brighter[one], edges.brighter[other]
        agrees = [np.einsum("kij,ij->ki", directions, side) > 0.0 for side in sides]
        directions = directions[agrees[0] & agrees[1]]
        half_angles = np.full(len(directions), cosines[0])
    else:
        triples = _triples(len(chosen), tries)
        directions, half_angles = nadirs_of_triples(*(edges.rays[chosen[i]] for i in triples))
        directions[(half_angles < cosines[0]) | (half_angles > cosines[1])] = np.nan
    sound = np.isfinite(directions[:, 0])
    directions, half_angles = directions[sound], half_angles[sound]
    if not len(directions):
        return None
    counts = np.count_nonzero(_agreeing(select(edges, chosen), directions, half_angles, tolerance), axis=1)
    best = slice(place := int(np.argmax(counts)), place + 1)
    members = _agreeing(edges, directions[best], half_angles[best], tolerance)[0]
    return ConeCandidate(directions[place], float(half_angles[place]), members)


def left_free(edges: EdgeRays, free: BoolArray, cone: ConeCandidate, tolerance: float) -> BoolArray:
    """Return which edges in the mask `free` (n,) are farther from a cone than twice the `tolerance` (px)."""
    near = _agreeing(edges, cone.direction[None], np.array([cone.cosine]), 2.0 * tolerance)[0]
    return np.asarray(free & ~near & ~cone.members)


@lru_cache(maxsize=64)
def _pairs(count: int, tries: int) -> tuple[IntArray, IntArray]:
    """Return the indices of all pairs of `count` items, or of at most `tries` evenly selected pairs."""
    first, second = np.triu_indices(count, 1)
    if len(first) > tries:
        chosen = np.linspace(0, len(first) - 1, tries).astype(int)
        first, second = first[chosen], second[chosen]
    return first, second


def _triples(count: int, tries: int) -> tuple[IntArray, IntArray, IntArray]:
    """Return the indices of up to `tries` triples of `count` items, with small and large differences."""
    number = np.arange(tries)
    first = number % count
    # The fractional parts of multiples of the golden ratio, and of sqrt(2), cover 0 to 1 evenly.
    one = 1 + ((number * 0.6180339887) % 1.0 * (count - 1)).astype(int)
    two = 1 + ((number * 0.4142135624) % 1.0 * (count - 1)).astype(int)
    sound = one != two
    return first[sound], (first + one)[sound] % count, (first + two)[sound] % count


def _agreeing(edges: EdgeRays, directions: FloatArray, cosines: FloatArray, tolerance: float) -> BoolArray:
    """Return which of n edges agree with each of k cones, as an array (k, n).

    An edge agrees if it lies within `tolerance` px of the cone and its bright side is towards the axis. The
    cones are given by their axes `directions` (k, 3) and the cosines (k,) of their half-angles.
    """
    sines = np.sqrt(np.maximum(1.0 - cosines**2, 1e-6))
    # A ray at the angle a from the axis is about (cos a - cos rho) / sin rho, rad, from the cone.
    off = directions @ edges.rays.T
    off -= cosines[:, None]
    near = np.abs(off, out=off) <= sines[:, None] * (tolerance * edges.pixel)
    near &= directions @ edges.brighter.T > 0.0
    return near


MOST_MISMATCH = 4.0
"""Largest accepted difference between a nadir and a coarse sensor's measurement, in standard deviations."""
_GUESS_SIGMA = math.radians(0.2)
"""Standard deviation (rad) of the nadir from a cone, before the fit of the limb.

Measured errors are 0.07 to 0.3 deg.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Orientation:
    """The attitude of a camera for an assumed nadir, with the rotation about nadir from known directions.

    Attributes:
        rotation: rotation matrix (3, 3) from inertial to camera axes, consistent with the assumed nadir.
        sigma: standard deviation of the camera's rotation about nadir, rad; infinite if it is unknown.
        mismatch: largest difference between the measured and the expected angle from the assumed nadir to a
            known direction, in standard deviations.
        share: fraction of the sphere on which a nadir agrees with the known directions.
    """

    rotation: FloatArray
    sigma: float
    mismatch: float
    share: float = 1.0


def orientation(nadir: FloatArray, inertial_nadir: FloatArray, knowledge: HorizonKnowledge) -> Orientation:
    """Return the camera attitude that maps `inertial_nadir` (3,), inertial axes, to `nadir`, camera axes."""
    base = shortest_turn(inertial_nadir, nadir)
    # Each known direction is given in camera axes and in inertial axes, with a standard deviation.
    # A rough attitude gives two known directions, nadir and a direction at right angles to it.
    known = [(each.camera, each.inertial, each.sigma) for each in knowledge.sensed]
    if knowledge.attitude is not None:
        matrix, sigma = attitude_matrix(knowledge.attitude.quaternion), knowledge.attitude.sigma
        known += [(matrix @ axis, axis, sigma) for axis in (inertial_nadir, tangent_basis(inertial_nadir)[0])]
    # Each known direction restricts nadir to a circle on the sphere, and two circles nearly determine it.
    narrowest = sorted(math.hypot(sigma, _GUESS_SIGMA) for _, _, sigma in known)[:2]
    share = math.prod(min(1.0, MOST_MISMATCH * sigma) for sigma in narrowest)
    down = _unit(nadir)
    vote, weight, mismatch = 0.0 + 0.0j, 0.0, 0.0
    for camera, inertial, sigma in known:
        seen, expected = _unit(camera), _unit(base @ inertial)
        below, assumed = _dot(down, seen), _dot(down, expected)
        across = _length(_cross(down, expected))
        apart = math.atan2(_length(_cross(down, seen)), below) - math.atan2(across, assumed)
        mismatch = max(mismatch, abs(apart) / math.hypot(sigma, _GUESS_SIGMA))
        if across > 0.05:
            angle = math.atan2(_dot(down, _cross(expected, seen)), _dot(seen, expected) - below * assumed)
            precision = (across / sigma) ** 2
            vote += precision * cmath.exp(1j * angle)
            weight += precision
    if weight == 0.0:
        return Orientation(base, math.inf, mismatch, share)
    return Orientation(turn(cmath.phase(vote) * nadir) @ base, weight**-0.5, mismatch, share)


# For a single vector, Python floats are ten times as fast as a numpy array.
Vector = tuple[float, float, float]


def _unit(vector: FloatArray) -> Vector:
    x, y, z = vector.tolist()
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


def _dot(one: Vector, other: Vector) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _cross(one: Vector, other: Vector) -> Vector:
    (a, b, c), (x, y, z) = one, other
    return b * z - c * y, c * x - a * z, a * y - b * x


def _length(vector: Vector) -> float:
    return math.sqrt(_dot(vector, vector))


def shortest_turn(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return the smallest rotation (3, 3) from one unit vector to another.

    For opposite vectors, the result is a rotation of 180 deg about an arbitrary axis normal to both.
    """

    def half_turn(axis: FloatArray, square: float) -> FloatArray:
        return np.asarray(2.0 / square * np.outer(axis, axis) - np.eye(3))

    middle = source + target
    square = float(middle @ middle)
    if square < 1e-12:
        return half_turn(tangent_basis(source)[0], 1.0)
    # The smallest rotation consists of 180 deg about `source` followed by 180 deg about `middle`.
    return np.asarray(half_turn(middle, square) @ half_turn(source, 1.0))


SPHERE_ALTITUDE_SIGMA = 10e3
"""Standard deviation (m) of a fitted altitude above the mean sphere due to the flattening of the Earth."""
_RADIUS_SIGMA = math.sqrt(4.0 / 45.0) * (SEMI_MAJOR_AXIS - SEMI_MINOR_AXIS)
"""Standard deviation (m) of the Earth's radius over all positions on the sphere, 6.4 km."""
_TURNS = 24
"""Number of trial rotations about nadir if the rotation is unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """The known or assumed position of the camera.

    Attributes:
        position: position of the camera (3,), m, in inertial axes if `located`, otherwise in arbitrary axes.
        surface: ellipsoid of the Earth, or a sphere if only the altitude is known.
        altitude_sigma: standard deviation of the altitude, m; very large if the altitude is unknown.
        located: whether the position is known; otherwise only the altitude of `position` is meaningful.
    """

    position: FloatArray
    surface: Ellipsoid
    altitude_sigma: float
    located: bool

    @property
    def cosine(self) -> float:
        """The cosine of the half-angle of the limb's cone for a sphere with the Earth's local radius."""
        distance = float(np.linalg.norm(self.position))
        radius = distance - self.surface.height_of(self.position) + UNIT_DEPTH_HEIGHT
        return float(np.sqrt(1.0 - min(1.0, radius / distance) ** 2))


def above_sphere(altitude: float, sigma: float = 0.0) -> Place:
    """Return an arbitrary position at an altitude above the mean sphere, m, with uncertainty `sigma`, m."""
    return Place(np.array([0.0, 0.0, MEAN_RADIUS + altitude]), mean_sphere(), sigma, False)


def limb_radius_sigma(altitude: float) -> float:
    """Return the standard deviation (m) of the limb's mean radius if the position of the camera is unknown.

    The difference between the ellipsoid and the mean sphere is a spherical harmonic of degree 2. The mean of
    a harmonic of degree 2 over the limb is its value at the sub-camera point multiplied by P2(cos a). P2 is
    the Legendre polynomial, and a is the angle at the Earth's centre between the camera and the limb. The
    `altitude`, m, is measured from the mean sphere.
    """
    cosine = MEAN_RADIUS / (MEAN_RADIUS + altitude)
    return _RADIUS_SIGMA * abs(1.5 * cosine**2 - 0.5)


def limb_tilt_sigma(view: LimbView, stand: Orientation, settings: HorizonSettings) -> float:
    """Return the standard deviation per axis (rad) of the limb's tilt due to an unknown flattening direction.

    The tilt is 0 if the rotation about nadir, and with it the direction of the flattening, is known.
    """
    if np.isfinite(stand.sigma):
        return 0.0
    return settings.sphere_sigma * MEAN_RADIUS**2 / float(view.position @ view.position)


def place_of(knowledge: HorizonKnowledge, settings: HorizonSettings) -> Place | None:
    """Return the camera's position from prior knowledge, or None if the altitude is unknown."""
    if knowledge.position is not None:
        position = np.asarray(knowledge.position, dtype=float)
        return Place(position, earth(knowledge.pole), settings.altitude_sigma, True)
    if knowledge.altitude is not None:
        # A larger Earth radius has the same effect on the limb as a lower altitude.
        nearer = (MEAN_RADIUS + knowledge.altitude) / MEAN_RADIUS
        return above_sphere(knowledge.altitude, nearer * limb_radius_sigma(knowledge.altitude))
    return None


def sun_from(place: Place, knowledge: HorizonKnowledge) -> FloatArray | None:
    """Return the unit vector (3,) to the Sun, inertial axes, or None if Sun or position is unknown."""
    if knowledge.sun is None or not place.located:
        return None
    return np.asarray(knowledge.sun / np.linalg.norm(knowledge.sun))


@dataclass(frozen=True, slots=True, eq=False)
class InitialGuess:
    """The starting point for the fit of a horizon.

    Attributes:
        place: known or assumed position of the camera relative to the Earth.
        view: assumed position and attitude of the camera and height of the limb.
        orientation: attitude of the camera, with the uncertainty of its rotation about nadir.
        members: mask of the edges of the image that agree with the cone of the guess (n,).
    """

    place: Place
    view: LimbView
    orientation: Orientation
    members: BoolArray


def initial_guess(
    candidate: ConeCandidate, observation: Observation, place: Place | None, knowledge: HorizonKnowledge
) -> InitialGuess:
    """Return the initial guess of a horizon from a cone; `place` is None if the altitude is unknown.

    If the rotation about nadir is unknown, the Earth is assumed to be a sphere. If the direction of the Sun
    is known, the rotation about nadir that agrees best with the brightness of the image is used.
    """
    if place is None:
        sine = float(np.sqrt(max(1.0 - candidate.cosine**2, 1e-6)))
        place = above_sphere((MEAN_RADIUS + UNIT_DEPTH_HEIGHT) / sine - MEAN_RADIUS, UNKNOWN)
    distance = float(np.linalg.norm(place.position))
    down = -place.position / distance
    stand = orientation(candidate.direction, down, knowledge if place.located else HorizonKnowledge())
    view = LimbView(stand.rotation, place.position, place.surface, UNIT_DEPTH_HEIGHT)
    if np.isfinite(stand.sigma):
        return InitialGuess(place, view, stand, candidate.members)
    radius = distance - place.surface.height_of(place.position)
    view = replace(view, surface=Ellipsoid(place.surface.pole, radius, radius))
    sun = sun_from(place, knowledge)
    if sun is not None:
        views = [
            replace(view, rotation=np.asarray(turn(angle * candidate.direction) @ stand.rotation))
            for angle in np.linspace(0.0, 2.0 * np.pi, _TURNS, endpoint=False)
        ]
        looks = [agreement(each, sun, observation.samples) for each in views]
        wrong = [look.stray * look.dark_samples + look.missing * look.lit_samples for look in looks]
        view = views[int(np.argmin(wrong))]
        stand = replace(stand, rotation=view.rotation)
    return InitialGuess(place, view, stand, candidate.members)
