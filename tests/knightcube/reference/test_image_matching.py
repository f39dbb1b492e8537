"""Tests that image matching finds exact attitudes, and for noisy stars the solution of Wahba's problem."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.solvers import SOLVERS
from knightcube.astro.attitude.wahba import AttitudeError
from knightcube.astro.quaternion import (
    angle_between,
    attitude_matrix,
    from_rotation_vector,
    multiply,
    normalise,
)
from knightcube.reference.image_matching import solve

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
    """A roll of 1 deg about the boresight is exact after one step.

    After a tilt of 1 deg, the error is up to 200 arcseconds after one step and 8 arcseconds after two.
    """
    observed, reference, true = _stars(3, 0.0)
    prior = multiply(from_rotation_vector(np.radians(1.0) * np.array(axis)), true)
    for steps, limit in enumerate(limits, start=1):
        found = solve(observed, reference, np.full(15, SIGMA), prior, steps)
        assert angle_between(found.quaternion, true) < limit * ARCSECOND
    assert angle_between(solve(observed, reference, np.full(15, SIGMA), prior).quaternion, true) < 1e-7
    assert angle_between(prior, true) == pytest.approx(np.radians(1.0))


def test_noisy_stars_give_the_attitude_of_the_q_method_within_its_uncertainty() -> None:
    """In the image plane, stars at the edge of a 20 deg field have up to 1.06 times their weight."""
    for seed in range(10):
        observed, reference, _ = _stars(100 + seed, SIGMA)
        optimal = SOLVERS["davenport"](observed, reference, np.full(15, SIGMA))
        found = solve(observed, reference, np.full(15, SIGMA))
        away = angle_between(found.quaternion, optimal.quaternion)
        assert away < 0.1 * np.sqrt(np.trace(optimal.covariance))
        assert optimal.loss <= found.loss < 1.02 * optimal.loss + 1e-6


def test_a_prior_that_looks_away_is_refused() -> None:
    observed, reference, true = _stars(5, 0.0)
    behind = multiply(from_rotation_vector(np.array([np.pi, 0.0, 0.0])), true)
    with pytest.raises(AttitudeError, match="in front of the camera"):
        solve(observed, reference, np.full(15, SIGMA), behind)
