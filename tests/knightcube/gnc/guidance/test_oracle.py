"""Tests of the reference optimiser against published optima and a closed form."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.collocation_oracle import Slew, solve
from tests.support.step_problems import known_optima


def test_the_oracle_reproduces_the_published_optima_to_1e_4() -> None:
    """The trapezoidal rule with 400 intervals agrees with twenty Hermite-Simpson optima to 4e-5."""
    for known in known_optima():
        found = solve(known.problem.slew(known.problem.horizon))
        assert found is not None
        assert found.energy == pytest.approx(known.energy, rel=1e-4)


def test_the_oracle_reproduces_the_closed_form_of_a_small_slew() -> None:
    """For a small slew, int I^2 dt equals the closed form, 12 a^2 / T^3.

    With cos(theta) = 1 and without a limit, theta'' is linear in time.
    """
    angle, horizon, gain = 1e-3, 10.0, 2.916e-4 / 1.05e-3
    found = solve(Slew(0.0, 0.0, angle, 0.0, horizon, 1.05e-3, 2.916e-4, 23.0, 0.148))
    assert found is not None
    assert found.energy == pytest.approx(23.0 * 12.0 * (angle / gain) ** 2 / horizon**3, rel=1e-4)


def test_the_oracle_keeps_the_limit_and_finds_no_path_below_the_shortest_time() -> None:
    for known in known_optima()[:4]:
        found = solve(known.problem.slew(1.02 * known.shortest))
        assert found is not None
        assert np.abs(found.current).max() <= known.problem.plant.current_limit
        assert solve(known.problem.slew(0.97 * known.shortest)) is None
