"""A flight that the application composes is the recorded one."""

from __future__ import annotations

from pathlib import Path

from tests.support.recorded_flights import unlike_record


def test_a_flight_through_commanded_modes_is_as_recorded(tmp_path: Path) -> None:
    assert unlike_record("commands", tmp_path) == []


def test_a_flight_that_navigates_in_orbit_is_as_recorded(tmp_path: Path) -> None:
    assert unlike_record("navigation", tmp_path) == []
