"""Tests that the pictures of a bench session, a day and a battery show the given values."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="pictures need the extra 'plots'")
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.dates import date2num
from matplotlib.figure import Figure

from ground import report
from ground.bringup.bench import Outcome
from ground.report import figures, panels
from ground.report.figures import battery_figure, day_figure, draw_bench
from ground.report.panels import RunSignals
from knightcube.vision.camera.images import grey_stretch, write_picture
from tests.support.packed_run import packed_run


def curves(ax: Axes) -> dict[str, tuple[Any, Any]]:
    """Return the points of each labelled line."""
    return {
        str(line.get_label()): (
            np.asarray(line.get_xdata(orig=False), float).tolist(),
            np.asarray(line.get_ydata(), float).tolist(),
        )
        for line in ax.get_lines()
    }


def texts(ax: Axes) -> list[str]:
    return [text.get_text() for text in ax.texts]


# Bench session.

RATE = np.array([[1e-3, 2e-3, 3e-3]]) * np.arange(500)[:, None]
OUTCOMES = {
    "rest": Outcome(
        values={"expected": {"gyro": 2e-4}},
        arrays={
            "times": np.arange(500) * 0.025,
            "rate": RATE,
            "allan_times": np.array([0.1, 0.4, 0.9]),
            "allan": np.array([[1.0, 2.0, 3.0], [0.5, 1.0, 1.5], [0.3, 0.6, 0.9]]),
        },
    ),
    "axes": Outcome(arrays={"turns": np.radians([[90.0, 1.0, 2.0], [3.0, 88.0, 4.0], [5.0, 6.0, 91.0]])}),
    "coils": Outcome(
        arrays={
            "response": 1e-6 * np.array([[500.0, 10.0, 20.0], [30.0, -400.0, 40.0]]),
            "expected": 1e-6 * np.array([[510.0, 0.0, 5.0], [0.0, 450.0, 6.0]]),
            "current": np.array([[0.1, 0.12], [0.2, np.nan]]),
            "commanded": np.array([0.11, 0.21]),
        }
    ),
    "focus": Outcome(arrays={"widths": np.array([3.0, np.nan, 1.5])}),
}


@pytest.fixture
def saved(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Figure, Path]]:
    """Return the pictures instead of writing them."""
    found: list[tuple[Figure, Path]] = []
    monkeypatch.setattr(figures, "save", lambda figure, file: found.append((figure, file)))
    return found


def bench(saved: list[tuple[Figure, Path]], frames: dict[str, Path] | None = None) -> list[Axes]:
    draw_bench(Path("bench.png"), OUTCOMES, frames or {})
    figure, file = saved.pop()
    assert file == Path("bench.png")
    return figure.axes


def heights(ax: Axes) -> list[float]:
    """Return the heights of the bars."""
    return [patch.get_height() for patch in ax.patches]  # type: ignore[attr-defined]


def centres(ax: Axes) -> list[float]:
    return [patch.get_x() + 0.5 * patch.get_width() for patch in ax.patches]  # type: ignore[attr-defined]


def test_the_gyro_is_drawn_at_rest_with_its_allan_deviation(saved: list[tuple[Figure, Path]]) -> None:
    gyro, allan, *_ = bench(saved)
    lines = curves(gyro)
    assert list(lines) == ["x", "y", "z"]
    assert lines["y"][0] == pytest.approx(np.arange(400) * 0.025)
    assert lines["y"][1] == pytest.approx(2.0 * np.arange(400))  # mrad/s
    assert gyro.get_legend() is not None
    assert curves(allan)["z"] == ([0.1, 0.4, 0.9], [3.0, 1.5, 0.9])
    assert curves(allan)["expected"][1] == pytest.approx([2e-4, 1e-4, 2e-4 / 3.0])
    assert (allan.get_xscale(), allan.get_yscale()) == ("log", "log")


def test_the_bars_of_turns_fields_and_currents_have_their_heights(saved: list[tuple[Figure, Path]]) -> None:
    _, _, turns, response, current, *_ = bench(saved)
    assert heights(turns) == pytest.approx([90.0, 3.0, 5.0, 1.0, 88.0, 6.0, 2.0, 4.0, 91.0])
    assert centres(turns) == pytest.approx([-0.27, 0.73, 1.73, 0.0, 1.0, 2.0, 0.27, 1.27, 2.27])
    assert [text.get_text() for text in turns.get_xticklabels()] == ["about x", "about y", "about z"]
    assert 90.0 in [line.get_ydata()[0] for line in turns.get_lines()]  # type: ignore[index]
    assert heights(response) == pytest.approx([500.0, 30.0, 10.0, -400.0, 20.0, 40.0])
    assert centres(response) == pytest.approx([-0.27, 0.73, 0.0, 1.0, 0.27, 1.27])
    marks = [np.asarray(line.get_ydata(), float).tolist() for line in response.get_lines()]
    assert marks[:3] == [pytest.approx([510.0, 0.0]), pytest.approx([0.0, 450.0]), pytest.approx([5.0, 6.0])]
    assert curves(response)["expected"][0] == pytest.approx([0.27, 1.27])
    assert [text.get_text() for text in response.get_xticklabels()] == ["coil x", "coil y"]
    assert heights(current) == pytest.approx([100.0, 200.0, 120.0, 0.0])
    assert centres(current) == pytest.approx([-0.15, 0.85, 0.15, 1.15])
    assert curves(current)["commanded"] == ([0.0, 1.0], pytest.approx([110.0, 210.0]))


def test_the_focus_is_drawn_by_frame(saved: list[tuple[Figure, Path]]) -> None:
    focus = bench(saved)[5]
    x, y = focus.get_lines()[0].get_data()
    assert np.asarray(x).tolist() == [1, 2, 3]
    assert np.asarray(y)[[0, 2]].tolist() == [3.0, 1.5]
    assert focus.get_ylim() == pytest.approx((0.0, 3.6))
    assert focus.get_legend() is None


def test_missing_steps_and_frames_are_named(saved: list[tuple[Figure, Path]], tmp_path: Path) -> None:
    pixels = np.random.default_rng(1).integers(10, 90, (300, 400), np.uint8)
    pixels[250, 130] = 200
    write_picture(tmp_path / "focus.png", pixels)
    axes = bench(saved, {"focus": tmp_path / "focus.png", "dark": tmp_path / "focus.png"})
    assert texts(axes[7]) == ["step light: no frame"]
    dark, focus = (np.asarray(axes[number].images[0].get_array()) for number in (6, 8))
    assert np.array_equal(dark, grey_stretch(pixels))
    # The section of 128 px is around the brightest pixel, and ends at the edge of the picture.
    assert np.array_equal(focus, grey_stretch(pixels[250 - 64 :, 130 - 64 : 130 + 64]))
    assert axes[8].get_title(loc="left") == "frame of step focus"
    draw_bench(tmp_path / "none.png", {"axes": Outcome()}, {})
    empty = saved.pop()[0].axes
    names = ["rest", "rest", "axes", "coils", "coils", "focus"]
    assert [texts(ax)[0] for ax in empty[:6]] == [f"step {name}: no data" for name in names]


# Passes of a day.

BEGIN = datetime(2026, 3, 20, 22, 30, tzinfo=UTC)


def at(hours: float) -> datetime:
    return BEGIN + timedelta(hours=hours)


class Prediction:
    """Prediction of one day with three passes and two eclipses."""

    begin, end = BEGIN, BEGIN + timedelta(hours=24)

    def __init__(self, stations: Sequence[Any]) -> None:
        self.stations = stations

    def elevations(self, station: Any) -> tuple[list[datetime], np.ndarray]:
        return [at(0.0), at(1.0), at(2.0)], np.array([-5.0, 30.0 + len(station.name), 0.0])

    def passes(self, stations: Sequence[Any]) -> list[Any]:
        rises = ((0, 1.0, 44.6), (1, 5.0, 12.2), (0, 9.0, 80.0))
        return [
            SimpleNamespace(
                station=stations[k], rise=at(h), top=at(h + 0.1), set=at(h + 0.2), elevation_deg=degrees
            )
            for k, h, degrees in rises
        ]

    def eclipses(self) -> list[tuple[datetime, datetime]]:
        return [(at(0.2), at(0.7)), (at(1.8), at(2.3))]


STATIONS: Any = [SimpleNamespace(name="Berlin"), SimpleNamespace(name="Kiruna")]


def bars(ax: Axes) -> list[tuple[float, float, float]]:
    """Return level, start (h) and duration (h) of each horizontal bar."""
    start = float(date2num(BEGIN))  # type: ignore[no-untyped-call]
    patches: list[Any] = list(ax.patches)
    return [
        (patch.get_y() + 0.5 * patch.get_height(), 24.0 * (patch.get_x() - start), 24.0 * patch.get_width())
        for patch in patches
        if hasattr(patch, "get_width") and patch.get_height() == pytest.approx(0.6)
    ]


def test_a_day_shows_elevations_passes_and_eclipses() -> None:
    sky, below = day_figure(Prediction(STATIONS), STATIONS, []).axes  # type: ignore[arg-type]
    lines = curves(sky)
    assert list(lines) == ["Berlin", "Kiruna"]
    assert np.isnan(lines["Berlin"][1][0])
    assert lines["Berlin"][1][1] == 36.0
    assert np.isnan(lines["Berlin"][1][2]), "the horizon itself is not drawn"
    assert np.array(bars(below)) == pytest.approx(
        np.array([[1.0, 1.0, 0.2], [0.0, 5.0, 0.2], [1.0, 9.0, 0.2]]), abs=1e-5
    )
    assert texts(below) == ["45°", "12°", "80°"]
    assert [tick.get_text() for tick in below.get_yticklabels()] == ["Berlin", "Kiruna"]
    assert below.get_yticks().tolist() == [1, 0]
    assert sky.get_ylim() == (0.0, 90.0)
    assert sky.get_xlim() == pytest.approx(tuple(date2num([BEGIN, at(24.0)])))  # type: ignore[no-untyped-call]
    assert sky.get_legend_handles_labels()[1].count("eclipse") == 1
    assert len(sky.patches) == 2
    assert sky.get_title(loc="left") == "From 2026-03-20 22:30 UTC"
    colours = [line.get_color() for line in sky.get_lines()]
    assert colours == list(panels.PATH_COLOURS[:2])
    first, second, third = (patch.get_facecolor() for patch in below.patches[:3])
    assert first == third != second


def test_a_pass_of_half_a_minute_is_visible() -> None:
    """The bar of a pass over a day is narrower than a pixel, but at least two columns have its colour."""

    class Short(Prediction):
        def passes(self, stations: Sequence[Any]) -> list[Any]:
            ends = {"rise": at(9.0), "top": at(9.002), "set": at(9.0 + 34.0 / 3600.0)}
            return [SimpleNamespace(station=stations[0], **ends, elevation_deg=5.0)]

    figure = day_figure(Short(STATIONS), STATIONS, [])  # type: ignore[arg-type]
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    below = figure.axes[1]
    instant = float(date2num(at(9.0)))  # type: ignore[no-untyped-call]
    column, row = np.round(below.transData.transform((instant, 1.0))).astype(int)
    pixels = np.asarray(canvas.buffer_rgba())[::-1][row, column - 3 : column + 4, :3]
    colour = np.round(255.0 * np.array(below.patches[0].get_facecolor()[:3]))
    assert int((np.abs(pixels - colour).max(axis=1) < 40.0).sum()) >= 2


def test_targets_are_in_a_row_of_their_own_and_last_to_the_next() -> None:
    targets = [(3600.0, "nadir"), (7200.0, "sun"), (36000.0, "point")]
    _, below = day_figure(Prediction(STATIONS), STATIONS, targets).axes  # type: ignore[arg-type]
    found = np.array(bars(below))
    assert found[:3, 0].tolist() == pytest.approx([2.0, 1.0, 2.0])
    assert found[3:] == pytest.approx(
        np.array([[0.0, 1.0, 1.0], [0.0, 2.0, 8.0], [0.0, 10.0, 14.0]]), abs=1e-5
    )
    assert [tick.get_text() for tick in below.get_yticklabels()] == ["Berlin", "Kiruna", "targets"]
    assert texts(below)[3:] == ["nadir", "sun", "point"]
    shades = [patch.get_facecolor() for patch in below.patches[3:6]]
    assert shades[0] == shades[2] != shades[1]


# Battery.


def test_the_battery_figure_shows_charge_powers_and_shed_loads() -> None:
    rows = [
        (10.0 * k, {"charge": 0.5 - 0.1 * k, "shed": k, "battery_voltage": 8.0, "battery_current": 0.25 * k})
        for k in range(3)
    ]
    true = [
        (float(k), {"charge": 0.4, "solar_power": 2.0, "load_power": 3.0, "coil_power": 1.0}) for k in (0, 1)
    ]
    run = packed_run(power=rows, true_power=true, streak=[(2.0, {"exposure_start_ns": 1_500_000_000})])
    figure = battery_figure(RunSignals(run))
    assert figure is not None
    charge, power, shed = figure.axes
    assert curves(charge)["estimated"] == ([0.0, 10.0, 20.0], pytest.approx([50.0, 40.0, 30.0], abs=1e-5))
    assert curves(charge)["true"] == ([0.0, 1.0], pytest.approx([40.0, 40.0], abs=1e-5))
    assert curves(power)["out of the battery, measured"][1] == pytest.approx([0.0, 2.0, 4.0])
    levels = {label: curves(power)[label][1] for label in ("solar panels", "all loads", "coils")}
    assert levels == {"solar panels": [2.0, 2.0], "all loads": [3.0, 3.0], "coils": [1.0, 1.0]}
    assert shed.get_lines()[0].get_ydata().tolist() == [0, 1, 2]  # type: ignore[union-attr]
    assert curves(shed)["frames of the star camera"] == ([1.5], [-0.4])
    assert [tick.get_text() for tick in shed.get_yticklabels()][:2] == ["nothing", "coils-limited"]
    without = battery_figure(RunSignals(packed_run(power=rows)))
    assert without is not None
    assert list(curves(without.axes[1])) == ["out of the battery, measured"]
    assert battery_figure(RunSignals(packed_run(true_power=true))) is None


# The pictures of the package.


@pytest.mark.parametrize(
    ("draw", "maker", "words"),
    [
        (report.draw_path, "path_figure", ("plan", "plant")),
        (report.draw_day, "day_figure", ("prediction", "stations", "targets")),
        (report.draw_slew, "slew_figure", ("made", "order")),
        (report.draw_fit, "fit_figure", ("record", "found")),
    ],
)
def test_a_figure_is_made_from_its_values_and_saved(
    draw: Any, maker: str, words: tuple[str, ...], saved: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, maker, lambda *given: given)
    draw(*words, Path("picture.png"))
    assert saved == [(words, Path("picture.png"))]


def test_a_folder_is_made_for_the_pictures_of_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []

    def drawn(*words: Any) -> str:
        given.append(words)
        assert words[-1].is_dir()
        return "files"

    monkeypatch.setattr(figures, "draw_figures", drawn)
    monkeypatch.setattr(figures, "draw_comparison", drawn)
    made: Any = report
    assert made.draw("run", tmp_path / "a" / "b") == "files"
    assert made.draw_both("first", "second", tmp_path / "c" / "d") == "files"
    assert made.draw_both("first", "second", tmp_path / "c" / "d") == "files"
    assert given == [
        ("run", tmp_path / "a" / "b"),
        ("first", "second", tmp_path / "c" / "d"),
        ("first", "second", tmp_path / "c" / "d"),
    ]


def test_a_module_other_than_matplotlib_that_is_missing_is_not_blamed_on_matplotlib() -> None:
    with pytest.raises(ModuleNotFoundError), report.drawing(Path("x")):
        raise ModuleNotFoundError(name="scipy.special")


def test_the_pictures_of_a_run_are_those_of_its_kind(
    tmp_path: Path, saved: list[tuple[Any, Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run with spin packets is a run in orbit; a run on the testbed can also have pictures of an orbit."""
    names = (
        "_attitude", "_current", "_power", "_paths", "_cycle_times", "_rate", "_overview", "cage_figure",
        "spin_figure", "knowledge_figure", "pointing_figure", "track_figure", "objects_figure",
        "battery_figure",
    )  # fmt: skip
    for name in names:
        monkeypatch.setattr(figures, name, lambda signals, name=name: None if "path" in name else name)
    orbiting = packed_run(spin=[(0.0, {})])
    files = figures.draw_figures(orbiting, tmp_path)
    drawn = ["power", "cycle_times", "spin", "knowledge", "pointing", "track", "objects", "battery"]
    assert files == [tmp_path / f"{name}.png" for name in drawn]
    assert [figure for figure, _ in saved] == [
        "_power", "_cycle_times", "spin_figure", "knowledge_figure", "pointing_figure", "track_figure",
        "objects_figure", "battery_figure",
    ]  # fmt: skip
    files = figures.draw_figures(packed_run(), tmp_path)
    first = ["attitude", "current", "power", "cycle_times", "rate", "overview", "cage"]
    assert [file.stem for file in files] == [*first, *drawn[2:]]


def test_two_runs_are_compared_in_three_panels(saved: list[tuple[Figure, Path]], tmp_path: Path) -> None:
    control = [(0.1 * k, {"q2": 0.01 * k, "rate": 0.1}) for k in range(5)]
    assert figures.draw_comparison(
        packed_run(control=control), packed_run(control=control[:3]), tmp_path
    ) == (tmp_path / "comparison.png")
    ((figure, file),) = saved
    assert file == tmp_path / "comparison.png"
    attitude, rate, _ = figure.axes
    assert list(curves(attitude)) == ["A", "B"]
    assert len(curves(rate)["B"][0]) == 3
    first, second = attitude.get_lines()
    assert first.get_color() != second.get_color()
