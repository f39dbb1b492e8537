"""The classical methods of star identification (Michalski 3.2), and `METHODS`, all methods by name.

- Angle matching (3.2.1; Gottlieb in Wertz 1978, 7.7): the triangles of the brightest observed stars are taken
  in order of brightness. Pairs of guide stars with the angles of two sides are joined at the star that they
  share; those with the right third angle are candidates.
- Triangles by area and polar moment (3.2.2, 3.2.3; Cole & Crassidis 2004, 2006): the area of an observed
  triangle, plus and minus its propagated standard deviation, is a range of the table's k-vector. Candidates
  are the triangles in this range whose polar moment and sides, in order of length, agree too. The sources
  pivot to a neighbouring triangle when several remain; here each of them is compared with the field.
- Pyramid (3.2.4; Mortari, Samaan, Bruccoleri & Junkins, Navigation 51, 2004): triangles are cycled so that no
  observed star stays in many consecutive triangles and a false star spoils few of them. A matched triangle
  becomes a pyramid if a fourth observed star has a guide star at the right angle from all three corners. Only
  pyramids are candidates; the fourth star makes chance matches rare.
- Rate matching (3.2.5): Michalski gives a title and one reference, Samaan, Mortari & Junkins, Recursive mode
  star identification algorithms (IEEE TAES 41, 2005). Two frames, or the ends of streaks, give each point its
  velocity across the sky. A star fixed in the sky moves as v' = -w x v with the body rate w that all stars
  share; satellites, hot pixels and planes do not and are excluded. A previous attitude, rotated by that rate,
  predicts the position of each star; without one, the pyramid identifies the remaining points.
- Geometric voting (3.2.6; Kolomenkin, Pollak, Shimshoni & Lindenbaum, IEEE TAES 44, 2008): every pair of
  observed stars votes. A guide star with a partner at the pair's angle gets one vote for being either of the
  two, however many partners it has; if each partner counted, crowded parts of the sky would outvote the true
  stars from 0.3 px of noise on. The assignments with the most votes then vote among themselves: those whose
  angles agree belong together, and the largest such family is the candidate.
- Grid (3.2.7; Padgett & Kreutz-Delgado, IEEE TAES 33, 1997): the pattern of each observed star is compared
  with those of all guide stars by counting the cells occupied in both. The neighbour that aligns a pattern
  may be false, or its guide star missing, so the next neighbours are tried too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import combinations, islice

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.reference.star_identification.search import (
    DEFAULT,
    Candidates,
    ClassicalSettings,
    Propose,
    View,
    search,
)
from knightcube.reference.star_tables import (
    BUFFER,
    KnownSky,
    MeasuredShape,
    TriangleShape,
    TriangleTable,
    angles,
    cells_of,
    measured_planar_shape,
    measured_spherical_shape,
    members,
    ordered,
    side_lengths,
    tangent_places,
)
from knightcube.vision.startracker import lost_in_space
from knightcube.vision.startracker.attitude_fit import MatchStatus, StarField, StarMatch
from knightcube.vision.startracker.index.sky_index import SkyIndex
from knightcube.vision.startracker.verification import nothing, verify


def propose_angles(view: View, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield the triangles that match, those of the brightest observed stars first."""
    triangles = sorted(combinations(range(view.stars), 3), key=lambda corners: corners[::-1])
    for corners in triangles[: settings.joins]:
        found = matching_triangles(view, sky, corners, settings.tolerance)
        yield Candidates(np.tile(corners, (len(found), 1)), found)


def matching_triangles(
    view: View, sky: KnownSky, corners: tuple[int, int, int], tolerance: float
) -> IntArray:
    """Return guide stars (k, 3) that may be the observed `corners`, angles and sense of turning alike.

    Pairs with the angle of the first side and of the second are joined where they share a star; the third
    angle is tested as its cosine.
    """
    pivot, second, third = corners
    one, other = np.array([pivot, pivot, second]), np.array([second, third, third])
    _, low, high = view.angles(one, other, tolerance)
    a, b, owner = sky.pairs.between(low[:2], high[:2])
    first = owner == 0
    a1, b1, a2, c2 = a[first], b[first], a[~first], b[~first]
    place, of = shared(a1, a2)
    triangles = np.stack([a1[of], b1[of], c2[place]], axis=-1)
    # A range that reaches zero or pi is clipped there: the cosine is not monotonic beyond.
    alike = within(sky, triangles[:, 1], triangles[:, 2], low[2], high[2])
    triangles = triangles[alike & (triangles[:, 1] != triangles[:, 2])]
    turns = _turning(sky.stars.direction[triangles]) == _turning(view.direction[[list(corners)]])
    return np.asarray(triangles[turns])


def shared(left: IntArray, right: IntArray) -> tuple[IntArray, IntArray]:
    """Return all places (k,) in `right` and (k,) in `left` that hold the same number."""
    order = np.argsort(right, kind="stable")
    ranked = right[order]
    place, of = members(np.searchsorted(ranked, left), np.searchsorted(ranked, left, side="right"))
    return order[place], of


def within(sky: KnownSky, one: IntArray, other: IntArray, low: FloatArray, high: FloatArray) -> BoolArray:
    """Return which pairs of guide stars (k,) have an angle within limits."""
    direction = sky.stars.direction
    cosine = np.einsum("kx,kx->k", direction[one], direction[other])
    least, most = np.cos(np.minimum(high, np.pi)), np.cos(np.maximum(low, 0.0))
    return np.asarray((cosine > least) & (cosine <= most))


def _turning(corners: FloatArray) -> BoolArray:
    """Return which triangles (k, 3, 3) turn left, seen from within the sphere."""
    a, b, c = np.moveaxis(corners, -2, 0)
    return np.asarray(np.einsum("kx,kx->k", a, np.cross(b, c)) > 0.0)


def propose_pyramids(view: View, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield the pyramids that match, triangle by triangle."""
    for corners in islice(cycled_triangles(view.stars), settings.joins):
        found = matching_triangles(view, sky, corners, settings.tolerance)
        if len(found):
            yield _pyramids(view, sky, corners, found, settings.tolerance)


def cycled_triangles(stars: int) -> Iterator[tuple[int, int, int]]:
    """Yield all triangles of `stars` stars in the source's order: by the steps between their numbers."""
    for step in range(1, stars - 1):
        for further in range(1, stars - step):
            for pivot in range(stars - step - further):
                yield pivot, pivot + step, pivot + step + further


def _pyramids(
    view: View, sky: KnownSky, corners: tuple[int, int, int], found: IntArray, tolerance: float
) -> Candidates:
    """Return the triangles `found` (k, 3) that a fourth star confirms, once for each that does."""
    rest = np.setdiff1d(np.arange(view.stars), corners)
    pivot = np.full(len(rest), corners[0])
    _, low, high = view.angles(pivot, rest, tolerance)
    near, fourth, owner = sky.pairs.between(low, high)
    wanted = np.zeros(len(sky.stars), dtype=bool)
    wanted[found[:, 0]] = True
    kept = wanted[near]
    near, fourth, owner = near[kept], fourth[kept], owner[kept]
    place, of = shared(found[:, 0], near)
    fourth, owner = fourth[place], owner[place]
    alike = np.ones(len(of), dtype=bool)
    for corner in (1, 2):
        _, low, high = view.angles(np.full(len(rest), corners[corner]), rest, tolerance)
        alike &= within(sky, found[of, corner], fourth, low[owner], high[owner])
    triangles, fourth, owner = found[of[alike]], fourth[alike], owner[alike]
    observed = np.column_stack([np.tile(corners, (len(owner), 1)), rest[owner]])
    # One pyramid of each triangle is enough: verification uses the other stars.
    _, once = np.unique(triangles, axis=0, return_index=True)
    return Candidates(observed[once], np.column_stack([triangles, fourth])[once])


_BATCH = 10


def propose_planar(view: View, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield the plane triangles that match, see `_propose_triangles`."""
    return _propose_triangles(view, sky, settings, sky.planar, measured_planar_shape)


def propose_spherical(view: View, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield the spherical triangles that match, see `_propose_triangles`."""
    return _propose_triangles(view, sky, settings, sky.spherical, measured_spherical_shape)


def _propose_triangles(
    view: View, sky: KnownSky, settings: ClassicalSettings, table: TriangleTable, measure: MeasuredShape
) -> Iterator[Candidates]:
    """Yield the matches of some triangles at a time, those of the brightest stars first."""
    chosen = sorted(combinations(range(view.stars), 3), key=lambda corners: corners[::-1])
    triangles = np.array(chosen[: settings.patterns], dtype=np.int64).reshape(-1, 3)
    for begin in range(0, len(triangles), _BATCH):
        batch = ordered(view.direction, triangles[begin : begin + _BATCH])
        found = measure(view.direction[batch], view.sigma[batch])
        yield _triangle_matches(view, sky, table, batch, found, settings.tolerance)


def _triangle_matches(
    view: View,
    sky: KnownSky,
    table: TriangleTable,
    triangles: IntArray,
    found: TriangleShape,
    tolerance: float,
) -> Candidates:
    """Return the triangles of the table that are like the observed ones (t, 3)."""
    # An area grows as the square of the scale, a polar moment as its fourth power.
    reach = tolerance * found.sigma_area + 2.0 * view.slack * found.area
    # float32 rounds the table's values.
    reach = reach + 1e-7 * found.area
    # The area of a flat triangle is too uncertain.
    usable = np.flatnonzero(reach < 0.2 * found.area)
    low, high = found.area[usable] - reach[usable], found.area[usable] + reach[usable]
    place, owner = members(*table.area.ranges(low, high))
    owner = usable[owner]
    reach = tolerance * found.sigma_moment + (4.0 * view.slack + 1e-7) * found.moment
    alike = np.abs(table.moment[place] - found.moment[owner]) <= reach[owner]
    place, owner = place[alike], owner[alike]
    star, observed = table.corner[place].astype(np.int64), triangles[owner]
    off = side_lengths(sky.stars.direction[star]) - side_lengths(view.direction[observed])
    allowed = tolerance * np.sqrt(2.0) * view.sigma.max() + view.slack * side_lengths(
        view.direction[observed]
    )
    volumes = [np.linalg.det(one) for one in (sky.stars.direction[star], view.direction[observed])]
    alike = np.all(np.abs(off) <= allowed, axis=-1) & (volumes[0] * volumes[1] > 0.0)
    return Candidates(observed[alike], star[alike])


_VOTERS = 16
_KEPT = 8
_PARTNERS = 3
_FAMILIES = 6


def propose_families(view: View, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield the family of each of the assignments with the most agreement, one pair of it a candidate."""
    voters = min(len(view.direction), _VOTERS)
    one, other = np.triu_indices(voters, 1)
    _, low, high = view.angles(one, other, settings.tolerance)
    ballot = _ballot(voters, one, other, low, high, sky)
    # Several for each observed star: the true one is not always first.
    star = np.argpartition(-ballot, _KEPT, axis=1)[:, :_KEPT].ravel()
    observed = np.repeat(np.arange(voters), _KEPT)
    agrees = _agreement(view, sky, observed, star, settings.tolerance)
    for leader in np.argsort(-agrees.sum(axis=1), kind="stable")[:_FAMILIES]:
        family = np.flatnonzero(agrees[leader])
        if not len(family):
            return
        apart = angles(view.direction[observed[family]], view.direction[observed[leader]])
        partners = family[np.argsort(-apart)[:_PARTNERS]]
        lead = np.full(len(partners), leader)
        yield Candidates(
            np.stack([observed[lead], observed[partners]], axis=-1),
            np.stack([star[lead], star[partners]], axis=-1),
        )


def _ballot(
    voters: int, one: IntArray, other: IntArray, low: FloatArray, high: FloatArray, sky: KnownSky
) -> FloatArray:
    """Return the votes (voters, stars) for each guide star to be each observed star."""
    first, _, owner = sky.pairs.between(low, high)
    in_favour = np.zeros((len(one), len(sky.stars)), dtype=np.float32)
    in_favour[owner, first] = 1.0
    member = np.zeros((voters, len(one)), dtype=np.float32)
    pairs = np.arange(len(one))
    member[one, pairs] = member[other, pairs] = 1.0
    return np.asarray(member @ in_favour)


def _agreement(view: View, sky: KnownSky, observed: IntArray, star: IntArray, tolerance: float) -> BoolArray:
    """Return which assignments (k, k) of observed to guide stars are compatible."""
    count = len(observed)
    one, other = (index.ravel() for index in np.indices((count, count)))
    _, low, high = view.angles(observed[one], observed[other], tolerance)
    direction = sky.stars.direction[star]
    true = angles(direction[one], direction[other])
    # Two observed stars nearer than their errors may have the same guide star for their best.
    different = (observed[one] != observed[other]) & (star[one] != star[other])
    alike = (true >= low) & (true < high) & different
    return np.asarray(alike.reshape(count, count))


_ALIGNMENTS = 3
_BEST = 4
_LEAST_CELLS = 3


def propose_grids(view: View, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield the guide stars whose patterns are most like each observed star's, the central first."""
    middle = np.argsort(-view.direction[:, 2], kind="stable")
    for centre in middle[: max(1, settings.patterns // _ALIGNMENTS)]:
        place = tangent_places(view.direction, np.full(len(view.direction), centre), view.direction)
        distance = np.hypot(*place.T)
        radius = np.tan(sky.grid.radius)
        near = np.flatnonzero((distance > 0.0) & (distance < radius))
        aligning = near[distance[near] > BUFFER * radius]
        for neighbour in aligning[np.argsort(distance[aligning])[:_ALIGNMENTS]]:
            others = near[near != neighbour]
            along = np.broadcast_to(place[neighbour], (len(others), 2))
            cells = np.unique(cells_of(place[others], along, sky.grid.radius))
            yield _grid_matches(sky, cells, int(centre), int(neighbour))


def _grid_matches(sky: KnownSky, cells: IntArray, centre: int, neighbour: int) -> Candidates:
    votes = sky.grid.votes(cells)
    best = np.argpartition(-votes, _BEST)[:_BEST]
    best = best[votes[best] >= _LEAST_CELLS]
    best = best[np.argsort(-votes[best], kind="stable")]
    star = np.stack([best, sky.grid.aligning[best].astype(np.int64)], axis=-1)
    return Candidates(np.tile([centre, neighbour], (len(best), 1)), star)


@dataclass(frozen=True, slots=True, eq=False)
class StarMotion:
    """How the points of a field move across it.

    Attributes:
        velocity: (n, 3) 1/s, each direction's change with time, camera frame.
        sigma: (n,) 1/s, its standard deviation along one axis.
    """

    velocity: FloatArray
    sigma: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PreviousAttitude:
    """A previous attitude.

    Attributes:
        attitude: (4,) ICRS to camera.
        sigma: rad, its standard deviation about each axis, drift since then included.
        elapsed: s since then.
    """

    attitude: FloatArray
    sigma: float
    elapsed: float

    @property
    def part_of_all_attitudes(self) -> float:
        """The volume of the turns up to four sigmas, of that of all turns."""
        angle = min(4.0 * self.sigma, np.pi)
        return float(angle - np.sin(angle)) / np.pi


@dataclass(frozen=True, slots=True, eq=False)
class SharedRate:
    """The body rate of most points.

    Attributes:
        rate: (3,) rad/s, camera axes.
        covariance: (3, 3).
        shares: (n,) which points move by it.
    """

    rate: FloatArray
    covariance: FloatArray
    shares: BoolArray


_CHI_SQUARE = 13.8
"""Of two degrees of freedom; one star in a thousand lies beyond."""
_SEEDS = 10


def identify_by_rate(
    field: StarField,
    sky: KnownSky,
    settings: ClassicalSettings = DEFAULT,
    motion: StarMotion | None = None,
    previous: PreviousAttitude | None = None,
) -> StarMatch:
    """Return which points of a field are which stars.

    Without `motion` all points are taken for stars, and a `previous` attitude is taken not to have turned.
    Raises FieldUnknown if the scale is too uncertain, ValueError if motion and field differ in length.
    """
    shared = None if motion is None else shared_rate(field.direction, motion)
    kept = np.arange(len(field)) if shared is None else np.flatnonzero(shared.shares)
    stars = field.subset(kept)
    if len(stars) < settings.verification.least_matches:
        return nothing(field, MatchStatus.TOO_FEW_STARS)
    answer = nothing(stars)
    if previous is not None:
        turn = np.zeros(3) if shared is None else shared.rate * previous.elapsed
        predicted = attitude_matrix(multiply(from_rotation_vector(turn), previous.attitude))
        answer = verify(
            stars, sky.index, predicted, 1.0, previous.part_of_all_attitudes, settings.verification
        )
    if answer.status is not MatchStatus.IDENTIFIED:
        answer = search(stars, sky, propose_pyramids, settings)
    star = np.full(len(field), -1)
    star[kept] = answer.star
    return StarMatch(
        answer.status, star, answer.fix, answer.scale, answer.scale_sigma, answer.log10_false_alarm
    )


def shared_rate(direction: FloatArray, motion: StarMotion) -> SharedRate:
    """Return the body rate that most of the points (n, 3) share, by least squares over those.

    Two points fix a rate; of the rates of pairs among the first ten, that which most points agree with.
    Raises ValueError when motion and directions differ in length.
    """
    if len(motion.velocity) != len(direction):
        raise ValueError(f"{len(direction)} directions and {len(motion.velocity)} velocities: give one each")
    shares = np.zeros(len(direction), dtype=bool)
    none = SharedRate(np.zeros(3), np.full((3, 3), np.inf), shares)
    for pair in combinations(range(min(len(direction), _SEEDS)), 2):
        chosen = np.array(pair)
        rate, covariance = _rate(direction[chosen], motion.velocity[chosen], motion.sigma[chosen])
        agrees = _agrees(direction, motion, rate, covariance)
        if agrees.sum() <= shares.sum():
            continue
        # Two close points give a poor rate that many points agree with: a fit to all must hold too.
        rate, _ = _rate(direction[agrees], motion.velocity[agrees], motion.sigma[agrees])
        agrees = _agrees(direction, motion, rate, np.zeros((3, 3)))
        if agrees.sum() > shares.sum():
            shares = agrees
    for _ in range(3):
        if shares.sum() < 2:
            return none
        rate, covariance = _rate(direction[shares], motion.velocity[shares], motion.sigma[shares])
        shares = _agrees(direction, motion, rate, np.zeros((3, 3)))
    return SharedRate(rate, covariance, shares)


def _rate(direction: FloatArray, velocity: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rate (3,) of least squares and its covariance: v' = v x w, across v."""
    weight = 1.0 / sigma**2
    normal = np.sum(weight) * np.eye(3) - np.einsum("n,nx,ny->xy", weight, direction, direction)
    covariance = np.linalg.pinv(normal)
    return covariance @ (weight @ np.cross(velocity, direction)), covariance


def _agrees(direction: FloatArray, motion: StarMotion, rate: FloatArray, covariance: FloatArray) -> BoolArray:
    """Return which points (n,) move by `rate`, both errors considered."""
    residual = motion.velocity - np.cross(direction, rate)
    residual -= np.sum(residual * direction, axis=-1, keepdims=True) * direction
    # The largest variance that the rate's error gives to any direction across the line of sight.
    spread = motion.sigma**2 + float(np.linalg.eigvalsh(covariance)[-1]) * (1.0 - direction[:, 2] ** 2)
    spread = spread + float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    return np.asarray(np.sum(residual**2, axis=-1) <= _CHI_SQUARE * spread)


DEFAULT_METHOD = "default"


@dataclass(frozen=True, slots=True)
class Method:
    """A method of identification.

    Attributes:
        identify: of a field, by tables of the sky. All but the default raise FieldUnknown for a scale that is
            too uncertain.
        source: publication.
    """

    identify: Callable[[StarField, KnownSky], StarMatch]
    source: str


def _default(field: StarField, sky: KnownSky) -> StarMatch:
    return lost_in_space.identify(field, sky.index)


def method_of(name: str) -> Callable[[StarField, SkyIndex], StarMatch]:
    """Return the method `name` of METHODS for `SolveSettings`; it builds its tables for each field."""
    method = METHODS[name]

    def identify(field: StarField, index: SkyIndex) -> StarMatch:
        return method.identify(field, KnownSky(index, field.half_width))

    return identify


def _classical(propose: Propose, source: str) -> Method:
    return Method(partial(search, propose=propose), source)


METHODS: dict[str, Method] = {
    DEFAULT_METHOD: Method(_default, "triangles by shape, turning and size, all at once; votes"),
    "angle": _classical(propose_angles, "Gottlieb 1978"),
    "spherical-triangle": _classical(propose_spherical, "Cole & Crassidis 2004"),
    "planar-triangle": _classical(propose_planar, "Cole & Crassidis 2006"),
    "pyramid": _classical(propose_pyramids, "Mortari et al. 2004"),
    "rate": Method(identify_by_rate, "Samaan, Mortari & Junkins 2005"),
    "voting": _classical(propose_families, "Kolomenkin et al. 2008"),
    "grid": _classical(propose_grids, "Padgett & Kreutz-Delgado 1997"),
}
