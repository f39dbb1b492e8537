"""The drivers report faults of their devices as in the recorded flights."""

from __future__ import annotations

from pathlib import Path

from tests.support.recorded_flights import unlike_record


def test_a_flight_with_wrong_measurements_is_as_recorded(tmp_path: Path) -> None:
    assert unlike_record("doubtful", tmp_path) == []


def test_a_flight_with_failing_coils_is_as_recorded(tmp_path: Path) -> None:
    assert unlike_record("coils", tmp_path) == []


def test_a_flight_with_failing_receivers_is_as_recorded(tmp_path: Path) -> None:
    assert unlike_record("receivers", tmp_path) == []
