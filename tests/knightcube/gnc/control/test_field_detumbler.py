"""Tests of detumbling with a magnetometer alone: its start, and a spin about the field direction.

The momentum plan must remove the planned momentum in the planned time, which must be close to the minimum
time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray, cross_product
from knightcube.astro.quaternion import IDENTITY, attitude_matrix, from_rotation_vector, multiply
from knightcube.errors import ArgumentError, UsageError
from knightcube.gnc.control.detumble import WindowSchedule
from knightcube.gnc.control.field_detumbler import (
    LIMIT_GAIN,
    LISTENED,
    SILENT_PERIODS,
    TRUSTED,
    FieldDetumbler,
    FieldDetumblerSettings,
    FieldPrediction,
    aligned_to,
    aligned_to_change,
    braking_dipole,
    momentum_plan,
    rotating_field,
    without_growth,
)
from knightcube.gnc.estimation.field_rate import FieldRateSettings
from knightcube.gnc.estimation.rigid_body import BodyErrors
from tests.support.recorded_results import check

SCHEDULE = WindowSchedule(100_000_000, 300_000_000, 600_000_000)
INERTIA = np.diag([1.1e-3, 1.05e-3, 0.99e-3])
LIMIT = 0.1
FIELD, TURN = np.array([0.0, 0.0, 4e-5]), np.array([0.0, 2.2e-3, 0.0])
OWN_FIELD = 4e-4
"""Field (T per A m^2) that the coils cause at the magnetometer. At the dipole limit it equals the Earth's
field."""
CYCLE_NS = 100_000_000


class Body(NamedTuple):
    """A body whose inertia differs from its description, and the dipole limit of its coils (A m^2)."""

    described: FloatArray
    inertia: FloatArray
    limit: float


def unlike(described: FloatArray, limit: float, seed: int) -> Body:
    """Return a body with inertia errors of up to 10 % (moments) and 5 deg (axes), as in `craft.accuracy`."""
    rng, errors = np.random.default_rng(seed), BodyErrors()
    moments, axes = np.linalg.eigh(described)
    while True:
        drawn = moments * (1.0 + errors.moments * rng.uniform(-1.0, 1.0, 3))
        if 2.0 * drawn.max() < drawn.sum():
            break
    principal = attitude_matrix(from_rotation_vector(errors.axes * rng.uniform(-1.0, 1.0, 3))) @ axes
    return Body(described, principal @ np.diag(drawn) @ principal.T, limit)


def braking(limit: float) -> FieldDetumblerSettings:
    return FieldDetumblerSettings(
        limit=limit, horizon=1500.0, replan=5.0, gentle=0.052, spin_up=3.0, slow=8.7e-3
    )


def detumbler(body: Body | None = None) -> FieldDetumbler:
    described, limit = (INERTIA, LIMIT) if body is None else (body.described, body.limit)
    noise = FieldRateSettings(inertia=described, field_sigma=2e-7, torque_walk=1e-4 if body is None else 1e-5)
    return FieldDetumbler(SCHEDULE, braking(limit), noise)


def fly(
    rate: FloatArray,
    seconds: float,
    spikes: float = 0.0,
    gyro: Callable[[FloatArray], FloatArray] | None = None,
    sooner: float = 1.0,
    late: float = 0.0,
    body: Body | None = None,
    seed: int = 4,
    noise: float = 1e-7,
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0),
    lag: float = 0.0,
) -> tuple[FloatArray, FieldDetumbler]:
    """Return the magnitude (n,), rad/s, of the rate in each cycle, and the detumbler.

    The field rotates `sooner` times as fast as in orbit. Samples are `late` s older than the last command.
    The function `gyro` returns the measured rate. The noise of the magnetometer is `noise`, T per axis. If
    `body` is given, the magnitude is computed from the energy and the mean moment of inertia. The dipole of
    each coil is multiplied by `signs`. The field of the coils decays with the time constant `lag`, s.
    """
    law, rng = detumbler(body), np.random.default_rng(seed)
    limit, inertia = (LIMIT, INERTIA) if body is None else (body.limit, body.inertia)
    inverse, speeds = np.linalg.inv(inertia), []
    law.begin(0)
    attitude, dipole, remaining = IDENTITY, np.zeros(3), np.zeros(3)
    dt = 1e-9 * CYCLE_NS
    for cycle in range(round(seconds / dt)):
        now_ns = cycle * CYCLE_NS
        field = (
            attitude_matrix(attitude)
            @ attitude_matrix(from_rotation_vector(sooner * TURN * cycle * dt)).T
            @ FIELD
        )
        past = attitude_matrix(from_rotation_vector(-late * rate)) @ field if late else field
        remaining = dipole + math.exp(-dt / lag if lag else -math.inf) * (remaining - dipole)
        sample = past + OWN_FIELD * remaining + noise * rng.standard_normal(3)
        if rng.uniform() < spikes:
            sample = sample + 1e-4 * rng.standard_normal(3)
        law.dipole(now_ns)
        law.sample(now_ns - round(1e9 * late), sample, None if gyro is None else gyro(rate))
        dipole = law.dipole(now_ns)
        assert np.abs(dipole).max() <= limit * (1.0 + 1e-12)
        torque = cross_product(np.multiply(signs, dipole), field)
        middle = rate + 0.5 * dt * inverse @ (torque - cross_product(rate, inertia @ rate))
        rate = rate + dt * inverse @ (torque - cross_product(middle, inertia @ middle))
        attitude = multiply(from_rotation_vector(dt * middle), attitude)
        square = rate @ rate if body is None else 3.0 * float(rate @ inertia @ rate) / np.trace(inertia)
        speeds.append(math.sqrt(float(square)))
    return np.array(speeds), law


def test_a_slow_spin_along_the_field_is_braked_as_the_field_turns_and_spiked_samples_do_not_mislead() -> None:
    """A spin along the field is reduced below 0.5 deg/s in 850 s, without a larger rate in between.

    B-dot takes at least 2,000 s. The minimum time to rest is 714 s, in which the field rotates by 90 deg.
    """
    speeds, _ = fly(np.array([0.0, 0.0, 0.03]), 850.0, spikes=0.1)
    assert speeds.max() < 1.1 * speeds[0]
    assert speeds[-1] < math.radians(0.5)


UNIT = Body(INERTIA, INERTIA, LIMIT)
THREE_UNITS = np.diag([0.0066, 0.0333, 0.0333])


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(("described", "limit"), [(INERTIA, LIMIT), (THREE_UNITS, 0.2)], ids=["1U", "3U"])
@pytest.mark.parametrize(
    ("speed", "multiple", "seconds"), [(0.03, 1.0, 200.0), (0.1, 3.0, 300.0)], ids=["gentle", "fast"]
)
def test_the_coils_never_spin_up_a_body_of_another_inertia_beyond_the_multiple(
    seed: int, described: FloatArray, limit: float, speed: float, multiple: float, seconds: float
) -> None:
    """The rate of a body with another inertia never exceeds the permitted multiple by more than 15 %.

    Initially the rate along the field is unknown, and the energy is known to the accuracy of the inertia. The
    rate of an elongated body varies at constant energy. A simulation of 300 s is sufficient, because in
    simulations of 400 s the bodies are fastest before 300 s.
    """
    body = unlike(described, limit, seed)
    off = 0.1 * speed * np.random.default_rng(seed).standard_normal(3)
    speeds, _ = fly(np.array([0.0, 0.0, speed]) + off, seconds, body=body, seed=seed)
    assert speeds.max() < 1.15 * multiple * speeds[0]


BIAS = np.array([4e-4, -3e-4, 5e-4])
"""Gyro bias (rad/s)."""


def test_with_a_gyro_a_slow_spin_along_the_field_is_never_made_faster() -> None:
    """With a gyro, a slow spin along the field is never accelerated by more than 10 %.

    The field rotates by 90 deg in 178 s. The fastest plan would increase the spin fivefold.
    """
    speeds, _ = fly(np.array([0.001, 0.0, 0.02]), 260.0, sooner=4.0, gyro=lambda rate: rate + BIAS)
    assert speeds.max() < 1.1 * speeds[0]
    assert speeds[-1] < math.radians(0.5)


def test_with_a_gyro_a_fast_spin_along_the_field_is_stopped_soon_at_thrice_its_rate() -> None:
    speeds, _ = fly(np.array([0.0, 0.0, 0.1]), 360.0, gyro=lambda rate: rate + BIAS)
    assert 2.0 * speeds[0] < speeds.max() < 3.1 * speeds[0]
    assert speeds[-1] < math.radians(0.5)


def test_a_gyro_that_is_stuck_does_not_mislead() -> None:
    speeds, _ = fly(np.array([0.1, 0.05, 0.03]), 200.0, gyro=lambda _: np.zeros(3))
    assert speeds[-1] < 0.5 * speeds[0]


@pytest.mark.parametrize("late", [0.001, 0.04])
def test_samples_older_than_the_last_command_brake_as_well(late: float) -> None:
    """Samples that are older than the last command damp the body as well.

    The rate along the field becomes observable only as the field rotates.
    """
    speeds, _ = fly(np.array([0.1, 0.05, 0.03]), 240.0, late=late)
    assert speeds[-1] < math.radians(0.5)


def test_a_reversed_coil_is_estimated_and_used() -> None:
    """Without an estimate of the coils, the reversed coil accelerates the body."""
    speeds, _ = fly(np.array([0.1, 0.05, 0.03]), 300.0, signs=(1.0, -1.0, 1.0), body=UNIT)
    assert speeds[-1] < math.radians(0.5)


def test_the_pauses_become_longer_if_the_coil_field_decays_slowly() -> None:
    """With a time constant of half the configured settling time, the first samples of a pause are wrong."""
    speeds, law = fly(np.array([0.1, 0.05, 0.03]), 300.0, lag=0.5e-9 * SCHEDULE.settle_ns)
    assert speeds[-1] < math.radians(0.5)
    assert law.restarts <= 2
    assert not law.listens(law.next_pause_ns + SCHEDULE.settle_ns)


def test_the_pauses_become_longer_although_the_filter_restarts_after_each_of_them() -> None:
    """The coil field falsifies the first sample of each pause, and the coils are off after a restart."""
    law, driven_ns, restarts = detumbler(), 0, 0
    law.begin(0)
    for now_ns in range(0, LISTENED + 12 * SCHEDULE.period_ns, 25_000_000):
        field = attitude_matrix(from_rotation_vector(np.array([1e-10 * now_ns, 0.0, 0.0]))) @ FIELD
        off_ns = now_ns - driven_ns
        law.sample(now_ns, field + 2e-6 * (off_ns <= SCHEDULE.settle_ns + 25_000_000))
        if driven_ns and off_ns == 375_000_000:
            law.renew_magnetometer()
            restarts += 1
        if law.dipole(now_ns).any():
            driven_ns = now_ns
    assert restarts >= 3
    assert not law.listens(law.next_pause_ns + SCHEDULE.settle_ns)


def test_outliers_do_not_make_the_pauses_longer() -> None:
    """One sample in 50 is an outlier, so 4 % of the pauses begin or end with an outlier."""
    _, law = fly(np.array([0.1, 0.05, 0.03]), 150.0, spikes=0.02)
    assert law.listens(law.next_pause_ns + SCHEDULE.settle_ns)


def test_coils_wait_where_no_sample_is_accepted_any_more() -> None:
    """The coils stay off if the samples of the IMU are rejected, and never act on a predicted field alone."""
    law = detumbler()
    law.begin(0)

    def acts(begin_ns: int, end_ns: int, good: float) -> bool:
        """Return whether the coils were driven while the body rotated at 0.1 rad/s normal to the field."""
        acted = False
        for now_ns in range(begin_ns, end_ns, 25_000_000):
            turned = attitude_matrix(from_rotation_vector(np.array([1e-10 * now_ns, 0.0, 0.0]))) @ FIELD
            law.sample(now_ns, good * turned)
            acted |= bool(law.dipole(now_ns).any())
        return acted

    silent_ns = LISTENED + 2 * SCHEDULE.period_ns
    quiet_ns = silent_ns + SILENT_PERIODS * SCHEDULE.period_ns
    assert acts(0, silent_ns, 1.0)
    assert acts(silent_ns, quiet_ns, math.nan), "two pauses without a sample do not stop the brake"
    assert not acts(quiet_ns, quiet_ns + 10 * SCHEDULE.period_ns, math.nan)
    assert acts(quiet_ns + 10 * SCHEDULE.period_ns, quiet_ns + 15 * SCHEDULE.period_ns, 1.0)


def test_a_spin_of_a_turn_in_two_seconds_is_braked() -> None:
    """A spin of half a turn per second is damped. The samples within a pause of the coils show the rate.

    Samples of different pauses do not show it, because the body rotates by 180 deg between two pauses.
    """
    speeds, _ = fly(np.array([2.0, -2.4, 0.3]), 60.0)
    assert speeds[-1] < 0.95 * speeds[0]


def test_no_dipole_in_the_pause_nor_before_enough_samples_agree() -> None:
    law = detumbler()
    law.begin(0)
    for k in range(TRUSTED):
        now_ns = SCHEDULE.settle_ns + 20_000_000 * k
        law.dipole(now_ns)
        law.sample(now_ns, FIELD if k else FIELD + 1e-4)  # the first sample is an outlier
        assert not law.dipole(now_ns).any()
    assert not law.trusted
    assert law.rate is None
    assert law.rate_sigma == math.inf
    assert not law.dipole(SCHEDULE.settle_ns + SCHEDULE.measure_ns).any()


@pytest.mark.parametrize("gyro", [True, False])
def test_the_coils_act_soon_with_a_gyro_and_otherwise_after_continuous_field_samples(gyro: bool) -> None:
    """The coils are driven after 0.6 s with a gyro, and after `LISTENED` with a magnetometer alone.

    With only the samples of the coil pauses, the error of the rate would still be 20 mrad/s after 10 s.
    """
    law, rate, rng = detumbler(), np.array([0.1, 0.05, 0.14]), np.random.default_rng(1)
    law.begin(0)
    for now_ns in range(0, LISTENED + SCHEDULE.period_ns, 25_000_000):
        field = attitude_matrix(from_rotation_vector(1e-9 * now_ns * rate)) @ FIELD
        law.sample(now_ns, field + 2e-7 * rng.standard_normal(3), rate + BIAS if gyro else None)
        if law.dipole(now_ns).any():
            break
    assert law.rate is not None
    if gyro:
        assert SCHEDULE.settle_ns < now_ns <= 600_000_000
    else:
        assert LISTENED <= now_ns < LISTENED + SCHEDULE.period_ns
        assert np.linalg.norm(law.rate - rate) < 0.01


LONG = WindowSchedule(100_000_000, 100_000_000, 3_800_000_000)


def driven(gyro: bool) -> tuple[FieldDetumbler, list[float]]:
    """Return a detumbler of a body that rotates steadily, and the durations (s) of its driven phases."""
    noise = FieldRateSettings(inertia=INERTIA, field_sigma=2e-7, torque_walk=1e-4)
    law = FieldDetumbler(LONG, braking(LIMIT), noise)
    rate, rng = np.array([0.1, 0.05, 0.14]), np.random.default_rng(1)
    law.begin(0)
    begun_ns, found, before = 0, [], False
    for now_ns in range(0, LISTENED + 20_000_000_000, 25_000_000):
        field = attitude_matrix(from_rotation_vector(1e-9 * now_ns * rate)) @ FIELD
        law.sample(now_ns, field + 2e-7 * rng.standard_normal(3), rate + BIAS if gyro else None)
        acts = bool(law.dipole(now_ns).any())
        if acts and not before:
            begun_ns = now_ns
        if before and not acts:
            found.append(1e-9 * (now_ns - begun_ns))
            assert law.listens(now_ns + LONG.settle_ns)
        law.acts(np.zeros(3))  # the coils have no effect, so the body keeps its rate
        before = acts
    return law, found


def test_the_driven_phase_is_short_while_the_rate_is_uncertain_and_long_with_a_gyro() -> None:
    law, alone = driven(gyro=False)
    uncertain = law.rate_sigma
    assert 1.8 < min(alone[1:4]) < max(alone[1:4]) < 3.0
    law, helped = driven(gyro=True)
    assert law.rate_sigma < 0.5 * uncertain
    assert helped[1:4] == pytest.approx([3.8, 3.8, 3.8], abs=0.05)


def test_after_another_mode_drove_the_coils_they_settle_before_the_first_sample() -> None:
    law = detumbler()
    law.begin(7_000_000_000)
    assert not law.listens(7_000_000_000 + SCHEDULE.settle_ns - 1)
    assert law.listens(7_000_000_000 + SCHEDULE.settle_ns)


def test_a_sample_taken_while_the_coils_act_or_settle_is_ignored() -> None:
    law = detumbler()
    law.begin(0)
    for now_ns in range(0, LISTENED + 5_000_000_000, 25_000_000):
        law.sample(now_ns, FIELD if law.listens(now_ns) else np.array([1.0, 0.0, 0.0]))
        law.dipole(now_ns)
    assert law.trusted
    assert law.restarts == 0
    assert law.rate is not None
    assert np.linalg.norm(law.rate) < 0.02


def test_constants_that_do_not_brake_are_refused() -> None:
    with pytest.raises(UsageError, match="limit"):
        braking(0.0)
    with pytest.raises(ArgumentError, match=r"inertia: .*the largest must not exceed"):
        FieldRateSettings(inertia=np.diag([1.0, 1.0, 3.0]), field_sigma=2e-7, torque_walk=1e-5)
    with pytest.raises(ArgumentError, match=r"field_sigma: 0\.0: give a finite number above zero"):
        FieldRateSettings(inertia=INERTIA, field_sigma=0.0, torque_walk=1e-5)


STEP, DIPOLE_LIMIT, REST = 5.0, 0.1, 1e-5
TIMES = np.arange(0.0, 400.0 * STEP, STEP)
FIELD_AHEAD = rotating_field(np.array([0.0, 0.0, 4e-5]), np.array([4e-5 * 0.0022, 0.0, 0.0]), TIMES)
"""Field (T) that makes two rotations in 95 min, as in a polar orbit."""


def remaining_fraction(momentum: FloatArray, costate: FloatArray, horizon: float) -> float:
    """Return the fraction of the momentum that remains if the plan is executed with dipoles at the limit."""
    now = momentum.copy()
    for there in FIELD_AHEAD[: round(horizon / STEP)]:
        dipole = -np.cross(there, costate)
        dipole *= LIMIT_GAIN * DIPOLE_LIMIT / max(float(np.linalg.norm(dipole)), 1e-2 * DIPOLE_LIMIT)
        now += STEP * np.cross(dipole, there)
    return float(np.linalg.norm(now) / np.linalg.norm(momentum))


def least_time(momentum: FloatArray, field: FloatArray) -> float:
    """Return a lower bound (s) of the time in which dipoles at the limit can remove the momentum.

    For any direction p, dipoles at the limit reduce p . h by at most the integral of the largest torque along
    p.
    """
    directions = np.random.default_rng(1).standard_normal((3000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    most = (
        np.cumsum(np.linalg.norm(np.cross(field[:, None], directions), axis=2), axis=0)
        * STEP
        * DIPOLE_LIMIT
        * LIMIT_GAIN
    )
    enough = np.all(most >= directions @ momentum, axis=1)
    return float(STEP * (np.argmax(enough) + 1))


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.3, -0.7, 0.6)])
def test_the_plan_removes_the_momentum_in_nearly_the_least_time(
    direction: tuple[float, float, float],
) -> None:
    momentum = 1e-3 * np.array(direction)
    plan = momentum_plan(momentum, FIELD_AHEAD, TIMES, DIPOLE_LIMIT, REST)
    assert remaining_fraction(momentum, plan.costate, plan.horizon) < 0.06
    least = least_time(momentum, FIELD_AHEAD)
    assert 0.98 * least - STEP <= plan.horizon < 1.02 * least + STEP


def test_momentum_along_the_field_waits_for_the_field_to_turn() -> None:
    along = momentum_plan(np.array([0.0, 0.0, 1e-3]), FIELD_AHEAD, TIMES, DIPOLE_LIMIT, REST)
    across = momentum_plan(np.array([1e-3, 0.0, 0.0]), FIELD_AHEAD, TIMES, DIPOLE_LIMIT, REST)
    assert along.horizon > 1.2 * across.horizon
    still = np.broadcast_to(FIELD_AHEAD[0], FIELD_AHEAD.shape)
    stuck = momentum_plan(np.array([0.0, 0.0, 1e-3]), still, TIMES, DIPOLE_LIMIT, REST)
    assert stuck.horizon == STEP * len(FIELD_AHEAD)
    assert np.all(np.isfinite(stuck.costate))


def test_momentum_below_the_permitted_remainder_is_not_planned_for() -> None:
    """A plan does not remove momentum below the permitted remainder, so it is shorter.

    A tenth of the momentum is along the slowly rotating field, and the other nine tenths are removed faster.
    """
    momentum = np.array([1e-4, 0.0, 1e-5])
    exact, allowed = (
        momentum_plan(momentum, FIELD_AHEAD, TIMES, DIPOLE_LIMIT, rest) for rest in (1e-7, 1.2e-5)
    )
    assert allowed.horizon < 0.6 * exact.horizon


def test_the_predicted_field_begins_with_the_measured_field() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        ahead = rng.standard_normal((9, 3))
        field = ahead[0] + 0.5 * rng.standard_normal(3)
        turned = aligned_to(ahead, field)
        # The function only rotates the series of fields, so their inner products do not change.
        np.testing.assert_allclose(turned @ turned.T, ahead @ ahead.T, atol=1e-12)
        assert np.linalg.det(turned[1:4]) == pytest.approx(np.linalg.det(ahead[1:4]))
        if ahead[0] @ field > 0.0:
            along = field / np.linalg.norm(field) * np.linalg.norm(ahead[0])
            np.testing.assert_allclose(turned[0], along, atol=1e-12)


def test_a_field_along_the_orbit_is_known_from_its_direction_and_its_change() -> None:
    """The field along the orbit is predicted from its present direction and its change.

    Near the equator, the direction of the field oscillates. The predicted series is in axes that differ from
    those of the measured field.
    """
    times = braking(LIMIT).instants
    angle = 0.3 * np.sin(1.1e-3 * times)
    true = 3e-5 * np.stack([np.sin(angle), 0.2 * np.cos(angle) ** 2, np.cos(angle)], axis=1)
    turned = attitude_matrix(from_rotation_vector(np.array([0.4, -1.1, 2.0])))
    change = (true[1] - true[0]) / (times[1] - times[0])
    found = aligned_to_change(true @ turned.T, times, true[0], change)
    np.testing.assert_allclose(found, true, atol=2e-7)
    extrapolated = rotating_field(true[0], change, times)
    assert np.abs(extrapolated - true).max() > 4e-6, "the field does not continue to rotate"
    still = np.tile(true[0], (len(times), 1))
    unmoved = aligned_to_change(still @ turned.T, times, true[0], np.zeros(3))
    np.testing.assert_allclose(unmoved, still, atol=1e-15)


@pytest.mark.parametrize(("strength", "used"), [(1.1, True), (1.5, False)])
def test_a_prediction_of_a_wrong_orbit_is_not_used(strength: float, used: bool) -> None:
    asked: list[FloatArray] = []

    def expected(_: int) -> FieldPrediction:
        ahead = strength * rotating_field(FIELD, np.array([1e-8, 0.0, 0.0]), instants)
        asked.append(ahead)
        return FieldPrediction(ahead, False)

    noise = FieldRateSettings(inertia=INERTIA, field_sigma=2e-7, torque_walk=1e-4)
    settings = braking(LIMIT)
    instants = settings.instants
    costates = []
    for source in (expected, lambda _: None):
        law = FieldDetumbler(SCHEDULE, settings, noise, source)
        law.begin(0)
        cycles = LISTENED // CYCLE_NS + 2 * SCHEDULE.period_ns // CYCLE_NS
        for cycle in range(cycles):
            turned = attitude_matrix(from_rotation_vector(0.1 * cycle * np.array([0.02, 0.08, 0.05])))
            law.dipole(cycle * CYCLE_NS)
            law.sample(cycle * CYCLE_NS, turned @ FIELD)
        assert law.trusted
        costates.append(law._planned(cycles * CYCLE_NS).costate)
    assert asked
    assert bool(np.linalg.norm(costates[0] - costates[1]) > 1e-6 * np.linalg.norm(costates[1])) is used


def test_the_dipole_never_adds_energy_to_what_the_plan_brakes_and_keeps_each_limit() -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        costate, field = rng.standard_normal(3), 4e-5 * rng.standard_normal(3)
        dipole = braking_dipole(1e4 * costate, field, DIPOLE_LIMIT)
        assert float(np.abs(dipole).max()) <= DIPOLE_LIMIT
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
        momentum_plan(np.ones(3), FIELD_AHEAD[:2], TIMES[:2], DIPOLE_LIMIT, REST)
    rest = momentum_plan(np.zeros(3), FIELD_AHEAD, TIMES, DIPOLE_LIMIT, REST)
    assert not rest.costate.any()
    assert rest.horizon == 0.0


def test_a_dipole_without_growth_makes_the_body_no_faster_and_what_brakes_it_stays() -> None:
    rng, inverse = np.random.default_rng(3), np.linalg.inv(np.diag([0.0066, 0.0333, 0.0333]))
    changed = 0
    for _ in range(100):
        dipole, field, rate = (
            0.2 * rng.standard_normal(3),
            4e-5 * rng.standard_normal(3),
            rng.standard_normal(3),
        )
        left = without_growth(dipole, [np.cross(field, inverse @ rate)])
        before, after = (float(rate @ inverse @ np.cross(m, field)) for m in (dipole, left))
        assert after <= 1e-9 * abs(before) or before <= 0.0
        assert np.abs(left).max() <= np.abs(dipole).max() * (1.0 + 1e-12)
        if before <= 0.0:
            np.testing.assert_array_equal(left, dipole)
        changed += before > 0.0
    assert 30 < changed < 70


def test_neither_of_two_quantities_grows_and_a_feasible_dipole_is_not_set_to_zero() -> None:
    rng = np.random.default_rng(6)
    idle = 0
    for _ in range(200):
        dipole, field = rng.standard_normal(3), rng.standard_normal(3)
        grows = [np.cross(field, rng.standard_normal(3)) for _ in range(2)]
        left = without_growth(dipole, grows)
        assert all(float(left @ one) <= 1e-8 for one in grows)
        idle += not np.cross(left, field).any()
    assert idle < 100


def test_a_magnetometer_noisier_than_configured_detumbles_the_body() -> None:
    speeds, _ = fly(np.array([0.1, -0.05, 0.08]), 360.0, noise=1e-6)
    assert speeds[-1] < 0.1 * speeds[0]


def test_detumbling_by_the_magnetometer_is_as_recorded() -> None:
    rate = np.array([0.1, -0.05, 0.08])
    with_gyro, _ = fly(rate, 12.0, gyro=lambda true: true + 1e-3)
    check(__file__, "detumbled", [fly(rate, 22.0, spikes=0.05)[0], with_gyro], 1e-4)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("momentum", np.full(3, np.nan)),
        ("field", np.zeros_like(FIELD_AHEAD)),
        ("field", np.full_like(FIELD_AHEAD, np.inf)),
        ("times", TIMES[::-1]),
        ("limit", 0.0),
    ],
)
def test_a_plan_without_a_solution_is_refused_with_the_name_of_the_value(name: str, value: Any) -> None:
    given: dict[str, Any] = {"momentum": np.full(3, 1e-3), "field": FIELD_AHEAD, "times": TIMES}
    with pytest.raises(ArgumentError, match=name):
        momentum_plan(**{**given, "limit": DIPOLE_LIMIT, "rest": REST, name: value})


def test_a_field_of_zero_has_no_direction_and_no_rotation() -> None:
    with pytest.raises(ArgumentError, match="field"):
        rotating_field(np.zeros(3), np.ones(3), TIMES)
    with pytest.raises(ArgumentError, match="field"):
        aligned_to(FIELD_AHEAD, np.zeros(3))


def test_a_dipole_that_is_not_finite_and_a_field_of_another_shape_are_refused() -> None:
    law = detumbler()
    with pytest.raises(ArgumentError, match="dipole"):
        law.acts(np.full(3, np.nan))
    with pytest.raises(ArgumentError, match="field"):
        law.sample(0, np.zeros(2))


def test_after_a_time_stamp_far_ahead_the_rate_is_estimated_again_before_the_coils_act() -> None:
    law, _ = driven(gyro=False)
    ahead_ns = 86_400_000_000_000
    for now_ns in range(ahead_ns, ahead_ns + LONG.period_ns, 100_000_000):
        assert not law.dipole(now_ns).any()
    assert law.restarts == 1


@pytest.mark.parametrize("name", ["costate", "field", "limit"])
def test_a_braking_dipole_follows_only_from_finite_values(name: str) -> None:
    good: dict[str, Any] = {"costate": np.ones(3), "field": np.array([1e-5, 2e-5, 3e-5]), "limit": 0.1}
    assert braking_dipole(**good).any()
    with pytest.raises(ArgumentError, match=name):
        braking_dipole(**{**good, name: np.nan * good[name]})
