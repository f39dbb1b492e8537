"""Runs a slice of the benchmark `link_kills`, and tests that it would detect a link that stores too late."""

from __future__ import annotations

from pathlib import Path

import pytest

from flight.link.process.commanding import Timetable
from flight.link.security import Vault
from ground.link.terminal import make_keys
from tests.studies.bench.link_kills import measure, measure_scheduled


def test_nothing_is_obeyed_twice_and_no_counter_used_twice(tmp_path: Path) -> None:
    found = measure(tmp_path, 20, seed=3)
    assert len(found.obeyed) > 10
    assert (found.obeyed_twice, found.counters_twice) == (0, 0)


def test_a_link_that_stores_nothing_is_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Vault, "advance", lambda *_: 2)
    assert measure(tmp_path, 12, seed=3).obeyed_twice > 0


def test_a_sender_that_stores_nothing_is_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_keys(tmp_path / "keys")
    monkeypatch.setattr("tests.studies.bench.link_kills.make_keys", lambda _: None)
    monkeypatch.setattr(Vault, "write", lambda *_: 2)
    assert measure(tmp_path, 3, seed=3).counters_twice > 0


def test_no_scheduled_command_comes_twice_and_a_kill_costs_one_at_most(tmp_path: Path) -> None:
    found = measure_scheduled(tmp_path, 12, seed=3)
    assert (found.obeyed_twice, found.schedules_lost) == (0, 0)
    assert 0 < found.never <= found.kills


def test_a_schedule_that_keeps_executed_entries_is_detected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Timetable, "remove", Timetable.forget)
    assert measure_scheduled(tmp_path, 6, seed=3).obeyed_twice > 0
