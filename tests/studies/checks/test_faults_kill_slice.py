"""Tests of killed flight processes with running devices; driven coils and damaged logs are detected."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import msgspec
import pytest

from flight.loop.state import COPIES, StateStore, StoredState, begin_boot
from ground.campaigns.runner import fly_here
from tests.ground.report.synthetic import Recipe, make_run
from tests.studies.campaigns import campaign, faults_kill
from tests.studies.campaigns.faults_kill import KILLS, Board, cases, summarise


def test_the_requested_kills_are_divided_into_cases() -> None:
    assert [case.parameters["kills"] for case in cases(2 * KILLS + 3, seed=1)] == [KILLS, KILLS, 3]


@pytest.mark.slow
def test_after_each_kill_coils_log_and_state_are_sound_and_the_next_flight_starts(tmp_path: Path) -> None:
    """With seed 7 the first kill is made with coils on (on a fast machine), the second before READY."""
    facts = summarise(fly_here(campaign("faults-kill"), 2, seed=7), tmp_path).facts
    assert (facts["kills"], facts["early"]) == (2, 1)
    assert (facts["beyond_limit"], facts["current_after_a"]) == (0, 0.0)
    assert facts["logs_readable"] == facts["states_whole"] == facts["kills_counted"] == 2
    assert facts["clean_ends"] == facts["modes_right"] == 1
    assert facts["starts_failed"] == facts["left_behind"] == 0


class Coils:
    """Devices whose coils carry the given currents in sequence; the last current persists."""

    def __init__(self, *currents: float) -> None:
        self._currents = list(currents)

    def call(self, name: str) -> list[float]:
        assert name == "currents"
        current = self._currents.pop(0) if len(self._currents) > 1 else self._currents[0]
        return [0.0, -current, 0.0]


def board(folder: Path, bus: Any = None) -> Board:
    made = Board(folder, folder / "facts.json", bus)
    made.state.mkdir(parents=True)
    return made


def test_a_coil_that_stays_driven_is_reported_and_a_coil_that_is_zeroed_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(faults_kill, "LIMIT_S", 0.1)
    monkeypatch.setattr(faults_kill, "_GIVE_UP_S", 0.3)
    left_on = board(tmp_path / "left on", Coils(0.05))
    assert faults_kill.watch_coils(left_on, time.monotonic_ns(), 0.05) == (0.3, 0.05)
    zeroed = board(tmp_path / "zeroed", Coils(0.05, 0.05, 0.0))
    zero_after, later = faults_kill.watch_coils(zeroed, time.monotonic_ns(), 0.05)
    assert 0.0 < zero_after < 0.1
    assert later == 0.0


def test_a_log_with_a_torn_end_is_readable_and_one_with_a_hole_is_not(tmp_path: Path) -> None:
    (log,) = make_run(tmp_path, Recipe(duration=2.0)).glob("flight-*")
    whole = log.read_bytes()
    log.write_bytes(whole[:-7])
    assert faults_kill._log_of(tmp_path, 2.0)["readable"]
    log.write_bytes(whole[:1000] + whole[1010:])
    assert not faults_kill._log_of(tmp_path, 2.0)["readable"]
    log.write_bytes(b"")
    assert faults_kill._log_of(tmp_path, 0.1)["readable"], "nothing was on disk yet"
    assert not faults_kill._log_of(tmp_path, 2.0)["readable"]


def test_a_kill_that_was_not_remembered_and_a_torn_state_are_reported(tmp_path: Path) -> None:
    kept = board(tmp_path)
    store = StateStore(kept.state, lambda *_: None)
    first = begin_boot(StoredState(), "")
    store.store(first)
    assert faults_kill._state_of(kept, counted=True) == {"whole": True, "counted": True}
    assert not faults_kill._state_of(kept, counted=True)["counted"], "the next boot did not count itself"
    second = begin_boot(first, "")
    store.store(msgspec.structs.replace(second, unclean=()))
    assert not faults_kill._state_of(kept, counted=True)["counted"]
    store.store(second)
    (kept.state / COPIES[0]).write_bytes(b"torn")
    assert faults_kill._state_of(kept, counted=False) == {"whole": False, "counted": True}
