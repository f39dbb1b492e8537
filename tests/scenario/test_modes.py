"""Tests of each mode and each transition in lock-step, and of the modes in which the coils are driven."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.link.events import Mode
from flight.link.telemetry.packets import to_text
from flight.loop.state import Notices, StateKeeper, StateStore
from flight.schema import reader as configuration
from flight.schema.bodies import Step
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter
from sim_hal.clock import SimClock
from sim_hal.emulators.serial_line import SOUND, LineFaults
from tests.scenario.mode_flights import (
    BRIEF,
    CYCLE,
    commanded,
    currents,
    entered,
    modes_of,
    path_of_modes,
    released,
    true_angle,
)
from tests.support.flights import Rigged, demo_config, event_names, fly


def test_the_demonstration_is_what_flies_by_default_after_one_cycle_of_boot(tmp_path: Path) -> None:
    run = fly(demo_config(3.0, camera=False), tmp_path)
    assert path_of_modes(run) == [(Mode.BOOT, "begin"), (Mode.TESTBED_DEMO, "start in testbed-demo")]
    assert entered(run, Mode.TESTBED_DEMO) == pytest.approx(0.025)
    assert event_names(run) == ["started", "target", "stopped"]


def test_boot_keeps_the_coils_at_zero_until_the_inertial_unit_sends(tmp_path: Path) -> None:
    def prepare(rigged: Rigged) -> None:
        wire = rigged.lock.line.to_host
        rigged.at(-0.2, lambda: setattr(wire, "faults", LineFaults(silent=True)))
        rigged.at(2.0, lambda: setattr(wire, "faults", SOUND))

    run = fly(commanded(5.0, {"at": 1.0, "mode": "hold"}), tmp_path, prepare)
    assert modes_of(run) == [Mode.BOOT, Mode.TESTBED_DEMO]
    assert entered(run, Mode.TESTBED_DEMO) == pytest.approx(2.0, abs=0.2)
    assert currents(run, -1.0, 2.0).max() == 0.0
    assert currents(run, 2.5, 5.0).max() > 0.0
    names = event_names(run)
    assert "boot-waits" in names
    (answer,) = run["command"]
    assert (answer["obeyed"], to_text(answer["text"])) == (0, "mode hold: not while in boot")


def test_safe_drives_no_coil_and_is_left_by_command_only(tmp_path: Path) -> None:
    run = fly(commanded(6.0, {"at": 4.0, "slew": 0.0}, initial="safe"), tmp_path)
    assert modes_of(run) == [Mode.BOOT, Mode.SAFE, Mode.SLEW]
    assert currents(run, -1.0, 4.0).max() == 0.0
    assert currents(run, 4.2, 6.0).max() > 0.0
    assert run["control"]["state"][:160].max() == 0


def test_a_command_to_be_safe_zeroes_the_coils_within_two_cycles(tmp_path: Path) -> None:
    run = fly(commanded(4.0, {"at": 2.0, "mode": "safe"}), tmp_path)
    assert modes_of(run) == [Mode.BOOT, Mode.TESTBED_DEMO, Mode.SAFE]
    assert currents(run, 1.5, 2.0).max() > 0.0
    assert currents(run, 2.05, 4.0).max() == 0.0
    names = event_names(run)
    assert names[-3:] == ["mode", "commanded", "stopped"]


def test_hold_keeps_the_attitude_of_the_moment_it_is_commanded(tmp_path: Path) -> None:
    run = fly(commanded(16.5, {"at": 3.0, "mode": "hold"}), tmp_path)
    assert modes_of(run) == [Mode.BOOT, Mode.TESTBED_DEMO, Mode.HOLD]
    time = run["truth"]["time_ns"] * 1e-9
    moment = float(np.interp(3.0, time, true_angle(run)))
    assert np.abs(true_angle(run)[time > 14.0] - moment).max() < 0.01
    wanted = run["control"]["target_q2"][-1]
    assert 2.0 * np.arcsin(wanted) == pytest.approx(moment, abs=0.01)


def test_a_slew_arrives_and_is_held(tmp_path: Path) -> None:
    run = fly(commanded(17.0, {"at": 1.0, "slew": -0.1}, initial="hold"), tmp_path)
    assert path_of_modes(run)[1:] == [
        (Mode.HOLD, "start in hold"),
        (Mode.SLEW, "commanded slew"),
        (Mode.HOLD, "arrived"),
    ]
    assert entered(run, Mode.HOLD) < 15.0
    final = true_angle(run)[run["truth"]["time_ns"] * 1e-9 > 15.0]
    assert np.abs(final - 2.0 * np.arcsin(-0.1)).max() < 0.005
    assert run["mode"]["target_q2"][-1] == -0.1
    assert run["target"]["index"].tolist() == [1001]


def test_a_slew_commanded_again_goes_to_the_new_target(tmp_path: Path) -> None:
    steps = ({"at": 1.0, "slew": -0.1}, {"at": 4.0, "slew": 0.2})
    run = fly(commanded(17.0, *steps, initial="hold"), tmp_path)
    assert modes_of(run)[2:] == [Mode.SLEW, Mode.SLEW, Mode.HOLD]
    assert true_angle(run)[-1] == pytest.approx(2.0 * np.arcsin(0.2), abs=0.005)


def test_a_slew_that_does_not_arrive_becomes_a_hold(tmp_path: Path) -> None:
    run = fly(commanded(8.0, {"at": 1.0, "slew": -0.3}, initial="hold", slew_limit=2.0), tmp_path)
    assert path_of_modes(run)[-1] == (Mode.HOLD, "reaction hold")
    assert "slew-late" in event_names(run)


def test_detumbling_reduces_the_rate_monotonically(tmp_path: Path) -> None:
    """Detumbling reduces the rate monotonically, from 0.5 rad/s with the coils x and z.

    The field is measured while the coils are off.
    """
    run = fly(commanded(11.0, initial="detumble"), tmp_path, section=released(-0.68, 0.5))
    assert modes_of(run) == [Mode.BOOT, Mode.DETUMBLE]
    truth = run["truth"]
    time = truth["time_ns"] * 1e-9
    rate = truth["rate"][:, 1]
    # One coil (0.096 A m^2 in 0.45 mT, driven for 0.6 of the time) reduces the rate by 0.025 rad/s per
    # second. Two coils reduce the rate by 1.4 times as much.
    assert rate[time > 10.9].max() < 0.2
    windows = np.interp(np.arange(0.5, 11.0, 0.25), time, rate)
    assert np.diff(windows).max() < 2e-3
    braking = time > 0.5
    off = np.abs(truth["current"][braking]).max(axis=1) == 0.0
    assert 0.3 < off.mean() < 0.5, "the coils are off for two fifths of the time, while the field is measured"
    assert np.abs(truth["current"][braking][:, 2]).max() > 0.05
    assert (run["control"]["state"][20:] == 3).all()


def test_a_body_that_has_been_detumbled_is_held(tmp_path: Path) -> None:
    run = fly(commanded(24.0, initial="detumble"), tmp_path, section=released(-0.6, 0.12))
    assert path_of_modes(run)[1:] == [(Mode.DETUMBLE, "start in detumble"), (Mode.HOLD, "rate is low")]
    time = run["truth"]["time_ns"] * 1e-9
    after = time > entered(run, Mode.HOLD)
    assert np.abs(run["truth"]["rate"][after, 1]).max() < 0.03
    assert np.ptp(true_angle(run)[time > 20.0]) < 0.005


def test_a_body_that_is_pushed_out_of_its_hold_is_detumbled_and_held_again(tmp_path: Path) -> None:
    def prepare(rigged: Rigged) -> None:
        world = rigged.testbed
        rigged.at(4.0, lambda: setattr(world, "rate", world.rate + 0.7))

    run = fly(commanded(53.0, initial="hold"), tmp_path, prepare)
    assert path_of_modes(run)[1:] == [
        (Mode.HOLD, "start in hold"),
        (Mode.DETUMBLE, "reaction detumble"),
        (Mode.HOLD, "rate is low"),
    ]
    assert "tumbling" in event_names(run)


@pytest.mark.parametrize(
    ("initial", "strategy"),
    [("hold", "goal"), ("testbed-demo", "goal"), ("testbed-demo", "receding"), ("testbed-demo", "step")],
)
def test_a_hold_that_is_impossible_ends_in_safe_with_the_coils_at_zero(
    tmp_path: Path, initial: str, strategy: str
) -> None:
    def prepare(rigged: Rigged) -> None:
        world = rigged.testbed

        def hand() -> None:
            world.angle, world.rate = 1.2, 0.0

        for k in range(550):
            rigged.at(4.0 + 0.02 * k, hand)

    config = commanded(15.0, initial=initial)
    config = configuration.replace(config, guidance=configuration.replace(config.guidance, strategy=strategy))
    run = fly(config, tmp_path, prepare, section=released(-0.2, 0.0))
    assert path_of_modes(run)[-1] == (Mode.SAFE, "reaction safe")
    # In the demonstration, the timeout starts when the path ends; without a path, it starts at the same time.
    # In the mode HOLD, the timeout starts when the filter discards its estimate.
    since = 10.0 if initial == "testbed-demo" else 4.0 + AttitudeFilter.REJECTIONS_TO_RESTART * CYCLE
    assert entered(run, Mode.SAFE) == pytest.approx(since + BRIEF["hold_patience"], abs=0.1)
    assert "hold-impossible" in event_names(run)
    assert currents(run, 4.0, entered(run, Mode.SAFE)).max() > 0.0
    assert currents(run, entered(run, Mode.SAFE) + 0.1, 15.0).max() == 0.0


def test_a_target_that_is_approached_or_moves_is_not_reported_as_impossible_to_hold(
    tmp_path: Path,
) -> None:
    """A target that is being approached, or that moves, is not reported as impossible to hold.

    The error is 0.8 rad for longer than the timeout of a hold. The last target is 0.68 rad away.
    """
    config = configuration.replace(commanded(27.0), steps=(Step(at=0.0, q2=-0.2, rate=0.04),))
    run = fly(config, tmp_path)
    assert modes_of(run) == [Mode.BOOT, Mode.TESTBED_DEMO]
    assert event_names(run) == ["started", "target", "stopped"]
    assert true_angle(run)[-1] == pytest.approx(2.0 * np.arcsin(-0.2) + 0.04 * 17.0, abs=0.01)


def test_a_body_spun_up_in_the_demonstration_is_detumbled(tmp_path: Path) -> None:
    def prepare(rigged: Rigged) -> None:
        rigged.at(4.0, lambda: setattr(rigged.testbed, "rate", 0.9))

    run = fly(commanded(8.0, hold_patience=15.0), tmp_path, prepare)
    assert modes_of(run)[:3] == [Mode.BOOT, Mode.TESTBED_DEMO, Mode.DETUMBLE]
    assert "tumbling" in event_names(run)


def test_a_latched_cause_of_safe_prevents_other_modes_until_it_is_cleared(tmp_path: Path) -> None:
    def prepare(rigged: Rigged) -> None:
        def fail(*_: object) -> None:
            raise ZeroDivisionError

        rigged.at(1.0, lambda: setattr(rigged.loop._tasks.steering, "run", fail))
        rigged.at(4.0, lambda: delattr(rigged.loop._tasks.steering, "run"))

    run = fly(
        commanded(
            8.0,
            {"at": 5.0, "mode": "hold"},
            {"at": 6.0, "clear": "task-failing"},
            {"at": 7.0, "mode": "hold"},
            hold_patience=15.0,
        ),
        tmp_path,
        prepare,
    )
    assert modes_of(run) == [Mode.BOOT, Mode.TESTBED_DEMO, Mode.SAFE, Mode.HOLD]
    assert run["command"]["obeyed"].tolist() == [0, 1, 1]
    assert to_text(run["command"][0]["text"]).endswith("refused until cleared: task-failing")


@pytest.mark.parametrize("initial", ["testbed-demo", "hold", "detumble"])
def test_a_unit_that_stays_silent_leads_to_safe_from_every_mode_that_drives(
    tmp_path: Path, initial: str
) -> None:
    def prepare(rigged: Rigged) -> None:
        rigged.at(2.0, lambda: setattr(rigged.lock.line.to_host, "faults", LineFaults(silent=True)))

    config = commanded(8.0, initial=initial, hold_patience=60.0)
    run = fly(config, tmp_path, prepare, section=released(0.2, 0.4))
    assert path_of_modes(run)[-1] == (Mode.SAFE, "reaction safe")
    names = event_names(run)
    assert names.index("control-lost") < names.index("imu-silent") < names.index("blind")


@pytest.mark.parametrize(("crashes", "mode"), [(2, Mode.TESTBED_DEMO), (3, Mode.SAFE)])
def test_too_many_recent_crashes_lead_to_safe_and_one_fewer_does_not(
    tmp_path: Path, crashes: int, mode: Mode
) -> None:
    """Too many recent crashes lead to SAFE, but one crash fewer does not lead to SAFE.

    A killed boot is recognised because its stored state still says that the boot is running.
    """
    config = commanded(1.0)
    state = tmp_path / "state"
    for _ in range(crashes):
        keeper_of(state).close(clean=False)
    config = configuration.replace(config, state=configuration.replace(config.state, folder=str(state)))
    run = fly(config, tmp_path / "run")
    assert modes_of(run) == [Mode.BOOT, mode]
    assert ("crashed-often" in event_names(run)) is (mode is Mode.SAFE)
    again = fly(config, tmp_path / "again")
    assert modes_of(again) == [Mode.BOOT, mode], "a clean end is not counted, and mends nothing by itself"


def keeper_of(folder: Path) -> StateKeeper:
    """Return a new state keeper with the folder `folder`, as a flight creates it at its start."""
    folder.mkdir(exist_ok=True)
    notices = Notices()
    return StateKeeper(StateStore(folder, notices.report), notices, SimClock(), period_ns=10_000_000_000)


def test_every_mode_is_reached_by_command_and_the_demonstration_continues_on_schedule(
    tmp_path: Path,
) -> None:
    steps: list[dict[str, Any]] = [
        {"at": 2.0, "mode": "safe"},
        {"at": 3.0, "mode": "detumble"},
        {"at": 6.0, "mode": "hold"},
        {"at": 7.0, "slew": 0.1},
        {"at": 8.0, "mode": "testbed-demo"},
    ]
    run = fly(commanded(21.0, *steps), tmp_path)
    ways = modes_of(run)
    assert ways[:3] == [Mode.BOOT, Mode.TESTBED_DEMO, Mode.SAFE]
    assert ways[-3:] == [Mode.HOLD, Mode.SLEW, Mode.TESTBED_DEMO]
    assert run["command"]["obeyed"].all()
    assert run["target"]["index"].tolist() == [0, 1001, 0]
    assert true_angle(run)[-1] == pytest.approx(2.0 * np.arcsin(-0.3), abs=0.005)
    for log in run.logs.values():
        assert log.intact
