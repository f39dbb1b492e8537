"""Runs slices of the campaigns of a free satellite that is controlled by coils."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ground.campaigns.runner import Case
from tests.studies.campaigns import detumble, orbit_pointing

CASE = {"craft": "knightcube", "orbit": "sso"}


def test_a_tumbling_knightcube_stops_and_the_table_states_the_time(tmp_path: Path) -> None:
    result = detumble.run(Case("a", (20_261_123, 0), {**CASE, "law": "attitude", "speed": 0.014}))
    assert not result["lost"]
    assert result["seconds"] < 400.0
    assert 0.0 < result["least"] <= result["seconds"], "no control beats the bound"
    assert result["fastest_deg"] < 1.3 * np.degrees(0.014), (
        "only the gyro's bias and a held dipole may add to the rate"
    )
    found = detumble.summarise([result], tmp_path)
    assert found.facts["knightcube/attitude/sso+iss"]["worst"] == result["seconds"]
    assert "knightcube" in found.text


def test_the_magnetometer_alone_knows_the_rate_that_the_coils_brake() -> None:
    """The component along the field becomes observable as the field rotates; some samples are outliers."""
    wanted = {**CASE, "law": "magnetometer", "speed": 0.1, "longest": 400.0, "spikes": 0.05}
    result = detumble.run(Case("m", (20_261_123, 1), wanted))
    assert not result["lost"]
    assert result["square"] > 0.0
    assert result["fastest_deg"] < 30.0


def test_a_body_whose_inertia_is_not_known_stops_above_the_bound() -> None:
    wanted = {**CASE, "orbit": "equator", "law": "inertia", "speed": 0.05}
    result = detumble.run(Case("i", (20_261_123, 2), wanted))
    assert not result["lost"]
    assert 0.0 < result["least"] <= result["seconds"]


def test_a_body_that_did_not_stop_is_counted_as_lost(tmp_path: Path) -> None:
    case = Case("lost", (1, 0), {"craft": "cubesat_3u", "law": "attitude", "orbit": "iss", "longest": 3.0})
    result = detumble.run(case)
    assert result["lost"]
    assert detumble.summarise([result], tmp_path).facts["cubesat_3u/attitude/sso+iss"]["lost"] == 1


def test_a_satellite_that_starts_with_nothing_learned_turns_to_its_target(tmp_path: Path) -> None:
    """A KnightCube starts 60 deg off nadir.

    The planner's slew of 300 s rotates it to nadir, as in the loop.
    """
    parameters = {"craft": "knightcube", "share": 0.1, "target": "nadir"}
    start = {"kind": "turn", "turn_deg": 60.0, "speed_deg": 0.1, "seconds": 340.0}
    turn = orbit_pointing.run(Case("turn", (20_261_123, 1), parameters | start))
    assert not turn["lost"]
    assert 250.0 < turn["first"] < 330.0
    hold = {
        **parameters,
        "kind": "hold",
        "hours": 4.0,
        "lost": False,
        "rms": 0.5,
        "nadir_rms": 0.3,
        "worst": 1.0,
    }
    hold |= {
        "nadir_worst": 0.8,
        "knowledge_rms": 0.004,
        "nees": 1.0,
        "dipole_missing": [1e-4, None],
        "mean_square": 1e-6,
    }
    found = orbit_pointing.summarise([hold, turn], tmp_path)
    assert found.facts["hold"]["hold/knightcube/0.1"]["runs"] == 1
    assert found.facts["turn"]["turn/knightcube/0.1"]["median"] is None
    assert found.facts["turn"]["turn/knightcube/0.1"]["arrived"] == 0, "a flight of six minutes shows no stay"
    assert "turn/knightcube/0.1" in found.text
