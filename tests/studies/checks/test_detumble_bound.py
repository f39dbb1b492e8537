"""Tests of the lower bound of the detumbling time in fields with a known minimum time."""

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


def test_across_a_constant_field_the_bound_is_momentum_divided_by_torque() -> None:
    torque = REACH * STRENGTH
    assert least([3e-4, 4e-4, 0.0], STILL) == pytest.approx(5e-4 / torque, rel=1e-3)
    assert least([3e-4, 4e-4, 0.0], STILL, left=1e-4) == pytest.approx(4e-4 / torque, rel=1e-3)


def test_along_a_constant_field_no_time_is_sufficient() -> None:
    assert least([0.0, 0.0, 1e-4], STILL) == pytest.approx(STEP * 400, rel=0.01)


def test_momentum_along_a_rotating_field_waits_for_the_rotation() -> None:
    """The field rotates in a plane, and the momentum is along the initial field.

    The direction ahead of the momentum by half of the field's rotation gives the largest bound.
    """
    speed = 2.2e-3
    turning = STRENGTH * np.stack([np.sin(speed * MIDDLES), 0.0 * MIDDLES, np.cos(speed * MIDDLES)], axis=1)
    own = np.arccos(1.0 - 1e-4 * speed / (REACH * STRENGTH)) / speed
    found = least([0.0, 0.0, 1e-4], turning)
    assert own < found < 1.5 * own
    ahead = np.array([np.sin(0.5 * speed * found), 0.0, np.cos(0.5 * speed * found)])
    across = np.linalg.norm(np.cross(turning[found > MIDDLES], ahead), axis=1)
    assert REACH * STEP * across.sum() == pytest.approx(1e-4 * ahead[2], rel=0.05)


def test_a_torque_of_other_causes_shortens_the_bound() -> None:
    torque = REACH * STRENGTH
    found = least_time(np.array([3e-4, 4e-4, 0.0]), STILL, STEP, REACH, 0.0, others=0.25 * torque)
    assert found == pytest.approx(4e-4 / torque, rel=1e-3)


def test_no_control_of_full_strength_beats_the_bound() -> None:
    """No law with full dipoles along -B x (h + c), with a random constant c, ends before the bound."""
    speed, rng = 2.2e-3, np.random.default_rng(7)
    turning = STRENGTH * np.stack([np.sin(speed * MIDDLES), 0.0 * MIDDLES, np.cos(speed * MIDDLES)], axis=1)
    for _ in range(40):
        start = 3e-4 * rng.standard_normal(3)
        constant = rng.choice([0.0, 1.0]) * 3e-4 * rng.standard_normal(3)
        left, now, steps = 0.3 * float(np.linalg.norm(start)), start.copy(), 0
        while steps < len(turning) and np.linalg.norm(now) > left:
            dipole = -np.cross(turning[steps], now + constant * np.linalg.norm(now) / np.linalg.norm(start))
            now += STEP * np.cross(REACH * dipole / np.linalg.norm(dipole), turning[steps])
            steps += 1
        assert least_time(start, turning, STEP, REACH, left) <= STEP * steps + 1e-6
