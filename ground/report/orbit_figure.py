"""The picture of a flight in orbit: pointing by axis, rate, dipole, power, field, light, modes, targets."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flight.link import events
from flight.link.modes import Mode
from flight.link.telemetry.packets import to_text
from ground.report import panels
from ground.report.pointing import pointing_errors
from ground.report.scene import Scene
from ground.report.signals import seconds, true_rows
from ground.telemetry.reader import Run
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix

SIZE = (10.9, 14.0)
AXES = ("x", "y", "z")
COLOURS = (panels.BLUE, panels.ORANGE, panels.GREEN)
SMOOTHED = 30.0
"""s over which the power is averaged: the coils pause each second or two."""
DARK = 0.5
"""Share of the Sun's disc below which the satellite is drawn in shadow."""


def orbit_figure(scene: Scene) -> Figure | None:
    """Return the picture, None for a run that never pointed."""
    run = scene.run
    if not len(pointing_errors(run).times):
        return None
    figure = Figure(figsize=SIZE, layout="constrained")
    rows = figure.subplots(6, 1, sharex=True, height_ratios=(1.7, 1.0, 1.0, 1.0, 1.0, 0.8))
    error, rate, dipole, power, field, mode = rows
    _error(error, run)
    _rate(rate, run)
    _dipole(dipole, run)
    _power(power, scene)
    _field(field, run)
    _modes(mode, run, scene.end)
    for ax in rows:
        _shade(ax, run)
        panels.legend(ax)
    return figure


def _error(ax: Axes, run: Run) -> None:
    found = pointing_errors(run)
    _vectors(ax, found.times, np.degrees(found.error))
    sigma = 3.0 * np.degrees(found.sigma.max(axis=1))
    for sign, label in ((1.0, "3 sigma of the attitude"), (-1.0, None)):
        ax.plot(found.times, sign * sigma, "--", color=panels.GREY, linewidth=0.8, label=label)
    ax.set_yscale("symlog", linthresh=0.1)
    known = "true" if found.source == "truth" else "estimated"
    panels.style(ax, "error, deg", f"Pointing error about the body's axes, {known} attitude", "")


def _rate(ax: Axes, run: Run) -> None:
    name = "truth" if len(run["truth"]) else "attitude"
    speed = np.degrees(np.linalg.norm(run[name]["rate"].astype(float), axis=1))
    ax.semilogy(seconds(run[name]), np.maximum(speed, 1e-4), color=panels.BLUE, linewidth=0.9)
    panels.style(ax, "rate, deg/s", "Body rate", "")


def _dipole(ax: Axes, run: Run) -> None:
    """Draw the dipole while the coils act: the pauses for the magnetometer would fill the picture."""
    packets = run["attitude"]
    packets = packets[packets["dipole"].any(axis=1)]
    _vectors(ax, seconds(packets), 1e3 * packets["dipole"].astype(float))
    ax.set_yscale("symlog", linthresh=1.0)
    panels.style(ax, "dipole, mA m²", "Dipole wanted of the coils, pauses left out", "")


def _power(ax: Axes, scene: Scene) -> None:
    found = scene.power
    if found is not None:
        edges = np.arange(found.time[0], found.end + SMOOTHED, SMOOTHED)
        place = np.digitize(found.time, edges) - 1
        spans = np.bincount(place, found.spans, len(edges) - 1)
        for name, power, colour in (
            ("supply, V |I|", found.supply, panels.VERMILLION),
            ("R I²", found.heat, panels.GREEN),
        ):
            spent = np.bincount(place, power * found.spans, len(edges) - 1)
            mean = 1e3 * spent / np.where(spans > 0.0, spans, np.nan)
            ax.stairs(np.maximum(mean, 1e-3), edges, color=colour, linewidth=1.0, label=name)
        ax.set_yscale("log")
    panels.style(ax, "power, mW", f"Coil power, mean over {SMOOTHED:g} s", "")
    panels.legend(ax)


def _field(ax: Axes, run: Run) -> None:
    """Draw the Earth's field in body axes: the true one, else what the magnetometer read."""
    packets = run["orbit_truth"]
    place = true_rows(run["truth"], packets)
    if (place >= 0).any():
        packets, place = packets[place >= 0], place[place >= 0]
        into_body = attitude_matrix(run["truth"]["quaternion"][place].astype(float))
        values, times = np.einsum("nij,nj->ni", into_body, packets["field"].astype(float)), seconds(packets)
    else:
        values, times = run["imu"]["field"].astype(float), seconds(run["imu"])
    _vectors(ax, times, 1e6 * values)
    panels.style(ax, "field, µT", "Magnetic field in the body's axes", "")


def _modes(ax: Axes, run: Run, end: float) -> None:
    """Draw the modes as steps, and the targets by name at their times."""
    packets = run["mode"]
    if len(packets):
        times, modes = seconds(packets), packets["mode"].astype(int)
        used = sorted({int(mode) for mode in modes})
        levels = [used.index(int(mode)) for mode in modes]
        ax.step(np.append(times, end), [*levels, levels[-1]], where="post", color=panels.BLUE, linewidth=1.4)
        ax.set_yticks(range(len(used)), [Mode(mode).label for mode in used])
        ax.set_ylim(-0.5, len(used) - 0.2)
    happened = run["event"]
    for row in happened[happened["code"] == events.TARGET.code]:
        at = float(row["time_ns"]) * 1e-9
        ax.axvline(at, color=panels.PURPLE, linewidth=0.9)
        ax.annotate(
            to_text(row["text"]),
            (at, 1.0),
            (3, -2),
            ("data", "axes fraction"),
            "offset points",
            va="top",
            fontsize=8,
            color=panels.PURPLE,
        )
    panels.style(ax, "mode", "Modes, and targets as commanded")


def _shade(ax: Axes, run: Run) -> None:
    """Shade the time in the Earth's shadow."""
    packets = run["orbit_truth"]
    if not len(packets):
        return
    times = seconds(packets)
    dark = np.concatenate([[0], (packets["sunlit"] < DARK).astype(int), [0]])
    changes = np.flatnonzero(np.diff(dark))
    for begin, end in zip(changes[::2], changes[1::2], strict=True):
        last = float(times[min(end, len(times) - 1)])
        ax.axvspan(float(times[begin]), last, color=panels.GREY, alpha=0.15, linewidth=0)


def _vectors(ax: Axes, times: FloatArray, values: FloatArray) -> None:
    for axis, (name, colour) in enumerate(zip(AXES, COLOURS, strict=True)):
        ax.plot(times, values[:, axis], color=colour, linewidth=0.8, label=name)
