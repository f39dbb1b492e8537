"""Tests of the bound on matches by chance, and of the verification."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from knightcube.astro.quaternion import (
    attitude_matrix,
    from_rotation_vector,
    multiply,
    normalise,
)
from knightcube.vision.startracker.attitude_fit import MatchStatus
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.verification import (
    Chance,
    _expected,
    _first_match,
    order_probability,
    verify,
)
from tests.support.compiled_forms import assert_forms_agree
from tests.support.star_lists import ListKind, StarList, draw


@pytest.mark.parametrize("length", [1, 2, 3, 5])
def test_the_probability_of_an_order_is_that_of_enumeration(length: int) -> None:
    orders = list(itertools.permutations(range(length)))

    def inversions(order: tuple[int, ...]) -> int:
        return sum(a > b for a, b in itertools.combinations(order, 2))

    for order in orders[:: max(1, len(orders) // 20)]:
        fewer = sum(inversions(other) <= inversions(order) for other in orders)
        assert math.isclose(order_probability(order), fewer / len(orders))


def _chance(observed: int, spread: float) -> Chance:
    return Chance(observed, spread, 1.0, 0.0, 1, 3, 0.0)


def test_the_bound_is_not_below_the_frequency_of_matches_of_random_stars() -> None:
    """Random star sets match no more often than the bound states.

    Sky and image are random sets of ten stars in a unit square, each in a random order of brightness. All
    rotations and shifts at a known scale are tried: every pair of image stars is aligned with every sky pair
    of equal length. For some limits, the fraction of trials whose lowest bound is below the limit is compared
    with the limit.
    """
    rng = np.random.default_rng(5)
    sigma, gate, stars, trials = 0.004, 3.0, 10, 150
    chance, bounds = _chance(stars, sigma**2), np.full(trials, np.inf)
    for trial in range(trials):
        sky, seen = (rng.uniform(size=stars) + 1j * rng.uniform(size=stars) for _ in range(2))
        for a, b in itertools.permutations(range(stars), 2):
            side = seen[b] - seen[a]
            turn = (sky[None, :] - sky[:, None]) / side + 10.0 * np.eye(stars)
            for i, j in np.argwhere(np.abs(np.abs(turn) - 1.0) * abs(side) < 2.0 * gate * sigma):
                rotation = turn[i, j] / abs(turn[i, j])
                laid = rotation * (seen - 0.5 * (seen[a] + seen[b])) + 0.5 * (sky[i] + sky[j])
                apart = np.abs(laid[:, None] - sky)
                near = np.flatnonzero(apart.min(axis=1) < gate * sigma)
                if len(set(ranks := apart[near].argmin(axis=1).tolist())) == len(near) >= 3:
                    bounds[trial] = min(bounds[trial], chance.log10(gate, near.tolist(), ranks))
    for bound in (0.01, 0.1, 0.3):
        assert np.mean(bounds < math.log10(bound)) < bound + 3.0 * math.sqrt(bound / trials)


def test_the_brightest_stars_count_more_than_as_many_stars_of_any_brightness() -> None:
    chance = _chance(40, 1e-6)
    brightest, any_stars = (chance.log10(3.0, observed, range(5)) for observed in (range(5), range(0, 40, 8)))
    assert brightest < any_stars - 3.0


def test_more_matches_are_less_likely_and_wider_gates_more() -> None:
    chance = _chance(20, 1e-8)
    values = [chance._of_places(3.5, matched, 20, 20) for matched in range(4, 15)]
    assert np.all(np.diff(values) < 0.0)
    assert chance._of_places(8.0, 6, 20, 20) > chance._of_places(3.5, 6, 20, 20)


SKY = default_index()


def _drawn(kind: ListKind, seed: int) -> StarList:
    return draw(kind, SKY.stars, np.random.default_rng([96, seed]))


def test_the_truth_verifies_and_its_false_stars_are_left_out() -> None:
    drawn = _drawn(ListKind(noise_px=0.2, false_stars=5, known_deg=0.1), 4)
    field = drawn.field()
    scale = 0.5 * 1024 / drawn.camera.focal_length / field.half_width[0]
    found = verify(field, SKY, attitude_matrix(drawn.attitude), scale)
    assert found.status is MatchStatus.IDENTIFIED
    wrong = (found.star >= 0) & (found.star != drawn.star)
    assert wrong.sum() <= 1
    assert np.mean(found.star[drawn.star >= 0] >= 0) > 0.9


def test_an_attitude_off_by_half_a_degree_does_not_verify() -> None:
    drawn = _drawn(ListKind(noise_px=0.2), 6)
    off = from_rotation_vector(np.deg2rad([0.5, 0.0, 0.0]))
    assert (
        verify(drawn.field(), SKY, attitude_matrix(multiply(off, drawn.attitude)), 1.0).status
        is MatchStatus.NO_MATCH
    )


def test_few_stars_that_verify_near_a_prior_may_be_chance_in_the_whole_sky() -> None:
    """A few stars that verify an attitude near a prior may match by chance in the whole sky.

    The bound depends on the searched area. Four stars with large errors are sufficient in tracking, but not
    lost in space.
    """
    convinced = {"tracking": 0, "lost": 0}
    for seed in range(15):
        drawn = _drawn(ListKind(noise_px=1.0, magnitude_error=0.0, known_deg=0.1), seed)
        field = drawn.field().subset(np.arange(4))
        scale = 0.5 * 1024 / drawn.camera.focal_length / field.half_width[0]
        for case, searched in (("tracking", 1e-9), ("lost", 1.0)):
            found = verify(field, SKY, attitude_matrix(drawn.attitude), scale, searched)
            convinced[case] += found.status is MatchStatus.IDENTIFIED
    assert convinced["tracking"] >= 12
    assert convinced["lost"] <= 5


@pytest.mark.parametrize("limit", [2.5, math.inf, -400.0])
def test_all_forms_match_the_same_stars_of_the_same_candidate(limit: float) -> None:
    drawn = draw(ListKind(noise_px=0.4, false_stars=4), SKY.stars, np.random.default_rng([41, 3]))
    field, rng = drawn.field(), np.random.default_rng(8)
    true = attitude_matrix(drawn.attitude)
    strange = [attitude_matrix(normalise(rng.normal(size=4))) for _ in range(5)]
    scales = np.array([*rng.uniform(0.7, 1.5, 5), 1.0])
    facts = 0.1, 0.1, math.log(field.scale[1] / field.scale[0]), 1.0, np.array([3.5, 8.0, 20.0]), 4, -4.5
    table = SKY.stars.direction, SKY.coarse, *SKY.boxes
    for matrices in (np.array([*strange, true]), np.array([true, *strange])):
        for expected in (np.empty(0, dtype=np.int64), np.unique(drawn.star[drawn.star >= 0])):
            given = field.direction, field.sigma, matrices, scales, *facts, limit, expected, *table
            assert_forms_agree(_first_match, *given, relative=1e-6)


def test_all_forms_expect_the_same_stars() -> None:
    table = SKY.stars.direction, SKY.coarse, *SKY.boxes
    for seed, across, count in ((1, 0.1, 40), (2, 0.3, 500), (3, 0.05, 8)):
        matrix = attitude_matrix(normalise(np.random.default_rng(seed).normal(size=4)))
        assert_forms_agree(_expected, *table, matrix, across, 0.7 * across, count, compiled=seed == 1)


def test_attitudes_that_are_not_numbers_match_no_star_in_any_form() -> None:
    field = draw(ListKind(), SKY.stars, np.random.default_rng([41, 5])).field()
    facts = 0.1, 0.1, 0.0, 1.0, np.array([3.5, 8.0, 20.0]), 4, -4.5, math.inf
    matrices, scales = np.full((1, 3, 3), np.nan), np.ones(1)
    for expected in (np.empty(0, dtype=np.int64), np.arange(30)):
        table = SKY.stars.direction, SKY.coarse, *SKY.boxes
        given = field.direction, field.sigma, matrices, scales, *facts, expected, *table
        assert _first_match.numpy_form(*given)[0] == -1
        # The interpreter cannot convert NaN to the index of a box of the star table.
        assert_forms_agree(_first_match, *given, interpreted=len(expected) > 0)
