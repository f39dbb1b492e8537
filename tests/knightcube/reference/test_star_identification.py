"""Tests of star identification by each reference method, and of image matching."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.solvers import SOLVERS
from knightcube.astro.attitude.wahba import AttitudeError
from knightcube.astro.catalogue import load
from knightcube.astro.quaternion import (
    angle_between,
    attitude_matrix,
    from_rotation_vector,
    multiply,
    normalise,
)
from knightcube.reference import star_identification
from knightcube.reference.star_identification import (
    DEFAULT,
    DEFAULT_METHOD,
    METHODS,
    FieldUnknown,
    PreviousAttitude,
    Propose,
    StarMotion,
    cycled_triangles,
    identify_by_rate,
    match_images,
    propose_angles,
    propose_pyramids,
    search,
    shared_rate,
    views,
)
from knightcube.reference.star_tables import KnownSky, side_lengths
from knightcube.vision.startracker.attitude_fit import MatchStatus, StarMatch
from knightcube.vision.startracker.index import SkyIndex, TriangleIndex, choose_guide_stars
from tests.support.star_lists import ListKind, StarList, draw, draw_random

CLASSICAL = sorted(set(METHODS) - {DEFAULT_METHOD})
LISTS = 8


@lru_cache(maxsize=1)
def _sky() -> KnownSky:
    """Return the guide stars of a 15 deg field, without the triangles of the default method."""
    stars = choose_guide_stars(load(), 7.0, 2026.5, float(np.deg2rad(40.0 / 3600.0)))
    none = TriangleIndex(np.zeros(0, np.uint32), np.zeros((0, 3), np.uint16), np.zeros((0, 2), np.uint8))
    half = float(np.tan(np.deg2rad(7.5)))
    return KnownSky(SkyIndex(stars, np.zeros((len(stars), 3), np.float32), none), (half, half))


def _kind(**changes: float) -> ListKind:
    base = ListKind(field_deg=15.0, noise_px=0.1, known_deg=0.0, faintest=float(_sky().stars.magnitude[-1]))
    return replace(base, **changes)  # type: ignore[arg-type]  # each change is one of the fields


def _drawn(kind: ListKind, seed: int) -> list[StarList]:
    rng = np.random.default_rng(seed)
    return [draw(kind, _sky().index.stars, rng) for _ in range(LISTS)]


def _right(answer: StarMatch, drawn: StarList) -> bool:
    """Return whether all identifications are true, and the attitude error is below ten sigmas of a star."""
    if answer.status is not MatchStatus.IDENTIFIED or answer.fix is None:
        return False
    claimed = answer.star >= 0
    off = angle_between(answer.fix.quaternion, drawn.attitude)
    # For the rotation about the boresight, the error of a star is divided by its distance of 0.1 rad from the
    # boresight.
    return bool(
        np.all(answer.star[claimed] == drawn.star[claimed])
        and off < 10.0 * drawn.kind.noise_px / drawn.camera.focal_length / 0.1
    )


@pytest.mark.parametrize("name", CLASSICAL)
def test_the_stars_of_a_clean_list_are_all_found(name: str) -> None:
    """With 0.1 px of noise, all identifications are right, and nearly all guide stars are identified."""
    for drawn in _drawn(_kind(), 1):
        answer = METHODS[name].identify(drawn.field(), _sky())
        assert _right(answer, drawn)
        assert np.mean(answer.star >= 0) > 0.9


def test_limits_of_cosines_admit_the_pairs_that_limits_of_angles_admit() -> None:
    """Limits of cosines by Michalski's eq. 31 agree with limits of angles to 1 %, for pairs 30 sigma apart.

    For blended stars, the limits of cosines are wider.
    """
    drawn = _drawn(_kind(noise_px=0.3), 6)[0]
    view = next(views(drawn.field(), DEFAULT))
    one, other = (np.array(index) for index in zip(*combinations(range(view.stars), 2), strict=True))
    angle, low, high = view.angles(one, other, 3.0)
    _, cosine_low, cosine_high = replace(view, cosine_limits=True).angles(one, other, 3.0)
    assert np.all(angle > 30.0 * view.sigma.max())
    assert cosine_high - cosine_low == pytest.approx(high - low, rel=0.01)
    same = np.zeros(1, dtype=int)
    assert replace(view, cosine_limits=True).angles(same, same, 3.0)[2][0] > 0.0
    answer = search(drawn.field(), _sky(), propose_angles, replace(DEFAULT, cosine_limits=True))
    assert _right(answer, drawn)


@pytest.mark.parametrize("name", CLASSICAL)
def test_lists_with_false_and_missing_stars_are_identified(name: str) -> None:
    """With two false stars and a tenth missing, at most one list is refused, and no result is wrong."""
    answers = [
        (METHODS[name].identify(d.field(), _sky()), d) for d in _drawn(_kind(false_stars=2, lost=0.1), 2)
    ]
    right = [_right(answer, drawn) for answer, drawn in answers]
    refused = [answer.status is MatchStatus.NO_MATCH for answer, _ in answers]
    assert sum(right) >= LISTS - 1
    assert sum(right) + sum(refused) == LISTS


@pytest.mark.parametrize("name", CLASSICAL)
def test_lists_with_half_a_pixel_of_noise_are_identified(name: str) -> None:
    """With half a pixel of noise, stars are identified although a pair has many possible partners."""
    lists = _drawn(_kind(noise_px=0.5, false_stars=2, lost=0.1), 3)
    answers = [METHODS[name].identify(drawn.field(), _sky()) for drawn in lists]
    assert all(answer.fix is None or _right(answer, one) for answer, one in zip(answers, lists, strict=True))
    assert sum(answer.fix is not None for answer in answers) >= LISTS - 1


@pytest.mark.parametrize("known_deg", [0.0, 0.1])
@pytest.mark.parametrize("propose", [propose_angles, propose_pyramids], ids=["angle", "pyramid"])
def test_a_list_of_no_sky_takes_no_more_work_than_the_budget_however_badly_the_scale_is_known(
    propose: Propose, known_deg: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    joined = []
    join = star_identification.matching_triangles

    def counting(*arguments: Any) -> Any:
        joined.append(arguments)
        return join(*arguments)

    monkeypatch.setattr(star_identification, "matching_triangles", counting)
    drawn = draw_random(_kind(known_deg=known_deg), 40, np.random.default_rng(4))
    answer = search(drawn.field(), _sky(), propose)
    assert answer.status is MatchStatus.NO_MATCH
    assert 0.8 * DEFAULT.joins <= len(joined) <= DEFAULT.joins


@pytest.mark.parametrize("name", CLASSICAL)
def test_points_strewn_at_random_are_refused(name: str) -> None:
    rng = np.random.default_rng(3)
    for count in (3, 4, 12, 30):
        answer = METHODS[name].identify(draw_random(_kind(noise_px=0.5), count, rng).field(), _sky())
        assert answer.status is (MatchStatus.TOO_FEW_STARS if count < 4 else MatchStatus.NO_MATCH)
        assert np.all(answer.star == -1)


@pytest.mark.parametrize("name", CLASSICAL)
def test_a_mirrored_sky_is_refused(name: str) -> None:
    """A mirrored sky is refused, although it has the same angles, areas and moments.

    The mirrored sky and the true sky differ only in the orientation of the patterns.
    """
    drawn = _drawn(_kind(), 4)[0]
    field = drawn.field()
    mirrored = replace(field, direction=field.direction * np.array([-1.0, 1.0, 1.0]))
    assert METHODS[name].identify(mirrored, _sky()).status is MatchStatus.NO_MATCH


@pytest.mark.parametrize("name", CLASSICAL)
def test_a_scale_known_to_half_a_percent_is_tried_and_found(name: str) -> None:
    drawn = _drawn(_kind(), 5)[0]
    stretched = replace(drawn.field().rescaled(1.004), scale=(0.995, 1.005))
    answer = METHODS[name].identify(stretched, _sky())
    assert _right(answer, drawn)
    assert abs(answer.scale - 1.0 / 1.004) < 5.0 * answer.scale_sigma + 1e-4


@pytest.mark.parametrize("name", CLASSICAL)
def test_a_field_of_view_that_is_not_known_is_refused_with_the_reason(name: str) -> None:
    drawn = _drawn(_kind(), 6)[0]
    with pytest.raises(FieldUnknown, match="the default method accepts any scale"):
        METHODS[name].identify(replace(drawn.field(), scale=(0.8, 1.2)), _sky())


@pytest.mark.parametrize("name", CLASSICAL)
def test_two_points_within_their_errors_of_one_another_do_no_harm(name: str) -> None:
    """Two points that match the same guide star do not cause a wrong identification.

    A single star does not determine an attitude.
    """
    drawn = _drawn(_kind(noise_px=2.0), 11)[0]
    field = drawn.field()
    twice = field.subset(np.repeat(np.arange(len(field)), 2))
    answer = METHODS[name].identify(twice, _sky())
    assert answer.status in {MatchStatus.IDENTIFIED, MatchStatus.NO_MATCH}


def test_the_pyramid_takes_every_triangle_once_and_changes_its_pivot_soon() -> None:
    cycled = list(cycled_triangles(7))
    assert len(cycled) == len(set(cycled)) == 35
    assert all(i < j < k for i, j, k in cycled)
    assert [corners[0] for corners in cycled[:5]] == [0, 1, 2, 3, 4]


def test_the_triangle_tables_hold_only_triangles_that_the_field_can_show() -> None:
    sky = _sky()
    corners = sky.stars.direction[sky.planar.corner[::500]]
    assert np.all(2.0 * np.arcsin(0.5 * side_lengths(corners)) < np.deg2rad(15.0) + 1e-6)
    assert np.all(np.diff(sky.spherical.area.key) >= 0.0)


def _motion(drawn: StarList, seed: int) -> tuple[StarMotion, FloatArray]:
    """Return velocities of at most 1 deg/s and the rate. The velocities of false points are random."""
    rng = np.random.default_rng(seed)
    field = drawn.field()
    rate = np.deg2rad([0.6, -0.7, 0.4])
    velocity = np.cross(field.direction, rate)
    false = drawn.star < 0
    velocity[false] = 0.02 * rng.standard_normal((int(false.sum()), 3))
    sigma = field.sigma / 0.1
    return StarMotion(velocity + sigma[:, None] * rng.standard_normal(velocity.shape), sigma), rate


@pytest.mark.parametrize("false", [2, 5, 10])
def test_points_that_do_not_share_the_stars_rate_are_left_out(false: int) -> None:
    """False points whose motion differs from the common rate are discarded.

    One of a hundred stars may be lost, and one of ten false points may have the right motion by chance.
    """
    kept, strangers, points = 0, 0, 0
    for number, drawn in enumerate(_drawn(_kind(false_stars=false), 7)):
        motion, rate = _motion(drawn, number)
        shared = shared_rate(drawn.field().direction, motion)
        true = drawn.star >= 0
        kept += int(shared.shares[true].sum())
        points += int(true.sum())
        strangers += int(shared.shares[~true].sum())
        off = shared.rate - rate
        # A chi-square with 3 degrees of freedom exceeds 25 once in 60,000 cases
        assert off @ np.linalg.solve(shared.covariance, off) < 25.0
        assert _right(identify_by_rate(drawn.field(), _sky(), motion=motion), drawn)
    assert kept >= 0.99 * points
    assert strangers <= 0.1 * false * LISTS


def test_a_star_at_rest_in_the_sky_moves_against_the_body() -> None:
    """The direction of a star after a small rotation of the body agrees with v' = -w x v.

    The direction is transformed by the attitude matrix.
    """
    rate, step = np.array([0.02, -0.01, 0.03]), 1e-4
    before = np.array([0.1, 0.2, 1.0]) / np.linalg.norm([0.1, 0.2, 1.0])
    after = attitude_matrix(from_rotation_vector(rate * step)) @ before
    np.testing.assert_allclose((after - before) / step, np.cross(before, rate), atol=1e-6)


def test_a_previous_attitude_turned_by_the_rate_names_too_few_stars_for_a_pattern() -> None:
    """A previous attitude, propagated by the rate, identifies four stars a second later.

    Four stars are too few for lost-in-space identification.
    """
    drawn = _drawn(_kind(), 8)[0]
    whole, rate = _motion(drawn, 8)
    few = np.arange(5)
    field = drawn.field().subset(few)
    motion = StarMotion(whole.velocity[few], whole.sigma[few])
    elapsed = 0.05
    earlier = multiply(from_rotation_vector(-rate * elapsed), drawn.attitude)
    previous = PreviousAttitude(earlier, 1e-5, elapsed)
    answer = identify_by_rate(field, _sky(), motion=motion, previous=previous)
    assert answer.status is MatchStatus.IDENTIFIED
    np.testing.assert_array_equal(answer.star, drawn.star[few])


def test_a_wrong_previous_attitude_is_forgotten() -> None:
    drawn = _drawn(_kind(), 9)[0]
    previous = PreviousAttitude(np.array([0.0, 0.0, 0.0, 1.0]), 1e-5, 0.1)
    assert _right(identify_by_rate(drawn.field(), _sky(), previous=previous), drawn)


def test_velocities_must_be_as_many_as_the_points() -> None:
    drawn = _drawn(_kind(), 10)[0]
    with pytest.raises(ValueError, match="one each"):
        identify_by_rate(drawn.field(), _sky(), motion=StarMotion(np.zeros((2, 3)), np.ones(2)))


ARCSECOND = np.radians(1.0 / 3600.0)
SIGMA = 2.0 * ARCSECOND


def _stars(seed: int, noise: float, half_deg: float = 10.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return 15 observed stars with noise (rad), their reference directions, and the true attitude."""
    rng = np.random.default_rng(seed)
    attitude = normalise(rng.standard_normal(4))
    seen = np.column_stack([np.tan(np.radians(half_deg)) * rng.uniform(-1.0, 1.0, (15, 2)), np.ones(15)])
    seen /= np.linalg.norm(seen, axis=1)[:, None]
    noisy = seen + noise * rng.standard_normal(seen.shape)
    return noisy / np.linalg.norm(noisy, axis=1)[:, None], seen @ attitude_matrix(attitude), attitude


@pytest.mark.parametrize(
    ("axis", "limits"), [((0, 0, 1), (0.01,)), ((1, 0, 0), (200, 8)), ((0.6, 0.8, 0), (200, 8))]
)
def test_a_roll_needs_one_step_and_a_tilt_several(axis: tuple[float, ...], limits: tuple[float, ...]) -> None:
    """After a roll by 1 deg about the boresight, the attitude is exact after one step.

    After a tilt by 1 deg, the error is up to 200 arcseconds after one step and 8 arcseconds after two steps.
    """
    observed, reference, true = _stars(3, 0.0)
    prior = multiply(from_rotation_vector(np.radians(1.0) * np.array(axis)), true)
    for steps, limit in enumerate(limits, start=1):
        found = match_images(observed, reference, np.full(15, SIGMA), prior, steps)
        assert angle_between(found.quaternion, true) < limit * ARCSECOND
    assert angle_between(match_images(observed, reference, np.full(15, SIGMA), prior).quaternion, true) < 1e-7
    assert angle_between(prior, true) == pytest.approx(np.radians(1.0))


def test_noisy_stars_give_the_attitude_of_the_q_method_within_its_uncertainty() -> None:
    """The attitude of noisy stars agrees with the q method within its uncertainty.

    In the image plane, stars at the edge of a 20 deg field have up to 1.06 times their usual weight.
    """
    for seed in range(10):
        observed, reference, _ = _stars(100 + seed, SIGMA)
        optimal = SOLVERS["davenport"](observed, reference, np.full(15, SIGMA))
        found = match_images(observed, reference, np.full(15, SIGMA))
        away = angle_between(found.quaternion, optimal.quaternion)
        assert away < 0.1 * np.sqrt(np.trace(optimal.covariance))
        assert optimal.loss <= found.loss < 1.02 * optimal.loss + 1e-6


def test_a_prior_with_the_opposite_boresight_is_refused() -> None:
    observed, reference, true = _stars(5, 0.0)
    behind = multiply(from_rotation_vector(np.array([np.pi, 0.0, 0.0])), true)
    with pytest.raises(AttitudeError, match="in front of the camera"):
        match_images(observed, reference, np.full(15, SIGMA), behind)
