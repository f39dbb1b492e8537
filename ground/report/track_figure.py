"""The picture of a satellite's ground track, in light and in shadow."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ground.report import panels
from ground.report.orbit_figure import DARK
from ground.report.signals import seconds
from ground.telemetry.reader import Run
from knightcube.astro.earth.orientation import celestial_to_terrestrial, geodetic

SIZE = (10.9, 5.8)
EVERY_S = 10.0
MARKED_S = 600.0


def track_figure(run: Run) -> Figure | None:
    """Return the picture, None for a run whose true place is not known."""
    packets = run["orbit_truth"]
    if not len(packets):
        return None
    times = seconds(packets)
    _, kept = np.unique((times / EVERY_S).astype(int), return_index=True)
    packets, times = packets[kept], times[kept]
    place = np.einsum(
        "nij,nj->ni",
        celestial_to_terrestrial(packets["utc"].astype(float)),
        packets["position"].astype(float),
    )
    longitude, latitude, height = geodetic(place)
    east, north = np.degrees(longitude), np.degrees(latitude)
    figure = Figure(figsize=SIZE, layout="constrained")
    ax = figure.subplots()
    dark = packets["sunlit"] < DARK
    for inside, colour, label in ((~dark, panels.ORANGE, "sunlit"), (dark, panels.BLUE, "in shadow")):
        ax.plot(east[inside], north[inside], ".", color=colour, markersize=4, label=label)
    marked = np.searchsorted(times, np.arange(times[0], times[-1], MARKED_S))
    ax.plot(east[marked], north[marked], "o", color=panels.BLACK, markersize=4)
    for k in marked:
        ax.annotate(
            f"{times[k] / 60.0:.0f} min", (east[k], north[k]), (5, 4), textcoords="offset points", fontsize=8
        )
    ax.set_xlim(-180, 180)
    ax.set_ylim(-90, 90)
    ax.set_xticks(range(-180, 181, 30))
    ax.set_yticks(range(-90, 91, 30))
    ax.set_aspect("equal")
    title = f"Ground track, {np.min(height) * 1e-3:.0f} to {np.max(height) * 1e-3:.0f} km above the ellipsoid"
    panels.style(ax, "latitude, deg", title, "longitude, deg")
    panels.legend(ax)
    return figure
