"""The three indicators: by hand, for stars at every angle, and for what is no star."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.olae import rotation_between
from knightcube.vision.objects.rso_indicators import (
    angular_displacements,
    centre_residuals,
    evaluate,
    lengths,
    olae_residuals,
    slopes,
    star_ends,
)
from tests.knightcube.vision.streaks.frames import rate_at, star_camera, true_endpoints

_CAMERA = star_camera()
_PINHOLE = _CAMERA.pinhole
_BOUNDS = (8.0, 10.0, 10.0)
_THETAS = [2.0, 10.0, 30.0, 60.0, 80.0, 90.0]


def _stars(theta_deg: float, seed: int = 1, n: int = 14) -> tuple[FloatArray, FloatArray]:
    """Return the exact ends (n, 2, 2) of stars over the whole field, and the turn (3,), 100 px at most."""
    theta = np.deg2rad(theta_deg)
    turn = rate_at(theta, min(100.0 / _PINHOLE.focal_length / np.sin(theta), 0.3), 0.8)
    points = np.random.default_rng(seed).uniform(60.0, 960.0, (n, 2))
    return true_endpoints(_CAMERA, _PINHOLE.unit_vectors(points), turn), turn


def test_the_indicators_of_a_quarter_circle_by_hand() -> None:
    """Centre (10, 20): from (13, 20) to (10, 23), a quarter turn of radius 3."""
    ends = np.array([[[13.0, 20.0], [10.0, 23.0]]])
    centre = np.array([10.0, 20.0])
    assert centre_residuals(ends, centre)[0] == pytest.approx(0.0, abs=1e-15)
    assert angular_displacements(ends, centre)[0] == pytest.approx(0.5 * np.pi)
    assert lengths(ends)[0] == pytest.approx(3.0 * np.sqrt(2.0))
    assert slopes(ends)[0] == pytest.approx(0.75 * np.pi)
    # A centre off by (1, 0) is missed by the part of it along the chord.
    assert abs(centre_residuals(ends, centre + np.array([1.0, 0.0]))[0]) == pytest.approx(np.sqrt(0.5))


def test_the_residual_is_that_of_olae() -> None:
    ends, _ = _stars(60.0)
    noisy = ends + np.random.default_rng(2).normal(0.0, 0.5, ends.shape)
    vectors = _PINHOLE.unit_vectors(noisy)
    solution = rotation_between(vectors[:, 0], vectors[:, 1], np.ones(len(ends)))
    found = olae_residuals(vectors, solution.rotation_vector)
    np.testing.assert_allclose(found, np.linalg.norm(solution.residuals, axis=-1), rtol=1e-6)


@pytest.mark.parametrize("theta_deg", _THETAS)
def test_a_star_in_the_same_place_is_the_star_itself(theta_deg: float) -> None:
    ends, turn = _stars(theta_deg)
    vectors = _PINHOLE.unit_vectors(ends)
    np.testing.assert_allclose(_PINHOLE.project(star_ends(vectors, turn)), ends, atol=1e-8)


@pytest.mark.parametrize("theta_deg", _THETAS)
def test_exact_stars_deviate_nowhere_whatever_the_axis(theta_deg: float) -> None:
    """Over the whole field, though the projection bends slopes by 1.8 deg and lengths by 6 % across it."""
    ends, turn = _stars(theta_deg)
    found = evaluate(ends[:, ::-1], np.full(len(ends), 0.1), turn, _PINHOLE, _BOUNDS)
    np.testing.assert_allclose(found.deviations, 0.0, atol=1e-6)
    np.testing.assert_allclose(found.endpoints, ends)
    assert found.degenerate == (theta_deg > 71.6)
    assert not found.fired.any()


@pytest.mark.parametrize("theta_deg", _THETAS)
def test_deviations_are_in_standard_deviations_of_the_endpoint_errors(theta_deg: float) -> None:
    """Across and along a streak each difference of two ends has unit variance; the residual holds both."""
    rng = np.random.default_rng(3)
    ends, turn = _stars(theta_deg, n=14)
    long = lengths(ends) > 25.0
    sigma = rng.uniform(0.05, 0.3, len(ends))
    deviations = [
        evaluate(
            ends + sigma[:, None, None] * rng.normal(size=ends.shape), sigma, turn, _PINHOLE, _BOUNDS
        ).deviations[long]
        for _ in range(60)
    ]
    spread = np.sqrt(np.mean(np.square(deviations), axis=(0, 1)))
    # The centre is itself fitted and the field's edge is stretched: a fifth.
    np.testing.assert_allclose(spread, [1.0, 1.0, np.sqrt(2.0)], rtol=0.2)


@pytest.mark.parametrize("theta_deg", _THETAS)
@pytest.mark.parametrize(
    ("along", "across", "expected"),
    [(6.0, 0.0, (False, True, True)), (0.0, 6.0, (True, False, True))],
)
def test_each_indicator_sees_its_own_part_of_a_motion(
    theta_deg: float, along: float, across: float, expected: tuple[bool, bool, bool]
) -> None:
    """An object whose second end is 6 px on, or to the side: 42 standard deviations of 0.1 px."""
    ends, turn = _stars(theta_deg)
    one = int(np.argmax(lengths(ends)))
    chord = ends[one, 1] - ends[one, 0]
    chord /= np.linalg.norm(chord)
    side = np.array([-chord[1], chord[0]])
    # Symmetric about the middle, so that the star in the same place is the same star.
    moved = 0.5 * (along * chord + across * side)
    ends[one] += [-moved, moved]
    found = evaluate(ends, np.full(len(ends), 0.1), turn, _PINHOLE, _BOUNDS)
    assert tuple(found.fired[one]) == expected
    assert not np.delete(found.fired, one, axis=0).any()


def test_a_point_has_no_direction_but_the_wrong_displacement() -> None:
    ends, turn = _stars(60.0)
    ends[3] = ends[3].mean(axis=0)
    found = evaluate(ends, np.full(len(ends), 0.1), turn, _PINHOLE, _BOUNDS)
    assert tuple(found.fired[3]) == (False, True, True)
    assert np.all(np.isfinite(found.deviations))


def test_the_lower_bound_keeps_a_quiet_frame_quiet_and_the_strict_rule_a_loud_one() -> None:
    ends, turn = _stars(60.0, n=30)
    rng = np.random.default_rng(4)
    noise = rng.normal(size=ends.shape)
    sigma = np.full(len(ends), 0.1)
    quiet = evaluate(ends + 0.1 * noise, sigma, turn, _PINHOLE, _BOUNDS)
    strict_only = evaluate(ends + 0.1 * noise, sigma, turn, _PINHOLE, (0.0, 0.0, 0.0))
    # 2.5 sigma of thirty streaks and three indicators: a false alarm in nearly every frame.
    assert strict_only.fired.any()
    assert not quiet.fired.any()
    # Errors ten times the expected ones: the frame's own spread holds where the bound would fire.
    loud = evaluate(ends + noise, sigma, turn, _PINHOLE, _BOUNDS)
    assert np.count_nonzero(np.abs(loud.deviations) > _BOUNDS) > 3 * np.count_nonzero(loud.fired)


def test_no_streaks_give_no_indicators() -> None:
    found = evaluate(np.empty((0, 2, 2)), np.empty(0), np.array([0.0, 0.03, 0.0]), _PINHOLE, _BOUNDS)
    assert found.deviations.shape == found.fired.shape == (0, 3)
    assert found.degenerate
