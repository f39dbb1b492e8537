"""Tests of the control cycle with test doubles: the calls of each task, and the recorded packets."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import numpy as np
import pytest

from flight.link.events import STEERING, Mode
from flight.link.telemetry.definitions import ATTITUDE, COIL_CURRENTS
from flight.loop import imaging, navigation
from flight.loop.body import PLANNER, ControlOutput
from flight.loop.executive import Cycle
from flight.loop.flight_loop import ATTITUDE_EVERY, ControlCycle, FlightLoop, Supervisors
from flight.loop.navigation import CurrentValidity
from flight.schema import reader as configuration
from flight.schema.devices import WideCamera
from flight.schema.document import config_path
from hal.interfaces.devices import MOST_COILS, CoilState

PERIOD_NS = 25_000_000
STILL = CoilState(np.zeros(3), np.zeros(3), 0, False, 0, False, 0, "")
REFUSES = CoilState(np.zeros(3), np.array([0.1, 0.0, -0.2]), 0, False, 0, False, 1, "no answer")
TARGET: Any = SimpleNamespace(law=SimpleNamespace(quaternion=lambda _: np.array([0.0, 0.6, 0.0, 0.8])))
ESTIMATE: Any = SimpleNamespace(
    quaternion=np.array([0.0, 0.0, 0.6, 0.8]),
    rate=np.array([0.01, 0.02, 0.03]),
    covariance=np.diag([4.0, 9.0, -1e-9, 1e-2, 4e-2, 9e-2, 25.0]),
)


class Bench:
    """A control cycle whose tasks, body and services record the calls that they receive."""

    def __init__(self, mode: Mode, target: Any = TARGET, coils: int = 3) -> None:
        self.tasks, self.body, self.services = Mock(), Mock(), Mock()
        self.services.recorder.epoch_ns = 7 * PERIOD_NS
        self.services.jobs.collect.return_value = []
        self.tasks.drive.state.return_value = STILL
        self.tasks.navigation.update.return_value = [SimpleNamespace()]
        self.tasks.navigation.speed = 0.5
        self.tasks.navigation.estimate.return_value = ESTIMATE
        self.tasks.navigation.is_measured.return_value = True
        self.tasks.modes.step.return_value = mode
        self.tasks.modes.target.return_value = target
        self.tasks.modes.detumbles = self.tasks.modes.acquires_sun = False
        steered = SimpleNamespace(reference=None, dipole=np.zeros(3), currents=np.arange(coils) * 0.1)
        for law in ("run", "detumble", "acquire_sun", "rest"):
            getattr(self.tasks.steering, law).return_value = steered
        self.control = self.body.control
        self.loop = ControlCycle(self.tasks, self.body, self.services)
        self.now_ns = 0

    def run(self, slot: int = 0) -> ControlOutput:
        """Run the control cycle of a slot."""
        self.now_ns = (100 + slot) * PERIOD_NS
        return self.loop.run(Cycle(slot, self.now_ns, self.now_ns))

    def results(self, *workers: str) -> list[Any]:
        """Make each worker return the result of a job."""
        made = [SimpleNamespace(worker=worker) for worker in workers]
        self.services.jobs.collect.return_value = made
        return made

    def recorded(self, packet: Any) -> list[dict[str, Any]]:
        """Return the values of the recorded packets of a type."""
        calls = self.services.recorder.record.call_args_list
        return [call.kwargs for call in calls if call.args[0] is packet]


@pytest.mark.parametrize("mode", Mode)
@pytest.mark.parametrize("target", [None, TARGET], ids=["without", "with"])
def test_the_planner_serves_only_a_steering_mode_with_a_target(mode: Mode, target: Any) -> None:
    bench = Bench(mode, target)
    output = bench.run()
    assert (output.mode, output.target, output.estimate) == (mode, target, ESTIMATE)
    bench.body.view.record_cycle.assert_called_once_with(output)
    if mode in STEERING and target is not None:
        bench.control.planner.serve.assert_called_once_with(ESTIMATE, target, bench.now_ns)
    else:
        bench.control.planner.serve.assert_not_called()


@pytest.mark.parametrize(
    ("mode", "flags", "law"),
    [
        (Mode.HOLD, ("detumbles", "acquires_sun"), "run"),
        (Mode.POINT, (), "run"),
        (Mode.DETUMBLE, ("detumbles", "acquires_sun"), "detumble"),
        (Mode.ACQUIRE, ("acquires_sun",), "acquire_sun"),
        (Mode.SAFE, (), "rest"),
        (Mode.BOOT, (), "rest"),
    ],
)
def test_one_control_law_commands_the_coils(mode: Mode, flags: tuple[str, ...], law: str) -> None:
    bench = Bench(mode)
    for flag in flags:
        setattr(bench.tasks.modes, flag, True)
    output = bench.run()
    steering, readings = bench.tasks.steering, bench.tasks.navigation.update.return_value
    current = bench.tasks.navigation.is_current.return_value
    expected = {
        "run": (ESTIMATE, bench.now_ns, True),
        "detumble": (readings, current, bench.now_ns),
        "acquire_sun": (readings, current, bench.now_ns),
        "rest": (bench.now_ns,),
    }
    assert [(name, args) for name, args, _ in steering.method_calls] == [(law, expected[law])]
    assert output.steered is getattr(steering, law).return_value


def test_an_error_about_one_result_loses_no_other_result() -> None:
    """A planner that never receives its result stays busy, which finally ends the flight."""
    bench = Bench(Mode.HOLD)
    _, plan = bench.results(imaging.WORKER, PLANNER)
    bench.tasks.imaging.finish.side_effect = ZeroDivisionError
    with pytest.raises(ZeroDivisionError):
        bench.run()
    bench.results()
    bench.run(1)
    bench.control.planner.finish.assert_called_once_with(plan, bench.now_ns)


@pytest.mark.parametrize(("speed", "rate"), [(0.5, 0.5), (math.inf, None)])
def test_an_unknown_rate_and_an_inaccurate_estimate_are_passed_to_the_modes(
    speed: float, rate: float | None
) -> None:
    bench = Bench(Mode.DETUMBLE)
    bench.tasks.navigation.speed = speed
    bench.tasks.navigation.is_accurate.return_value = False
    bench.run()
    args = bench.tasks.modes.step.call_args.args
    assert args[1] == rate
    assert args[-1] is False


def test_an_estimate_without_measurements_does_not_steer() -> None:
    bench = Bench(Mode.HOLD)
    bench.tasks.navigation.is_measured.return_value = False
    output = bench.run()
    bench.tasks.steering.run.assert_called_once_with(None, bench.now_ns, True)
    bench.control.planner.serve.assert_called_once_with(None, TARGET, bench.now_ns)
    assert output.estimate is ESTIMATE
    never = Bench(Mode.HOLD)
    never.tasks.navigation.estimate.return_value = None
    never.run()
    never.tasks.steering.run.assert_called_once_with(None, never.now_ns, False)


def test_a_plan_is_requested_for_the_first_estimate_and_resumed_after_a_gap() -> None:
    bench = Bench(Mode.HOLD)
    planner, navigation = bench.control.planner, bench.tasks.navigation
    for slot, (estimate, measured) in enumerate(
        [
            (None, False),
            (ESTIMATE, True),
            (ESTIMATE, True),
            (ESTIMATE, False),
            (ESTIMATE, True),
            (None, False),
        ]
    ):
        navigation.estimate.return_value, navigation.is_measured.return_value = estimate, measured
        bench.run(slot)
    assert [call.args for call in planner.request.call_args_list] == [(101 * PERIOD_NS,)]
    assert [call.args for call in planner.resume.call_args_list] == [(104 * PERIOD_NS,)]


def test_a_new_target_is_announced_and_aimed_at_once() -> None:
    bench = Bench(Mode.HOLD, None)
    bench.run(0)
    bench.body.view.announce.assert_not_called()
    bench.control.targets.error_when_due.assert_not_called()
    bench.tasks.modes.target.return_value = TARGET
    for slot in (1, 2, 3):
        bench.run(slot)
    bench.body.view.announce.assert_called_once_with(TARGET, 101 * PERIOD_NS)
    bench.control.planner.aim.assert_called_once_with(TARGET, 101 * PERIOD_NS)
    assert [call.args for call in bench.tasks.modes.target.call_args_list][-1] == (96 * PERIOD_NS,)
    overdue = bench.control.targets.error_when_due
    assert [call.args for call in overdue.call_args_list] == [
        (ESTIMATE, TARGET, slot * PERIOD_NS) for slot in (102, 103)
    ]
    accurate = bench.tasks.navigation.is_accurate.return_value
    bench.tasks.modes.step.assert_called_with(
        ESTIMATE, pytest.approx(0.5), overdue.return_value, True, bench.now_ns, accurate
    )


def test_each_cycle_gives_the_coils_to_navigation_and_to_the_checks() -> None:
    bench = Bench(Mode.HOLD)
    drive, navigation = bench.tasks.drive, bench.tasks.navigation
    drive.is_suspect = False
    bench.run()
    navigation.correct_coils.assert_called_once_with(drive.correction, drive.available)
    validity = CurrentValidity(True, True, -1, None)
    navigation.commanded.assert_called_once_with(STILL, drive.effective.return_value, validity)
    drive.effective.assert_called_once_with(STILL)
    readings = navigation.update.return_value
    drive.look.assert_called_once_with(STILL, readings, bench.now_ns, known=True)
    bench.tasks.imaging.serve.assert_called_once_with(bench.now_ns)
    order = [name for name, _, _ in navigation.method_calls]
    assert order[:4] == ["correct_coils", "commanded", "update", "estimate"]
    drive.is_suspect = True
    bench.run(1)
    assert not navigation.commanded.call_args.args[2].now, "a suspected coil carries an unknown current"


def test_coils_that_do_not_answer_are_not_noted_as_fresh() -> None:
    bench = Bench(Mode.HOLD)
    bench.run(0)
    bench.services.streams.note.assert_called_once_with("coils", bench.now_ns)
    assert bench.tasks.modes.step.call_args.args[3] is True
    bench.tasks.drive.state.return_value = REFUSES
    bench.tasks.navigation.update.return_value = []
    bench.run(1)
    bench.services.streams.note.assert_called_once()
    assert bench.tasks.modes.step.call_args.args[1] is None, "no reading, no rate"
    assert bench.tasks.modes.step.call_args.args[3] is False


def test_the_result_of_a_worker_goes_to_its_task_and_a_camera_s_updates_the_estimate() -> None:
    bench = Bench(Mode.HOLD)
    better: Any = SimpleNamespace(**vars(ESTIMATE))
    bench.tasks.navigation.estimate.side_effect = [ESTIMATE, ESTIMATE, better]
    made = bench.results(PLANNER, imaging.WORKER, navigation.HORIZON_WORKER)
    output = bench.run()
    for task, result in zip(
        (bench.control.planner, bench.tasks.imaging, bench.tasks.horizon_cameras), made, strict=True
    ):
        task.finish.assert_called_once_with(result, bench.now_ns)
    assert [call.args for call in bench.tasks.observer.job.call_args_list] == [
        (result, bench.now_ns) for result in made
    ]
    assert output.estimate is better
    assert bench.tasks.steering.run.call_args.args[0] is better


def test_without_cameras_their_results_are_ignored() -> None:
    bench = Bench(Mode.HOLD)
    bench.tasks.imaging = bench.tasks.horizon_cameras = None
    bench.results(imaging.WORKER, navigation.HORIZON_WORKER)
    assert bench.run().mode is Mode.HOLD


def test_every_fourth_cycle_is_recorded_and_only_more_than_three_coils_apart() -> None:
    bench = Bench(Mode.HOLD, coils=4)
    wanted = np.array([0.6, 0.0, 0.0, 0.8])
    reference = SimpleNamespace(quaternion=wanted, body_rate=np.array([0.1, 0.2, 0.3]))
    bench.tasks.steering.run.return_value.reference = reference
    bench.tasks.drive.state.return_value = cast(Any, SimpleNamespace(error="", current=np.full(4, 0.05)))
    for slot in range(2 * ATTITUDE_EVERY):
        bench.run(slot)
    currents, attitudes = bench.recorded(COIL_CURRENTS), bench.recorded(ATTITUDE)
    assert (len(currents), len(attitudes)) == (2, 2)
    padding = [math.nan] * (MOST_COILS - 4)
    assert currents[0]["command"] == pytest.approx([0.0, 0.1, 0.2, 0.3, *padding], nan_ok=True)
    assert currents[0]["written"] == pytest.approx([0.05] * 4 + padding, nan_ok=True)
    values = attitudes[0]
    assert (values["mode"], values["quaternion"]) == (int(Mode.HOLD), [0.0, 0.0, 0.6, 0.8])
    assert (values["rate"], values["wanted_rate"]) == ([0.01, 0.02, 0.03], [0.1, 0.2, 0.3])
    assert (values["wanted"], values["target"]) == (wanted.tolist(), [0.0, 0.6, 0.0, 0.8])
    assert values["angle_sigma"] == [2.0, 3.0, 0.0]
    assert values["rate_sigma"] == pytest.approx([0.1, 0.2, 0.3])
    few = Bench(Mode.SAFE, None)
    few.tasks.navigation.estimate.return_value = None
    few.run()
    assert few.recorded(COIL_CURRENTS) == []
    (values,) = few.recorded(ATTITUDE)
    assert np.isnan([*values["quaternion"], *values["rate"], *values["wanted_rate"], *values["target"]]).all()


@pytest.mark.parametrize(
    ("period", "fine_period", "fast"), [(5.0, 1.0, True), (1.0, 5.0, True), (2.0, 2.0, False)]
)
def test_horizon_cameras_with_either_period_below_two_seconds_have_a_group_of_their_own(
    period: float, fine_period: float, fast: bool
) -> None:
    camera = WideCamera(period=period, fine_period=fine_period)
    config = configuration.replace(configuration.load(config_path("orbit")), wide_cameras=(camera,))
    body, tasks = Mock(), Mock()
    body.estimation.learned_problems = []
    FlightLoop(config, body, tasks, Mock(), Supervisors())
    (groups,) = tasks.health.watch.call_args.args
    assert ("horizon" in {group.name for group in groups}) is fast
