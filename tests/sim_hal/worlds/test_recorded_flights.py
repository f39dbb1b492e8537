"""Tests that the simulated worlds move as in the recorded runs."""

from __future__ import annotations

from pathlib import Path

from tests.support.recorded_flights import unlike_record


def test_a_flight_in_the_cage_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("cage", session_folder) == []


def test_a_detumbling_flight_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("detumbling", session_folder) == []
