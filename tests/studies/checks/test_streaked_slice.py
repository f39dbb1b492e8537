"""Runs a small slice of the campaign `streaked`: attitude errors agree with claims for any shutter."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ground.campaigns.runner import Case
from tests.studies.campaigns.resting import STREAKS, streaked_run, summarise

SEED = 18


def _flown(row: str, runs: int) -> list[dict[str, object]]:
    cells = [(f"{row} {length:g} {n}", n, length) for length in STREAKS for n in range(runs)]
    return [streaked_run(Case(key, (SEED, n), {"row": row, "trail": length})) for key, n, length in cells]


def test_an_unspecified_rolling_shutter_is_in_the_claim(tmp_path: Path) -> None:
    """If the covariance ignored the unknown shutter, errors would reach 7 sigma, or 0.4 px."""
    own = summarise(_flown("rolling 30 us, unstated", 2), tmp_path).facts["all"]
    assert own["attitudes"] == own["frames"] == 6
    assert own["worst"] < 4.5
    assert own["off"] < 0.03


def test_a_specified_shutter_does_not_increase_the_claim(tmp_path: Path) -> None:
    """On the same frames, the claimed uncertainty is larger if the line time is not known.

    The two fits of a frame find slightly different widths of the streaks, which also change the claimed
    uncertainty. Therefore, one of the six frames may be an exception.
    """
    flown = [_flown(f"rolling 0 us, {how}", 2) for how in ("stated", "unstated")]
    for results in flown:
        own = summarise(results, tmp_path).facts["all"]
        assert own["attitudes"] == 6
        assert own["worst"] < 4.5
        assert own["claim"] < 0.03
    stated, unstated = (
        np.array([np.trace(np.array(frame["covariance"])[:2, :2]) for frame in results]) for results in flown
    )
    assert np.count_nonzero(stated < unstated) >= 5
