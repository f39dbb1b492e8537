"""The picture of one planned slew in orbit: boresights on the sky, dipole, torque and field, energy."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ground.report import panels
from ground.report.figures import DPI
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix
from knightcube.gnc.guidance.three_axes.slew_model import shown
from knightcube.gnc.guidance.three_axes.slew_plan import OrderedSlew, SlewOrder, SlewStatus
from knightcube.gnc.guidance.three_axes.slew_task import Cone

SIZE = (10.9, 12.6)
_CONES = {"Sun": panels.ORANGE, "Earth": panels.GREEN, "Moon": panels.GREY}
_DASHED = (0, (5, 2))
_INSTANTS = 601


def slew_figure(made: OrderedSlew, order: SlewOrder) -> Figure:
    """Return the picture of a slew."""
    figure = Figure(figsize=SIZE, layout="constrained")
    grid = figure.add_gridspec(4, 1, height_ratios=(2.3, 1.0, 1.0, 1.0))
    sky = figure.add_subplot(grid[0], projection="mollweide")
    dipole = figure.add_subplot(grid[1])
    torque, energy = (figure.add_subplot(grid[k], sharex=dipole) for k in (2, 3))
    times = np.linspace(0.0, made.plan.horizon, _INSTANTS)
    _sky(sky, made, order, times)
    _dipole(dipole, made, times)
    _torque(torque, made, times)
    _energy(energy, made, times)
    for ax in (dipole, torque, energy):
        panels.legend(ax)
    return figure


def _sky(ax: Axes, made: OrderedSlew, order: SlewOrder, times: FloatArray) -> None:
    """Draw the ways of the pointing axis and of the star camera's boresight among the cones."""
    plan = made.plan
    turned = attitude_matrix(plan.path.references(times).quaternion)
    handles: list[Line2D | Patch] = [*_cones(ax, made.task.cones, times[[0, -1]])]
    axes = [("pointing axis", order.axes.pointing, panels.BLUE), ("star camera", order.camera, panels.PURPLE)]
    for name, axis, colour in axes[: 1 if np.allclose(order.axes.pointing, order.camera) else 2]:
        way = axis @ turned
        east, north = np.arctan2(way[:, 1], way[:, 0]), np.arcsin(np.clip(way[:, 2], -1.0, 1.0))
        ax.plot(*_split(east, north), color=colour, linewidth=1.8)
        ax.plot(east[0], north[0], "o", color=colour, markersize=8, markerfacecolor="white")
        ax.plot(east[-1], north[-1], "o", color=colour, markersize=8)
        handles.append(Line2D([], [], color=colour, linewidth=1.8, label=name))
    for fill, name in (("white", "begin"), (panels.BLACK, "end")):
        handles.append(
            Line2D([], [], color=panels.BLACK, marker="o", markerfacecolor=fill, ls="", label=name)
        )
    stretched = f", stretched from {plan.horizon_asked:g} s" if plan.status is SlewStatus.STRETCHED else ""
    title = f"Planned slew: {plan.energy:.4g} J in {plan.horizon:.4g} s{stretched}"
    title += "; the sky in right ascension and declination"
    ax.set_title(title, loc="left", fontsize=11, fontweight="bold", color=panels.BLACK, pad=22.0)
    ax.grid(True, color="#e4e4e4", linewidth=0.8)
    ax.tick_params(labelsize=8, labelcolor=panels.GREY)
    place = (0.5, -0.02)
    ax.legend(handles=handles, loc="upper center", bbox_to_anchor=place, ncols=4, fontsize=9, frameon=False)


def _cones(ax: Axes, cones: tuple[Cone, ...], ends: FloatArray) -> Iterator[Patch]:
    """Draw cones, shaded at the first of two times and dashed at the second; yield their legends."""
    longitude, latitude = np.meshgrid(np.radians(np.arange(-180, 181)), np.radians(np.arange(-90, 91)))
    level = np.cos(latitude)
    grid = np.stack([level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)], axis=2)
    for cone in cones:
        colour = _CONES[cone.name]
        begun, ended = (grid @ towards - np.cos(cone.angle) for towards in cone.direction(ends))
        ax.contourf(longitude, latitude, begun, [0.0, 9.0], colors=[colour], alpha=0.3)
        ax.contour(longitude, latitude, ended, [0.0], colors=[colour], linestyles="dashed", linewidths=1.2)
        yield Patch(
            facecolor=colour, alpha=0.4, label=f"{cone.name}'s cone, {np.degrees(cone.angle):.0f} deg"
        )


def _split(east: FloatArray, north: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a way with gaps where it leaves the map at one side and comes back at the other."""
    jumps = np.flatnonzero(np.abs(np.diff(east)) > np.pi) + 1
    return np.insert(east, jumps, np.nan), np.insert(north, jumps, np.nan)


def _dipole(ax: Axes, made: OrderedSlew, times: FloatArray) -> None:
    dipoles = 1e3 * made.plan.path.dipoles(times)
    for values, name, colour in zip(
        dipoles.T, panels.COILS, (panels.BLUE, panels.ORANGE, panels.GREEN), strict=True
    ):
        ax.plot(times, values, color=colour, linewidth=1.3, label=name)
    limit = 1e3 * float(made.task.craft.limit.min())
    # Far below the limit, its line would only flatten the curves.
    if np.abs(dipoles).max() > 0.3 * limit:
        for sign in (-1.0, 1.0):
            ax.axhline(
                sign * limit,
                color=panels.VERMILLION,
                linestyle=_DASHED,
                label="limit" if sign > 0.0 else None,
            )
    panels.style(ax, "dipole, mA m²", f"Dipole; the limit is {limit:.3g} mA m²", "")


def _torque(ax: Axes, made: OrderedSlew, times: FloatArray) -> None:
    """Draw the torque that the motion takes, across the field and along it, and what the coils could make."""
    task, path = made.task, made.plan.path
    wanted, craft, around = path.references(times), task.craft, task.along(times)
    q = wanted.quaternion
    down, strength = around.gradient()
    field, down = shown(q, around.field), shown(q, down)
    tide = strength[:, None] * np.cross(down, down @ craft.inertia) + craft.torque
    spin = np.cross(wanted.rate, wanted.rate @ craft.inertia)
    torque = wanted.acceleration @ craft.inertia + spin - tide - np.cross(craft.residual, field)
    size = np.linalg.norm(field, axis=1)
    along = np.sum(torque * field, axis=1) / size
    across = np.linalg.norm(torque - along[:, None] * field / size[:, None], axis=1)
    ax.plot(times, 1e6 * across, color=panels.BLUE, linewidth=1.3, label="across the field")
    ax.plot(times, 1e6 * along, color=panels.VERMILLION, linewidth=1.3, label="along it: none can be made")
    most = 1e6 * size * float(craft.limit.min())
    if 1e6 * across.max() > 0.3 * most.min():
        ax.plot(times, most, color=panels.GREY, linestyle=_DASHED, label="one coil across it could")
    panels.style(ax, "torque, µN m", "Torque of the coils", "")


def _energy(ax: Axes, made: OrderedSlew, times: FloatArray) -> None:
    power = made.plan.path.dipoles(times) ** 2 @ made.task.craft.weights
    steps = 0.5 * np.diff(times) * (power[1:] + power[:-1])
    ax.fill_between(
        times, np.concatenate([[0.0], np.cumsum(steps)]), color=panels.BLUE, alpha=0.35, linewidth=0
    )
    ax.set_ylim(bottom=0.0)
    panels.style(ax, "energy, J", "Heat of the coils so far", "time since the begin, s")


def save_slew(made: OrderedSlew, order: SlewOrder, file: Path) -> None:
    """Draw a slew into a file. Raises OSError."""
    slew_figure(made, order).savefig(file, dpi=DPI, facecolor="white", format="png")
