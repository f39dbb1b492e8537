"""Tests of initial guesses of slews: their momenta are feasible and end at the target, outside the cones."""

from __future__ import annotations

import numpy as np

from knightcube.astro.quaternion import angle_between, attitude_matrix
from knightcube.gnc.guidance.slew_model import AttitudeEnd
from knightcube.gnc.guidance.slew_search import SlewSolver, guesses
from tests.support.random_slews import slews


def test_first_guesses_need_no_torque_along_the_field_end_in_the_target_and_keep_the_cones() -> None:
    """Initial guesses need no torque along the field, end at the target and avoid the cones.

    In case 0 of `bench orbit_slews --cones --seed 43` every path without limits passes through a cone.
    """
    (_, task), *_ = slews(1, 43, True)
    solver = SlewSolver(task)
    equations = solver.equations(task.horizon, 24)
    kept, scale = solver.kept(equations), task.horizon
    found = guesses(equations, task.craft, kept)
    end = task.end(task.horizon)
    assert isinstance(end, AttitudeEnd)
    for guess in found[:3]:
        q, rate = guess.states[:, :4], guess.states[:, 4:] / scale
        momentum = np.einsum("nji,nj->ni", attitude_matrix(q), rate @ task.craft.inertia)
        torque = np.gradient(momentum, scale / 48.0, axis=0)
        field = equations.around.field
        along = np.abs(np.sum(torque * field, axis=1)) / np.linalg.norm(field, axis=1)
        assert along[1:-1].max() < 0.03 * np.linalg.norm(torque, axis=1).max()
        assert float(angle_between(q[-1], end.quaternion)) < 0.1
        assert kept.values(q[1:]).min() > -0.02


def test_guesses_are_the_same_each_time() -> None:
    (_, task), *_ = slews(1, 43, False)
    solver = SlewSolver(task)
    equations = solver.equations(task.horizon, 10)
    first, then = (guesses(equations, task.craft, solver.kept(equations)) for _ in range(2))
    assert len(first) == len(then) > 3
    np.testing.assert_array_equal(first[0].states, then[0].states)
