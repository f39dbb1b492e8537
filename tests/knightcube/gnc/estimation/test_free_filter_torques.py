"""Tests of a free satellite's filter with unknown inertia axes and unknown coil currents."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray, cross_product
from knightcube.astro.earth.disturbance import AIR, Pressures
from knightcube.astro.quaternion import (
    IDENTITY,
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.gnc.estimation import free_filter
from knightcube.gnc.estimation.error_state import PLAUSIBLE, Role
from knightcube.gnc.estimation.free_filter import (
    AIR_WALK,
    ATTITUDE,
    GYRO,
    RATE,
    SLOW,
    TORQUES,
    FilterEnvironment,
    FreeFilter,
    FreeFilterSettings,
    SlowStates,
)
from knightcube.gnc.estimation.free_filter import (
    INERTIA as INERTIA_ERROR,
)
from tests.knightcube.gnc.estimation.filter_states import NO_ERRORS

INERTIA = np.diag([0.0066, 0.0333, 0.0333])
BIAS = np.array([4e-5, -3e-5, 2e-5])
AXES_TURN = np.array([0.004, 0.012, -0.010])
GYRO_SIGMA, STAR = 4.4e-5, 5e-5
CYCLES = 40
"""Number of coil cycles per second."""
FIELD = np.array([1e-5, 2e-5, 3e-5])
NOTHING = Pressures(np.zeros((1, 3)), np.zeros((1, 3)))
AROUND = FilterEnvironment(FIELD, np.array([6.878e9, 0.0, 0.0]), NOTHING, 0.0)


class Craft:
    """A rigid body whose principal axes are rotated, and biased gyros."""

    def __init__(self, turn: FloatArray, rate: FloatArray, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        rotation = attitude_matrix(from_rotation_vector(turn)).T
        self.inertia = rotation @ INERTIA @ rotation.T
        self.quaternion, self.rate = IDENTITY, rate

    def second(self, dipole: FloatArray, noise: float) -> FloatArray:
        """Simulate a second with a dipole (3,) and `noise` (A m^2) per cycle; return the mean of the gyro."""
        dt, rates, inverse = 1.0 / CYCLES, [], np.linalg.inv(self.inertia)
        for _ in range(CYCLES):
            acting = dipole + noise * self.rng.standard_normal(3)
            torque = cross_product(acting, attitude_matrix(self.quaternion) @ FIELD)
            momentum = self.inertia @ self.rate
            middle = self.rate + 0.5 * dt * inverse @ (torque - cross_product(self.rate, momentum))
            self.quaternion = multiply(from_rotation_vector(dt * middle), self.quaternion)
            momentum = self.inertia @ middle
            self.rate = self.rate + dt * inverse @ (torque - cross_product(middle, momentum))
            rates.append(middle)
        return np.asarray(np.mean(rates, axis=0) + BIAS + GYRO_SIGMA * self.rng.standard_normal(3))

    def seen(self, sigma: float) -> FloatArray:
        """Return the true attitude with a random error of `sigma` (rad) per axis."""
        return multiply(from_rotation_vector(sigma * self.rng.standard_normal(3)), self.quaternion)


def errors(found: FreeFilter, craft: Craft) -> FloatArray:
    """Return the errors (9,) of attitude, rate and gyro bias."""
    turn = to_rotation_vector(multiply(craft.quaternion, conjugate(found.quaternion)))
    return np.concatenate([turn, craft.rate - found.rate, BIAS - found.gyro_bias])


def fly(
    craft: Craft,
    found: FreeFilter,
    seconds: int,
    dipole: FloatArray,
    noise: float,
    variation: float = 0.0,
    every: int = 20,
) -> None:
    """Simulate a body with a gyro mean every second, and star attitudes every ten seconds.

    The true dipole of each coil deviates from the command by the standard deviation `variation`. A new
    deviation is drawn at intervals of `every` s.
    """
    true = dipole
    for second in range(1, seconds + 1):
        if variation and second % every == 1:
            true = dipole * (1.0 + np.sqrt(3.0) * variation * craft.rng.uniform(-1.0, 1.0, 3))
        mean = craft.second(true, noise)
        found.begin_mean()
        found.advance(1.0, dipole, AROUND)
        found.gyro(mean, GYRO_SIGMA**2 * np.eye(3), 0.5 * found.acceleration, 0.5)
        if second % 10 == 0:
            found.attitude(craft.seen(STAR), STAR**2 * np.eye(3))


def started(craft: Craft, settings: FreeFilterSettings) -> FreeFilter:
    """Return a filter that has received a star attitude and one gyro sample."""
    found = FreeFilter(INERTIA, settings)
    gyro = craft.rate + BIAS + GYRO_SIGMA * craft.rng.standard_normal(3)
    found.start(craft.seen(STAR), STAR**2 * np.eye(3), gyro, by_stars=True)
    return found


def test_a_rotation_of_the_principal_axes_is_not_estimated_as_a_gyro_bias() -> None:
    craft = Craft(AXES_TURN, np.array([0.14, 0.06, -0.05]), 1)
    found = started(craft, FreeFilterSettings())
    fly(craft, found, 90, np.zeros(3), 0.0)
    error, sigma = errors(found, craft), np.sqrt(np.diag(found.covariance))
    assert found.refused == 0
    assert np.abs(error[GYRO]).max() < 1e-4, "a filter with fixed axes learns 1e-3"
    assert np.all(np.abs(error) < 4.5 * sigma[:9])
    assert ratio_error(found, craft) < 0.0005


def ratio_error(found: FreeFilter, craft: Craft) -> float:
    """Return the largest error of an element of J / trace(J)."""
    true = craft.inertia / np.trace(craft.inertia)
    elements = found.description()["inertia"]
    return float(np.abs(elements / elements[:3].sum() - true[[0, 1, 2, 1, 2, 0], [0, 1, 2, 2, 0, 1]]).max())


@pytest.mark.parametrize("seed", range(3))
def test_a_tumble_shows_the_ratios_of_the_moments_and_the_scale_stays_uncertain(seed: int) -> None:
    craft = Craft(AXES_TURN, np.array([0.12, 0.08, -0.06]), seed)
    craft.inertia = craft.inertia @ np.diag([1.08, 0.95, 0.95])
    craft.inertia = 0.5 * (craft.inertia + craft.inertia.T)
    found = started(craft, FreeFilterSettings())
    assert ratio_error(found, craft) > 0.005
    fly(craft, found, 120, np.zeros(3), 0.0)
    assert found.refused == 0
    assert ratio_error(found, craft) < 0.001
    covariance = found.covariance[INERTIA_ERROR, INERTIA_ERROR]
    scale = np.concatenate([np.diag(INERTIA), np.zeros(3)]) / np.trace(INERTIA)
    scale /= np.linalg.norm(scale)
    assert np.sqrt(scale @ covariance @ scale) > 0.01, "no coil acted: nothing shows the scale"
    assert inertia_square(found, craft) < 22.5, "99.9 % of a chi-square with 6"


def test_a_spin_about_a_principal_axis_leaves_the_claim_wide() -> None:
    craft = Craft(np.zeros(3), np.array([0.0, 0.0, 0.15]), 1)
    found = started(craft, FreeFilterSettings())
    before = np.sqrt(np.diag(found.covariance))[INERTIA_ERROR]
    fly(craft, found, 120, np.zeros(3), 0.0)
    after = np.sqrt(np.diag(found.covariance))[INERTIA_ERROR]
    assert np.all(after[:3] > 0.85 * before[:3])


def test_the_first_seconds_of_a_fast_tumble_do_not_make_the_inertia_too_certain() -> None:
    squares = []
    for seed in range(8):
        drawn = np.random.default_rng(seed)
        craft = Craft(np.zeros(3), 0.09 * drawn.choice((-1.0, 1.0), 3), seed)
        rotation = attitude_matrix(from_rotation_vector(drawn.uniform(-0.08, 0.08, 3)))
        craft.inertia = rotation.T @ np.diag(np.diag(INERTIA) * drawn.uniform(0.94, 1.06, 3)) @ rotation
        found = started(craft, FreeFilterSettings())
        fly(craft, found, 10, np.zeros(3), 0.0)
        squares.append(inertia_square(found, craft) / 6.0)
    assert np.mean(squares) < 1.6, "more than 2 without the terms of second order"


def inertia_square(found: FreeFilter, craft: Craft) -> float:
    """Return the NEES of the inertia, a chi-square with 6 degrees of freedom."""
    true = (craft.inertia - INERTIA) / np.trace(INERTIA)
    error = true[[0, 1, 2, 1, 2, 0], [0, 1, 2, 2, 0, 1]] - found._constants[INERTIA_ERROR]
    return float(error @ np.linalg.solve(found.covariance[INERTIA_ERROR, INERTIA_ERROR], error))


def test_a_fast_tumble_of_a_very_different_body_leaves_the_scale_uncertain() -> None:
    craft = Craft(4.0 * AXES_TURN, np.array([0.10, 0.08, -0.08]), 0)
    craft.inertia = np.diag([1.09, 0.96, 0.96]) @ craft.inertia @ np.diag([1.09, 0.96, 0.96])
    found = started(craft, FreeFilterSettings())
    sigmas = []
    for seconds in (0, 60):
        fly(craft, found, seconds, np.zeros(3), 0.0)
        inertia = found.inertia[[0, 1, 2, 1, 2, 0], [0, 1, 2, 2, 0, 1]] / np.trace(INERTIA)
        along = inertia / (inertia @ inertia)
        sigmas.append(float(np.sqrt(along @ found.covariance[INERTIA_ERROR, INERTIA_ERROR] @ along)))
    assert ratio_error(found, craft) < 0.003
    assert sigmas[1] > 0.8 * sigmas[0], "no coil acted: only the prior connects the scale with the ratios"
    assert inertia_square(found, craft) < 22.5, "99.9 % of a chi-square with 6"


def test_a_considered_block_is_not_corrected_and_widens_the_claim() -> None:
    sigmas, values = [], []
    for role in (Role.ESTIMATED, Role.CONSIDERED, Role.FIXED):
        craft = Craft(np.zeros(3), np.array([0.14, 0.06, -0.05]), 1)
        found = started(craft, FreeFilterSettings(roles={"gyro_bias": role}))
        fly(craft, found, 60, np.zeros(3), 0.0)
        sigmas.append(float(np.sqrt(found.covariance[RATE, RATE].trace())))
        values.append(found.gyro_bias)
    estimated, considered, fixed = sigmas
    assert fixed < estimated < considered
    assert np.all(values[0] != 0.0)
    assert np.all(values[1] == 0.0)
    assert np.all(values[2] == 0.0)


def test_currents_that_scatter_in_each_cycle_are_in_the_claim() -> None:
    noise = 2.7e-3
    honest = FreeFilterSettings(
        errors=NO_ERRORS, coil_noise=noise / np.sqrt(CYCLES), dipole=(1e-6, 0.0), sunlit=(1e-6, 0.0)
    )
    nees = {}
    for settings in (honest, dataclasses.replace(honest, coil_noise=0.0)):
        squares = []
        for seed in range(6):
            craft = Craft(np.zeros(3), np.array([0.0, -1.1e-3, 0.0]), seed)
            found = started(craft, settings)
            fly(craft, found, 60, np.array([1e-4, 0.0, 1e-4]), noise)
            pick = np.r_[ATTITUDE, RATE]
            error = errors(found, craft)[:6]
            squares.append(error @ np.linalg.solve(found.covariance[np.ix_(pick, pick)], error) / 6.0)
        nees[settings.coil_noise] = float(np.mean(squares))
    assert 0.5 < nees[honest.coil_noise] < 1.7, "36 errors: 99.9 % of a chi-square over 36"
    assert nees[0.0] > 1.7


@pytest.mark.parametrize("every", [5, 20, 60])
def test_coils_that_vary_over_tens_of_seconds_are_in_the_claim(
    every: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The covariance covers coils that vary every 5, 20 or 60 s.

    The filter assumes a correlation time of 20 s.
    """
    honest = FreeFilterSettings(errors=NO_ERRORS, dipole=(1e-6, 0.0), sunlit=(1e-6, 0.0), field=1e-9)
    nees = []
    for coil_error in (free_filter.COIL_ERROR, 0.0):
        monkeypatch.setattr(free_filter, "COIL_ERROR", coil_error)
        squares = []
        for seed in range(6):
            craft = Craft(np.zeros(3), np.array([0.0, -1.1e-3, 0.0]), seed)
            found = started(craft, honest)
            dipole = 0.15 * craft.rng.choice((-1.0, 1.0), 3)
            fly(craft, found, 24, dipole, 0.0, 0.005, every)
            pick = np.r_[ATTITUDE, RATE]
            error = errors(found, craft)[:6]
            squares.append(error @ np.linalg.solve(found.covariance[np.ix_(pick, pick)], error) / 6.0)
        nees.append(float(np.mean(squares)))
    assert 0.5 < nees[0] < 1.7, "36 errors: 99.9 % of a chi-square over 36"
    # Variations in short intervals partly cancel each other, as they are independent.
    assert nees[1] > (3.0 if every >= 20 else 2.0)


def test_a_contradicted_estimate_has_the_prior_variances_again() -> None:
    craft = Craft(np.zeros(3), np.zeros(3), 2)
    found = started(craft, FreeFilterSettings())
    fly(craft, found, 40, np.zeros(3), 0.0)
    learned = np.sqrt(np.diag(found.covariance))[GYRO]
    bias = found.gyro_bias
    found.start(craft.quaternion, STAR**2 * np.eye(3), craft.rate + BIAS)
    assert np.allclose(np.sqrt(np.diag(found.covariance))[GYRO], learned)
    found.start(craft.quaternion, STAR**2 * np.eye(3), craft.rate + BIAS, doubted=True)
    assert np.allclose(np.sqrt(np.diag(found.covariance))[GYRO], 1e-3)
    assert np.allclose(found.gyro_bias, bias)


def test_a_contradicted_estimate_forgets_a_bias_that_no_gyro_has() -> None:
    """A filter that restarts after a contradiction discards a gyro bias that is not plausible.

    False directions have caused the bias. If the filter kept the bias, each restart would give a wrong
    estimate.
    """
    craft, settings = Craft(np.zeros(3), np.zeros(3), 4), FreeFilterSettings()
    known = settings.error_state(INERTIA).prior[SLOW, SLOW]
    taught = np.zeros(len(known))
    taught[0], known[0, 0] = 2.0 * PLAUSIBLE * settings.gyro[0], 1e-12
    found = FreeFilter(INERTIA, settings, SlowStates(taught, known))
    found.start(craft.quaternion, STAR**2 * np.eye(3), craft.rate + BIAS)
    fly(craft, found, 10, np.zeros(3), 0.0)
    assert found.refused, "the next star contradicts it"
    found.start(craft.quaternion, STAR**2 * np.eye(3), craft.rate + BIAS, doubted=True)
    found.refused = 0
    fly(craft, found, 30, np.zeros(3), 0.0)
    assert found.refused == 0
    assert np.abs(found.gyro_bias - BIAS).max() < 3e-5


def test_the_torque_by_air_changes_with_its_density_and_so_by_a_fraction_of_its_size() -> None:
    """The random walk of the drag torque increases with the torque, because the air density varies.

    With strong drag, a constant random walk would be too small, and the filter would finally reject stars.
    """
    settings = FreeFilterSettings(errors=NO_ERRORS)
    prior = settings.error_state(INERTIA).prior[SLOW, SLOW]
    first, seconds = TORQUES.start - SLOW.start + AIR.start, 100
    grown = []
    for size in (0.0, 8e-8):
        values = np.zeros(len(prior))
        values[first + 1] = size
        found = FreeFilter(INERTIA, settings, SlowStates(values, np.zeros_like(prior)))
        found.start(IDENTITY, STAR**2 * np.eye(3), np.zeros(3))
        for _ in range(seconds):
            found.advance(1.0, np.zeros(3), AROUND)
        at = slice(TORQUES.start + AIR.start, TORQUES.start + AIR.stop)
        grown.append(np.sqrt(np.diag(found.covariance[at, at]) / seconds))
    np.testing.assert_allclose(grown[0], settings.torque[1])
    np.testing.assert_allclose(grown[1], np.hypot(settings.torque[1], [0.0, AIR_WALK * 8e-8, 0.0]))


def test_a_dipole_that_acts_late_in_a_step_rotates_the_body_less() -> None:
    """A dipole in the second half of a step rotates the body less than the same mean dipole over the step."""
    dipole = np.array([0.0, 0.09, 0.0])
    apart, together = (FreeFilter(INERTIA, FreeFilterSettings(errors=NO_ERRORS)) for _ in range(2))
    for found in (apart, together):
        found.start(IDENTITY, STAR**2 * np.eye(3), np.zeros(3))
    for part in (np.zeros(3), dipole):
        apart.advance(0.5, part, AROUND)
    assert apart.impulse(0.5) == pytest.approx(0.375 * dipole)
    uneven = 1.0 * (0.5 * 0.5 * dipole - 0.375 * dipole)
    together.advance(1.0, 0.5 * dipole, AROUND, 0.0, uneven)
    off = to_rotation_vector(multiply(apart.quaternion, conjugate(together.quaternion)))
    assert np.linalg.norm(off) < 1e-8
    assert np.linalg.norm(together.motion.inverse @ np.cross(uneven, FIELD)) > 1e-6
    # The rotation by the dipole also rotates the field in body axes, an effect of third order in time.
    assert apart.rate == pytest.approx(together.rate, abs=1e-8)


def test_a_dipole_that_changes_within_a_step_acts_in_the_field_of_its_own_time() -> None:
    """A dipole that changes within a step acts in the field at its own time, not in the field at mid-step.

    In the axes of a rotating body, the field at the end of a step differs from the field at mid-step.
    """
    spin, dipole = np.array([0.05, -0.1, 0.08]), np.array([0.09, -0.05, 0.02])
    rates = []
    for late in (False, True):
        apart, together = (FreeFilter(INERTIA, FreeFilterSettings(errors=NO_ERRORS)) for _ in range(2))
        for found in (apart, together):
            found.start(IDENTITY, STAR**2 * np.eye(3), spin)
        parts = [np.zeros(3), dipole] if late else [dipole, np.zeros(3)]
        for part in parts:
            for _ in range(10):
                apart.advance(0.05, part, AROUND)
        uneven = (-0.125 if late else 0.125) * dipole
        together.advance(1.0, 0.5 * dipole, AROUND, 0.0, uneven)
        rates.append(apart.rate)
        assert together.rate == pytest.approx(apart.rate, abs=4e-7)
    assert np.abs(rates[1] - rates[0]).max() > 6e-6, "the time of the pulse matters"


def test_after_a_large_correction_the_remaining_error_is_that_of_the_corrected_axes() -> None:
    """After a large correction, the covariance refers to errors in the corrected axes.

    A direction that a measurement determines accurately is fixed in inertial space, not in the body.
    """
    prior, noise = 0.3**2 * np.eye(3), np.diag([1.0, 1e-4, 1e-4]) ** 2
    wide = FreeFilter(INERTIA, FreeFilterSettings(errors=NO_ERRORS))
    wide.start(IDENTITY, prior, np.zeros(3))
    assert wide.attitude(from_rotation_vector(np.array([0.0, 0.4, 0.0])), noise)
    covariance = wide.covariance[ATTITUDE, ATTITUDE]
    correction = to_rotation_vector(wide.quaternion)
    # An error e before the correction c is log(exp(e) exp(-c)) after the correction.
    drawn = np.random.default_rng(3).multivariate_normal(
        np.zeros(3), np.linalg.inv(np.linalg.inv(prior) + np.linalg.inv(noise)), 4000
    )
    left = to_rotation_vector(multiply(from_rotation_vector(correction + drawn), conjugate(wide.quaternion)))
    sampled = left.T @ left / len(left)
    assert covariance[0, 2] == pytest.approx(sampled[0, 2], rel=0.15)
    assert abs(covariance[0, 2]) > 0.1 * covariance[0, 0]
