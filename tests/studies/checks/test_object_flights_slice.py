"""Runs a slice of the campaign `object-flights`, and tests its bound against an analytical result."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ground.campaigns.runner import Case
from tests.studies.campaigns.object_flights import cases, least_deviation, run, summarise


@pytest.mark.parametrize("lean", [0.0, np.radians(30.0)])
def test_the_bound_is_that_of_a_catch_up_by_hand(lean: float) -> None:
    """An object at w = 0.3 deg/s leads a body accelerating at a = 0.012 deg/s^2 by at most w^2 / 2 a.

    The object starts 1 deg short of the boresight, which reduces the lead by 1 deg. If the field leans
    towards the axis of rotation, the authority is multiplied by the cosine of that angle.
    """
    rate, authority, step = np.radians(0.3), np.radians(0.012), 0.5
    times = np.arange(0.0, 60.0, step)
    angle = rate * times - np.radians(1.0)
    directions = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(times))], axis=1)
    field = np.tile([np.cos(lean), 0.0, np.sin(lean)], (len(times), 1))
    least = least_deviation(step, directions, np.array([1.0, 0.0, 0.0]), field, authority, np.radians(5.0))
    # The body rotates about z, by torques normal to a field in the plane of x and z.
    expected = rate**2 / (2.0 * authority * np.cos(lean)) - np.radians(1.0)
    assert least == pytest.approx(max(expected, np.radians(1.0)), rel=0.06)


def test_a_slow_object_is_kept_through_ten_seconds_without_it(tmp_path: Path) -> None:
    wanted = {"craft": "cubesat_3u", "orbit": "sso", "share": 0.3, "band": 0, "magnitude": 4.0, "gap": 60.0}
    found = run(Case("slow", (5, 0, 0), wanted))
    assert found["found"] <= 20.0
    assert found["could"]
    assert found["kept"]
    assert found["same"]
    assert found["end"] < 0.5
    assert found["most"] >= found["least"] - 0.1
    json.dumps(summarise([found], tmp_path).facts, allow_nan=False)
    assert len({case.key for case in cases(2, 1)}) == 16


def test_a_followed_object_is_kept_by_rolling_no_faster_than_the_body_may_turn() -> None:
    """In this pass of seed 5, the object is lost if paths are rejected that are too fast only at the end."""
    (case,) = (case for case in cases(1, 5) if case.key == "knightcube/0.2/0")
    found = run(case)
    assert found["kept"]
    assert found["refused"] <= 5, "of about a hundred"
    assert found["rate"] < 1.0, "deg/s, from which it would be braked"
    assert found["most"] < found["least"] + 1.0
