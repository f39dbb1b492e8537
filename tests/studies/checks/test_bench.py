"""`python -m tests.studies.bench`: benches by name; and what the benches of the streaks measure with."""

from __future__ import annotations

import sys
from types import ModuleType

import numpy as np
import pytest

import tests.studies.bench
from flight.schema import reader as configuration
from sim_hal.star_camera import StarCameraModel
from tests.studies.bench import __main__ as bench
from tests.studies.bench import streaks
from tests.studies.bench.executive import Load, full_load
from tests.studies.bench.mid_exposure import FITS, SOLUTIONS, Seen, attitude_row
from tests.studies.bench.stage_clock import REST, WHOLE, clocked
from tests.support.scenes import FIELD, slew


def test_every_bench_is_listed_with_one_line_and_none_is_imported(capsys: pytest.CaptureFixture[str]) -> None:
    before = set(sys.modules)
    assert bench.main([]) == 0
    listed = capsys.readouterr().out
    for name, line in bench.benches().items():
        assert f"  {name}" in listed
        assert line in listed
        assert line
    assert {"streaks", "endpoints", "likelihood", "plan"} <= bench.benches().keys()
    assert not {name for name in set(sys.modules) - before if name.startswith("tests.studies.bench.")}


def test_an_unknown_bench_is_wrong_use(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        bench.main(["nothing"])
    assert stopped.value.code == 2
    assert "streaks" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["plan", "likelihood", "endpoints"])
def test_a_bench_gets_its_own_arguments(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a main with a list of arguments, and of a main that reads the command line."""
    with pytest.raises(SystemExit) as stopped:
        bench.main([name, "--help"])
    assert stopped.value.code == 0
    assert f"python -m tests.studies.bench {name}" in capsys.readouterr().out.replace(".plan", " plan")


def test_the_cycle_of_the_filter_is_timed_for_both_bodies(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["filter_cycle", "--cycles", "20"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == ["suspended", "free"]


def _busy() -> float:
    return sum(float(np.linalg.norm(np.ones(1000))) for _ in range(2000))


def test_the_stage_clock_sees_what_a_module_imported_and_leaves_it_as_it_was() -> None:
    module = ModuleType("somewhere")
    vars(module)["stage"] = _busy
    with clocked(module, "tests.") as spent:
        module.stage()
    assert module.stage is _busy
    assert spent["stage"] > 0.5 * spent[WHOLE] > 0.0
    assert spent[WHOLE] == pytest.approx(spent["stage"] + spent[REST])


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


def test_pieces_of_one_streak_are_merged_and_crossing_ones_are_not() -> None:
    lines = pytest.importorskip("tests.studies.bench.opencv_lines", reason="needs the extra bench: opencv")
    signal = np.full((200, 200), 50.0, dtype=np.float32)
    pieces = np.array(
        [
            [[20.0, 50.0], [80.0, 50.0]],
            [[82.0, 51.0], [140.0, 51.0]],
            [[20.0, 53.0], [60.0, 53.0]],
            [[70.0, 20.0], [70.0, 90.0]],
        ]
    )
    merged = lines.merge(pieces, lines.Prepared(signal, 10.0))
    assert len(merged) == 2
    assert np.ptp(merged[0], axis=0) == pytest.approx([120.0, 0.5], abs=1.0)
    assert np.ptp(merged[1], axis=0) == pytest.approx([0.0, 70.0], abs=1.0)


def test_without_opencv_the_streaks_bench_says_how_to_get_it_and_goes_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    monkeypatch.delitem(sys.modules, "tests.studies.bench.opencv_lines", raising=False)
    monkeypatch.delattr(tests.studies.bench, "opencv_lines", raising=False)
    known = streaks.estimators(StarCameraModel(field_of_view=FIELD), 0.2, 1)
    assert list(known) == ["likelihood", "harris", "minimum-eigenvalue", "trajkovic-4", "trajkovic-8"]
    assert "pip install '.[bench]'" in capsys.readouterr().err


def test_the_bench_of_the_streaks_measures_all_on_the_same_frames() -> None:
    """One frame, two estimators: a rate of each, all of the brightest stars, and times that add up."""
    camera = StarCameraModel(field_of_view=FIELD)
    frames = streaks.scenes(camera, 1, 10.0, (60.0, 80.0), 0.2, (7,))
    known = streaks.estimators(camera, 0.2, 1)
    chosen = {name: known[name] for name in ("likelihood", "harris")}
    figures = streaks.measure(chosen, camera, frames)
    for row in figures.values():
        assert (row["rates"], row["wrong"]) == (1, 0)
        assert row["recall"] > 0.5
        stages = row["stages_ms"]
        assert sum(median for name, (median, _) in stages.items() if name != "whole") == pytest.approx(
            stages["whole"][0]
        )
    assert figures["likelihood"]["recall"] > 0.9
    assert figures["likelihood"]["vector_ratio"] < 4.0


@pytest.mark.parametrize("detector", ["opencv-lsd", "opencv-hough"])
def test_opencv_finds_a_drawn_streak_to_about_a_pixel(detector: str) -> None:
    lines = pytest.importorskip("tests.studies.bench.opencv_lines", reason="needs the extra bench: opencv")
    rows, columns = np.indices((200, 200))
    along = ((columns - 40.0) + (rows - 60.0)) / np.sqrt(2.0)
    across = ((columns - 40.0) - (rows - 60.0)) / np.sqrt(2.0)
    streak = 400.0 * np.exp(-0.5 * across**2) * ((along > 0.0) & (along < 100.0))
    noise = np.random.default_rng(5).normal(0.0, 10.0, streak.shape)
    frame = lines.Prepared((streak + noise).astype(np.float32), 10.0)
    found = lines.merge(lines.DETECTORS[detector](frame), frame)[0]
    found = found[np.argsort(found[:, 0])]
    true = np.array([[40.0, 60.0], [40.0 + 100.0 / np.sqrt(2.0), 60.0 + 100.0 / np.sqrt(2.0)]])
    assert np.abs(found - true).max() < 3.0


def test_the_executive_flies_testbed_and_satellite_with_workers_that_hardly_rest() -> None:
    for orbit in (False, True):
        config = configuration.parse(full_load(Load(600.0, camera_period=0.4, orbit=orbit)))
        assert config.body == ("orbit" if orbit else "testbed")
        assert config.camera is not None
        assert config.camera.period == 0.4
        assert config.replan_period() == (10.0 if orbit else 0.025)
