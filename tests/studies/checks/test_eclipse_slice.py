"""Runs slices of the campaign `eclipse`: one or two minutes with stars, and the same time in shadow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ground.campaigns.runner import Case
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.free_filter import FilterEnvironment
from tests.studies.campaigns import eclipse
from tests.studies.campaigns.orbit_pointing_flight import CYCLE


def test_the_filter_is_judged_with_stars_and_at_the_end_of_the_shadow(tmp_path: Path) -> None:
    given = {"learned": 100.0, "settled": 60.0, "last": 60.0, "seconds": 240.0}
    results = [
        eclipse.run(Case("slice", (9, run), {"kind": "filter", "craft": "knightcube", **given}))
        for run in (6, 13)  # in both cases the shadow begins within five minutes
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


class Driven(eclipse.DarkFlight):
    """A flight in which one coil after another gives nearly its full moment, in both directions."""

    def _plan(self, time: float) -> None:
        pass

    def _command(self, time: float, around: FilterEnvironment) -> FloatArray:
        axis, back = divmod(int(time / CYCLE) // 2 % 6, 2)
        dipole = np.zeros(3)
        dipole[axis] = (0.09, -0.09)[back]
        return dipole


def test_a_body_that_is_driven_hard_is_known_within_its_claim() -> None:
    """Compare the gyro's mean rate over a pause and a command with the filter's mean over the same time."""
    flight, off, speeds = Driven("knightcube", 5), [], []
    for cycle in range(60):
        flight.cycle(cycle * CYCLE)
        error, claim, _ = flight.error()
        off.append(error / claim)
        speeds.append(float(np.linalg.norm(flight.flight.motion.rate)))
    assert max(speeds) > np.radians(0.5)
    assert np.abs(off).max() < 4.0
    assert np.mean(np.square(off)) < 1.8


def test_a_storm_is_added_to_the_field_that_is_measured() -> None:
    storm, calm = (eclipse.DarkFlight("knightcube", 5, size) for size in (5e-8, 0.0))
    added = np.linalg.norm(storm.flight.field_error)
    assert 1e-8 < added < 2e-7
    assert np.linalg.norm(storm.flight.field() - calm.flight.field()) == pytest.approx(added)
