"""The picture of a fit: measured and predicted angle, current, and innovations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ground.identification.fit import Fit
from ground.identification.record import Record
from ground.report import panels
from ground.report.figures import DPI, OVERVIEW


def fit_figure(record: Record, found: Fit) -> Figure:
    """Return the picture: angle, current, and the innovations of angle and rate in standard deviations."""
    figure = Figure(figsize=(OVERVIEW[0], 0.85 * OVERVIEW[1]), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    passed = found.innovations
    time = record.time[passed.taken]
    measured = np.degrees(record.angle[passed.taken])
    predicted = measured - np.degrees(passed.error[:, 0])
    axes[0].plot(time, measured, ".", color=panels.SKY, markersize=2.0, label="measured")
    axes[0].plot(time, predicted, color=panels.BLUE, linewidth=1.2, label="predicted by the fit")
    axes[1].step(record.switch_time, 1e3 * record.current, where="post", color=panels.VERMILLION)
    for ax, column, name in zip(axes[2:], (0, 1), ("angle", "rate"), strict=True):
        sigma = np.sqrt(passed.covariance[:, column, column])
        ax.plot(time, passed.error[:, column] / sigma, ".", color=panels.BLUE, markersize=1.5)
        for level in (-3.0, 3.0):
            ax.axhline(level, color=panels.GREY, linestyle=(0, (5, 2)), linewidth=1.0)
        panels.style(ax, "sigma", f"Innovations of the {name}", "mission time, s" if column else "")
    panels.style(axes[0], "angle, deg", "Turn about the thread", "")
    panels.style(axes[1], "current, mA", "Current on the wire", "")
    panels.legend(axes[0])
    return figure


def save_fit(record: Record, found: Fit, file: Path) -> None:
    """Draw a fit into a file. Raises OSError."""
    fit_figure(record, found).savefig(file, dpi=DPI, facecolor="white", format="png")
