"""Tests that the drivers report device faults as in the recorded runs."""

from __future__ import annotations

from pathlib import Path

from tests.support.recorded_flights import unlike_record


def test_a_flight_with_wrong_measurements_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("doubtful", session_folder) == []


def test_a_flight_with_failing_coils_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("coils", session_folder) == []


def test_a_flight_with_failing_receivers_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("receivers", session_folder) == []
