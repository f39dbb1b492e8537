"""Tests of planned motions that serve as references."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.gnc.control import pointing_path
from knightcube.gnc.control.pointing_path import PlannedMotion
from tests.support.compiled_forms import assert_forms_agree


def test_references_have_the_accelerations_that_lead_from_rate_to_rate() -> None:
    """The acceleration of a reference leads from each rate to the next, and is constant after the last rate.

    The motion has four rates at intervals of 0.5 s.
    """
    rate = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 3.0, 0.0], [1.0, 3.0, -2.0]])
    quaternion = np.tile([0.0, 0.0, 0.0, 1.0], (4, 1))
    times = np.array([10.0, 10.5, 11.0, 11.5])
    found = PlannedMotion(quaternion, rate, np.zeros((3, 4))).references(times)
    expected = [[2.0, 0.0, 0.0], [0.0, 6.0, 0.0], [0.0, 0.0, -4.0], [0.0, 0.0, -4.0]]
    assert found.acceleration.tolist() == expected
    assert found.acceleration[:-1] * 0.5 == pytest.approx(np.diff(found.rate, axis=0))
    assert found.times.tolist() == times.tolist()
    assert found.quaternion.shape == (4, 4)


def test_compiled_and_interpreted_sweeps_agree() -> None:
    generator = np.random.default_rng(2)
    steps, columns = 7, 4
    ahead, weights = generator.normal(size=(2, steps, 6, 6 + columns))
    weights[:, :, :6] = np.eye(6)
    by_control, slopes = generator.normal(size=(steps, 6, 3)), generator.normal(size=(steps, 3, columns))
    control, end = np.full((steps, 3), 0.5), generator.normal(size=(6, columns))
    assert_forms_agree(pointing_path._riccati, ahead, by_control, weights, control, slopes, np.eye(6), end)
    for form in (pointing_path._riccati.numpy_form, pointing_path._riccati.loop_form):
        assert form(ahead, 0.0 * by_control, weights, 0.0 * control, slopes, np.eye(6), end)[3]
