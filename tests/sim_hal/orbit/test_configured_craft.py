"""The craft of each orbit configuration is the true one, and the one that the campaigns judge."""

from __future__ import annotations

from pathlib import Path

import pytest

from flight.schema import reader
from flight.schema.orbit import as_orbit
from sim_hal.settings import Simulation
from sim_hal.worlds.free_body import CRAFTS
from tests.support.pointing_settings import WEIGHTS

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


@pytest.mark.parametrize(("name", "craft"), [("orbit.yaml", "knightcube"), ("orbit_3u.yaml", "cubesat_3u")])
def test_the_campaign_of_pointing_judges_the_weights_that_are_flown(name: str, craft: str) -> None:
    flown, judged = as_orbit(reader.load(FOLDER / name)).pointing, WEIGHTS[craft]
    for weight in ("turn", "rate", "dipole", "roll"):
        assert getattr(flown, weight) == pytest.approx(getattr(judged, weight), rel=0.01), weight
