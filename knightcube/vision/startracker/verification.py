"""Verification of a candidate attitude against the whole field.

The guide stars predicted in the field are compared with the observed stars. Attitude and scale are refined
with the matched stars, and the comparison is repeated until the set of matched stars is constant. The
significance of a match is an upper bound on the expected number of attitudes, among the searched attitudes,
at which random stars would match at least as well. If the expected number of chance matches is far below one,
it is also an upper bound on the probability of a false match. The bound on the number of chance matches does
not depend on how a candidate attitude was found. The bound is multiplied by the number of alternatives among
which gate, brightness limit and test are chosen (Bonferroni).
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
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.startracker.attitude_fit import (
    DistortedFit,
    MatchStatus,
    Refinement,
    StarField,
    StarMatch,
    fit_with_distortion,
    refine,
    stretched,
)
from knightcube.vision.startracker.index import SkyIndex

_MOST_ORDERED = 12
# Share of the accepted chance matches that is used for comparisons with all observed stars.
# The rest is used for comparisons with the brightest observed stars alone.
_ALL_OBSERVED = 0.9


@dataclass(frozen=True, slots=True)
class Chance:
    """The parameters from which the probability of a chance match is computed.

    Attributes:
        observed: number of observed stars.
        spread: variance of a star's direction along one axis, divided by the solid angle of the field.
        fields: solid angle of the searched part of the sky, divided by the solid angle of the field.
        scales: natural logarithm of the ratio of the highest to the lowest image scale.
        choices: number of gate widths from which the most significant is selected.
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
        """Return log10 of an upper bound on the expected number of chance matches as good as a given match.

        The observed stars with the indices `observed` match the expected stars `ranks` within `gate` standard
        deviations, both in order of brightness. Only expected stars down to a brightness limit are compared,
        and the limit with the most significant match is selected. The bound is therefore multiplied by j^2
        pi^2/6, where j - 1 is the number of expected stars that are brighter than the limit and have no
        match. Either all observed stars are compared, or only those down to the faintest match. In the second
        case, the bound is also multiplied by the factor for this limit, in which j - 1 is the number of
        compared observed stars without a match. The bound is divided by `_ALL_OBSERVED` in the first case,
        and by 1 - `_ALL_OBSERVED` in the second case.
        """
        pairs = sorted(zip(ranks, observed, strict=True))
        best = math.inf
        for matched in range(len(pairs), self.least - 1, -1):
            expected = pairs[matched - 1][0] + 1
            bright = max(star for _, star in pairs[:matched]) + 1
            limited = self._of_places(gate, matched, expected, bright) + log10_choice(bright - matched)
            value = min(
                self._of_places(gate, matched, expected, self.observed) - math.log10(_ALL_OBSERVED),
                limited - math.log10(1.0 - _ALL_OBSERVED),
            )
            value += math.log10(self.choices) + log10_choice(expected - matched)
            if self.enough < value < self.enough + 8.0 and matched <= _MOST_ORDERED:
                value += min(0.0, math.log10(2.0 * order_probability([star for _, star in pairs[:matched]])))
            best = min(best, value)
            if best < self.enough - 2.0:
                break
        return best

    def _of_places(self, gate: float, matched: int, expected: int, observed: int) -> float:
        """Return log10 of the expected number of chance matches of at least `matched` of `expected` stars.

        The first matched star may be any star of the sky. The second matched star lies in a ring around the
        first star. The radius of the ring is the distance of the first two matched stars. The width of the
        ring is computed from the range of the scale and from the gate. Every further matched star lies within
        the gate of an expected star. The probability is multiplied by the number of ways to choose the
        matched stars among the observed stars. The fit of the attitude reduces the distances between observed
        and expected stars. The gate is therefore increased by the factor 1/(1 - leverage).
        """
        leverage = 2.0 / matched if matched > 2 else 0.5
        chance = min(expected * math.pi * gate * gate * self.spread / (1.0 - leverage) ** 2, 0.5)
        if matched <= observed * chance:
            return math.log10(self.fields * expected)
        # The mean square distance of two random points in a unit square is 1/3.
        ring = 2.0 * math.pi / 3.0 * expected * (self.scales + 2.0 * gate * math.sqrt(3.0 * self.spread))
        lost = observed - matched
        ways = math.lgamma(observed + 1) - math.lgamma(matched + 1) - math.lgamma(lost + 1)
        rest = (matched - 2) * math.log(chance) + lost * math.log1p(-chance)
        # The probabilities of 1, 2, ... more matches decrease faster than a geometric series (Feller, VI.3).
        ratio = lost / (matched + 1.0) * chance / (1.0 - chance)
        return (ways + rest - math.log1p(-ratio) + math.log(self.fields * expected * ring)) / math.log(10.0)


def log10_choice(order: int) -> float:
    """Return log10 of the Bonferroni factor for one of a series of alternatives, `order` = 0, 1, 2, ...

    The reciprocal factors of all alternatives sum to one.
    """
    return math.log10(math.pi**2 / 6.0 * (order + 1.0) ** 2)


def order_probability(sequence: Sequence[int]) -> float:
    """Return the probability that a random order has no more inversions than `sequence` (Kendall's tau)."""
    inversions = sum(a > b for place, a in enumerate(sequence) for b in sequence[place + 1 :])
    counts = _inversion_counts(len(sequence))
    return sum(counts[: inversions + 1]) / math.factorial(len(sequence))


@lru_cache(maxsize=_MOST_ORDERED + 1)
def _inversion_counts(length: int) -> tuple[int, ...]:
    """Return the numbers of permutations of `length` items with 0, 1, ... inversions (Mahonian numbers)."""
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
            significant match is used. The wide gates are for a lens with distortion, and for stars with
            underestimated standard deviations.
        least_matches: minimum number of matched stars.
        rounds: maximum number of rounds of matching and refinement.
        most: number of the brightest observed stars that decide whether a candidate is accepted. After a
            candidate is accepted, all stars are matched.
    """

    log10_false_alarm: float = -4.5
    gates: tuple[float, ...] = (3.5, 8.0, 20.0)
    least_matches: int = 4
    rounds: int = 5
    most: int = 64


@dataclass(frozen=True, slots=True, eq=False)
class _Matching:
    """The matched stars of the first candidate attitude with sufficiently few expected chance matches.

    Attributes:
        candidate: index of the candidate attitude.
        observed, star: indices of the matched observed stars and of their guide stars (k,).
        log10_chance: log10 of the upper bound on the expected number of chance matches.
        expected: indices of the guide stars that are expected in the field, the brightest first.
    """

    candidate: int
    observed: IntArray
    star: IntArray
    log10_chance: float
    expected: IntArray


# Fraction of bright expected stars with a match below which the distortion of the lens is also fitted.
_FEW_MISSED = 0.8
# Maximum fraction of bright expected stars that have an unmatched star nearby instead of a match.
# A larger fraction indicates a wrong fit of the lens: a foreground hides stars but does not displace them.
# Radius of the search for nearby stars, as a fraction of the distance from image centre to corner.
_MOST_DISPLACED, _DISPLACED_BY = 0.15, 0.04
# Excess of log10 of the number of chance matches over its limit, for rejection without refinement.
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

    The candidate has an attitude matrix (3, 3), ICRS to camera, accurate enough for stars to match, and an
    image scale. The search covered the fraction `searched` of all attitudes, 1 if there is no prior attitude.
    """
    return verify_first(field, sky, matrix[None], np.array([scale]), searched, settings)


def verify_first(
    field: StarField,
    sky: SkyIndex,
    matrices: FloatArray,
    scales: FloatArray,
    searched: float = 1.0,
    settings: VerificationSettings = VerificationSettings(),
) -> StarMatch:
    """Return the identification by the first candidate that `verify` accepts, or NO_MATCH.

    The candidates have the attitude matrices (c, 3, 3) and scales (c,).
    """
    deciding = field if len(field) <= settings.most else field.subset(np.arange(settings.most))
    matching = _Matcher(deciding, sky, searched, settings)
    limit = settings.log10_false_alarm + _HOPELESS
    begin = 0
    while begin < len(scales):
        found = matching.first(matrices[begin:], scales[begin:], limit)
        if found is None:
            break
        begin += found.candidate
        start = Refinement(matrices[begin], float(scales[begin]), np.empty((0, 0)), np.empty(0))
        answer = _verified(field, matching, found, start)
        if answer.status is MatchStatus.IDENTIFIED:
            return answer
        begin += 1
    return nothing(field)


def _verified(field: StarField, matching: _Matcher, first: _Matching, start: Refinement) -> StarMatch:
    """Return the identification of the whole field by one candidate, or NO_MATCH."""
    sky, settings = matching.sky, matching.settings
    decided = _settle(matching, first, start)
    if decided is None or decided[0].log10_chance > settings.log10_false_alarm:
        return nothing(field)
    if matching.field is not field:
        refined = decided[1]
        everything = _Matcher(field, sky, matching.searched, settings)
        limit = settings.log10_false_alarm + _HOPELESS
        grown = everything.first(refined.matrix[None], np.array([refined.scale]), limit)
        decided = None if grown is None else _settle(everything, grown, refined)
        if decided is None:
            return nothing(field)
    found, refined = decided
    expected = found.expected
    # The distortion of an uncalibrated lens is fitted if bright stars do not match or residuals are large.
    bright = _bright_matched(expected, found.star)
    missed = not bright or sum(bright) < _FEW_MISSED * len(bright)
    widened = refined.widened()
    if field.scale[1] > field.scale[0] and (missed or widened is not refined):
        return _distorted(field, sky, found, refined)
    return _identified(field, found, widened)


def _distorted(field: StarField, sky: SkyIndex, matching: _Matching, refined: Refinement) -> StarMatch:
    """Return the identification with fitted distortion, or NO_MATCH if bright stars are displaced."""
    across, down = field.half_width
    expected = expected_stars(
        sky, refined.matrix, (across * refined.scale, down * refined.scale), _most_expected(len(field))
    )
    found = fit_with_distortion(field, sky, expected, matching.observed, matching.star, refined)
    if found is None or _share_displaced(field, sky, expected, found) > _MOST_DISPLACED:
        return nothing(field)
    grown = replace(matching, observed=found.observed, star=found.star)
    answer = _identified(field, grown, found.refined)
    return replace(answer, distortion=found.distortion, from_lens=found.from_lens)


def _bright_matched(expected: npt.NDArray[np.integer[Any]], star: npt.NDArray[np.integer[Any]]) -> list[bool]:
    """Return which expected stars have matches, from the brightest star to the match of median brightness."""
    known = set(star.tolist())
    matched = [number in known for number in expected.tolist()]
    places = [place for place, found in enumerate(matched) if found]
    return matched[: places[(len(places) - 1) // 2] + 1] if places else []


def _share_displaced(
    field: StarField, sky: SkyIndex, expected: npt.NDArray[np.intp], found: DistortedFit
) -> float:
    """Return the fraction of bright expected stars with an unmatched star nearby instead of a match.

    The fraction that is expected by chance is subtracted from the result.
    """
    matched = np.array(_bright_matched(expected, found.star), dtype=np.bool_)
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
    across, down = float(half_width[0]), float(half_width[1])
    return _expected(
        sky.stars.direction, sky.coarse, *sky.boxes, np.ascontiguousarray(matrix), across, down, count
    )


def _expected_numpy(
    guide: FloatArray,
    coarse: npt.NDArray[np.float32],
    by_box: npt.NDArray[np.int32],
    placed: FloatArray,
    begin_of_box: npt.NDArray[np.int32],
    matrix: FloatArray,
    across: float,
    down: float,
    count: int,
) -> npt.NDArray[np.intp]:
    """See `expected_stars`; the boxes of the index are used only by the compiled form."""
    cosine = 1.0 / math.sqrt(1.0 + across * across + down * down)
    # The search covers twice as many stars of the sky as needed for `count` stars in an average field.
    # The factor of two is needed because stars are less dense near the galactic poles.
    brightest = int(math.pi / (across * down) * 2.0 * (count + 5.0))
    near = np.flatnonzero(matrix[2].astype(np.float32) @ coarse[:, :brightest] > cosine)
    x, y, z = matrix @ guide[near].T
    inside = (np.abs(x) <= across * z) & (np.abs(y) <= down * z)
    return np.asarray(near[inside][:count])


@compiled_form_of(_expected_numpy)
def _expected(
    guide: FloatArray,
    coarse: npt.NDArray[np.float32],
    by_box: npt.NDArray[np.int32],
    placed: FloatArray,
    begin_of_box: npt.NDArray[np.int32],
    matrix: FloatArray,
    across: float,
    down: float,
    count: int,
) -> npt.NDArray[np.intp]:
    """See `_expected_numpy`."""
    return _inside(matrix, across, down, count, guide, by_box, placed, begin_of_box)


@loop_helper
def _most_expected(observed: int) -> int:
    """Return the maximum number of expected stars for a number of observed stars."""
    return int(1.3 * observed) + 8


def _settle(matcher: _Matcher, first: _Matching, start: Refinement) -> tuple[_Matching, Refinement] | None:
    """Return the matched stars and the attitude after repeated matching and refinement.

    Matching and refinement of the attitude alternate until the matched stars no longer change. `first` is the
    matching at the attitude `start`. Returns None if the refinement diverges, if too few stars match, or if
    the fitted scale is not possible.
    """
    field, sky = matcher.field, matcher.sky
    matching, refined = first, start
    for rounds in range(matcher.settings.rounds):
        if rounds > 0:
            following = matcher.again(refined, matching.expected)
            if following is None:
                return None
            if following.observed.tobytes() == matching.observed.tobytes():
                return following, refined
            matching = following
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
        # The fitted scale must be within five standard deviations of the range of possible scales.
        lowest, highest = field.scale
        slack = math.exp(5.0 * found.scale_sigma)
        if lowest != highest and not lowest / slack <= found.scale <= highest * slack:
            return None
        refined = found
    return matching, refined


class _Matcher:
    """The comparison of a field with the guide stars that are expected at candidate attitudes.

    Attributes:
        field: observed points of the frame.
        sky: index of the guide stars.
        searched: fraction of all attitudes covered by the search.
        settings: settings of the verification.
    """

    def __init__(
        self, field: StarField, sky: SkyIndex, searched: float, settings: VerificationSettings
    ) -> None:
        self.field, self.sky, self.searched, self.settings = field, sky, searched, settings
        self._seen = np.ascontiguousarray(field.direction), np.ascontiguousarray(field.sigma)
        self._guide: tuple[Any, ...] = (sky.stars.direction, sky.coarse, *sky.boxes)
        self._facts: tuple[Any, ...] = (
            float(field.half_width[0]),
            float(field.half_width[1]),
            math.log(field.scale[1] / field.scale[0]),
            float(searched),
            np.array(settings.gates),
            settings.least_matches,
            settings.log10_false_alarm,
        )

    def first(self, matrices: FloatArray, scales: FloatArray, limit: float) -> _Matching | None:
        """Return the matching at the first candidate with at most 10^`limit` chance matches, or None."""
        return self._matching(matrices, scales, limit, np.empty(0, dtype=np.int64))

    def again(self, at: Refinement, expected: IntArray) -> _Matching | None:
        """Return the matching of `expected` stars at one attitude, or None if too few stars match."""
        return self._matching(at.matrix[None], np.array([at.scale]), math.inf, expected)

    def _matching(
        self, matrices: FloatArray, scales: FloatArray, limit: float, expected: IntArray
    ) -> _Matching | None:
        candidates = np.ascontiguousarray(matrices), scales
        given: tuple[Any, ...] = (*self._seen, *candidates, *self._facts, limit, expected, *self._guide)
        candidate, observed, star, chance, expected = _first_match(*given)
        return None if candidate < 0 else _Matching(candidate, observed, star, chance, expected)


_Found = tuple[int, IntArray, IntArray, float, IntArray]


def _first_match_numpy(
    direction: FloatArray,
    sigma: FloatArray,
    matrices: FloatArray,
    scales: FloatArray,
    across: float,
    down: float,
    ln_scales: float,
    searched: float,
    gates: FloatArray,
    least: int,
    enough: float,
    limit: float,
    expected: IntArray,
    guide: FloatArray,
    coarse: npt.NDArray[np.float32],
    by_box: npt.NDArray[np.int32],
    placed: FloatArray,
    begin_of_box: npt.NDArray[np.int32],
) -> _Found:
    """Return the attributes of a `_Matching`; the candidate is -1 if no candidate matches sufficiently well.

    If `expected` is empty, the expected guide stars are computed for each candidate.
    """
    given = len(expected) > 0
    for number in range(len(scales)):
        matrix, scale = matrices[number], float(scales[number])
        if not given:
            table, most = (guide, coarse, by_box, placed, begin_of_box), _most_expected(len(direction))
            expected = _expected_numpy(*table, matrix, across * scale, down * scale, most)
        if len(expected) < least:
            continue
        variance = (sigma * scale) ** 2
        nearest, squared = _pair_numpy(stretched(direction, scale), variance, matrix, guide[expected])
        area = 4.0 * across * down * scale**2
        chance = Chance(
            len(direction),
            float(variance.mean()) / area,
            4.0 * math.pi / area * searched,
            ln_scales,
            len(gates),
            least,
            enough,
        )
        best, matched, bound = np.empty(0, dtype=np.int64), least - 1, math.inf
        for gate in gates.tolist():
            within = np.flatnonzero(squared <= gate * gate)
            # A match within a wider gate is less significant unless it contains more stars.
            if len(within) <= matched:
                continue
            matched = len(within)
            value = chance.log10(gate, within.tolist(), nearest[within].tolist())
            if not len(best) or value < bound:
                best, bound = within, value
        if len(best) and bound <= limit:
            return number, best, expected[nearest[best]], bound, expected
    nothing_found = np.empty(0, dtype=np.int64)
    return -1, nothing_found, nothing_found, math.inf, nothing_found


def _pair_numpy(
    seen: FloatArray, variance: FloatArray, matrix: FloatArray, guide: FloatArray
) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Return each star's nearest guide star and its squared distance, or infinity if not mutually nearest."""
    cosines = seen @ (matrix @ guide.T)
    nearest = cosines.argmax(axis=1)
    rows = np.arange(len(nearest))
    squared = 2.0 * (1.0 - cosines[rows, nearest]) / variance
    squared[cosines.argmax(axis=0)[nearest] != rows] = np.inf
    return nearest, squared


@compiled_form_of(_first_match_numpy)
def _first_match(
    direction: FloatArray,
    sigma: FloatArray,
    matrices: FloatArray,
    scales: FloatArray,
    across: float,
    down: float,
    ln_scales: float,
    searched: float,
    gates: FloatArray,
    least: int,
    enough: float,
    limit: float,
    expected: IntArray,
    guide: FloatArray,
    coarse: npt.NDArray[np.float32],
    by_box: npt.NDArray[np.int32],
    placed: FloatArray,
    begin_of_box: npt.NDArray[np.int32],
) -> _Found:
    given, observed = len(expected) > 0, len(direction)
    seen, nearest, squared = np.empty((observed, 3)), np.empty(observed, dtype=np.int64), np.empty(observed)
    most, widest, tangent = _most_expected(observed), gates.max(), direction[:, 0] / direction[:, 2]
    order = np.argsort(tangent, kind="mergesort")
    tangent = tangent[order]
    for number in range(len(scales)):
        scale = scales[number]
        if not given:
            expected = _inside(
                matrices[number], across * scale, down * scale, most, guide, by_box, placed, begin_of_box
            )
        if len(expected) < least:
            continue
        _stretch(direction, scale, seen)
        mean, reach = 0.0, 0.0
        for k in range(observed):
            mean += (sigma[k] * scale) ** 2 / observed
            reach = max(reach, widest * sigma[k] * scale)
        _pair(seen, sigma, scale, matrices[number], guide, expected, order, tangent, reach, nearest, squared)
        area = 4.0 * across * down * scale * scale
        gate, bound = _best_gate(
            squared, nearest, gates, least, enough, mean / area, 4.0 * math.pi / area * searched, ln_scales
        )
        if gate > 0.0 and bound <= limit:
            best, star = _within(squared, nearest, gate)
            for k in range(len(star)):
                star[k] = expected[star[k]]
            return number, best, star, bound, expected
    nothing_found = np.empty(0, dtype=np.int64)
    return -1, nothing_found, nothing_found, math.inf, nothing_found


@loop_helper
def _within(squared: FloatArray, nearest: IntArray, gate: float) -> tuple[IntArray, IntArray]:
    """Return the indices (k,) of the observed stars within the gate, and of the expected stars they match."""
    count = 0
    for k in range(len(squared)):
        count += int(squared[k] <= gate * gate)
    best, star = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    count = 0
    for k in range(len(squared)):
        if squared[k] <= gate * gate:
            best[count], star[count] = k, nearest[k]
            count += 1
    return best, star


@loop_helper
def _stretch(direction: FloatArray, scale: float, seen: FloatArray) -> None:
    """Write unit vectors, with their tangents multiplied by `scale`, to `seen` (n, 3)."""
    squared = scale * scale
    for k in range(len(direction)):
        z = direction[k, 2]
        shrink = 1.0 / math.sqrt(squared + (1.0 - squared) * z * z)
        seen[k, 0] = direction[k, 0] * scale * shrink
        seen[k, 1] = direction[k, 1] * scale * shrink
        seen[k, 2] = z * shrink


@loop_helper
def _inside(
    matrix: FloatArray,
    across: float,
    down: float,
    count: int,
    guide: FloatArray,
    by_box: npt.NDArray[np.int32],
    placed: FloatArray,
    begin_of_box: npt.NDArray[np.int32],
) -> IntArray:
    """Return the indices of the `count` brightest guide stars in the field, as `expected_stars` does."""
    cosine = 1.0 / math.sqrt(1.0 + across * across + down * down)
    chord = math.sqrt(2.0 - 2.0 * cosine)
    brightest = int(math.pi / (across * down) * 2.0 * (count + 5.0))
    if brightest < _FEW_BRIGHTEST:
        return _first_inside(matrix, across, down, cosine, guide[:brightest], count)
    boxes = round((len(begin_of_box) - 1) ** (1.0 / 3.0))
    lowest, highest = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    for axis in range(3):
        lowest[axis] = max(int((matrix[2, axis] - chord + 1.0) * (0.5 * boxes)), 0)
        highest[axis] = min(int((matrix[2, axis] + chord + 1.0) * (0.5 * boxes)), boxes - 1)
    found, stars = 0, np.empty(count, dtype=np.int64)
    for i in range(lowest[0], highest[0] + 1):
        for j in range(lowest[1], highest[1] + 1):
            for k in range(lowest[2], highest[2] + 1):
                box = (i * boxes + j) * boxes + k
                for at in range(begin_of_box[box], begin_of_box[box + 1]):
                    star = by_box[at]
                    if star >= brightest:
                        break
                    x, y, z = placed[at, 0], placed[at, 1], placed[at, 2]
                    if not _in_field(matrix, across, down, cosine, x, y, z):
                        continue
                    # The stars found so far are sorted, and only the brightest are kept.
                    if found == count and star > stars[found - 1]:
                        continue
                    place = min(found, count - 1)
                    while place > 0 and stars[place - 1] > star:
                        stars[place] = stars[place - 1]
                        place -= 1
                    stars[place] = star
                    found = min(found + 1, count)
    inside = np.empty(found, dtype=np.int64)
    for k in range(found):
        inside[k] = stars[k]
    return inside


@loop_helper
def _first_inside(
    matrix: FloatArray, across: float, down: float, cosine: float, guide: FloatArray, count: int
) -> IntArray:
    """Return the indices of the first `count` of the stars `guide` (n, 3) that are in the field.

    In a wide field, a search of all bright stars is faster than a search of many boxes.
    """
    found, stars = 0, np.empty(count, dtype=np.int64)
    for star in range(len(guide)):
        x, y, z = guide[star, 0], guide[star, 1], guide[star, 2]
        if _in_field(matrix, across, down, cosine, x, y, z):
            stars[found] = star
            found += 1
            if found == count:
                break
    return stars[:found].copy()


@loop_helper
def _in_field(
    matrix: FloatArray, across: float, down: float, cosine: float, x: float, y: float, z: float
) -> bool:
    """Return whether the direction (x, y, z) is in the field; `cosine` is for the corners' field angle."""
    along: float = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z
    right: float = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z
    below: float = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z
    return along > cosine and abs(right) <= across * along and abs(below) <= down * along


# Number of brightest guide stars below which all of them are searched instead of boxes.
_FEW_BRIGHTEST = 8_000


@loop_helper
def _pair(
    seen: FloatArray,
    sigma: FloatArray,
    scale: float,
    matrix: FloatArray,
    guide: FloatArray,
    expected: IntArray,
    order: IntArray,
    tangent: FloatArray,
    reach: float,
    nearest: IntArray,
    squared: FloatArray,
) -> None:
    """Write the nearest expected star of each observed star and its squared distance in standard deviations.

    The distance is infinite if another observed star is nearer to the expected star, or if no expected star
    is within the chord `reach`. The array `order` (n,) sorts the observed stars by their field-angle tangent
    along the first axis, and `tangent` (n,) contains the sorted tangents at scale 1.
    """
    closest, owner = np.full(len(seen), -2.0), np.full(len(expected), -1)
    nearest[:] = 0
    strip = _widest_difference(seen, reach) / scale
    for e in range(len(expected)):
        gx, gy, gz = guide[expected[e], 0], guide[expected[e], 1], guide[expected[e], 2]
        x = matrix[0, 0] * gx + matrix[0, 1] * gy + matrix[0, 2] * gz
        y = matrix[1, 0] * gx + matrix[1, 1] * gy + matrix[1, 2] * gz
        z = matrix[2, 0] * gx + matrix[2, 1] * gy + matrix[2, 2] * gz
        middle, best = x / (z * scale), -2.0
        for at in range(np.searchsorted(tangent, middle - strip), len(tangent)):
            if tangent[at] > middle + strip:
                break
            k = order[at]
            cosine = seen[k, 0] * x + seen[k, 1] * y + seen[k, 2] * z
            if cosine > closest[k]:
                closest[k], nearest[k] = cosine, e
            if cosine > best:
                best, owner[e] = cosine, k
    for k in range(len(seen)):
        squared[k] = 2.0 * (1.0 - closest[k]) / (sigma[k] * scale) ** 2
        if owner[nearest[k]] != k:
            squared[k] = math.inf


@loop_helper
def _widest_difference(seen: FloatArray, reach: float) -> float:
    """Return an upper bound on the difference between the tangents of two stars at most `reach` apart.

    Between two stars, a gnomonic image is enlarged by at most 1 + t^2, where t is the larger of their
    tangents.
    """
    lowest = 1.0
    for k in range(len(seen)):
        lowest = min(lowest, seen[k, 2])
    apart = 2.0 * math.asin(min(0.5 * reach, 1.0))
    farthest = math.acos(max(lowest, -1.0)) + apart
    return apart / math.cos(farthest) ** 2 if farthest < 1.5 else math.inf


@loop_helper
def _best_gate(
    squared: FloatArray,
    nearest: IntArray,
    gates: FloatArray,
    least: int,
    enough: float,
    spread: float,
    fields: float,
    scales: float,
) -> tuple[float, float]:
    """Return the most significant gate (0 if too few stars match) and log10 of the chance matches."""
    best, bound, matched = 0.0, math.inf, least - 1
    for gate in gates:
        within, rank = _within(squared, nearest, gate)
        if len(within) <= matched:
            continue
        matched = len(within)
        for k in range(1, matched):
            place, one, two = k, within[k], rank[k]
            while place > 0 and rank[place - 1] > two:
                within[place], rank[place] = within[place - 1], rank[place - 1]
                place -= 1
            within[place], rank[place] = one, two
        value = _log10_chance(
            gate, within, rank, len(squared), spread, fields, scales, len(gates), least, enough
        )
        if best == 0.0 or value < bound:
            best, bound = gate, value
    return best, bound


@loop_helper
def _log10_chance(
    gate: float,
    stars: IntArray,
    ranks: IntArray,
    observed: int,
    spread: float,
    fields: float,
    scales: float,
    choices: int,
    least: int,
    enough: float,
) -> float:
    """Return the value of `Chance.log10` for matched stars (k,) in ascending order of their `ranks`."""
    best = math.inf
    for matched in range(len(stars), least - 1, -1):
        expected = ranks[matched - 1] + 1
        leverage = 2.0 / matched if matched > 2 else 0.5
        chance = min(expected * math.pi * gate * gate * spread / (1.0 - leverage) ** 2, 0.5)
        ring = 2.0 * math.pi / 3.0 * expected * (scales + 2.0 * gate * math.sqrt(3.0 * spread))
        unlikely = fields * expected * ring
        bright = 0
        for k in range(matched):
            bright = max(bright, stars[k] + 1)
        value = _log10_places(matched, observed, chance, fields * expected, unlikely)
        value -= math.log10(_ALL_OBSERVED)
        limited = _log10_places(matched, bright, chance, fields * expected, unlikely)
        limited += math.log10(math.pi**2 / 6.0 * (bright - matched + 1.0) ** 2 / (1.0 - _ALL_OBSERVED))
        value = min(value, limited)
        value += math.log10(choices * math.pi**2 / 6.0 * (expected - matched + 1.0) ** 2)
        if enough < value < enough + 8.0 and matched <= _MOST_ORDERED:
            value += min(0.0, math.log10(2.0 * _share_ordered(stars, matched)))
        best = min(best, value)
        if best < enough - 2.0:
            break
    return best


@loop_helper
def _log10_places(matched: int, observed: int, chance: float, attitudes: float, pairs: float) -> float:
    """Return the value of `Chance._of_places` for the probability `chance` that an observed star matches.

    The first matched star has `attitudes` possible guide stars, and the first two matched stars have `pairs`
    possible pairs of guide stars.
    """
    if matched <= observed * chance:
        return math.log10(attitudes)
    lost = observed - matched
    value = math.lgamma(observed + 1.0) - math.lgamma(matched + 1.0) - math.lgamma(lost + 1.0)
    value += (matched - 2) * math.log(chance) + lost * math.log1p(-chance)
    value -= math.log1p(-lost / (matched + 1.0) * chance / (1.0 - chance))
    return (value + math.log(pairs)) / math.log(10.0)


@loop_helper
def _share_ordered(sequence: IntArray, length: int) -> float:
    """Return the value of `order_probability` for the first `length` elements of `sequence`."""
    inversions = 0
    for place in range(length):
        for other in range(place + 1, length):
            if sequence[place] > sequence[other]:
                inversions += 1
    # The item with the index `more` adds 0 to `more` inversions, with equal probability.
    share = np.zeros(length * (length - 1) // 2 + 1)
    share[0] = 1.0
    for more in range(1, length):
        for total in range(more * (more + 1) // 2, -1, -1):
            value = 0.0
            for part in range(max(0, total - more), total + 1):
                value += share[part]
            share[total] = value / (more + 1.0)
    total_share = 0.0
    for fewer in range(inversions + 1):
        total_share += share[fewer]
    return total_share


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
