"""Classical methods of star identification (Michalski, section 3.2), for comparison with the default method.

Each method (`METHODS`) proposes candidates, which assign guide stars to some observed stars and thereby
define an attitude. For each candidate attitude, the bright observed stars that are close to guide stars are
counted. The candidates with the highest counts are verified with all observed stars by
`knightcube.vision.startracker.verification`, which rejects false candidates. If the image scale is uncertain,
the identification is tried at several scales (`ScaledField`). The function `match_images` determines the
attitude of identified stars by image matching.

- Angle matching: The triangles of the brightest observed stars are processed in order of brightness
  (Michalski, section 3.2.1, and Gottlieb in Wertz 1978, section 7.7). Two pairs of guide stars whose angles
  match two sides of a triangle are joined if the pairs share a star. Two joined pairs are a candidate if the
  angle of the third side matches as well.

- Triangles by area and polar moment: The area of an observed triangle and its propagated standard deviation
  define a range of areas in the table of guide star triangles (Michalski, sections 3.2.2 and 3.2.3, and Cole
  & Crassidis 2004 and 2006). Triangles in this range are candidates if their polar moments and side lengths
  also match. If several triangles match, the published methods pivot to a neighbouring triangle, while this
  implementation tests all matching triangles.

- Pyramid: The triangles are ordered so that no observed star occurs in many consecutive triangles, which
  limits the effect of a false star (Michalski, section 3.2.4, and Mortari, Samaan, Bruccoleri & Junkins,
  Navigation 51, 2004). Only triangles that a fourth observed star confirms are candidates, because a matching
  fourth star makes chance matches rare.

- Rate matching: Two frames, or the ends of streaks, give the velocity of each observed point (Michalski,
  section 3.2.5, and Samaan, Mortari & Junkins, Recursive mode star identification algorithms, IEEE TAES 41,
  2005). A fixed star moves as v' = -w x v, with a body rate w that is common to all stars. Satellites,
  aircraft and hot pixels do not move with this rate. The position of each star is predicted from a previous
  attitude, which is propagated by the body rate. Without a previous attitude, the pyramid method identifies
  the remaining points.

- Geometric voting: For each pair of observed stars, each guide star that forms the same angle with another
  guide star gets one vote for each of the two observed stars (Michalski, section 3.2.6, and Kolomenkin,
  Pollak, Shimshoni & Lindenbaum, IEEE TAES 44, 2008). The number of matching partners is ignored, because
  guide stars in dense regions of the sky would otherwise get the most votes at noise above 0.3 px. In a
  second vote, two assignments with many votes vote for each other if the angle between their guide stars
  agrees with the angle between their observed stars. The largest group of consistent assignments is the
  candidate.

- Grid: The grid pattern of each observed star is compared with the patterns of all guide stars by counting
  the cells that both patterns occupy (Michalski, section 3.2.7, and Padgett & Kreutz-Delgado, IEEE TAES 33,
  1997). Several neighbouring stars are tried as the star that defines the orientation, because a neighbouring
  star may be false or missing in the catalogue.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations, islice

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.astro.attitude.wahba import (
    AttitudeError,
    AttitudeFix,
    attitude_of_pair,
    best_pair,
    sightings,
    upright,
)
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.errors import KnightCubeError
from knightcube.reference.star_tables import (
    BUFFER,
    KnownSky,
    MeasuredShape,
    TriangleShape,
    TriangleTable,
    angles,
    cells_of,
    cosine_sigma,
    measured_planar_shape,
    measured_spherical_shape,
    members,
    ordered,
    side_lengths,
    tangent_positions,
)
from knightcube.vision.startracker import lost_in_space
from knightcube.vision.startracker.attitude_fit import MatchStatus, StarField, StarMatch, stretched
from knightcube.vision.startracker.index import SkyIndex
from knightcube.vision.startracker.verification import VerificationSettings, nothing, verify


@dataclass(frozen=True, slots=True)
class ClassicalSettings:
    """Settings of the classical methods. Each method uses some of these settings.

    Attributes:
        brightest: number of brightest observed stars from which patterns are formed.
        tolerance: tolerance of angles, areas and moments, in standard deviations.
        patterns: maximum number of triangles or grid patterns that are looked up in a table.
        joins: maximum number of triangles formed from pairs, for all image scales together; a triangle takes
            0.5 ms.
        candidates: maximum number of candidates per image scale that are compared with the observed stars.
        screened: number of brightest observed stars with which a candidate is first compared.
        verified: maximum number of candidates of a pattern that are verified with all observed stars.
        scale_step: relative half width of the interval of image scales that one search covers.
        scales: maximum number of image scales to search; a field that needs more scales is rejected.
        cosine_limits: whether the limits of an angle are computed from its cosine and the variance of the
            cosine (Michalski, eq. 31) instead of the angle itself.
        verification: conditions for the acceptance of a candidate.
    """

    brightest: int = 11
    tolerance: float = 3.0
    patterns: int = 80
    joins: int = 24
    candidates: int = 2500
    screened: int = 14
    verified: int = 4
    scale_step: float = 0.002
    scales: int = 9
    cosine_limits: bool = False
    verification: VerificationSettings = field(default_factory=VerificationSettings)


DEFAULT = ClassicalSettings()


class FieldUnknown(KnightCubeError):
    """Raised if the image scale is too uncertain for the classical methods.

    The default method can identify a field of uncertain image scale.
    """


@dataclass(frozen=True, slots=True, eq=False)
class ScaledField:
    """Star field at one assumed image scale.

    Attributes:
        field: original star field.
        scale: factor by which the tangents of the field angles are multiplied.
        direction: (n, 3) unit vectors to the observed stars at this scale.
        sigma: (n,) standard deviations of the directions, rad.
        slack: relative error of angles due to the uncertainty of the scale.
        stars: number of brightest observed stars from which patterns are formed.
        cosine_limits: whether the limits of angles are computed from their cosines.
    """

    field: StarField
    scale: float
    direction: FloatArray
    sigma: FloatArray
    slack: float
    stars: int
    cosine_limits: bool = False

    def angles(
        self, one: IntArray, other: IntArray, tolerance: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the angles (k,) between observed stars, with lower and upper limits (k,) of the true angles.

        The limits allow for the error of the scale, and for `tolerance` standard deviations of the angle, or
        of its cosine (Michalski, eq. 31) if `cosine_limits` is set. The observed stars have the indices `one`
        and `other` (k,).
        """
        angle = angles(self.direction[one], self.direction[other])
        if self.cosine_limits:
            cosine = np.cos(angle)
            reach = tolerance * cosine_sigma(cosine, self.sigma[one], self.sigma[other])
            low, high = (np.arccos(np.clip(cosine + off, -1.0, 1.0)) for off in (reach, -reach))
            return angle, low - self.slack * angle, high + self.slack * angle
        off = tolerance * np.hypot(self.sigma[one], self.sigma[other]) + self.slack * angle
        return angle, angle - off, angle + off


def views(field: StarField, settings: ClassicalSettings) -> Iterator[ScaledField]:
    """Yield the field at image scales within the uncertainty of the scale, beginning with the most likely.

    Raises FieldUnknown if more scales are needed than the settings allow.
    """
    low, high = (math.log(edge) for edge in field.scale)
    steps = max(1, math.ceil((high - low) / (2.0 * settings.scale_step) - 1e-9))
    if steps > settings.scales:
        known = 100.0 * settings.scales * settings.scale_step
        raise FieldUnknown(
            f"scale known to {50.0 * (high - low):.1f} %: the classical methods need {known:.1f} %; "
            "the default method accepts any scale"
        )
    edges = np.linspace(low, high, steps + 1)
    middles = 0.5 * (edges[1:] + edges[:-1])
    for middle in middles[np.argsort(np.abs(middles - 0.5 * (low + high)), kind="stable")]:
        scale = math.exp(middle)
        yield ScaledField(
            field,
            scale,
            stretched(field.direction, scale),
            field.sigma * scale,
            0.5 * (high - low) / steps,
            min(settings.brightest, len(field)),
            settings.cosine_limits,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Candidates of an identification: indices of observed stars, and of the guide stars assigned to them.

    Both arrays are (k, m) for k candidates of at least two stars, of which the first two define the attitude.
    """

    observed: IntArray
    star: IntArray

    def __len__(self) -> int:
        return len(self.observed)


_LEAST_BASE = 10.0
"""Minimum angle between the first two stars of a candidate, in standard deviations of a direction."""
_LEAST_JOINS = 4
Propose = Callable[[ScaledField, KnownSky, ClassicalSettings], Iterator[Candidates]]


def search(
    field: StarField, sky: KnownSky, propose: Propose, settings: ClassicalSettings = DEFAULT
) -> StarMatch:
    """Return the first candidate of a method that passes the verification with all observed stars.

    The function `propose` yields the candidates. Raises FieldUnknown if the image scale is too uncertain.
    """
    if len(field) < settings.verification.least_matches:
        return nothing(field, MatchStatus.TOO_FEW_STARS)
    steps = list(views(field, settings))
    settings = replace(settings, joins=max(_LEAST_JOINS, settings.joins // len(steps)))
    for view in steps:
        spent = 0
        for candidates in propose(view, sky, settings):
            taken = min(len(candidates), settings.candidates - spent)
            spent += taken
            answer = _best(view, sky, candidates, taken, settings)
            if answer is not None:
                return answer
            if spent >= settings.candidates:
                break
    return nothing(field)


def _best(
    view: ScaledField, sky: KnownSky, candidates: Candidates, taken: int, settings: ClassicalSettings
) -> StarMatch | None:
    """Return the first of `taken` candidates, in order of matching stars, that passes the verification."""
    if not taken:
        return None
    observed, star = candidates.observed[:taken], candidates.star[:taken]
    # Two very close observed stars, or the same guide star twice, do not define an attitude.
    base = view.direction[observed[:, 0]] - view.direction[observed[:, 1]]
    apart = np.linalg.norm(base, axis=-1) > _LEAST_BASE * view.sigma.max()
    apart &= star[:, 0] != star[:, 1]
    if not apart.any():
        return None
    observed, star = observed[apart], star[apart]
    matrices = attitudes(view.direction[observed[:, :2]], sky.stars.direction[star[:, :2]])
    support = _support(view, sky, matrices, observed, settings)
    least = min(settings.verification.least_matches, len(view.direction))
    for number in np.argsort(-support, kind="stable")[: settings.verified]:
        if support[number] < least:
            return None
        answer = verify(view.field, sky.index, matrices[number], view.scale, settings=settings.verification)
        if answer.status is MatchStatus.IDENTIFIED:
            return answer
    return None


def attitudes(observed: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the attitude matrices (k, 3, 3) that rotate pairs of reference directions onto observed pairs.

    The arguments `observed` and `reference` (k, 2, 3) contain the unit vectors of k pairs.
    """
    return np.swapaxes(_frames(observed), -1, -2) @ _frames(reference)


def _frames(pairs: FloatArray) -> FloatArray:
    middle = pairs[:, 0] + pairs[:, 1]
    along = pairs[:, 0] - pairs[:, 1]
    middle = middle / np.linalg.norm(middle, axis=-1, keepdims=True)
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    return np.stack([middle, along, np.cross(middle, along)], axis=1)


def _support(
    view: ScaledField, sky: KnownSky, matrices: FloatArray, observed: IntArray, settings: ClassicalSettings
) -> IntArray:
    """Return, for each attitude (k, 3, 3), the number of bright observed stars close to a guide star."""
    seen = view.direction[: settings.screened]
    pair = view.direction[observed[:, :2]]
    base = np.linalg.norm(pair[:, 0] - pair[:, 1], axis=-1)
    middle = 0.5 * (pair[:, 0] + pair[:, 1])
    lever = np.linalg.norm(seen[None] - middle[:, None], axis=-1)
    sigma = float(view.sigma.max())
    # If two stars define the attitude, the position error of another star grows with its distance from their
    # midpoint.
    gate = settings.tolerance * sigma * np.sqrt(1.5 + 2.0 * (lever / base[:, None]) ** 2)
    gate = np.minimum(gate + view.slack * lever, 0.25 * math.atan(min(sky.half_width)))
    distance, _ = sky.tree.query(seen @ matrices, distance_upper_bound=float(gate.max()))
    return np.asarray((distance <= gate).sum(axis=1))


def propose_angles(view: ScaledField, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield candidates by angle matching, in order of the brightness of the observed stars."""
    triangles = sorted(combinations(range(view.stars), 3), key=lambda corners: corners[::-1])
    for corners in triangles[: settings.joins]:
        found = matching_triangles(view, sky, corners, settings.tolerance)
        yield Candidates(np.tile(corners, (len(found), 1)), found)


def matching_triangles(
    view: ScaledField, sky: KnownSky, corners: tuple[int, int, int], tolerance: float
) -> IntArray:
    """Return guide star triangles (k, 3) that match an observed triangle in angles and orientation.

    Pairs of guide stars that match the first and the second side are joined at their common star. The third
    side of each joined triangle is then compared by the cosine of its angle.
    """
    pivot, second, third = corners
    one, other = np.array([pivot, pivot, second]), np.array([second, third, third])
    _, low, high = view.angles(one, other, tolerance)
    a, b, owner = sky.pairs.between(low[:2], high[:2])
    first = owner == 0
    a1, b1, a2, c2 = a[first], b[first], a[~first], b[~first]
    place, of = shared(a1, a2)
    triangles = np.stack([a1[of], b1[of], c2[place]], axis=-1)
    # Angle limits are clipped to the range from 0 to pi, in which the cosine is monotonic.
    alike = within(sky, triangles[:, 1], triangles[:, 2], low[2], high[2])
    triangles = triangles[alike & (triangles[:, 1] != triangles[:, 2])]
    same_orientation = _turns_left(sky.stars.direction[triangles]) == _turns_left(
        view.direction[[list(corners)]]
    )
    return np.asarray(triangles[same_orientation])


def shared(left: IntArray, right: IntArray) -> tuple[IntArray, IntArray]:
    """Return the indices (k,) in `right` and the indices (k,) in `left` of all pairs of equal values."""
    order = np.argsort(right, kind="stable")
    ranked = right[order]
    place, of = members(np.searchsorted(ranked, left), np.searchsorted(ranked, left, side="right"))
    return order[place], of


def within(sky: KnownSky, one: IntArray, other: IntArray, low: FloatArray, high: FloatArray) -> BoolArray:
    """Return, for each pair of guide stars (k,), whether its angle lies between `low` and `high`, rad."""
    direction = sky.stars.direction
    cosine = np.einsum("kx,kx->k", direction[one], direction[other])
    minimum, maximum = np.cos(np.minimum(high, np.pi)), np.cos(np.maximum(low, 0.0))
    return np.asarray((cosine > minimum) & (cosine <= maximum))


def _turns_left(corners: FloatArray) -> BoolArray:
    """Return, for each triangle (k, 3, 3), whether its corners a, b, c are right-handed: a . (b x c) > 0."""
    a, b, c = np.moveaxis(corners, -2, 0)
    return np.asarray(np.einsum("kx,kx->k", a, np.cross(b, c)) > 0.0)


def propose_pyramids(view: ScaledField, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield candidates by the pyramid method, in batches for each observed triangle."""
    for corners in islice(cycled_triangles(view.stars), settings.joins):
        found = matching_triangles(view, sky, corners, settings.tolerance)
        if len(found):
            yield _pyramids(view, sky, corners, found, settings.tolerance)


def cycled_triangles(stars: int) -> Iterator[tuple[int, int, int]]:
    """Yield the triangles of `stars` stars in the order of the pyramid method (Mortari et al. 2004).

    The triangles are ordered by the differences between the indices of the three stars.
    """
    for step in range(1, stars - 1):
        for further in range(1, stars - step):
            for pivot in range(stars - step - further):
                yield pivot, pivot + step, pivot + step + further


def _pyramids(
    view: ScaledField, sky: KnownSky, corners: tuple[int, int, int], found: IntArray, tolerance: float
) -> Candidates:
    """Return the matching triangles of `found` (k, 3) that a fourth star confirms, extended by this star."""
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
    # A single fourth star per triangle is enough, because the verification uses all other stars.
    _, once = np.unique(triangles, axis=0, return_index=True)
    return Candidates(observed[once], np.column_stack([triangles, fourth])[once])


_BATCH = 10


def propose_planar(view: ScaledField, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield candidates by matching of planar triangles."""
    return _propose_triangles(view, sky, settings, sky.planar, measured_planar_shape)


def propose_spherical(view: ScaledField, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield candidates by matching of spherical triangles."""
    return _propose_triangles(view, sky, settings, sky.spherical, measured_spherical_shape)


def _propose_triangles(
    view: ScaledField,
    sky: KnownSky,
    settings: ClassicalSettings,
    table: TriangleTable,
    measure: MeasuredShape,
) -> Iterator[Candidates]:
    """Yield matching triangles in batches, beginning with the triangles of the brightest observed stars."""
    chosen = sorted(combinations(range(view.stars), 3), key=lambda corners: corners[::-1])
    triangles = np.array(chosen[: settings.patterns], dtype=np.int64).reshape(-1, 3)
    for begin in range(0, len(triangles), _BATCH):
        batch = ordered(view.direction, triangles[begin : begin + _BATCH])
        found = measure(view.direction[batch], view.sigma[batch])
        yield _triangle_matches(view, sky, table, batch, found, settings.tolerance)


def _triangle_matches(
    view: ScaledField,
    sky: KnownSky,
    table: TriangleTable,
    triangles: IntArray,
    found: TriangleShape,
    tolerance: float,
) -> Candidates:
    """Return the triangles of guide stars in `table` that match observed `triangles` (t, 3)."""
    # The area of a triangle is proportional to scale^2, and the polar moment to scale^4.
    reach = tolerance * found.sigma_area + 2.0 * view.slack * found.area
    # The limits are widened by the rounding error of the float32 values in the table.
    reach = reach + 1e-7 * found.area
    # Flat triangles are excluded, because their areas are too uncertain.
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


def propose_families(view: ScaledField, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield candidates by geometric voting: pairs from the largest groups of consistent assignments."""
    voters = min(len(view.direction), _VOTERS)
    one, other = np.triu_indices(voters, 1)
    _, low, high = view.angles(one, other, settings.tolerance)
    ballot = _ballot(voters, one, other, low, high, sky)
    # Several guide stars are kept per observed star, because the true star may not have the most votes.
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
    """Return the votes (voters, stars) for each assignment of a guide star to an observed star."""
    first, _, owner = sky.pairs.between(low, high)
    in_favour = np.zeros((len(one), len(sky.stars)), dtype=np.float32)
    in_favour[owner, first] = 1.0
    member = np.zeros((voters, len(one)), dtype=np.float32)
    pairs = np.arange(len(one))
    member[one, pairs] = member[other, pairs] = 1.0
    return np.asarray(member @ in_favour)


def _agreement(
    view: ScaledField, sky: KnownSky, observed: IntArray, star: IntArray, tolerance: float
) -> BoolArray:
    """Return a matrix (k, k) of flags: whether two assignments of guide to observed stars are consistent."""
    count = len(observed)
    one, other = (index.ravel() for index in np.indices((count, count)))
    _, low, high = view.angles(observed[one], observed[other], tolerance)
    direction = sky.stars.direction[star]
    true = angles(direction[one], direction[other])
    # Two very close observed stars may be assigned to the same guide star.
    different = (observed[one] != observed[other]) & (star[one] != star[other])
    alike = (true >= low) & (true < high) & different
    return np.asarray(alike.reshape(count, count))


_ALIGNMENTS = 3
_BEST = 4
_LEAST_CELLS = 3


def propose_grids(view: ScaledField, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield candidates by grid patterns, beginning with observed stars near the image centre."""
    middle = np.argsort(-view.direction[:, 2], kind="stable")
    for centre in middle[: max(1, settings.patterns // _ALIGNMENTS)]:
        place = tangent_positions(view.direction, np.full(len(view.direction), centre), view.direction)
        distance = np.hypot(*place.T)
        radius = np.tan(sky.grid.radius)
        near = np.flatnonzero((distance > 0.0) & (distance < radius))
        aligning = near[distance[near] > BUFFER * radius]
        for neighbour in aligning[np.argsort(distance[aligning])[:_ALIGNMENTS]]:
            others = near[near != neighbour]
            along = np.broadcast_to(place[neighbour], (len(others), 2))
            cells = np.unique(cells_of(place[others], along, sky.grid.radius))
            votes = sky.grid.votes(cells)
            best = np.argpartition(-votes, _BEST)[:_BEST]
            best = best[votes[best] >= _LEAST_CELLS]
            best = best[np.argsort(-votes[best], kind="stable")]
            star = np.stack([best, sky.grid.aligning[best].astype(np.int64)], axis=-1)
            yield Candidates(np.tile([int(centre), int(neighbour)], (len(best), 1)), star)


@dataclass(frozen=True, slots=True, eq=False)
class StarMotion:
    """Time derivatives (n, 3) of the directions of observed points in the camera frame, 1/s.

    The standard deviations `sigma` (n,) of the velocities are per axis, 1/s.
    """

    velocity: FloatArray
    sigma: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PreviousAttitude:
    """Attitude quaternion (4,), from ICRS to the camera frame, `elapsed` s ago.

    The standard deviation `sigma` about each axis, rad, includes the drift during the elapsed time.
    """

    attitude: FloatArray
    sigma: float
    elapsed: float

    @property
    def part_of_all_attitudes(self) -> float:
        """Fraction of all attitudes that lie within four standard deviations of the previous attitude."""
        angle = min(4.0 * self.sigma, np.pi)
        return float(angle - np.sin(angle)) / np.pi


@dataclass(frozen=True, slots=True, eq=False)
class SharedRate:
    """Body rate (3,) that most observed points share, in camera axes, rad/s, with its covariance (3, 3).

    The flags `shares` (n,) mark the points whose motion agrees with the rate.
    """

    rate: FloatArray
    covariance: FloatArray
    shares: BoolArray


_CHI_SQUARE = 13.8
"""Threshold of chi-square with two degrees of freedom, which is exceeded by chance for one star in 1000."""
_SEEDS = 10


def identify_by_rate(
    field: StarField,
    sky: KnownSky,
    settings: ClassicalSettings = DEFAULT,
    motion: StarMotion | None = None,
    previous: PreviousAttitude | None = None,
) -> StarMatch:
    """Return the identification of a star field by rate matching.

    Without the `motion` of the observed points, all points are treated as stars and the attitude as constant.
    Raises FieldUnknown if the scale is too uncertain, and ValueError if `motion` and `field` differ in
    length.
    """
    shared = None if motion is None else shared_rate(field.direction, motion)
    kept = np.arange(len(field)) if shared is None else np.flatnonzero(shared.shares)
    stars = field.subset(kept)
    if len(stars) < settings.verification.least_matches:
        return nothing(field, MatchStatus.TOO_FEW_STARS)
    answer = nothing(stars)
    if previous is not None:
        rotation = np.zeros(3) if shared is None else shared.rate * previous.elapsed
        predicted = attitude_matrix(multiply(from_rotation_vector(rotation), previous.attitude))
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
    """Return the body rate with which most observed points agree, by least squares over these points.

    A rate is computed from each pair among the first ten of the n points, which are given by `direction` (n,
    3). The rate with which most points agree is the initial guess. Raises ValueError if the numbers of
    directions and velocities differ.
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
        # Many points agree with the inaccurate rate from two close points, so the rate is refined.
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
    """Return the least-squares body rate (3,) and its covariance (3, 3) from the model v' = v x w."""
    weight = 1.0 / sigma**2
    normal = np.sum(weight) * np.eye(3) - np.einsum("n,nx,ny->xy", weight, direction, direction)
    covariance = np.linalg.pinv(normal)
    return covariance @ (weight @ np.cross(velocity, direction)), covariance


def _agrees(direction: FloatArray, motion: StarMotion, rate: FloatArray, covariance: FloatArray) -> BoolArray:
    """Return, for each point (n,), whether its motion agrees with `rate` within the errors."""
    residual = motion.velocity - np.cross(direction, rate)
    residual -= np.sum(residual * direction, axis=-1, keepdims=True) * direction
    # The largest eigenvalues of the rate's covariances give an upper bound of the velocity error.
    spread = motion.sigma**2 + float(np.linalg.eigvalsh(covariance)[-1]) * (1.0 - direction[:, 2] ** 2)
    spread = spread + float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    return np.asarray(np.sum(residual**2, axis=-1) <= _CHI_SQUARE * spread)


DEFAULT_METHOD = "default"


@dataclass(frozen=True, slots=True)
class Method:
    """Method of star identification, with its publication.

    The function `identify` compares the stars of a field with the guide star tables of the sky. The methods
    other than the default method raise FieldUnknown if the image scale is too uncertain.
    """

    identify: Callable[[StarField, KnownSky], StarMatch]
    source: str


def method_of(name: str) -> Callable[[StarField, SkyIndex], StarMatch]:
    """Return an identification function of the method `name` for use in `SolveSettings`.

    The returned function builds new tables of the sky for each field.
    """
    method = METHODS[name]

    def identify(field: StarField, index: SkyIndex) -> StarMatch:
        return method.identify(field, KnownSky(index, field.half_width))

    return identify


def _classical(propose: Propose, source: str) -> Method:
    return Method(partial(search, propose=propose), source)


METHODS: dict[str, Method] = {
    DEFAULT_METHOD: Method(
        lambda field, sky: lost_in_space.identify(field, sky.index),
        "votes of triangles that match in shape, orientation and size",
    ),
    "angle": _classical(propose_angles, "Gottlieb 1978"),
    "spherical-triangle": _classical(propose_spherical, "Cole & Crassidis 2004"),
    "planar-triangle": _classical(propose_planar, "Cole & Crassidis 2006"),
    "pyramid": _classical(propose_pyramids, "Mortari et al. 2004"),
    "rate": Method(identify_by_rate, "Samaan, Mortari & Junkins 2005"),
    "voting": _classical(propose_families, "Kolomenkin et al. 2008"),
    "grid": _classical(propose_grids, "Padgett & Kreutz-Delgado 1997"),
}


def match_images(
    observed: FloatArray,
    reference: FloatArray,
    sigma: FloatArray,
    prior: FloatArray | None = None,
    steps: int = 4,
) -> AttitudeFix:
    """Return the attitude that matches the image of the reference stars to the observed image.

    The method AIM (attitude estimation using image matching: Delabie, De Schutter & Vandenbussche, Journal of
    Guidance, Control, and Dynamics 36, 2013) is mentioned in Michalski, section 3.4. The method projects the
    reference stars into an image with a prior attitude. The rotation and translation that move the projected
    image onto the observed image with the smallest sum of squared distances have a closed form, derived here
    independently. The rotation in the image is a rotation about the boresight, and the translation is a tilt
    of the boresight.

    If the camera is tilted, stars far from the boresight move farther in the image than stars at the
    boresight. The error of the closed form is therefore proportional to the error of the prior attitude and
    to the squared field angle. Each further step projects the stars with the newest attitude, which removes
    most of the remaining error. Four steps reduce a prior error of 1 deg in a 20 deg field to less than
    0.01".

    Raises AttitudeError if the attitude is undetermined, or if a star is behind the camera according to the
    prior attitude.

    Args:
        observed: (n, 3) observed unit vectors in camera axes, boresight +z.
        reference: (n, 3) reference unit vectors.
        sigma: (n,) standard deviations of the observed directions, rad.
        prior: (4,) prior attitude, reference frame to camera; by default TRIAD with the best pair of stars.
        steps: number of projections with the newest attitude.
    """
    seen = sightings(observed, reference, sigma)
    attitude = attitude_of_pair(seen, *best_pair(seen, sigma)) if prior is None else prior
    for _ in range(steps):
        attitude = multiply(
            _image_motion(observed, reference @ attitude_matrix(attitude).T, seen.weight), attitude
        )
    attitude = upright(attitude)
    return AttitudeFix(attitude, seen.covariance, seen.loss(attitude))


def _image_motion(observed: FloatArray, predicted: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the rotation (4,) of the camera that moves the predicted image onto the observed image.

    The unit vectors (n, 3) are in camera axes, and the weights (n,) have a sum of one.
    """
    if min(observed[:, 2].min(), predicted[:, 2].min()) <= 0.0:
        raise AttitudeError("image matching needs all observed and predicted stars in front of the camera")
    image, catalogue = (vectors[:, :2] / vectors[:, 2:] for vectors in (observed, predicted))
    image_centre, catalogue_centre = weight @ image, weight @ catalogue
    u, v = image - image_centre, catalogue - catalogue_centre
    turn = np.arctan2(weight @ (v[:, 0] * u[:, 1] - v[:, 1] * u[:, 0]), weight @ np.sum(u * v, axis=1))
    cosine, sine = np.cos(turn), np.sin(turn)
    x, y = image_centre - np.array([[cosine, -sine], [sine, cosine]]) @ catalogue_centre
    shift = float(np.hypot(x, y))
    tilt = (np.arctan(shift) / shift if shift > 0.0 else 1.0) * np.array([y, -x, 0.0])
    # The rotation of the camera is opposite to the motion of the stars in the image.
    return multiply(from_rotation_vector(tilt), from_rotation_vector(np.array([0.0, 0.0, -turn])))
