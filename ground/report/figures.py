"""Pictures of a run, of planned paths, slews and days, of an identification, and of a bench session.

The pictures of the testbed are those of Sease (2013), Figures 5.4 to 5.6 and 5.9 to 5.11. The pictures are
drawn with matplotlib's Figure objects, without the global state of pyplot.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import timedelta
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import DateFormatter
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from flight.link import events
from flight.link.telemetry.definitions import MODES, SHED
from flight.link.telemetry.packets import PacketArray
from ground.report import orbit, panels
from ground.report.panels import RunSignals
from ground.report.signals import PowerHistory, seconds, true_quaternions
from ground.telemetry import Run, named, text_of
from hal.interfaces.devices import COIL_NAMES
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orientation import celestial_to_terrestrial, geodetic
from knightcube.astro.quaternion import attitude_matrix
from knightcube.gnc.guidance.slew_model import Cone, heat_matrix, shown
from knightcube.gnc.guidance.slew_plan import OrderedSlew, SlewOrder, SlewStatus
from knightcube.vision.camera.images import grey_stretch, read_image

if TYPE_CHECKING:  # imported only for types, because these modules import the optimiser and Skyfield
    from ground.bringup.bench import Outcome
    from ground.identification.fit import PlantFit
    from ground.identification.record import Record
    from ground.passes import OrbitPrediction, Station
    from knightcube.gnc.guidance.plant import SingleAxisPlant
    from knightcube.gnc.guidance.vmc import StepPlan

DPI = 110
WIDE = (11.0, 5.2)
TALL = (11.0, 7.6)
OVERVIEW = (10.9, 12.7)
BENCH = (13.0, 10.0)
PATH_WINDOW_S = 20.0
"""Length (s) of the time axis in the figure of the planned paths; it begins at the command of a step."""
_MIN_FIELD_ROTATION = np.radians(20.0)
"""Smallest rotation (rad) of the field in a run for which the figure of the coil cage is drawn."""
_BENCH_SAMPLES = 400
_FOCUS_SIDE = 128  # side (px) of the section of the focus frame around its brightest pixel
_FIELD_STRIDE = 40  # interval, in magnetometer readings, between the drawn readings: one per second


def save(figure: Figure, file: Path) -> None:
    """Write a picture as PNG. Raises OSError."""
    figure.savefig(file, dpi=DPI, facecolor="white", format="png")


def draw_figures(run: Run, folder: Path) -> list[Path]:
    """Draw all pictures for which the run has data and return the files. Raises OSError."""
    signals = RunSignals(run)
    in_orbit: dict[str, Callable[[RunSignals], Figure | None]] = {
        "power": _power,
        "cycle_times": _cycle_times,
        "spin": spin_figure,
        "knowledge": knowledge_figure,
        "pointing": pointing_figure,
        "track": track_figure,
        "objects": objects_figure,
        "battery": battery_figure,
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
    """Plot attitude, rate and power of two runs in one figure, and return its path. Raises OSError."""
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
    timing, jobs = signals.run["cycle_timing"], signals.run["job_timing"]
    if not len(timing):
        return None
    figure = Figure(figsize=TALL, layout="constrained")
    axes = figure.subplots(2 if len(jobs) else 1, 1, squeeze=False)[:, 0]
    cycle = {name: timing[name].astype(float) for name in ("lateness", "execution")}
    identity = signals.run["run"]
    period = float(identity["control_period_ns"][0]) * 1e-9 if len(identity) else 0.0
    panels.exceedance(axes[0], cycle, "Control cycles", period or None)
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
    """Draw attitude, current, power and rate in panels one below the other, as shown in the README."""
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


SPIN_MARGIN = 0.2
"""Time shown before and after detumbling, as a fraction of the duration of detumbling."""
POWER_MEAN_S = 30.0
"""Averaging time (s) of the power. The coils pause every one or two seconds."""
SHADOW = 0.5
"""Visible fraction of the solar disc below which the satellite is drawn in shadow."""
TRACK_INTERVAL_S = 10.0
"""Time (s) between drawn points of the ground track."""
TRACK_MARK_S = 600.0
"""Shortest time (s) between marked points of the ground track."""
_MAX_MARKS = 60
"""Maximum number of marked points of the ground track."""
_CONES = {"Sun": panels.ORANGE, "Earth": panels.GREEN, "Moon": panels.GREY}
_OBJECT_COLOURS = (panels.BLUE, panels.ORANGE, panels.GREEN, panels.PURPLE)


def spin_figure(signals: RunSignals) -> Figure | None:
    """Return the figure of detumbling with rate, field and dipole.

    Returns None for a run without spin packets.
    """
    spin = signals.run["spin"]
    if not len(spin):
        return None
    figure = Figure(figsize=(10.9, 9.4), layout="constrained")
    rate, field, dipole = figure.subplots(3, 1, sharex=True)
    _detumbling_rate(rate, signals.run)
    panels.vectors(field, seconds(spin), 1e6 * spin["field"].astype(float))
    panels.vectors(dipole, seconds(spin), 1e3 * spin["dipole"].astype(float))
    panels.plain_ticks(rate)
    panels.style(rate, "rate, deg/s", "Detumbling", "")
    panels.style(field, "field, µT", "Magnetic field in the body frame", "")
    panels.style(dipole, "dipole, mA m²", "Commanded dipole")
    for ax in (rate, field, dipole):
        panels.legend(ax)
    return figure


def _detumbling_rate(ax: Axes, run: Run) -> None:
    """Draw the true rate, or else the gyro's, and the rate from the magnetometer with its uncertainty."""
    time, speed, source = orbit.body_speeds(run)
    spin = orbit.magnetometer_rates(run)
    if len(spin):
        at, found = seconds(spin), np.degrees(np.linalg.norm(spin["rate"].astype(float), axis=1))
        sigma = np.degrees(spin["rate_sigma"].astype(float))
        lower, upper, colour = np.maximum(found - sigma, 1e-3), found + sigma, panels.ORANGE
        ax.fill_between(at, lower, upper, color=colour, alpha=0.3, linewidth=0, label="1 sigma")
        ax.semilogy(at, found, ".", color=panels.ORANGE, markersize=5, label="from the magnetometer alone")
    label = "gyro" if source == "imu" else source
    ax.semilogy(time, np.degrees(speed), color=panels.BLUE, linewidth=1.2, label=label, zorder=3)
    periods = orbit.detumbling_periods(run, float((time if len(time) else seconds(run["spin"]))[-1]))
    for k, (begin, stop, _) in enumerate(periods):
        label = "" if k else "detumbling"
        ax.axvspan(begin, stop, color=panels.GREY, alpha=0.12, linewidth=0, label=label)
    if periods:
        margin = SPIN_MARGIN * (periods[-1][1] - periods[0][0])
        first, last = max(periods[0][0] - margin, 0.0), periods[-1][1] + margin
        last = min(last, float(time[-1])) if len(time) else last
        ax.set_xlim(first, last)
        shown_rows = (time >= first) & (time <= last)
        speed = speed[shown_rows]
    ax.set_ylim(bottom=max(1e-3, 0.5 * float(np.degrees(speed[speed > 0.0].min()))) if speed.any() else 1e-3)


def knowledge_figure(signals: RunSignals) -> Figure | None:
    """Return the figure of the attitude errors with their uncertainty, and the level of knowledge.

    Returns None for a run without navigation packets or without a truth log.
    """
    found, packets = orbit.attitude_errors(signals.run), signals.run["navigation"]
    if not (len(found.times) and len(packets)):
        return None
    figure = Figure(figsize=(10.9, 9.4), layout="constrained")
    *errors, level = figure.subplots(4, 1, sharex=True)
    for axis, (ax, (name, colour)) in enumerate(zip(errors, panels.AXIS_COLOURS.items(), strict=True)):
        error, bound = np.degrees(found.error[:, axis]), 3.0 * np.degrees(found.sigma[:, axis])
        grey = panels.GREY
        ax.fill_between(found.times, -bound, bound, color=grey, alpha=0.25, linewidth=0, label="3 sigma")
        ax.plot(found.times, error, color=colour, linewidth=0.9, label="error")
        ax.set_yscale("symlog", linthresh=0.01)
        panels.style(ax, f"{name}, deg", "Attitude error against the truth" if axis == 0 else "", "")
        panels.legend(ax)
    values = packets["knowledge"].astype(int)
    level.step(seconds(packets), values, where="post", color=panels.BLUE, linewidth=1.2)
    level.set_yticks(range(3), ("lost", "coarse", "fine"))
    panels.style(level, "knowledge", "Level of attitude knowledge")
    return figure


def pointing_figure(signals: RunSignals) -> Figure | None:
    """Return the figure of a flight in orbit, or None for a run without pointing.

    The panels show the pointing error, rate, dipole, power and magnetic field, and modes with targets. The
    power panel is omitted for a run without power data.
    """
    run = signals.run
    found = orbit.pointing_errors(run)
    if not len(found.times):
        return None
    spent = signals.power
    heights = (1.7, 1.0, 1.0, *(() if spent is None else (1.0,)), 1.0, 0.8)
    figure = Figure(figsize=(10.9, 14.0 / 6.5 * sum(heights)), layout="constrained")
    rows = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    error, rate, dipole, *powers, field, mode = rows
    _pointing_error(error, found)
    name = "truth" if len(run["truth"]) else "attitude"
    speed = np.degrees(np.linalg.norm(run[name]["rate"].astype(float), axis=1))
    rate.semilogy(seconds(run[name]), np.maximum(speed, 1e-4), color=panels.BLUE, linewidth=0.9)
    panels.style(rate, "rate, deg/s", "Body rate", "")
    # Cycles without a dipole are omitted: the coils pause often for the magnetometer.
    acting = run["attitude"][run["attitude"]["dipole"].any(axis=1)]
    panels.vectors(dipole, seconds(acting), 1e3 * acting["dipole"].astype(float))
    dipole.set_yscale("symlog", linthresh=1.0)
    panels.style(dipole, "dipole, mA m²", "Commanded dipole, pauses omitted", "")
    if spent is not None:
        _mean_power(powers[0], spent)
    _field(field, run)
    _modes(mode, run, signals.end)
    for ax in rows:
        _shade(ax, run["orbit_truth"])
        panels.legend(ax)
    return figure


def _pointing_error(ax: Axes, found: orbit.AttitudeErrors) -> None:
    panels.vectors(ax, found.times, np.degrees(found.error))
    sigma = 3.0 * np.degrees(found.sigma.max(axis=1))
    for sign, label in ((1.0, "3 sigma of the attitude"), (-1.0, None)):
        ax.plot(found.times, sign * sigma, "--", color=panels.GREY, linewidth=0.8, label=label)
    ax.set_yscale("symlog", linthresh=0.1)
    known = "true" if found.source == "truth" else "estimated"
    panels.style(ax, "error, deg", f"Pointing error about the body axes, {known} attitude", "")


def _mean_power(ax: Axes, found: PowerHistory) -> None:
    edges = np.arange(found.time[0], found.end + POWER_MEAN_S, POWER_MEAN_S)
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
    panels.style(ax, "power, mW", f"Coil power, mean over {POWER_MEAN_S:g} s", "")


def _field(ax: Axes, run: Run) -> None:
    """Draw the Earth's magnetic field in the body frame: the true or, if unknown, the measured field."""
    packets = run["orbit_truth"]
    true = true_quaternions(run["truth"], packets)
    known = np.isfinite(true[:, 0])
    if known.any():
        packets, into_body = packets[known], attitude_matrix(true[known])
        values, times = np.einsum("nij,nj->ni", into_body, packets["field"].astype(float)), seconds(packets)
    else:
        values, times = run["imu"]["field"].astype(float), seconds(run["imu"])
    panels.vectors(ax, times, 1e6 * values)
    panels.style(ax, "field, µT", "Magnetic field in the body frame", "")


def _modes(ax: Axes, run: Run, end: float) -> None:
    packets = run["mode"]
    if len(packets):
        times, modes = seconds(packets), packets["mode"].astype(int)
        used = sorted({int(mode) for mode in modes})
        levels = [used.index(int(mode)) for mode in modes]
        ax.step(np.append(times, end), [*levels, levels[-1]], where="post", color=panels.BLUE, linewidth=1.4)
        ax.set_yticks(range(len(used)), [named(MODES, mode) for mode in used])
        ax.set_ylim(-0.5, len(used) - 0.2)
    happened = run["event"]
    for row in happened[happened["code"] == events.TARGET.code]:
        at, colour = float(row["time_ns"]) * 1e-9, panels.PURPLE
        ax.axvline(at, color=colour, linewidth=0.9)
        place = (at, 1.0), (3, -2), ("data", "axes fraction"), "offset points"
        ax.annotate(text_of(row["text"]), *place, va="top", fontsize=8, color=colour)
    panels.style(ax, "mode", "Modes and commanded targets")


def _shade(ax: Axes, packets: PacketArray) -> None:
    if not len(packets):
        return
    times = seconds(packets)
    dark = np.concatenate([[0], (packets["sunlit"] < SHADOW).astype(int), [0]])
    changes = np.flatnonzero(np.diff(dark))
    for begin, end in zip(changes[::2], changes[1::2], strict=True):
        last = float(times[min(end, len(times) - 1)])
        ax.axvspan(float(times[begin]), last, color=panels.GREY, alpha=0.15, linewidth=0)


def track_figure(signals: RunSignals) -> Figure | None:
    """Return the figure of the ground track in sunlight and shadow.

    Returns None if the true position is unknown.
    """
    packets = signals.run["orbit_truth"]
    if not len(packets):
        return None
    _, kept = np.unique((seconds(packets) / TRACK_INTERVAL_S).astype(int), return_index=True)
    packets = packets[kept]
    times, into_earth = seconds(packets), celestial_to_terrestrial(packets["utc"].astype(float))
    position = np.einsum("nij,nj->ni", into_earth, packets["position"].astype(float))
    longitude, latitude, height = geodetic(position)
    east, north = np.degrees(longitude), np.degrees(latitude)
    figure = Figure(figsize=(10.9, 5.8), layout="constrained")
    ax = figure.subplots()
    dark = packets["sunlit"] < SHADOW
    for inside, colour, label in ((~dark, panels.ORANGE, "sunlit"), (dark, panels.BLUE, "in shadow")):
        ax.plot(east[inside], north[inside], ".", color=colour, markersize=4, label=label)
    interval = TRACK_MARK_S * max(1.0, np.ceil((times[-1] - times[0]) / (TRACK_MARK_S * _MAX_MARKS)))
    marked = np.searchsorted(times, np.arange(times[0], times[-1], interval))
    ax.plot(east[marked], north[marked], "o", color=panels.BLACK, markersize=4)
    for k in marked:
        label, place = f"{times[k] / 60.0:.0f} min", (east[k], north[k])
        ax.annotate(label, place, (5, 4), textcoords="offset points", fontsize=8)
    ax.set_xlim(-180, 180)
    ax.set_ylim(-90, 90)
    ax.set_xticks(range(-180, 181, 30))
    ax.set_yticks(range(-90, 91, 30))
    ax.set_aspect("equal")
    title = f"Ground track, {np.min(height) * 1e-3:.0f} to {np.max(height) * 1e-3:.0f} km above the ellipsoid"
    panels.style(ax, "latitude, deg", title, "longitude, deg")
    panels.legend(ax)
    return figure


def battery_figure(signals: RunSignals) -> Figure | None:
    """Return the figure of charge, powers and shed loads, or None without a power system."""
    packets, true = signals.run["power"], signals.run["true_power"]
    if not len(packets):
        return None
    times = seconds(packets)
    figure = Figure(figsize=(10.9, 8.2), layout="constrained")
    charge, power, shed = figure.subplots(3, 1, sharex=True)
    charge.plot(times, 100.0 * packets["charge"], color=panels.BLUE, label="estimated")
    drawn = packets["battery_voltage"].astype(float) * packets["battery_current"].astype(float)
    power.plot(times, drawn, color=panels.BLUE, label="out of the battery, measured")
    if len(true):
        at = seconds(true)
        charge.plot(at, 100.0 * true["charge"], "--", color=panels.BLACK, label="true")
        for name, label, colour in (
            ("solar_power", "solar panels", panels.ORANGE),
            ("load_power", "all loads", panels.VERMILLION),
            ("coil_power", "coils", panels.GREEN),
        ):
            power.plot(at, true[name], color=colour, linewidth=1.0, label=label)
    shed.step(times, packets["shed"], where="post", color=panels.BLUE)
    shed.set_yticks([number for number, _ in SHED], [name for _, name in SHED])
    panels.style(charge, "charge, %", "State of charge", "")
    panels.style(power, "power, W", "Powers", "")
    panels.style(shed, "", "Loads shed: each step includes those below it")
    frames = signals.run["streak"]["exposure_start_ns"] * 1e-9
    shed.plot(frames, np.full(len(frames), -0.4), "|", color=panels.PURPLE, label="frames of the star camera")
    for ax in (charge, power, shed):
        _shade(ax, signals.run["orbit_truth"])
        panels.legend(ax)
    return figure


def objects_figure(signals: RunSignals) -> Figure | None:
    """Return the figure of the tracked objects' paths, rates and brightness, or None without objects."""
    tracks = orbit.object_tracks(signals.run)
    if not tracks:
        return None
    figure = Figure(figsize=(11.0, 7.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.1, 1.0))
    path, rate, brightness = (figure.add_subplot(grid[place]) for place in ((slice(None), 0), (0, 1), (1, 1)))
    for k, packets in enumerate(tracks):
        colour, label = _OBJECT_COLOURS[k % len(_OBJECT_COLOURS)], f"object {int(packets['number'][0])}"
        times, direction = packets["middle_ns"] * 1e-9, packets["direction"].astype(float)
        right = np.unwrap(np.arctan2(direction[:, 1], direction[:, 0]))
        right = np.degrees(right - 2.0 * np.pi * np.floor(right[0] / (2.0 * np.pi)))
        up = np.degrees(np.arcsin(np.clip(direction[:, 2], -1.0, 1.0)))
        path.plot(right, up, color=colour, label=label)
        path.plot(right[:1], up[:1], "o", color=colour)
        speed = np.degrees(np.linalg.norm(packets["rate"].astype(float), axis=1))
        rate.plot(times, speed, color=colour, label=label)
        brightness.plot(times, packets["magnitude"], color=colour, label=label)
        missed = packets["seen"] <= 0
        if missed.any():
            path.plot(right[missed], up[missed], "x", color=colour, markersize=4, label="not detected")
    path.set_aspect("equal", adjustable="datalim")
    path.invert_xaxis()
    brightness.invert_yaxis()
    panels.style(
        path, "declination, deg", "Paths among the stars, starting at the dot", "right ascension, deg"
    )
    panels.style(rate, "deg/s", "Angular rate")
    panels.style(brightness, "V", "Magnitude, mean of the last detections")
    path.legend(loc="best", fontsize=9)
    return figure


def slew_figure(made: OrderedSlew, order: SlewOrder) -> Figure:
    """Return the figure of a planned slew: boresights on the sky, dipole, torque and energy."""
    figure = Figure(figsize=(10.9, 12.6), layout="constrained")
    grid = figure.add_gridspec(4, 1, height_ratios=(2.3, 1.0, 1.0, 1.0))
    sky = figure.add_subplot(grid[0], projection="mollweide")
    dipole = figure.add_subplot(grid[1])
    torque, energy = (figure.add_subplot(grid[k], sharex=dipole) for k in (2, 3))
    times = np.linspace(0.0, made.plan.horizon, 601)
    _slew_sky(sky, made, order, times)
    dipoles, limits = 1e3 * made.plan.path.dipoles(times), 1e3 * made.task.craft.limit
    panels.vectors(dipole, times, dipoles)
    text = ", ".join(f"{name} {limit:.3g}" for name, limit in zip("xyz", limits, strict=True))
    # A limit is drawn only if a curve comes near it, because a distant line would flatten the curves.
    for (name, colour), limit in zip(panels.AXIS_COLOURS.items(), limits.tolist(), strict=True):
        if np.abs(dipoles).max() > 0.3 * limit:
            panels.level(dipole, -limit, "", colour)
            panels.level(dipole, limit, f"limit {name}", colour)
    panels.style(dipole, "dipole, mA m²", f"Dipole; the limits are {text} mA m²", "")
    _slew_torque(torque, made, times)
    moments = made.plan.path.dipoles(times)
    power = np.sum(moments @ heat_matrix(made.task.craft.weights) * moments, axis=1)
    heat = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(times) * (power[1:] + power[:-1]))])
    energy.fill_between(times, heat, color=panels.BLUE, alpha=0.35, linewidth=0)
    energy.set_ylim(bottom=0.0)
    panels.style(energy, "energy, J", "Accumulated heat of the coils", "time since the start of the slew, s")
    for ax in (dipole, torque, energy):
        panels.legend(ax)
    return figure


def _slew_sky(ax: Axes, made: OrderedSlew, order: SlewOrder, times: FloatArray) -> None:
    """Draw the paths of the pointing axis and of the star camera's boresight, and the exclusion cones."""
    plan = made.plan
    turned = attitude_matrix(plan.path.references(times).quaternion)
    handles: list[Line2D | Patch] = [*_cones(ax, made.task.cones, times[[0, -1]])]
    axes = [("pointing axis", order.axes.pointing, panels.BLUE), ("star camera", order.camera, panels.PURPLE)]
    for name, axis, colour in axes[: 1 if np.allclose(order.axes.pointing, order.camera) else 2]:
        path = axis @ turned
        east, north = np.arctan2(path[:, 1], path[:, 0]), np.arcsin(np.clip(path[:, 2], -1.0, 1.0))
        # The drawn line has a gap where the path crosses the edge of the map.
        jumps = np.flatnonzero(np.abs(np.diff(east)) > np.pi) + 1
        ax.plot(*(np.insert(values, jumps, np.nan) for values in (east, north)), color=colour, linewidth=1.8)
        ax.plot(east[0], north[0], "o", color=colour, markersize=8, markerfacecolor="white")
        ax.plot(east[-1], north[-1], "o", color=colour, markersize=8)
        handles.append(Line2D([], [], color=colour, linewidth=1.8, label=name))
    for fill, name in (("white", "start"), (panels.BLACK, "end")):
        mark = Line2D([], [], color=panels.BLACK, marker="o", markerfacecolor=fill, ls="", label=name)
        handles.append(mark)
    stretched = f", stretched from {plan.horizon_asked:g} s" if plan.status is SlewStatus.STRETCHED else ""
    title = f"Planned slew: {plan.energy:.4g} J in {plan.horizon:.4g} s{stretched}"
    title += "; the sky in right ascension and declination"
    ax.set_title(title, loc="left", fontsize=11, fontweight="bold", color=panels.BLACK, pad=22.0)
    ax.grid(True, color="#e4e4e4", linewidth=0.8)
    ax.tick_params(labelsize=8, labelcolor=panels.GREY)
    place = (0.5, -0.02)
    ax.legend(handles=handles, loc="upper center", bbox_to_anchor=place, ncols=4, fontsize=9, frameon=False)


def _cones(ax: Axes, cones: tuple[Cone, ...], ends: FloatArray) -> Iterator[Patch]:
    """Draw the exclusion cones (shaded at the first time, dashed at the second); yield legend entries."""
    longitude, latitude = np.meshgrid(np.radians(np.arange(-180, 181)), np.radians(np.arange(-90, 91)))
    level = np.cos(latitude)
    grid = np.stack([level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)], axis=2)
    for cone in cones:
        angles = cone.half_angles(ends)
        colour, label = _CONES[cone.name], f"{cone.name} cone, {np.degrees(angles[0]):.0f} deg"
        first, last = (
            grid @ towards - np.cos(angle)
            for towards, angle in zip(cone.direction(ends), angles, strict=True)
        )
        ax.contourf(longitude, latitude, first, [0.0, 9.0], colors=[colour], alpha=0.3)
        ax.contour(longitude, latitude, last, [0.0], colors=[colour], linestyles="dashed", linewidths=1.2)
        yield Patch(facecolor=colour, alpha=0.4, label=label)


def _slew_torque(ax: Axes, made: OrderedSlew, times: FloatArray) -> None:
    """Draw the components of the required torque perpendicular to and along the magnetic field."""
    task, path = made.task, made.plan.path
    reference, craft, around = path.references(times), task.craft, task.along(times)
    q = reference.quaternion
    down, strength = around.gradient()
    field, down = shown(q, around.field), shown(q, down)
    disturbance = strength[:, None] * np.cross(down, down @ craft.inertia) + craft.torque
    gyroscopic = np.cross(reference.rate, reference.rate @ craft.inertia)
    torque = (
        reference.acceleration @ craft.inertia + gyroscopic - disturbance - np.cross(craft.residual, field)
    )
    size = np.linalg.norm(field, axis=1)
    along = np.sum(torque * field, axis=1) / size
    across = np.linalg.norm(torque - along[:, None] * field / size[:, None], axis=1)
    ax.plot(times, 1e6 * across, color=panels.BLUE, linewidth=1.3, label="across the field")
    label = "along the field, not available"
    ax.plot(times, 1e6 * along, color=panels.VERMILLION, linewidth=1.3, label=label)
    # Largest ratio, over the body axes, of the dipole for the torque across the field to its limit.
    share = np.max(np.abs(np.cross(field, torque)) / size[:, None] ** 2 / craft.limit, axis=1)
    if share.max() > 0.3:
        label = "limit of the torque across the field"
        largest = 1e6 * across / np.where(share > 0.0, share, np.nan)
        ax.plot(times, largest, color=panels.GREY, linestyle=panels.DASHED, label=label)
    panels.style(ax, "torque, µN m", "Torque of the coils", "")


def day_figure(
    prediction: OrbitPrediction, stations: Sequence[Station], targets: Sequence[tuple[float, str]]
) -> Figure:
    """Return the figure of a day: the elevation at each station, passes, eclipses and targets.

    The `targets` are pairs of a start (s after the start of the span) and a name.
    """
    rows = len(stations) + bool(targets)
    figure = Figure(figsize=(13.0, 3.6 + 0.45 * rows), layout="constrained")
    sky, bars = figure.subplots(2, 1, sharex=True, height_ratios=[4.0, max(1, rows)])
    colours = dict(zip((one.name for one in stations), cycle(panels.PATH_COLOURS), strict=False))
    for station in stations:
        at, elevation = prediction.elevations(station)
        above = np.where(elevation > 0.0, elevation, np.nan)
        sky.plot(at, above, color=colours[station.name], linewidth=1.4, label=station.name)
    for one in prediction.passes(stations):
        colour = colours[one.station.name]
        level = rows - 1 - stations.index(one.station)
        # The edge keeps a pass of half a minute, which is narrower than a pixel, visible.
        bars.barh(level, one.set - one.rise, left=one.rise, height=0.6, color=colour, ec=colour, lw=1.5)
        text = f"{one.elevation_deg:.0f}°"
        bars.annotate(text, (one.top, level + 0.32), ha="center", va="bottom", fontsize=7, color=panels.BLACK)
    names = [station.name for station in stations]
    if targets:
        names.append("targets")
        starts = [prediction.begin + timedelta(seconds=start) for start, _ in targets]
        for number, (start, (_, name)) in enumerate(zip(starts, targets, strict=True)):
            stop = starts[number + 1] if number + 1 < len(starts) else prediction.end
            shade = panels.SKY if number % 2 else panels.GREY
            bars.barh(0, stop - start, left=start, height=0.6, color=shade, alpha=0.6)
            bars.annotate(
                name, (start, 0), xytext=(3, 0), textcoords="offset points", va="center", fontsize=8
            )
    for number, (begin, end) in enumerate(prediction.eclipses()):
        label = "" if number else "eclipse"
        sky.axvspan(begin, end, color=panels.BLACK, alpha=0.12, linewidth=0, label=label)
        bars.axvspan(begin, end, color=panels.BLACK, alpha=0.12, linewidth=0)
    sky.set_ylim(0.0, 90.0)
    bars.set_yticks(range(rows - 1, -1, -1), names)
    bars.set_ylim(-0.6, rows - 0.2)
    sky.set_xlim(prediction.begin, prediction.end)
    sky.xaxis.set_major_formatter(DateFormatter("%H:%M"))  # type: ignore[no-untyped-call]
    panels.style(sky, "elevation, deg", f"From {prediction.begin:%Y-%m-%d %H:%M} UTC", "")
    panels.style(bars, "", "Passes above the mask, with the highest elevation", "UTC")
    sky.margins(x=0.0)
    panels.legend(sky)
    return figure


def draw_bench(file: Path, outcomes: Mapping[str, Outcome], frames: Mapping[str, Path]) -> None:
    """Draw the finished steps of a bench session, with empty panels for missing data. Raises OSError."""
    figure = Figure(figsize=BENCH, layout="constrained")
    axes = figure.subplots(3, 3)
    for name, ax, panel in (
        ("rest", axes[0, 0], _gyro),
        ("rest", axes[0, 1], _allan),
        ("axes", axes[0, 2], _turns),
        ("coils", axes[1, 0], _response),
        ("coils", axes[1, 1], _supply_current),
        ("focus", axes[1, 2], _focus),
    ):
        if name in outcomes and outcomes[name].arrays:
            panel(ax, outcomes[name])
            if ax.get_legend_handles_labels()[0]:
                ax.legend(fontsize=8)
        else:
            _no_data(ax, f"step {name}: no data")
    for ax, name in zip(axes[2], ("dark", "light", "focus"), strict=True):
        if name in frames:
            _frame(ax, frames[name], name)
        else:
            _no_data(ax, f"step {name}: no frame")
    save(figure, file)


def _no_data(ax: Axes, text: str) -> None:
    ax.set_axis_off()
    ax.text(0.5, 0.5, text, ha="center", va="center", color=panels.GREY, transform=ax.transAxes)


def _gyro(ax: Axes, outcome: Outcome) -> None:
    times, rate = (outcome.arrays[name][:_BENCH_SAMPLES] for name in ("times", "rate"))
    for index, (name, colour) in enumerate(panels.AXIS_COLOURS.items()):
        ax.plot(times, 1e3 * rate[:, index], color=colour, linewidth=0.8, label=name)
    panels.style(ax, "rate, mrad/s", "Gyro at rest", "time, s")


def _allan(ax: Axes, outcome: Outcome) -> None:
    times, deviation = outcome.arrays["allan_times"], outcome.arrays["allan"]
    for index, (name, colour) in enumerate(panels.AXIS_COLOURS.items()):
        ax.loglog(times, deviation[:, index], color=colour, marker=".", label=name)
    expected = outcome.values["expected"]["gyro"]
    falling = expected * np.sqrt(times[0] / times)
    ax.loglog(times, falling, color=panels.GREY, linestyle="--", label="expected")
    panels.style(ax, "deviation, rad/s", "Allan deviation", "averaging time, s")


def _turns(ax: Axes, outcome: Outcome) -> None:
    turns = np.degrees(outcome.arrays["turns"])
    for index, (name, colour) in enumerate(panels.AXIS_COLOURS.items()):
        ax.bar(np.arange(3) + 0.27 * (index - 1), turns[:, index], 0.25, color=colour, label=name)
    ax.axhline(90.0, color=panels.VERMILLION, linestyle="--", linewidth=1.0)
    ax.set_xticks(range(3), [f"about {name}" for name in "xyz"])
    panels.style(
        ax, "about x, y and z, deg", "Rotations of 90 deg, measured by the gyro", "requested rotation"
    )


def _response(ax: Axes, outcome: Outcome) -> None:
    response = 1e6 * outcome.arrays["response"]
    places = np.arange(len(response))
    for index, (name, colour) in enumerate(panels.AXIS_COLOURS.items()):
        ax.bar(places + 0.27 * (index - 1), response[:, index], 0.25, color=colour, label=name)
        marks: dict[str, Any] = {"linestyle": "", "marker": "_", "markersize": 16.0, "color": panels.BLACK}
        expected = 1e6 * outcome.arrays["expected"][:, index]
        ax.plot(places + 0.27 * (index - 1), expected, label="expected" if index == 2 else "", **marks)
    ax.axhline(0.0, color=panels.GREY, linewidth=0.8)
    ax.set_xticks(places, [f"coil {COIL_NAMES[place]}" for place in places])
    panels.style(ax, "field, uT/A", "Field of each coil at the magnetometer", "")


def _supply_current(ax: Axes, outcome: Outcome) -> None:
    current, commanded = 1e3 * outcome.arrays["current"], 1e3 * outcome.arrays["commanded"]
    places = np.arange(len(commanded))
    for way, (label, colour) in enumerate((("positive", panels.BLUE), ("negative", panels.SKY))):
        ax.bar(places + 0.3 * (way - 0.5), np.nan_to_num(current[:, way]), 0.28, color=colour, label=label)
    marks: dict[str, Any] = {"linestyle": "", "marker": "_", "markersize": 40.0, "color": panels.VERMILLION}
    ax.plot(places, commanded, label="commanded", **marks)
    ax.set_xticks(places, [f"coil {COIL_NAMES[place]}" for place in places])
    panels.style(ax, "current, mA", "Supply current", "")


def _focus(ax: Axes, outcome: Outcome) -> None:
    widths = outcome.arrays["widths"]
    ax.plot(range(1, len(widths) + 1), widths, color=panels.BLUE, marker="o")
    ax.set_ylim(0.0, 1.2 * float(np.nanmax(widths)))
    panels.style(ax, "PSF width, px", "Focus", "frame")


def _frame(ax: Axes, file: Path, name: str) -> None:
    pixels = read_image(file)
    if name == "focus":
        row, column = (int(place) for place in np.unravel_index(int(np.argmax(pixels)), pixels.shape))
        top, left = max(row - _FOCUS_SIDE // 2, 0), max(column - _FOCUS_SIDE // 2, 0)
        pixels = pixels[top : top + _FOCUS_SIDE, left : left + _FOCUS_SIDE]
    ax.imshow(grey_stretch(pixels), cmap="gray")
    ax.set_title(f"frame of step {name}", loc="left", fontsize=11, fontweight="bold")
    ax.set_axis_off()
