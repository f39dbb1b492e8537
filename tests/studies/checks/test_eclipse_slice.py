"""Slices of the campaign of the eclipse: a minute or two with stars, and as long into the shadow without."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.studies.campaigns import eclipse
from tests.studies.campaigns.campaign import Case

LIT, BLIND, SECONDS = 90.0, 40.0, 130.0


def test_the_loop_is_judged_with_stars_and_without_in_sunlight_and_shadow() -> None:
    given = {"lit": LIT, "blind": BLIND, "settled": 25.0, "last": 20.0, "seconds": SECONDS}
    result = eclipse.run(Case("slice", (9, 1), {"kind": "loop", "craft": "cubesat_3u", **given}))
    assert result["shadow_s"] == pytest.approx(SECONDS - LIT, abs=2.0)
    assert result["dark_share"] > 0.85, "the shadow begins when it is said to"
    assert result["stars"]["rms_deg"] < 0.01
    for part in ("sunlit", "eclipse"):
        assert result["stars"]["claim_deg"] < result[part]["claim_deg"] < 0.3, "no star was used"
        assert result[part]["rms_deg"] < 0.1
        assert result[part]["sigmas"] < 5.0


def test_the_filter_is_judged_with_stars_and_at_the_end_of_the_shadow(tmp_path: Path) -> None:
    given = {"learned": 100.0, "settled": 60.0, "last": 60.0, "seconds": 240.0}
    results = [
        eclipse.run(Case("slice", (9, run), {"kind": "filter", "craft": "knightcube", **given}))
        for run in range(2)
    ]
    for result in results:
        assert result["shadow_s"] == pytest.approx(240.0)
        assert result["learned_s"] > 100.0
        assert result["stars"]["rms_deg"] < 0.02
        assert result["stars"]["claim_deg"] < result["eclipse"]["claim_deg"] < 1.0, "no star was used"
        assert result["eclipse"]["rms_deg"] < 1.0
        assert result["eclipse"]["sigmas"] < 5.0
    table = eclipse.summarise(results, tmp_path)
    found = table.facts["filter/knightcube/eclipse"]
    assert found["flights"] == 2
    assert found["worst"] == pytest.approx(max(r["eclipse"]["rms_deg"] for r in results))
    assert "filter/knightcube/sunlit" not in table.facts
