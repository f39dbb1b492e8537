"""Runs a small slice of the campaign `gyro-dead` at a fixed seed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from tests.studies.campaigns.gyro_dead import cases, run, summarise


def test_a_tumbling_satellite_without_a_gyro_knows_attitude_and_rate_within_its_claims(
    tmp_path: Path,
) -> None:
    """Attitude and rate are known within seconds of the first star attitude."""
    case = next(case for case in cases(1, 3) if case.key == "orbit/0")
    result = run(replace(case, parameters={**case.parameters, "duration": 30.0}))
    assert result["at"] == 0.0
    assert result["stars"] >= 3
    assert result["rates"] >= 2
    assert not result["safe"]
    assert not result["failed"]
    assert max(result["nees_attitude"], result["nees_rate"]) < 1.5
    (row,) = summarise([result], tmp_path).facts["rows"]
    assert (row["flights"], row["arrived"], row["nadir_rms_deg"]) == (1, 0, 180.0)
    json.dumps(row, allow_nan=False)


def test_a_step_without_gyro_and_camera_is_reached_within_realistic_uncertainty(tmp_path: Path) -> None:
    case = next(case for case in cases(1, 3) if case.key == "dark/0")
    result = run(replace(case, parameters={**case.parameters, "duration": 34.0}))
    assert (result["steps"], result["reached"], result["failed"]) == (1, 1, 0)
    assert result["reported"]
    assert max(result["nees_angle"], result["nees_rate"]) < 1.5
    (row,) = summarise([result], tmp_path).facts["rows"]
    assert (row["flights"], row["camera"], row["worst_deg"]) == (1, False, result["worst_deg"])
    json.dumps(row, allow_nan=False)
