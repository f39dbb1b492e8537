"""Tests that a body points to the Sun by gyro, strings and field, and is damped without a Sun direction."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray, cross_product
from knightcube.astro.quaternion import IDENTITY, attitude_matrix, from_rotation_vector, multiply
from knightcube.gnc.control.detumble import WindowSchedule
from knightcube.gnc.control.sun_acquisition import MEMORY, SunAcquisition, SunAcquisitionSettings
from tests.support.recorded_results import check

SCHEDULE = WindowSchedule(100_000_000, 100_000_000, 1_800_000_000)
INERTIA, LIMIT = np.array([1.10e-3, 1.05e-3, 0.99e-3]), 0.0959
Z = np.array([0.0, 0.0, 1.0])
TURN = np.array([0.0, 2.2e-3, 0.0])
"""Rotation rate (rad/s) of the field: two rotations per orbit."""
OWN_FIELD = 4e-4
"""Field that the coils cause at the magnetometer (T per A m^2)."""
BIAS = np.array([4e-4, -3e-4, 5e-4])
STEP_NS = 100_000_000


def seeker() -> SunAcquisition:
    return SunAcquisition(SCHEDULE, SunAcquisitionSettings(inertia=np.diag(INERTIA), axis=Z, limit=LIMIT))


def fly(sun: FloatArray | None, rate: FloatArray, seconds: float) -> tuple[FloatArray, FloatArray]:
    """Return every ten seconds the angle (deg) between axis and Sun, and the rate (deg/s)."""
    law, rng, step = seeker(), np.random.default_rng(2), 1e-9 * STEP_NS
    attitude, dipole, notes = IDENTITY, np.zeros(3), []
    for k in range(round(seconds / step)):
        now_ns, turned = k * STEP_NS, attitude_matrix(attitude)
        inertial = attitude_matrix(from_rotation_vector(k * step * TURN)).T @ np.array([1.5e-5, 1e-5, 3e-5])
        field = turned @ inertial
        if sun is not None and k % 10 == 0:
            law.update_sun(now_ns, turned @ sun)
        if k % 100 == 0:
            off = 0.0 if sun is None else np.degrees(np.arccos(np.clip(Z @ turned @ sun, -1.0, 1.0)))
            notes.append((off, np.degrees(np.linalg.norm(rate))))
        law.sample(now_ns, field + OWN_FIELD * dipole + 1e-7 * rng.standard_normal(3), rate + BIAS)
        dipole = law.dipole(now_ns)
        assert np.abs(dipole).max() <= LIMIT * (1.0 + 1e-12)
        torque = cross_product(dipole, field) - cross_product(rate, INERTIA * rate)
        rate = rate + step * torque / INERTIA
        attitude = multiply(from_rotation_vector(step * rate), attitude)
    off, speed = np.array(notes).T
    return off, speed


def test_it_turns_to_the_sun_from_behind() -> None:
    sun = np.array([0.6, 0.3, -0.74])
    off, speed = fly(sun / np.linalg.norm(sun), np.radians([0.3, -0.2, 0.4]), 700.0)
    assert off[0] > 130.0
    assert off[-10:].max() < 30.0
    assert speed.max() < 1.0, "slower than what is braked"


def test_without_a_sun_it_is_held_still() -> None:
    _, speed = fly(None, np.radians([0.3, -0.2, 0.4]), 300.0)
    assert speed[-1] < 0.8 * speed[0], "what lies along the field stays until the field has turned"
    assert np.all(np.diff(speed) < 0.02)


def test_a_sun_that_is_no_longer_seen_is_carried_on_by_the_gyro_and_then_forgotten() -> None:
    law, rate = seeker(), np.array([0.0, 0.002, 0.0])
    law.update_sun(0, Z)
    for second in range(1, int(MEMORY) + 1):
        law.sample(second * 1_000_000_000, np.array([0.0, 0.0, 3e-5]), rate)
    carried = attitude_matrix(from_rotation_vector(MEMORY * rate)) @ Z
    assert law.sun == pytest.approx(carried, abs=1e-6)
    law.sample(int(MEMORY + 1.0) * 1_000_000_000, np.array([0.0, 0.0, 3e-5]), rate)
    assert law.sun is None


def test_a_single_field_or_one_that_jumps_starts_no_coil() -> None:
    law = seeker()
    law.update_sun(0, np.array([1.0, 0.0, 0.0]))
    acted = []
    for k in range(1, 400):
        now_ns = k * 25_000_000
        window = now_ns // SCHEDULE.period_ns
        field = np.array([0.0, 1e-5, 3e-5]) if window != 2 else np.array([3e-5, 0.0, 0.0])
        law.sample(now_ns, field, np.zeros(3))
        if law.dipole(now_ns).any():
            acted.append(int(window))
    # After the first pause only one field is known. The fields of pauses 2 and 3 contradict their
    # predecessors.
    assert set(acted) == {1, 4}


def test_no_dipole_in_the_pauses_and_a_reading_that_is_not_finite_is_left_out() -> None:
    law = seeker()
    law.update_sun(0, np.array([1.0, 0.0, 0.0]))
    for k in range(1, 240):
        now_ns = k * 25_000_000
        law.sample(now_ns, np.array([0.0, 1e-5, 3e-5]) if k % 7 else np.full(3, np.nan), np.zeros(3))
        pausing = now_ns % SCHEDULE.period_ns < 200_000_000
        assert not (pausing and law.dipole(now_ns).any())
    assert law.dipole(239 * 25_000_000).any()


def test_the_acquisition_of_the_sun_is_as_recorded() -> None:
    towards = np.array([0.6, 0.3, -0.74])
    slow = np.radians([0.3, -0.2, 0.4])
    suns = (towards / np.linalg.norm(towards), None)
    check(__file__, "sun", [fly(sun, slow, 41.0) for sun in suns], 1e-4)


def test_the_bandwidth_is_that_of_the_largest_principal_moment() -> None:
    turn = attitude_matrix(from_rotation_vector(np.array([0.3, -0.5, 0.4])))
    moments = np.diag([1.1e-2, 3.05e-2, 2.2e-2])
    plain, rotated = (
        SunAcquisitionSettings(inertia=inertia, axis=Z, limit=1e-3).speed
        for inertia in (moments, turn @ moments @ turn.T)
    )
    assert plain == pytest.approx((0.6 * 1e-3 * 3e-5 / 3.05e-2) ** 0.5)
    assert rotated == pytest.approx(plain)
