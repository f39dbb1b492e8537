"""The fit finds the simulated truth within its stated uncertainty, and says when it cannot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from ground.identification.constants import Constants, Noise
from ground.identification.fit import first_guess, fit
from ground.identification.preparation import noise_of
from ground.identification.record import IdentificationError
from tests.ground.identification.conftest import Identified
from tests.ground.identification.test_excitation import USUAL
from tests.ground.identification.worlds import believed, fly_bare, motion_error

NOISE = noise_of(believed())


def chi_square(found: list[Identified], off: float = 1.0) -> float:
    """Return the sum over all worlds for gain, torsion and damping; `off` spoils the true gain."""
    total = 0.0
    for world, _, made in found:
        error = motion_error(replace(world, dipole=world.dipole * off), made.constants)
        total += float(error @ np.linalg.solve(made.covariance[:3, :3], error))
    return total


def test_the_truth_lies_within_the_stated_uncertainty_in_all_worlds(identified: list[Identified]) -> None:
    """Chi-square of 4 worlds x 3 constants, 99.8 % band; a gain half a percent off would be noticed."""
    low, high = chi2.ppf([0.001, 0.999], 3 * len(identified))
    assert low < chi_square(identified) < high
    assert chi_square(identified, off=1.005) > high


def test_the_uncertainty_is_small_enough_to_be_of_use(identified: list[Identified]) -> None:
    for world, _, made in identified:
        assert made.sigma("gain") < 2e-3 * world.constants.gain
        assert made.sigma("torsion") < 2e-5
        assert made.sigma("damping") < 1e-4


def test_bias_delay_and_noise_are_found_too(identified: list[Identified]) -> None:
    for world, _, made in identified:
        assert abs(made.constants.bias - world.bias) < 4.0 * made.sigma("bias")
        assert abs(made.constants.delay) < 4.0 * made.sigma("delay")
        assert made.noise.angle == pytest.approx(3.5e-3 / 3**0.5, rel=0.05)
        assert made.noise.rate == pytest.approx(1.75e-4 / 3**0.5, rel=0.05)
        assert made.noise.current == pytest.approx(3.5e-3 / 3**0.5, rel=0.35)
        assert made.whiteness.passed


def test_the_first_guess_is_near_enough_to_start_from(identified: list[Identified]) -> None:
    for world, record, _ in identified:
        assert first_guess(record).gain == pytest.approx(world.constants.gain, rel=0.05)
        assert first_guess(record).torsion == pytest.approx(world.constants.torsion, abs=1e-3)


def test_a_delay_of_the_coils_is_distinguished_from_the_torque() -> None:
    record = fly_bare(USUAL, 40.0)
    late = replace(record, switch_time=record.switch_time - 0.012)
    made = fit(late, NOISE)
    assert made.constants.delay == pytest.approx(0.012, abs=1e-3)
    assert abs(made.constants.gain - USUAL.constants.gain) < 4.0 * made.sigma("gain")


def test_the_hand_that_lets_the_body_go_late_does_not_count() -> None:
    """Ten samples of a body held still, then the release: an impulse that no constant explains."""
    record = fly_bare(USUAL, 40.0)
    held = np.arange(len(record.time)) < 10
    noise = record.angle - np.where(held, 0.3, record.angle)
    spoilt = replace(
        record, angle=np.where(held, 0.3 + 0.01 * noise, record.angle), rate=np.where(held, 0.0, record.rate)
    )
    made = fit(spoilt, NOISE)
    assert 10 in made.innovations.restarts
    error = motion_error(USUAL, made.constants)
    assert error @ np.linalg.solve(made.covariance[:3, :3], error) < chi2.ppf(0.999, 3)


def test_coloured_noise_is_noticed_and_the_uncertainty_grows() -> None:
    """An attitude error that lasts half a second, as a filter inside the unit makes it."""
    record = fly_bare(USUAL, 40.0)
    rng = np.random.default_rng(8)
    drift = 0.3 * lfilter([1.0], [1.0, -0.95], rng.standard_normal(len(record.time)))
    made = fit(replace(record, angle=record.angle + 2e-3 * drift), NOISE)
    assert not made.whiteness.passed
    passed = made.innovations
    j = passed.whiten(passed.gradient).reshape(-1, 6)
    if_white = np.sqrt(np.diag(np.linalg.inv(j.T @ j + np.diag([0.0, 0.0, 0.0, 1.0, 100.0, 2500.0]))))
    wider = np.sqrt(np.diag(made.covariance)) / if_white
    assert np.all(wider > 1.0 - 1e-9)
    assert np.max(wider) > 1.2
    error = motion_error(USUAL, made.constants)
    assert np.all(np.abs(error) < 4.0 * np.sqrt(np.diag(made.covariance)[:3]))


def test_a_coil_connected_the_other_way_is_named() -> None:
    record = fly_bare(replace(USUAL, dipole=-USUAL.dipole), 40.0)
    with pytest.raises(IdentificationError, match=r"coils\.signs"):
        fit(record, NOISE)


def test_a_flight_without_current_or_with_next_to_none_is_refused() -> None:
    record = fly_bare(USUAL, 30.0)
    with pytest.raises(IdentificationError, match="never driven"):
        fit(replace(record, current=np.zeros(len(record.current))), NOISE)
    rng = np.random.default_rng(1)
    count = len(record.time)
    still = replace(
        record,
        angle=2e-3 * rng.standard_normal(count),
        rate=1e-4 * rng.standard_normal(count),
        current=1e-5 * rng.standard_normal(count),
    )
    with pytest.raises(IdentificationError):
        fit(still, NOISE)


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning", "ignore:invalid value:RuntimeWarning")
@pytest.mark.parametrize(("value", "times"), [(1e300, 1), (1e160, 100), (40.0, 100)])
def test_rates_that_nothing_explains_are_refused_however_wild(value: float, times: int) -> None:
    record = fly_bare(USUAL, 20.0)
    rate = record.rate.copy()
    rate[100 : 100 + times] = value * np.random.default_rng(2).standard_normal(times)
    with pytest.raises(IdentificationError):
        fit(replace(record, rate=rate), NOISE)


def test_progress_is_reported_until_the_steps_are_small() -> None:
    steps: list[float] = []
    fit(fly_bare(USUAL, 40.0), NOISE, lambda _, step: steps.append(step))
    assert steps[-1] < 0.01 < max(steps)


def test_constants_and_noise_survive_the_way_through_arrays() -> None:
    constants = Constants(0.3, 0.01, 0.002, 1e-4, -1e-4, 0.004)
    assert Constants.of(constants.to_array()) == constants
    noise = Noise.of_logarithms(Noise(2e-3, 2e-3, 1e-4).to_logarithms())
    assert noise.rate == pytest.approx(1e-4)
