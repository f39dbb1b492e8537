"""Tests of the tuning study: the campaign's gains satisfy its criterion, and a search finds better ones."""

from __future__ import annotations

from knightcube.reference.control import PidController, PidSettings
from tests.studies.campaigns import controllers
from tests.studies.tune_controllers import OVERSHOOT, SETTLED_S, fly
from tests.support.thread_loop import BELIEVED, PERIOD


def test_the_flown_pid_keeps_the_criterion_with_less_power_than_three_poles() -> None:
    control = controllers.pid().control
    assert control.gains is not None
    gains = PidSettings(control.gains.proportional, control.gains.integral, control.gains.derivative)
    tuned = fly(PidController(BELIEVED, PERIOD, gains, control.target_weight))
    placed = fly(PidController(BELIEVED, PERIOD, PidSettings.placed(0.76), 0.0))
    assert tuned.settling <= SETTLED_S + 0.1
    assert tuned.overshoot <= OVERSHOOT + 0.001
    assert tuned.power < 0.8 * placed.power
