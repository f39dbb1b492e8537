"""The true craft of each orbit configuration is the one that its flight software believes."""

from __future__ import annotations

from pathlib import Path

import pytest

from flight.schema import reader
from flight.schema.orbit import as_orbit
from sim_hal.settings import Simulation
from sim_hal.worlds.free_body.craft import CRAFTS

FOLDER = Path(__file__).resolve().parents[3] / "config"


@pytest.mark.parametrize("name", ["orbit.yaml", "orbit_3u.yaml", "orbit_object.yaml", "orbit_object_1u.yaml"])
def test_the_believed_coils_and_inertia_are_the_true_ones(name: str) -> None:
    """Errors of a few per cent are drawn by the seed; other coils than believed are a wrong configuration."""
    believed = as_orbit(reader.load(FOLDER / name)).craft
    text = (FOLDER / name).read_text(encoding="utf-8")
    section = reader.simulation_section(text, name, Simulation)
    assert section is not None
    assert section.free_body is not None
    true = section.free_body.craft
    craft = CRAFTS[true] if isinstance(true, str) else true
    assert believed.dipole_per_ampere == pytest.approx(craft.dipole_per_ampere, rel=0.01)
    assert believed.inertia == pytest.approx(craft.inertia, rel=0.01)
