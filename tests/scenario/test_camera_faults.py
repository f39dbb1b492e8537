"""Tests that faulty or late camera frames and a slow worker are reported, and the frames are not used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight.schema.reader import replace
from ground.telemetry import Run
from knightcube.astro.arrays import FloatArray
from sim_hal.settings import FaultEntry
from tests.support.flights import config_for, demo_world, event_names, event_time, fly

AT, SPAN = 3.0, 4.0
ABOUT_VISION = {"camera-late", "camera-lost", "camera-strange", "camera-torn", "vision-slow", "vision-failed"}


def flown(folder: Path, mode: str, fault: str = "") -> Run:
    faults = (FaultEntry(fault=fault, at=AT, span=SPAN),) if fault else ()
    config = replace(config_for(mode, camera=True), duration=8.0)
    return fly(config, folder, section=replace(demo_world(), faults=faults))


def test_a_healthy_camera_raises_no_alarm(tmp_path: Path) -> None:
    run = flown(tmp_path, "hold")
    assert not ABOUT_VISION & set(event_names(run))
    assert len(run["stars"]) == 4


@pytest.mark.parametrize(
    ("fault", "event", "within"),
    [
        ("camera: slow", "camera-late", 2.6),
        ("camera: delayed", "camera-late", 2.6),
        ("vision: slow", "vision-slow", 2.5),
    ],
)
def test_a_late_result_is_reported_with_the_next_frame(
    fault: str, event: str, within: float, tmp_path: Path
) -> None:
    """A late result is reported at the next frame. The camera exposes a frame every 2 s."""
    run = flown(tmp_path, "hold", fault)
    assert AT < event_time(run, event) < AT + within
    assert "task-failed" not in event_names(run)


@pytest.mark.parametrize(
    ("fault", "event"), [("camera: torn", "camera-torn"), ("camera: wrong", "camera-strange")]
)
def test_a_torn_or_wrong_frame_is_reported_and_not_used(fault: str, event: str, tmp_path: Path) -> None:
    run = flown(tmp_path, "safe", fault)
    assert AT < event_time(run, event) < AT + 2.0
    streak = run["streak"]
    time = streak["time_ns"] * 1e-9
    spoiled = (time > AT) & (time < AT + 2.0)
    assert spoiled.sum() == 1
    assert not streak["accepted"][spoiled].any()
    assert streak["accepted"][time < AT].all()
    rate: FloatArray = run["control"]["rate"]
    true: FloatArray = run["truth"]["rate"][: len(rate), 1]
    error = np.abs(rate - true)
    assert np.nanmax(error[40:]) < 5e-3
