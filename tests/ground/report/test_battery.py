"""Tests of the battery section of the report, from packets with known values."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from ground.report import draw, format_report, summarise
from tests.support.packed_run import packed_run

CHARGES = (0.5, 0.45, 0.35, math.nan, 0.25, 0.6)
SHED = (0, 0, 1, 1, 2, 0)


def test_the_report_states_charge_energies_and_shed_loads(tmp_path: Path) -> None:
    rows = [
        (float(k), {"charge": charge, "shed": shed, "energy_in": 3.0 * k, "energy_out": 5.0 * k})
        for k, (charge, shed) in enumerate(zip(CHARGES, SHED, strict=True))
    ]
    powers = {"solar_power": 2.0, "load_power": 3.0, "coil_power": 1.0}
    true = [(float(k), {"charge": 0.4, **powers}) for k in range(6)]
    run = packed_run(power=rows, true_power=true, event=[(0.0, {"name": "started", "code": 1})])
    summary = summarise(run)
    found = summary["battery"]
    assert found["charge_lowest"] == pytest.approx(0.25)
    assert found["charge_last"] == pytest.approx(0.6)
    assert found["known_share"] == pytest.approx(5 / 6)
    assert (found["in_j"], found["out_j"]) == (15.0, 25.0)
    assert found["shed_s"] == {"coils-limited": 3.0, "camera-slower": 1.0, "safe": 0.0}
    errors = (0.1, 0.05, -0.05, -0.15, 0.2)
    assert found["charge_error_rms"] == pytest.approx(math.sqrt(sum(x * x for x in errors) / 5))
    assert (found["solar_j"], found["loads_j"], found["coils_j"]) == (12.0, 18.0, 6.0)
    late = summarise(packed_run(power=rows, true_power=true[4:]))["battery"]
    assert late["charge_error_rms"] == pytest.approx(math.sqrt((0.15**2 + 0.2**2) / 2))
    gaps = summarise(packed_run(power=rows, true_power=[*true[:2], *true[4:]]))["battery"]
    assert (gaps["solar_j"], gaps["loads_j"], gaps["coils_j"]) == (12.0, 18.0, 6.0)
    text = format_report(summary)
    assert "state of charge, estimated: lowest 25.0 %, at the end 60.0 %" in text
    assert "shed: coils-limited 3 s, camera-slower 1 s, safe 0 s" in text
    assert tmp_path / "battery.png" in draw(run, tmp_path)


def test_a_run_without_a_power_system_has_no_such_section() -> None:
    summary = summarise(packed_run(event=[(0.0, {"name": "started", "code": 1})]))
    assert "battery" not in summary
    assert "Battery" not in format_report(summary)
