"""Plots of a bench session: gyro noise, Allan deviation, rotations, coil responses, currents and frames."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ground.bringup.bench import Outcome
from ground.report.figures import save
from ground.report.panels import AXIS_COLOURS, BLACK, BLUE, GREY, SKY, VERMILLION, style
from hal.interfaces.devices import COIL_NAMES
from knightcube.vision.camera.images import grey_stretch, read_image

_SIZE = (13.0, 10.0)
_SAMPLES = 400
_CUT_OUT = 128  # side (px) of the section of the focus frame that is shown around its brightest pixel


def draw(file: Path, outcomes: Mapping[str, Outcome], frames: Mapping[str, Path]) -> None:
    """Draw the finished steps; a step without data leaves its panel empty. Raises OSError."""
    figure = Figure(figsize=_SIZE, layout="constrained")
    axes = figure.subplots(3, 3)
    for name, ax, panel in (
        ("rest", axes[0, 0], _rate),
        ("rest", axes[0, 1], _allan),
        ("axes", axes[0, 2], _turns),
        ("coils", axes[1, 0], _response),
        ("coils", axes[1, 1], _current),
        ("focus", axes[1, 2], _focus),
    ):
        if name in outcomes and outcomes[name].arrays:
            panel(ax, outcomes[name])
        else:
            _empty(ax, f"step {name}: no data")
    for ax, name in zip(axes[2], ("dark", "light", "focus"), strict=True):
        if name in frames:
            _frame(ax, frames[name], name)
        else:
            _empty(ax, f"step {name}: no frame")
    save(figure, file)


def _empty(ax: Axes, text: str) -> None:
    ax.set_axis_off()
    ax.text(0.5, 0.5, text, ha="center", va="center", color=GREY, transform=ax.transAxes)


def _rate(ax: Axes, outcome: Outcome) -> None:
    times, rate = outcome.arrays["times"], outcome.arrays["rate"]
    for index, (name, colour) in enumerate(AXIS_COLOURS.items()):
        ax.plot(times[:_SAMPLES], 1e3 * rate[:_SAMPLES, index], color=colour, linewidth=0.8, label=name)
    style(ax, "rate, mrad/s", "Gyro at rest", "time, s")
    ax.legend(fontsize=8)


def _allan(ax: Axes, outcome: Outcome) -> None:
    times, deviation = outcome.arrays["allan_times"], outcome.arrays["allan"]
    for index, (name, colour) in enumerate(AXIS_COLOURS.items()):
        ax.loglog(times, deviation[:, index], color=colour, marker=".", label=name)
    expected = outcome.values["expected"]["gyro"]
    ax.loglog(times, expected * np.sqrt(times[0] / times), color=GREY, linestyle="--", label="expected")
    style(ax, "deviation, rad/s", "Allan deviation", "averaging time, s")
    ax.legend(fontsize=8)


def _turns(ax: Axes, outcome: Outcome) -> None:
    turns = np.degrees(outcome.arrays["turns"])
    for index, (name, colour) in enumerate(AXIS_COLOURS.items()):
        ax.bar(np.arange(3) + 0.27 * (index - 1), turns[:, index], 0.25, color=colour, label=name)
    ax.axhline(90.0, color=VERMILLION, linestyle="--", linewidth=1.0)
    ax.set_xticks(range(3), [f"about {name}" for name in "xyz"])
    style(ax, "about x, y and z, deg", "Turns of 90 deg, measured by the gyro", "asked turn")
    ax.legend(fontsize=8)


def _response(ax: Axes, outcome: Outcome) -> None:
    response = 1e6 * outcome.arrays["response"]
    places = np.arange(len(response))
    for index, (name, colour) in enumerate(AXIS_COLOURS.items()):
        ax.bar(places + 0.27 * (index - 1), response[:, index], 0.25, color=colour, label=name)
        marks: dict[str, Any] = {"linestyle": "", "marker": "_", "markersize": 16.0, "color": BLACK}
        expected = 1e6 * outcome.arrays["expected"][:, index]
        ax.plot(places + 0.27 * (index - 1), expected, label="expected" if index == 2 else "", **marks)
    ax.axhline(0.0, color=GREY, linewidth=0.8)
    ax.set_xticks(places, [f"coil {COIL_NAMES[place]}" for place in places])
    style(ax, "field, uT/A", "Field of each coil at the magnetometer", "")
    ax.legend(fontsize=8)


def _current(ax: Axes, outcome: Outcome) -> None:
    current, commanded = 1e3 * outcome.arrays["current"], 1e3 * outcome.arrays["commanded"]
    places = np.arange(len(commanded))
    for way, (label, colour) in enumerate((("positive", BLUE), ("negative", SKY))):
        ax.bar(places + 0.3 * (way - 0.5), np.nan_to_num(current[:, way]), 0.28, color=colour, label=label)
    ax.plot(places, commanded, linestyle="", marker="_", markersize=40.0, color=VERMILLION, label="commanded")
    ax.set_xticks(places, [f"coil {COIL_NAMES[place]}" for place in places])
    style(ax, "current, mA", "Supply current", "")
    ax.legend(fontsize=8)


def _focus(ax: Axes, outcome: Outcome) -> None:
    widths = outcome.arrays["widths"]
    ax.plot(range(1, len(widths) + 1), widths, color=BLUE, marker="o")
    ax.set_ylim(0.0, 1.2 * float(np.nanmax(widths)))
    style(ax, "PSF width, px", "Focus", "frame")


def _frame(ax: Axes, file: Path, name: str) -> None:
    pixels = read_image(file)
    if name == "focus":
        row, column = (int(place) for place in np.unravel_index(int(np.argmax(pixels)), pixels.shape))
        top, left = max(row - _CUT_OUT // 2, 0), max(column - _CUT_OUT // 2, 0)
        pixels = pixels[top : top + _CUT_OUT, left : left + _CUT_OUT]
    ax.imshow(grey_stretch(pixels), cmap="gray")
    ax.set_title(f"frame of step {name}", loc="left", fontsize=11, fontweight="bold")
    ax.set_axis_off()
