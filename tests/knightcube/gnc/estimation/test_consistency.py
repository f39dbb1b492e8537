"""Tests that errors and innovations of short runs agree with the covariance of the filter."""

from __future__ import annotations

import pytest

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
