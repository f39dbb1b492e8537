"""Tests that the estimates of short runs equal the recorded estimates."""

from __future__ import annotations

from pathlib import Path

from tests.support.recorded_flights import unlike_record


def test_the_angle_of_the_testbed_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("steps", session_folder) == []


def test_the_angle_after_wrong_measurements_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("doubtful", session_folder) == []


def test_the_rate_from_the_magnetometer_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("detumbling", session_folder) == []


def test_the_attitude_in_orbit_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("navigation", session_folder) == []


def test_the_attitude_with_wrong_solar_strings_is_as_recorded(session_folder: Path) -> None:
    assert unlike_record("receivers", session_folder) == []
