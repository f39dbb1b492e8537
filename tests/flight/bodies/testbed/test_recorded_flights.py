"""Tests that the testbed estimates, plans and steers as in the recorded runs."""

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
