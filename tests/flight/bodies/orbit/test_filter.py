"""Tests of the satellite's filter: star fixes are used at their times, and start or restart the filter."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from copy import copy, deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from flight.bodies.orbit.filter import REFUSALS_TO_RESTART, OrbitFilter, OrbitFilterSettings
from hal.interfaces.devices import ImuReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import Pressures
from knightcube.astro.quaternion import (
    IDENTITY,
    angle_between,
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.gnc.control.coil_map import CoilMap
from knightcube.gnc.estimation.estimate import (
    ATTITUDE,
    FIELD_BIAS,
    RATE,
    AttitudeMeasurement,
    Estimate,
    Knowledge,
    MeanRateMeasurement,
)
from knightcube.gnc.estimation.free_filter import (
    COILS,
    GYRO,
    SLOW,
    FilterEnvironment,
    FreeFilterSettings,
    SlowStates,
)
from knightcube.gnc.estimation.free_filter import INERTIA as INERTIA_ERROR
from knightcube.gnc.estimation.rigid_body import BodyErrors

PERIOD_NS = SECOND_NS // 40
MOMENTS = (1.1e-3, 1.05e-3, 0.99e-3)
INERTIA = np.diag(MOMENTS)
FIELD = np.array([1e-5, 2e-5, 3e-5])
BIAS, SPIN = np.array([4e-4, -5e-4, 3e-4]), np.array([3e-3, -2e-3, 4e-3])
STAR = 2e-5
DIPOLE = 0.02
"""Commanded dipole (A m^2) along x."""


def around(_: int) -> FilterEnvironment:
    nothing = Pressures(np.zeros((1, 3)), np.zeros((1, 3)))
    return FilterEnvironment(FIELD, np.array([1e9, 0.0, 0.0]), nothing, 1.0)


class Flown:
    """A simulated body with coils, and its filter. Several Euler steps are integrated before each reading."""

    def __init__(
        self, pulses: bool = False, errors: BodyErrors | None = None, slow: SlowStates | None = None
    ) -> None:
        self.filter = OrbitFilter(
            OrbitFilterSettings(
                inertia=INERTIA,
                coils=CoilMap.equal(1.0, 0.1),
                gyro_noise=1e-4,
                field_noise=1e-7,
                unknown_psd=1e-8,
                settle_ns=100_000_000,
                history_ns=12 * SECOND_NS,
                slow=slow,
                free=FreeFilterSettings(errors=errors or BodyErrors()),
            ),
            around,
        )
        self.generator = np.random.default_rng(5)
        self.attitude, self.rate, self.time_ns = IDENTITY, SPIN, 0
        self.attitudes = {0: IDENTITY}
        self._pulses = pulses
        self.carries = 1.0  # ratio of the coils' true dipole to the commanded dipole
        self.rests = False  # if set, the commanded dipole is zero
        self.alternates = False  # if set, the commanded dipole alternates between +x and -z
        self.field: FloatArray | None = None  # field (T) that a stuck magnetometer repeats
        self.magnet: FloatArray = np.zeros(3)  # error (T) that is added to the field
        self.bias = BIAS  # bias (rad/s) of the gyro
        self.has_gyro = True

    def fly(self, seconds: float) -> None:
        """Simulate for some time. If the coils are pulsed, they are driven for 0.8 s of each second."""
        for _ in range(round(seconds * SECOND_NS / PERIOD_NS)):
            acts = self._pulses and not self.rests and self.time_ns % SECOND_NS >= 200_000_000
            dipole = np.array([DIPOLE if acts else 0.0, 0.0, 0.0])
            if self.alternates and self.time_ns // SECOND_NS % 10 >= 5:
                dipole = -dipole[[2, 1, 0]]
            self.filter.command(self.time_ns, dipole)
            carried = (self.carries * dipole).tolist()
            for _ in range(5):
                change = 5e-3 * self._acceleration(*carried)
                turn = 5e-3 * (self.rate + 0.5 * change)
                self.attitude = multiply(from_rotation_vector(turn), self.attitude)
                self.rate = self.rate + change
            self.time_ns += PERIOD_NS
            self.attitudes[self.time_ns] = self.attitude
            self.filter.accept(self._reading())

    def _acceleration(self, mx: float, my: float, mz: float) -> FloatArray:
        """Return the angular acceleration (3,), rad/s^2, under a dipole, A m^2.

        The method uses floats, because they are faster than arrays of three elements.
        """
        bx, by, bz = (attitude_matrix(self.attitude) @ FIELD).tolist()
        wx, wy, wz = self.rate.tolist()
        jx, jy, jz = MOMENTS
        return np.array(
            [
                (my * bz - mz * by + (jy - jz) * wy * wz) / jx,
                (mz * bx - mx * bz + (jz - jx) * wz * wx) / jy,
                (mx * by - my * bx + (jx - jy) * wx * wy) / jz,
            ]
        )

    def stars(self, time_ns: int, off: FloatArray | None = None) -> AttitudeMeasurement:
        """Return the star attitude at a past time, with an error of `off` (3,), rad."""
        error = STAR * self.generator.standard_normal(3) + (0.0 if off is None else off)
        seen = multiply(from_rotation_vector(error), self.attitudes[time_ns])
        return AttitudeMeasurement(time_ns, seen, STAR**2 * np.eye(3), by_stars=True)

    def see(self, age_ns: int, off: FloatArray | None = None) -> bool:
        """Pass a star attitude of the age `age_ns` to the filter, and return whether it was used."""
        used: list[bool] = []
        self.filter.measure_late([self.stars(self.time_ns - age_ns, off)], used.extend)
        return used == [True]

    def error(self) -> float:
        """Return the angle (rad) between the estimated and the true attitude."""
        return float(angle_between(self.filter.at(self.time_ns).quaternion, self.attitude))

    def _reading_at(self, time_ns: int) -> ImuReading:
        return self._reading()._replace(time_ns=time_ns, arrival_ns=time_ns)

    def _reading(self) -> ImuReading:
        noise = self.generator.standard_normal(6)
        field = attitude_matrix(self.attitude) @ FIELD + 1e-7 * noise[3:] + self.magnet
        field = field if self.field is None else self.field
        rate, nothing = self.rate + self.bias + 1e-4 * noise[:3], np.zeros(3)
        rate = rate if self.has_gyro else np.full(3, np.nan)
        return ImuReading(self.time_ns, self.time_ns, self.time_ns, IDENTITY, rate, field, nothing)


@pytest.mark.parametrize("form", [replace, copy, deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_a_propagated_estimate_can_be_replaced_copied_and_pickled(
    form: Callable[[Estimate], Estimate],
) -> None:
    flown = Flown()
    flown.fly(1.0)
    flown.filter.begin(flown.stars(flown.time_ns - 24 * PERIOD_NS))
    found = flown.filter.at(flown.time_ns)
    other = form(found)
    assert (other.covariance == found.covariance).all()
    assert (other.rate == found.rate).all()
    assert other.time_ns == found.time_ns


def acquired(pulses: bool = False) -> Flown:
    """Return a body whose filter has received star attitudes every 5 s; the first was 0.6 s old.

    The body is a copy, so that no test changes the body of another test.
    """
    return deepcopy(_acquired(pulses))


@cache
def _acquired(pulses: bool) -> Flown:
    flown = Flown(pulses)
    flown.fly(3.0)
    assert flown.filter.knowledge is Knowledge.LOST
    assert not flown.filter.started
    assert flown.filter.begin(flown.stars(flown.time_ns - 24 * PERIOD_NS))
    for _ in range(5):
        flown.fly(5.0)
        assert flown.see(52 * PERIOD_NS)
    return flown


@pytest.mark.parametrize("pulses", [False, True])
def test_stars_of_over_a_second_ago_are_applied_at_their_own_time(pulses: bool) -> None:
    flown = acquired(pulses)
    found = flown.filter.at(flown.time_ns)
    sigma = np.sqrt(np.diag(found.covariance))
    assert flown.filter.knowledge is Knowledge.FINE
    assert flown.error() < 3.0 * np.linalg.norm(sigma[ATTITUDE])
    assert (np.abs(found.rate - flown.rate) < 4.0 * sigma[RATE]).all()
    assert found.bias == pytest.approx(BIAS, abs=5e-5)
    assert flown.filter.refused == 0


def test_within_a_step_a_fast_body_is_propagated_by_the_learned_coils_in_the_rotating_field() -> None:
    """Between two steps, the filter predicts the rate of a fast body from coil gains and the rotating field.

    The true gain is 1.2, and the body rotates by several degrees within a step.
    """
    flown = Flown(pulses=True, errors=BodyErrors(moments=0.0, axes=0.0))
    flown.rate, flown.carries = np.array([0.08, -0.1, 0.06]), 1.2
    flown.fly(3.0)
    assert flown.filter.begin(flown.stars(flown.time_ns - 24 * PERIOD_NS))
    for _ in range(8):
        flown.fly(5.0)
        assert flown.see(52 * PERIOD_NS)
    assert flown.filter.coil_matrix[0, 0] == pytest.approx(1.2, abs=0.06)
    flown.fly(0.25)
    error, change = flown.rate - flown.filter.at(flown.time_ns).rate, flown.rate
    flown.fly(0.7)
    found = flown.filter.at(flown.time_ns)
    assert np.linalg.norm(flown.rate - change) > 4e-4
    assert flown.rate - found.rate == pytest.approx(error, abs=1.5e-5)


def test_the_covariance_of_the_star_camera_is_that_of_the_present_time() -> None:
    flown = Flown(pulses=True, errors=BodyErrors(camera=0.0))
    flown.fly(3.0)
    assert flown.filter.begin(flown.stars(flown.time_ns - PERIOD_NS))
    claims = []
    for seconds in (1.5, 0.7):
        flown.fly(seconds)
        found = flown.filter.description(flown.time_ns)["camera_attitude_sigma"]
        # Without camera misalignment, the attitudes of camera and body have the same uncertainty.
        present = flown.filter.at(flown.time_ns).covariance[ATTITUDE, ATTITUDE]
        assert found == pytest.approx(np.sqrt(present.diagonal()))
        claims.append(found)
    assert (claims[1] > 1.2 * claims[0]).all()


def test_the_past_and_the_rates_of_an_exposure_are_kept() -> None:
    flown = acquired(pulses=True)
    then = flown.time_ns - 60 * PERIOD_NS
    past = flown.filter.past(then)
    assert past is not None
    assert angle_between(past.quaternion, flown.attitudes[then]) < 5e-4, "the rms over 8 seeds is 3.3e-4"
    spanning = flown.filter.rates(then, then + SECOND_NS)
    assert spanning is not None
    assert spanning[0][0] <= then < then + SECOND_NS <= spanning[0][-1]
    assert flown.filter.past(flown.time_ns - 30 * SECOND_NS) is None


def test_stars_older_than_the_history_are_refused() -> None:
    flown = acquired()
    assert not flown.see(20 * SECOND_NS)


def test_stars_older_than_the_history_do_not_contradict_the_estimate() -> None:
    flown = acquired()
    for _ in range(REFUSALS_TO_RESTART):
        assert not flown.see(20 * SECOND_NS)
    assert not flown.see(10 * PERIOD_NS, np.array([0.0, 0.1, 0.0]))
    assert flown.filter.restarts == 0


def test_after_some_attitudes_that_contradict_it_the_filter_begins_again() -> None:
    flown = acquired()
    off = np.array([0.0, 0.1, 0.0])
    for number in range(REFUSALS_TO_RESTART):
        assert flown.filter.restarts == 0, number
        flown.fly(2.0)
        assert not flown.see(10 * PERIOD_NS, off)
    assert flown.filter.restarts == 1
    assert flown.error() == pytest.approx(0.1, abs=5e-3)


@pytest.mark.parametrize("wrong", [-2e-3, 1.5e-3])
def test_stars_replace_a_wrong_bias_of_an_earlier_boot_within_half_a_minute(wrong: float) -> None:
    """A wrong stored bias with a stated uncertainty of 1e-5 rad/s is replaced within 30 s.

    Star fixes contradict the bias and restart the filter.
    """
    prior = FreeFilterSettings().error_state(INERTIA).prior[SLOW, SLOW].copy()
    values, bias = np.zeros(len(prior)), slice(GYRO.start - SLOW.start, GYRO.stop - SLOW.start)
    values[bias], prior[bias, bias] = wrong, 1e-10 * np.eye(3)
    flown = Flown(slow=SlowStates(values, prior))
    flown.fly(3.0)
    assert flown.filter.begin(flown.stars(flown.time_ns - 24 * PERIOD_NS))
    for _ in range(6):
        flown.fly(5.0)
        flown.see(52 * PERIOD_NS)
    assert flown.filter.restarts > 0
    found = flown.filter.at(flown.time_ns)
    assert found.bias == pytest.approx(BIAS, abs=1e-4)
    assert flown.error() < 1e-3


ACCURACY = BodyErrors(moments=0.1, axes=0.05, coil_gain=0.2, coil_axes=0.05)


def _taught(stored: dict[int, tuple[float, float]]) -> SlowStates:
    """Return the stored states of an earlier boot, with given values and standard deviations by index."""
    covariance = FreeFilterSettings(errors=ACCURACY).error_state(INERTIA).prior[SLOW, SLOW].copy()
    values = np.zeros(len(covariance))
    for index, (value, sigma) in stored.items():
        at = index - SLOW.start
        covariance[at] = covariance[:, at] = 0.0
        values[at], covariance[at, at] = value, sigma**2
    return SlowStates(values, covariance)


# Stored estimates of the inertia errors, relative to the trace. The estimates differ from the truth by 10 or
# 15 % of a principal moment.
WRONG_INERTIA = {INERTIA_ERROR.start: (0.052, 1e-4), INERTIA_ERROR.start + 1: (-0.034, 1e-4)}
KNOWN_COILS = {index: (0.0, 5e-3) for index in range(COILS.start, COILS.stop)}


@pytest.mark.parametrize(
    ("stored", "spin", "wrong"),
    [
        (WRONG_INERTIA, 20.0 * SPIN, True),
        (KNOWN_COILS | {COILS.start: (-0.4, 5e-3)}, 20.0 * SPIN, True),
        (KNOWN_COILS | {COILS.stop - 1: (0.3, 5e-3)}, 20.0 * SPIN, True),
        (KNOWN_COILS | {index: (0.0, 1e-4) for index in WRONG_INERTIA}, 20.0 * SPIN, False),
    ],
)
def test_the_motion_replaces_wrong_learned_values_after_a_minute_and_healthy_ones_never(
    stored: dict[int, tuple[float, float]], spin: FloatArray, wrong: bool
) -> None:
    flown = Flown(pulses=True, errors=ACCURACY, slow=_taught(stored))
    flown.rate, flown.alternates = spin, True
    flown.fly(3.0)
    assert flown.filter.begin(flown.stars(flown.time_ns - 24 * PERIOD_NS))
    for _ in range(15):
        flown.fly(5.0)
        flown.see(52 * PERIOD_NS)
    assert len(flown.filter.contradictions) == wrong
    assert all("inertia, dipole and torques" in text for text in flown.filter.contradictions)
    slow = flown.filter.slow
    for index, (_, sigma) in stored.items():
        at = index - SLOW.start
        claimed = float(np.sqrt(slow.covariance[at, at]))
        assert abs(slow.values[at]) < 4.0 * claimed
        assert (claimed > 2.0 * sigma) is wrong
    assert flown.error() < 4.0 * flown.filter.worst_sigma


def test_attitudes_that_are_not_finite_never_restart_the_filter() -> None:
    """A failing vision worker may send attitudes with NaN. Such attitudes must not stop the control task."""
    flown = acquired()
    for _ in range(2 * REFUSALS_TO_RESTART):
        flown.fly(2.0)
        assert not flown.see(10 * PERIOD_NS, np.full(3, np.nan))
    assert flown.filter.restarts == 0
    assert flown.error() < 1e-3


def test_a_rate_from_streaks_is_used() -> None:
    flown = acquired()
    flown.fly(1.0)
    since_ns, until_ns = flown.time_ns - 60 * PERIOD_NS, flown.time_ns - 20 * PERIOD_NS
    used: list[bool] = []
    rate = MeanRateMeasurement(since_ns, until_ns, flown.rate, 1e-10 * np.eye(3))
    flown.filter.measure_late([rate], used.extend)
    assert used == [True]


@pytest.mark.parametrize("pulses", [False, True])
@pytest.mark.parametrize("jump", [1e-4, 3e-4, 1e-3, -2e-3])
def test_a_jump_of_the_gyro_bias_is_estimated_without_a_wrong_claim(jump: float, pulses: bool) -> None:
    """After a jump of the gyro bias, the errors of attitude, rate and bias stay within their uncertainties.

    The gyro alone cannot show whether the bias or the rate has changed.
    """
    flown = acquired(pulses=pulses)
    for _ in range(6):
        flown.fly(5.0)
        assert flown.see(52 * PERIOD_NS)
    flown.bias = BIAS + np.array([0.0, jump, 0.0])
    for _ in range(6):
        for _ in range(5):
            flown.fly(1.0)
            found = flown.filter.at(flown.time_ns)
            error = to_rotation_vector(multiply(found.quaternion, conjugate(flown.attitude)))
            sigma = np.sqrt(np.diag(found.covariance))
            assert (np.abs(error) < 5.0 * sigma[ATTITUDE]).all()
            assert (np.abs(found.rate - flown.rate) < 5.0 * sigma[RATE]).all()
        flown.see(52 * PERIOD_NS)
    assert flown.filter.restarts == 0
    assert found.bias == pytest.approx(flown.bias, abs=1e-4)


def test_uncertain_currents_increase_the_uncertainty() -> None:
    flown = acquired()
    before = flown.filter.at(flown.time_ns).covariance[RATE, RATE].trace()
    flown.filter.mark_unknown(flown.time_ns - SECOND_NS)
    assert flown.filter.at(flown.time_ns).covariance[RATE, RATE].trace() > 2.0 * before


def test_the_attitude_error_stays_within_its_claim_if_a_coil_fails() -> None:
    """The attitude error stays within 5 sigma if a coil fails in the middle of a step.

    The gyro measures the resulting rate.
    """
    flown = acquired(pulses=True)
    flown.carries = 0.0
    flown.fly(7.5)
    found = flown.filter.at(flown.time_ns)

    error = to_rotation_vector(multiply(found.quaternion, conjugate(flown.attitude)))
    assert (np.abs(error) < 5.0 * np.sqrt(np.diag(found.covariance)[ATTITUDE])).all()


def test_stars_that_contradict_the_commanded_dipole_are_used_and_widen_the_claim() -> None:
    """Star fixes that contradict the commanded dipole are accepted, and increase the uncertainty.

    Coil x has 0.3 times the commanded dipole, which the gyro alone does not show.
    """
    flown = acquired(pulses=True)
    flown.carries = 0.3
    for _ in range(2):
        flown.fly(5.0)
        assert flown.see(52 * PERIOD_NS)
    assert flown.filter.refused >= 1
    assert flown.error() < 3.0 * flown.filter.worst_sigma
    assert flown.filter.restarts == 0


def test_the_attitude_stays_within_its_claim_while_the_orbit_is_unknown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The GPS receiver of a satellite without elements gives no fix for a minute."""
    flown = acquired()
    known = flown.filter._around
    monkeypatch.setattr(flown.filter, "_around", lambda _: None)
    for _ in range(4):
        flown.fly(15.0)
        claim = flown.filter.at(flown.time_ns).covariance[:3, :3]
        assert flown.error() < 3.0 * np.sqrt(np.linalg.eigvalsh(claim)[-1]) < 0.15
    monkeypatch.setattr(flown.filter, "_around", known)
    flown.fly(3.0)
    assert flown.error() < 0.01
    assert flown.see(20 * PERIOD_NS)


def test_commands_that_were_doubted_are_tried_again_after_a_rest() -> None:
    """After 5 to 13 s without a dipole, the filter trusts the commands again.

    Untrusted coils stay off, so only a new trial can show that they work.
    """
    flown = acquired(pulses=True)
    flown.carries = -3.0
    flown.fly(6.0)
    assert flown.filter.doubts_commands
    flown.carries, flown.rests = 1.0, True
    flown.fly(5.0)
    assert flown.filter.doubts_commands
    flown.fly(8.0)
    assert not flown.filter.doubts_commands


def test_a_magnetometer_that_repeats_its_value_or_is_false_is_doubted_and_left_out() -> None:
    flown = acquired()
    assert flown.filter.field_doubt == ""
    flown.field = np.array([3e-5, 1e-5, 2e-5])
    flown.fly(1.0)
    assert "the same field" in flown.filter.field_doubt
    flown.fly(10.0)
    assert flown.filter.knowledge is Knowledge.FINE
    assert flown.error() < 5e-4
    flown.field, flown.magnet = None, np.array([2e-5, 0.0, 0.0])
    flown.fly(6.0)
    assert "contradict the estimate" in flown.filter.field_doubt
    flown.magnet = np.zeros(3)
    flown.fly(3.0)
    assert flown.filter.field_doubt == ""


def _coil_x(flown: Flown) -> tuple[float, float]:
    """Return the estimated gain of coil x, and the standard deviation of this gain."""
    found = flown.filter.description(flown.time_ns)
    return float(found["coils"][0]), float(found["coils_sigma"][0])


def test_a_correction_of_a_coil_is_applied_in_the_currents_and_not_in_the_learned_matrix_as_well() -> None:
    """If the coil monitor corrects a gain of 0.8, the filter resets its own estimate of this gain to 1."""
    flown = acquired(pulses=True)
    flown.carries = 0.8
    for _ in range(10):
        flown.fly(5.0)
        flown.see(52 * PERIOD_NS)
    learned, _ = _coil_x(flown)
    assert learned < 0.9
    flown.filter.correct_coils(np.array([0.8, 1.0, 1.0]), np.array([0.2, 0.0, 0.0]))
    gain, sigma = _coil_x(flown)
    assert gain == pytest.approx(1.0, abs=0.15)
    assert sigma > 0.05
    flown.carries = 1.0  # the commanded currents now include the correction
    assert flown.see(60 * PERIOD_NS), "a measurement from before the correction"
    for _ in range(6):
        flown.fly(5.0)
        flown.see(52 * PERIOD_NS)
    gain, sigma = _coil_x(flown)
    assert gain == pytest.approx(1.0, abs=min(4.0 * sigma, 0.1))
    assert flown.error() < 4.0 * flown.filter.worst_sigma
    assert flown.filter.restarts == 0


def test_a_measurement_from_before_a_correction_does_not_bring_the_old_matrix_back() -> None:
    flown = acquired(pulses=True)
    flown.carries = 0.8
    for _ in range(8):
        flown.fly(5.0)
        flown.see(52 * PERIOD_NS)
    flown.rests = True
    flown.fly(12.0)
    flown.filter.correct_coils(np.array([0.8, 1.0, 1.0]), np.zeros(3))
    assert _coil_x(flown)[0] == pytest.approx(1.0, abs=0.02)
    assert flown.see(8 * SECOND_NS)
    assert _coil_x(flown)[0] == pytest.approx(1.0, abs=0.02)


def test_the_dipole_of_a_corrected_coil_is_unknown_in_the_steps_before() -> None:
    flown = acquired(pulses=True)
    steps = flown.filter._steps
    driven = [step.dipole[0] for step in steps]
    flown.filter.correct_coils(np.array([1.0, -1.0, 1.0]), np.zeros(3))
    assert not any(step.doubt for step in steps), "coil y was never driven"
    flown.filter.correct_coils(np.array([-1.0, 1.0, 1.0]), np.zeros(3))
    assert [step.doubt > 0.0 for step in steps] == [dipole != 0.0 for dipole in driven]
    assert [step.dipole[0] for step in steps] == [-dipole for dipole in driven]
    assert any(driven)
    assert not all(driven)


def test_currents_that_redundant_coils_do_not_share_linearly_make_the_dipole_less_certain() -> None:
    """If the currents of redundant coils do not cause the least heat, the dipole is less certain."""
    flown = acquired()
    pyramid = np.array([[1.0, -1.0, -1.0, 1.0], [1.0, 1.0, -1.0, -1.0], [1.0, 1.0, 1.0, 1.0]])
    coils = CoilMap(pyramid, np.full(4, 0.1), np.full(4, 30.0))
    errors = BodyErrors(coil_gain=0.2)
    settings = replace(flown.filter._settings, coils=coils, free=FreeFilterSettings(errors=errors))
    idle = 0.02 * np.array([1.0, -1.0, 1.0, -1.0])  # currents whose total dipole is zero
    linear = coils.currents(np.array([DIPOLE, 0.0, 0.0]))
    doubts = []
    for used, currents in (
        (np.ones(4, dtype=bool), linear),
        (np.ones(4, dtype=bool), linear + idle),
        (np.array([True, True, True, False]), linear + linear[3] * np.array([1.0, -1.0, 1.0, -1.0])),
    ):
        filter_ = OrbitFilter(settings, around)
        if not used.all():
            filter_.renew_coils(np.zeros((9, 9)), used)
        filter_.command(0, currents)
        for cycle in range(60):
            filter_.accept(flown._reading_at(cycle * PERIOD_NS))
            filter_.command((cycle + 1) * PERIOD_NS, currents)
        doubts.append(filter_._steps[0].doubt)
    expected = 0.2 * 0.02 * np.sqrt(12.0) / 3.0  # four coils of sqrt(3) A m^2 per ampere
    assert doubts == pytest.approx([0.0, expected, 0.0], abs=1e-12)


def test_a_correction_of_redundant_coils_widens_the_present_estimate() -> None:
    """A correction of a coil increases the uncertainty, because earlier dipoles of the coil are uncertain."""
    pyramid = np.array([[1.0, -1.0, -1.0, 1.0], [1.0, 1.0, -1.0, -1.0], [1.0, 1.0, 1.0, 1.0]])
    coils = CoilMap(pyramid, np.full(4, 0.1), np.full(4, 30.0))
    currents, flown, sigmas = coils.currents(np.array([DIPOLE, 0.0, 0.0])), Flown(), []
    flown.attitudes |= {cycle * PERIOD_NS: IDENTITY for cycle in range(80)}
    for change in (np.ones(4), np.array([0.5, 1.0, 1.0, 1.0])):
        filter_ = OrbitFilter(replace(flown.filter._settings, coils=coils), around)
        for cycle in range(80):
            filter_.accept(flown._reading_at(cycle * PERIOD_NS))
            filter_.command(cycle * PERIOD_NS, currents)
        assert filter_.begin(flown.stars(20 * PERIOD_NS))
        filter_.correct_coils(change, np.zeros(4))
        sigmas.append(filter_.worst_sigma)
    assert sigmas[1] > 1.01 * sigmas[0]


TUMBLE = np.array([0.02, -0.05, 0.03])


@pytest.mark.parametrize(("pulses", "every"), [(False, 5.0), (True, 5.0), (True, 2.0)])
def test_star_fixes_give_attitude_and_rate_of_a_tumbling_body_without_a_gyro(
    pulses: bool, every: float
) -> None:
    """Without a gyro, star fixes every 2 or 5 s determine attitude and rate of a tumbling body.

    The first fix leaves the rate about the field unknown. The second fix must not discard the first fix.
    """
    flown = Flown(pulses)
    flown.rate, flown.has_gyro = TUMBLE, False
    flown.fly(3.0)
    assert flown.filter.begin(flown.stars(flown.time_ns - 24 * PERIOD_NS))
    for _ in range(round(20.0 / every)):
        flown.fly(every)
        if not flown.filter.started:
            assert flown.filter.begin(flown.stars(flown.time_ns - 24 * PERIOD_NS))
        else:
            assert flown.see(24 * PERIOD_NS)
    found = flown.filter.at(flown.time_ns)
    error = np.concatenate(
        (to_rotation_vector(multiply(flown.attitude, conjugate(found.quaternion))), flown.rate - found.rate)
    )
    sigma = np.sqrt(np.diag(found.covariance)[:6])
    assert (np.abs(error) < 4.0 * sigma).all()
    assert np.abs(error[3:]).max() < 2e-4
    assert sigma[3:].max() < 1e-3
    assert flown.filter.restarts == 0
    assert flown.filter.refused == 0
    assert not flown.filter.doubts_commands


def test_a_gyro_that_dies_and_recovers_within_the_flight_leaves_an_honest_estimate() -> None:
    flown = acquired(pulses=True)
    for gyro in (False, True):
        flown.has_gyro = gyro
        flown.fly(5.4)
        assert (flown.filter.rate_by_field() is None) is gyro
        assert flown.see(24 * PERIOD_NS)
    found = flown.filter.at(flown.time_ns)
    off = (flown.rate - found.rate) / np.sqrt(np.diag(found.covariance)[RATE])
    assert np.abs(off).max() < 4.0
    assert flown.filter.refused == 0


def test_the_magnetometer_gives_the_rate_while_nothing_else_does() -> None:
    """A direction is not propagated until the magnetometer has determined the rate about all axes."""
    flown = Flown()
    flown.rate, flown.has_gyro = TUMBLE, False
    assert flown.filter.rate_by_field() is None
    flown.fly(1.0)
    early = flown.filter.rate_by_field()
    assert early is not None
    assert flown.filter.turned(0, SECOND_NS // 2) is None, "the rate along the field is unknown"
    along = FIELD / np.linalg.norm(FIELD)
    across = attitude_matrix(flown.attitude) @ along
    off = flown.rate - early.rate
    assert np.linalg.norm(off - across * (across @ off)) < 0.01
    assert across @ early.covariance @ across > 0.1**2


@pytest.mark.parametrize("renewed", [True, False])
def test_another_magnetometer_begins_without_the_learned_bias(renewed: bool) -> None:
    """The filter discards the bias of a replaced magnetometer.

    With the old bias, the filter would refuse the readings of the new magnetometer.
    """
    flown = Flown(pulses=True)
    flown.rate, flown.magnet = TUMBLE, np.array([6e-7, 0.0, -6e-7])
    flown.fly(3.0)
    assert flown.filter.begin(flown.stars(flown.time_ns - 24 * PERIOD_NS))
    for _ in range(16):
        flown.fly(5.0)
        assert flown.see(24 * PERIOD_NS)
    assert flown.filter.refused == 0
    if renewed:
        learned = flown.filter.at(flown.time_ns)
        flown.filter.renew_magnetometer()
        fresh = flown.filter.at(flown.time_ns)
        assert learned.field_bias.any()
        assert not fresh.field_bias.any()
        assert (fresh.covariance.diagonal()[FIELD_BIAS] > learned.covariance.diagonal()[FIELD_BIAS]).all()
    flown.magnet = -flown.magnet
    for _ in range(4):
        flown.fly(5.0)
        assert flown.see(24 * PERIOD_NS)
    assert (flown.filter.refused == 0) is renewed
    assert flown.error() < 5.0 * flown.filter.worst_sigma


def test_the_dipoles_stay_unknown_while_the_driver_of_the_coils_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """During the failure, each command has the time at which the failure began, so all steps begin later."""
    flown = Flown(pulses=True)
    flown.fly(2.0)
    failed_ns, command = flown.time_ns, flown.filter.command
    monkeypatch.setattr(flown.filter, "command", lambda *_: command(failed_ns, np.zeros(3), known=False))
    flown.fly(4.0)
    repaired_ns = flown.time_ns
    monkeypatch.setattr(flown.filter, "command", lambda *_: command(repaired_ns, np.zeros(3)))
    flown.fly(4.0)
    doubts = {step.end_ns: step.doubt > 0.0 for step in flown.filter._steps if step.begin_ns > failed_ns}
    assert len(doubts) > 5
    assert doubts == {end_ns: end_ns <= repaired_ns + SECOND_NS for end_ns in doubts}
