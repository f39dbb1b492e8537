"""Tests that the shipped satellites detumble with other coils, dimensions and orbits."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from flight.schema import reader as configuration
from flight.schema.bodies import as_orbit
from flight.schema.devices import Winding
from flight.schema.document import FOLDER
from sim_hal.settings import FaultEntry, Simulation
from tests.support.flights import fly
from tests.support.unlike_body import without_cameras

DOUBLED = tuple(
    Winding(axis=axis, dipole_per_ampere=5.0, resistance=ohms, current_limit=limit)
    for axis, ohms, limit in (
        ((1.0, 0.0, 0.0), 30.0, 0.1),
        ((0.0, 1.0, 0.0), 30.0, 0.1),
        ((0.0, 0.0, 1.0), 45.0, 0.06),
        ((0.0, 0.0, -1.0), 30.0, 0.1),
    )
)
"""Coils on three axes, with two unequal coils in opposite directions on the axis z."""
SECONDS, BROKEN, FIELD = 20.0, 36.0, 3.0e-5
"""Duration (s) with healthy coils, duration (s) of a flight whose coil fails after 10 s, and field (T)."""


@pytest.mark.parametrize("name", ["orbit_2u", "orbit_6u", "orbit_12u", "orbit_1u_tilted"])
def test_an_example_detumbles_with_currents_within_the_limit_of_each_coil(name: str, tmp_path: Path) -> None:
    path = FOLDER / f"{name}.yaml"
    config = without_cameras(as_orbit(configuration.load(path)), SECONDS)
    section = configuration.simulation_section(path.read_text(encoding="utf-8"), str(path), Simulation)
    run = fly(config, tmp_path / "flown", section=section)
    limits = np.array(config.coils.limits)
    carried = np.abs(run["truth"]["current"]).max(axis=0)
    assert (carried <= limits * (1.0 + 1e-9)).all()
    assert (carried > 0.5 * limits).all()
    momentum = np.linalg.norm(run["truth"]["rate"] @ config.craft.inertia_matrix(), axis=1)
    removed = (momentum[0] - momentum[-1]) / (SECONDS * FIELD * float(config.coils.map().limits.mean()))
    assert removed > 0.2, "a fifth of what the mean dipole limit across a typical field would remove"
    assert not {row["name"] for row in run["event"]} & {b"coil-broken", b"coil-suspect", b"coil-corrected"}
    # The true coils differ from the configured coils only by their gains and directions.
    true = run["true_description"]["coils"][0].reshape(3, 3)
    assert np.abs(true - np.eye(3)).max() < 0.45


@pytest.mark.parametrize("windings", [None, DOUBLED], ids=["pyramid", "doubled"])
def test_a_satellite_with_four_coils_flies_on_when_one_of_them_fails(
    windings: tuple[Winding, ...] | None, tmp_path: Path
) -> None:
    """The tested satellites have a pyramid of four rods, or three axes with two unequal coils on one axis."""
    path, broken = FOLDER / "orbit_6u_redundant.yaml", 3
    config = without_cameras(as_orbit(configuration.load(path)), BROKEN)
    if windings is not None:
        coils = configuration.replace(config.coils, windings=windings)
        config = configuration.replace(config, coils=coils)
    section = configuration.simulation_section(path.read_text(encoding="utf-8"), str(path), Simulation)
    assert section is not None
    fault = FaultEntry(fault="coil-4: open", at=10.0)
    run = fly(config, tmp_path, section=configuration.replace(section, faults=(fault,)))
    true, told = run["true_coil_currents"], run["coil_currents"]
    assert np.isnan(true["current"][:, 4:]).all()
    assert np.isnan(told["written"][:, 4:]).all()
    before = true["time_ns"] < 10_000_000_000
    limits = np.array(config.coils.limits)
    # The emulated bridges drive all four coils, and the telemetry reports the current of each coil.
    assert (np.abs(true["current"][before, :4]).max(axis=0) > 0.3 * limits).all()
    assert (np.abs(true["current"][:, :4]).max(axis=0) <= limits * (1.0 + 1e-6)).all()
    # The current that a cycle commands flows until the next cycle, with an error below 10 mA.
    told_before = told[told["time_ns"] < 9_900_000_000]
    flowing = true["current"][np.searchsorted(true["time_ns"], told_before["time_ns"] + 25_000_000), :4]
    assert np.abs(flowing - told_before["written"][:, :4]).max() < 0.01
    assert run["truth"]["current"] == pytest.approx(true["current"][:, :3], abs=1e-7)
    # The fourth coil is isolated, and the other three coils continue to damp the rotation.
    (event,) = [row for row in run["event"] if row["name"] == b"coil-broken"]
    assert event["text"].startswith(b"coil 4 open")
    assert event["time_ns"] < 25_000_000_000
    assert int(run["health"]["coils_in_use"][-1]) == 0b0111
    after = told["time_ns"] > event["time_ns"] + 1_000_000_000
    assert not told["command"][after, broken].any()
    # Parameters that were estimated with four coils are not valid for three coils.
    told_of = run["description"]
    place = np.searchsorted(told_of["time_ns"], event["time_ns"])
    learned, anew = told_of["coils_sigma"][place - 1], told_of["coils_sigma"][place]
    accuracy, left = config.craft.accuracy, config.coils.map().working(np.arange(4) != broken)
    errors = left.error_covariance(accuracy.coil_gain, math.radians(accuracy.coil_axes_deg))
    assert (anew > 1.2 * learned).any()
    assert (anew < 1.001 * np.sqrt(np.diag(errors))).all()
    momentum = np.linalg.norm(run["truth"]["rate"] @ config.craft.inertia_matrix(), axis=1)
    isolated = np.searchsorted(run["truth"]["time_ns"], event["time_ns"])
    seconds = BROKEN - event["time_ns"] * 1e-9
    assert (momentum[isolated] - momentum[-1]) / (seconds * FIELD * 0.35) > 0.1
    assert not {row["name"] for row in run["event"]} & {b"task-failed", b"blind", b"control-lost"}


@pytest.mark.parametrize(("axes", "duration"), [("xy", 60.0), ("xyy", 20.0)])
def test_a_satellite_with_coils_in_a_plane_detumbles_and_no_coil_is_accused(
    axes: str, duration: float, tmp_path: Path
) -> None:
    path = FOLDER / "orbit.yaml"
    config = without_cameras(as_orbit(configuration.load(path)), duration)
    windings = []
    for index, axis in enumerate(axes):
        coil = config.coils.windings["xyz".index(axis)]
        windings.append(configuration.replace(coil, channels=(2 * index, 2 * index + 1)))
    coils = configuration.replace(config.coils, windings=tuple(windings))
    section = configuration.simulation_section(path.read_text(encoding="utf-8"), str(path), Simulation)
    run = fly(configuration.replace(config, coils=coils), tmp_path, section=section)
    count = len(axes)
    # The packet `truth` contains three currents; the currents of more coils are in a separate packet.
    carried = np.abs(run["truth" if count < 3 else "true_coil_currents"]["current"]).max(axis=0)
    assert (carried[:count] > 0.1).all()
    # The flight application assumes a coil normal to the plane, and treats it as broken.
    assert carried[count] == 0.0
    assert np.isnan(run["run"]["coil_resistance"][0]).tolist() == [k >= count for k in range(3)]
    assert {int(used) for used in run["health"]["coils_in_use"]} == {2**count - 1}
    assert not {row["name"] for row in run["event"]} & {b"coil-broken", b"coil-suspect", b"coil-corrected"}
    momentum = np.linalg.norm(run["truth"]["rate"] @ config.craft.inertia_matrix(), axis=1)
    assert momentum[-1] < (1.0 - 0.1 * duration / 60.0) * momentum[0]
