"""Tests that a body points to the Sun by gyro, strings and field, and is damped without a Sun direction."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray, cross_product
from knightcube.astro.quaternion import IDENTITY, attitude_matrix, from_rotation_vector, multiply
from knightcube.errors import ArgumentError
from knightcube.gnc.control.detumble import WindowSchedule
from knightcube.gnc.control.sun_acquisition import (
    DIPOLE_GAIN,
    DRIFT,
    JUMP,
    LARGEST_BIAS,
    LONGEST_GAP,
    LONGEST_INTERVAL,
    MEMORY,
    SMOOTHED,
    PropagatedSun,
    ResidualDipole,
    SunAcquisition,
    SunAcquisitionSettings,
)
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


def test_the_body_turns_to_a_sun_behind_it() -> None:
    sun = np.array([0.6, 0.3, -0.74])
    off, speed = fly(sun / np.linalg.norm(sun), np.radians([0.3, -0.2, 0.4]), 700.0)
    assert off[0] > 130.0
    assert off[-10:].max() < 30.0
    assert speed.max() < 1.0, "slower than what is braked"


def test_without_a_sun_the_body_is_damped() -> None:
    _, speed = fly(None, np.radians([0.3, -0.2, 0.4]), 300.0)
    assert speed[-1] < 0.8 * speed[0], "what lies along the field stays until the field has turned"
    assert np.all(np.diff(speed) < 0.02)


def test_a_rotation_along_the_field_is_removed_while_the_field_rotates() -> None:
    """The field rotates by 190 deg; with a higher gain, the momentum follows the field and remains."""
    along = np.array([1.5e-5, 1e-5, 3e-5])
    _, speed = fly(None, np.radians(0.8) * along / np.linalg.norm(along), 1500.0)
    assert speed[-1] < 0.3 * speed[0]
    assert speed.max() < 1.02 * speed[0]


def test_a_sun_that_is_no_longer_measured_is_propagated_by_the_gyro_and_then_forgotten() -> None:
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


def test_after_a_gap_of_the_readings_two_fields_start_the_coils_again() -> None:
    """A field before the gap is unknown after the gap, in which the body may have rotated anywhere."""
    law = seeker()
    acted: list[int] = []
    for k in [*range(1, 150), *range(560, 800)]:
        now_ns = k * 25_000_000
        law.update_sun(now_ns, np.array([1.0, 0.0, 0.0]))
        law.sample(now_ns, np.array([0.0, 1e-5, 3e-5]), np.zeros(3))
        if law.dipole(now_ns).any():
            acted.append(now_ns // SCHEDULE.period_ns)
    # Readings are missing from 3.725 s (second window) to 14 s (start of the eighth window).
    assert sorted(set(acted)) == [1, 8, 9]


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


SECOND = 1_000_000_000


def turned_by(angle: float) -> FloatArray:
    """Return the direction z (3,) in axes that are rotated by an `angle` (rad) about x."""
    return np.array([0.0, np.sin(angle), np.cos(angle)])


def test_a_measured_sun_is_mixed_with_the_propagated_one_and_corrects_the_bias() -> None:
    """The weight of a measurement is the time since the last one, divided by the smoothing time."""
    sun = PropagatedSun()
    sun.measure(0, Z)
    assert sun.direction is not None
    np.testing.assert_array_equal(sun.direction, Z)
    since = 0.25 * SMOOTHED
    angle = 0.5 * np.arcsin(JUMP)
    sun.propagate(round(since * SECOND), np.eye(3))
    sun.measure(round(since * SECOND), turned_by(angle))
    mixed = 0.75 * Z + 0.25 * turned_by(angle)
    np.testing.assert_allclose(sun.direction, mixed / np.linalg.norm(mixed))
    expected = -DRIFT * since * np.cross(turned_by(angle), Z)
    np.testing.assert_allclose(sun.bias, np.clip(expected, -LARGEST_BIAS, LARGEST_BIAS))
    assert sun.bias.any()
    sun.propagate(round(9.0 * SMOOTHED * SECOND), np.eye(3))
    for _ in range(3):
        sun.measure(round(9.0 * SMOOTHED * SECOND), np.array([0.0, 0.0, 1.0]))
        assert np.abs(sun.bias).max() <= LARGEST_BIAS


@pytest.mark.parametrize(("share", "jumps"), [(0.99, False), (1.01, True)])
def test_a_sun_that_jumps_replaces_the_propagated_one(share: float, jumps: bool) -> None:
    sun = PropagatedSun()
    sun.measure(0, Z)
    sun.propagate(SECOND // 10, np.eye(3))
    seen = turned_by(float(np.arcsin(share * JUMP)))
    sun.measure(SECOND // 10, seen)
    assert np.array_equal(np.asarray(sun.direction), seen) is jumps
    assert sun.bias.any() is not np.bool_(jumps)
    sun.measure(SECOND // 10, -np.asarray(sun.direction))
    assert float(np.asarray(sun.direction) @ Z) < 0.0, "the opposite direction is a jump, too"


@pytest.mark.parametrize(("late", "known"), [(0.0, True), (0.01, False)])
def test_a_sun_is_forgotten_after_a_gap_of_the_gyro(late: float, known: bool) -> None:
    sun = PropagatedSun()
    sun.measure(0, Z)
    turn = attitude_matrix(from_rotation_vector(np.array([0.1, 0.0, 0.0])))
    sun.propagate(round((LONGEST_GAP + late) * SECOND), turn)
    assert (sun.direction is not None) is known
    if sun.direction is not None:
        np.testing.assert_allclose(sun.direction, turn @ Z)


def test_a_residual_dipole_is_learned_from_the_difference_of_the_rates() -> None:
    """The first rate only starts the observer. The second rate causes one step, which is computed by hand."""
    inertia, field = np.diag([1e-3, 2e-3, 3e-3]), np.array([0.0, 0.0, 3e-5])
    observer = ResidualDipole(inertia, 1.0)
    observer.follow(0.5, np.array([0.01, 0.0, 0.0]), field, np.zeros(3))
    assert not observer.dipole.any()
    error = np.array([1e-4, -2e-4, 3e-4])
    observer.follow(0.5, np.array([0.01, 0.0, 0.0]) + error, field, np.zeros(3))
    torque = inertia @ error
    expected = DIPOLE_GAIN * 0.5 * np.cross(field, torque) / (3e-5) ** 2
    np.testing.assert_allclose(observer.dipole, expected)
    assert np.cross(observer.dipole, field)[:2] @ torque[:2] > 0.0
    before = observer.dipole
    observer.follow(LONGEST_INTERVAL + 0.01, np.ones(3), field, np.zeros(3))
    np.testing.assert_array_equal(observer.dipole, before)
    observer.restart()
    observer.follow(0.5, np.zeros(3), field, np.zeros(3))
    np.testing.assert_array_equal(observer.dipole, before)
    small = ResidualDipole(inertia, 1e-9)
    for rate in (np.zeros(3), error):
        small.follow(0.5, rate, field, np.zeros(3))
    assert np.abs(small.dipole).max() == 1e-9


def test_coils_that_cause_the_measured_acceleration_leave_no_residual_dipole() -> None:
    inertia, field = np.diag([1e-3, 2e-3, 3e-3]), np.array([1e-5, -2e-5, 3e-5])
    observer, rate, coils = (
        ResidualDipole(inertia, 1.0),
        np.array([0.02, -0.01, 0.03]),
        np.array([0.05, 0.02, -0.04]),
    )
    for _ in range(100):
        observer.follow(0.025, rate, field, coils)
        torque = np.cross(coils, field) - np.cross(rate, inertia @ rate)
        rate = rate + 0.025 * np.linalg.solve(inertia, torque)
    assert np.abs(observer.dipole).max() < 1e-4


@pytest.mark.parametrize("sunny", [True, False])
def test_the_dipole_makes_the_commanded_torque_across_the_field(sunny: bool) -> None:
    """Without a Sun the torque damps the rotation; with a Sun it also turns the axis to the Sun."""
    law, field = seeker(), np.array([1e-5, -2e-5, 3e-5])
    rate = np.array([1e-3, -2e-3, 1.5e-3]) if not sunny else np.zeros(3)
    if sunny:
        law.update_sun(0, turned_by(0.4))
    for k in range(1, 100):
        law.sample(k * 25_000_000, attitude_matrix(from_rotation_vector(0.025 * k * rate)) @ field, rate)
        dipole = law.dipole(k * 25_000_000)
    here = law.field
    assert here is not None
    torque = np.cross(dipole, here)
    assert torque.any()
    if sunny:
        assert torque @ np.cross(Z, turned_by(0.4)) > 0.0, "towards the Sun"
    else:
        assert torque @ rate < 0.0
    assert abs(dipole @ here) < 1e-9 * np.linalg.norm(here)


@pytest.mark.parametrize("wrong", [np.zeros(3), np.array([np.nan, 0.0, 1.0]), np.array([np.inf, 0.0, 0.0])])
def test_a_sun_without_a_direction_is_left_out(wrong: FloatArray) -> None:
    """A zero vector would count as a Sun behind the body, and NaN would stay in the propagated direction."""
    law = seeker()
    law.update_sun(0, wrong)
    assert law.sun is None
    law.update_sun(0, 2.0 * Z)
    law.update_sun(1, wrong)
    np.testing.assert_array_equal(law.sun, Z)


@pytest.mark.parametrize(
    ("inertia", "axis", "limit", "words"),
    [
        (np.diag([1.0, 1.0, 3.0]), Z, LIMIT, "inertia: .*the largest must not exceed"),
        (np.diag(INERTIA), np.zeros(3), LIMIT, "axis: .*give a direction"),
        (
            np.diag(INERTIA),
            Z,
            -LIMIT,
            "limit: -0.0959: give a finite number or three finite numbers above zero",
        ),
        (np.diag(INERTIA), Z, np.array([LIMIT, LIMIT]), "limit: .*or three finite numbers"),
    ],
)
def test_impossible_settings_are_refused(
    inertia: FloatArray, axis: FloatArray, limit: float | FloatArray, words: str
) -> None:
    with pytest.raises(ArgumentError, match=words):
        SunAcquisitionSettings(inertia=inertia, axis=axis, limit=limit)


def test_a_dipole_that_is_not_finite_is_refused() -> None:
    settings = SunAcquisitionSettings(inertia=np.eye(3), axis=np.array([0.0, 0.0, 1.0]), limit=0.1)
    with pytest.raises(ArgumentError, match="dipole"):
        SunAcquisition(SCHEDULE, settings).acts(np.full(3, np.nan))
