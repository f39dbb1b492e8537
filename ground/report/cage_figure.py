"""The picture of a testbed in a cage whose field turns: attitude, field and coil currents over time."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ground.report import panels
from ground.report.scene import Scene
from ground.report.signals import seconds
from knightcube.astro.arrays import FloatArray

SIZE = (10.9, 12.0)
_TURNS = np.radians(20.0)
"""rad by which the field must turn in a run to be drawn: a testbed's stands."""
_PACE = 40
"""Readings of the magnetometer for one that is drawn: a second."""


def cage_figure(scene: Scene) -> Figure | None:
    """Return the picture, None for a run whose field stands, or that has none."""
    time, field = _reference_field(scene)
    if len(time) < 2:
        return None
    towards = np.unwrap(np.arctan2(field[:, 0], -field[:, 1]))
    if float(np.ptp(towards)) < _TURNS:
        return None
    figure = Figure(figsize=SIZE, layout="constrained")
    attitude, strength, direction, current = figure.subplots(4, 1, sharex=True)
    panels.attitude(attitude, scene)
    for values, name, colour in ((field[:, 0], "x", panels.BLUE), (field[:, 1], "z", panels.ORANGE)):
        strength.plot(time, 1e6 * values, color=colour, linewidth=0.8, label=f"along {name}")
    strength.plot(time, 1e6 * np.hypot(*field.T), color=panels.BLACK, linewidth=1.0, label="strength")
    angle = 2.0 * np.degrees(np.arcsin(np.clip(scene.flown.q2, -1.0, 1.0)))
    direction.plot(time, np.degrees(towards), color=panels.GREEN, linewidth=1.0, label="field, from -z to x")
    direction.plot(scene.flown.time, angle, color=panels.BLUE, linewidth=1.0, label="body")
    panels.current(current, scene)
    panels.style(strength, "field, µT", "Field of the cage, in the testbed's axes", "")
    panels.style(direction, "deg", "Direction of the field, and the body's angle", "")
    for ax in (strength, direction):
        panels.legend(ax)
    attitude.set_xlabel("")
    return figure


def _reference_field(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Return times (n,) s and the measured field (n, 2) T along x and z of the testbed's axes."""
    imu, flown = scene.run["imu"][::_PACE], scene.flown
    if not len(imu) or not len(flown.time):
        return np.zeros(0), np.zeros((0, 2))
    time = seconds(imu)
    angle = np.interp(time, flown.time, 2.0 * np.arcsin(np.clip(flown.q2, -1.0, 1.0)))
    x, z = imu["field"][:, 0].astype(float), imu["field"][:, 2].astype(float)
    sine, cosine = np.sin(angle), np.cos(angle)
    return time, np.stack([x * cosine + z * sine, z * cosine - x * sine], axis=1)
