"""Tests of the motion of a free satellite during a short step."""

from __future__ import annotations

import numpy as np

from knightcube.astro.quaternion import normalise
from knightcube.gnc.estimation import free_motion
from tests.support.compiled_forms import assert_forms_agree


def test_compiled_and_interpreted_steps_agree() -> None:
    generator = np.random.default_rng(4)
    inertia = np.diag([1.1e-3, 1.05e-3, 0.99e-3]) + 1e-5
    body = inertia, np.linalg.inv(inertia), np.array([0.9, 1.0, 1.1]), 3.14e-3
    around = (
        3e-5 * generator.normal(size=3),
        7e6 * normalise(generator.normal(size=3)),
        generator.normal(size=(1, 3)),
        generator.normal(size=(1, 3)),
    )
    quaternion, sizes = normalise(generator.normal(size=4)), 1e-8 * generator.normal(size=9)
    rate, driven, dipole = 0.05 * generator.normal(size=(3, 3))
    assert_forms_agree(
        free_motion._step, body, quaternion, rate, driven, dipole, sizes, around, 0.7, 4e14, 0.4
    )
