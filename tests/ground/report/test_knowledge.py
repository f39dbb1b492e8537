"""What the report says of a satellite's residual dipole, in sunlight and in shadow."""

from __future__ import annotations

import math
from typing import cast

import numpy as np
import pytest

from ground.report.knowledge import JUDGED, dipole_errors
from ground.telemetry.reader import Run

SHADOW, END = 2 * JUDGED, 3 * JUDGED
"""s, from which the satellite is in shadow, and the end of the flight."""
TRUE = np.array([6e-4, 0.0, 8e-4])


def flown(known: bool = True) -> Run:
    """Return a flight whose estimate is off by half, later by a tenth, in shadow by a fifth of the dipole."""
    times = np.arange(END)
    share = np.where(times < SHADOW - JUDGED, 0.5, np.where(times < SHADOW, 0.1, 0.2))
    packets = np.zeros(END, dtype=[("time_ns", "i8"), ("residual_dipole", "f8", 3)])
    truth = np.zeros(END, dtype=[("time_ns", "i8"), ("residual_dipole", "f8", 3), ("sunlit", "f8")])
    packets["time_ns"] = truth["time_ns"] = times * 1_000_000_000
    packets["residual_dipole"] = TRUE * (1.0 + share[:, None]) if known else math.nan
    truth["residual_dipole"], truth["sunlit"] = TRUE, times < SHADOW
    return cast(Run, {"navigation": packets, "orbit_truth": truth})


def test_the_last_ten_minutes_of_each_light_are_judged() -> None:
    found = dipole_errors(flown())
    assert found["sunlight"] == pytest.approx(0.1)
    assert found["shadow"] == pytest.approx(0.2)


def test_without_an_estimate_nothing_is_said() -> None:
    assert all(math.isnan(share) for share in dipole_errors(flown(known=False)).values())
