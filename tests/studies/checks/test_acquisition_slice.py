"""Runs one case of the campaign `acquisition` in the whole loop, with stars in view."""

from __future__ import annotations

import math
from pathlib import Path

from ground.campaigns.runner import Case
from tests.studies.campaigns import acquisition


def test_a_flight_is_judged_by_when_it_knew_its_attitude_and_how_well(tmp_path: Path) -> None:
    result = acquisition.run(Case("slice", (11, SEEING), {"duration": 24.0}))
    assert result["fine_s"] < 15.0
    assert result["rms_deg"] < 0.05
    assert result["worst_sigmas"] < 5.0
    table = acquisition.summarise([result, {**result, "fine_s": math.inf, "rms_deg": None}], tmp_path)
    (found,) = table.facts.values()
    assert (found["flights"], found["within"], found["never"]) == (2, 1, 1)


SEEING = 2
"""Number of a flight that starts with the Sun and the lit Earth outside the camera's field."""
