"""Tests that the fit finds the simulated truth within its stated uncertainty, or reports a failure."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter
from scipy.stats import chi2

from flight.schema.bodies import as_testbed
from flight.schema.reader import parse
from ground.identification.fit import (
    NAMES,
    AbsolutePlant,
    MotionConstants,
    MotionNoise,
    PlantFit,
    PlantPrior,
    PriorValue,
    _Predictor,
    absolute,
    config_text,
    excitation_config,
    first_guess,
    fit,
    innovations,
    noise_of,
    plant_section,
    plant_text,
    prior_of,
)
from ground.identification.record import HorizontalField, IdentificationError, Record, Timeline
from knightcube.astro.arrays import FloatArray
from tests.ground.identification.conftest import Identified
from tests.ground.identification.excitations import USUAL
from tests.ground.identification.worlds import believed, drawn, fly_bare, motion_error, scale_error
from tests.support import flights

NOISE = noise_of(believed())


def chi_square(found: list[Identified], off: float = 1.0) -> float:
    """Return the chi-square of gain, torsion and damping over all worlds. `off` multiplies the true gain."""
    total = 0.0
    for world, _, made in found:
        error = motion_error(replace(world, dipole=world.dipole * off), made.constants)
        total += float(error @ np.linalg.solve(made.covariance[:3, :3], error))
    return total


def test_the_truth_lies_within_the_stated_uncertainty_in_all_worlds(identified: list[Identified]) -> None:
    """The chi-square of 4 worlds x 3 constants is in its 99.8 % band.

    With a gain error of 0.5 %, the chi-square exceeds the band.
    """
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
    """A body that is held for ten samples and then released does not bias the fit.

    No constants explain the motion at the release.
    """
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


def test_a_gap_in_the_samples_does_not_bias_the_fit() -> None:
    """After the gap, the prediction by the initial constants is far off; that by the final ones is not."""
    record = fly_bare(USUAL, 60.0)
    kept = (record.time < 15.0) | (record.time > 27.0)
    gap = replace(record, time=record.time[kept], angle=record.angle[kept], rate=record.rate[kept])
    made = fit(gap, NOISE)
    assert len(made.innovations.restarts) == 0
    error = motion_error(USUAL, made.constants)
    assert error @ np.linalg.solve(made.covariance[:3, :3], error) < chi2.ppf(0.999, 3)


def test_coloured_noise_is_noticed_and_the_uncertainty_grows() -> None:
    """Coloured noise is detected and increases the uncertainty.

    The attitude error has a correlation time of half a second, like the error of a filter inside the unit.
    """
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
    with pytest.raises(IdentificationError, match=r"`sign` of `coils\.windings`"):
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
def test_rates_that_no_constants_explain_are_refused(value: float, times: int) -> None:
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
    constants = MotionConstants(0.3, 0.01, 0.002, 1e-4, -1e-4, 0.004)
    assert MotionConstants.of(constants.to_array()) == constants
    noise = MotionNoise.of_logarithms(MotionNoise(2e-3, 2e-3, 1e-4).to_logarithms())
    assert noise.rate == pytest.approx(1e-4)


TRUE = MotionConstants(gain=0.28, torsion=0.0095, damping=0.002, disturbance=1e-3, bias=2e-4, delay=0.006)
QUIET = MotionNoise(current=1e-9, angle=2e-3, rate=1e-4)


def noiseless(constants: MotionConstants, seconds: float = 12.0) -> Record:
    """Return the exact record of a body under random currents, as scipy integrates it."""
    time = np.asarray(np.arange(round(seconds / 0.025)) * 0.025, dtype=np.float64)
    current = np.repeat(np.random.default_rng(4).uniform(-0.09, 0.09, len(time) // 20 + 1), 20)[: len(time)]
    switch: FloatArray = time + 0.011

    def motion(t: float, state: FloatArray) -> list[float]:
        index = int(np.searchsorted(switch + constants.delay, t, side="right")) - 1
        drive = constants.gain * (current[index] if index >= 0 else 0.0) * np.cos(state[0])
        return [
            state[1],
            drive - constants.torsion * state[0] - constants.damping * state[1] + constants.disturbance,
        ]

    state = np.array([0.4, -0.03])
    states = [state]
    for begin, end in itertools.pairwise(time.tolist()):
        for span in ((begin, begin + 0.017), (begin + 0.017, end)):
            middle = 0.5 * sum(span)  # middle of an interval of constant current
            solution = solve_ivp(lambda _, s, m=middle: motion(m, s), span, state, rtol=1e-11, atol=1e-13)
            state = solution.y[:, -1]
        states.append(state)
    angle, rate = np.array(states).T
    none = np.zeros(len(time), dtype=bool)
    return Record(time, angle, rate + constants.bias, switch, current, none, 0.025, None)


def test_a_noiseless_motion_is_predicted_to_a_thousandth_of_the_noise() -> None:
    """The prediction agrees with scipy's integrator (1e-11) within a thousandth of the noise.

    The currents switch between the samples.
    """
    passed = innovations(noiseless(TRUE), TRUE, QUIET)
    assert np.max(np.abs(passed.error[:, 0])) < 1e-3 * 2e-3
    assert np.max(np.abs(passed.error[:, 1])) < 1e-3 * 1e-4


@pytest.mark.parametrize("name", NAMES)
def test_the_gradient_is_that_of_the_predictions(name: str) -> None:
    """The gradient agrees with central differences of the whole prediction within 0.2 %."""
    record = noiseless(TRUE, 6.0)
    size = 1e-5 if name in ("disturbance", "bias") else 1e-4
    there, back = (
        innovations(record, replace(TRUE, **{name: getattr(TRUE, name) + off}), QUIET, with_gradient=False)
        for off in (size, -size)
    )
    differences = (back.error - there.error) / (2.0 * size)
    gradient = innovations(record, TRUE, QUIET).gradient[:, :, NAMES.index(name)]
    for column in range(2):
        error = np.linalg.norm(gradient[:, column] - differences[:, column])
        assert error < 2e-3 * np.linalg.norm(differences[:, column])


def test_with_the_truth_the_innovations_are_white_and_of_unit_variance(identified: list[Identified]) -> None:
    for world, record, _ in identified:
        noise = MotionNoise(3.5e-3 / 3**0.5, 3.5e-3 / 3**0.5, 1.75e-4 / 3**0.5)
        whitened = innovations(record, world.constants, noise, with_gradient=False).whitened
        count = len(whitened)
        assert np.mean(whitened**2, axis=0) == pytest.approx(1.0, abs=4.0 * (0.8 / count) ** 0.5)
        lag_one = np.mean(whitened[1:] * whitened[:-1], axis=0)
        assert np.all(np.abs(lag_one) < 4.0 / count**0.5)


def test_a_sample_beyond_the_gate_is_skipped_without_an_effect_on_later_samples() -> None:
    record = noiseless(TRUE, 6.0)
    spoilt = replace(record, angle=record.angle + 1.0 * (np.arange(len(record.time)) == 100))
    passed = innovations(spoilt, TRUE, QUIET, gate=30.0)
    assert passed.restarts == {100, 101}
    assert np.max(np.abs(passed.whitened)) < 0.01
    blind = innovations(spoilt, TRUE, QUIET)
    assert np.max(np.abs(blind.whitened)) > 30.0, "without the gate it is seen"


def test_the_timeline_keeps_the_charge_whatever_the_delay() -> None:
    record = noiseless(TRUE, 3.0)
    for delay in (-0.011, 0.0, 0.0043, 0.03):
        timeline = Timeline.of(record, delay)
        assert np.sum(timeline.span) == pytest.approx(record.time[-1])
        starts = record.switch_time + delay
        ends = np.append(starts[1:], np.inf)
        lasts = np.clip(ends, 0.0, record.time[-1]) - np.clip(starts, 0.0, record.time[-1])
        assert timeline.span @ timeline.current == pytest.approx(record.current @ lasts, abs=1e-12)
        assert sorted(timeline.sample[timeline.sample >= 0]) == list(range(1, len(record.time)))


def test_the_covariance_is_that_of_a_kalman_filter_with_matrices() -> None:
    predictor = _Predictor(TRUE, MotionNoise(0.02, 2e-3, 1e-4), 0.025, with_gradient=False)
    predictor.start(0.4, -0.03)
    noise = np.diag([2e-3**2, 1e-4**2])
    covariance, walk = noise.copy(), (TRUE.gain * 0.02) ** 2 * 0.025
    state = np.array([0.4, -0.03 - TRUE.bias])
    for angle, rate, span, current in (
        (0.398, -0.031, 0.025, 0.05),
        (0.399, -0.027, 0.1, -0.08),
        (0.4, -0.03, 0.3, 0.02),
    ):
        acceleration = TRUE.gain * current * np.cos(state[0]) + TRUE.disturbance
        acceleration -= TRUE.torsion * state[0] + TRUE.damping * state[1]
        slope = -TRUE.gain * current * np.sin(state[0]) - TRUE.torsion
        cosine = np.cos(state[0])
        motion = np.array([[0.0, 1.0], [slope, -TRUE.damping]]) * span
        flow = np.eye(2) + motion + motion @ motion / 2.0
        spread = walk * cosine**2 * np.array([[span**3 / 3.0, span**2 / 2.0], [span**2 / 2.0, span]])
        jerk = slope * state[1] - TRUE.damping * acceleration
        state = state + span * np.array([state[1], acceleration])
        state = state + span**2 / 2.0 * np.array([acceleration + span * jerk / 3.0, jerk])
        covariance = flow @ covariance @ flow.T + spread
        predictor.propagate(span, current, 1.0)
        error, stated = predictor.update(angle, rate)
        total = covariance + noise
        expected = np.array([angle, rate - TRUE.bias]) - state
        np.testing.assert_allclose(error, expected, rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(np.reshape(stated, (2, 2)), total, rtol=1e-9)
        gain = covariance @ np.linalg.inv(total)
        state, covariance = state + gain @ expected, (np.eye(2) - gain) @ covariance


PRIOR = prior_of(believed())


def scaled(found: PlantFit, prior: PlantPrior, field: float | None) -> AbsolutePlant:
    measured = None if field is None else HorizontalField(field, 0.0, 100)
    return absolute(found, prior, measured)


def test_over_many_worlds_the_uncertainty_of_all_constants_is_true(identified: list[Identified]) -> None:
    """The mean chi-square of 80 worlds that are drawn from the prior is in its expected band.

    The constants from the motion are the true constants plus random errors of the stated covariance.
    """
    rng = np.random.default_rng(3)
    _, _, made = identified[0]
    squares, keep = [], [0, 1, 2, 4, 5]
    for _ in range(80):
        world = drawn(rng)
        noise = rng.multivariate_normal(np.zeros(6), made.covariance, method="cholesky")
        found = replace(made, constants=MotionConstants.of(world.constants.to_array() + noise))
        plant = scaled(found, PRIOR, world.field * world.magnetometer)
        error = scale_error(world, plant)[keep]
        squares.append(error @ np.linalg.solve(plant.covariance[np.ix_(keep, keep)], error))
    low, high = chi2.ppf([0.001, 0.999], 5 * 80) / 80
    assert low < np.mean(squares) < high


def test_the_ratios_of_the_motion_are_kept(identified: list[Identified]) -> None:
    for world, _, made in identified:
        plant = scaled(made, PRIOR, world.field)
        gain = plant.torque_constant.value / plant.inertia.value
        assert gain == pytest.approx(made.constants.gain, abs=0.1 * made.sigma("gain"))
        ratio = plant.stiffness.value / plant.inertia.value
        assert ratio == pytest.approx(made.constants.torsion, abs=0.1 * made.sigma("torsion"))


def test_an_inertia_known_for_sure_makes_the_torque_constant_of_the_motion(
    identified: list[Identified],
) -> None:
    world, _, made = identified[0]
    sure = replace(PRIOR, inertia=PriorValue(world.inertia, 1e-9))
    plant = scaled(made, sure, None)
    assert plant.inertia.value == pytest.approx(world.inertia)
    assert plant.inertia.own_prior == pytest.approx(1.0)
    expected = made.constants.gain * world.inertia
    assert plant.torque_constant.value == pytest.approx(expected, rel=1e-4)
    assert plant.torque_constant.sigma == pytest.approx(made.sigma("gain") * world.inertia, rel=1e-3)


def test_without_a_magnetometer_the_field_has_its_configured_uncertainty(
    identified: list[Identified],
) -> None:
    world, _, made = identified[0]
    blind, seeing = scaled(made, PRIOR, None), scaled(made, PRIOR, world.field)
    assert blind.field.sigma > 3.0 * seeing.field.sigma
    assert blind.inertia.sigma > seeing.inertia.sigma
    assert "magnetometer" in seeing.sources()["field"]
    assert "magnetometer" not in blind.sources()["field"]


def test_the_weight_of_the_prior_is_the_sensitivity_of_the_result_to_it(identified: list[Identified]) -> None:
    """If the prior changes by 1 %, the result changes by 1 % times the stated weight of the prior."""
    world, _, made = identified[0]
    before = scaled(made, PRIOR, world.field)
    moved = replace(PRIOR, inertia=replace(PRIOR.inertia, value=PRIOR.inertia.value * 1.01))
    after = scaled(made, moved, world.field)
    follows = np.log(after.inertia.value / before.inertia.value) / np.log(1.01)
    assert before.inertia.own_prior == pytest.approx(follows, abs=1e-6)
    assert 0.0 < follows < 1.0


def test_the_fragment_takes_the_place_of_the_plant_section(identified: list[Identified]) -> None:
    world, _, made = identified[0]
    plant = scaled(made, PRIOR, world.field)
    head, rest = flights.TEXT.split("plant:", 1)
    _, tail = rest.split("inertial_unit:", 1)
    config = as_testbed(parse(head + plant_text(plant, 80, "a test") + "\ninertial_unit:" + tail))
    section = config.plant
    gain = section.coil_turns * section.coil_area * section.field / section.inertia
    assert gain == pytest.approx(made.constants.gain, rel=1e-5)
    assert section.thread_stiffness == pytest.approx(plant.stiffness.value, rel=1e-5)


def test_a_negative_stiffness_is_set_to_zero(identified: list[Identified]) -> None:
    _, _, made = identified[0]
    loose = replace(made, constants=replace(made.constants, torsion=-1e-7))
    plant = scaled(loose, PRIOR, None)
    assert plant_section(plant, 80).thread_stiffness == 0.0
    assert "set to zero" in plant_text(plant, 80, "a test")


def test_the_configuration_of_the_flight_survives_its_way_through_yaml() -> None:
    config = excitation_config(flights.demo_config(700.0), 200.0)
    assert parse(config_text(config)) == config
    assert config.camera is None
    assert config.control.tracker == "excitation"
