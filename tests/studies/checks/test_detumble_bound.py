"""The bound of detumbling's time in fields whose least time is known."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from tests.studies.campaigns.detumble import least_time

STEP, REACH, STRENGTH = 5.0, 0.1, 4e-5
STILL = np.tile([0.0, 0.0, STRENGTH], (400, 1))
MIDDLES = STEP * (np.arange(400) + 0.5)


def least(momentum: list[float], field: FloatArray, left: float = 0.0) -> float:
    return least_time(np.array(momentum), field, STEP, REACH, left)


def test_across_a_field_that_stands_the_torque_is_all_there_is() -> None:
    torque = REACH * STRENGTH
    assert least([3e-4, 4e-4, 0.0], STILL) == pytest.approx(5e-4 / torque, rel=1e-3)
    assert least([3e-4, 4e-4, 0.0], STILL, left=1e-4) == pytest.approx(4e-4 / torque, rel=1e-3)


def test_along_a_field_that_stands_no_time_suffices() -> None:
    assert least([0.0, 0.0, 1e-4], STILL) == pytest.approx(STEP * 400, rel=0.01)


def test_what_lies_along_a_field_that_turns_waits_for_the_turn() -> None:
    """Torques across the field must cancel: a direction half of the turn ahead asks for more than h's own."""
    speed = 2.2e-3
    turning = STRENGTH * np.stack([np.sin(speed * MIDDLES), 0.0 * MIDDLES, np.cos(speed * MIDDLES)], axis=1)
    own = np.arccos(1.0 - 1e-4 * speed / (REACH * STRENGTH)) / speed
    found = least([0.0, 0.0, 1e-4], turning)
    assert own < found < 1.5 * own
    ahead = np.array([np.sin(0.5 * speed * found), 0.0, np.cos(0.5 * speed * found)])
    across = np.linalg.norm(np.cross(turning[found > MIDDLES], ahead), axis=1)
    assert REACH * STEP * across.sum() == pytest.approx(1e-4 * ahead[2], rel=0.05)
