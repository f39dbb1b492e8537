"""Tests of the k-vector and the pair table against exhaustive searches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from knightcube.astro.arrays import FloatArray
from knightcube.reference import star_tables
from knightcube.reference.star_tables import PairTable, cosine_sigma
from knightcube.vision.startracker.index import GuideStars

_KEYS = arrays(
    np.float64,
    st.integers(0, 60),
    elements=st.floats(-3.0, 3.0, allow_subnormal=False).map(lambda x: round(x, 2)),
)
_ENDS = st.lists(st.tuples(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0)), min_size=1, max_size=8)


def _found_by_hand(key: FloatArray, low: float, high: float) -> list[int]:
    return [place for place, value in enumerate(key) if low <= value < high]


@settings(max_examples=40, deadline=None)
@given(drawn=_KEYS, ends=_ENDS, cells=st.one_of(st.none(), st.integers(1, 90)))
def test_ranges_hold_the_keys_that_a_search_through_all_finds(
    drawn: FloatArray, ends: list[tuple[float, float]], cells: int | None
) -> None:
    """A range contains the keys that an exhaustive search finds.

    Keys are often equal, cells are few or many, and ranges may be empty, reversed or beyond all keys.
    """
    key = np.sort(drawn)
    index = star_tables.build_k_vector(key, cells)
    start, stop = index.ranges([low for low, _ in ends], [high for _, high in ends])
    for (low, high), begin, end in zip(ends, start, stop, strict=True):
        assert list(range(begin, end)) == _found_by_hand(key, low, high)


@settings(max_examples=40, deadline=None)
@given(drawn=_KEYS.filter(lambda key: len(key) > 1), first=st.integers(0, 59), last=st.integers(0, 59))
def test_a_key_that_is_the_low_end_is_in_and_one_that_is_the_high_end_is_out(
    drawn: FloatArray, first: int, last: int
) -> None:
    key = np.sort(drawn)
    low, high = sorted((key[first % len(key)], key[last % len(key)]))
    start, stop = star_tables.build_k_vector(key).ranges(low, high)
    assert list(range(start[0], stop[0])) == _found_by_hand(key, low, high)


def test_a_million_skewed_keys_agree_with_bisection() -> None:
    """A search among a million float32 keys, nearly all in a few cells, agrees with bisection.

    Some of the searched values are keys themselves.
    """
    rng = np.random.default_rng(11)
    key = np.sort(rng.exponential(1.0, 1_000_000).astype(np.float32) ** 4)
    ends = np.concatenate([rng.choice(key, 400).astype(np.float64), rng.uniform(-1.0, 1.1 * key[-1], 400)])
    start, _ = star_tables.build_k_vector(key).ranges(ends, np.inf)
    np.testing.assert_array_equal(start, np.searchsorted(key.astype(np.float64), ends))


def test_no_keys_have_empty_ranges_and_infinite_ends_hold_all_keys() -> None:
    start, stop = star_tables.build_k_vector(np.empty(0)).ranges([0.0], [1.0])
    assert start == stop
    start, stop = star_tables.build_k_vector(np.array([1.0, 1.0, 1.0])).ranges(-np.inf, np.inf)
    assert (start[0], stop[0]) == (0, 3)


def test_keys_out_of_order_and_ends_that_are_not_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match="ascending"):
        star_tables.build_k_vector(np.array([2.0, 1.0]))
    with pytest.raises(ValueError, match="finite"):
        star_tables.build_k_vector(np.array([1.0, np.nan]))
    with pytest.raises(ValueError, match="at least one"):
        star_tables.build_k_vector(np.array([1.0]), 0)
    with pytest.raises(ValueError, match="NaN"):
        star_tables.build_k_vector(np.array([1.0])).ranges(np.nan, 1.0)


def test_members_of_ranges_are_consecutive_and_have_the_number_of_their_range() -> None:
    place, owner = star_tables.members(np.array([3, 7, 0]), np.array([5, 7, 3]))
    assert place.tolist() == [3, 4, 0, 1, 2]
    assert owner.tolist() == [0, 0, 2, 2, 2]


def _sky(count: int) -> GuideStars:
    rng = np.random.default_rng(4)
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return GuideStars(
        np.arange(1, count + 1, dtype=np.int32), direction, np.sort(rng.uniform(0.0, 6.0, count)), 2026.5
    )


@pytest.fixture(scope="module")
def table() -> PairTable:
    """Return the pairs of 300 stars within 0.4 rad."""
    return star_tables.build_pairs(_sky(300), 0.4)


def test_the_table_has_every_pair_within_the_widest_angle_and_no_other(table: PairTable) -> None:
    """The table contains every pair within the largest angle, and no other pair, up to float32.

    The expected angles are the arc cosines of all products.
    """
    direction = _sky(300).direction
    one, other = np.triu_indices(300, 1)
    angle = np.arccos(np.clip(np.sum(direction[one] * direction[other], axis=-1), -1.0, 1.0))
    near = angle < 0.4
    expected = {(int(i), int(j)) for i, j in zip(one[near], other[near], strict=True)}
    assert {(int(i), int(j)) for i, j in zip(table.first, table.second, strict=True)} == expected
    assert len(table) == len(expected)
    assert table.first.dtype == np.uint16
    stored = np.sum(direction[table.first] * direction[table.second], axis=-1)
    np.testing.assert_allclose(np.cos(table.angle.key.astype(float)), stored, atol=3e-8)


def test_a_range_of_angles_returns_its_pairs_both_ways_round(table: PairTable) -> None:
    first, second, owner = table.between([0.1, 0.3], [0.11, 0.32])
    angle = star_tables.angles(_sky(300).direction[first], _sky(300).direction[second])
    assert np.all(
        (angle >= np.array([0.1, 0.3])[owner] - 1e-7) & (angle < np.array([0.11, 0.32])[owner] + 1e-7)
    )
    forward = {(int(i), int(j)) for i, j in zip(first, second, strict=True)}
    assert forward == {(j, i) for i, j in forward}
    assert len(forward) == len(first) > 20


def test_the_magnitude_limit_gives_the_wanted_number_of_stars_in_a_field() -> None:
    stars = _sky(300)
    limit = star_tables.faintest_for(stars, 4.0 * np.pi / 30.0, 5.0)
    assert len(stars.brighter_than(limit)) == 150
    assert len(stars.brighter_than(star_tables.faintest_for(stars, 0.01, 50.0))) == 300


@pytest.mark.parametrize("degrees", [0.01, 0.1, 5.0, 90.0])
def test_the_variance_of_a_cosine_is_that_of_drawn_pairs(degrees: float) -> None:
    """The variance of a pair's cosine equals the sample variance, even at separations like the errors.

    The 20,000 random draws determine the standard deviation to within 1.5 % (3 sigma).
    """
    rng = np.random.default_rng(4)
    sigma = np.radians([0.02, 0.05])
    first, second = np.array([1.0, 0.0, 0.0]), np.array([np.cos(np.radians(degrees)), 0.0, 0.0])
    second[1] = np.sin(np.radians(degrees))
    noise = [s * rng.standard_normal((20_000, 3)) for s in sigma]
    across = [n - (n @ b)[:, None] * b for n, b in zip(noise, (first, second), strict=True)]
    measured = np.sum((first + across[0]) * (second + across[1]), axis=1)
    cosine = np.array([first @ second])
    expected = cosine_sigma(cosine, sigma[:1], sigma[1:])[0]
    assert np.std(measured) == pytest.approx(expected, rel=0.03)
