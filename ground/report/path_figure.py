"""The picture of one planned path: its attitude, rate and current (Sease 2013, Figures 5.4-5.6)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from ground.report import panels
from ground.report.figures import DPI, OVERVIEW

if TYPE_CHECKING:  # the planner brings the optimiser with it, which a picture does not need
    from knightcube.gnc.guidance.one_axis.plant import SingleAxisPlant
    from knightcube.gnc.guidance.one_axis.vmc import StepPlan


def path_figure(plan: StepPlan, plant: SingleAxisPlant) -> Figure:
    """Return the picture of a plan: q2, rate and current over its horizon, marked on its nodes."""
    last = plan.horizon * (1.0 - 1e-12)  # at the horizon itself the path already holds
    time, nodes = np.linspace(0.0, last, 401), np.minimum(plan.node_times, last)
    figure = Figure(figsize=(OVERVIEW[0], 0.75 * OVERVIEW[1]), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    for instants, mark in ((time, "-"), (nodes, "o")):
        angle, rate, acceleration = plan.path.motion(instants)
        signals = (np.sin(0.5 * angle), 1e3 * rate, plant.currents(angle, rate, acceleration))
        for ax, signal in zip(axes, signals, strict=True):
            label = "path" if mark == "-" else "nodes"
            ax.plot(instants, signal, mark, color=panels.BLUE, markersize=4.0, label=label)
    axes[0].axhline(plan.target_q2, color=panels.VERMILLION, linestyle=(0, (5, 2)), label="target")
    for sign in (-1.0, 1.0):
        limit = f"limit, {plant.current_limit:.4g} A" if sign > 0.0 else None
        axes[2].axhline(
            sign * plant.current_limit, color=panels.VERMILLION, linestyle=(0, (5, 2)), label=limit
        )
    stretched = f", stretched from {plan.horizon_asked:g} s" if plan.horizon > plan.horizon_asked else ""
    panels.style(
        axes[0], "$q_2$", f"Planned path: {plan.energy:.4g} J in {plan.horizon:.4g} s{stretched}", ""
    )
    panels.style(axes[1], "rate, mrad/s", "Rate", "")
    panels.style(axes[2], "current, A", "Current", "time, s")
    for ax in axes:
        panels.legend(ax)
    return figure


def save_path(plan: StepPlan, plant: SingleAxisPlant, file: Path) -> None:
    """Draw a plan into a file. Raises OSError."""
    path_figure(plan, plant).savefig(file, dpi=DPI, facecolor="white", format="png")
