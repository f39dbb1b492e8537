"""The predictor: right about a noiseless motion, its gradient that of its predictions, white on the truth."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ground.identification.constants import NAMES, Constants, Noise
from ground.identification.innovations import innovations
from ground.identification.record import Record
from ground.identification.timeline import Timeline
from knightcube.astro.arrays import FloatArray
from tests.ground.identification.conftest import Identified

TRUE = Constants(gain=0.28, torsion=0.0095, damping=0.002, disturbance=1e-3, bias=2e-4, delay=0.006)
QUIET = Noise(current=1e-9, angle=2e-3, rate=1e-4)


def noiseless(constants: Constants, seconds: float = 12.0) -> Record:
    """Return an exact record of a body under random currents, by scipy's integrator."""
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
            middle = 0.5 * sum(span)  # within a part the current does not change
            solution = solve_ivp(lambda _, s, m=middle: motion(m, s), span, state, rtol=1e-11, atol=1e-13)
            state = solution.y[:, -1]
        states.append(state)
    angle, rate = np.array(states).T
    none = np.zeros(len(time), dtype=bool)
    return Record(time, angle, rate + constants.bias, switch, current, none, 0.025, None)


def test_a_noiseless_motion_is_predicted_to_a_thousandth_of_the_noise() -> None:
    """Against scipy's integrator at 1e-11; the switches fall between the samples."""
    passed = innovations(noiseless(TRUE), TRUE, QUIET)
    assert np.max(np.abs(passed.error[:, 0])) < 1e-3 * 2e-3
    assert np.max(np.abs(passed.error[:, 1])) < 1e-3 * 1e-4


@pytest.mark.parametrize("name", NAMES)
def test_the_gradient_is_that_of_the_predictions(name: str) -> None:
    """Central differences of the whole pass, to a thousandth."""
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
        noise = Noise(3.5e-3 / 3**0.5, 3.5e-3 / 3**0.5, 1.75e-4 / 3**0.5)
        whitened = innovations(record, world.constants, noise, with_gradient=False).whitened
        count = len(whitened)
        assert np.mean(whitened**2, axis=0) == pytest.approx(1.0, abs=4.0 * (0.8 / count) ** 0.5)
        lag_one = np.mean(whitened[1:] * whitened[:-1], axis=0)
        assert np.all(np.abs(lag_one) < 4.0 / count**0.5)


def test_a_wild_sample_is_gone_over_and_costs_nothing_after_it() -> None:
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
