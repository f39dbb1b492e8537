"""The picture of the objects that a flight tracked: their ways among the stars, rates and brightness."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ground.report import panels
from ground.report.objects import speeds_of, tracks_of
from ground.telemetry.reader import Run
from knightcube.astro.arrays import FloatArray

SIZE = (11.0, 7.6)
COLOURS = (panels.BLUE, panels.ORANGE, panels.GREEN, panels.PURPLE)


def objects_figure(run: Run) -> Figure | None:
    """Return the picture of the objects' ways, rates and brightness; None for a run without an object."""
    tracks = tracks_of(run)
    if not tracks:
        return None
    figure = Figure(figsize=SIZE, layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.1, 1.0))
    way, rate, light = (figure.add_subplot(grid[place]) for place in ((slice(None), 0), (0, 1), (1, 1)))
    for number, packets in enumerate(tracks):
        _draw((way, rate, light), packets, COLOURS[number % len(COLOURS)])
    way.set_aspect("equal", adjustable="datalim")
    way.invert_xaxis()
    light.invert_yaxis()
    panels.style(way, "declination, deg", "Ways among the stars, from the dot on", "right ascension, deg")
    panels.style(rate, "deg/s", "Angular rate")
    panels.style(light, "V", "Brightness, mean of the last sightings")
    way.legend(loc="best", fontsize=9)
    return figure


def _draw(axes: tuple[Axes, Axes, Axes], packets: Any, colour: str) -> None:
    """Draw one object's track into the panels of way, rate and brightness."""
    way, rate, light = axes
    times, label = packets["middle_ns"] * 1e-9, f"object {int(packets['number'][0])}"
    right, up = _sky(packets["direction"].astype(float))
    seen = packets["seen"] > 0
    way.plot(right, up, color=colour, label=label)
    way.plot(right[:1], up[:1], "o", color=colour)
    rate.plot(times, np.degrees(speeds_of(packets)), color=colour, label=label)
    light.plot(times, packets["magnitude"], color=colour, label=label)
    if not seen.all():
        way.plot(right[~seen], up[~seen], "x", color=colour, markersize=4, label="not seen")


def _sky(direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return right ascension, without a jump at a whole turn, and declination (n,), deg."""
    right = np.unwrap(np.arctan2(direction[:, 1], direction[:, 0]))
    right = right - 2.0 * np.pi * np.floor(right[0] / (2.0 * np.pi))
    return np.degrees(right), np.degrees(np.arcsin(np.clip(direction[:, 2], -1.0, 1.0)))
