"""A small slice of the campaign of streaks: attitudes within their claims, whatever the shutter."""

from __future__ import annotations

from pathlib import Path

from ground.campaigns.runner import Case
from tests.studies.campaigns.streaked import STREAKED, STREAKS, run

SEED = 18


def _flown(row: str, runs: int) -> list[dict[str, object]]:
    cells = [(length, n) for length in STREAKS for n in range(runs)]
    return [
        run(Case(f"{row} {length:g} {n}", (SEED, n), {"row": row, "trail": length})) for length, n in cells
    ]


def test_a_rolling_shutter_that_nobody_described_is_in_the_claim(tmp_path: Path) -> None:
    """Such attitudes were up to 7 sigma off, and 0.4 px of their claimed 0.05."""
    own = STREAKED.summarise(_flown("rolling 30 us, unstated", 2), tmp_path).facts["all"]
    assert own["attitudes"] == own["frames"] == 6
    assert own["worst"] < 4.5
    assert own["off"] < 0.03


def test_a_shutter_that_is_described_costs_nothing(tmp_path: Path) -> None:
    """Of the same frames, the claim where nothing is described is the wider one."""
    stated, unstated = (
        STREAKED.summarise(_flown(f"rolling 0 us, {how}", 2), tmp_path).facts["all"]
        for how in ("stated", "unstated")
    )
    assert stated["attitudes"] == unstated["attitudes"] == 6
    assert max(stated["worst"], unstated["worst"]) < 4.5
    assert stated["claim"] < unstated["claim"] < 0.03
