"""The picture of a satellite's attitude knowledge: error by axis with its claim, and knowledge over time."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ground.report import panels
from ground.report.knowledge import attitude_errors
from ground.report.signals import seconds
from ground.telemetry.reader import Run

SIZE = (10.9, 9.4)
LEVELS = ("lost", "coarse", "fine")


def knowledge_figure(run: Run) -> Figure | None:
    """Return the picture, None for a run without packets of navigation or without a truth."""
    found = attitude_errors(run)
    if not (len(found.times) and len(run["navigation"])):
        return None
    figure = Figure(figsize=SIZE, layout="constrained")
    rows = figure.subplots(4, 1, sharex=True)
    colours = (panels.BLUE, panels.ORANGE, panels.GREEN)
    for axis, (ax, colour) in enumerate(zip(rows, colours, strict=False)):
        error, sigma = np.degrees(found.error[:, axis]), np.degrees(found.sigma[:, axis])
        ax.fill_between(
            found.times,
            -3.0 * sigma,
            3.0 * sigma,
            color=panels.GREY,
            alpha=0.25,
            linewidth=0,
            label="3 sigma",
        )
        ax.plot(found.times, error, color=colour, linewidth=0.9, label="error")
        ax.set_yscale("symlog", linthresh=0.01)
        panels.style(ax, f"{'xyz'[axis]}, deg", "Attitude error against the truth" if axis == 0 else "", "")
        panels.legend(ax)
    packets, ax = run["navigation"], rows[3]
    ax.step(
        seconds(packets), packets["knowledge"].astype(int), where="post", color=panels.BLUE, linewidth=1.2
    )
    ax.set_yticks(range(len(LEVELS)), LEVELS)
    panels.style(ax, "knowledge", "How well the attitude is known")
    return figure
