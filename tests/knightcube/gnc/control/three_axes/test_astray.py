"""A body that is astray is held still: damping takes energy in any attitude, until the body is slow."""

from __future__ import annotations

import numpy as np

from knightcube.gnc.control.three_axes.pointing_law import (
    FAR,
    LEAVING,
    PATIENCE,
    SLOW,
    PathRecovery,
    damping_dipole,
)


def test_damping_takes_energy_from_any_rate_in_any_field() -> None:
    rng, inertia = np.random.default_rng(1), np.array([1.1e-3, 1.05e-3, 0.99e-3])
    for _ in range(50):
        rate, field = 0.02 * rng.standard_normal(3), 4e-5 * rng.standard_normal(3)
        torque = np.cross(damping_dipole(inertia, rate, field), field)
        # The power of -J rate across the field; for equal moments never positive.
        assert float(rate @ torque) < 1e-3 * float(np.linalg.norm(rate) * np.linalg.norm(torque))
        assert (
            abs(float(torque @ field)) < 1e-12 * float(np.linalg.norm(torque) * np.linalg.norm(field)) + 1e-24
        )


def seen(astray: PathRecovery, off: float, speed: float, now: float) -> tuple[float | None, bool]:
    astray.update(off, speed, now)
    return astray.since, astray.ready


def test_far_off_its_path_a_body_is_held_still_until_it_is_slow() -> None:
    astray = PathRecovery()
    assert seen(astray, 0.99 * FAR, 1.0, 0.0) == (None, False)
    assert seen(astray, 1.01 * FAR, 2.0 * SLOW, 10.0) == (10.0, False)
    # Nearer again it is held still all the same.
    assert seen(astray, 0.0, 2.0 * SLOW, 20.0) == (10.0, False)
    assert seen(astray, 3.0 * FAR, 0.9 * SLOW, 30.0) == (10.0, True)
    astray.planned()
    assert seen(astray, 0.0, SLOW, 31.0) == (None, False)


def test_a_spin_along_the_field_is_not_waited_for() -> None:
    astray = PathRecovery()
    astray.update(2.0 * FAR, 5.0 * SLOW, 0.0)
    assert not seen(astray, 2.0 * FAR, 5.0 * SLOW, PATIENCE - 1.0)[1]
    assert seen(astray, 2.0 * FAR, 5.0 * SLOW, PATIENCE + 1.0)[1]


def test_a_body_that_leaves_its_path_is_planned_for_again_while_it_flies_it() -> None:
    astray = PathRecovery()
    for off, leaving in ((0.9 * LEAVING, False), (1.1 * LEAVING, True), (1.1 * FAR, False)):
        astray.update(off, SLOW, 0.0)
        assert astray.leaving == leaving
    astray.planned()
    astray.update(1.1 * LEAVING, SLOW, 1.0)
    astray.planned()
    assert not astray.leaving
