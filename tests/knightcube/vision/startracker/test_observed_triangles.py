"""Tests of the choice of triangles of observed stars."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import IntArray
from knightcube.vision.startracker.attitude_fit import StarField
from knightcube.vision.startracker.observed_triangles import (
    _MIDDLE_SIZES,
    BatchSizes,
    _of_sizes,
    batches_of,
    middle_sized,
    neighbours,
    spread_batches,
    triples,
)
from tests.support.compiled_forms import assert_forms_agree
from tests.support.star_lists import spread_field


def test_the_triangles_of_neighbours_join_a_star_with_two_of_its_five_nearest() -> None:
    """The triangles join each star with two of its five nearest neighbours.

    The stars are on a great circle at increasing distances, so the neighbours can be counted by hand.
    """
    angle = np.cumsum(np.arange(1, 46)) * 1e-4
    direction = np.stack([np.sin(angle), np.zeros(45), np.cos(angle)], axis=1)
    field = StarField(direction, np.full(45, 1e-5), (0.2, 0.2))
    expected = set()
    # Only the 40 brightest stars are centres of triangles.
    for centre in range(40):
        near = sorted(range(45), key=lambda other: abs(angle[other] - angle[centre]))[1:6]
        expected |= {tuple(sorted((centre, a, b))) for a in near for b in near if a < b}
    found = neighbours(field)
    assert {tuple(row) for row in found.tolist()} == expected
    assert len(found) == len(expected)


def test_all_triangles_of_a_field_occur_once_the_brightest_first() -> None:
    found = triples(6)
    assert len({tuple(row) for row in found.tolist()}) == len(found) == 20
    assert all(a < b < c for a, b, c in found.tolist())
    assert found[:, 2].tolist() == sorted(found[:, 2].tolist())


def test_batches_begin_with_triangles_of_the_brightest_stars() -> None:
    """The first batches have their stated sizes, divided by the root of the number of scale steps.

    Triangles with faint stars follow, and are computed last.
    """
    asked = []
    faint = np.array([[3, 4, 5]])

    def spread() -> list[IntArray]:
        asked.append(True)
        return [faint, faint[:0]]

    sizes = BatchSizes((60, 100), (40, 80))
    found = batches_of(spread_field(30), sizes, 1, spread)
    first, second = next(found), next(found)
    assert not asked
    whole = triples(12)
    assert np.array_equal(first[0], whole[:60])
    assert np.array_equal(second[0], whole[60:160])
    assert not first[1]
    assert not second[1]
    ((third, with_faint),) = found
    assert np.array_equal(third, faint)
    assert with_faint
    steps = [len(triangles) for triangles, _ in batches_of(spread_field(30), sizes, 4, spread)]
    assert steps == [30, 50, 1]
    assert [len(t) for t, _ in batches_of(spread_field(30), sizes, 10_000, spread)] == [20, 20, 1]
    # All ten triangles of five stars are in the first batch.
    assert [len(t) for t, _ in batches_of(spread_field(5), sizes, 1, spread)] == [10]
    assert [len(t) for t, _ in batches_of(spread_field(12), sizes, 1, spread)] == [60, 100, 1]


@pytest.mark.parametrize(("most", "least"), [(400, 100), (10_000, 100), (10_000, 9_000), (50, 80)])
def test_the_compiled_choice_of_triangles_equals_that_in_numpy(most: int, least: int) -> None:
    for count in (3, 40, 70):
        triangles = triples(min(count, 64), shuffled=True)
        given = spread_field(count).direction, triangles, 0.04, 0.1, 0.15, most, least
        assert_forms_agree(_of_sizes, *given, interpreted=count < 70, compiled=most == 400)


def test_spread_batches_contain_triangles_of_medium_size() -> None:
    """The longest side of a triangle of medium size is between 0.2 and 0.5 field widths.

    Larger triangles follow only if the field has too few triangles of medium size. Triangles of neighbours
    are added if the field has many points, or points of unknown magnitude.
    """
    field, sizes = spread_field(40), BatchSizes((10,), (100, 300))
    chosen = middle_sized(field, 400, 100)
    assert len(chosen) == 400
    assert len({tuple(row) for row in chosen.tolist()}) == 400
    corner = field.direction[chosen]
    sides = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
    lowest, highest, largest = _MIDDLE_SIZES
    assert sides.min() >= 0.2 * lowest
    assert sides.max() <= 0.2 * highest
    every = triples(40)
    corner = field.direction[every]
    sides = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
    fitting = int(np.count_nonzero((sides >= 0.2 * lowest) & (sides <= 0.2 * highest)))
    assert len(middle_sized(field, 100_000, 100)) == fitting
    more = middle_sized(field, 100_000, fitting + 50)
    assert np.array_equal(more[:fitting], middle_sized(field, 100_000, 0))
    assert len({tuple(row) for row in more.tolist()}) == fitting + 50
    corner = field.direction[more[fitting:]]
    sides = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
    assert sides.min() > 0.2 * highest
    assert sides.max() <= 0.2 * largest
    first, second = spread_batches(field, sizes)
    assert np.array_equal(first, chosen[:100])
    assert np.array_equal(second[:300], chosen[100:])
    assert np.array_equal(second[300:], neighbours(field))
    ranked = spread_batches(spread_field(40, magnitude=True), sizes)
    assert [len(batch) for batch in ranked] == [100, 300]
    assert len(spread_batches(spread_field(65, magnitude=True), sizes)[1]) > 300
    assert len(spread_batches(spread_field(64, magnitude=True), sizes)[1]) == 300
    assert triples(7, shuffled=True).tolist() != triples(7).tolist()
    assert sorted(triples(7, shuffled=True).tolist()) == sorted(triples(7).tolist())
