"""`python -m tests.studies.bench`: benches by name; and what the benches of the streaks measure with."""

from __future__ import annotations

import re
import sys

import numpy as np
import pytest

from flight.schema import reader as configuration
from sim_hal.star_camera import StarCameraModel
from tests.studies.bench import __main__ as bench
from tests.studies.bench.executive import Load, full_load
from tests.studies.bench.mid_exposure import FITS, SOLUTIONS, Seen, attitude_row
from tests.support.scenes import FIELD, slew


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
    """Of a main with a list of arguments, and of a main that reads the command line."""
    with pytest.raises(SystemExit) as stopped:
        bench.main([name, "--help"])
    assert stopped.value.code == 0
    assert re.search(rf"python -m tests.studies[. ]bench {name}", capsys.readouterr().out)


def test_the_attitude_of_perfect_places_is_exact_and_a_displaced_star_is_singled_out() -> None:
    camera = StarCameraModel(field_of_view=FIELD)
    scene = slew(np.random.default_rng(3), 1.5, 0.05, 0.2, limit=5.0)
    inside = np.flatnonzero(camera.pinhole.contains(scene.middle))[:8]
    places, reference = scene.middle[inside], scene.directions[inside]
    covariance = np.tile(1e-4 * np.eye(2), (len(inside), 1, 1))
    attitude = Seen(places, covariance, reference, camera.pinhole).attitude()
    displaced = places + np.where(np.arange(len(inside)) == 2, 1.0, 0.0)[:, None]
    stars = Seen(displaced, covariance, reference, camera.pinhole)
    assert Seen(places, covariance, reference, camera.pinhole).disagreement(attitude).max() < 1e-6
    assert int(stars.disagreement(stars.attitude()).argmax()) == 2
    refined, _ = stars.without(2).refined(stars.attitude())
    assert abs(float(refined @ attitude)) == pytest.approx(1.0, abs=1e-14)


def test_the_bench_of_the_attitudes_asks_the_tracker_before_and_after_the_sky_is_known() -> None:
    """One frame of long streaks: an attitude of each way, within some sigmas of the truth."""
    row = attitude_row(30.0, 1, 5, 8.5, 0.2)
    assert row["attitudes"] == 1
    assert list(row["solutions"]) == list(SOLUTIONS)
    for one in row["solutions"].values():
        assert 0.0 < one["over_bound"] < 6.0
    assert all(0.0 < row["over_claimed"][name] < 4.0 for name in ("flight", "known sky"))
    assert all(0.0 < row["rate_over_bound"][name] < 4.0 for name in FITS)
    both = [row["solutions"][name]["rms_px"] for name in ("flight", "known sky")]
    assert both[0] != both[1]


def test_the_executive_flies_testbed_and_satellite_with_workers_that_hardly_rest() -> None:
    for orbit in (False, True):
        config = configuration.parse(full_load(Load(600.0, camera_period=0.4, orbit=orbit)))
        assert config.body == ("orbit" if orbit else "testbed")
        assert config.camera is not None
        assert config.camera.period == 0.4
        assert config.replan_period() == (10.0 if orbit else 0.025)
