"""Tests that errors and innovations of short runs agree with the covariance of the filter."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knightcube import attitude_error, check_consistency
from knightcube.errors import ArgumentError
from tests.knightcube.gnc.estimation import consistency_flights as consistency
from tests.knightcube.gnc.estimation.consistency_flights import Result
from tests.support.consistency_worlds import band

SEED = 20_261_121
SECONDS = 12


def fly(scene: str, runs: int, **parameters: float) -> list[Result]:
    """Return the results of short runs."""
    return [consistency.run(scene, (SEED, run), SECONDS, **parameters) for run in range(runs)]


@pytest.fixture(scope="module")
def flown() -> dict[str, list[Result]]:
    """Return runs of both worlds with the correct noise assumptions."""
    return {"testbed": fly("testbed", 8), "free": fly("free", 3)}


@pytest.mark.parametrize("scene", ["testbed", "free"])
def test_errors_and_innovations_agree_with_the_covariance_of_the_filter(
    scene: str, flown: dict[str, list[Result]]
) -> None:
    """The NEES at the end of the runs is in its 99.9 % band.

    The mean NIS of the IMU is 1 within 4 %. The mean NIS of the camera is in its 99.9 % band.
    """
    results = flown[scene]
    runs = len(results)
    facts = consistency.scene_facts(results)
    low, high = band(runs * facts["degrees"], 0.999)
    assert low < facts["nees_final"] < high
    assert facts["nis"]["gyro"]["mean"] == pytest.approx(1.0, abs=0.04)
    assert facts["nis"]["unit attitude"]["mean"] == pytest.approx(1.0, abs=0.04)
    assert facts["nis"]["streaks"]["measurements"] >= runs
    streaks = facts["nis"]["streaks"]
    low, high = band(streaks["measurements"] * results[0]["nis_degrees"], 0.999)
    assert low < streaks["mean"] < high
    assert sum(facts["refused"].values()) <= 1
    assert facts["bias_worst_sigmas"] < 4.0


def test_variances_that_are_claimed_too_small_are_found_out() -> None:
    """If the filter assumes half of the IMU's true noise, NEES and NIS exceed their bounds."""
    facts = consistency.scene_facts(fly("testbed", 12, claimed=0.25))
    assert facts["nees_final"] > band(12 * facts["degrees"], 0.999)[1]
    assert facts["nis"]["gyro"]["mean"] > 2.0


def test_variances_that_are_claimed_too_large_are_found_out() -> None:
    """If the filter assumes twice the IMU's true noise, NIS and mean NEES fall below their bounds.

    The innovations show a wrong noise earlier than the errors do.
    """
    facts = consistency.scene_facts(fly("testbed", 4, claimed=4.0))
    assert facts["nees_mean"] < 0.9
    assert facts["nis"]["gyro"]["mean"] < 0.5


COVARIANCE = np.array([[4.0, 1e-6, 0.0], [1e-6, 1e-12, 2e-10], [0.0, 2e-10, 1.0]])
"""A covariance whose units differ by six orders of magnitude, with correlations."""


@pytest.mark.parametrize(("scale", "outside"), [(1.0, 0), (1.5, 1), (0.67, -1)])
def test_the_mean_nees_of_errors_with_a_wrong_scale_is_outside_its_bounds(scale: float, outside: int) -> None:
    errors = scale * np.random.default_rng(3).multivariate_normal(np.zeros(3), COVARIANCE, 200)
    found = check_consistency(errors, [COVARIANCE] * 200)
    assert int(np.sign(found.mean - np.clip(found.mean, found.lower, found.upper))) == outside
    assert bool(found) == (outside == 0)
    assert found.mean == pytest.approx(scale**2, abs=0.25 * scale**2)


def test_consistent_errors_are_outside_the_bounds_as_rarely_as_stated() -> None:
    """The 90 % bounds exclude 10 % of 2,000 sets of five errors, within 3 standard deviations."""
    errors = np.random.default_rng(4).multivariate_normal(np.zeros(3), COVARIANCE, (2000, 5))
    outside = sum(not check_consistency(few, [COVARIANCE] * 5, confidence=0.9) for few in errors)
    assert abs(outside - 200) < 3.0 * np.sqrt(2000 * 0.1 * 0.9)


def test_fewer_independent_errors_have_wider_bounds() -> None:
    errors = np.ones((10, 3))
    every, some = (check_consistency(errors, [np.eye(3)] * 10, independent=n) for n in (10, 2))
    assert (some.lower, some.upper) == pytest.approx(band(6, 0.99))
    assert some.lower < every.lower < every.upper < some.upper
    assert repr(every) == "<Consistency consistent: mean NEES 1.000, bounds 0.460 to 1.789, 10 errors>"


def test_an_attitude_error_rotates_the_estimate_into_the_truth() -> None:
    """In the convention of the package, A(true) = A(error) A(estimated), independently computed by SciPy."""
    true, estimated = Rotation.random(2, random_state=5)
    turned = Rotation.from_rotvec(attitude_error(true.as_quat(), estimated.as_quat())).inv().as_matrix()
    expected = true.inv().as_matrix()
    np.testing.assert_allclose(turned @ estimated.inv().as_matrix(), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"errors": [1.0, 2.0]}, "errors: an array of shape"),
        ({"covariances": [np.eye(3)]}, r"covariances: .* shape \(1, 3, 3\): give \(2, 3, 3\)"),
        ({"covariances": [np.eye(3), np.diag([1.0, -1.0, 1.0])]}, r"covariances\[1\]: must be symmetric"),
        ({"covariances": [np.zeros((3, 3)), np.eye(3)]}, r"covariances\[0\]: must be symmetric"),
        ({"covariances": [np.eye(3) + np.eye(3, k=1)] * 2}, r"covariances\[0\]: must be symmetric"),
        ({"confidence": 99.0}, "confidence: 99.0: give a probability"),
        ({"independent": 3}, "independent: 3: give a whole number from 1 to 2"),
    ],
)
def test_errors_or_covariances_that_determine_no_nees_are_refused(changed: Any, text: str) -> None:
    given = {"errors": np.ones((2, 3)), "covariances": [np.eye(3)] * 2}
    with pytest.raises(ArgumentError, match=text):
        check_consistency(**given | changed)
