"""Tests that a frame in motion without a rate or without an attitude gives an event."""

from __future__ import annotations

from pathlib import Path

from flight.schema import reader as configuration
from sim_hal.settings import FaultEntry
from tests.support.flights import demo_config, demo_world, event_names, fly


def test_frames_upside_down_are_reported_as_unused(tmp_path: Path) -> None:
    section = configuration.replace(demo_world(), faults=(FaultEntry(fault="camera: wrong", at=0.0),))
    run = fly(demo_config(8.0), tmp_path, section=section)
    assert "frame-unused" in event_names(run)


def test_used_frames_are_not_reported_as_unused(tmp_path: Path) -> None:
    assert "frame-unused" not in event_names(fly(demo_config(8.0), tmp_path))
