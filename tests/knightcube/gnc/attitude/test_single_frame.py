"""The attitude of one moment: errors as large as each way says, and none better than the optimum."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import chi2

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.wahba import AttitudeError, AttitudeFix
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply, normalise
from knightcube.astro.quaternion import to_rotation_vector as rotation_vector
from knightcube.gnc.attitude.single_frame import (
    Sight,
    attitude,
    camera_sight,
    combined,
    field_sight,
    optimum,
    with_direction,
)
from tests.support.orbit_geometry import suite

RUNS, SEED = 150, 20_261_121
SUN_SIGMA, NADIR_SIGMA, FIELD_SIGMA = 3e-4, 1e-3, 5e-3
EARTH_FIELD = 3e-5


def scene(rng: np.random.Generator, lopsided: bool = False) -> tuple[FloatArray, Sight, Sight, Sight]:
    """Return an attitude (4,), and Sun, nadir and field as it sees them, with the errors they claim."""
    truth = normalise(rng.standard_normal(4))
    references = rng.standard_normal((3, 3))
    references /= np.linalg.norm(references, axis=-1, keepdims=True)
    if min(np.linalg.norm(np.cross(references[k], references[k - 1])) for k in range(3)) < 0.3:
        return scene(rng, lopsided)
    sights = []
    for reference, sigma in zip(references[:2], (SUN_SIGMA, NADIR_SIGMA), strict=True):
        root = sigma * np.eye(3)
        if lopsided:  # a short arc of limb: one way ten times worse than the other
            axes = np.linalg.qr(rng.standard_normal((3, 3)))[0]
            root = sigma * axes * np.array([1.0, 3.0, 10.0])
        seen = attitude_matrix(truth) @ reference + root @ rng.standard_normal(3)
        sights.append(Sight(seen / np.linalg.norm(seen), reference, root @ root.T))
    field = EARTH_FIELD * (attitude_matrix(truth) @ references[2] + FIELD_SIGMA * rng.standard_normal(3))
    spread = (FIELD_SIGMA * EARTH_FIELD) ** 2 * np.eye(3)
    sun, nadir = sights
    return truth, sun, nadir, field_sight(field, EARTH_FIELD * references[2], spread)


def error(truth: FloatArray, fix: AttitudeFix) -> FloatArray:
    return rotation_vector(multiply(truth, conjugate(fix.quaternion)))


WAYS: dict[str, tuple[Callable[[Sight, Sight, Sight], AttitudeFix], bool]] = {
    "triad": (lambda sun, nadir, field: attitude([sun, nadir], "triad"), False),
    "quest": (lambda sun, nadir, field: attitude([sun, nadir], "quest"), False),
    "optimum": (lambda sun, nadir, field: optimum([sun, nadir]), True),
    "optimum of three": (lambda sun, nadir, field: optimum([sun, nadir, field]), True),
    "cameras, then the field": (lambda sun, nadir, field: with_direction(optimum([sun, nadir]), field), True),
}


@pytest.mark.parametrize("way", WAYS)
def test_errors_are_as_large_as_the_covariance_says(way: str) -> None:
    """Mean NEES of 150 attitudes in its 99.9 % band; lopsided covariances where they are weighed whole."""
    make, lopsided = WAYS[way]
    rng = np.random.default_rng(SEED)
    total = 0.0
    for _ in range(RUNS):
        truth, sun, nadir, field = scene(rng, lopsided)
        fix = make(sun, nadir, field)
        off = error(truth, fix)
        total += float(off @ np.linalg.solve(fix.covariance, off))
    low, high = chi2.ppf([0.0005, 0.9995], 3 * RUNS)
    assert low < total < high


def test_the_field_joined_to_the_cameras_is_the_optimum_of_all_three() -> None:
    rng = np.random.default_rng(SEED)
    for _ in range(20):
        _, sun, nadir, field = scene(rng, lopsided=True)
        whole = optimum([sun, nadir, field])
        joined = with_direction(optimum([sun, nadir]), field)
        sigma = np.sqrt(np.diag(whole.covariance))
        off = rotation_vector(multiply(whole.quaternion, conjugate(joined.quaternion)))
        assert np.all(np.abs(off) < 0.05 * sigma)
        np.testing.assert_allclose(
            joined.covariance, whole.covariance, rtol=0.05, atol=0.02 * sigma.max() ** 2
        )
        assert np.trace(whole.covariance) <= np.trace(optimum([sun, nadir]).covariance)


def test_two_attitudes_combine_to_what_their_sights_give_together() -> None:
    """Of four sights, two and two against all; and the agreement is a chi-square of three."""
    rng = np.random.default_rng(SEED)
    agreement = 0.0
    for _ in range(RUNS):
        truth, sun, nadir, field = scene(rng)
        first = optimum([sun, nadir])
        other = Sight(*(attitude_matrix(truth) @ nadir.reference, nadir.reference), nadir.covariance)
        noisy = other.observed + NADIR_SIGMA * rng.standard_normal(3)
        other = Sight(noisy / np.linalg.norm(noisy), other.reference, other.covariance)
        second = optimum([other, field])
        both, whole = combined(first, second), optimum([sun, nadir, other, field])
        sigma = np.sqrt(np.diag(whole.covariance))
        off = rotation_vector(multiply(whole.quaternion, conjugate(both.quaternion)))
        assert np.all(np.abs(off) < 0.1 * sigma)
        np.testing.assert_allclose(np.diag(both.covariance), sigma**2, rtol=0.1)
        agreement += 2.0 * (both.loss - first.loss - second.loss)
    low, high = chi2.ppf([0.0005, 0.9995], 3 * RUNS)
    assert low < agreement < high


def test_attitudes_that_contradict_each_other_are_shown_by_the_loss() -> None:
    _, sun, nadir, _ = scene(np.random.default_rng(1))
    fix = optimum([sun, nadir])
    turned = AttitudeFix(
        multiply(np.array([0.1, 0.0, 0.0, np.sqrt(0.99)]), fix.quaternion), fix.covariance, 0.0
    )
    assert combined(fix, turned).loss > 100.0


def test_what_a_camera_measured_is_seen_from_the_body() -> None:
    """UW's top camera, its rows run aft: direction and covariance turn together."""
    top = suite("uw").cameras[3]
    off_axis = np.array([0.0, np.sin(0.3), np.cos(0.3)])
    rows_worse = np.outer([0.0, np.cos(0.3), -np.sin(0.3)], [0.0, np.cos(0.3), -np.sin(0.3)])
    sight = camera_sight(top.to_camera, off_axis, 1e-6 * rows_worse, np.array([1.0, 0.0, 0.0]), 1e-4)
    np.testing.assert_allclose(sight.observed, (-np.sin(0.3), 0.0, -np.cos(0.3)), atol=1e-8)
    np.testing.assert_allclose(np.diag(sight.covariance)[1], 1e-8, rtol=1e-6)
    assert np.trace(sight.covariance) == pytest.approx(1e-6 + 3e-8)


def test_a_field_that_its_bias_drowns_gives_no_direction() -> None:
    with pytest.raises(AttitudeError, match="gives no direction"):
        field_sight(np.full(3, 1e-6), np.full(3, 1e-6), 1e-11 * np.eye(3))


def test_sun_and_nadir_on_one_line_fix_no_attitude() -> None:
    down = np.array([0.0, 0.0, 1.0])
    sights = [Sight(down, down, 1e-6 * np.eye(3)), Sight(-down, -down, 1e-6 * np.eye(3))]
    with pytest.raises(AttitudeError):
        optimum(sights)
