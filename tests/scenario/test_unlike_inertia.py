"""Tests of coil monitoring in a tumble, with an inertia that differs from the configured inertia."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight.link.telemetry.packets import to_text
from flight.schema.reader import replace
from ground.telemetry import Run
from knightcube.astro.arrays import FloatArray
from tests.support.flights import fly
from tests.support.unlike_body import (
    coil_judgement,
    configured,
    with_fault,
    with_other_body,
    without_cameras,
)

TWO_PERCENT_OFF = (0.0066, 0.0340, 0.0326)
"""Moments of inertia (kg m^2); the configured 3U has 0.0066, 0.0333, 0.0333."""


def _coils_and_sigma(flown: Run) -> tuple[FloatArray, FloatArray]:
    """Return the final estimates (3,) of the coil gains, and their standard deviations (3,)."""
    last = flown["description"][-1]
    return np.diag(last["coils"].reshape(3, 3)), np.diag(last["coils_sigma"].reshape(3, 3))


def _flown(folder: Path, duration: float, fault: str) -> Run:
    config, world = configured("orbit_3u")
    section = with_other_body(world, TWO_PERCENT_OFF, 0.9, seed=1, fault=fault)
    return fly(without_cameras(config, duration), folder, section=section)


def test_moments_two_percent_off_isolate_no_healthy_coil(tmp_path: Path) -> None:
    """If the moments of inertia are 2 % off, no healthy coil is isolated.

    If the configured inertia were trusted, the coils y and z would seem reversed, at 48 and 88 s.
    """
    found = coil_judgement(_flown(tmp_path, 95.0, ""), "")
    assert found["healthy_isolated"] == []
    assert found["healthy_suspected"] == found["healthy_corrected"] == []


@pytest.mark.parametrize("axis", "yz")
def test_a_coil_reversed_in_the_tumble_is_soon_flown_with_its_sign_changed(tmp_path: Path, axis: str) -> None:
    flown = _flown(tmp_path, 42.0, f"coil-{axis}: reversed")
    found = coil_judgement(flown, axis)
    assert found["corrected_s"] is not None
    assert found["corrected_s"] < 30.0
    assert found["flown_with"] == -1.0
    gains, sigmas = _coils_and_sigma(flown)
    assert (np.abs(gains - 1.0) < 0.25).all(), "the filter does not learn the corrected sign again"
    assert (sigmas > 0.01).all()
    assert found["isolated_s"] is None
    assert found["healthy_isolated"] == found["healthy_corrected"] == []


def test_an_open_coil_is_isolated_in_the_tumble_by_the_supply_current(tmp_path: Path) -> None:
    """An open coil is isolated in a tumble by the supply current.

    All three coils are driven at their limit, so only a probe of single coils shows an open coil.
    """
    found = coil_judgement(_flown(tmp_path, 12.0, "coil-y: open"), "y")
    assert found["isolated_s"] is not None
    assert found["isolated_s"] < 10.0
    assert found["healthy_isolated"] == []


def test_a_sign_found_before_a_restart_is_used_from_the_start(tmp_path: Path) -> None:
    """A coil that was found to be reversed before a restart has the corrected sign from the start.

    The stored gain matrix of the coils refers to corrected dipoles, so the correction is stored too.
    """
    config, world = configured("orbit_3u")
    state = replace(config.state, folder=str(tmp_path / "state"), period=1.0)
    config = replace(without_cameras(config, 20.0), state=state)
    section = with_fault(world, 1, "coil-y: reversed")
    first = fly(config, tmp_path / "first", section=section)
    assert coil_judgement(first, "y")["flown_with"] == -1.0
    again = fly(config, tmp_path / "again", section=section)
    told = [to_text(event["text"]) for event in again["event"] if to_text(event["name"]) == "coil-corrected"]
    assert told == ["coil y: as before the restart; used with -1.00 of its configured dipole"]
    assert coil_judgement(again, "y")["corrected_s"] < 0.1
    gains, sigmas = _coils_and_sigma(again)
    assert (np.abs(gains - 1.0) < 0.4).all()
    assert (sigmas > 0.02).all()
