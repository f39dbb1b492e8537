"""The shipped satellites with other coils, sizes and orbits detumble in the loop."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight.schema import reader as configuration
from flight.schema.document import FOLDER
from flight.schema.orbit import as_orbit
from sim_hal.settings import Simulation
from tests.support.flights import fly
from tests.support.unlike_body import without_cameras

SECONDS, FIELD = 60.0, 3.0e-5
"""s and T."""


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
    # The true coils differ from the described ones by their gains and directions only.
    true = run["true_description"]["coils"][0].reshape(3, 3)
    assert np.abs(true - np.eye(3)).max() < 0.45


def test_a_satellite_with_two_coils_detumbles_and_no_coil_is_accused(tmp_path: Path) -> None:
    path = FOLDER / "orbit.yaml"
    config = without_cameras(as_orbit(configuration.load(path)), SECONDS)
    coils = configuration.replace(config.coils, windings=config.coils.windings[:2])
    section = configuration.simulation_section(path.read_text(encoding="utf-8"), str(path), Simulation)
    run = fly(configuration.replace(config, coils=coils), tmp_path, section=section)
    carried = np.abs(run["truth"]["current"]).max(axis=0)
    assert (carried[:2] > 0.1).all()
    assert carried[2] == 0.0
    assert not np.nan_to_num(run["control"]["current_command"])[:, 2].any()
    assert np.isnan(run["run"]["coil_resistance"][0]).tolist() == [False, False, True]
    assert {int(used) for used in run["health"]["coils_in_use"]} == {0b011}
    assert not {row["name"] for row in run["event"]} & {b"coil-broken", b"coil-suspect", b"coil-corrected"}
    momentum = np.linalg.norm(run["truth"]["rate"] @ config.craft.inertia_matrix(), axis=1)
    assert momentum[-1] < 0.9 * momentum[0]
