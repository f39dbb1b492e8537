"""The picture of a satellite's detumbling: rate, field and dipole while it was braked and a while longer."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ground.report import panels
from ground.report.detumbling import braked, known_rates, speeds
from ground.report.signals import seconds
from ground.telemetry.reader import Run

SIZE = (10.9, 9.4)
MARGIN = 0.2
"""Of the time from the first braking to the end of the last, shown before and after."""
AXES = ("x", "y", "z")


def spin_figure(run: Run) -> Figure | None:
    """Return the picture, None for a run without spin packets."""
    if not len(run["spin"]):
        return None
    figure = Figure(figsize=SIZE, layout="constrained")
    rate, field, dipole = figure.subplots(3, 1, sharex=True)
    _rate(rate, run)
    _axes(field, run, "field", 1e6)
    _axes(dipole, run, "dipole", 1e3)
    panels.style(rate, "rate, deg/s", "Detumbling", "")
    panels.style(field, "field, µT", "Magnetic field in the body's axes", "")
    panels.style(dipole, "dipole, mA m²", "Dipole wanted of the coils")
    for ax in (rate, field, dipole):
        panels.legend(ax)
    return figure


def _rate(ax: Axes, run: Run) -> None:
    """Draw the speed, and the magnetometer's with its sigma; the periods of braking are shaded."""
    time, speed, source = speeds(run)
    spin = known_rates(run)
    if len(spin):
        at, found = seconds(spin), np.degrees(np.linalg.norm(spin["rate"].astype(float), axis=1))
        sigma = np.degrees(spin["rate_sigma"].astype(float))
        least = np.maximum(found - sigma, 1e-3)
        ax.fill_between(
            at, least, found + sigma, color=panels.ORANGE, alpha=0.3, linewidth=0, label="1 sigma"
        )
        ax.semilogy(at, found, ".", color=panels.ORANGE, markersize=5, label="by the magnetometer alone")
    label = "gyro" if source == "imu" else source
    ax.semilogy(time, np.degrees(speed), color=panels.BLUE, linewidth=1.2, label=label, zorder=3)
    end = float(time[-1]) if len(time) else 0.0
    spans = [(begin, stop) for begin, stop, _ in braked(run, end)]
    for k, (begin, stop) in enumerate(spans):
        ax.axvspan(begin, stop, color=panels.GREY, alpha=0.12, linewidth=0, label="" if k else "braked")
    if spans:
        margin = MARGIN * (spans[-1][1] - spans[0][0])
        first, last = max(spans[0][0] - margin, 0.0), spans[-1][1] + margin
        ax.set_xlim(first, last)
        shown = (time >= first) & (time <= last)
        time, speed = time[shown], speed[shown]
    ax.set_ylim(bottom=max(1e-3, 0.5 * float(np.degrees(speed[speed > 0.0].min()))) if speed.any() else 1e-3)


def _axes(ax: Axes, run: Run, name: str, scale: float) -> None:
    spin = run["spin"]
    for axis, colour in zip(range(3), (panels.BLUE, panels.ORANGE, panels.GREEN), strict=True):
        values = scale * spin[name][:, axis].astype(float)
        ax.plot(seconds(spin), values, color=colour, linewidth=0.8, label=AXES[axis])
