"""Tests that plots show all data of a run, and do not use the global state of matplotlib."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from flight.bodies.testbed.control import plant_of
from flight.schema import reader as configuration
from flight.schema.bodies import as_testbed
from ground.report import draw, draw_path
from ground.telemetry import read_run
from knightcube.errors import UsageError
from knightcube.gnc.guidance.vmc import plan
from tests.ground.report.synthetic import CURRENT, Recipe, make_run
from tests.support.packed_run import packed_run

pytest.importorskip("matplotlib", reason="pictures need the extra 'plots'")
from matplotlib.figure import Figure
from matplotlib.image import imread

from ground.report import panels
from ground.report.figures import path_figure, spin_figure, track_figure
from ground.report.panels import RunSignals, planned_path

EVERY = ["attitude", "current", "power", "paths", "cycle_times", "rate", "overview"]
ROOT = Path(__file__).resolve().parents[3]


def is_drawn(path: Path) -> bool:
    """Return whether a plot has pixels that are not white."""
    return bool(imread(path)[..., :3].std() > 0.01)


def test_detumbling_without_a_valid_gyro_rate_is_drawn_until_the_last_rate_of_the_magnetometer() -> None:
    spin = [(float(second), {"rate": [0.1, 0.0, 0.0], "known": 1}) for second in range(4)]
    readings = [(float(second), {"rate": [np.nan] * 3}) for second in range(4)]
    figure = spin_figure(RunSignals(packed_run(spin=spin, imu=readings, mode=[(1.0, {"mode": 2})])))
    assert figure is not None
    assert figure.axes[0].get_xlim() == pytest.approx((0.6, 3.4))


@pytest.mark.parametrize(
    ("recipe", "expected"),
    [
        (Recipe(rate_hz=5.0), EVERY),
        (Recipe(duration=3.0, rate_hz=10.0), EVERY),
        (
            Recipe(duration=20.0, rate_hz=10.0, truth=False, identity=False, commands=False),
            ["attitude", "current", "cycle_times", "rate", "overview"],
        ),
    ],
    ids=["full", "cut short", "hardware, bare"],
)
def test_every_picture_for_which_the_run_has_data_is_drawn(
    tmp_path: Path, recipe: Recipe, expected: list[str]
) -> None:
    files = draw(read_run(make_run(tmp_path / "run", recipe)), tmp_path / "pictures")
    assert [path.stem for path in files] == expected
    assert all(is_drawn(path) for path in files)
    rows, columns = imread(files[-1]).shape[:2]
    assert (columns, rows) == pytest.approx((1200, 1400), abs=5), "the overview, as the README wants it"


def test_the_panels_show_the_values_of_the_log(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path, Recipe(duration=120.0, rate_hz=10.0)))
    signals, figure = RunSignals(run), Figure()
    top, bottom = figure.subplots(2)
    panels.attitude(top, signals)
    lines = {str(line.get_label()): line for line in top.get_lines()}
    assert set(lines) == {"target", "estimated", "true"}
    np.testing.assert_array_equal(lines["estimated"].get_ydata(), run["control"]["q2"])
    np.testing.assert_allclose(lines["true"].get_ydata(), run["control"]["q2"], atol=1e-12)
    panels.current(bottom, signals)
    drawn = np.asarray(bottom.get_lines()[0].get_ydata())
    assert drawn.max() == CURRENT


def test_the_plot_has_lines_for_the_thesis_the_supply_power_and_r_i_squared(tmp_path: Path) -> None:
    """A coil with 0.1 A for a tenth of the time takes 34 mW at 3.4 V, and 50 mW from the bus.

    The plot has separate lines for the thesis's limit, for the supply power and for R I^2.
    """
    signals, ax = RunSignals(read_run(make_run(tmp_path, Recipe(rate_hz=5.0)))), Figure().subplots()
    panels.power(ax, signals)
    drawn = {str(line.get_label()): np.asarray(line.get_ydata(), float) for line in ax.get_lines()}
    assert drawn["$V |I|$ at the coils"].max() == pytest.approx(0.34)
    assert drawn["average, 34.0 mW"][-1] == pytest.approx(0.034)
    assert drawn["average at the bus, 50.0 mW"][-1] == pytest.approx(0.050)
    assert drawn["average $R I^2$, 23.0 mW"][-1] == pytest.approx(0.023)
    assert drawn["thesis, 100 mW"][0] == 0.10


def test_two_runs_are_compared_by_their_supply_power(tmp_path: Path) -> None:
    signals, axes = RunSignals(read_run(make_run(tmp_path, Recipe(rate_hz=5.0)))), Figure().subplots(3)
    panels.compared(axes, signals, "A", "black")
    assert np.asarray(axes[2].get_lines()[0].get_ydata(), float)[-1] == pytest.approx(34.0)


def test_one_late_cycle_of_thousands_does_not_flatten_the_distribution() -> None:
    times = 1e-4 * np.random.default_rng(1).gamma(3.0, size=4000)
    times[7] = 3.0
    ax = Figure().subplots()
    panels.exceedance(ax, {"lateness": times}, "Control cycles", 0.025)
    middle, top = np.percentile(times, [50.0, 99.0])
    (low, _), (high, _) = ax.transAxes.inverted().transform(ax.transData.transform([(middle, 1), (top, 1)]))
    assert high - low > 0.08, "share of the width from the median to 99 %"
    assert ax.get_xlim()[1] > 3.0
    line = ax.get_lines()[0]
    np.testing.assert_array_equal(line.get_xdata(), np.sort(times))
    np.testing.assert_allclose(np.asarray(line.get_ydata(), float), 1.0 - np.arange(4000) / 4000)


def test_the_legend_states_that_lock_step_has_no_lateness() -> None:
    ax = Figure().subplots()
    panels.exceedance(ax, {"lateness": np.zeros(9), "execution": np.full(9, 2.0e-3)}, "Control cycles")
    labels = ax.get_legend_handles_labels()[1]
    assert labels == ["lateness: none", "execution: median 2 ms, max 2 ms"]
    only = Figure().subplots()
    panels.exceedance(only, {"lateness": np.zeros(9)}, "Control cycles")
    assert only.get_xscale() == "linear", "a logarithmic axis needs a number"


@pytest.mark.parametrize(
    ("time", "text"),
    [(2.58, "2.58 s"), (0.9999, "1 s"), (0.0246, "24.6 ms"), (1.2e-5, "12 µs"), (0.0, "0 µs")],
)
def test_times_have_the_unit_that_fits_them(time: float, text: str) -> None:
    assert panels.duration(time) == text


def test_values_that_only_a_damaged_log_has_do_not_keep_a_panel_from_being_drawn(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path, Recipe(duration=20.0, rate_hz=10.0)))
    damaged = run.truth.packets["truth"].copy()
    damaged["rate"][: len(damaged) // 2] = np.inf
    run.truth.packets["truth"] = damaged
    axes = Figure().subplots()
    with np.errstate(invalid="ignore"):
        panels.rate_error(axes, RunSignals(run))
    assert np.isfinite(axes.get_ylim()).all()


def test_a_planned_path_passes_through_its_nodes_and_is_the_polynomial_between(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path, Recipe(duration=5.0, rate_hz=10.0)))
    plan = run["plan"][0]
    time, q2, node_time, node_q2 = planned_path(plan)
    assert (time[0], time[-1]) == (node_time[0], node_time[-1]) == (0.0, 13.0)
    part = time / 13.0
    np.testing.assert_allclose(q2, 0.2 - 0.5 * (3.0 * part**2 - 2.0 * part**3), atol=1e-12)
    np.testing.assert_allclose(node_q2, np.interp(node_time, time, q2), atol=1e-3)


def test_the_report_on_board_imports_no_matplotlib() -> None:
    code = "import sys, ground.report, ground.telemetry; print('matplotlib' in sys.modules)"
    printed = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert printed.stdout == "False\n"


def test_without_matplotlib_the_cure_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = read_run(make_run(tmp_path, Recipe(duration=1.0, rate_hz=10.0)))
    for name in [name for name in sys.modules if name.startswith(("matplotlib", "ground.report."))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(UsageError, match=r"pip install '\.\[plots\]'"):
        draw(run, tmp_path)


def test_a_place_that_cannot_be_written_is_a_clear_error(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path, Recipe(duration=1.0, rate_hz=10.0)))
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UsageError, match="the picture cannot be written"):
        draw(run, tmp_path / "file")


def test_a_path_is_drawn_from_its_start_to_its_target_within_the_limit(tmp_path: Path) -> None:
    plant = plant_of(as_testbed(configuration.load(ROOT / "config" / "step_demo.yaml")))
    made = plan(plant, -0.3, 0.0, -0.2, 0.0, 10.0)
    attitude, rate, current = path_figure(made, plant).axes
    q2 = np.asarray(attitude.get_lines()[0].get_ydata())
    assert (q2[0], q2[-1]) == pytest.approx((-0.3, -0.2), abs=1e-9)
    line = rate.get_lines()[0]
    values, spans = np.asarray(line.get_ydata()) / 1e3, np.diff(np.asarray(line.get_xdata()))
    assert 0.5 * (values[1:] + values[:-1]) @ spans == pytest.approx(
        2.0 * (np.arcsin(-0.2) - np.arcsin(-0.3)), abs=1e-4
    )
    drawn = np.abs(np.asarray(current.get_lines()[0].get_ydata()))
    assert drawn.max() == pytest.approx(made.peak_current, rel=0.02)
    assert drawn.max() <= 1.001 * plant.current_limit
    file = tmp_path / "path.png"
    draw_path(made, plant, file)
    assert imread(file).std() > 0.01
    with pytest.raises(UsageError, match="the picture cannot be written"):
        draw_path(made, plant, tmp_path)


def test_the_track_of_a_month_has_as_many_marks_as_can_be_read() -> None:
    def marks(step: float) -> list[str]:
        times = (step * number for number in range(100))
        rows = [(at, {"utc": 2461120.0 + at / 86400.0, "position": [7e6, at, 0.0]}) for at in times]
        figure = track_figure(RunSignals(packed_run(orbit_truth=rows)))
        assert figure is not None
        return [text.get_text() for text in figure.axes[0].texts]

    assert marks(60.0) == [f"{minutes} min" for minutes in range(0, 99, 10)]
    assert 50 <= len(marks(25_920.0)) <= 60
