"""Tests that a broken coil is isolated, that the other coils replace it, and that heat leads to SAFE."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from flight.link.events import Mode
from flight.link.telemetry.packets import to_text
from flight.loop.health import ResourceSample
from flight.schema.reader import replace
from flight.schema.sections import Modes
from ground.telemetry import Run
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix
from sim_hal.settings import FaultEntry
from tests.scenario.mode_flights import modes_of
from tests.support.flights import Rigged, demo_config, demo_world, event_names, event_time, fly

AT = 4.0
SECOND = 1_000_000_000
FIELD = np.array([0.0, 0.0, -4.5e-4])
DIPOLE = 80 * 0.0081


def flown(fault: str, folder: Path, duration: float, initial: str = "testbed-demo") -> tuple[Run, FloatArray]:
    """Run a flight with a fault from the time AT on; return its log and the commanded currents (k, 3), A."""
    wishes: list[FloatArray] = []

    def listen(rigged: Rigged) -> None:
        drive = rigged.loop._tasks.drive
        send, zero = drive.send, drive.zero

        def sent(
            currents: FloatArray, field: Callable[[], FloatArray | None], *, testable: bool = False
        ) -> None:
            wishes.append(currents.copy())
            send(currents, field, testable=testable)

        def zeroed() -> None:
            wishes.append(np.zeros(3))
            zero()

        drive.send, drive.zero = sent, zeroed  # type: ignore[method-assign]  # records and passes the call on

    config = demo_config(duration, camera=False)
    config = replace(config, modes=replace(Modes(), initial=initial))
    world = replace(demo_world(), faults=(FaultEntry(fault=fault, at=AT),))
    run = fly(config, folder, listen, section=world)
    return run, np.array(wishes[-len(run["control"]) :])


def torque(currents: FloatArray, quaternions: FloatArray) -> FloatArray:
    """Return the torque (k,), N m, about the thread, caused by currents (k, 3), A, at attitudes (k, 4)."""
    fields = np.array([attitude_matrix(quaternion) @ FIELD for quaternion in quaternions])
    made: FloatArray = np.cross(DIPOLE * currents, fields)[:, 1]
    return made


@pytest.mark.parametrize(("fault", "within"), [("coil-x: open", 6.0), ("bridge-x: a-high", 6.0)])
def test_a_broken_coil_is_left_out_and_the_others_keep_the_direction_of_the_torque(
    fault: str, within: float, tmp_path: Path
) -> None:
    run, wishes = flown(fault, tmp_path, 16.0)
    isolated = event_time(run, "coil-broken")
    assert AT < isolated < AT + within
    text = to_text(run["event"]["text"][event_names(run).index("coil-broken")])
    assert text.startswith("coil x")
    truth, count = run["truth"], len(wishes)
    after = np.arange(count) * 0.025 > isolated + 0.5
    # At the start of a cycle, the true current follows the previous cycle's command.
    carried, attitude = truth["current"][1 : count + 1], truth["quaternion"][:count]
    assert np.abs(carried[after, 0]).max() < 1e-9, "the broken coil carries nothing"
    wanted, made = torque(wishes, attitude)[after], torque(carried, attitude)[after]
    much = np.abs(wanted) > 0.1 * DIPOLE * 0.148 * 4.5e-4
    assert much.sum() > 40
    along = (np.sign(made) == np.sign(wanted))[much & (np.abs(made) > 1e-7)]
    assert along.mean() > 0.99, "the remaining coils turn the body the commanded way"
    assert run["health"]["coils_in_use"][-1] == 0b110


def test_a_reversed_coil_is_flown_with_its_sign_changed(tmp_path: Path) -> None:
    run, wishes = flown("coil-x: reversed", tmp_path, 24.0)
    corrected = event_time(run, "coil-corrected")
    assert AT < corrected < AT + 6.0
    assert "coil-broken" not in event_names(run)
    truth, count = run["truth"], len(wishes)
    after = np.arange(count) * 0.025 > corrected + 0.5
    carried = truth["current"][1 : count + 1]
    much = after & (np.abs(wishes[:, 0]) > 0.01)
    assert much.sum() > 40
    assert (np.sign(carried[much, 0]) == np.sign(wishes[much, 0])).mean() > 0.99
    assert run["health"]["coils_in_use"][-1] == 0b111


def test_a_coil_that_a_stuck_leg_drives_in_safe_is_reported_braked_and_left_out(tmp_path: Path) -> None:
    run, _ = flown("bridge-z: b-high", tmp_path, 10.0, initial="safe")
    names = event_names(run)
    assert names.index("coil-suspect") < names.index("coil-broken")
    assert event_time(run, "coil-suspect") < AT + 1.0
    truth = run["truth"]
    time, carried = truth["time_ns"] * 1e-9, np.abs(truth["current"])
    assert carried[time > AT + 0.1, 2].max() == pytest.approx(3.4 / 23.0, rel=0.03)
    assert carried[time > AT + 3.0].max() == 0.0
    assert carried[:, :2].max() == 0.0, "no other coil was driven to find out"
    assert np.count_nonzero(carried[:, 2]) * 0.025 < 1.6


def test_a_healthy_flight_in_safe_brakes_no_bridge(tmp_path: Path) -> None:
    run, _ = flown("disk: full", tmp_path, 8.0, initial="safe")
    assert not {"coil-suspect", "coil-broken"} & set(event_names(run))
    assert not run["truth"]["current"].any()


def test_a_board_that_is_too_hot_leads_to_safe_with_the_coils_at_zero(tmp_path: Path) -> None:
    def prepare(rigged: Rigged) -> None:
        def look(now_ns: int) -> ResourceSample:
            hot = now_ns - rigged.epoch_ns > 3 * SECOND
            return ResourceSample(now_ns, 0.0, 5e7, 1e8, 1e10, 100.0 if hot else 50.0)

        rigged.loop._tasks.health.read_resources(look, SECOND // 2)

    run = fly(demo_config(8.0, camera=False), tmp_path, prepare)
    assert modes_of(run)[-1] is Mode.SAFE
    assert 3.0 < event_time(run, "too-hot") < 5.0
    truth = run["truth"]
    time, carried = truth["time_ns"] * 1e-9, np.abs(truth["current"]).max(axis=1)
    assert carried[time < 3.0].max() > 0.0
    assert carried[time > event_time(run, "too-hot") + 0.1].max() == 0.0
