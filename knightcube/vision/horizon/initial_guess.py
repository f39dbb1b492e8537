"""The first guess of one horizon: a cone on which many edges agree, and the orientation about nadir.

All rays u of a sphere's limb make the same angle rho with nadir n: u.g = 1 with g = n / cos rho, linear in g
(Christian & Robinson 2016, for a sphere). If rho is known, two rays leave two directions for n; if rho is
unknown, three rays leave one. Every pair of edges (every triple, if the altitude is unknown), thinned evenly
if there are too many, gives a cone. An edge agrees with a cone if it lies near it and grows brighter towards
nadir. The edges of the best cone are removed and the search continues, so that the terminator, a coast or a
band of cloud becomes a candidate of its own. This is sample consensus (Fischler & Bolles 1981) without random
choice.

A horizon does not determine the rotation about nadir, but the flattening depends on the direction of the
pole and the light on that of the Sun. A rough attitude, the coarse Sun and the magnetic field give that
rotation. Each known direction also has a known angle from nadir: a nadir that contradicts it is wrong.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.astro.directions import tangent_basis
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.horizon.edges import EdgeRays, Observation
from knightcube.vision.horizon.illumination import agreement
from knightcube.vision.horizon.limb import (
    MEAN_RADIUS,
    UNIT_DEPTH_HEIGHT,
    UNKNOWN,
    Ellipsoid,
    LimbView,
    crossed,
    earth,
    mean_sphere,
    turn,
)
from knightcube.vision.horizon.settings import HorizonKnowledge, HorizonSettings

_PARALLEL = 1e-12


def nadirs_of_pairs(first: FloatArray, second: FloatArray, cosine: float) -> FloatArray:
    """Return both directions (2, n, 3) that make the angle of `cosine` with two rays (n, 3) each.

    NaN where the rays are too far apart for it, or one and the same.
    """
    dot = np.einsum("ij,ij->i", first, second)
    normal = crossed(first, second)
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
    """Return the directions (n, 3) and cosines (n,) of the cones through three rays (n, 3) each.

    NaN where three rays lie in one plane with the camera.
    """
    normal = crossed(second - first, third - first)
    size = np.linalg.norm(normal, axis=1)
    directions = normal / np.where(size > _PARALLEL, size, np.nan)[:, None]
    cosines = np.einsum("ij,ij->i", directions, first)
    # Of a direction and its opposite the nadir is within 90 deg of its limb.
    sign = np.where(cosines < 0.0, -1.0, 1.0)
    return directions * sign[:, None], cosines * sign


@dataclass(frozen=True, slots=True, eq=False)
class ConeCandidate:
    """A circular cone and the edges (n,) that agree with it."""

    direction: FloatArray
    cosine: float
    members: BoolArray


def best_cone(
    edges: EdgeRays,
    free: BoolArray,
    cosines: tuple[float, float] | None,
    tolerance: float,
    tries: int,
) -> ConeCandidate | None:
    """Return the cone through `free` edges (n,) with which most of these agree, or None.

    `cosines` is the half-angle's cosine (where known, a range of no width) or its least and greatest;
    `tolerance` is in pixels, `tries` the number of pairs or triples tried.
    """
    chosen = np.flatnonzero(free)
    directions, half_angles = _cones(edges, chosen, cosines, tries)
    if not len(directions):
        return None
    counts = np.count_nonzero(_agreeing(edges.chosen(chosen), directions, half_angles, tolerance), axis=1)
    best = slice(place := int(np.argmax(counts)), place + 1)
    members = _agreeing(edges, directions[best], half_angles[best], tolerance)[0]
    return ConeCandidate(directions[place], float(half_angles[place]), members)


def left_free(edges: EdgeRays, free: BoolArray, cone: ConeCandidate, tolerance: float) -> BoolArray:
    """Return which of the `free` edges (n,) lie on no cone yet, `cone` being the last; see `best_cone`."""
    near = _agreeing(edges, cone.direction[None], np.array([cone.cosine]), 2.0 * tolerance)[0]
    return np.asarray(free & ~near & ~cone.members)


def _cones(
    edges: EdgeRays, free: IntArray, cosines: tuple[float, float] | None, tries: int
) -> tuple[FloatArray, FloatArray]:
    if cosines is not None and cosines[0] == cosines[1]:
        first, second = _pairs(len(free), tries)
        one, other = free[first], free[second]
        directions = nadirs_of_pairs(edges.rays[one], edges.rays[other], cosines[0])
        # A pair that does not agree with its own cone need not be compared with others.
        sides = edges.brighter[one], edges.brighter[other]
        agrees = [np.einsum("kij,ij->ki", directions, side) > 0.0 for side in sides]
        directions = directions[agrees[0] & agrees[1]]
        half_angles = np.full(len(directions), cosines[0])
    else:
        directions, half_angles = nadirs_of_triples(
            *(edges.rays[free[i]] for i in _triples(len(free), tries))
        )
        if cosines is not None:
            outside = (half_angles < cosines[0]) | (half_angles > cosines[1])
            directions[outside] = np.nan
    sound = np.isfinite(directions[:, 0])
    return directions[sound], half_angles[sound]


@lru_cache(maxsize=64)
def _pairs(count: int, tries: int) -> tuple[IntArray, IntArray]:
    """Return two lists of indices below `count`: all pairs, or `tries` of them evenly chosen."""
    first, second = np.triu_indices(count, 1)
    if len(first) > tries:
        chosen = np.linspace(0, len(first) - 1, tries).astype(int)
        first, second = first[chosen], second[chosen]
    return first, second


def _triples(count: int, tries: int) -> tuple[IntArray, IntArray, IntArray]:
    """Return three lists of indices below `count`: strides of all sizes, from every place."""
    number = np.arange(tries)
    first = number % count
    # Two strides that wander through all pairs: multiples of the golden section and of the root of two.
    one = 1 + ((number * 0.6180339887) % 1.0 * (count - 1)).astype(int)
    two = 1 + ((number * 0.4142135624) % 1.0 * (count - 1)).astype(int)
    sound = one != two
    return first[sound], (first + one)[sound] % count, (first + two)[sound] % count


def _agreeing(edges: EdgeRays, directions: FloatArray, cosines: FloatArray, tolerance: float) -> BoolArray:
    """Return (k, n) which edges lie within `tolerance` px of cones (k, 3), (k,), their bright side inside."""
    sines = np.sqrt(np.maximum(1.0 - cosines**2, 1e-6))
    # cos(angle) - cos(rho) is sin(rho) times the distance, near the cone.
    off = directions @ edges.rays.T
    off -= cosines[:, None]
    near = np.abs(off, out=off) <= sines[:, None] * (tolerance * edges.pixel)
    near &= directions @ edges.brighter.T > 0.0
    return near


MOST_MISMATCH = 4.0
"""Largest disagreement with a coarse sensor, in standard deviations."""
GUESS_SIGMA = math.radians(0.2)
"""Error (rad) of a nadir by the cone through the edges, before the fit of a limb: 0.07 to 0.3 deg in frames
of flights."""


@dataclass(frozen=True, slots=True, eq=False)
class Orientation:
    """A camera's orientation about an assumed nadir.

    Attributes:
        rotation: (3, 3), inertial into camera axes; nadir exactly as assumed.
        sigma: rad, of the turn about nadir; infinite if unknown.
        mismatch: the worst disagreement of a known direction with this nadir, in standard deviations of the
            direction and of a guessed nadir.
        share: of all nadirs, those that the known directions leave.
    """

    rotation: FloatArray
    sigma: float
    mismatch: float
    share: float = 1.0


def orientation(nadir: FloatArray, inertial_nadir: FloatArray, knowledge: HorizonKnowledge) -> Orientation:
    """Return the orientation about `nadir` (3,), camera axes, which is `inertial_nadir` (3,)."""
    base = shortest_turn(inertial_nadir, nadir)
    down = _unit(nadir)
    vote, weight, mismatch = 0.0 + 0.0j, 0.0, 0.0
    known = _known(knowledge, inertial_nadir)
    # Each leaves a ring of the sphere; two rings cross, a third adds little.
    narrowest = sorted(math.hypot(sigma, GUESS_SIGMA) for _, _, sigma in known)[:2]
    share = math.prod(min(1.0, MOST_MISMATCH * sigma) for sigma in narrowest)
    for camera, inertial, sigma in known:
        seen, expected = _unit(camera), _unit(base @ inertial)
        below, assumed = _dot(down, seen), _dot(down, expected)
        across = _length(_cross(down, expected))
        apart = math.atan2(_length(_cross(down, seen)), below) - math.atan2(across, assumed)
        mismatch = max(mismatch, abs(apart) / math.hypot(sigma, GUESS_SIGMA))
        if across > 0.05:
            angle = math.atan2(_dot(down, _cross(expected, seen)), _dot(seen, expected) - below * assumed)
            precision = (across / sigma) ** 2
            vote += precision * cmath.exp(1j * angle)
            weight += precision
    if weight == 0.0:
        return Orientation(base, math.inf, mismatch, share)
    return Orientation(turn(cmath.phase(vote) * nadir) @ base, weight**-0.5, mismatch, share)


def turned(rotation: FloatArray, nadir: FloatArray, angle: float) -> FloatArray:
    """Return a camera's rotation (3, 3) after a turn by `angle` rad about `nadir` (3,), camera axes."""
    return np.asarray(turn(angle * nadir) @ rotation)


def _known(
    knowledge: HorizonKnowledge, inertial_nadir: FloatArray
) -> list[tuple[FloatArray, FloatArray, float]]:
    """Return pairs of directions, camera and inertial, with their spreads: an attitude is two of them."""
    pairs = [(each.camera, each.inertial, each.sigma) for each in knowledge.sensed]
    if knowledge.attitude is not None:
        matrix, sigma = attitude_matrix(knowledge.attitude.quaternion), knowledge.attitude.sigma
        # Nadir itself tests the tilt, a direction normal to it gives the turn.
        for axis in (inertial_nadir, tangent_basis(inertial_nadir)[0]):
            pairs.append((matrix @ axis, axis, sigma))
    return pairs


# Plain floats: for one vector numpy costs ten times as much.
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
    """Return the matrix (3, 3) that takes a unit vector to another; opposite ones, by any half turn."""
    middle = source + target
    square = float(middle @ middle)
    if square < 1e-12:
        return _half_turn(tangent_basis(source)[0], 1.0)
    # A half turn about the source leaves it, a half turn about the middle takes it to the target.
    return np.asarray(_half_turn(middle, square) @ _half_turn(source, 1.0))


def _half_turn(axis: FloatArray, square: float) -> FloatArray:
    return np.asarray(2.0 / square * np.outer(axis, axis) - np.eye(3))


SPHERE_ALTITUDE_SIGMA = 10e3
"""Error (m) of an altitude above the mean sphere, caused by the flattening of the Earth."""
_TURNS = 24


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """The camera's position, as far as known.

    Attributes:
        position: (3,) m, inertial axes where the real one is known.
        surface: ellipsoid or sphere.
        altitude_sigma: m, infinite where the altitude is unknown.
        located: whether the position is the real one.
    """

    position: FloatArray
    surface: Ellipsoid
    altitude_sigma: float
    located: bool

    @property
    def cosine(self) -> float:
        """The cosine of the half-angle of the limb's cone, taken for circular with the radius below."""
        distance = float(np.linalg.norm(self.position))
        radius = distance - self.surface.height_of(self.position) + UNIT_DEPTH_HEIGHT
        return float(np.sqrt(1.0 - min(1.0, radius / distance) ** 2))


@dataclass(frozen=True, slots=True, eq=False)
class InitialGuess:
    """The start of a horizon's fit.

    Attributes:
        place: assumed place of the camera.
        view: start of the fit.
        orientation: of the camera about nadir.
        members: (n,) the picture's edges that may lie on it.
    """

    place: Place
    view: LimbView
    orientation: Orientation
    members: BoolArray


def cosine_at(altitude: float) -> float:
    """Return the cosine of the half-angle of the limb's cone from `altitude` m above the mean sphere."""
    return _above_sphere(altitude, 0.0).cosine


def place_of(knowledge: HorizonKnowledge, settings: HorizonSettings) -> Place | None:
    """Return the known place of the camera; None if its altitude is unknown."""
    if knowledge.position is not None:
        position = np.asarray(knowledge.position, dtype=float)
        return Place(position, earth(knowledge.pole), settings.altitude_sigma, True)
    if knowledge.altitude is not None:
        return _above_sphere(knowledge.altitude, SPHERE_ALTITUDE_SIGMA)
    return None


def _above_sphere(altitude: float, sigma: float) -> Place:
    return Place(np.array([0.0, 0.0, MEAN_RADIUS + altitude]), mean_sphere(), sigma, False)


def initial_guess(
    candidate: ConeCandidate,
    observation: Observation,
    place: Place | None,
    knowledge: HorizonKnowledge,
    settings: HorizonSettings,
) -> InitialGuess:
    """Return the guess that a cone gives; `place` is None if the altitude is unknown."""
    if place is None:
        sine = float(np.sqrt(max(1.0 - candidate.cosine**2, 1e-6)))
        place = _above_sphere((MEAN_RADIUS + UNIT_DEPTH_HEIGHT) / sine - MEAN_RADIUS, UNKNOWN)
    view, stand = _first_view(candidate, observation, place, knowledge)
    return InitialGuess(place, view, stand, candidate.members)


def sun_from(place: Place, knowledge: HorizonKnowledge) -> FloatArray | None:
    """Return the unit vector (3,) to the Sun in the axes of the place; None if either is unknown."""
    if knowledge.sun is None or not place.located:
        return None
    return np.asarray(knowledge.sun / np.linalg.norm(knowledge.sun))


def _first_view(
    candidate: ConeCandidate,
    observation: Observation,
    place: Place,
    knowledge: HorizonKnowledge,
) -> tuple[LimbView, Orientation]:
    """Return the first view and its orientation; on a sphere if the turn about nadir is unknown."""
    down = -place.position / np.linalg.norm(place.position)
    nothing = HorizonKnowledge()
    stand = orientation(candidate.direction, down, knowledge if place.located else nothing)
    height = UNIT_DEPTH_HEIGHT
    view = LimbView(stand.rotation, place.position, place.surface, height)
    if np.isfinite(stand.sigma):
        return view, stand
    distance = float(np.linalg.norm(place.position))
    radius = distance - place.surface.height_of(place.position)
    view = replace(view, surface=Ellipsoid(place.surface.pole, radius, radius))
    sun = sun_from(place, knowledge)
    if sun is None:
        return view, stand
    turns = [
        replace(view, rotation=turned(stand.rotation, candidate.direction, angle))
        for angle in np.linspace(0.0, 2.0 * np.pi, _TURNS, endpoint=False)
    ]
    looks = [agreement(each, sun, observation.samples) for each in turns]
    best = int(
        np.argmin([look.stray * look.dark_samples + look.missing * look.lit_samples for look in looks])
    )
    return turns[best], replace(stand, rotation=turns[best].rotation)
