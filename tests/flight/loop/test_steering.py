"""Tests that the commanded current is zero without a valid estimate, and of the coil drive's corrections."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import numpy as np
import pytest

from flight.loop.body import SteeringState
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
        rests=any(resting),
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


class Flown:
    """Steering with a test double of a body, and with a simulated drive."""

    def __init__(self) -> None:
        self.fault = ""
        self.drive, self.coils, self.watch = _drive([False, False, False])
        self.coils.state = lambda: Mock(error=self.fault)  # type: ignore[attr-defined]
        self.watch.test_wave = lambda currents: None
        self.said: dict[str, tuple[bool, str]] = {}
        facts_ = SimpleNamespace(
            update=lambda fact, holds, _, text: self.said.__setitem__(fact.name, (holds, text))
        )
        self.body = Mock()
        self.asked = np.array([0.02, 0.03, -0.01])
        self.wanted = SimpleNamespace(currents=self.asked, dipole=np.array([1.0, 2.0, 3.0]), saturated=True)
        control = self.body.control
        for law in (control.tracker, control.detumbling, control.sun_acquisition):
            law.command.return_value = self.wanted
        self.body.estimation.rate_without_gyro.return_value = None
        control.paths.is_adrift.return_value = False
        self.steering = Steering(self.body, self.drive, cast(Any, SimpleNamespace(facts=facts_)))


@pytest.mark.parametrize(
    ("following", "adrift", "state", "holding"),
    [
        (True, True, SteeringState.FOLLOWING, False),
        (False, True, SteeringState.HOLDING, True),
        (False, False, SteeringState.HOLDING, False),
    ],
)
def test_a_path_is_followed_and_its_end_is_held(
    following: bool, adrift: bool, state: SteeringState, holding: bool
) -> None:
    flown = Flown()
    control = flown.body.control
    control.paths.is_following.return_value = following
    control.paths.is_adrift.return_value = adrift
    estimate = Mock()
    steered = flown.steering.run(estimate, 7, True)
    assert (steered.state, steered.saturated) == (state, True)
    assert steered.reference is control.paths.sample.return_value
    assert steered.dipole.tolist() == [1.0, 2.0, 3.0]
    assert steered.currents.tolist() == flown.asked.tolist()
    control.paths.sample.assert_called_once_with(7)
    control.tracker.command.assert_called_once_with(estimate, steered.reference)
    control.tracker.reset.assert_not_called()
    assert flown.said["control-lost"] == (False, "steering again")
    assert flown.said["holding"][0] is holding
    assert flown.said["coil-fault"] == (False, "the PWM chip accepts commands again")


@pytest.mark.parametrize("started", [True, False])
def test_without_an_estimate_control_is_lost_if_there_ever_was_one(started: bool) -> None:
    flown = Flown()
    steered = flown.steering.run(None, 7, started)
    holds, text = flown.said["control-lost"]
    assert holds is started
    assert text.startswith("measurement too old")
    assert (steered.state, steered.saturated) == (SteeringState.OFF, False)
    assert not steered.dipole.any()
    assert flown.said["holding"][0] is False
    flown.body.control.tracker.reset.assert_called_once_with()


def test_a_fault_of_the_chip_is_reported_with_its_text() -> None:
    flown = Flown()
    flown.fault = "no acknowledge"
    flown.steering.rest(7)
    assert flown.said["coil-fault"] == (True, "no acknowledge")


def test_a_law_gets_all_readings_and_the_currents_that_were_sent() -> None:
    flown = Flown()
    law = flown.body.control.detumbling
    readings = [
        Mock(time_ns=at, field=FIELD * at, rate=np.full(3, 0.1 * at), has_rate=at == 1) for at in (1, 2)
    ]
    steered = flown.steering.detumble(readings, True, 7)
    assert (steered.state, steered.reference) == (SteeringState.BRAKING, None)
    assert steered.dipole.tolist() == [1.0, 2.0, 3.0]
    assert [call.args[0] for call in law.sample.call_args_list] == [1, 2]
    for call, reading in zip(law.sample.call_args_list, readings, strict=True):
        assert call.args[1] is reading.field
        assert call.args[2] is reading.rate
    law.command.assert_called_once_with(7)
    (sent,) = law.sent.call_args.args
    assert sent.tolist() == flown.asked.tolist()
    assert flown.said["control-lost"] == (False, "detumbling again")
    flown.body.control.tracker.reset.assert_called_once_with()


def test_a_rate_of_the_estimate_replaces_that_of_the_gyro() -> None:
    flown = Flown()
    law, known = flown.body.control.sun_acquisition, np.array([0.0, 0.1, 0.0])
    flown.body.estimation.rate_without_gyro.return_value = known
    steered = flown.steering.acquire_sun([Mock(time_ns=1, field=FIELD, has_rate=False)], True, 7)
    assert steered.state is SteeringState.BRAKING
    assert law.sample.call_args.args[2] is known
    flown.body.estimation.rate_without_gyro.return_value = None
    steered = flown.steering.acquire_sun([Mock(time_ns=2, field=FIELD, has_rate=False)], True, 8)
    assert steered.state is SteeringState.OFF
    assert flown.said["control-lost"] == (True, "neither gyro nor estimate gives the rate: coils set to zero")
    steered = flown.steering.acquire_sun([], True, 9)
    assert steered.state is SteeringState.OFF, "without a new reading, the rate stays unknown"
    steered = flown.steering.acquire_sun([Mock(time_ns=3, field=FIELD, has_rate=True)], True, 10)
    assert steered.state is SteeringState.BRAKING


def test_old_readings_set_the_coils_to_zero() -> None:
    flown = Flown()
    assert flown.steering.detumble([], False, 7).state is SteeringState.OFF
    assert flown.said["control-lost"] == (True, "readings too old for detumbling: coils set to zero")
    flown.body.control.detumbling.command.assert_not_called()
    (sent,) = flown.body.control.detumbling.sent.call_args.args
    assert sent.tolist() == [0.0, 0.0, 0.0], "the law propagates the motion without a dipole moment"


def test_a_body_without_sun_acquisition_rests() -> None:
    flown = Flown()
    flown.body.control.sun_acquisition = None
    flown.steering.begin_sun_acquisition(7)
    assert flown.steering.acquire_sun([Mock(has_rate=True)], True, 7).state is SteeringState.OFF
    assert "control-lost" not in flown.said


def test_the_windows_of_the_laws_begin_when_their_mode_begins() -> None:
    flown = Flown()
    flown.steering.begin_detumbling(7)
    flown.steering.begin_sun_acquisition(8)
    flown.body.control.detumbling.begin.assert_called_once_with(7)
    flown.body.control.sun_acquisition.begin.assert_called_once_with(8)


def test_a_low_battery_limits_the_currents_to_a_share_and_keeps_their_torque_direction() -> None:
    drive, coils, _ = _drive([False, False, False])
    drive.limit(0.5)
    asked = np.array([0.02, 0.1, -0.01])
    drive.send(asked, lambda: FIELD)
    assert np.abs(coils.currents).max() <= 0.074 + 1e-12
    wanted, made = (np.cross(currents, FIELD) for currents in (asked, coils.currents))
    assert made @ wanted > 0.0
    assert np.cross(made, wanted) == pytest.approx(np.zeros(3), abs=1e-18)
    within = np.array([0.02, 0.074, -0.01])
    drive.send(within, lambda: pytest.fail("no field is needed within the limits"))
    assert coils.currents.tolist() == within.tolist()
    drive.limit(1.0)
    drive.send(np.array([0.02, 0.2, -0.01]), lambda: FIELD)
    assert coils.currents.tolist() == [0.02, 0.2, -0.01], "the driver limits currents itself"


def test_zero_and_off_reach_the_driver() -> None:
    drive, coils, watch = _drive([False, False, False])
    cast(Any, coils).off = Mock()
    drive.send(np.array([0.02, 0.03, -0.01]), lambda: FIELD)
    drive.zero()
    assert coils.currents.tolist() == drive.command.tolist() == [0.0, 0.0, 0.0]
    drive.off()
    cast(Any, coils).off.assert_called_once_with()
    watch.doubts_currents = True
    assert drive.is_suspect


def test_the_ground_can_trust_all_coils_again() -> None:
    drive, _, watch = _drive([False, False, False])
    told: list[tuple[Any, ...]] = []
    drive._events = cast(
        EventLog, SimpleNamespace(report=lambda kind, *rest: told.append((kind.name, *rest)))
    )
    watch.forget = Mock()
    watch.available = np.array([True, False, True])
    drive.isolate()
    assert drive.available.tolist() == [True, False, True]
    watch.available = np.ones(3, dtype=bool)
    drive._reported.add(1)
    drive.trust(9)
    assert [call.args for call in watch.forget.call_args_list] == [(0,), (1,), (2,)]
    assert drive.available.all()
    assert drive._reported == set()
    assert told == [("coil-trusted", 9, "all coils are in use again")]


def test_a_check_passes_the_command_the_readings_and_the_supply_current_to_the_monitor() -> None:
    drive, _, _ = _drive([False, False, False])
    watch = Mock(news=list, verdicts=(), braked=NO_AXES, suspicion="", monitor_doubted="odd")
    watch.begin_trial.return_value = None
    watch.tested.return_value = "coil x: 9.8 ohm"
    told: list[tuple[Any, ...]] = []
    said: dict[str, tuple[bool, str]] = {}
    drive._watch = watch
    drive._events = cast(
        EventLog, SimpleNamespace(report=lambda kind, *rest: told.append((kind.name, *rest)))
    )
    drive._facts = cast(
        Facts,
        SimpleNamespace(update=lambda fact, holds, _, text: said.__setitem__(fact.name, (holds, text))),
    )
    power = Mock()
    power.error.return_value, power.latest.return_value = "", "a reading"
    drive._power = power
    never = CoilState(np.zeros(3), np.zeros(3), -1, False, 0, False, 0, "")
    drive.look(never, [], 5)
    watch.commanded.assert_not_called()
    watch.interrupted.assert_not_called()
    watch.measured.assert_called_once_with("a reading")
    assert told == [("coil-tested", 5, "coil x: 9.8 ohm")]
    assert said["coil-suspect"] == (False, "")
    assert said["power-doubted"] == (True, "odd")
    power.error.return_value = "no acknowledge"
    state = CoilState(np.zeros(3), np.array([0.1, 0.2, 0.3]), 0, False, 0, False, 0, "", frozenset({0}))
    drive.look(state, [], 6, known=False)
    watch.measured.assert_called_once()
    watch.interrupted.assert_called_once_with(6)
    watch.commanded.assert_called_once_with(6, state.current, state.braked, 0)


def test_bridges_are_braked_once_when_the_monitor_changes_them() -> None:
    drive, coils, _ = _drive([False, False, False])
    cast(Any, coils).brake = Mock()
    drive._brake(NO_AXES)
    drive._brake(frozenset({0}))
    drive._brake(frozenset({0}))
    drive._brake(NO_AXES)
    assert [call.args[0] for call in cast(Any, coils).brake.call_args_list] == [frozenset({0}), NO_AXES]
