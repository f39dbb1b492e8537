"""Runs a small slice of the RSO campaigns: objects are detected without false alarms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ground.campaigns.runner import Case
from tests.studies.campaigns.rso import by_magnitude, ends_error
from tests.studies.campaigns.rso_orbits import (
    ESTIMATORS,
    TABLE_MAGNITUDE,
    THESIS,
    cases,
    flown,
    mean_errors,
    one_frame,
    rate_error,
    star_streaks,
    summarise,
)
from tests.support.scenes import BRIGHTEST, catalogue, faintest

SEED = 8


def test_the_orbits_give_the_thesis_s_opportunities_and_the_hardest_is_found() -> None:
    scenario, times = flown((SEED, 0), 0)
    assert len(times) == 14
    # In the twelfth frame the object moves almost like a star, up to 4 px from the border.
    case = Case("0/4.0", (SEED, 0), {"run": 0, "magnitude": 4.0})
    frame = one_frame(scenario, times[11], case, 11)
    assert frame["error_px"] < 0.5
    assert frame["false"] == 0
    assert np.array(frame["strict"]).shape == np.array(THESIS).shape
    # With Harris's corners, the thesis states errors below 1 % and 0.4 deg over the ten orbits.
    for name in ESTIMATORS:
        assert abs(frame[name][0]) < 0.01
        assert frame[name][1] < 0.8
    facts = summarise([{"run": 0, "magnitude": 4.0, "frames": []}], Path()).facts
    assert facts["skies"]["whole"]["judge"] == [0, 0, 0]
    ends, _ = star_streaks(scenario, times[11])
    # The stars move along the rows at 0.05 rad/s: 73 px in half a second at the image centre.
    middle = np.abs(ends - 512.0).max(axis=(1, 2)) < 100.0
    assert np.all(np.abs(np.linalg.norm(ends[middle, 1] - ends[middle, 0], axis=1) - 73.0) < 2.0)


def test_fewer_stars_are_the_brightest_and_table_4_4_counts_them_apart() -> None:
    """In the first frame with only the 7,000 brightest stars, every rule selects the object alone."""
    stars = catalogue(faintest(BRIGHTEST))[0]
    # Magnitudes have two decimals, so several stars have the magnitude of the faintest star.
    assert BRIGHTEST <= len(stars.magnitude) < 1.02 * BRIGHTEST
    assert stars.magnitude.max() < 6.5
    tables = [case for case in cases(1, SEED) if case.parameters["stars"] == BRIGHTEST]
    assert [case.parameters["magnitude"] for case in tables] == [TABLE_MAGNITUDE]
    scenario, times = flown(tables[0].seed, 0)
    frame = one_frame(scenario, times[0], tables[0], 0)
    facts = summarise([{**tables[0].parameters, "frames": [frame]}], Path()).facts
    table = facts["skies"]["brightest 7000"]
    assert table["judge"] == [1, 0, 0]
    assert facts["frames"] == 0
    assert table["harris"]["magnitude_percent"] < 1.0
    assert mean_errors([]) == {"rates": 0, "magnitude_percent": None, "axis_deg": None}
    assert rate_error(np.array([0.0, 0.0, 0.051])) == pytest.approx([0.02, 90.0])


def test_another_run_starts_elsewhere() -> None:
    first, other = flown((SEED, 0), 0)[0], flown((SEED, 1), 1)[0]
    at = np.array([0.0])
    assert np.allclose(first.attitude(at), [0.0, 0.0, 0.0, 1.0])
    assert not np.allclose(first.attitude(at), other.attitude(at))


def test_a_magnitude_without_frames_has_no_error() -> None:
    empty = by_magnitude([], 4.0)
    assert (empty["frames"], empty["error_px"]) == (0, None)


def test_ends_may_come_in_either_order() -> None:
    ends = np.array([[0.0, 0.0], [30.0, 40.0]])
    assert ends_error(ends[::-1], ends) == 0.0
    assert ends_error(ends + np.array([3.0, 4.0]), ends) == pytest.approx(5.0)
