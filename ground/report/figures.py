"""The pictures of a run: Sease 2013, Figures 5.9-5.11, and what the thesis could not show.

Drawn through matplotlib's Figure objects, without pyplot's global state.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flight.link.telemetry.packets import to_text
from ground.report import panels
from ground.report.cage_figure import cage_figure
from ground.report.knowledge_figure import knowledge_figure
from ground.report.objects_figure import objects_figure
from ground.report.orbit_figure import orbit_figure
from ground.report.scene import Scene
from ground.report.signals import seconds
from ground.report.spin_figure import spin_figure
from ground.report.track_figure import track_figure
from ground.telemetry.reader import Run

DPI = 110
WIDE = (11.0, 5.2)
TALL = (11.0, 7.6)
OVERVIEW = (10.9, 12.7)
PATH_WINDOW_S = 20.0
_IN_ORBIT = ("power", "cycle_times", "spin", "knowledge", "pointing", "track", "objects")


def draw_figures(run: Run, folder: Path) -> list[Path]:
    """Draw every picture that the run has something for; returns the files. Raises OSError."""
    scene = Scene(run)
    pictures: dict[str, Callable[[Scene], Figure | None]] = {
        "attitude": _attitude,
        "current": _current,
        "power": _power,
        "paths": _paths,
        "cycle_times": _cycle_times,
        "rate": _rate,
        "overview": _overview,
        "cage": cage_figure,
        "spin": lambda scene: spin_figure(scene.run),
        "knowledge": lambda scene: knowledge_figure(scene.run),
        "pointing": orbit_figure,
        "track": lambda scene: track_figure(scene.run),
        "objects": lambda scene: objects_figure(scene.run),
    }
    if len(run["spin"]):  # a satellite in orbit has no q2
        pictures = {name: pictures[name] for name in _IN_ORBIT}
    files = []
    for name, picture in pictures.items():
        figure = picture(scene)
        if figure is not None:
            files.append(folder / f"{name}.png")
            figure.savefig(files[-1], dpi=DPI, facecolor="white")
    return files


def draw_comparison(first: Run, second: Run, folder: Path) -> Path:
    """Draw attitude, rate and power of two runs over each other; returns the file. Raises OSError."""
    figure = Figure(figsize=TALL, layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    for run, letter, colour in ((first, "A", panels.BLUE), (second, "B", panels.ORANGE)):
        panels.compared(axes, Scene(run), letter, colour)
    for ax, label, title in zip(
        axes,
        ("$q_2$", "rate, mrad/s", "power, mW"),
        ("Attitude", "Rate", "Average supply power of the coils so far"),
        strict=True,
    ):
        panels.style(ax, label, title, "" if ax is not axes[-1] else "mission time, s")
        panels.legend(ax)
    path = folder / "comparison.png"
    figure.savefig(path, dpi=DPI, facecolor="white")
    return path


def _single(scene: Scene, panel: Callable[[Axes, Scene], None]) -> Figure:
    figure = Figure(figsize=WIDE, layout="constrained")
    panel(figure.subplots(), scene)
    return figure


def _attitude(scene: Scene) -> Figure | None:
    return _single(scene, panels.attitude) if len(scene.flown.time) else None


def _current(scene: Scene) -> Figure | None:
    return _single(scene, panels.current) if len(scene.run["control"]) else None


def _power(scene: Scene) -> Figure | None:
    return _single(scene, panels.power) if scene.power is not None else None


def _paths(scene: Scene) -> Figure | None:
    """Draw the planned paths of the first two steps against the flown one."""
    targets = scene.run["target"][:2]
    if not len(targets) or not len(scene.run["plan"]):
        return None
    figure = Figure(figsize=TALL, layout="constrained")
    axes = figure.subplots(len(targets), 1, squeeze=False)[:, 0]
    starts = seconds(targets)
    stops = np.minimum(np.append(starts[1:], scene.end), starts + PATH_WINDOW_S)
    for ax, target, start, stop in zip(axes, targets, starts, stops, strict=True):
        title = f"Step {int(target['index'])}: planned and flown"
        panels.paths(ax, scene, float(start), float(stop), float(target["q2"]), title)
    return figure


def _cycle_times(scene: Scene) -> Figure | None:
    """Draw the distributions of lateness, execution and the workers' times."""
    timing, jobs = scene.run["cycle_timing"], scene.run["job_timing"]
    if not len(timing):
        return None
    figure = Figure(figsize=TALL, layout="constrained")
    axes = figure.subplots(2 if len(jobs) else 1, 1, squeeze=False)[:, 0]
    cycle = {name: timing[name].astype(float) for name in ("lateness", "execution")}
    identity = scene.run["run"]
    period = float(identity["control_period_ns"][0]) * 1e-9 if len(identity) else None
    panels.exceedance(axes[0], cycle, "Control cycles", period)
    if len(jobs):
        names = np.array([to_text(name) for name in jobs["name"]], dtype=object)
        work = {str(name): jobs["execution"][names == name].astype(float) for name in sorted(set(names))}
        panels.exceedance(axes[1], work, "Jobs of the workers")
    return figure


def _rate(scene: Scene) -> Figure | None:
    """Draw the rate, and its error where the truth is known."""
    if not len(scene.flown.time):
        return None
    if scene.truth is None:
        return _single(scene, panels.rate)
    figure = Figure(figsize=TALL, layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True)
    panels.rate(top, scene)
    panels.rate_error(bottom, scene)
    top.set_xlabel("")
    return figure


def _overview(scene: Scene) -> Figure | None:
    """Stack attitude, current, power and rate: the picture of the README."""
    if not len(scene.flown.time):
        return None
    stack = [panels.attitude, panels.current, panels.power, panels.rate]
    if scene.power is None:
        stack.remove(panels.power)
    figure = Figure(figsize=OVERVIEW, layout="constrained")
    axes = figure.subplots(len(stack), 1, sharex=True, squeeze=False)[:, 0]
    for ax, panel in zip(axes, stack, strict=True):
        panel(ax, scene)
        if ax is not axes[-1]:
            ax.set_xlabel("")
    return figure
