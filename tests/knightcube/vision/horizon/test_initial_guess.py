"""Tests of initial guesses: cones through many drawn edges, and orientations from directions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray, tangent_basis
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, normalise
from knightcube.vision.horizon.edges import EdgeRays
from knightcube.vision.horizon.illumination import limb_rays
from knightcube.vision.horizon.initial_guess import (
    MOST_MISMATCH,
    above_sphere,
    best_cone,
    left_free,
    limb_radius_sigma,
    limb_tilt_sigma,
    orientation,
    place_of,
    shortest_turn,
    sun_from,
)
from knightcube.vision.horizon.limb import MEAN_RADIUS, UNKNOWN, LimbView, earth, mean_sphere
from knightcube.vision.horizon.settings import (
    HorizonKnowledge,
    HorizonSettings,
    RoughAttitude,
    SensedDirection,
)

PIXEL = 0.002
NADIR = np.array([0.0, 0.0, 1.0])
COSINE = math.cos(math.radians(65.0))


def ring(nadir: FloatArray, half_angle: float, count: int, off: float = 0.0) -> EdgeRays:
    """Return edges on a cone about `nadir` (3,), bright inside, each displaced outwards by `off` px."""
    turn = shortest_turn(NADIR, nadir)
    azimuth = np.arange(count) * (2.0 * np.pi / count)
    angle = half_angle + off * PIXEL
    circle = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(count)], axis=1)
    rays = (math.sin(angle) * circle + math.cos(angle) * NADIR) @ turn.T
    inward = (math.sin(angle) * NADIR - math.cos(angle) * circle) @ turn.T
    return EdgeRays(rays, PIXEL * inward, np.full(count, PIXEL))


def joined(*parts: EdgeRays) -> EdgeRays:
    return EdgeRays(
        np.concatenate([part.rays for part in parts]),
        np.concatenate([part.brighter for part in parts]),
        np.concatenate([part.pixel for part in parts]),
    )


def free(edges: EdgeRays) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    return np.ones(len(edges), dtype=bool)


@pytest.mark.parametrize("known", [True, False])
def test_the_cone_of_the_most_edges_is_found_and_then_the_other(known: bool) -> None:
    other = normalise(np.array([0.8, 0.1, 0.6]))
    angle = math.acos(COSINE)
    edges = joined(ring(NADIR, angle, 24), ring(other, angle, 11))
    cosines = (COSINE, COSINE) if known else (COSINE - 0.05, COSINE + 0.05)
    first = best_cone(edges, free(edges), cosines, 0.5, 400)
    assert first is not None
    assert first.direction == pytest.approx(NADIR, abs=1e-9)
    assert first.cosine == pytest.approx(COSINE)
    assert first.members[:24].all()
    left = left_free(edges, free(edges), first, 0.5)
    assert not left[:24].any()
    second = best_cone(edges, left, cosines, 0.5, 400)
    assert second is not None
    assert second.direction == pytest.approx(other, abs=1e-9)


@pytest.mark.parametrize(("off", "members", "left"), [(1.9, 12, 0), (2.1, 0, 0), (3.9, 0, 0), (4.1, 0, 12)])
def test_edges_within_the_tolerance_are_members_and_within_twice_the_tolerance_used_up(
    off: float, members: int, left: int
) -> None:
    angle = math.acos(COSINE)
    edges = joined(ring(NADIR, angle, 24), ring(NADIR, angle, 12, off))
    cone = best_cone(edges, np.arange(36) < 24, (COSINE, COSINE), 2.0, 400)
    assert cone is not None
    assert np.count_nonzero(cone.members[24:]) == members
    assert np.count_nonzero(left_free(edges, free(edges), cone, 2.0)) == left


def test_an_edge_with_a_bright_outer_side_is_not_on_a_cone() -> None:
    edges = ring(NADIR, math.acos(COSINE), 24)
    inverse = EdgeRays(edges.rays, -edges.brighter, edges.pixel)
    elsewhere = best_cone(inverse, free(inverse), (COSINE, COSINE), 2.0, 400)
    assert elsewhere is None or np.count_nonzero(elsewhere.members) <= 4
    mixed = EdgeRays(
        edges.rays, np.where(np.arange(24)[:, None] < 16, 1.0, -1.0) * edges.brighter, edges.pixel
    )
    cone = best_cone(mixed, free(mixed), (COSINE, COSINE), 2.0, 400)
    assert cone is not None
    assert np.flatnonzero(cone.members).tolist() == list(range(16))


@pytest.mark.parametrize(("half_angle", "found"), [(58.0, False), (61.0, True), (69.0, True), (72.0, False)])
def test_only_cones_within_the_range_of_altitudes_are_candidates(half_angle: float, found: bool) -> None:
    edges = ring(NADIR, math.radians(half_angle), 24)
    limits = (math.cos(math.radians(70.0)), math.cos(math.radians(60.0)))
    assert (best_cone(edges, free(edges), limits, 0.5, 400) is not None) is found


def test_two_edges_determine_a_known_cone_and_three_an_unknown_one() -> None:
    edges = ring(NADIR, math.acos(COSINE), 3)
    assert best_cone(edges, np.arange(3) < 2, (COSINE, COSINE), 0.5, 400) is not None
    assert best_cone(edges, np.arange(3) < 1, (COSINE, COSINE), 0.5, 400) is None
    # Only the second of the tried triples has all its edges on one cone.
    cone = best_cone(edges, free(edges), (0.0, 1.0), 0.5, 2)
    assert cone is not None
    assert cone.members.all()


def test_few_trials_are_spread_over_all_pairs() -> None:
    """A few trials are spread over all pairs of edges.

    The first 15 of the 45 edges are stray, so trials in the order of the pairs would find no cone.
    """
    draw = np.random.default_rng(1)
    good = ring(NADIR, math.acos(COSINE), 30)
    stray = EdgeRays(
        normalise(draw.normal(size=(15, 3))), PIXEL * draw.normal(size=(15, 3)), np.full(15, PIXEL)
    )
    edges = joined(stray, good)
    cone = best_cone(edges, free(edges), (COSINE, COSINE), 0.5, 100)
    assert cone is not None
    assert cone.direction == pytest.approx(NADIR, abs=1e-9)


def true_attitude() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a quaternion (4,), and the nadir in camera axes and in inertial axes."""
    quaternion = normalise(np.array([0.3, -0.5, 0.4, 0.6]))
    down = normalise(np.array([0.2, -0.7, 0.5]))
    return quaternion, attitude_matrix(quaternion) @ down, down


def sensed(inertial: FloatArray, sigma: float, error: FloatArray | None = None) -> SensedDirection:
    """Return a sensor's measurement at the true attitude, rotated by `error` (3,), rad, in camera axes."""
    quaternion, _, _ = true_attitude()
    seen = attitude_matrix(quaternion) @ inertial
    if error is not None:
        seen = attitude_matrix(from_rotation_vector(error)) @ seen
    return SensedDirection(3.0 * seen, 0.2 * inertial, sigma)


def across(down: FloatArray, angle: float) -> FloatArray:
    """Return the direction (3,) at an `angle` (rad) from nadir."""
    side = normalise(np.cross(down, [1.0, 0.0, 0.0]))
    return np.asarray(math.cos(angle) * down + math.sin(angle) * side)


@pytest.mark.parametrize("angle", [0.3, 1.2, 2.5])
def test_one_direction_gives_the_rotation_about_nadir_with_the_error_of_its_lever(angle: float) -> None:
    quaternion, nadir, down = true_attitude()
    found = orientation(nadir, down, HorizonKnowledge(sensed=(sensed(across(down, angle), 0.01),)))
    assert found.rotation == pytest.approx(attitude_matrix(quaternion), abs=1e-9)
    assert found.sigma == pytest.approx(0.01 / math.sin(angle))
    assert found.mismatch == pytest.approx(0.0, abs=1e-9)
    # Four directions with equal errors halve the standard deviation.
    four = orientation(nadir, down, HorizonKnowledge(sensed=4 * (sensed(across(down, angle), 0.01),)))
    assert four.sigma == pytest.approx(0.5 * found.sigma)


def test_the_more_accurate_direction_decides_and_the_average_is_weighted() -> None:
    """The weighted mean of two measurements with errors of 0.01 and 0.02 rad has the weights 4 to 1.

    The measurements differ by 0.03 rad.
    """
    quaternion, nadir, down = true_attitude()
    level = across(down, 0.5 * math.pi)
    pair = sensed(level, 0.01), sensed(level, 0.02, 0.03 * nadir)
    found = orientation(nadir, down, HorizonKnowledge(sensed=pair))
    turned = attitude_matrix(from_rotation_vector(0.03 / 5.0 * nadir)) @ attitude_matrix(quaternion)
    assert found.rotation == pytest.approx(turned, abs=1e-5)


@pytest.mark.parametrize(("lever", "known"), [(0.04, False), (0.06, True)])
def test_a_direction_along_nadir_gives_no_rotation(lever: float, known: bool) -> None:
    _, nadir, down = true_attitude()
    found = orientation(nadir, down, HorizonKnowledge(sensed=(sensed(across(down, lever), 0.01),)))
    assert math.isfinite(found.sigma) is known
    assert found.rotation @ down == pytest.approx(nadir)


@pytest.mark.parametrize(("off_deg", "accepted"), [(0.75, True), (0.85, False)])
def test_an_exact_direction_may_contradict_a_guessed_nadir_by_its_error(
    off_deg: float, accepted: bool
) -> None:
    """An exact direction may deviate from a guessed nadir by four times 0.2 deg, the error of the guess.

    In flight, initial guesses of nadir are wrong by up to 0.3 deg.
    """
    _, nadir, down = true_attitude()
    level = across(down, 0.5 * math.pi)
    axis = normalise(np.cross(nadir, sensed(level, 1.0).camera))
    for side in (-1.0, 1.0):
        error = side * math.radians(off_deg) * axis
        found = orientation(nadir, down, HorizonKnowledge(sensed=(sensed(level, 1e-6, error),)))
        assert (found.mismatch <= MOST_MISMATCH) is accepted
        # With a sensor error of 1 deg, the same deviation is less than one standard deviation.
        coarse = orientation(nadir, down, HorizonKnowledge(sensed=(sensed(level, math.radians(1.0), error),)))
        assert coarse.mismatch == pytest.approx(off_deg / math.hypot(1.0, 0.2), rel=1e-6)


def test_the_fraction_of_nadirs_allowed_by_a_direction_is_that_of_a_belt() -> None:
    """A direction permits the nadirs in a belt, within four sigma of a great circle.

    The belt has the fraction sin(4 sigma) of the sphere. Two directions permit only the intersection of their
    belts.
    """
    _, nadir, down = true_attitude()
    one = sensed(across(down, 0.5 * math.pi), 0.03)
    draw = normalise(np.random.default_rng(1).normal(size=(200_000, 3)))
    belt = np.abs(np.arcsin(draw[:, 2])) < MOST_MISMATCH * 0.03
    crossing = belt & (np.abs(np.arcsin(draw[:, 0])) < MOST_MISMATCH * 0.03)
    found = orientation(nadir, down, HorizonKnowledge(sensed=(one,)))
    assert found.share == pytest.approx(float(belt.mean()), rel=0.02)
    two = orientation(nadir, down, HorizonKnowledge(sensed=(one, one)))
    assert float(crossing.mean()) < two.share < 2.0 * float(crossing.mean())
    three = orientation(nadir, down, HorizonKnowledge(sensed=(one, one, replace(one, sigma=0.2))))
    assert three.share == pytest.approx(two.share)
    assert orientation(nadir, down, HorizonKnowledge(sensed=(replace(one, sigma=2.0),))).share == 1.0
    assert orientation(nadir, down, HorizonKnowledge()).share == 1.0


def test_a_rough_attitude_gives_the_rotation_and_tests_the_tilt() -> None:
    quaternion, nadir, down = true_attitude()
    found = orientation(nadir, down, HorizonKnowledge(attitude=RoughAttitude(quaternion, 0.02)))
    assert found.rotation == pytest.approx(attitude_matrix(quaternion), abs=1e-9)
    assert found.sigma == pytest.approx(0.02)
    assert found.mismatch == pytest.approx(0.0, abs=1e-9)
    tilted = normalise(nadir + 0.1 * normalise(np.cross(nadir, [0.0, 1.0, 0.0])))
    wrong = orientation(tilted, down, HorizonKnowledge(attitude=RoughAttitude(quaternion, 0.02)))
    assert wrong.mismatch == pytest.approx(math.atan(0.1) / math.hypot(0.02, math.radians(0.2)), rel=1e-6)


def test_without_knowledge_the_rotation_is_the_shortest() -> None:
    _, nadir, down = true_attitude()
    found = orientation(nadir, down, HorizonKnowledge())
    assert math.isinf(found.sigma)
    assert found.mismatch == 0.0
    assert found.rotation @ down == pytest.approx(nadir)
    angle = math.acos(0.5 * (float(np.trace(found.rotation)) - 1.0))
    assert angle == pytest.approx(math.acos(float(down @ nadir)))


def test_the_shortest_turn_to_the_opposite_is_half_a_turn() -> None:
    source = normalise(np.array([0.3, 0.4, -0.5]))
    found = shortest_turn(source, -source)
    assert found @ source == pytest.approx(-source)
    assert found @ found.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(found) == pytest.approx(1.0)


def test_the_cone_of_a_place_is_that_of_the_limb() -> None:
    place = above_sphere(500e3, 7.0)
    view = LimbView(np.eye(3), place.position, mean_sphere(), 0.0)
    assert view.surface.height_of(place.position) == pytest.approx(500e3)
    assert place.altitude_sigma == 7.0
    assert not place.located
    raised = LimbView(np.eye(3), place.position, mean_sphere(), 15.4e3)
    assert limb_rays(raised, 4) @ raised.nadir == pytest.approx(np.full(4, place.cosine), abs=1e-4)
    inside = above_sphere(1e3)
    assert inside.cosine == 0.0, "within the air the limb is at the horizontal"


def test_the_place_is_the_position_or_the_altitude_or_unknown() -> None:
    settings = HorizonSettings(altitude_sigma=123.0)
    position = np.array([0.0, 7e6, 0.0])
    known = place_of(
        HorizonKnowledge(position=position, altitude=4e5, sun=np.array([0.0, 3.0, 4.0])), settings
    )
    assert known is not None
    assert known.located
    assert known.position.tolist() == position.tolist()
    assert known.altitude_sigma == 123.0
    sphere = place_of(HorizonKnowledge(altitude=4e5), settings)
    assert sphere is not None
    assert float(np.linalg.norm(sphere.position)) == pytest.approx(MEAN_RADIUS + 4e5)
    assert 4e3 < sphere.altitude_sigma < 7e3 < UNKNOWN
    assert place_of(HorizonKnowledge(), settings) is None
    sunny = HorizonKnowledge(sun=np.array([0.0, 3.0, 4.0]))
    sun = sun_from(known, sunny)
    assert sun is not None
    assert sun == pytest.approx([0.0, 0.6, 0.8])
    assert sun_from(sphere, sunny) is None
    assert sun_from(known, HorizonKnowledge()) is None


@pytest.mark.parametrize("altitude", [250e3, 700e3, 1900e3])
def test_the_errors_of_the_spherical_model_are_those_of_limbs_of_the_ellipsoid(altitude: float) -> None:
    """The stated errors of the spherical limb model cover its deviations from the limb of the ellipsoid.

    The positions cover a sphere, and the reference is the circular cone through the limb of the ellipsoid.
    """
    count = 300
    height = (2.0 * np.arange(count) + 1.0) / count - 1.0
    radii, tilts = np.zeros(count), np.zeros((count, 2))
    for k, z in enumerate(height):
        position = (MEAN_RADIUS + altitude) * np.array([math.sqrt(1.0 - z * z), 0.0, z])
        view = LimbView(np.eye(3), position, earth(NADIR), 0.0)
        cone, *_ = np.linalg.lstsq(limb_rays(view, 72), np.ones(72), rcond=None)
        size = float(np.linalg.norm(cone))
        radii[k] = float(np.linalg.norm(position)) * math.sqrt(1.0 - size**-2)
        tilts[k] = tangent_basis(view.nadir) @ cone / size
    assert np.sqrt(np.mean((radii - MEAN_RADIUS) ** 2)) == pytest.approx(limb_radius_sigma(altitude), rel=0.1)
    place = above_sphere(altitude)
    view = LimbView(np.eye(3), place.position, place.surface, 0.0)
    stand = orientation(view.nadir, view.nadir, HorizonKnowledge())
    tilt = limb_tilt_sigma(view, stand, HorizonSettings())
    assert np.sqrt(np.mean(tilts**2)) == pytest.approx(tilt, rel=0.1)
    assert limb_tilt_sigma(view, replace(stand, sigma=0.1), HorizonSettings()) == 0.0
