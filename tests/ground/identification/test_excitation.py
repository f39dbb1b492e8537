"""Tests that the excitation moves any body as intended and within its limit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from flight.bodies.testbed.control import plant_of
from knightcube.errors import UsageError
from knightcube.gnc.control.one_axis import ExcitationController, manoeuvres
from knightcube.gnc.guidance.plant import PathSample
from tests.ground.identification.conftest import Identified
from tests.ground.identification.excitations import USUAL
from tests.ground.identification.worlds import PERIOD, believed, drawn, fly_bare, usual_excitation

REST = PathSample(0.0, 0.0, 0.0)
PLANT = plant_of(believed())


def controller(**changes: float) -> ExcitationController:
    return ExcitationController(PLANT, PERIOD, replace(usual_excitation(), **changes))


def test_each_manoeuvre_leaves_a_free_body_at_rest_and_the_swings_start_at_the_reach() -> None:
    """The pulses of a manoeuvre leave a free body at rest, and move it at most by the reach.

    The motion is integrated exactly, as for a double integrator.
    """
    strength, reach = 0.02, 0.5
    for manoeuvre in manoeuvres(strength, reach, 45.0):
        angle = rate = farthest = 0.0
        for pulse in manoeuvre:
            a = strength * pulse.share
            angle += rate * pulse.duration + 0.5 * a * pulse.duration**2
            rate += a * pulse.duration
            farthest = max(farthest, abs(angle))
        assert rate == pytest.approx(0.0, abs=1e-12)
        assert farthest <= reach + 1e-12
        assert abs(angle) == pytest.approx(reach if manoeuvre[-1].share == 0.0 else 0.0, abs=1e-12)


def test_within_the_drawn_worlds_the_body_stays_within_half_and_the_current_within_its_share(
    identified: list[Identified],
) -> None:
    limit = usual_excitation().current_share * PLANT.current_limit
    for _, record, _ in identified:
        assert np.max(np.abs(record.current)) <= limit + 1e-12
        assert 0.15 < np.sin(0.5 * np.max(np.abs(record.angle))) < 0.5


def test_a_body_with_three_times_the_assumed_acceleration_stays_below_the_bound() -> None:
    """The feedback keeps a body with three times the assumed acceleration below the largest permitted q2.

    Without feedback, the pulses would reach q2 = 0.52.
    """
    record = fly_bare(replace(USUAL, inertia=USUAL.inertia / 3.0), 60.0)
    assert np.sin(0.5 * np.max(np.abs(record.angle))) < usual_excitation().largest_q2
    pulses = manoeuvres(1.0, 3.0 * 0.45 * 2.0 * math.asin(usual_excitation().largest_q2), 45.0)[1]
    assert math.sin(0.5 * pulses[0].duration ** 2) > 0.5


def test_a_body_without_a_thread_does_not_drift_away_in_the_swing() -> None:
    record = fly_bare(replace(USUAL, stiffness=0.0, damping=0.0), 120.0)
    assert np.sin(0.5 * np.max(np.abs(record.angle))) < 0.5


def test_a_reversed_coil_gets_no_current_after_a_minute() -> None:
    record = fly_bare(replace(USUAL, dipole=-USUAL.dipole), 80.0)
    assert np.any(record.current[: round(50.0 / PERIOD)])
    assert not np.any(record.current[round(61.0 / PERIOD) :])


def test_the_excitation_gives_up_only_if_the_body_does_not_come_to_rest() -> None:
    lost = controller()
    for _ in range(round(61.0 / PERIOD)):
        lost.command(REST, 0.3, 0.0)
    assert lost.gave_up
    assert not lost.command(REST, 0.0, 0.0).authority
    found = controller()
    for _ in range(round(61.0 / PERIOD)):
        found.command(REST, 0.0, 0.0)
    assert not found.gave_up


def test_after_a_loss_of_the_estimate_the_body_is_brought_to_rest_before_it_is_moved_again() -> None:
    made = controller()
    while made.command(REST, 0.0, 0.0).current == 0.0:
        pass
    made.reset()
    currents = [made.command(REST, 0.0, 0.0).current for _ in range(round(0.9 / PERIOD))]
    assert not np.any(currents)
    assert any(made.command(REST, 0.0, 0.0).current for _ in range(round(0.3 / PERIOD)))


@pytest.mark.parametrize(
    "changes", [{"current_share": 0.0}, {"current_share": 1.1}, {"largest_q2": 0.0}, {"largest_q2": 0.6}]
)
def test_settings_outside_their_range_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(UsageError, match=next(iter(changes))):
        controller(**changes)


def test_an_input_that_is_not_finite_is_refused() -> None:
    with pytest.raises(UsageError, match="not finite"):
        controller().command(REST, math.nan, 0.0)


def test_the_drawn_worlds_differ() -> None:
    rng = np.random.default_rng(20)
    gains = [drawn(rng).constants.gain for _ in range(6)]
    assert max(gains) > 1.1 * min(gains)
