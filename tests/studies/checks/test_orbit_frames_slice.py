"""Runs twenty seconds of the campaign `orbit-frames` in sunlight at a fixed seed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ground.campaigns.runner import Case
from tests.studies.campaigns.orbit_frames import ORBIT_FRAMES, VARIANTS, run


def test_rendered_frames_start_the_filter_and_keep_it_within_its_claim(tmp_path: Path) -> None:
    parameters = {**VARIANTS["level"], "variant": "level", "period": 4.0, "seconds": 2000.0, "until": 20.0}
    result = run(Case("level/0", (5, 0, 0), parameters))
    notes = np.array(result["instants"])
    assert len(notes) == 5
    assert result["starts"] == 1
    assert np.isfinite(notes[-1, 2:9]).all()
    # The limit applies to the errors across nadir (body z). The rotation about nadir is determined by the Sun
    # or, in this run, by the magnetic field.
    assert np.abs(notes[-1, 2:4]).max() < 0.15
    assert np.all(np.abs(notes[-1, 2:5]) < 5.0 * notes[-1, 5:8])
    assert (notes[:, 10] > 0).any(), "a nadir of the cameras' limbs"
    assert notes[:, 12].max() < 500.0, "ms of processor: the budget of 2 Hz, twenty times what it takes"
    summary = ORBIT_FRAMES.summarise([result], tmp_path)
    json.dumps(summary.facts)
    assert "level" in summary.text
