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
    """Return two revolutions, and the table of headings of UW at three elevations of the Sun."""
    cases = [
        case for case in coverage.cases(2, SEED) if case.parameters.get("beta", 15.0) in (0.0, 15.0, 60.0)
    ]
    return [coverage.run(case) for case in cases]


def test_vt_has_the_horizon_in_all_three_cameras_to_14_deg_of_tilt() -> None:
    """Section 4.1 of the paper states 15 deg.

    A field of 67 deg and a limb 19.3 deg below the horizontal give 33.5 - 19.3 = 14.2 deg.
    """
    dip = np.degrees(np.arccos(6378.1366 / (6378.1366 + 380.0)))
    assert np.degrees(coverage.all_three_up_to()) == pytest.approx(33.5 - dip, abs=0.2)


def test_the_shares_are_the_paper_s(seen: list[Result]) -> None:
    shares = [result["shares"] for result in seen if result["kind"] == "orbit"]
    for share in shares:
        assert share["vt/level"]["horizon"][3] == 1.0
        assert share["uw/level"]["horizon"][4] == 0.0
        # Section 4.1: within 15 deg of tilt all three cameras show the horizon, except in the last degree.
        assert share["vt/within 15 deg"]["horizon"][3] > 0.97
        assert sum(share["vt/within 15 deg"]["horizon"][:2]) == 0.0
        # Section 4.3: when pitched back and forth by 90 deg, at least two cameras show the horizon at all
        # times.
        assert sum(share["usu/tipped 90 deg"]["horizon"][:2]) == 0.0
        assert sum(share["vt/tipped 90 deg"]["horizon"][:2]) > 0.1
        assert share["vt/level"]["sun"] == 0.0
        assert sum(share["uw/any"]["lit horizon"]) == pytest.approx(1.0)


def test_uw_sees_the_sun_for_74_percent_of_sunlight_in_the_right_heading(seen: list[Result]) -> None:
    """Section 4.2 of the paper states neither heading nor date.

    The paper's value of 74 % results with two cameras on the Sun's side and a low Sun.
    """
    tables = {result["beta"]: result["shares"] for result in seen if result["kind"] == "heading"}
    assert tables[15.0][coverage.BEST]["cone"] == pytest.approx(0.74, abs=0.03)
    assert tables[0.0][coverage.BEST]["square"] == pytest.approx(0.74, abs=0.03)
    for table in tables.values():
        for found in table.values():
            assert found["square"] >= found["cone"]
    # If one camera points at the Sun, the Sun is always in view at a high elevation above the orbital plane.
    assert tables[60.0]["one to the Sun's side"]["cone"] == 1.0


def test_the_summary_names_the_headings_that_give_the_paper_s_figure(
    seen: list[Result], tmp_path: Path
) -> None:
    summary = coverage.summarise(seen, tmp_path)
    assert (coverage.BEST, 15.0) in summary.facts["betas_of_paper"]["cone"]
    assert summary.facts["suites"]["usu/tipped 90 deg"]["least_cameras"] >= 2


def test_the_limb_by_day_is_the_half_that_the_sun_shines_on() -> None:
    """With a level Sun straight ahead, the forward half of the limb is sunlit, and the other half is dark."""
    position = revolution(orbit_world.FIRST_DATE, 0.0, 6000.0).positions[:1]
    edge = limb(position)
    day = limb_in_daylight(position, edge, np.array([[1.0, 0.0, 0.0]]))
    np.testing.assert_array_equal(day, edge[..., 0] > 0.0)


def test_the_true_body_sways_as_it_is_said_to() -> None:
    """Over five hours, the rms of the attitude motion about each axis is 3 deg to within a third."""
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
    """Two orbits, each 15 minutes around sunset, have a NEES in its 99.9 % band and errors within limits."""
    results = [piece("all sensors", run) for run in range(2)]
    facts = orbit_attitude.variant_facts(results)
    # Errors are correlated over minutes, so an orbit counts as two independent instants.
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
    """The claimed errors of Sun and nadir are a quarter of the true ones."""
    facts = orbit_attitude.variant_facts([piece("all sensors", 0, claimed=1.0 / 16.0)])
    assert facts["nis"]["nadir"] > 2.0
    assert facts["nees_mean"] > band(6 * 2, 0.999)[1]


def test_the_true_attitudes_are_those_of_the_readings() -> None:
    """The mean of the readings, expressed in the axes of the attitude, is the truth."""
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
