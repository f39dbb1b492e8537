"""Tests that a control cycle, the opening of a flight and a star fix use at most the permitted files."""

from __future__ import annotations

import numpy as np

from knightcube.astro import quaternion
from tests.studies.house import LIMITS, Touched, measure


def test_a_cycle_an_opening_and_a_star_fix_enter_few_files() -> None:
    entered = measure()
    assert "flight/loop/control_cycle.py" in entered["control cycle"]
    assert "flight/app/flight.py" in entered["opening of a flight"]
    assert "knightcube/vision/star_tracker.py" in entered["star fix"]
    assert {name: len(files) for name, files in entered.items() if len(files) > LIMITS[name]} == {}


def test_a_called_function_counts_and_a_function_that_is_not_called_does_not() -> None:
    touched = Touched()
    with touched.measured():
        pass
    assert touched.files == set()
    with touched.measured():
        quaternion.conjugate(np.array([0.0, 0.0, 0.0, 1.0]))
    assert touched.files == {"knightcube/astro/quaternion.py"}
