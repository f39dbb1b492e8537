"""Slices of the campaigns of a free satellite under its coils."""

from __future__ import annotations

from pathlib import Path

from tests.studies.campaigns import detumble, orbit_pointing
from tests.studies.campaigns.campaign import Case

CASE = {"craft": "knightcube", "orbit": "sso"}


def test_a_tumbling_knightcube_stops_and_the_table_says_when(tmp_path: Path) -> None:
    result = detumble.run(Case("a", (20_261_123, 0), {**CASE, "law": "attitude", "speed": 0.014}))
    assert not result["lost"]
    assert result["seconds"] < 200.0
    found = detumble.summarise([result], tmp_path)
    assert found.facts["knightcube/attitude"]["worst"] == result["seconds"]
    assert "knightcube" in found.text


def test_the_magnetometer_alone_knows_the_rate_that_the_coils_brake() -> None:
    wanted = {**CASE, "law": "magnetometer", "speed": 0.1, "longest": 40.0, "spikes": 0.05}
    result = detumble.run(Case("m", (20_261_123, 1), wanted))
    assert result["lost"], "40 s are too short"
    assert result["square"] > 0.0
    assert result["rate"] < 0.2


def test_a_body_that_did_not_stop_is_counted_as_lost(tmp_path: Path) -> None:
    case = Case("lost", (1, 0), {"craft": "cubesat_3u", "law": "attitude", "orbit": "iss", "longest": 3.0})
    result = detumble.run(case)
    assert result["lost"]
    assert detumble.summarise([result], tmp_path).facts["cubesat_3u/attitude"]["lost"] == 1


def test_a_satellite_that_starts_with_nothing_learned_points_and_knows_its_attitude(tmp_path: Path) -> None:
    parameters = {"craft": "cubesat_3u", "share": 0.1, "law": "whole", "revolutions": 0.03}
    flight = orbit_pointing.run(Case("slice", (20_261_123, 1), parameters))
    assert not flight["lost"]
    longer = {**flight, "rms": 0.5, "nadir_rms": 0.3, "worst": 1.0, "knowledge_rms": 0.004, "nees": 1.0}
    longer |= {"dipole_missing": [1e-4, None], "mean_square": 1e-6}
    found = orbit_pointing.summarise([longer], tmp_path)
    assert found.facts["cubesat_3u/0.1/whole"]["runs"] == 1
    assert "cubesat_3u, 0.1, whole" in found.text
