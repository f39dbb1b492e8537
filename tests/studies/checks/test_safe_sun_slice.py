"""Runs a slice of the campaign `safe-sun` with the Sun behind the body, and tests its results."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from ground.campaigns.runner import Case
from tests.studies.campaigns import safe_sun


def test_a_knightcube_finds_the_sun_by_strings_and_gyro_and_holds_it(tmp_path: Path) -> None:
    parameters = {"craft": "knightcube", "share": 0.3, "orbit": "sso", "seconds": 1600.0}
    result = safe_sun.run(Case("k", (20_261_125, 3), parameters))
    assert result["found"] < 400.0
    assert result["rms"] < 10.0, "of its second half, in sunlight"
    assert result["fastest_deg"] < 1.0, "the mode brakes a faster body"
    facts = safe_sun.summarise([result], tmp_path).facts["knightcube/0.3"]
    assert facts["runs"] == 1
    assert facts["held"] == int(result["rms"] <= safe_sun.NEAR)


def test_time_after_an_eclipse_counts_and_so_does_a_sun_that_is_never_found() -> None:
    times = np.arange(10.0)
    lit = np.array([1.0, 1, 1, 0, 0, 1, 1, 1, 1, 1])
    off = np.array([90.0, 10, 10, 50, 50, 30, 30, 10, 10, 10])
    found = safe_sun.judged(np.column_stack([times, off, lit, np.ones(10)]), 0.5)
    assert (found["found"], found["again"], found["worst"], found["missed"]) == (1.0, 2.0, 30.0, 0)
    assert found["rms"] == pytest.approx(math.sqrt((5 * 100.0 + 2 * 900.0) / 7.0))
    assert found["rms_dark"] == pytest.approx(50.0)
    never = safe_sun.judged(np.column_stack([times, np.full(10, 90.0), lit, np.ones(10)]), 0.5)
    assert never["found"] is None
    assert never["again"] is None
    assert never["missed"] == 2
