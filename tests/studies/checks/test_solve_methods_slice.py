"""Runs one frame of the benchmark `solve_methods`."""

from __future__ import annotations

import pytest

from knightcube.astro.attitude.solvers import OPTIMAL, SOLVERS
from knightcube.vision.startracker.survey import CENTROIDS
from tests.studies.bench.solve_methods import compare


def test_every_solver_and_centroid_solves_a_frame_and_the_optimal_solvers_agree() -> None:
    """All optimal solvers minimise the same loss, so they differ by rounding only."""
    rows = {(row.centroid, row.attitude): row for row in compare(1, 5)}
    assert len(rows) == len(CENTROIDS) * (len(SOLVERS) + len(("image", "aim")))
    for (centroid, attitude), row in rows.items():
        assert row.solved == 1
        assert row.across < 2.0
        if attitude in OPTIMAL:
            assert row.across == pytest.approx(rows[centroid, "davenport"].across, abs=1e-5)
    assert rows["psf", "image"].across < rows["psf", "triad"].across
