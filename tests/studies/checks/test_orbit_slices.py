"""Runs slices of the orbit campaigns: camera coverage of the paper, and attitude errors at sunset."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ground.campaigns.runner import Case, Result
from knightcube.astro.quaternion import attitude_matrix
from tests.studies.campaigns import coverage, orbit_attitude
from tests.support import orbit_world
from tests.support.consistency_worlds import band
from tests.support.orbit_geometry import limb, limb_in_daylight, revolution, suite

SEED = 20_261_121


@pytest.fixture(scope="module")
def seen() -> list[Result]:
    """Two revolutions, and UW's headings at three heights of the Sun."""
    cases = [
        case for case in coverage.cases(2, SEED) if case.parameters.get("beta", 15.0) in (0.0, 15.0, 60.0)
    ]
    return [coverage.run(case) for case in cases]


def test_vt_has_the_horizon_in_all_three_cameras_to_14_deg_of_tilt() -> None:
    """4.1 says 15; by its own 67 deg field and a limb 19.3 deg down the edge is at 33.5 - 19.3 = 14.2."""
    dip = np.degrees(np.arccos(6378.1366 / (6378.1366 + 380.0)))
    assert np.degrees(coverage.all_three_up_to()) == pytest.approx(33.5 - dip, abs=0.2)


def test_the_shares_are_the_paper_s(seen: list[Result]) -> None:
    shares = [result["shares"] for result in seen if result["kind"] == "orbit"]
    for share in shares:
        assert share["vt/level"]["horizon"][3] == 1.0
        assert share["uw/level"]["horizon"][4] == 0.0
        # 4.1: within 15 deg the horizon is in all three cameras, except in the last degree.
        assert share["vt/within 15 deg"]["horizon"][3] > 0.97
        assert sum(share["vt/within 15 deg"]["horizon"][:2]) == 0.0
        # 4.3: tipped back and forth by 90 deg, at least two cameras at all times.
        assert sum(share["usu/tipped 90 deg"]["horizon"][:2]) == 0.0
        assert sum(share["vt/tipped 90 deg"]["horizon"][:2]) > 0.1
        assert share["vt/level"]["sun"] == 0.0
        assert sum(share["uw/any"]["lit horizon"]) == pytest.approx(1.0)


def test_uw_sees_the_sun_for_74_percent_of_sunlight_in_the_right_heading(seen: list[Result]) -> None:
    """4.2 names neither heading nor date: two cameras to the Sun's side, and the Sun low over the orbit."""
    tables = {result["beta"]: result["shares"] for result in seen if result["kind"] == "heading"}
    assert tables[15.0][coverage.BEST]["cone"] == pytest.approx(0.74, abs=0.03)
    assert tables[0.0][coverage.BEST]["square"] == pytest.approx(0.74, abs=0.03)
    for table in tables.values():
        for found in table.values():
            assert found["square"] >= found["cone"]
    # With one camera straight at it the Sun is never out of view when it stands over the orbit's side.
    assert tables[60.0]["one to the Sun's side"]["cone"] == 1.0


def test_the_summary_names_the_headings_that_give_the_paper_s_figure(
    seen: list[Result], tmp_path: Path
) -> None:
    summary = coverage.summarise(seen, tmp_path)
    assert (coverage.BEST, 15.0) in summary.facts["betas_of_paper"]["cone"]
    assert summary.facts["suites"]["usu/tipped 90 deg"]["least_cameras"] >= 2


def test_the_limb_by_day_is_the_half_that_the_sun_shines_on() -> None:
    """The Sun ahead and level: the forward half of the limb is by day, the other by night."""
    position = revolution(orbit_world.FIRST_DATE, 0.0, 6000.0).positions[:1]
    edge = limb(position)
    day = limb_in_daylight(position, edge, np.array([[1.0, 0.0, 0.0]]))
    np.testing.assert_array_equal(day, edge[..., 0] > 0.0)


def test_the_true_body_sways_as_it_is_said_to() -> None:
    """Five hours of it: 3 deg rms an axis within a third, and rates that are its attitudes' own."""
    rng = np.random.default_rng(SEED)
    frame = np.broadcast_to(np.eye(3), (36_000, 3, 3))
    attitudes = orbit_world._sway(frame, rng)
    off = 2.0 * attitudes[:, :3] / attitudes[:, 3:]
    assert np.sqrt(np.mean(off**2)) == pytest.approx(orbit_world.SWAY, rel=1.0 / 3.0)


def piece(variant: str, run: int, **parameters: float) -> Result:
    """Return fifteen minutes of an orbit, nine before sunset and six after."""
    parameters_ = {"variant": variant, "seconds": 900.0, **parameters}
    return orbit_attitude.run(Case(f"{variant}/{run}", (SEED, run), parameters_))


@pytest.mark.slow
def test_into_the_eclipse_the_filter_errs_by_no_more_than_it_says() -> None:
    """Two orbits, 15 minutes about sunset: NEES in its 99.9 % band, both lights within their limits."""
    results = [piece("all sensors", run) for run in range(2)]
    facts = orbit_attitude.variant_facts(results)
    # Errors last for minutes: taken as those of two independent instants an orbit.
    low, high = band(2 * 6 * 2, 0.999)
    assert low < facts["nees_mean"] < high
    assert facts["both"]["rms"] < 0.05
    assert facts["eclipse"]["said"] < 0.4
    assert facts["eclipse"]["rms"] < 3.0 * facts["eclipse"]["said"]
    for kind, mean in facts["nis"].items():
        assert mean == pytest.approx(1.0, abs=0.15), kind
    assert not any(facts["refused"].values())
    assert {"observed", "aided"} <= {status for result in results for status in result["status"]}


@pytest.mark.slow
def test_covariances_that_are_claimed_too_small_are_found_out() -> None:
    """Sun and nadir said to be a quarter as far off as they are."""
    facts = orbit_attitude.variant_facts([piece("all sensors", 0, claimed=1.0 / 16.0)])
    assert facts["nis"]["nadir"] > 2.0
    assert facts["nees_mean"] > band(6 * 2, 0.999)[1]


def test_the_true_attitudes_are_those_of_the_readings() -> None:
    """Without noise a sensor would read what the attitude makes of the truth: the mean of the differences."""
    rng = np.random.default_rng(SEED)
    sensors = suite("uw")
    truth = orbit_world.world(sensors, rng, 300.0)
    said = orbit_world.readings(sensors, truth, rng)
    there = np.einsum("nij,nj->ni", attitude_matrix(truth.attitudes), truth.sun)
    assert np.std(said.sun - there) == pytest.approx(orbit_world.OPTICAL_SIGMA * np.sqrt(2.0 / 3.0), rel=0.1)
    off = said.gyro - said.gyro_bias - truth.rates
    assert sensors.gyros is not None
    assert np.std(off) == pytest.approx(sensors.gyros.sample_sigma, rel=0.1)
    assert not np.any(truth.sun_in_field & ~truth.sunlit)
