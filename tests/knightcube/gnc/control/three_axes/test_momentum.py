"""The momentum plan removes what it says in the time it says, near the least time there is."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.errors import UsageError
from knightcube.gnc.control.three_axes.field_detumbler import (
    LIMIT_GAIN,
    aligned_to,
    braking_dipole,
    momentum_plan,
    rotating_field,
    without_speed_up,
)

STEP, LIMIT, REST = 5.0, 0.1, 1e-5
TIMES = np.arange(0.0, 400.0 * STEP, STEP)
FIELD = rotating_field(np.array([0.0, 0.0, 4e-5]), np.array([4e-5 * 0.0022, 0.0, 0.0]), TIMES)
"""T: it turns by two turns in 95 min, as in a polar orbit."""


def left(momentum: FloatArray, costate: FloatArray, horizon: float) -> float:
    """Return the share of the momentum that is left by a dipole of the limit's length along the plan."""
    now = momentum.copy()
    for there in FIELD[: round(horizon / STEP)]:
        dipole = -np.cross(there, costate)
        dipole *= LIMIT_GAIN * LIMIT / max(float(np.linalg.norm(dipole)), 1e-2 * LIMIT)
        now += STEP * np.cross(dipole, there)
    return float(np.linalg.norm(now) / np.linalg.norm(momentum))


def least_time(momentum: FloatArray, field: FloatArray) -> float:
    """Return a bound from below: for any p, a dipole of that length takes at most its integral from p . h."""
    directions = np.random.default_rng(1).standard_normal((3000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    most = (
        np.cumsum(np.linalg.norm(np.cross(field[:, None], directions), axis=2), axis=0)
        * STEP
        * LIMIT
        * LIMIT_GAIN
    )
    enough = np.all(most >= directions @ momentum, axis=1)
    return float(STEP * (np.argmax(enough) + 1))


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.3, -0.7, 0.6)])
def test_the_plan_removes_the_momentum_in_nearly_the_least_time(
    direction: tuple[float, float, float],
) -> None:
    momentum = 1e-3 * np.array(direction)
    plan = momentum_plan(momentum, FIELD, TIMES, LIMIT, REST)
    assert left(momentum, plan.costate, plan.horizon) < 0.06
    least = least_time(momentum, FIELD)
    assert 0.98 * least - STEP <= plan.horizon < 1.02 * least + STEP


def test_momentum_along_the_field_waits_for_the_field_to_turn() -> None:
    along = momentum_plan(np.array([0.0, 0.0, 1e-3]), FIELD, TIMES, LIMIT, REST)
    across = momentum_plan(np.array([1e-3, 0.0, 0.0]), FIELD, TIMES, LIMIT, REST)
    assert along.horizon > 1.2 * across.horizon
    still = np.broadcast_to(FIELD[0], FIELD.shape)
    stuck = momentum_plan(np.array([0.0, 0.0, 1e-3]), still, TIMES, LIMIT, REST)
    assert stuck.horizon == STEP * len(FIELD)
    assert np.all(np.isfinite(stuck.costate))


def test_what_the_rest_allows_is_not_waited_for() -> None:
    """A tenth of the momentum lies along the field, which takes longer to turn than the others to stop."""
    momentum = np.array([1e-4, 0.0, 1e-5])
    exact, allowed = (momentum_plan(momentum, FIELD, TIMES, LIMIT, rest) for rest in (1e-7, 1.2e-5))
    assert allowed.horizon < 0.6 * exact.horizon


def test_the_field_ahead_begins_as_it_is_measured() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        ahead = rng.standard_normal((9, 3))
        field = ahead[0] + 0.5 * rng.standard_normal(3)
        turned = aligned_to(ahead, field)
        np.testing.assert_allclose(turned @ turned.T, ahead @ ahead.T, atol=1e-12)  # a rotation
        assert np.linalg.det(turned[1:4]) == pytest.approx(np.linalg.det(ahead[1:4]))
        if ahead[0] @ field > 0.0:
            along = field / np.linalg.norm(field) * np.linalg.norm(ahead[0])
            np.testing.assert_allclose(turned[0], along, atol=1e-12)


def test_the_dipole_never_adds_energy_to_what_the_plan_brakes_and_keeps_each_limit() -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        costate, field = rng.standard_normal(3), 4e-5 * rng.standard_normal(3)
        dipole = braking_dipole(1e4 * costate, field, LIMIT)
        assert float(np.abs(dipole).max()) <= LIMIT
        assert float(np.cross(dipole, field) @ costate) <= 0.0


def test_the_field_turned_ahead_keeps_its_strength_and_begins_with_its_change() -> None:
    field, change = np.array([1e-5, -2e-5, 3e-5]), np.array([3e-8, 2e-8, 5e-8])
    ahead = rotating_field(field, change, np.arange(50.0))
    np.testing.assert_allclose(np.linalg.norm(ahead, axis=1), np.linalg.norm(field), rtol=1e-12)
    across = change - field * float(field @ change) / float(field @ field)
    np.testing.assert_allclose(ahead[1] - ahead[0], across, rtol=0.01, atol=1e-10)
    np.testing.assert_array_equal(rotating_field(field, np.zeros(3), np.arange(3.0)), np.tile(field, (3, 1)))


def test_a_field_of_two_instants_is_refused_and_no_momentum_needs_no_dipole() -> None:
    with pytest.raises(UsageError, match="three instants"):
        momentum_plan(np.ones(3), FIELD[:2], TIMES[:2], LIMIT, REST)
    rest = momentum_plan(np.zeros(3), FIELD, TIMES, LIMIT, REST)
    assert not rest.costate.any()
    assert rest.horizon == 0.0


def test_without_gain_no_torque_makes_the_body_faster_and_what_brakes_it_stays() -> None:
    rng, inverse = np.random.default_rng(3), np.linalg.inv(np.diag([0.0066, 0.0333, 0.0333]))
    changed = 0
    for _ in range(100):
        dipole, field, rate = (
            0.2 * rng.standard_normal(3),
            4e-5 * rng.standard_normal(3),
            rng.standard_normal(3),
        )
        left = without_speed_up(dipole, field, rate, inverse)
        before, after = (float(rate @ inverse @ np.cross(m, field)) for m in (dipole, left))
        assert after <= 1e-9 * abs(before) or before <= 0.0
        assert np.abs(left).max() <= np.abs(dipole).max() * (1.0 + 1e-12)
        if before <= 0.0:
            np.testing.assert_array_equal(left, dipole)
        changed += before > 0.0
    assert 30 < changed < 70
