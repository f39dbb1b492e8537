"""Tests of the identification record of a flight: which data of the log it contains, and which it omits."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import chi2

from ground.identification.fit import excitation_config, fit, noise_of
from ground.identification.record import IdentificationError, Record, read_record, reported_problems
from ground.telemetry import Run, ScanResult
from knightcube.errors import UsageError
from tests.ground.identification.worlds import World, believed, fly_stack, motion_error
from tests.support import flights
from tests.support.packed_run import packed_run

WORLD = World(inertia=1.15e-3, dipole=0.62, field=4.2e-4, stiffness=1.6e-5, damping=3.0e-6, bias=1e-4, seed=9)


def recorded(run: Run) -> Record:
    """Return the record of a run whose coils return to zero 0.25 s after the last command."""
    return read_record(run, 0.25)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Return the record of 40 s of the excitation in the world of the demonstration."""
    return flights.fly(excitation_config(believed(), 40.0), tmp_path_factory.mktemp("run"))


@pytest.mark.slow
def test_through_drivers_loop_and_log_the_truth_lies_within_the_uncertainty(tmp_path: Path) -> None:
    record = fly_stack(WORLD, tmp_path, 65.0)
    made = fit(record, noise_of(believed()))
    error = motion_error(WORLD, made.constants)
    assert error @ np.linalg.solve(made.covariance[:3, :3], error) < chi2.ppf(0.999, 3)
    assert made.sigma("gain") < 2e-3 * WORLD.constants.gain
    assert abs(made.constants.bias - WORLD.bias) < 4.0 * made.sigma("bias")
    assert record.field is not None
    assert record.field.magnitude == pytest.approx(WORLD.field, rel=1e-3)


def altered(
    run: Run, packet: str, keep: npt.NDArray[np.bool_] | slice = slice(None), **columns: npt.NDArray[Any]
) -> Run:
    """Return a run with replaced columns of a packet. Only the rows `keep` of this packet are kept."""
    array = run.flight.packets[packet].copy()
    for name, values in columns.items():
        array[name] = values
    packets = {**run.flight.packets, packet: array[keep]}
    return replace(run, flight=replace(run.flight, packets=packets))


def test_the_record_does_not_depend_on_the_truth_log(short: Run) -> None:
    empty: ScanResult = replace(short.truth, packets={n: a[:0] for n, a in short.truth.packets.items()})
    with_truth, without = recorded(short), recorded(replace(short, truth=empty))
    assert len(short["truth"])
    for name in ("time", "angle", "rate", "switch_time", "current"):
        assert np.array_equal(getattr(with_truth, name), getattr(without, name))


def test_samples_that_the_host_received_late_have_the_time_of_the_unit(short: Run) -> None:
    exact = recorded(short).time
    rng = np.random.default_rng(6)
    noted = short["imu"]["sample_time_ns"] + (20e6 * rng.uniform(size=len(exact)) ** 3).astype(int)
    late = recorded(altered(short, "imu", sample_time_ns=noted)).time
    assert np.max(np.abs(late - exact)) < 1e-3
    restarted = short["imu"]["device_time_ns"].copy()
    restarted[500:] -= restarted[500]
    assert recorded(altered(short, "imu", device_time_ns=restarted)).time == pytest.approx(exact)


def test_a_current_that_shows_a_cycle_later_counts_from_the_cycle_that_asked(short: Run) -> None:
    control = short["control"]
    written = control["current_written"]
    late = np.concatenate([np.zeros((1, 3)), written[:-1]])
    found, exact = recorded(altered(short, "control", current_written=late)).current, written[:, 0]
    assert np.mean(np.abs(found[:-1] - exact[:-1]) > 1e-3) < 0.02
    assert np.mean(np.abs(late[:-1, 0] - exact[:-1]) > 1e-3) > 0.05, "as written it would be wrong"


def test_without_commands_the_coil_falls_to_zero_as_the_driver_lets_it(short: Run) -> None:
    time = short["control"]["time_ns"] * 1e-9
    record = recorded(altered(short, "control", keep=(time < 12.0) | (time > 13.0)))
    at = int(np.searchsorted(record.switch_time, 12.5)) - 1
    assert record.current[at] == 0.0
    assert record.switch_time[at] == pytest.approx(11.975 + 0.25)


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_an_offset_of_the_magnetometer_does_not_rotate_and_is_subtracted(short: Run, share: float) -> None:
    """If the measured field does not rotate as the body does, the record contains no field."""
    quiet = np.zeros_like(short["control"]["current_written"])
    stilled = altered(short, "control", current_written=quiet, current_command=quiet)
    imu = short["imu"]
    offset = np.array([3e-5, 5e-5, 6e-5])
    still = np.array([2e-4, 0.0, 4e-4])
    field = imu["field"] + offset if share else imu["field"]
    record = recorded(altered(stilled, "imu", field=np.tile(still, (len(imu), 1)) if share == 1.0 else field))
    if share == 1.0:
        assert record.field is None
        return
    assert record.field is not None
    assert record.field.magnitude == pytest.approx(4.5e-4, rel=5e-3)
    assert record.field.offset == pytest.approx(math.hypot(3e-5, 6e-5) if share else 0.0, rel=0.05)


def test_the_field_is_taken_only_while_the_coils_are_off(short: Run) -> None:
    """Samples of the magnetometer while a coil is driven are not used, so an error of 10 % has no effect."""
    control, imu = short["control"], short["imu"]
    quiet = control["current_written"].copy()
    quiet[800:, 0] = 0.0
    asked = control["current_command"].copy()
    asked[800:, 0] = 0.0
    stilled = altered(short, "control", current_written=quiet, current_command=asked)
    field = imu["field"].copy()
    field[:805] *= 1.1
    record = recorded(altered(stilled, "imu", field=field))
    assert record.field is not None
    assert record.field.magnitude == pytest.approx(4.5e-4, rel=1e-3)
    always_on = control["current_written"].copy()
    always_on[:, 0] = 0.05
    assert recorded(altered(short, "control", current_written=always_on)).field is None


def test_a_text_in_the_log_does_not_control_the_terminal() -> None:
    run = packed_run(event=[(1.0, {"severity": 2, "name": "coil-fault", "text": "gone\x1b[2J"})])
    assert reported_problems(run) == ["coil-fault (1): gone\\x1b[2J"]


def test_another_coil_and_a_flight_too_short_are_refused(short: Run) -> None:
    driven = short["control"]["current_written"].copy()
    driven[5, 2] = 0.01
    with pytest.raises(UsageError, match="y or z"):
        recorded(altered(short, "control", current_written=driven))
    with pytest.raises(IdentificationError, match="too short"):
        recorded(altered(short, "imu", keep=slice(0, 50)))


@pytest.mark.parametrize(
    ("packet", "field", "value"),
    [
        ("imu", "rate", np.nan),
        ("imu", "quaternion", 1e200),
        ("imu", "sample_time_ns", 2**60),
        ("control", "current_command", -np.inf),
        ("control", "time_ns", 2**60),
        ("run", "control_period_ns", 0),
        ("run", "coil_resistance", np.nan),
    ],
)
def test_values_that_no_flight_writes_are_reported_as_damage(
    short: Run, packet: str, field: str, value: float
) -> None:
    values = short[packet][field].copy()
    values[len(values) // 2] = value
    damaged = altered(short, packet, **{field: values})
    if field == "sample_time_ns":  # times of the host are used only if the clock of the unit has stopped
        damaged = altered(damaged, "imu", device_time_ns=values)
    with pytest.raises(IdentificationError, match=r"the log is damaged|in order of time"):
        recorded(damaged)
