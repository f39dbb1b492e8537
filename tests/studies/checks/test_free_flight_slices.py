"""Slices of the campaigns of a free satellite under its coils."""

from __future__ import annotations

from pathlib import Path

from tests.studies.campaigns import detumble
from tests.studies.campaigns.campaign import Case


def test_a_tumbling_knightcube_stops_by_either_law_and_the_table_says_when(tmp_path: Path) -> None:
    results = [
        detumble.run(
            Case(law, (20_261_123, 0), {"craft": "knightcube", "law": law, "orbit": "sso", "speed": 0.03})
        )
        for law in detumble.LAWS
    ]
    assert not any(result["lost"] for result in results)
    assert max(result["seconds"] for result in results) < 400.0
    found = detumble.summarise(results, tmp_path)
    assert found.facts["knightcube/attitude"]["worst"] == results[1]["seconds"]
    assert "magnetometer" in found.text


def test_a_body_that_did_not_stop_is_counted_as_lost(tmp_path: Path) -> None:
    case = Case("lost", (1, 0), {"craft": "cubesat_3u", "law": "attitude", "orbit": "iss", "longest": 3.0})
    result = detumble.run(case)
    assert result["lost"]
    assert detumble.summarise([result], tmp_path).facts["cubesat_3u/attitude"]["lost"] == 1
