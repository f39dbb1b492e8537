"""Tests of `python -m tests.studies.bench`: benchmarks by name, and measures of the streak benchmarks."""

from __future__ import annotations

import re
import sys

import pytest

from flight.schema import reader as configuration
from tests.studies.bench import __main__ as bench
from tests.studies.bench.executive import Load, full_load
from tests.studies.bench.mid_exposure import SOLUTIONS, attitude_rows


def test_every_bench_is_listed_with_one_line_and_none_is_imported(capsys: pytest.CaptureFixture[str]) -> None:
    before = set(sys.modules)
    assert bench.main([]) == 0
    listed = capsys.readouterr().out
    for name, line in bench.benches().items():
        assert f"  {name}" in listed
        assert line in listed
        assert line
    assert {"executive", "starid", "likelihood", "plan"} <= bench.benches().keys()
    assert not {name for name in set(sys.modules) - before if name.startswith("tests.studies.bench.")}


def test_an_unknown_bench_is_wrong_use(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        bench.main(["nothing"])
    assert stopped.value.code == 2
    assert "likelihood" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["plan", "likelihood", "mid_exposure"])
def test_a_bench_gets_its_own_arguments(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Test a main function that takes a list of arguments, and one that reads the command line."""
    with pytest.raises(SystemExit) as stopped:
        bench.main([name, "--help"])
    assert stopped.value.code == 0
    assert re.search(rf"python -m tests.studies[. ]bench {name}", capsys.readouterr().out)


def test_the_bench_of_the_attitudes_asks_the_tracker_before_and_after_the_sky_is_known() -> None:
    """Solve one frame of long streaks: both attitudes are within some sigmas of the truth."""
    rows = attitude_rows(30.0, 1, 5, 8.5, 0.2)
    assert [row["solution"] for row in rows] == list(SOLUTIONS)
    for row in rows:
        assert row["attitudes"] == 1
        assert 0.0 < row["over_bound"] < 6.0
        assert 0.0 < row["over_claimed"] < 4.0
        assert 0.0 < row["rate_over_bound"] < 4.0
    assert rows[0]["rms_px"] != rows[1]["rms_px"]


def test_the_executive_flies_testbed_and_satellite_with_workers_that_hardly_rest() -> None:
    for orbit in (False, True):
        config = configuration.parse(full_load(Load(600.0, camera_period=0.4, orbit=orbit)))
        assert config.body == ("orbit" if orbit else "testbed")
        assert config.camera is not None
        assert config.camera.period == 0.4
        assert config.replan_period() == (10.0 if orbit else 0.025)
