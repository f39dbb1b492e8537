"""Verification of a candidate attitude against the whole field, and tracking with a prior attitude.

The guide stars predicted in the field are compared with the observed stars. Attitude and scale are refined
with the matched stars, and the comparison is repeated until the set of matched stars no longer changes. The
significance of a match is an upper bound of the expected number of attitudes, among the searched attitudes,
at which random stars would match at least as well. If the expected number of chance matches is far below one,
it is also an upper bound of the probability of a false match. The bound of chance matches does not depend on
how a candidate attitude was found. The bound is multiplied by the number of alternatives among which gate,
brightness limit and test are chosen (Bonferroni).

`track` identifies the stars of a frame with a prior attitude. A prior attitude with a small error displaces
all predicted stars by nearly the same vector. Pairs of an observed and a predicted star are formed if their
distance is within the uncertainty of the prior. The largest set of pairs with a common displacement is used
to refine the attitude. The refined attitude is then verified with the whole field as in lost in space, except
that only attitudes near the prior count as searched.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.startracker.attitude_fit import (
    DistortedFit,
    MatchStatus,
    Refinement,
    StarField,
    StarMatch,
    fit_with_distortion,
    inflation,
    refine,
    stretched,
)
from knightcube.vision.startracker.index.sky_index import SkyIndex

_MOST_ORDERED = 12


@dataclass(frozen=True, slots=True)
class Chance:
    """The parameters from which the probability of a chance match is computed.

    Attributes:
        observed: number of observed stars.
        spread: variance of a star's direction along one axis, divided by the solid angle of the field.
        fields: solid angle of the searched part of the sky, divided by the solid angle of the field.
        scales: natural logarithm of the ratio of the highest to the lowest image scale.
        choices: number of gate widths among which the matching selects.
        least: minimum number of matched stars for an identification.
        enough: log10 of the number of chance matches below which an exact bound is not needed.
    """

    observed: int
    spread: float
    fields: float
    scales: float
    choices: int
    least: int
    enough: float

    def log10(self, gate: float, observed: Sequence[int], ranks: Sequence[int]) -> float:
        """Return log10 of an upper bound of the number of chance matches that are as good as a given match.

        The matching also selects the faintest expected star that is compared. Because of this selection of
        the faintest star, the bound is multiplied by j^2 pi^2/6, where j - 1 is the number of brighter
        expected stars without a match.

        Args:
            gate: half-width within which a star matches, in standard deviations.
            observed: indices of the matched observed stars in order of brightness.
            ranks: indices of the expected stars that the observed stars match, in order of brightness.
        """
        pairs = sorted(zip(ranks, observed, strict=True))
        best = math.inf
        for matched in range(len(pairs), self.least - 1, -1):
            expected = pairs[matched - 1][0] + 1
            value = self._of_places(gate, matched, expected)
            value += math.log10(self.choices * math.pi**2 / 6.0 * (expected - matched + 1.0) ** 2)
            if self.enough < value < self.enough + 8.0 and matched <= _MOST_ORDERED:
                value += min(0.0, math.log10(2.0 * order_probability([star for _, star in pairs[:matched]])))
            best = min(best, value)
            if best < self.enough - 2.0:
                break
        return best

    def _of_places(self, gate: float, matched: int, expected: int) -> float:
        """Return log10 of the expected number of chance matches of at least `matched` of `expected` stars.

        The first matched star may be any star of the sky. The second matched star lies in a ring around the
        first star. The radius of the ring is the distance of the first two matched stars, and its width
        follows from the range of the scale and from the gate. Every further matched star lies within the gate
        of an expected star. The probability is multiplied by the number of ways to choose the matched stars
        among the observed stars. Because the fit reduces the distances of the matched stars, the distance of
        each star is increased by the factor 1/(1 - leverage).
        """
        leverage = 2.0 / matched if matched > 2 else 0.5
        chance = min(expected * math.pi * gate * gate * self.spread / (1.0 - leverage) ** 2, 0.5)
        if matched <= self.observed * chance:
            return math.log10(self.fields * expected)
        # The mean square distance of two points of a unit square is 1/3.
        ring = 2.0 * math.pi / 3.0 * expected * (self.scales + 2.0 * gate * math.sqrt(3.0 * self.spread))
        lost = self.observed - matched
        ways = math.lgamma(self.observed + 1) - math.lgamma(matched + 1) - math.lgamma(lost + 1)
        rest = (matched - 2) * math.log(chance) + lost * math.log1p(-chance)
        # The probabilities of more matches decrease faster than a geometric series (Feller, section VI.3).
        ratio = lost / (matched + 1.0) * chance / (1.0 - chance)
        return (ways + rest - math.log1p(-ratio) + math.log(self.fields * expected * ring)) / math.log(10.0)


def order_probability(sequence: Sequence[int]) -> float:
    """Return the probability that a random order has no more inversions than `sequence` (Kendall's tau)."""
    inversions = sum(a > b for place, a in enumerate(sequence) for b in sequence[place + 1 :])
    counts = _inversion_counts(len(sequence))
    return sum(counts[: inversions + 1]) / math.factorial(len(sequence))


@lru_cache(maxsize=_MOST_ORDERED + 1)
def _inversion_counts(length: int) -> tuple[int, ...]:
    """Return the numbers of permutations of `length` items with 0, 1, 2, ... inversions (Mahonian)."""
    counts = [1]
    for more in range(1, length):
        counts = [sum(counts[max(0, total - more) : total + 1]) for total in range(len(counts) + more)]
    return tuple(counts)


@dataclass(frozen=True, slots=True)
class VerificationSettings:
    """Settings of the verification of a candidate attitude.

    Attributes:
        log10_false_alarm: log10 of the largest accepted expected number of chance matches.
        gates: trial half-widths within which a star matches, in standard deviations; the gate with the most
            significant match is used. The wide gates are for a lens with distortion, or for standard
            deviations that are too small.
        least_matches: minimum number of matched stars.
        rounds: maximum number of rounds of matching and refinement.
        most: number of observed stars, the brightest first, from which it is decided whether a candidate is
            accepted. After a candidate is accepted, all stars are matched.
    """

    log10_false_alarm: float = -4.5
    gates: tuple[float, ...] = (3.5, 8.0, 20.0)
    least_matches: int = 4
    rounds: int = 5
    most: int = 64


@dataclass(frozen=True, slots=True, eq=False)
class _Matching:
    """Indices (k,) of matched observed stars and of their guide stars, and log10 of the chance matches."""

    observed: IntArray
    star: IntArray
    log10_chance: float


# Fraction of bright expected stars that match, below which the distortion of the lens is also fitted.
_FEW_MISSED = 0.8
# Maximum fraction of bright expected stars that have an unmatched star nearby instead of a match.
# The second value is the radius of the search for nearby stars, relative to the image corner's tangent.
# A larger fraction of displaced stars indicates a wrong lens fit, because a foreground only hides stars.
_MOST_DISPLACED, _DISPLACED_BY = 0.15, 0.04
# Log10 of the factor on the limit of chance matches above which a candidate is rejected at once.
_HOPELESS = 7.0


def verify(
    field: StarField,
    sky: SkyIndex,
    matrix: FloatArray,
    scale: float,
    searched: float = 1.0,
    settings: VerificationSettings = VerificationSettings(),
) -> StarMatch:
    """Return the identification of the whole field, or NO_MATCH if the candidate may be a chance match.

    Args:
        field: observed points of the frame.
        sky: index of the guide stars.
        matrix: attitude matrix of the candidate (3, 3), ICRS to camera, accurate enough for stars to match.
        scale: image scale of the candidate attitude.
        searched: fraction of all attitudes covered by the search that found the candidate; 1 for lost in
            space.
        settings: settings of the verification.
    """
    expected = _expected_in(field, sky, matrix, scale)
    deciding = field if len(field) <= settings.most else field.subset(np.arange(settings.most))
    start = Refinement(matrix, scale, np.empty((0, 0)), np.empty(0))
    decided = _settle(deciding, sky, expected, start, searched, settings)
    if decided is None:
        return nothing(field)
    matching, refined = decided
    if matching.log10_chance > settings.log10_false_alarm:
        return nothing(field)
    if deciding is not field:
        expected = _expected_in(field, sky, refined.matrix, refined.scale)
        decided = _settle(field, sky, expected, refined, searched, settings)
        if decided is None:
            return nothing(field)
        matching, refined = decided
    # Distortion of an uncalibrated lens is fitted if bright stars do not match or residuals are too large.
    bright = _bright_matched(expected, matching.star)
    missed = not len(bright) or float(np.mean(bright)) < _FEW_MISSED
    scattered = inflation(refined.squares, len(refined.covariance)) > 1.0
    if field.scale[1] > field.scale[0] and (missed or scattered):
        return _distorted(field, sky, matching, refined)
    return _identified(field, matching, refined.widened())


def _distorted(field: StarField, sky: SkyIndex, matching: _Matching, refined: Refinement) -> StarMatch:
    """Return the identification with fitted distortion, or NO_MATCH if bright stars are displaced."""
    expected = _expected_in(field, sky, refined.matrix, refined.scale)
    found = fit_with_distortion(field, sky, expected, matching.observed, matching.star, refined)
    if found is None or _share_displaced(field, sky, expected, found) > _MOST_DISPLACED:
        return nothing(field)
    grown = _Matching(found.observed, found.star, matching.log10_chance)
    answer = _identified(field, grown, found.refined)
    return replace(answer, distortion=found.distortion, from_lens=found.from_lens)


def _bright_matched(
    expected: npt.NDArray[np.intp], star: npt.NDArray[np.integer[Any]]
) -> npt.NDArray[np.bool_]:
    """Return a mask of the matched stars, for the expected stars brighter than the median matched star."""
    matched = (expected[:, None] == star).any(axis=1)
    places = np.flatnonzero(matched)
    return np.asarray(matched[: places[(len(places) - 1) // 2] + 1] if len(places) else matched[:0])


def _share_displaced(
    field: StarField, sky: SkyIndex, expected: npt.NDArray[np.intp], found: DistortedFit
) -> float:
    """Return the fraction of bright expected stars that have an unmatched star nearby instead of a match.

    The fraction that is expected by chance is subtracted from the result.
    """
    matched = _bright_matched(expected, found.star)
    missed = sky.stars.direction[expected[: len(matched)][~matched]]
    unmatched = np.delete(found.seen, found.observed, axis=0)
    if not len(missed) or not len(unmatched):
        return 0.0
    across, down = (width * found.refined.scale for width in field.half_width)
    radius = _DISPLACED_BY * math.hypot(across, down)
    nearest = (unmatched @ (found.refined.matrix @ missed.T)).max(axis=0)
    near = np.count_nonzero(2.0 - 2.0 * nearest < radius**2)
    chance = len(missed) * min(1.0, len(unmatched) * math.pi * radius**2 / (4.0 * across * down))
    return float(near - chance) / len(matched)


def nothing(field: StarField, status: MatchStatus = MatchStatus.NO_MATCH) -> StarMatch:
    """Return an identification in which no star is matched."""
    return StarMatch(status, np.full(len(field), -1))


def expected_stars(
    sky: SkyIndex, matrix: FloatArray, half_width: tuple[float, float], count: int
) -> npt.NDArray[np.intp]:
    """Return the indices of the `count` brightest guide stars in the field, the brightest first."""
    across, down = half_width
    cosine = 1.0 / math.sqrt(1.0 + across * across + down * down)
    # The search covers twice as many stars of the sky as needed for `count` stars in an average field.
    # The factor of two is needed because stars are less dense near the galactic poles.
    brightest = int(math.pi / (across * down) * 2.0 * (count + 5.0))
    near = np.flatnonzero(matrix[2].astype(np.float32) @ sky.coarse[:, :brightest] > cosine)
    x, y, z = matrix @ sky.stars.direction[near].T
    inside = (np.abs(x) <= across * z) & (np.abs(y) <= down * z)
    return np.asarray(near[inside][:count])


def _expected_in(field: StarField, sky: SkyIndex, matrix: FloatArray, scale: float) -> npt.NDArray[np.intp]:
    """Return the indices of the guide stars that are expected in the field, the brightest first."""
    across, down = field.half_width
    return expected_stars(sky, matrix, (across * scale, down * scale), int(1.3 * len(field)) + 8)


def _settle(
    field: StarField,
    sky: SkyIndex,
    expected: npt.NDArray[np.intp],
    start: Refinement,
    searched: float,
    settings: VerificationSettings,
) -> tuple[_Matching, Refinement] | None:
    """Return the matched stars and the attitude after repeated matching and refinement.

    Matching and refinement of the attitude alternate until the matched stars no longer change. Returns None
    if the refinement diverges.
    """
    refined, previous = start, None
    for _ in range(settings.rounds):
        matching = _match(field, sky, expected, refined, searched, settings)
        if matching is None or (
            previous is None and matching.log10_chance > settings.log10_false_alarm + _HOPELESS
        ):
            return None
        if previous is not None and np.array_equal(previous.observed, matching.observed):
            return matching, refined
        previous = matching
        found = refine(
            field.direction[matching.observed],
            sky.stars.direction[matching.star],
            field.sigma[matching.observed],
            refined.matrix,
            refined.scale,
            field.scale[1] > field.scale[0],
        )
        if found is None:
            return None
        # The fitted scale must lie within five standard deviations of the range of possible scales.
        lowest, highest = field.scale
        slack = math.exp(5.0 * found.scale_sigma)
        if lowest != highest and not lowest / slack <= found.scale <= highest * slack:
            return None
        refined = found
    return (previous, refined) if previous is not None else None


def _match(
    field: StarField,
    sky: SkyIndex,
    expected: npt.NDArray[np.intp],
    at: Refinement,
    searched: float,
    settings: VerificationSettings,
) -> _Matching | None:
    """Return the observed stars that match an expected star within a gate, for the most significant gate."""
    if len(expected) < settings.least_matches:
        return None
    cosines = stretched(field.direction, at.scale) @ (at.matrix @ sky.stars.direction[expected].T)
    nearest = cosines.argmax(axis=1)
    rows = np.arange(len(nearest))
    variance = (field.sigma * at.scale) ** 2
    squared = 2.0 * (1.0 - cosines[rows, nearest]) / variance
    squared[cosines.argmax(axis=0)[nearest] != rows] = np.inf
    area = 4.0 * field.half_width[0] * field.half_width[1] * at.scale**2
    chance = Chance(
        len(field),
        float(variance.mean()) / area,
        4.0 * math.pi / area * searched,
        math.log(field.scale[1] / field.scale[0]),
        len(settings.gates),
        settings.least_matches,
        settings.log10_false_alarm,
    )
    best: _Matching | None = None
    matched = settings.least_matches - 1
    for gate in settings.gates:
        within = np.flatnonzero(squared <= gate * gate)
        # A match within a wider gate is less significant unless it contains more stars.
        if len(within) <= matched:
            continue
        matched = len(within)
        value = chance.log10(gate, within.tolist(), nearest[within].tolist())
        if best is None or value < best.log10_chance:
            best = _Matching(within, expected[nearest[within]], value)
    return best


def _identified(field: StarField, matching: _Matching, refined: Refinement) -> StarMatch:
    star = np.full(len(field), -1)
    star[matching.observed] = matching.star
    return StarMatch(
        MatchStatus.IDENTIFIED,
        star,
        refined.fix(),
        refined.scale,
        refined.scale_sigma * refined.scale,
        matching.log10_chance,
    )


PRIOR_SIGMAS = 4.0
"""Largest error of a prior attitude that the search near it covers, in standard deviations."""
_BRIGHTEST = 16
# Maximum number of pairs of an observed and a predicted star.
# With more pairs of stars, the comparison is ambiguous and takes longer than a search of the whole sky.
_MOST_PAIRS = 400
_DEFAULT = VerificationSettings()


def track(
    field: StarField,
    sky: SkyIndex,
    attitude: FloatArray,
    sigma: float,
    settings: VerificationSettings = _DEFAULT,
) -> StarMatch:
    """Return the identification near a prior attitude, or NO_MATCH if the stars contradict the prior.

    The prior is the quaternion `attitude` (4,) from ICRS to camera axes, with the standard deviation `sigma`,
    rad, about each axis. If `sigma` exceeds some degrees, `identify` is faster and more reliable.
    """
    if len(field) < settings.least_matches:
        return nothing(field, MatchStatus.TOO_FEW_STARS)
    scale = math.sqrt(field.scale[0] * field.scale[1])
    matrix = attitude_matrix(attitude)
    observed, star = _same_shift(field, sky, matrix, scale, sigma)
    if len(observed) >= 2:
        free_scale = field.scale[1] > field.scale[0] and len(observed) > 2
        found = refine(
            field.direction[observed],
            sky.stars.direction[star],
            field.sigma[observed],
            matrix,
            scale,
            free_scale,
        )
        if found is not None:
            matrix, scale = found.matrix, found.scale
    # The searched fraction of attitudes is the volume of rotations near the prior, divided by 8 pi^2.
    searched = min((PRIOR_SIGMAS * sigma) ** 3 / (6.0 * math.pi), 1.0)
    return verify(field, sky, matrix, scale, searched, settings)


def _same_shift(
    field: StarField, sky: SkyIndex, matrix: FloatArray, scale: float, sigma: float
) -> tuple[IntArray, npt.NDArray[np.intp]]:
    """Return the indices of observed stars (k,) and guide stars (k,) that have a common displacement.

    The returned stars form the largest set of pairs for which one displacement explains the error of the
    prior.
    """
    reach = PRIOR_SIGMAS * sigma
    across, down = (scale * width for width in field.half_width)
    wider = across + reach * (1.0 + across**2), down + reach * (1.0 + down**2)
    area = (wider[0] * wider[1]) / (across * down)
    expected = expected_stars(sky, matrix, wider, int((1.3 * min(len(field), _BRIGHTEST) + 8) * area))
    seen = stretched(field.direction[:_BRIGHTEST], scale)
    shift = seen[:, None, :] - sky.stars.direction[expected] @ matrix.T
    # Errors of roll and scale displace stars at different edges of the image differently.
    radius = math.hypot(across, down)
    star_sigma = float(field.sigma[:_BRIGHTEST].max()) * scale
    stretch = 0.5 * math.log(field.scale[1] / field.scale[0])
    close = (
        np.einsum("ijk,ijk->ij", shift, shift)
        <= (math.sqrt(2.0) * reach + stretch * radius + 4.0 * star_sigma) ** 2
    )
    one, two = np.nonzero(close)
    if not len(one) or len(one) > _MOST_PAIRS:
        return np.empty(0, dtype=np.int64), expected[:0]
    shifts = shift[one, two]
    apart = shifts[:, None, :] - shifts
    tolerance = 4.0 * star_sigma + (PRIOR_SIGMAS * sigma + stretch) * radius
    agree = np.einsum("ijk,ijk->ij", apart, apart) <= tolerance**2
    # Two pairs of stars that share an observed star or a guide star do not support each other.
    agree &= (one[:, None] != one) & (two[:, None] != two)
    best = int(agree.sum(axis=1).argmax())
    members = np.append(np.flatnonzero(agree[best]), best)
    nearest = members[np.argsort(np.einsum("ij,ij->i", apart[best, members], apart[best, members]))]
    observed, first = np.unique(one[nearest], return_index=True)
    return observed, expected[two[nearest[first]]]
