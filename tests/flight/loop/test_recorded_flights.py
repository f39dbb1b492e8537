"""Tests that the packets of short runs with all tasks of the loop equal the recorded packets."""

from __future__ import annotations

from pathlib import Path

from tests.support.recorded_flights import unlike_record


def test_a_flight_to_an_attitude_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("steps", session_folder) == []


def test_a_flight_with_the_guidance_of_the_thesis_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("thesis", session_folder) == []


def test_a_flight_in_the_cage_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("cage", session_folder) == []


def test_a_flight_through_commanded_modes_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("commands", session_folder) == []


def test_a_flight_with_a_silent_inertial_unit_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("blind", session_folder) == []


def test_a_flight_with_wrong_measurements_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("doubtful", session_folder) == []


def test_a_flight_with_failing_coils_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("coils", session_folder) == []


def test_a_detumbling_flight_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("detumbling", session_folder) == []


def test_a_flight_that_navigates_in_orbit_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("navigation", session_folder) == []


def test_a_flight_with_failing_receivers_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("receivers", session_folder) == []
