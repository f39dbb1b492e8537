"""Runs a slice of the campaign `orbit-faults`: two reported faults, and a detected wrong coil current."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from flight.link.events import EVENTS, Severity
from flight.schema import reader as configuration
from ground.campaigns.runner import Case
from ground.telemetry import Run
from knightcube.astro.earth.orbit_knowledge import TwoLineElements
from sim_hal.faults.catalogue import CATALOGUE
from sim_hal.settings import FaultEntry
from tests.studies.campaigns import orbit_fault_flights, orbit_faults
from tests.studies.campaigns import orbit_fault_judgement as judgement
from tests.studies.campaigns.fault_judgement import part_of
from tests.studies.campaigns.orbit_fault_flights import (
    MODES,
    config_for,
    old_elements,
    world_for,
)
from tests.support.flights import fly
from tests.support.packed_run import WritablePackets

BRIEF, LAST = 34.0, 6.0
"""Durations (s) of a flight, and of its end in which the body must meet the requirements of its mode."""
AT, SPAN = 12.0, 10.0


@pytest.fixture(autouse=True)
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(judgement, "LAST", LAST)


def flown(fault: str, mode: str, folder: Path) -> Run:
    entry = FaultEntry(fault=fault, at=AT, span=SPAN)
    config = configuration.replace(config_for(mode), duration=BRIEF, wide_cameras=())
    return fly(config, folder, section=world_for(mode, 3, (entry,)))


def test_a_receiver_that_repeats_its_fix_is_reported_and_the_body_points_on(tmp_path: Path) -> None:
    run = flown("gps: stuck", "sun", tmp_path)
    found = judgement.judge(run, CATALOGUE["gps: stuck"], "sun", AT, AT + SPAN)
    assert found["event"] == "gps-refused"
    assert found["told_s"] < 4.0
    assert (found["works"], found["blind_current_a"], found["beyond_s"]) == (True, 0.0, 0.0)
    assert not found["task_failed"]
    assert found["log_intact"]


def test_a_stuck_magnetometer_ends_detumbling_and_a_current_in_spite_of_it_is_detected(
    tmp_path: Path,
) -> None:
    run, kind = flown("magnetometer: stuck", "detumble", tmp_path), CATALOGUE["magnetometer: stuck"]
    found = judgement.judge(run, kind, "detumble", AT, AT + SPAN)
    assert found["event"] == "field-refused"
    assert found["told_s"] < 2.0
    assert found["blind_current_a"] < 1e-3
    assert found["works"]
    names = ("truth", "imu", "navigation", "mode", "attitude")
    doctored = WritablePackets({name: run[name].copy() for name in names})
    late = np.abs(run["truth"]["time_ns"] * 1e-9 - (AT + 9.0)) < 0.1
    doctored["truth"]["current"][late] = 0.05
    blind = judgement.blind_current(cast("Run", doctored), kind, "detumble", AT, AT + SPAN)
    assert blind == pytest.approx(0.05)


def test_each_fault_has_events_of_its_own_that_exist() -> None:
    names = {event.name: event for event in EVENTS}
    for fault in orbit_faults.faults():
        part = part_of(CATALOGUE[fault]) if fault in CATALOGUE else fault.partition(":")[0]
        own = judgement.ORBIT_OWN[part]
        assert own, fault
        assert all(names[name].severity is not Severity.INFORMATION for name in own)


def test_the_campaign_meets_every_fault_in_every_mode() -> None:
    drawn = orbit_faults.cases(len(MODES) * len(orbit_faults.faults()), seed=1)
    met = {(case.parameters["fault"], case.parameters["mode"]) for case in drawn}
    assert len(met) == len(drawn)


def test_elements_of_a_week_ago_have_an_error_within_their_sigma() -> None:
    config = config_for("point")
    assert config.elements is not None
    known, old = TwoLineElements(*config.elements), TwoLineElements(*old_elements())
    date = 2_461_120.0
    off = np.linalg.norm(known.at(date).position - old.at(date).position)
    assert off == pytest.approx(4.0 * 7.6e3, rel=0.05)
    # After a week, sigma exceeds 1.5 km plus 1.5 km per day, because the drag is unknown.
    assert 1500.0 + 7.0 * 1500.0 < old.at(date).sigma < 2e5
    assert off < 3.0 * old.at(date).sigma


def refly(
    monkeypatch: pytest.MonkeyPatch, seed: int, number: int, fault: str, mode: str, seconds: float
) -> dict[str, Any]:
    """Repeat a flight of the campaign with the fault of a given name."""
    monkeypatch.undo()
    monkeypatch.setattr(orbit_fault_flights, "DURATION", seconds)
    name = f"{number} {fault} {mode}"
    return orbit_faults.run(Case(name, (seed, number), {"fault": fault, "mode": mode}))


def test_false_pictures_from_the_start_do_not_cause_a_permanent_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In flight 97 of seed 3, false pictures caused a bias of 0.5 deg/s, and every later attitude failed."""
    found = refly(monkeypatch, 3, 97, "wide: wrong", "acquire", 48.0)
    assert found["event"] == "wide-false"
    assert found["works"]
    assert found["beyond_s"] == 0.0


def test_detumbling_continues_although_the_unit_restarted_at_another_phase(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In flight 0 of seed 4, the unit's samples came a millisecond before the commands.

    A detumbler that rejected all these samples would use its prediction for half a minute, with an error of
    2.5 deg/s.
    """
    found = refly(monkeypatch, 4, 0, "imu: off", "detumble", 56.0)
    assert found["works"]
