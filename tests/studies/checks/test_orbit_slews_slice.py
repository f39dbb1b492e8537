"""A slice of the campaign `orbit-slews`: a planned path ends in its target, at little more than its heat."""

from __future__ import annotations

from pathlib import Path

from tests.studies.campaigns import orbit_slews
from tests.studies.campaigns.campaign import Case


def test_a_planned_path_is_held_at_little_more_than_its_heat(tmp_path: Path) -> None:
    """The third slew of seed 1 of the KnightCube: 149 deg in 300 s, without the torques that are learned."""
    parameters = {"craft": "knightcube", "orbit": "sso", "law": "path", "share": 0.0, "learn": 60.0}
    path = orbit_slews.run(Case("path", (1, 2), parameters))
    assert path["off"] <= orbit_slews.WANTED["knightcube"]
    assert path["heat"] <= 1.3 * path["optimum"]
    facts = orbit_slews.summarise([{**path, "share": 0.1}], tmp_path).facts
    assert facts["knightcube/path/0.1"]["within"] == 1.0
