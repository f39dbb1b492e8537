"""Tests that each measured value is stated on exactly one page."""

from __future__ import annotations

import math

import pytest

from sim_hal.star_camera import StarCameraModel
from tests.docs.blocks import ROOT
from tests.support.scenes import EXPOSURES, FIELD


def _rows(page: str) -> dict[str, list[str]]:
    """Return the cells of all table rows of a page by their first cell."""
    lines = (ROOT / page).read_text(encoding="utf-8").replace(r"\|", "¦").splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| ")]
    return {first: others for first, *others in cells}


@pytest.mark.parametrize("page", ["README.md", "docs/results/testbed.md"])
def test_the_power_of_the_thesis_is_stated_beside_the_power_from_the_supply(page: str) -> None:
    rows = [first for first, others in _rows(page).items() if "0.10 W" in others]
    assert rows
    assert all("from the supply" in first and "R I²" not in first for first in rows)


def test_the_page_of_streaks_states_the_camera_of_its_campaigns() -> None:
    camera, (short, long) = StarCameraModel(field_of_view=FIELD), EXPOSURES
    head = (ROOT / "docs/results/streaks.md").read_text(encoding="utf-8").partition("\n## ")[0]
    assert f"{camera.columns} x {camera.rows} pixels over {math.degrees(FIELD):.0f} degrees" in head
    assert f"exposures of {short:g} and {long:g} s" in head


def test_the_readme_has_the_figures_of_the_results_page() -> None:
    quoted = {
        first: cells for first, cells in _rows("README.md").items() if "power" in first or "worst" in first
    }
    stated = _rows("docs/results/testbed.md")
    assert len(quoted) == 4
    for first, (thesis, here) in quoted.items():
        assert (thesis, here) == (stated[first][0], stated[first][2]), first
