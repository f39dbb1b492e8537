"""Computes parts of the tables of the three source documents, and tests the list of these tables."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.studies import sources
from tests.studies.__main__ import names

RESULTS = Path(__file__).resolve().parents[3] / "docs" / "results"
SEED = 77


def test_image_matching_reaches_the_q_method_and_a_wrong_prior_needs_further_steps() -> None:
    """In three lists per cell, a prior error of 5 deg has an effect after one step, but none after four."""
    head, *rows = sources.image_matching_errors(3, SEED)
    assert head[-1] == "4 steps"
    assert [row[1] for row in rows] == 2 * ["0.01", "0.1", "1", "5"]
    for row in rows:
        optimal, *steps = (float(cell) for cell in row[2:])
        assert steps[-1] == pytest.approx(optimal, rel=0.03)
        if row[1] == "5":
            assert steps[0] > 3.0 * optimal
        if row[1] == "0.01":
            assert steps[0] == pytest.approx(optimal, rel=0.1)


@pytest.mark.slow
def test_limits_of_eq_31_identify_the_lists_that_limits_of_angles_identify() -> None:
    _, *rows = sources.cosine_limits(2, SEED)
    for row in rows[:3]:
        assert row[2] == row[3]
        assert row[2].endswith("; 0")
    assert int(rows[0][2].split(";")[0]) == 2


@pytest.mark.slow
def test_one_frame_gives_rate_and_axis_within_the_theses_figures() -> None:
    """One frame of each scene is estimated by two methods.

    Table 4.1 of the thesis states 0.9 % and 0.65 deg.
    """
    _, *rows = sources.one_frame_tables(1, SEED)
    assert [row[1] for row in rows] == 2 * ["`harris`", "`likelihood`"]
    for row in rows:
        assert row[2] == "1 of 1"
        for cell in row[3:]:
            printed, here = (float(value) for value in cell.split("; "))
            assert here < max(printed, 0.65)


def test_the_list_names_studies_that_exist(capsys: pytest.CaptureFixture[str]) -> None:
    assert sources.main([]) == 0
    listed = capsys.readouterr().out
    for _, commands in sources.INDEX:
        assert commands in listed
        assert commands.startswith("(") or {part.split()[0] for part in commands.split("; ")} <= set(names())
    for table in re.findall(r"sources ([a-z0-9-]+)", listed):
        assert table in sources.TABLES


def test_every_measured_table_is_on_a_results_page() -> None:
    pages = "".join(path.read_text(encoding="utf-8") for path in RESULTS.glob("*.md"))
    for table in sources.TABLES:
        assert f"`sources {table} --runs" in pages, table
    assert sources.markdown([["a", "b"], ["1", ""]]) == "| a | b |\n| --- | --- |\n| 1 | |\n"
