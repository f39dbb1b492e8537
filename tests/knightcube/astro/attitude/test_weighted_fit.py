"""Tests that the errors of a least-squares attitude agree with its covariance, for full input covariances."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import chi2

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.solvers import SOLVERS, VectorObservation, field_observation, weighted_fit
from knightcube.astro.attitude.wahba import AttitudeError, AttitudeFix
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply, normalise
from knightcube.astro.quaternion import to_rotation_vector as rotation_vector

RUNS, SEED = 150, 20_261_121
SUN_SIGMA, NADIR_SIGMA, FIELD_SIGMA = 3e-4, 1e-3, 5e-3
EARTH_FIELD = 3e-5


def scene(
    rng: np.random.Generator, lopsided: bool = False
) -> tuple[FloatArray, VectorObservation, VectorObservation, VectorObservation]:
    """Return an attitude (4,), and measured directions of Sun, nadir and field with their covariances."""
    truth = normalise(rng.standard_normal(4))
    references = rng.standard_normal((3, 3))
    references /= np.linalg.norm(references, axis=-1, keepdims=True)
    if min(np.linalg.norm(np.cross(references[k], references[k - 1])) for k in range(3)) < 0.3:
        return scene(rng, lopsided)
    observations = []
    for reference, sigma in zip(references[:2], (SUN_SIGMA, NADIR_SIGMA), strict=True):
        root = sigma * np.eye(3)
        if lopsided:  # for a short arc of the limb, the error is ten times larger along one direction
            axes = np.linalg.qr(rng.standard_normal((3, 3)))[0]
            root = sigma * axes * np.array([1.0, 3.0, 10.0])
        seen = attitude_matrix(truth) @ reference + root @ rng.standard_normal(3)
        observations.append(VectorObservation(seen / np.linalg.norm(seen), reference, root @ root.T))
    field = EARTH_FIELD * (attitude_matrix(truth) @ references[2] + FIELD_SIGMA * rng.standard_normal(3))
    spread = (FIELD_SIGMA * EARTH_FIELD) ** 2 * np.eye(3)
    sun, nadir = observations
    return truth, sun, nadir, field_observation(field, EARTH_FIELD * references[2], spread)


def error(truth: FloatArray, fix: AttitudeFix) -> FloatArray:
    return rotation_vector(multiply(truth, conjugate(fix.quaternion)))


def by_sigma(solver: str, *observations: VectorObservation) -> AttitudeFix:
    """Return the attitude that a solver finds if each direction has only one sigma."""
    return SOLVERS[solver](
        np.array([one.observed for one in observations]),
        np.array([one.reference for one in observations]),
        np.array([one.sigma for one in observations]),
    )


WAYS: dict[
    str, tuple[Callable[[VectorObservation, VectorObservation, VectorObservation], AttitudeFix], bool]
] = {
    "triad": (lambda sun, nadir, field: by_sigma("triad", sun, nadir), False),
    "quest": (lambda sun, nadir, field: by_sigma("quest", sun, nadir), False),
    "whole covariances": (lambda sun, nadir, field: weighted_fit([sun, nadir]), True),
    "whole covariances of three": (lambda sun, nadir, field: weighted_fit([sun, nadir, field]), True),
}


@pytest.mark.parametrize("way", WAYS)
def test_errors_agree_with_the_covariance(way: str) -> None:
    """With full covariances, the mean NEES of 150 attitudes is in its 99.9 % band."""
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


def test_a_field_as_small_as_its_bias_gives_no_direction() -> None:
    with pytest.raises(AttitudeError, match="too weak to give a direction"):
        field_observation(np.full(3, 1e-6), np.full(3, 1e-6), 1e-11 * np.eye(3))


def test_sun_and_nadir_on_one_line_fix_no_attitude() -> None:
    down = np.array([0.0, 0.0, 1.0])
    observations = [
        VectorObservation(down, down, 1e-6 * np.eye(3)),
        VectorObservation(-down, -down, 1e-6 * np.eye(3)),
    ]
    with pytest.raises(AttitudeError):
        weighted_fit(observations)
