"""The pages compare the thesis's power consumption with the power from the supply, not with R I^2."""

from __future__ import annotations

import pytest

from tests.docs.blocks import ROOT


@pytest.mark.parametrize("page", ["README.md", "docs/results/testbed.md"])
def test_the_thesis_s_power_stands_beside_the_power_from_the_supply(page: str) -> None:
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    rows = [line for line in lines if line.startswith("|") and "0.10 W" in line]
    assert rows
    assert all("from the supply" in row and "R I²" not in row for row in rows)
