"""Tests of lost-in-space identification on synthetic star lists: identifications and refusals."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from knightcube.astro.quaternion import angle_between, attitude_matrix
from knightcube.vision.startracker import lost_in_space
from knightcube.vision.startracker.attitude_fit import (
    MatchStatus,
    StarField,
    StarMatch,
    _refined,
    stretched,
)
from knightcube.vision.startracker.index import CELLS, FINE, OCTAVE
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.lost_in_space import (
    IdentificationSettings,
    _choose,
    _look_up,
    identify,
    look_up,
    scale_steps,
)
from knightcube.vision.startracker.observed_triangles import triples
from knightcube.vision.startracker.verification import _first_match
from tests.pace import ordinary_seconds
from tests.support.compiled_forms import assert_forms_agree
from tests.support.star_lists import (
    ListKind,
    StarList,
    configurations,
    draw,
    draw_random,
    spread_field,
)

SKY = default_index()
ARCSECOND = np.pi / 648_000.0


def _drawn(kind: ListKind, seed: int) -> StarList:
    return draw(kind, SKY.stars, np.random.default_rng([97, seed]))


def _right(found: StarMatch, drawn: StarList) -> bool:
    if found.status is not MatchStatus.IDENTIFIED or found.fix is None:
        return False
    matched = found.star >= 0
    named = np.mean(found.star[matched] == drawn.star[matched])
    return bool(named > 0.8 and angle_between(found.fix.quaternion, drawn.attitude) < 0.01)


@pytest.mark.parametrize(
    "kind", configurations(), ids=lambda kind: f"{kind.field_deg}-{kind.noise_px}-{kind.false_stars}"
)
def test_every_configuration_of_the_issue_is_named(kind: ListKind) -> None:
    """The stars of each tested configuration are identified.

    The lists are a small part of the lists of `python -m tests.studies.bench starid`.
    """
    for seed in range(10):
        drawn = _drawn(kind, seed)
        assert _right(identify(drawn.field(), SKY), drawn), seed


@pytest.mark.parametrize("field_deg", [11.0, 15.0, 20.0, 25.0, 29.5])
def test_a_field_of_view_known_only_to_lie_between_10_and_30_deg_is_found(field_deg: float) -> None:
    for seed in range(6):
        drawn = _drawn(ListKind(field_deg=field_deg, noise_px=0.3, false_stars=2, known_deg=None), seed)
        found = identify(drawn.field(), SKY)
        if np.sum(drawn.star >= 0) < 6:
            continue
        assert _right(found, drawn), seed
        believed = 0.5 * 1024 / drawn.field().half_width[0]
        true = drawn.camera.focal_length
        assert abs(believed / found.scale / true - 1.0) < max(5.0 * found.scale_sigma, 1e-4)


@pytest.mark.parametrize(
    "kind",
    [
        ListKind(faintest=7.5, noise_px=0.5, false_stars=5),
        ListKind(field_deg=30.0, faintest=4.8, noise_px=0.3, false_stars=3),
        ListKind(field_deg=6.1, faintest=7.5, noise_px=0.5, false_stars=3),
        ListKind(faintest=6.5, noise_px=0.3, false_stars=3, magnitude_error=0.5, lost=0.2),
        ListKind(faintest=6.5, noise_px=0.3, false_stars=20),
        ListKind(faintest=6.5, noise_px=0.3, false_stars=5, distortion_px=4.0, known_deg=0.5),
        ListKind(faintest=6.0, noise_px=0.3, false_stars=3, order="none"),
        ListKind(field_deg=20.0, faintest=6.0, noise_px=0.3, false_stars=3, order="none"),
    ],
    ids=[
        "deep",
        "wide-and-shallow",
        "narrow",
        "scrambled",
        "half-false",
        "distorted",
        "unordered",
        "unordered-20",
    ],
)
def test_other_cameras_and_worse_detectors_are_supported(kind: ListKind) -> None:
    for seed in range(6):
        drawn = _drawn(kind, seed)
        assert _right(identify(drawn.field(), SKY), drawn), seed


@pytest.mark.parametrize(("false_stars", "least"), [(3, 6), (10, 6), (20, 5)])
def test_false_stars_brighter_than_all_true_ones_do_not_prevent_the_identification(
    false_stars: int, least: int
) -> None:
    """False stars that are brighter than all true stars do not prevent the identification.

    The lists are a small part of those of `python -m tests.studies.bench starid --hard`, with an unknown
    field of view.
    """
    right = 0
    for seed in range(6):
        drawn = _drawn(
            ListKind(field_deg=15.0, noise_px=0.3, false_stars=false_stars, bright=True, known_deg=None), seed
        )
        found = identify(drawn.field(), SKY)
        assert found.status is not MatchStatus.IDENTIFIED or _right(found, drawn), seed
        right += found.status is MatchStatus.IDENTIFIED
    assert right >= least


@pytest.mark.parametrize(("field_deg", "faintest"), [(4.5, 8.0), (7.0, 7.0), (40.0, 5.5), (58.0, 5.0)])
def test_a_field_of_view_between_4_and_60_deg_is_found(field_deg: float, faintest: float) -> None:
    kind = ListKind(
        field_deg=field_deg,
        noise_px=0.3,
        false_stars=2,
        faintest=faintest,
        known_deg=None,
        searched_deg=(4.0, 60.0),
    )
    for seed in range(5):
        drawn = _drawn(kind, seed)
        assert _right(identify(drawn.field(), SKY), drawn), seed


@pytest.mark.parametrize("known_deg", [0.1, None])
def test_random_points_are_refused(known_deg: float | None) -> None:
    kind = ListKind(known_deg=known_deg, noise_px=0.3)
    for seed in range(25):
        rng = np.random.default_rng([98, seed])
        drawn = draw_random(kind, int(rng.integers(4, 41)), rng)
        assert identify(drawn.field(), SKY).status is MatchStatus.NO_MATCH, seed


def test_a_refusal_takes_limited_time() -> None:
    """A refusal takes a limited time, at most 20 ms in `tests.studies.bench starid` on an idle machine.

    The test permits ten times this duration.
    """
    drawn = draw_random(ListKind(known_deg=None), 40, np.random.default_rng(99))
    field = drawn.field()
    identify(field, SKY)
    assert ordinary_seconds(lambda: identify(field, SKY)) < 0.2


@pytest.mark.parametrize("count", [0, 1, 3])
def test_fewer_than_four_stars_are_reported_as_too_few(count: int) -> None:
    drawn = draw_random(ListKind(), count, np.random.default_rng(count))
    assert identify(drawn.field(), SKY).status is MatchStatus.TOO_FEW_STARS


@pytest.mark.parametrize("known_deg", [0.1, None])
def test_a_mirror_image_of_the_sky_is_identified_and_reported_as_mirrored(known_deg: float | None) -> None:
    for seed in range(10):
        drawn = _drawn(ListKind(known_deg=known_deg, noise_px=0.3), seed)
        assert not identify(drawn.field(), SKY).mirrored
        found = identify(drawn.field().mirrored(), SKY)
        assert found.mirrored
        assert _right(found, drawn), seed


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_field_of_view_wrong_by_ten_percent_is_corrected_unless_trusted(factor: float) -> None:
    believed = IdentificationSettings(hint_error=1.0)
    for seed in range(5):
        drawn = _drawn(ListKind(noise_px=0.3, known_deg=0.6), seed)
        field = drawn.field().rescaled(factor)
        hinted = replace(field, scale=drawn.field().scale)
        assert _right(identify(hinted, SKY), drawn), seed
        assert identify(hinted, SKY, believed).status is MatchStatus.NO_MATCH, seed
        assert identify(replace(field, scale=(1.0, 1.0)), SKY).status is MatchStatus.NO_MATCH, seed


def test_a_camera_without_a_mirror_does_not_accept_mirror_images() -> None:
    for seed in range(5):
        field = _drawn(ListKind(), seed).field().mirrored()
        assert identify(field, SKY, IdentificationSettings(mirror=False)).status is MatchStatus.NO_MATCH, seed


def test_four_true_stars_and_nothing_else_are_enough_when_sharp() -> None:
    """Four true stars without false stars are sufficient if the positions are accurate.

    In the chosen lists, the fifth star is clearly fainter than the four brightest stars.
    """
    named = 0
    for seed in range(20):
        drawn = _drawn(ListKind(noise_px=0.1, magnitude_error=0.0), seed)
        found = identify(drawn.field().subset(np.arange(4)), SKY)
        matched = found.star >= 0
        assert not np.any(matched & (found.star != drawn.star[:4])), seed
        named += found.status is MatchStatus.IDENTIFIED
    assert named >= 15


@pytest.mark.parametrize(("field_deg", "known_deg"), [(12.0, 0.1), (28.0, None)])
def test_the_covariance_is_honest(field_deg: float, known_deg: float | None) -> None:
    """The mean of the normalised squared error is 3, as for a chi-square with three degrees of freedom.

    If the field of view is unknown, the given standard deviations refer to the assumed field of 17 deg.
    """
    squares = []
    for seed in range(150):
        kind = ListKind(field_deg=field_deg, noise_px=0.2, false_stars=2, known_deg=known_deg)
        drawn = _drawn(kind, 1000 + seed)
        found = identify(drawn.field(), SKY)
        assert found.fix is not None
        turn = attitude_matrix(found.fix.quaternion) @ attitude_matrix(drawn.attitude).T
        error = 0.5 * np.array([turn[1, 2] - turn[2, 1], turn[2, 0] - turn[0, 2], turn[0, 1] - turn[1, 0]])
        squares.append(error @ np.linalg.solve(found.fix.covariance, error))
    # The mean of 150 chi-squares with three degrees of freedom has a standard deviation of sqrt(6 / 150) =
    # 0.2.
    assert 2.3 < np.mean(squares) < 3.8


def test_standard_deviations_too_small_by_half_are_detected() -> None:
    """If standard deviations are too small by half, large residuals increase the covariance."""
    drawn = _drawn(ListKind(field_deg=20.0, noise_px=0.5), 5)
    field = drawn.field()
    honest = identify(field, SKY)
    proud = identify(replace(field, sigma=0.4 * field.sigma), SKY)
    assert honest.fix is not None
    assert proud.fix is not None
    assert np.trace(proud.fix.covariance) > 0.6 * np.trace(honest.fix.covariance)


def test_the_order_of_answers_is_that_of_the_observed_stars() -> None:
    drawn = _drawn(ListKind(), 3)
    field = drawn.field()
    order = np.random.default_rng(1).permutation(len(field))
    shuffled = identify(field.subset(order), SKY)
    assert np.array_equal(shuffled.star, identify(field, SKY).star[order])


def test_repeated_points_in_one_direction_are_not_identified() -> None:
    direction = np.tile([0.0, 0.0, 1.0], (6, 1))
    field = StarField(direction, np.full(6, 1e-4), (0.1, 0.1), (0.99, 1.01))
    assert identify(field, SKY).status is MatchStatus.NO_MATCH


@pytest.mark.parametrize(
    ("kind", "seed", "most"),
    [(ListKind(false_stars=2), 1, 600_000), (ListKind(known_deg=None), 2, 600_000), (ListKind(), 3, 300)],
)
def test_all_forms_find_the_same_matches_and_candidates_in_the_same_order(
    kind: ListKind, seed: int, most: int
) -> None:
    field = _drawn(kind, seed).field()
    scales = scale_steps(field, 0.0015)
    seen = field.direction, field.sigma
    looked_up: tuple[Any, ...] = (
        *seen,
        scales,
        triples(min(len(field), 12))[:60],
        3.0,
        0.0015,
        0.1,
        most,
        *SKY.triangles.table,
    )
    assert_forms_agree(_look_up, *looked_up)
    found: tuple[Any, ...] = _look_up.numpy_form(*looked_up)
    *matches, read = found
    assert 0 < read <= most
    tried = np.stack([matches[0][0], matches[1][0]], axis=1).astype(np.int64)
    for known in (tried[:0], tried):
        chosen = (field.direction, SKY.stars.direction, *matches, known, 12, *field.scale, OCTAVE)
        assert_forms_agree(_choose, *chosen)
        assert len(_choose.numpy_form(*chosen)[1]) > 0


@pytest.mark.parametrize("known_deg", [0.1, None])
def test_identification_by_compiled_forms_gives_the_same_answers(
    known_deg: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("numba", reason="numba is not installed: pip install knightcube[fast]")
    kind = ListKind(noise_px=0.3, false_stars=3, known_deg=known_deg)
    fields = [_drawn(kind, seed).field() for seed in range(4)]
    fields += [draw_random(kind, count, np.random.default_rng([7, count])).field() for count in (8, 25)]
    fields.append(_drawn(replace(kind, mirrored=True), 9).field())
    expected = [identify(field, SKY) for field in fields]
    for hot in (_look_up, _choose, _first_match, _refined):
        monkeypatch.setattr(hot, "_chosen", hot.compiled_form())
    for field, one in zip(fields, expected, strict=True):
        other = identify(field, SKY)
        assert (other.status, other.mirrored) == (one.status, one.mirrored)
        np.testing.assert_array_equal(other.star, one.star)
        if one.fix is not None and other.fix is not None:
            np.testing.assert_allclose(other.fix.quaternion, one.fix.quaternion, atol=1e-12)
            np.testing.assert_allclose(other.fix.covariance, one.fix.covariance, rtol=1e-6)
    assert {one.status for one in expected} == {MatchStatus.IDENTIFIED, MatchStatus.NO_MATCH}


def test_matches_are_ranked_by_the_number_of_matches_with_the_same_pairs() -> None:
    draw = np.random.default_rng(2)
    observed = draw.integers(0, 6, (300, 3)).astype(np.uint16)
    star = draw.integers(0, 9, (300, 3)).astype(np.uint16)
    # Scales from 0.97 to 1.03 count as equal, and a scale of 1.1 does not.
    like = draw.choice([0, 1], 300)
    factor = np.where(like, 1.1, draw.choice([0.97, 1.0, 1.03], 300))
    scale = np.floor(np.log2(factor) * OCTAVE).astype(np.int32)
    keys = [
        [(one, two, like[k]) for one, two in zip(observed[k].tolist(), star[k].tolist(), strict=True)]
        for k in range(300)
    ]
    pairs = [pair for match in keys for pair in match]
    expected = [sum(pairs.count(pair) for pair in match) for match in keys]
    assert lost_in_space._votes(observed, star, scale).tolist() == expected
    assert lost_in_space._counted_votes(observed, star, scale).tolist() == expected
    order = sorted(range(300), key=lambda k: (-expected[k], k))
    assert lost_in_space._most_voted(np.array(expected), 25).tolist() == order[:25]


def test_the_frame_of_three_directions_rotates_with_them() -> None:
    draw = np.random.default_rng(6)
    corners = draw.normal(size=(3, 3)) * 0.1 + np.array([0.3, -0.2, 0.9])
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    frame = lost_in_space._frame(corners)
    assert frame @ frame.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    middle = corners.sum(axis=0)
    assert frame[0] == pytest.approx(middle / np.linalg.norm(middle))
    # The second axis lies in the plane of the centre and the difference of the first two directions.
    assert frame[1] @ (corners[0] - corners[1]) > 0.0
    assert frame[2] @ (corners[0] - corners[1]) == pytest.approx(0.0, abs=1e-12)
    turn = attitude_matrix(np.array([0.1, -0.5, 0.3, 0.8]) / np.linalg.norm([0.1, -0.5, 0.3, 0.8]))
    assert lost_in_space._frame(corners @ turn.T) == pytest.approx(frame @ turn.T)
    columns = np.ascontiguousarray(corners.T)
    lost_in_space._into_frame(columns)
    assert pytest.approx(frame) == columns.T


def test_candidates_are_the_attitudes_of_the_matches_with_the_most_votes() -> None:
    """A candidate has the attitude of its match; a match with two known pairs is not a new candidate."""
    turn = attitude_matrix(np.array([0.2, 0.4, -0.1, 0.9]) / np.linalg.norm([0.2, 0.4, -0.1, 0.9]))
    field = spread_field(8)
    guide = stretched(field.direction, 1.04) @ turn
    observed = np.array([[0, 1, 2], [0, 1, 3], [4, 5, 6], [4, 5, 6], [7, 3, 2]], dtype=np.uint16)
    star = np.array([[0, 1, 2], [0, 1, 3], [4, 5, 6], [5, 4, 6], [7, 3, 2]], dtype=np.uint16)
    scale = np.full(5, round(math.log2(1.04) * 1_000_000_000), dtype=np.int32)
    none = np.zeros((0, 2), dtype=np.int64)
    arguments = field.direction, guide, observed, star, scale
    for form in (_choose.numpy_form, _choose.loop_form):
        matrices, scales, tried = form(*arguments, none, 9, 0.9, 1.02, 1_000_000_000)
        # The second match shares two pairs with the first.
        assert len(matrices) == 4
        assert matrices[0] == pytest.approx(turn, abs=1e-9)
        assert matrices[1] == pytest.approx(turn, abs=1e-9) or matrices[2] == pytest.approx(turn, abs=1e-9)
        assert scales.tolist() == [1.02] * 4
        assert tried.shape == (12, 2)
        assert sorted(map(tuple, tried[:3].tolist())) == [(0, 0), (1, 1), (2, 2)]
        known = np.array([[4, 4], [5, 5], [0, 0], [1, 1], [2, 2]])
        matrices, scales, tried = form(*arguments, known, 1, 1.05, 1.2, 1_000_000_000)
        assert len(matrices) == 1
        assert scales.tolist() == [1.05]
        assert tried.shape == (8, 2)
        assert tried[:5].tolist() == known.tolist()


@pytest.mark.parametrize("scale", [1.0, 0.93])
def test_a_triangle_of_guide_stars_is_found_in_the_index(scale: float) -> None:
    """A triangle of the index is found with its guide stars and the scale of the image.

    A mirrored triangle is not found.
    """
    star_of = SKY.triangles.corners
    draw = np.random.default_rng(4)
    found = mirrored = 0
    for entry in draw.choice(len(star_of), 12, replace=False):
        names = star_of[entry].astype(np.int64)
        frame = lost_in_space._frame(SKY.stars.direction[names])
        seen = SKY.stars.direction[names] @ np.stack([frame[1], frame[2], frame[0]]).T
        seen = stretched(seen, 1.0 / scale)
        order = draw.permutation(3)
        width = float(np.abs(seen[:, :2] / seen[:, 2:]).max()) + 0.01
        limits = (scale, scale) if scale == 1.0 else (0.9, 0.96)
        field = StarField(seen[order], np.full(3, 1e-6), (width, width), limits)
        scales = scale_steps(field, 0.0015)
        matches, read = look_up(field, SKY, scales, np.array([[0, 1, 2]]), 3.0, 0.0015, 10_000_000)
        assert read >= len(matches)
        factors = 2.0 ** (matches.scale / OCTAVE)
        for corners, names_found, at in zip(matches.observed, matches.star, factors, strict=True):
            assert limits[0] * (1.0 - 0.02) <= at <= limits[1] * (1.0 + 0.02)
            if names_found.tolist() == names[order][corners].tolist() and set(names_found) == set(names):
                found += 1
                assert at == pytest.approx(scale, rel=2e-3)
                break
        matches, _ = look_up(field.mirrored(), SKY, scales, np.array([[0, 1, 2]]), 3.0, 0.0015, 10_000_000)
        mirrored += any(set(row) == set(names) for row in matches.star.tolist())
    assert found == 12
    assert mirrored == 0


def test_sides_of_triangles_are_sorted_with_their_opposite_corners() -> None:
    """The first corner is opposite to the shortest side; the orientation refers to the sorted corners."""
    field, triangles = spread_field(9), triples(9)
    scales = np.random.default_rng(3).uniform(0.9, 1.15, len(triangles))
    corners, sides, left = lost_in_space._forms(field.direction, triangles, scales)
    for row, (abc, three, is_left) in enumerate(zip(corners, sides, left, strict=True)):
        assert sorted(abc.tolist()) == triangles[row].tolist()
        at = stretched(field.direction[abc], float(scales[row]))
        opposite = [np.linalg.norm(at[(k + 1) % 3] - at[(k + 2) % 3]) for k in range(3)]
        assert three == pytest.approx(opposite)
        assert np.all(np.diff(three) >= 0.0)
        (ax, ay), (bx, by), (cx, cy) = field.direction[abc, :2] / field.direction[abc, 2:]
        assert is_left == ((bx - ax) * (cy - ay) - (cx - ax) * (by - ay) > 0.0)
        corner, side = triangles[row].copy(), np.empty(3)
        lost_in_space._sort_sides(field.direction, float(scales[row]), corner, side)
        assert corner.tolist() == abc.tolist()
        assert side == pytest.approx(three)
        assert lost_in_space._is_left(field.direction, corner) == is_left


def test_scale_steps_are_joined_while_side_ratios_are_nearly_constant() -> None:
    """The side ratios at the limits of joined steps differ from the ratios in the middle by the tolerance.

    Together, the joined ranges cover all scale steps. The ratios of small triangles near the axis change
    least.
    """
    tangent = np.array([[0.0, 0.0], [0.02, 0.0], [0.01, 0.03], [0.28, 0.3], [-0.3, 0.2], [-0.1, -0.28]])
    direction = np.column_stack([tangent, np.ones(6)])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    field = StarField(direction, np.full(6, 1e-5), (0.3, 0.3), (0.4, 1.6))
    scales, triangles = scale_steps(field, 0.0015), triples(6)
    steps = len(scales) // 2
    assert scales[[0, -1]] == pytest.approx([0.4, 1.6])
    number, begin, end = lost_in_space._joined_steps(direction, triangles, scales, 0.0015)
    ratios = []
    for at in (2 * begin, begin + end, 2 * end):
        _, sides, _ = lost_in_space._forms(direction, triangles[number], scales[at])
        ratios.append(sides[:, :2] / sides[:, 2:])
    wide = end - begin > 1
    assert wide.any()
    assert np.abs(np.array(ratios) - ratios[1])[:, wide].max() < 1.15 * 0.0015
    counts = np.bincount(number)
    for triangle in range(len(triangles)):
        own = number == triangle
        assert begin[own][0] == 0
        assert end[own][-1] == steps
        assert np.array_equal(begin[own][1:], end[own][:-1])
        joined = lost_in_space._joined(direction, scales, 0.0015, triangles[triangle].copy(), np.empty(3))
        assert joined == (end - begin)[own][0]
    assert counts[0] == counts.min() < counts.max()


def test_places_are_those_within_the_tolerance_of_a_ratio() -> None:
    """The ranges contain all positions whose intervals overlap the tolerances of both side ratios."""
    draw = np.random.default_rng(5)
    *_, below, layout = SKY.triangles.table
    for _ in range(40):
        short, medium, slack = draw.uniform(0.2, 0.9), draw.uniform(0.2, 0.9), draw.uniform(1e-4, 8e-3)
        runs, windows = np.zeros((25, 3), dtype=np.int32), np.zeros((25, 2), dtype=np.uint32)
        count = lost_in_space._add_runs(
            1, short, medium, slack, 10_000.5, 30_000.5, below, layout, runs, windows
        )
        assert (windows[:count] >> 16 == [10_000, 30_000]).all()
        for shift, ratio in ((8, short), (0, medium)):
            widths = [
                high - low + 1 for low, high in (windows[:count].astype(np.int64) >> shift & 255).tolist()
            ]
            edges = np.arange(CELLS * FINE) / (CELLS * FINE)
            near = (edges + 1.0 / (CELLS * FINE) > ratio - slack) & (edges <= ratio + slack)
            cells = len(np.unique(np.flatnonzero(near) // FINE))
            assert sum(widths) * cells == np.count_nonzero(near) * count


def test_a_mirrored_field_or_a_wrong_scale_is_searched_only_if_allowed() -> None:
    drawn = _drawn(ListKind(noise_px=0.2), 12)
    field = drawn.field()
    assert identify(field, SKY).status is MatchStatus.IDENTIFIED
    assert identify(field.subset(np.arange(2)), SKY).status is MatchStatus.TOO_FEW_STARS
    mirror = identify(field.mirrored(), SKY)
    assert mirror.mirrored
    assert mirror.status is MatchStatus.IDENTIFIED
    only = IdentificationSettings(mirror=False)
    assert identify(field.mirrored(), SKY, only).status is MatchStatus.NO_MATCH
    wrong = replace(field.rescaled(1.15), scale=(0.98, 1.02))
    found = identify(wrong, SKY)
    assert found.status is MatchStatus.IDENTIFIED
    assert not found.mirrored
    assert found.scale == pytest.approx(1.0 / 1.15, rel=0.02)
    trusted = IdentificationSettings(hint_error=1.0)
    assert identify(wrong, SKY, trusted).status is MatchStatus.NO_MATCH
