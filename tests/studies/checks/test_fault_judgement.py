"""Tests of the rules by which a fault counts as exercised."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from ground.telemetry import Run
from sim_hal.faults.catalogue import CATALOGUE
from tests.studies.campaigns import fault_judgement

_TIMING = np.dtype([("time_ns", "<i8"), ("name", "S12"), ("execution", "<f8"), ("outcome", "S12")])


@pytest.mark.parametrize(
    ("at", "end", "met"),
    [
        (5.0577, 9.65, False),
        (5.03, 9.65, False),
        (5.02, 9.65, True),
        (4.0, 5.03, True),
        (4.0, 5.02, False),
        (5.2, 9.65, False),
    ],
)
def test_a_worker_meets_a_fault_only_with_a_job_that_was_begun_under_it(
    at: float, end: float, met: bool
) -> None:
    """One plan begins at 5.025 s and is reported after the modelled 0.05 s, whatever its real duration."""
    jobs = np.array([(5_075_000_000, b"planner", 0.0112, b"done")], dtype=_TIMING)
    flown, kind = {"job_timing": jobs}, CATALOGUE["planner: exception"]
    assert fault_judgement._is_worker_busy(flown, kind, at, end) == met  # type: ignore[arg-type]


@pytest.mark.parametrize(("current", "met"), [(0.008, False), (0.024, False), (0.03, True)])
def test_a_monitor_that_doubles_little_reports_nothing_wrong(current: float, met: bool) -> None:
    """At 8 mA, a doubled reading is within the error of a correct one, so no monitor can distinguish them."""
    control = np.zeros(400, dtype=[("time_ns", "<i8"), ("current_written", "<f8", 3)])
    control["time_ns"] = np.arange(400) * 25_000_000
    control["current_written"][:, 0] = -current
    kind = CATALOGUE["monitor: wrong"]
    assert fault_judgement._is_exercised({"control": control}, kind, 3.0, 6.0) == met  # type: ignore[arg-type]


MS = 1_000_000
CYCLE_NS = 25 * MS


def of_control(currents: np.ndarray[Any, Any]) -> Run:
    count = len(currents)
    control = np.zeros(count, dtype=[("time_ns", "i8"), ("current_written", "f8", 3)])
    control["time_ns"] = np.arange(count) * CYCLE_NS
    control["current_written"][:, 0] = currents
    return cast("Run", {"control": control})


def test_a_monitor_that_is_behind_is_met_only_where_the_currents_change() -> None:
    kind, count = CATALOGUE["monitor: delayed"], 400
    steady = of_control(np.full(count, 0.05))
    step = of_control(np.where(np.arange(count) < 240, 0.0, 0.05))
    assert not fault_judgement._is_exercised(steady, kind, 5.0, 9.0)
    assert fault_judgement._is_exercised(step, kind, 5.0, 9.0)
    assert not fault_judgement._is_exercised(step, kind, 0.0, 4.0)


def test_an_upset_of_the_unit_is_met_where_its_samples_come_otherwise() -> None:
    kind = CATALOGUE["imu: upset"]
    imu = np.zeros(400, dtype=[("time_ns", "i8")])
    imu["time_ns"] = np.arange(400) * CYCLE_NS
    control = of_control(np.zeros(400))["control"]
    whole = cast("Run", {"imu": imu, "control": control})
    gap = cast("Run", {"imu": imu[(imu["time_ns"] < 4e9) | (imu["time_ns"] > 4.3e9)], "control": control})
    assert not fault_judgement._is_exercised(whole, kind, 4.0, 4.0)
    assert fault_judgement._is_exercised(gap, kind, 4.0, 4.0)


def test_an_upset_of_the_monitor_is_met_where_it_shows_nothing_for_a_while() -> None:
    kind = CATALOGUE["monitor: upset"]
    house = np.zeros(10, dtype=[("time_ns", "i8"), ("coil_current", "f8")])
    house["time_ns"] = np.arange(10) * 1_000 * MS
    control = of_control(np.zeros(400))["control"]
    flown = cast("Run", {"housekeeping": house, "control": control, "run": {"duration": [10.0]}})
    assert not fault_judgement._is_exercised(flown, kind, 4.0, 4.0)
    house["coil_current"][5:7] = np.nan
    assert fault_judgement._is_exercised(flown, kind, 4.0, 4.0)
    assert fault_judgement._recovered(flown, kind, 4.0, 4.0, []) == pytest.approx(3.0)
