"""Tests that the commanded current is zero without a valid estimate, and of the coil drive's corrections."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import numpy as np
import pytest

from flight.loop.coil_currents import CoilFault
from flight.loop.coil_monitor import CoilMonitor, CoilMonitorSettings
from flight.loop.coil_response import CoilCorrection
from flight.loop.facts import EventLog, Facts, Services
from flight.loop.steering import CoilDrive, CoilDriveSettings, Steering
from flight.schema.sections import Modes
from hal.interfaces.devices import NO_AXES, CoilState, ImuReading, TorqueCoils
from knightcube.astro.arrays import FloatArray

FIELD = np.array([2e-5, -1e-5, 3e-5])
DIPOLE = 0.65


class Coils:
    """Coils that store the most recent command."""

    def __init__(self) -> None:
        self.currents: FloatArray = np.zeros(3)

    def command(self, currents: FloatArray) -> None:
        self.currents = currents


def _drive(resting: list[bool]) -> tuple[CoilDrive, Coils, SimpleNamespace]:
    coils = Coils()
    watch = SimpleNamespace(
        resting=np.array(resting),
        available=np.ones(3, dtype=bool),
        at_rest=False,
        probe=None,
        suspicion="",
        tumble_rate=0.0175,
        correction=CoilCorrection(),
    )
    settings = CoilDriveSettings(DIPOLE * np.eye(3), np.full(3, 0.148), None)
    services = SimpleNamespace(facts=None, events=None)
    drive = CoilDrive(
        cast(TorqueCoils, coils), None, cast(CoilMonitor, watch), settings, cast(Services, services)
    )
    return drive, coils, watch


@pytest.mark.parametrize("estimate", [None, Mock()], ids=["blind", "measured"])
@pytest.mark.parametrize("reference", [None, Mock()], ids=["no path", "path"])
@pytest.mark.parametrize("current", [False, True], ids=["no reading", "reading"])
@pytest.mark.parametrize("has_rate", [False, True], ids=["no gyro", "gyro"])
def test_each_cycle_without_a_basis_for_control_sends_zero_current(
    estimate: Any, reference: Any, current: bool, has_rate: bool
) -> None:
    drive, coils, watch = _drive([False, False, False])
    coils.state = lambda: Mock(error="")  # type: ignore[attr-defined]
    watch.test_wave = lambda _: None
    body = Mock()
    asked, control = np.array([0.02, 0.03, -0.01]), body.control
    body.estimation.rate_without_gyro.return_value = None
    control.paths.sample.return_value = reference
    for law in (control.tracker, control.detumbling, control.sun_acquisition):
        law.command.return_value.currents = asked
    steering = Steering(body, drive, Mock())
    reading = Mock(has_rate=has_rate)
    runs: tuple[tuple[Callable[[], Any], bool], ...] = (
        (lambda: steering.run(estimate, 0, True), estimate is not None and reference is not None),
        (lambda: steering.detumble([reading], current, 0), current),
        (lambda: steering.acquire_sun([reading], current, 0), current and has_rate),
        (lambda: steering.rest(0), False),
    )
    for run, has_basis in runs:
        coils.currents = np.full(3, 0.1)
        sent = run().currents
        assert coils.currents.tolist() == sent.tolist() == (asked.tolist() if has_basis else [0.0] * 3)


def test_a_resting_coil_carries_nothing_and_the_others_make_the_torque() -> None:
    asked = np.array([0.02, 0.03, -0.01])
    drive, coils, _ = _drive([False, True, False])
    drive.send(asked, lambda: FIELD)
    assert coils.currents[1] == pytest.approx(0.0, abs=1e-12)
    wanted, made = (np.cross(DIPOLE * currents, FIELD) for currents in (asked, coils.currents))
    assert made == pytest.approx(wanted, rel=1e-6)


def test_without_a_field_a_resting_coil_is_left_out() -> None:
    drive, coils, _ = _drive([False, True, False])
    drive.send(np.array([0.02, 0.03, -0.01]), lambda: None)
    assert coils.currents.tolist() == [0.02, 0.0, -0.01]


def test_coils_that_do_not_rest_get_what_is_asked() -> None:
    drive, coils, _ = _drive([False, False, False])
    drive.send(np.array([0.02, 0.03, -0.01]), lambda: FIELD)
    assert coils.currents.tolist() == [0.02, 0.03, -0.01]


def test_a_probe_replaces_the_commands_of_all_coils_and_the_filter_gets_it() -> None:
    drive, coils, watch = _drive([False, False, False])
    watch.correction.reverse(1, 0, in_tumble=True)
    watch.probe = np.array([0.0, 0.04, 0.0])
    drive.send(np.array([0.02, 0.03, -0.01]), lambda: FIELD)
    assert coils.currents.tolist() == [0.0, 0.04, 0.0]
    assert drive.command.tolist() == [0.0, -0.04, 0.0]
    watch.at_rest = True
    drive.send(np.array([0.02, 0.03, -0.01]), lambda: FIELD)
    assert not coils.currents.any()


def test_coils_are_not_tested_without_a_gyro_whose_rate_would_show_the_result() -> None:
    drive, coils, watch = _drive([False, False, False])
    drive._facts = drive._events = cast(Any, Mock())
    watch.test_wave = lambda _: np.array([0.05, 0.0, 0.0])
    for name in ("commanded", "observe_motion", "interrupted"):
        setattr(watch, name, Mock())
    watch.news, watch.verdicts, watch.braked = list, (), NO_AXES
    watch.begin_trial, watch.tested, watch.monitor_doubted = (lambda _: None), (lambda _: ""), ""
    in_force = CoilState(np.zeros(3), np.zeros(3), 0, False, 0, False, 0, "")
    for rate, sent in ((0.0, 0.05), (np.nan, 0.02), (0.0, 0.05)):
        reading = ImuReading(0, 0, 0, np.zeros(4), np.full(3, rate), FIELD, np.zeros(3))
        drive.look(in_force, [reading], 0)
        drive.look(in_force, [], 0)
        drive.send(np.array([0.02, 0.0, 0.0]), lambda: FIELD, testable=True)
        assert coils.currents[0] == sent
    assert watch.observe_motion.call_count == 2


def test_a_loaded_parameter_changes_the_rate_below_which_coils_are_reviewed() -> None:
    drive, _, watch = _drive([False, False, False])
    drive.adopt(Modes(tumble_rate=0.3))
    assert watch.tumble_rate == 0.3


def test_a_reversed_coil_gets_the_opposite_current_and_the_filter_the_effective_one() -> None:
    drive, coils, watch = _drive([False, False, False])
    watch.correction.reverse(1, 0, in_tumble=True)
    asked = np.array([0.02, 0.03, -0.01])
    drive.send(asked, lambda: FIELD)
    assert coils.currents.tolist() == [0.02, -0.03, -0.01]
    assert drive.command.tolist() == asked.tolist()
    in_force = cast(CoilState, SimpleNamespace(current=coils.currents))
    assert drive.effective(in_force).tolist() == asked.tolist()


@pytest.mark.parametrize("known", [True, False])
def test_a_weak_coil_gets_more_current_within_its_limit(known: bool) -> None:
    drive, coils, watch = _drive([False, False, False])
    watch.correction.weigh(2, 0.5)
    drive.send(np.array([0.02, 0.03, -0.05]), lambda: FIELD)
    assert coils.currents.tolist() == [0.02, 0.03, -0.1]
    asked = np.array([0.02, 0.03, -0.12])
    drive.send(asked, lambda: FIELD if known else None)
    assert np.abs(coils.currents).max() <= 0.148 + 1e-12
    made, wanted = (np.cross(currents, FIELD) for currents in (drive.command, asked))
    if known:
        assert np.cross(made, wanted) == pytest.approx(np.zeros(3), abs=1e-18)
        assert made @ wanted > 0.0
    else:
        assert drive.command.tolist() == [0.02, 0.03, -0.074]


def test_corrections_and_trials_are_reported_and_a_coil_on_trial_is_used_again() -> None:
    drive, _, _ = _drive([False, False, False])
    told: list[tuple[str, str]] = []
    events = SimpleNamespace(report=lambda kind, time_ns, text: told.append((kind.name, text)))
    table = Facts(cast(EventLog, events))
    watch = CoilMonitor(CoilMonitorSettings((0.148, 0.148, 0.148), trial_after_ns=10**9))
    drive._watch, drive._events, drive._facts = watch, cast(EventLog, events), table
    cast(Any, drive._coils).brake = lambda axes: None
    state = CoilState(np.zeros(3), np.zeros(3), 0, False, 0, False, 0, "")
    watch._give(0, CoilFault.OPEN, 0, "no current")
    watch._tell(1, "seen")
    drive.look(state, [], 1)
    drive.isolate()
    assert drive.available.tolist() == [False, True, True]
    slow = ImuReading(2, 2, 2, np.zeros(4), np.zeros(3), np.zeros(3), np.zeros(3))
    drive.look(state, [slow], 10**9)
    assert drive.available.all()
    watch._give(0, CoilFault.OPEN, 10**9, "no current")
    drive.look(state, [], 10**9 + 1)
    names = [name for name, _ in told]
    assert names == ["coil-corrected", "coil-broken", "coil-trusted", "coil-broken"]
    assert told[2][1] == "coil x is tried again, 1 of 3"
