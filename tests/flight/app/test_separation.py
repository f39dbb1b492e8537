"""Tests that the separation inhibit lasts for its powered time, even with restarts or a failing disk."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from flight.app.service import InhibitedError, SeparationInhibit
from tests.manual_clock import ManualClock

SECOND = 1_000_000_000


def remaining_time(inhibit: SeparationInhibit, folder: Path, seconds: float = 100.0) -> float:
    """Return the remaining time (s) of the inhibit, or 0 after its end."""
    try:
        inhibit.check(folder, seconds)
    except InhibitedError as error:
        return float(str(error).removeprefix(f"separation inhibit of {seconds:g} s: ").split()[0])
    return 0.0


def test_time_without_power_does_not_count_and_a_restart_begins_nothing_again(tmp_path: Path) -> None:
    clock = ManualClock()
    for expected in (70.0, 40.0, 10.0, 0.0):
        inhibit = SeparationInhibit(clock)
        clock.advance(30 * SECOND)
        assert remaining_time(inhibit, tmp_path / "state") == expected
        clock.advance(500 * SECOND)  # this time is not counted, because the power fails before the next check
    clock = ManualClock()  # a new start, years later
    assert remaining_time(SeparationInhibit(clock), tmp_path / "state") == 0.0


def test_without_an_inhibit_nothing_is_stored(tmp_path: Path) -> None:
    SeparationInhibit(ManualClock()).check(tmp_path / "state", 0.0)
    assert not (tmp_path / "state").exists()


def test_any_damage_of_the_record_begins_the_inhibit_again(tmp_path: Path) -> None:
    clock = ManualClock()
    inhibit = SeparationInhibit(clock)
    clock.advance(60 * SECOND)
    assert remaining_time(inhibit, tmp_path) == 40.0
    record = (tmp_path / "powered").read_bytes()
    for position in range(len(record)):
        damaged = record[:position] + bytes([record[position] ^ 1]) + record[position + 1 :]
        (tmp_path / "powered").write_bytes(damaged)
        assert remaining_time(SeparationInhibit(clock), tmp_path) == 100.0


def test_a_disk_that_cannot_be_written_does_not_prolong_a_boot(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    clock = ManualClock()
    inhibit = SeparationInhibit(clock)
    for expected in (50.0, 0.0):
        clock.advance(50 * SECOND)
        assert remaining_time(inhibit, tmp_path / "file" / "state") == expected


def test_one_failed_read_does_not_begin_the_inhibit_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = ManualClock()
    inhibit = SeparationInhibit(clock)
    clock.advance(60 * SECOND)
    assert remaining_time(inhibit, tmp_path) == 40.0
    read, failures = os.read, [OSError(5, "Input/output error")]

    def fail(file: int, size: int) -> bytes:
        if failures:
            raise failures.pop()
        return read(file, size)

    monkeypatch.setattr(os, "read", fail)
    assert remaining_time(SeparationInhibit(clock), tmp_path) == 40.0
