"""Tests that the orbiting body estimates and detumbles as in the recorded runs."""

from __future__ import annotations

from pathlib import Path

from tests.support.recorded_flights import unlike_record


def test_a_detumbling_flight_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("detumbling", session_folder) == []


def test_a_flight_that_navigates_in_orbit_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("navigation", session_folder) == []


def test_a_flight_with_failing_receivers_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("receivers", session_folder) == []
