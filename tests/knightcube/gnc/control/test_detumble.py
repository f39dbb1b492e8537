"""Tests that windowed B-dot damps a body in a changing field, and excludes the field of its own coils."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import IDENTITY, attitude_matrix, derivative, from_rotation_vector, normalise
from knightcube.errors import UsageError
from knightcube.gnc.control.detumble import (
    Detumbler,
    DetumblerSettings,
    WindowSchedule,
    braking_current,
    share_in_rotating_field,
)
from knightcube.gnc.estimation.field_rate import rate_across

SCHEDULE = WindowSchedule(50_000_000, 50_000_000, 150_000_000)
INERTIA = np.diag([1.05e-3, 1.2e-3, 1.4e-3])
BRAKING = DetumblerSettings(1.05e-3, 80 * 0.0081, 0.148, 0.3)
TURN = np.array([0.05, 0.0, 0.0])
IN_TURNING_FIELD = DetumblerSettings(1.05e-3, 80 * 0.0081, 0.148, share_in_rotating_field(0.05, SCHEDULE))
CYCLE = 0.025
NOISE = 1.0e-7
"""Noise (T) of a VN-100 magnetometer at 40 Hz, rounded up from 140 microgauss per sqrt(Hz) (data sheet)."""
OWN_FIELD = 1e-3
"""Field (T/A) that the coils cause at the magnetometer; at full current it exceeds the Earth's field."""


class FreeBody:
    """A simulated rigid body in a rotating field.

    The magnetometer of the body also measures the field of the coils.
    """

    def __init__(
        self, rate: FloatArray, field: float, turn: FloatArray, inertia: FloatArray, seed: int
    ) -> None:
        self.quaternion, self.rate, self.time = IDENTITY, rate, 0.0
        self.current: FloatArray = np.zeros(3)
        self._strength, self._turn = field, turn
        self._inertia, self._inverse = inertia, np.linalg.inv(inertia)
        self._generator = np.random.default_rng(seed)

    def field(self) -> FloatArray:
        """Return the true field (3,) in body axes."""
        reference = attitude_matrix(from_rotation_vector(self._turn * self.time)).T @ [0.0, 0.0, 1.0]
        return self._strength * np.asarray(attitude_matrix(self.quaternion) @ reference)

    def measured(self) -> FloatArray:
        return self.field() + OWN_FIELD * self.current + self._generator.normal(0.0, NOISE, 3)

    @property
    def energy(self) -> float:
        return float(0.5 * self.rate @ self._inertia @ self.rate)

    def advance(self) -> None:
        """Integrate the body over one cycle by the midpoint rule, in steps of at most 1/30 rad."""
        steps = max(int(30.0 * CYCLE * np.linalg.norm(self.rate)), 1)
        for _ in range(steps):
            dt = CYCLE / steps
            torque = np.cross(BRAKING.dipole_per_ampere * self.current, self.field())
            middle = self.rate + 0.5 * dt * self._acceleration(self.rate, torque)
            self.rate = self.rate + dt * self._acceleration(middle, torque)
            self.quaternion = normalise(self.quaternion + dt * derivative(self.quaternion, middle))
            self.time += dt

    def _acceleration(self, rate: FloatArray, torque: FloatArray) -> FloatArray:
        return np.asarray(self._inverse @ (torque - np.cross(rate, self._inertia @ rate)))


def fly(body: FreeBody, seconds: float, detumbler: Detumbler) -> tuple[FloatArray, FloatArray]:
    """Return the rate (m,) and the energy (m,) at the start of each window."""
    detumbler.begin(0)
    rates, energies = [], []
    for k in range(round(seconds / CYCLE)):
        now_ns = round(k * CYCLE * 1e9)
        if now_ns % SCHEDULE.period_ns == 0:
            rates.append(float(np.linalg.norm(body.rate)))
            energies.append(body.energy)
        detumbler.sample(now_ns, body.measured())
        body.current = detumbler.current(now_ns)
        assert np.abs(body.current).max() <= BRAKING.current_limit * (1 + 1e-12)
        body.advance()
    return np.array(rates), np.array(energies)


@pytest.mark.parametrize("axis", [(0.0, 1.0, 0.0), (0.6, -0.5, 0.62)])
def test_a_body_of_equal_moments_slows_down_monotonically_from_half_a_radian_a_second(
    axis: tuple[float, float, float],
) -> None:
    direction = np.array(axis) / np.linalg.norm(axis)
    body = FreeBody(0.5 * direction, 4.5e-4, TURN, 1.05e-3 * np.eye(3), 1)
    rates, _ = fly(body, 110.0, Detumbler(SCHEDULE, IN_TURNING_FIELD))
    fast = rates[:-1] > 0.07
    assert np.diff(rates)[fast].max() < 2e-4, "what the noise and the field's own turn do in a window"
    assert rates[-20:].max() < 0.07, "it follows the field, which turns by 0.05 rad/s"


def test_an_uneven_body_loses_energy_monotonically_and_ends_below_the_limit() -> None:
    body = FreeBody(np.array([0.3, -0.25, 0.31]), 4.5e-4, TURN, INERTIA, 2)
    rates, energies = fly(body, 130.0, Detumbler(SCHEDULE, IN_TURNING_FIELD))
    fast = rates[:-1] > 0.1
    assert np.diff(energies)[fast].max() < 2e-3 * energies[0]
    assert rates[-20:].max() < 0.08


def test_in_a_field_that_turns_too_much_gain_locks_the_spin_to_the_field() -> None:
    """A gain above the optimum couples the spin to the rotating field, and damps the spin less.

    The component along the field decays fastest at k = 2 Omega J (Avanzini and Giulietti 2012).
    """
    left = {}
    for share in (share_in_rotating_field(0.05, SCHEDULE), 0.3):
        body = FreeBody(np.array([0.3, -0.25, 0.31]), 4.5e-4, TURN, 1.05e-3 * np.eye(3), 3)
        rates, _ = fly(body, 60.0, Detumbler(SCHEDULE, replace(BRAKING, share=share)))
        left[share] = rates[-1]
    assert left[0.025] < 0.6 * left[0.3]


@pytest.mark.parametrize("speed", [0.1, 0.5, 2.0, 5.0, 10.0])
def test_a_fast_body_is_damped_and_not_accelerated(speed: float) -> None:
    """A body of up to 10 rad/s is damped, because the field is extrapolated between windows.

    In the axes of a body at 10 rad/s, the field rotates by 2.5 rad between two windows.
    """
    body = FreeBody(np.array([0.0, speed, 0.0]), 4.5e-4, np.zeros(3), 1.05e-3 * np.eye(3), 4)
    rates, _ = fly(body, 15.0, Detumbler(SCHEDULE, BRAKING))
    # A torque of 4.3e-5 N m on 1.05e-3 kg m^2 for 0.6 of the time changes the rate by 0.37 rad/s if the field
    # is known accurately.
    assert rates[-1] < rates[0] - min(0.9 * speed, 0.33)


def test_the_rate_across_the_field_is_exact_for_a_steady_turn_and_nothing_along_it() -> None:
    field = np.array([1e-4, -2e-4, 3e-4])
    along = field / np.linalg.norm(field)
    across = np.cross(along, [0.0, 0.0, 1.0])
    for speed in (1e-4, 0.3, 2.9):
        rate = speed * across / np.linalg.norm(across)
        after = attitude_matrix(from_rotation_vector(rate * 1.0)) @ field
        np.testing.assert_allclose(rate_across(field, after, 1.0), rate, atol=1e-12)
    after = attitude_matrix(from_rotation_vector(0.7 * along)) @ field
    np.testing.assert_allclose(rate_across(field, after, 1.0), 0.0, atol=1e-12)
    np.testing.assert_array_equal(rate_across(np.zeros(3), np.zeros(3), 1.0), np.zeros(3))


def test_the_torque_opposes_the_rate_and_takes_the_stated_share() -> None:
    field, rate = np.array([0.0, 2e-4, 3e-4]), np.array([0.01, 0.0, 0.0])
    torque = np.cross(BRAKING.dipole_per_ampere * braking_current(BRAKING, rate, field, 0.15), field)
    np.testing.assert_allclose(torque * 0.15, -0.3 * BRAKING.inertia * rate, rtol=1e-12, atol=1e-20)


def test_a_limited_current_keeps_its_direction() -> None:
    field, rate = np.array([1e-4, 2e-4, 3e-4]), np.array([0.3, -0.2, 0.1])
    wanted = braking_current(DetumblerSettings(1.05e-3, 0.648, 1e9, 0.3), rate, field, 0.15)
    given = braking_current(BRAKING, rate, field, 0.15)
    assert np.abs(wanted).max() > BRAKING.current_limit
    assert np.abs(given).max() == pytest.approx(BRAKING.current_limit)
    np.testing.assert_allclose(given / np.linalg.norm(given), wanted / np.linalg.norm(wanted))


def test_samples_taken_while_the_coils_act_are_not_used() -> None:
    detumbler = Detumbler(SCHEDULE, BRAKING)
    detumbler.begin(1_000)
    used = [t for t in range(0, 500_000_000, 5_000_000) if detumbler.listens(1_000 + t)]
    assert used == [t for t in range(0, 500_000_000, 5_000_000) if 50 <= t % 250_000_000 / 1e6 < 100]
    assert not detumbler.listens(0)


def test_without_samples_the_coils_stay_off_and_after_a_gap_two_windows_are_needed() -> None:
    detumbler = Detumbler(SCHEDULE, BRAKING)
    detumbler.begin(0)
    field = np.array([0.0, 0.0, 4.5e-4])
    acted = []
    for k in range(80):
        now_ns = k * 25_000_000
        turn = attitude_matrix(from_rotation_vector(np.array([0.0, 0.4, 0.0]) * k * CYCLE))
        window = now_ns // SCHEDULE.period_ns
        if window not in {2, 3, 4}:  # the IMU is silent
            detumbler.sample(now_ns, turn @ field)
        if detumbler.current(now_ns).any():
            acted.append(window)
    assert sorted(set(acted)) == [1, 6, 7]


@pytest.mark.parametrize("share", [0.0, 1.0, math.nan])
def test_a_share_that_does_not_brake_is_refused(share: float) -> None:
    with pytest.raises(UsageError, match="share"):
        DetumblerSettings(1e-3, 0.6, 0.1, share)


def test_a_window_without_time_to_measure_is_refused() -> None:
    with pytest.raises(UsageError, match="above zero"):
        WindowSchedule(0, 0, 1)


@pytest.mark.parametrize("seconds", [0.1, math.nan])
def test_a_window_in_seconds_is_refused_because_its_unit_is_the_nanosecond(seconds: Any) -> None:
    with pytest.raises(UsageError, match=r"act_ns: .*whole number"):
        WindowSchedule(0, 50_000_000, seconds)


def test_a_rate_follows_only_from_finite_fields_and_a_positive_time() -> None:
    field = np.array([1e-5, 2e-5, 3e-5])
    for name, given in (("seconds", (field, -field, 0.0)), ("after", (field, math.nan * field, 1.0))):
        with pytest.raises(UsageError, match=name):
            rate_across(*given)


def test_currents_follow_only_from_finite_values_and_a_positive_time() -> None:
    braking, field = DetumblerSettings(1e-3, 0.6, 0.1, 0.2), np.array([1e-5, 2e-5, 3e-5])
    for name, rate, act_time in (("rate", math.nan, 1.0), ("act_time", 0.1, 0.0)):
        with pytest.raises(UsageError, match=name):
            braking_current(braking, np.full(3, rate), field, act_time)


@pytest.mark.parametrize("length_ms", [20, 40, 100, 99, 300])
def test_an_exposure_waits_until_no_step_of_the_coils_falls_within(length_ms: int) -> None:
    """An exposure is delayed so that the coils do not switch during the exposure.

    The coils are off for 100 of every 250 ms, and a command may arrive 50 ms late.
    """
    steps = np.arange(0, 2_000, 250)[:, None] + np.array([0, 100])
    for begin_ms in range(0, 500, 10):
        found = SCHEDULE.calm(begin_ms * 1_000_000, length_ms * 1_000_000) // 1_000_000
        if length_ms > 100:
            assert found == begin_ms  # an exposure of this length is not delayed
            continue
        assert begin_ms <= found < begin_ms + 400
        assert not ((steps + 50 > found) & (steps < found + length_ms)).any()
