"""Tests that a run of the flight application equals the recorded run."""

from __future__ import annotations

from pathlib import Path

from tests.support.recorded_flights import unlike_record


def test_a_flight_through_commanded_modes_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("commands", session_folder) == []


def test_a_flight_that_navigates_in_orbit_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("navigation", session_folder) == []
