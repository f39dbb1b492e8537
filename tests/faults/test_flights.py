"""A slice of the campaigns: in flight each fault rings its alarm, and without one everything is quiet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sim_hal.faults.catalogue import CATALOGUE
from sim_hal.settings import FaultEntry
from tests.campaigns import faults, soak
from tests.campaigns.campaign import Case
from tests.scenario.flights import event_names, fly

AT = 5.0


def flown(fault: str, mode: str = "testbed-demo", span: float | None = 3.0) -> dict[str, Any]:
    kind = CATALOGUE[fault]
    return faults.fly_with(kind, mode, FaultEntry(fault=fault, at=AT, span=span), seed=3)


@pytest.mark.parametrize(
    ("fault", "event", "detected_in", "recovered_in"),
    [
        ("imu: reset", "imu-silent", 0.2, 2.0),
        ("imu: baud", "imu-corrupt", 0.2, 2.0),
        ("pwm: garbage", "coil-fault", 0.6, 2.0),
        ("bus: hang", "coil-fault", 0.1, 2.0),
        ("monitor: brown-out", "power-fault", 1.3, 2.0),
        ("disk: full", "log-fault", 1.3, 2.0),
    ],
)
def test_a_device_that_fails_is_told_and_good_again_within_two_seconds(
    fault: str, event: str, detected_in: float, recovered_in: float
) -> None:
    result = flown(fault)
    assert result["event"] == event
    assert result["detected_s"] <= detected_in
    assert result["recovered_s"] <= recovered_in
    assert result["blind_current_a"] == 0.0
    assert result["log_intact"]
    assert not result["task_failed"]


def test_a_coil_that_breaks_is_taken_out_of_use() -> None:
    result = flown("coil-x: open", span=None)
    assert "isolate" in result["reactions"]
    assert result["recovered_s"] <= 6.0


@pytest.mark.parametrize("mode", ["detumble", "slew"])
def test_a_sound_flight_is_quiet_in_its_mode(mode: str, tmp_path: Any) -> None:
    run = fly(faults.config_for(mode, camera=False), tmp_path)
    told = set(event_names(run)) - {"started", "stopped", "target", "mode", "commanded", "plan-stretched"}
    assert told == set()


def test_the_campaign_meets_every_fault_in_every_mode() -> None:
    kinds = faults.faults()
    drawn = faults.cases(6 * len(kinds), seed=1)
    met = {(case.parameters["fault"], case.parameters["mode"]) for case in drawn}
    assert len(met) == len(drawn)


def test_its_table_tells_the_worst_of_each_fault() -> None:
    base = {
        "exercised": True,
        "detected_s": 0.5,
        "event": "imu-silent",
        "reactions": ["coils off"],
        "recovered_s": 1.0,
        "blind_current_a": 0.0,
        "largest_current_a": 0.1,
        "task_failed": False,
        "log_intact": True,
    }
    worse = {**base, "detected_s": None, "event": None, "recovered_s": None, "blind_current_a": 0.02}
    idle = {**worse, "exercised": False}
    results = [{"fault": "imu: off", "mode": "hold", **one} for one in (base, worse, idle)]
    row = faults.summarise(results, Path()).facts["faults"]["imu: off"]
    assert (row["detected"], row["exercised"], row["runs"]) == (1, 2, 3)
    assert row["not_recovered"] == 1
    assert row["blind_current_a"] == 0.02


@pytest.mark.slow
def test_two_minutes_of_the_soak_stay_within_all_limits() -> None:
    result = soak.run(Case("slice", (5, 4), {"seconds": 120.0}))
    assert result["faults"] >= 1
    assert soak.broken({**result, "memory_slope": 0.0}) == []
    assert soak.broken({**result, "memory_slope": 1e12}) == ["memory"]
    assert soak.broken({**result, "largest_current_a": 0.2, "pointing_deg": float("nan")}) != []
