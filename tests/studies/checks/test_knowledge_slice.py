"""Runs a small slice of the campaigns `aged-elements` and `calendar` at a fixed seed."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest

from ground.campaigns.runner import Case
from knightcube.astro.earth.orbit_knowledge import TwoLineElements
from tests.studies.campaigns.knowledge import (
    AGED_ELEMENTS,
    CALENDAR,
    FALSE,
    HONEST,
    LEAP,
    ROLLOVER,
    USED_WITHIN,
    fly_month,
    lines,
    months,
    run,
)


@pytest.mark.parametrize("kind", ["good", "silent", *FALSE])
def test_claims_with_old_elements_are_honest_and_only_good_fixes_are_used(kind: str) -> None:
    result = run(Case("slice", (7, 2), {"kind": kind, "step": 20}))
    assert result["worst"] <= HONEST
    assert result["unknown"] == 0
    if kind == "good":
        assert result["first_use_s"] <= USED_WITHIN
    else:
        assert result["used"] == 0
    json.dumps(AGED_ELEMENTS.summarise([result], Path()).facts, allow_nan=False)


@pytest.mark.parametrize(
    ("craft", "utc"),
    [
        ("orbit", "2026-01-15"),
        ("orbit_3u", "2031-07-15"),
        ("orbit", "2036-12-15"),
        ("orbit_3u", ROLLOVER),
        ("orbit", LEAP),
    ],
)
def test_place_sun_field_shadow_and_attitude_are_known_throughout_the_mission(craft: str, utc: str) -> None:
    """The cases are two ordinary dates, the rollover of the GPS week, and a leap second."""
    [case] = [case for case in months(132, 1) if case.key.startswith(f"{craft}.yaml/{utc}")]
    result = fly_month(case)
    assert (result["unknown"], result["eclipse_wrong"]) == (0, 0)
    assert result["worst"] <= HONEST
    assert result["field_sigmas"] <= HONEST
    assert result["attitude_sigmas"] <= HONEST
    assert result["attitude_deg"] < 5.0
    assert result["sun_deg"] < 0.05
    assert result["used"] == (94 if utc != LEAP else pytest.approx(87, abs=1))
    assert result["dark"] > 0
    json.dumps(CALENDAR.summarise([result], Path()).facts, allow_nan=False)


def test_elements_are_written_with_their_drag() -> None:
    for drag in (0.0, 5e-4, 0.99999e-3, -3.2e-5):
        made = lines(datetime(2031, 7, 1, 6, tzinfo=UTC), drag, [97.4, 1.0, 0.001, 2.0, 3.0], 15.2)
        assert TwoLineElements(*made).epoch == pytest.approx(2463049.75)
