"""Functions that draw the panels of a run's pictures on given axes.

The colours are from the Okabe-Ito palette, which can be distinguished with all common kinds of colour vision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter

from flight.link.telemetry.definitions import MAX_NODES
from flight.link.telemetry.packets import PacketArray
from ground.report import steps as limits
from ground.report.signals import (
    PowerHistory,
    ThreadMotion,
    bus_power,
    coil_power,
    covariance_matrices,
    estimated_attitude,
    last_time,
    mean_rates,
    seconds,
    true_attitude,
    with_rate,
    within_truth,
)
from ground.telemetry import Run
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.plant import lgl_rule

BLACK, GREY = "#222222", "#8a8a8a"
BLUE, ORANGE, GREEN = "#0072B2", "#E69F00", "#009E73"
VERMILLION, PURPLE, SKY = "#D55E00", "#CC79A7", "#56B4E9"
PATH_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILLION)
AXIS_COLOURS = {"x": BLUE, "y": ORANGE, "z": GREEN}
DASHED = (0, (5, 2))
MAX_SHORT = 100.0
"""Ratio of the ends of a logarithmic axis below which 2 and 5 times the powers of ten are labelled too."""
_MAX_ERROR = 1e9
"""Largest plausible rate error (mrad/s).

A larger error comes from a damaged log and does not affect the axis scale.
"""


@dataclass(frozen=True)
class RunSignals:
    """Signals of one run, computed once for all panels."""

    run: Run

    @cached_property
    def truth(self) -> ThreadMotion | None:
        """True motion, or None without a truth log."""
        return true_attitude(self.run)

    @cached_property
    def estimate(self) -> ThreadMotion:
        """Estimated motion."""
        return estimated_attitude(self.run)

    @cached_property
    def flown(self) -> ThreadMotion:
        """True motion, or the estimated motion if the run has no truth log."""
        return self.truth or self.estimate

    @cached_property
    def power(self) -> PowerHistory | None:
        """Power of the coils."""
        return coil_power(self.run)

    @cached_property
    def end(self) -> float:
        """Last time of the logs, s."""
        return last_time(self.run)

    @cached_property
    def current_limit(self) -> float:
        """Limit (A) of a coil current from the run's configuration, or else the limit of the thesis."""
        run = self.run["run"]
        return float(run["current_limit"][0]) if len(run) else limits.CURRENT_LIMIT_A


def planned_path(plan: PacketArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return times (m,), s, and q2 (m,) along a plan packet's path, and times and q2 (n,) at its nodes."""
    nodes = int(plan["nodes"])
    values = plan["node_q2"][:nodes].astype(float)
    rule = lgl_rule(nodes)
    points = np.linspace(-1.0, 1.0, 201)
    origin, horizon = float(plan["origin_ns"]) / 1e9, float(plan["horizon"])
    times, node_times = (origin + 0.5 * horizon * (x + 1.0) for x in (points, rule.nodes))
    return times, rule.interpolation(points) @ values, node_times, values


def _streak_rates(run: Run) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return mid-exposure times (n,), s, and the rates (n,), rad/s, about the suspension thread.

    The rates are measured from streaks of stars in frames. The third array contains the standard deviations
    (0 if unknown), and the fourth array the differences from the true mean rates (NaN if unknown).
    """
    rated = with_rate(run["streak"])
    start = rated["exposure_start_ns"] / 1e9
    stop = start + rated["exposure"]
    variance = np.nan_to_num(covariance_matrices(rated["covariance"])[:, 1, 1])
    difference = rated["rate"][:, 1] - mean_rates(run["truth"], start, stop)[:, 1]
    value = rated["rate"][:, 1].astype(float)
    return 0.5 * (start + stop), value, np.sqrt(np.maximum(variance, 0.0)), difference


def style(ax: Axes, ylabel: str, title: str = "", xlabel: str = "mission time, s") -> None:
    """Apply the common style of all pictures to axes."""
    ax.set_ylabel(ylabel)
    ax.set_xlabel(xlabel)
    if title:
        ax.set_title(title, loc="left", fontsize=11, fontweight="bold", color=BLACK)
    ax.grid(True, color="#e4e4e4", linewidth=0.8)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(GREY)
    ax.tick_params(color=GREY, labelcolor=BLACK)
    ax.margins(x=0.01)


def legend(ax: Axes) -> None:
    """Put the legend above the axes, to the right of the title."""
    handles, labels = ax.get_legend_handles_labels()
    if handles:
        place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.98), "frameon": False}
        gaps: dict[str, Any] = {"borderaxespad": 0.2, "columnspacing": 1.4}
        ax.legend(handles, labels, ncols=len(handles), fontsize=9, **place, **gaps)


def plain_ticks(ax: Axes) -> None:
    """Label the logarithmic y axis with plain numbers, at 1, 2 and 5 times powers of ten on a short axis."""
    low, high = ax.get_ylim()
    subs = (1.0, 2.0, 5.0) if high < MAX_SHORT * low else (1.0,)
    ax.yaxis.set_major_locator(LogLocator(subs=subs))
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.yaxis.set_minor_formatter(NullFormatter())


def level(ax: Axes, value: float, label: str, colour: str = VERMILLION) -> None:
    """Draw a dashed horizontal line at a target or a limit."""
    ax.axhline(value, color=colour, linewidth=1.2, linestyle=DASHED, label=label)


def vectors(ax: Axes, times: FloatArray, values: FloatArray) -> None:
    """Draw the three components of vectors (n, 3) at `times` (n,)."""
    for column, (name, colour) in zip(values.T, AXIS_COLOURS.items(), strict=True):
        ax.plot(times, column, color=colour, linewidth=0.8, label=name)


def attitude(ax: Axes, signals: RunSignals) -> None:
    """Draw q2 of the target, the estimate and the truth (Sease 2013, Figure 5.9)."""
    targets = signals.run["target"]
    if len(targets):
        times, values = np.append(seconds(targets), signals.end), targets["q2"].astype(float)
        look: dict[str, Any] = {"color": VERMILLION, "linewidth": 1.4, "linestyle": DASHED, "zorder": 3}
        ax.step(times, np.append(values, values[-1]), where="post", label="target", **look)
    if len(signals.estimate.time):
        ax.plot(signals.estimate.time, signals.estimate.q2, color=SKY, linewidth=2.6, label="estimated")
    if signals.truth is not None:
        ax.plot(signals.truth.time, signals.truth.q2, color=BLACK, linewidth=1.0, label="true")
    style(ax, "$q_2$", "Attitude")
    legend(ax)


def current(ax: Axes, signals: RunSignals) -> None:
    """Draw the commanded coil currents and their limit (Sease 2013, Figure 5.10)."""
    control = signals.run["control"]
    time, written = seconds(control), control["current_written"]
    for values, (name, colour) in zip(written.T, AXIS_COLOURS.items(), strict=True):
        if np.any(values):
            amperes = values.astype(float)
            ax.step(time, amperes, where="post", color=colour, linewidth=0.8, label=f"coil {name}")
    level(ax, -signals.current_limit, "")
    level(ax, signals.current_limit, f"limit, {signals.current_limit:g} A")
    style(ax, "current, A", "Torque coil current")
    legend(ax)


def power(ax: Axes, signals: RunSignals) -> None:
    """Draw the supply power, its averages and, for the testbed, the thesis's 0.10 W (Figure 5.11)."""
    found = signals.power
    if found is None:
        return
    time, ends = found.time, found.time + found.spans
    ax.fill_between(time, found.supply, step="post", color=BLUE, alpha=0.35, linewidth=0.0)
    ax.step(time, found.supply, where="post", color=BLUE, linewidth=0.7, label="$V |I|$ at the coils")
    averages = [
        (ends, found.running_average(found.supply), BLACK, "average"),
        (ends, found.running_average(found.heat), GREEN, "average $R I^2$"),
    ]
    measured_at, measured = bus_power(signals.run)
    if len(measured):
        average = np.cumsum(measured) / np.arange(1, len(measured) + 1)
        averages.insert(1, (measured_at, average, PURPLE, "average at the bus"))
    for times, average, colour, name in averages:
        ax.plot(times, average, color=colour, linewidth=1.6, label=f"{name}, {1e3 * average[-1]:.1f} mW")
    if not len(signals.run["spin"]):  # the thesis limits only the testbed
        level(ax, limits.AVERAGE_SUPPLY_POWER_LIMIT_W, "thesis, 100 mW")
    ax.set_ylim(bottom=0.0)
    style(ax, "power, W", "Coil power")
    legend(ax)


def compared(axes: Sequence[Axes], signals: RunSignals, name: str, colour: str) -> None:
    """Draw q2, rate and running average of the supply power of one run on three axes."""
    flown, power = signals.flown, signals.power
    axes[0].plot(flown.time, flown.q2, color=colour, linewidth=1.4, label=name)
    axes[1].plot(flown.time, 1e3 * flown.rate, color=colour, linewidth=1.0, label=name)
    if power is not None:
        average = power.running_average(power.supply)
        axes[2].plot(power.time + power.spans, 1e3 * average, color=colour, linewidth=1.4, label=name)


def paths(ax: Axes, signals: RunSignals, start: float, stop: float, target: float, title: str) -> None:
    """Draw the paths planned between `start` and `stop`, s, with their nodes, and the flown attitude."""
    flown = signals.flown
    inside = (flown.time >= start) & (flown.time <= stop)
    source = "true" if flown.source == "truth" else "estimated"
    times, label = flown.time[inside] - start, f"flown ({source})"
    ax.plot(times, flown.q2[inside], color=BLACK, linewidth=3.2, alpha=0.3, label=label)
    plans = signals.run["plan"]
    origin = plans["origin_ns"] / 1e9
    drawable = (plans["accepted"] == 1) & (plans["nodes"] >= 2) & (plans["nodes"] <= MAX_NODES)
    chosen = plans[drawable & (origin >= start - 0.5) & (origin < stop)]
    for i, plan in enumerate(chosen):
        time, values, node_time, node_values = planned_path(plan)
        colour = PATH_COLOURS[i % len(PATH_COLOURS)]
        ax.plot(time - start, values, color=colour, linewidth=1.3, label=f"plan {int(plan['number'])}")
        ax.plot(node_time - start, node_values, "o", color=colour, markersize=3.5)
    level(ax, target, "target")
    ax.set_xlim(-0.01 * (stop - start), stop - start)
    style(ax, "$q_2$", title, "time since the command, s")
    legend(ax)


def rate(ax: Axes, signals: RunSignals) -> None:
    """Draw the rate about the suspension thread: estimated, true, and from star streaks with error bars."""
    if len(signals.estimate.time):
        estimate = 1e3 * signals.estimate.rate
        ax.plot(signals.estimate.time, estimate, color=SKY, linewidth=2.6, label="estimated")
    if signals.truth is not None:
        ax.plot(signals.truth.time, 1e3 * signals.truth.rate, color=BLACK, linewidth=1.0, label="true")
    middle, value, sigma, _ = _streak_rates(signals.run)
    _error_bars(ax, middle, value, sigma, "from streaks")
    style(ax, "rate, mrad/s", "Rate about the thread")
    legend(ax)


def rate_error(ax: Axes, signals: RunSignals) -> None:
    """Draw the errors of the estimated rate and of the streak rates against the truth."""
    truth, control = signals.truth, signals.run["control"]
    if truth is None:
        return
    control = control[np.isfinite(control["rate"]) & np.isfinite(control["rate_sigma"])]
    control = within_truth(signals.run["truth"], control)
    time, bound = seconds(control), 3e3 * control["rate_sigma"].astype(float)
    error = 1e3 * (control["rate"] - np.interp(time, truth.time, truth.rate))
    band = r"$\pm 3\sigma$ of the estimate"
    ax.fill_between(time, -bound, bound, color=SKY, alpha=0.35, linewidth=0.0, label=band)
    ax.plot(time, error, color=BLUE, linewidth=0.6, label="estimated minus true")
    middle, _, sigma, difference = _streak_rates(signals.run)
    known = np.isfinite(difference)
    _error_bars(ax, middle[known], difference[known], sigma[known], r"streaks minus true, $\pm\sigma$")
    everything = np.concatenate([np.abs(error), bound, np.abs(1e3 * difference[known])])
    everything = everything[everything < _MAX_ERROR]
    if len(everything):  # a start-up transient must not determine the axis scale
        span = 1.5 * float(np.percentile(everything, 99.0)) or 1.0
        ax.set_ylim(-span, span)
    style(ax, "error, mrad/s", "Error of the rate")
    legend(ax)


def _error_bars(ax: Axes, time: FloatArray, rate: FloatArray, sigma: FloatArray, label: str) -> None:
    if len(time):
        look: dict[str, Any] = {"fmt": "o", "markersize": 3.5, "color": ORANGE, "elinewidth": 1.0}
        ax.errorbar(time, 1e3 * rate, 1e3 * sigma, label=label, zorder=4, **look)


def exceedance(ax: Axes, values: dict[str, FloatArray], title: str, bound: float | None = None) -> None:
    """Draw for each named set the fraction of times (s) above x as a function of x, and a line at `bound`.

    Both axes are logarithmic, so that one late cycle in thousands is as visible as the median. Times of zero,
    such as the lateness in lock-step, cannot be drawn on logarithmic axes and are stated in the legend.
    """
    shortest = []
    for (name, times), colour in zip(values.items(), PATH_COLOURS, strict=False):
        ordered = np.sort(times[np.isfinite(times)])
        share = 1.0 - np.arange(len(ordered)) / max(1, len(ordered))
        shown = ordered > 0.0
        if not shown.any():
            ax.plot([], [], color=colour, linewidth=1.6, label=f"{name}: none")
            continue
        ends = f"median {duration(float(np.median(ordered)))}, max {duration(float(ordered[-1]))}"
        x, y = ordered[shown], share[shown]
        ax.step(x, y, where="pre", color=colour, linewidth=1.6, label=f"{name}: {ends}")
        ax.plot(x[-1:], y[-1:], "o", color=colour, markersize=5)
        shortest.append(x[0])
    if bound is not None:
        label = f"period, {duration(bound)}"
        ax.axvline(bound, color=VERMILLION, linewidth=1.2, linestyle=DASHED, label=label)
    style(ax, "share above", title, "time")
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter(lambda share, _: f"{100.0 * share:g} %")
    if shortest or bound is not None:
        ax.set_xscale("log")
        ax.margins(x=0.05)
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
        ax.xaxis.set_major_formatter(lambda time, _: duration(time))
    legend(ax)


def duration(time: float) -> str:
    """Return a time in s as text with three digits and a unit."""
    scale, unit = next(((s, u) for s, u in ((1.0, "s"), (1e3, "ms")) if abs(time) * s >= 0.9995), (1e6, "µs"))
    return f"{time * scale:.3g} {unit}"
