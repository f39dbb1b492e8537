"""Tests that each fault of a run is reported, and that a healthy run reports none."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest

from flight.link.events import EVENTS, Reaction, Severity
from flight.schema import reader as configuration
from ground.campaigns.runner import Case
from ground.telemetry import Run
from sim_hal.faults.catalogue import CATALOGUE, FaultKind
from sim_hal.settings import FaultEntry
from tests.studies.campaigns import fault_judgement, faults, soak
from tests.support.flights import config_for, demo_world, event_names, fly
from tests.support.packed_run import WritablePackets

AT = 5.0
BRIEF = 14.0
"""Duration (s) of a flight with one fault, long enough to detect the fault, end it, and recover."""


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the flights of the campaign."""
    monkeypatch.setattr(faults, "DURATION", BRIEF)


def flown(fault: str, mode: str = "testbed-demo", span: float | None = 3.0) -> dict[str, Any]:
    kind = CATALOGUE[fault.partition(" (")[0]]
    return faults.fly_with(kind, mode, FaultEntry(fault=fault, at=AT, span=span), seed=3)


@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize(
    ("fault", "events", "detected_in", "recovered_in"),
    [
        ("imu: reset", ["control-lost", "imu-silent"], 0.2, 2.0),
        ("imu: baud", ["imu-corrupt"], 0.2, 2.0),
        ("pwm: garbage", ["coil-fault"], 0.6, 2.0),
        ("bus: hang", ["coil-fault"], 0.1, 2.0),
        ("monitor: brown-out", ["power-fault"], 1.3, 2.0),
        ("disk: full", ["log-fault"], 1.3, 2.0),
        ("pwm: upset (register=0, bit=4)", ["coil-fault"], 0.6, 2.0),
        ("imu: upset (register=75, bit=0)", ["control-lost", "imu-silent"], 0.2, 2.0),
        ("monitor: delayed", ["coil-suspect"], 3.0, 2.0),
    ],
)
def test_a_device_that_fails_is_reported_and_good_again_within_two_seconds(
    fault: str, events: list[str], detected_in: float, recovered_in: float
) -> None:
    result = flown(fault)
    assert result["reported"][: len(events)] == events
    assert result["reaction_right"] is not False
    assert result["detected_s"] <= detected_in
    assert result["recovered_s"] <= recovered_in
    assert result["blind_current_a"] == 0.0
    assert result["log_intact"]
    assert not result["task_failed"]


@pytest.mark.usefixtures("brief")
def test_a_coil_that_breaks_is_taken_out_of_use() -> None:
    result = flown("coil-x: open", span=None)
    assert "isolate" in result["reactions"]
    assert result["reaction_right"] is True
    assert result["recovered_s"] <= 6.0


@pytest.mark.usefixtures("brief")
def test_a_report_by_another_name_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(fault_judgement.OWN_OF_KIND, "imu: silent", frozenset({"clock-step"}))
    result = flown("imu: silent")
    assert result["detected_s"] is None
    assert {"imu-silent", "control-lost"} <= set(result["others"])
    assert result["exercised"]


@pytest.mark.usefixtures("brief")
def test_a_loop_that_steers_without_measurements_is_detected(tmp_path: Any) -> None:
    """The log of a flight with a silent unit is changed as if the loop had continued.

    Both the reaction and the coil current must show the fault.
    """
    entry = FaultEntry(fault="imu: silent", at=AT, span=3.0)
    section = configuration.replace(demo_world(), seed=3, faults=(entry,))
    run = fly(config_for("testbed-demo", camera=False, duration=BRIEF), tmp_path, section=section)
    kind = CATALOGUE["imu: silent"]
    sound = fault_judgement.judge(run, kind, entry)
    assert (sound["reaction_right"], sound["blind_current_a"]) == (True, 0.0)
    doctored = WritablePackets(
        {name: run[name].copy() for name in ("control", "imu", "truth", "event", "housekeeping", "run")}
    )
    doctored.logs = run.logs
    during = (run["control"]["time_ns"] > 6.0e9) & (run["control"]["time_ns"] < 7.0e9)
    doctored["control"]["state"][during] = 1
    doctored["truth"]["current"][: len(during)][during] = 0.05
    wrong = fault_judgement.judge(cast("Run", doctored), kind, entry)
    assert wrong["reaction_right"] is False
    assert wrong["blind_current_a"] == pytest.approx(0.05)


@pytest.mark.parametrize("kind", faults.faults(), ids=lambda kind: kind.name)
def test_each_fault_has_events_of_its_own_that_exist(kind: FaultKind) -> None:
    names = {event.name: event for event in EVENTS}
    own = fault_judgement.own_events(kind)
    assert own
    assert all(names[name].severity is not Severity.INFORMATION for name in own)
    reaction = fault_judgement.REACTION.get(fault_judgement.part_of(kind))
    assert reaction is None or names[reaction].reaction is not Reaction.NOTE


@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize("mode", [mode for mode in faults.MODES if mode not in {"detumble", "slew"}])
def test_the_twin_without_a_fault_reports_none_of_their_events(mode: str, tmp_path: Any) -> None:
    """Fly the seeds and modes of the faulty flights above without a fault.

    Another test covers the other two modes.
    """
    section = configuration.replace(demo_world(), seed=3)
    run = fly(config_for(mode, camera=False, duration=BRIEF), tmp_path, section=section)
    assert not set(event_names(run)) & frozenset().union(*fault_judgement.OWN.values(), {"stream-poor"})


@pytest.mark.parametrize("mode", ["detumble", "slew"])
def test_a_sound_flight_is_quiet_in_its_mode(mode: str, tmp_path: Any) -> None:
    run = fly(config_for(mode, camera=False), tmp_path)
    reported = set(event_names(run)) - {"started", "stopped", "target", "mode", "commanded", "plan-stretched"}
    assert reported == set()


def test_the_campaign_meets_every_fault_in_every_mode() -> None:
    kinds = faults.faults()
    drawn = faults.cases(6 * len(kinds), seed=1)
    met = {(case.parameters["fault"], case.parameters["mode"]) for case in drawn}
    assert len(met) == len(drawn)


def test_the_table_of_the_campaign_shows_the_worst_result_of_each_fault() -> None:
    base = {
        "exercised": True,
        "detected_s": 0.5,
        "event": "imu-silent",
        "others": [],
        "reaction_right": True,
        "at": 5.0,
        "end": 8.0,
        "number": "0",
        "reactions": ["coils off"],
        "recovered_s": 1.0,
        "blind_current_a": 0.0,
        "largest_current_a": 0.1,
        "task_failed": False,
        "service_failing": True,
        "log_intact": True,
    }
    worse = {**base, "detected_s": None, "event": None, "recovered_s": None, "blind_current_a": 0.02}
    worse |= {"reaction_right": False, "others": ["tumbling"], "number": "71"}
    idle = {**worse, "exercised": False, "reaction_right": None, "service_failing": False}
    results = [{"fault": "imu: off", "mode": "hold", **one} for one in (base, worse, idle)]
    summary = faults.summarise(results, Path())
    row = summary.facts["faults"]["imu: off"]
    assert (row["detected"], row["exercised"], row["runs"]) == (1, 2, 3)
    assert row["not_recovered"] == 1
    assert row["blind_current_a"] == 0.02
    assert (row["reactions_right"], row["reactions_asked"]) == (1, 2)
    assert summary.facts["service_failing"] == 2
    named = "imu: off, hold, 5.00 to 8.00 s, number 71; reported: tumbling"
    assert summary.facts["not_reported"] == summary.facts["wrong_reaction"] == [named]
    assert summary.text.count(named) == 2


@pytest.mark.slow
def test_two_minutes_of_the_soak_stay_within_all_limits() -> None:
    result = soak.run(Case("slice", (5, 4), {"seconds": 120.0}))
    assert result["faults"] >= 1
    assert soak.broken({**result, "memory_slope": 0.0}) == []
    assert soak.broken({**result, "memory_slope": 1e12}) == ["memory"]
    assert soak.broken({**result, "largest_current_a": 0.2, "pointing_deg": float("nan")}) != []
