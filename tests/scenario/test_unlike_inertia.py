"""Coils in a tumble whose inertia is not the configured one."""

from __future__ import annotations

from pathlib import Path

import pytest

from ground.telemetry import Run
from tests.support.flights import fly
from tests.support.unlike_body import coil_judgement, configured, with_other_body, without_cameras

TWO_PERCENT_OFF = (0.0066, 0.0340, 0.0326)
"""kg m^2; the configured 3U has 0.0066, 0.0333, 0.0333."""


def _flown(folder: Path, duration: float, fault: str) -> Run:
    config, world = configured("orbit_3u")
    section = with_other_body(world, TWO_PERCENT_OFF, 0.9, seed=1, fault=fault)
    return fly(without_cameras(config, duration), folder, section=section)


def test_moments_two_percent_off_isolate_no_healthy_coil(tmp_path: Path) -> None:
    """Of this flight the believed inertia alone made coils y and z look reversed, at 48 and 88 s."""
    found = coil_judgement(_flown(tmp_path, 110.0, ""), "")
    assert found["healthy_isolated"] == []
    assert found["healthy_suspected"] == found["healthy_corrected"] == []


@pytest.mark.parametrize("axis", "yz")
def test_a_coil_reversed_in_the_tumble_is_soon_flown_with_its_sign_changed(tmp_path: Path, axis: str) -> None:
    found = coil_judgement(_flown(tmp_path, 60.0, f"coil-{axis}: reversed"), axis)
    assert found["corrected_s"] is not None
    assert found["corrected_s"] < 30.0
    assert found["flown_with"] == -1.0
    assert found["isolated_s"] is None
    assert found["healthy_isolated"] == found["healthy_corrected"] == []


def test_an_open_coil_is_isolated_in_the_tumble_by_the_supply_current(tmp_path: Path) -> None:
    """All three coils are driven at their limit, so that only the probe shows which coil is open."""
    found = coil_judgement(_flown(tmp_path, 12.0, "coil-y: open"), "y")
    assert found["isolated_s"] is not None
    assert found["isolated_s"] < 10.0
    assert found["healthy_isolated"] == []
