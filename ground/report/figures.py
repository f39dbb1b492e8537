"""Pictures of a run of the testbed (Sease 2013, Figures 5.9 to 5.11), of a planned path, and of a fit.

The pictures are drawn with matplotlib's Figure objects, without the global state of pyplot.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ground.report import orbit_figures, panels
from ground.report.panels import RunSignals
from ground.report.signals import seconds
from ground.telemetry import Run, text_of

if TYPE_CHECKING:  # imported only for types, because these modules import the optimiser
    from ground.identification.fit import PlantFit
    from ground.identification.record import Record
    from knightcube.gnc.guidance.plant import SingleAxisPlant
    from knightcube.gnc.guidance.vmc import StepPlan

DPI = 110
WIDE = (11.0, 5.2)
TALL = (11.0, 7.6)
OVERVIEW = (10.9, 12.7)
PATH_WINDOW_S = 20.0
"""Length (s) of the time axis, from the command of a step, in the figure of the planned paths."""
_MIN_FIELD_ROTATION = np.radians(20.0)
"""Smallest rotation (rad) of the field in a run for which the figure of the coil cage is drawn."""
_FIELD_STRIDE = 40  # number of magnetometer readings (one second) of which only the first is drawn


def save(figure: Figure, file: Path) -> None:
    """Write a picture as PNG. Raises OSError."""
    figure.savefig(file, dpi=DPI, facecolor="white", format="png")


def draw_figures(run: Run, folder: Path) -> list[Path]:
    """Draw all pictures for which the run has data and return the files. Raises OSError."""
    signals = RunSignals(run)
    in_orbit: dict[str, Callable[[RunSignals], Figure | None]] = {
        "power": _power,
        "cycle_times": _cycle_times,
        "spin": orbit_figures.spin_figure,
        "knowledge": orbit_figures.knowledge_figure,
        "pointing": orbit_figures.pointing_figure,
        "track": orbit_figures.track_figure,
        "objects": orbit_figures.objects_figure,
        "battery": orbit_figures.battery_figure,
    }
    on_testbed: dict[str, Callable[[RunSignals], Figure | None]] = {
        "attitude": _attitude,
        "current": _current,
        "power": _power,
        "paths": _paths,
        "cycle_times": _cycle_times,
        "rate": _rate,
        "overview": _overview,
        "cage": cage_figure,
    }
    pictures = in_orbit if len(run["spin"]) else on_testbed | in_orbit
    files = []
    for name, picture in pictures.items():
        figure = picture(signals)
        if figure is not None:
            files.append(folder / f"{name}.png")
            save(figure, files[-1])
    return files


def draw_comparison(first: Run, second: Run, folder: Path) -> Path:
    """Draw attitude, rate and power of two runs into one picture and return its file. Raises OSError."""
    figure = Figure(figsize=TALL, layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    for run, letter, colour in ((first, "A", panels.BLUE), (second, "B", panels.ORANGE)):
        panels.compared(axes, RunSignals(run), letter, colour)
    panels.style(axes[0], "$q_2$", "Attitude", "")
    panels.style(axes[1], "rate, mrad/s", "Rate", "")
    panels.style(axes[2], "power, mW", "Running average of the coils' supply power")
    for ax in axes:
        panels.legend(ax)
    path = folder / "comparison.png"
    save(figure, path)
    return path


def _single(signals: RunSignals, panel: Callable[[Axes, RunSignals], None]) -> Figure:
    figure = Figure(figsize=WIDE, layout="constrained")
    panel(figure.subplots(), signals)
    return figure


def _attitude(signals: RunSignals) -> Figure | None:
    return _single(signals, panels.attitude) if len(signals.flown.time) else None


def _current(signals: RunSignals) -> Figure | None:
    return _single(signals, panels.current) if len(signals.run["control"]) else None


def _power(signals: RunSignals) -> Figure | None:
    return _single(signals, panels.power) if signals.power is not None else None


def _paths(signals: RunSignals) -> Figure | None:
    """Draw the planned paths of the first two steps and the flown attitude."""
    targets = signals.run["target"][:2]
    if not len(targets) or not len(signals.run["plan"]):
        return None
    figure = Figure(figsize=TALL, layout="constrained")
    axes = figure.subplots(len(targets), 1, squeeze=False)[:, 0]
    starts = seconds(targets)
    stops = np.minimum(np.append(starts[1:], signals.end), starts + PATH_WINDOW_S)
    for ax, target, start, stop in zip(axes, targets, starts, stops, strict=True):
        title = f"Step {int(target['index'])}: planned and flown"
        panels.paths(ax, signals, float(start), float(stop), float(target["q2"]), title)
    return figure


def _cycle_times(signals: RunSignals) -> Figure | None:
    """Draw the distributions of lateness, execution time and job times."""
    timing, jobs = signals.run["cycle_timing"], signals.run["job_timing"]
    if not len(timing):
        return None
    figure = Figure(figsize=TALL, layout="constrained")
    axes = figure.subplots(2 if len(jobs) else 1, 1, squeeze=False)[:, 0]
    cycle = {name: timing[name].astype(float) for name in ("lateness", "execution")}
    identity = signals.run["run"]
    period = float(identity["control_period_ns"][0]) * 1e-9 if len(identity) else None
    panels.exceedance(axes[0], cycle, "Control cycles", period)
    if len(jobs):
        names = np.array([text_of(name) for name in jobs["name"]], dtype=object)
        work = {str(name): jobs["execution"][names == name].astype(float) for name in sorted(set(names))}
        panels.exceedance(axes[1], work, "Jobs of the workers")
    return figure


def _stack(
    signals: RunSignals, drawn: Sequence[Callable[[Axes, RunSignals], None]], size: tuple[float, float]
) -> Figure:
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(drawn), 1, sharex=True, squeeze=False)[:, 0]
    for ax, panel in zip(axes, drawn, strict=True):
        panel(ax, signals)
        if ax is not axes[-1]:
            ax.set_xlabel("")
    return figure


def _rate(signals: RunSignals) -> Figure | None:
    """Draw the estimated rate and, if the truth is known, the error of the rate."""
    if not len(signals.flown.time):
        return None
    if signals.truth is None:
        return _single(signals, panels.rate)
    return _stack(signals, [panels.rate, panels.rate_error], TALL)


def _overview(signals: RunSignals) -> Figure | None:
    """Draw attitude, current, power and rate in panels below each other, as shown in the README."""
    if not len(signals.flown.time):
        return None
    drawn = [panels.attitude, panels.current, *([panels.power] if signals.power else []), panels.rate]
    return _stack(signals, drawn, OVERVIEW)


def cage_figure(signals: RunSignals) -> Figure | None:
    """Return the figure of a testbed in a coil cage: attitude, field and coil currents over time.

    Returns None for a run in a fixed field, or without magnetometer readings.
    """
    imu, flown = signals.run["imu"][::_FIELD_STRIDE], signals.flown
    if len(imu) < 2 or not len(flown.time):
        return None
    time = seconds(imu)
    angle = np.interp(time, flown.time, 2.0 * np.arcsin(np.clip(flown.q2, -1.0, 1.0)))
    in_body = imu["field"].astype(float)
    sine, cosine = np.sin(angle), np.cos(angle)
    x = in_body[:, 0] * cosine + in_body[:, 2] * sine
    z = in_body[:, 2] * cosine - in_body[:, 0] * sine
    azimuth = np.unwrap(np.arctan2(x, -z))
    if float(np.ptp(azimuth)) < _MIN_FIELD_ROTATION:
        return None
    figure = Figure(figsize=(10.9, 12.0), layout="constrained")
    attitude, strength, direction, current = figure.subplots(4, 1, sharex=True)
    panels.attitude(attitude, signals)
    for values, name, colour in ((x, "x", panels.BLUE), (z, "z", panels.ORANGE)):
        strength.plot(time, 1e6 * values, color=colour, linewidth=0.8, label=f"along {name}")
    strength.plot(time, 1e6 * np.hypot(x, z), color=panels.BLACK, linewidth=1.0, label="strength")
    body = 2.0 * np.degrees(np.arcsin(np.clip(flown.q2, -1.0, 1.0)))
    direction.plot(time, np.degrees(azimuth), color=panels.GREEN, linewidth=1.0, label="field, from -z to x")
    direction.plot(flown.time, body, color=panels.BLUE, linewidth=1.0, label="body")
    panels.current(current, signals)
    panels.style(strength, "field, µT", "Field of the cage in the testbed's axes", "")
    panels.style(direction, "deg", "Direction of the field and angle of the body", "")
    for ax in (strength, direction):
        panels.legend(ax)
    attitude.set_xlabel("")
    return figure


def path_figure(plan: StepPlan, plant: SingleAxisPlant) -> Figure:
    """Return the figure of a planned path with q2, rate, current and nodes (Sease 2013, Fig. 5.4 to 5.6)."""
    last = plan.horizon * (1.0 - 1e-12)  # just before the end of the path, after which the target is held
    time, nodes = np.linspace(0.0, last, 401), np.minimum(plan.node_times, last)
    figure = Figure(figsize=(OVERVIEW[0], 0.75 * OVERVIEW[1]), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    for instants, mark, label in ((time, "-", "path"), (nodes, "o", "nodes")):
        angle, rate, acceleration = plan.path.motion(instants)
        drawn = (np.sin(0.5 * angle), 1e3 * rate, plant.currents(angle, rate, acceleration))
        for ax, values in zip(axes, drawn, strict=True):
            ax.plot(instants, values, mark, color=panels.BLUE, markersize=4.0, label=label)
    panels.level(axes[0], plan.target_q2, "target")
    panels.level(axes[2], -plant.current_limit, "")
    panels.level(axes[2], plant.current_limit, f"limit, {plant.current_limit:.4g} A")
    stretched = f", stretched from {plan.horizon_asked:g} s" if plan.horizon > plan.horizon_asked else ""
    title = f"Planned path: {plan.energy:.4g} J in {plan.horizon:.4g} s{stretched}"
    panels.style(axes[0], "$q_2$", title, "")
    panels.style(axes[1], "rate, mrad/s", "Rate", "")
    panels.style(axes[2], "current, A", "Current", "time, s")
    for ax in axes:
        panels.legend(ax)
    return figure


def fit_figure(record: Record, found: PlantFit) -> Figure:
    """Return the figure of an identification with plots of angle, current and normalised innovations."""
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
        for value in (-3.0, 3.0):
            ax.axhline(value, color=panels.GREY, linestyle=panels.DASHED, linewidth=1.0)
        panels.style(ax, "sigma", f"Innovations of the {name}", "mission time, s" if column else "")
    panels.style(axes[0], "angle, deg", "Rotation about the thread", "")
    panels.style(axes[1], "current, mA", "Commanded current", "")
    panels.legend(axes[0])
    return figure
