"""The panels that the pictures are composed of, each drawn on axes it is given.

Colours are of the Okabe-Ito palette, distinguishable with all common kinds of colour vision.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator

from flight.link.telemetry.definitions import MAX_NODES
from ground.report import performance as limits
from ground.report.scene import Scene, planned_path, streak_rates
from ground.report.signals import seconds
from knightcube.astro.arrays import FloatArray

BLACK, GREY = "#222222", "#8a8a8a"
BLUE, ORANGE, GREEN, VERMILLION, PURPLE, SKY = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#D55E00",
    "#CC79A7",
    "#56B4E9",
)
PATH_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILLION)
COILS = ("x", "y", "z")
_ABSURD = 1e9  # mrad/s: no rate, but what a damaged log may hold


def style(ax: Axes, ylabel: str, title: str = "", xlabel: str = "mission time, s") -> None:
    """Give axes the look of all pictures."""
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
    """Put the legend above the axes, to the right of the title, where it hides nothing."""
    handles, labels = ax.get_legend_handles_labels()
    if handles:
        ax.legend(
            handles,
            labels,
            ncols=len(handles),
            loc="lower right",
            bbox_to_anchor=(1.0, 0.98),
            fontsize=9,
            frameon=False,
            borderaxespad=0.2,
            columnspacing=1.4,
        )


def attitude(ax: Axes, scene: Scene) -> None:
    """Draw q2: target, estimate and truth (Sease Figure 5.9)."""
    targets = scene.run["target"]
    if len(targets):
        times, values = seconds(targets), targets["q2"].astype(float)
        ax.step(
            np.append(times, scene.end),
            np.append(values, values[-1]),
            where="post",
            color=VERMILLION,
            linewidth=1.4,
            linestyle=(0, (5, 2)),
            label="target",
            zorder=3,
        )
    if len(scene.estimate.time):
        ax.plot(scene.estimate.time, scene.estimate.q2, color=SKY, linewidth=2.6, label="estimated")
    if scene.truth is not None:
        ax.plot(scene.truth.time, scene.truth.q2, color=BLACK, linewidth=1.0, label="true")
    style(ax, "$q_2$", "Attitude")
    legend(ax)


def current(ax: Axes, scene: Scene) -> None:
    """Draw the coil currents on the wire within their limit (Sease Figure 5.10)."""
    control = scene.run["control"]
    time, written = seconds(control), control["current_written"]
    for coil, colour in enumerate((BLUE, ORANGE, GREEN)):
        if np.any(written[:, coil]):
            values = written[:, coil].astype(float)
            ax.step(time, values, where="post", color=colour, linewidth=0.8, label=f"coil {COILS[coil]}")
    for sign in (-1.0, 1.0):
        ax.axhline(
            sign * scene.current_limit,
            color=VERMILLION,
            linewidth=1.2,
            linestyle=(0, (5, 2)),
            label=f"limit, {scene.current_limit:g} A" if sign > 0 else None,
        )
    style(ax, "current, A", "Torque coil current")
    legend(ax)


def power(ax: Axes, scene: Scene) -> None:
    """Draw the supply power with the thesis's 0.10 W (Sease Figure 5.11), and the average R I^2."""
    found = scene.power
    if found is None:
        return
    time, ends = found.time, found.time + found.spans
    ax.fill_between(time, found.supply, step="post", color=BLUE, alpha=0.35, linewidth=0.0)
    ax.step(time, found.supply, where="post", color=BLUE, linewidth=0.7, label="$V |I|$ at the coils")
    averages = [
        (ends, found.average_so_far(found.supply), BLACK, "average"),
        (ends, found.average_so_far(found.heat), GREEN, "average $R I^2$"),
    ]
    measured_at, measured = scene.bus_power
    if len(measured):
        so_far = np.cumsum(measured) / np.arange(1, len(measured) + 1)
        averages.insert(1, (measured_at, so_far, PURPLE, "average at the bus"))
    for times, average, colour, name in averages:
        ax.plot(times, average, color=colour, linewidth=1.6, label=f"{name}, {1e3 * average[-1]:.1f} mW")
    ax.axhline(
        limits.AVERAGE_SUPPLY_POWER_LIMIT_W,
        color=VERMILLION,
        linewidth=1.2,
        linestyle=(0, (5, 2)),
        label="thesis, 100 mW",
    )
    ax.set_ylim(bottom=0.0)
    style(ax, "power, W", "Coil power")
    legend(ax)


def compared(axes: Sequence[Axes], scene: Scene, name: str, colour: str) -> None:
    """Draw q2, the rate and the average supply power so far of one run of several into three axes."""
    flown, power = scene.flown, scene.power
    axes[0].plot(flown.time, flown.q2, color=colour, linewidth=1.4, label=name)
    axes[1].plot(flown.time, 1e3 * flown.rate, color=colour, linewidth=1.0, label=name)
    if power is not None:
        average = power.average_so_far(power.supply)
        axes[2].plot(power.time + power.spans, 1e3 * average, color=colour, linewidth=1.4, label=name)


def paths(ax: Axes, scene: Scene, start: float, stop: float, target: float, title: str) -> None:
    """Draw the paths planned from `start` on, on their nodes, against the flown one until `stop`, s."""
    flown = scene.flown
    inside = (flown.time >= start) & (flown.time <= stop)
    ax.plot(
        flown.time[inside] - start,
        flown.q2[inside],
        color=BLACK,
        linewidth=3.2,
        alpha=0.3,
        label=f"flown ({'true' if flown.source == 'truth' else 'estimated'})",
    )
    plans = scene.run["plan"]
    origin = plans["origin_ns"] / 1e9
    drawable = (plans["accepted"] == 1) & (plans["nodes"] >= 2) & (plans["nodes"] <= MAX_NODES)
    chosen = plans[drawable & (origin >= start - 0.5) & (origin < stop)]
    for i, plan in enumerate(chosen):
        time, values, node_time, node_values = planned_path(plan)
        colour = PATH_COLOURS[i % len(PATH_COLOURS)]
        ax.plot(time - start, values, color=colour, linewidth=1.3, label=f"plan {int(plan['number'])}")
        ax.plot(node_time - start, node_values, "o", color=colour, markersize=3.5)
    ax.axhline(target, color=VERMILLION, linewidth=1.2, linestyle=(0, (5, 2)), label="target")
    ax.set_xlim(-0.01 * (stop - start), stop - start)
    style(ax, "$q_2$", title, "time since the command, s")
    legend(ax)


def rate(ax: Axes, scene: Scene) -> None:
    """Draw the rate about the thread: estimated, true, and from streaks with their standard deviations."""
    if len(scene.estimate.time):
        ax.plot(scene.estimate.time, 1e3 * scene.estimate.rate, color=SKY, linewidth=2.6, label="estimated")
    if scene.truth is not None:
        ax.plot(scene.truth.time, 1e3 * scene.truth.rate, color=BLACK, linewidth=1.0, label="true")
    middle, value, sigma, _ = streak_rates(scene.run)
    if len(middle):
        ax.errorbar(
            middle,
            1e3 * value,
            yerr=1e3 * sigma,
            fmt="o",
            markersize=3.5,
            color=ORANGE,
            ecolor=ORANGE,
            elinewidth=1.0,
            label="from streaks",
            zorder=4,
        )
    style(ax, "rate, mrad/s", "Rate about the thread")
    legend(ax)


def rate_error(ax: Axes, scene: Scene) -> None:
    """Draw the errors of the estimated rate and of the streak rates against the truth."""
    truth, control = scene.truth, scene.run["control"]
    if truth is None:
        return
    control = control[np.isfinite(control["rate"]) & np.isfinite(control["rate_sigma"])]
    time, bound = seconds(control), 3e3 * control["rate_sigma"].astype(float)
    error = 1e3 * (control["rate"] - np.interp(time, truth.time, truth.rate))
    ax.fill_between(
        time, -bound, bound, color=SKY, alpha=0.35, linewidth=0.0, label=r"$\pm 3\sigma$ of the estimate"
    )
    ax.plot(time, error, color=BLUE, linewidth=0.6, label="estimated less true")
    middle, _, sigma, difference = streak_rates(scene.run)
    known = np.isfinite(difference)
    if known.any():
        ax.errorbar(
            middle[known],
            1e3 * difference[known],
            yerr=1e3 * sigma[known],
            fmt="o",
            markersize=3.5,
            color=ORANGE,
            ecolor=ORANGE,
            elinewidth=0.8,
            label=r"streaks less true, $\pm\sigma$",
        )
    everything = np.concatenate([np.abs(error), bound, np.abs(1e3 * difference[known])])
    everything = everything[everything < _ABSURD]
    if len(everything):  # a start-up transient must not flatten the rest
        span = 1.5 * float(np.percentile(everything, 99.0)) or 1.0
        ax.set_ylim(-span, span)
    style(ax, "error, mrad/s", "Error of the rate")
    legend(ax)


def exceedance(ax: Axes, values: dict[str, FloatArray], title: str, bound: float | None = None) -> None:
    """Draw the share of values larger than x, of each named set of times in s; a line at `bound` s.

    On axes of decades: one late cycle of thousands is as plain as the median. Times of zero, as the lateness
    in lock-step, have no place on them and are stated in the legend.
    """
    least = []
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
        least.append(x[0])
    if bound is not None:
        label = f"period, {duration(bound)}"
        ax.axvline(bound, color=VERMILLION, linewidth=1.2, linestyle=(0, (5, 2)), label=label)
    style(ax, "share above", title, "time")
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter(lambda share, _: f"{100.0 * share:g} %")
    if least or bound is not None:
        ax.set_xscale("log")
        ax.margins(x=0.05)
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
        ax.xaxis.set_major_formatter(lambda time, _: duration(time))
    legend(ax)


def duration(time: float) -> str:
    """Return a time in s as text of three digits with its unit."""
    scale, unit = next(((s, u) for s, u in ((1.0, "s"), (1e3, "ms")) if abs(time) * s >= 0.9995), (1e6, "µs"))
    return f"{time * scale:.3g} {unit}"
