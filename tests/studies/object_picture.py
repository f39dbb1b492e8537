"""Draws the pass of an object that a satellite followed, from a flight log.

The frame is rendered with the attitude that the flight estimated and the object position of its track.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flight.schema import reader as configuration
from flight.schema.bodies import as_orbit
from ground.report.figures import DPI
from ground.telemetry import Run, read_run
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.vision.camera.images import grey_stretch
from sim_hal.assembly import StarRenderer
from sim_hal.settings import SkySection
from sim_hal.star_camera import SourceTrack
from tests.studies.command import command

CONFIG = Path(__file__).resolve().parents[2] / "config" / "orbit_object.yaml"


def draw(run: Run, path: Path) -> None:
    """Draw the frame, the path of the object in the field, and the angles over the pass."""
    config = as_orbit(configuration.load(CONFIG))
    assert config.camera is not None
    mounting = np.array(config.camera.mounting)
    track, attitude = run["track"], run["attitude"]
    times = track["middle_ns"] * 1e-9
    quaternions = _at(times, attitude["time_ns"] * 1e-9, attitude["quaternion"])
    cameras = np.array([multiply(mounting, quaternion) for quaternion in quaternions])
    boresights = np.array([attitude_matrix(camera)[2] for camera in cameras])
    cosines: FloatArray = np.sum(boresights * track["direction"], axis=1)
    off = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    figure = Figure(figsize=(11.0, 5.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.0))
    _frame(left, run, cameras)
    right.plot(times, off, color="tab:blue", label="object off the boresight, deg")
    right.axhline(
        0.5 * config.camera.field_of_view_deg, color="0.6", linestyle="--", label="edge of the field"
    )
    rate = np.degrees(np.linalg.norm(track["rate"], axis=1))
    right.plot(times, 10.0 * rate, color="tab:orange", label="its rate, 0.1 deg/s")
    unseen = track["seen"] == 0
    right.plot(times[unseen], off[unseen], "x", color="tab:red", label="not seen in this frame")
    right.set(xlabel="mission time, s", ylim=(0.0, None), title="The pass")
    right.legend(fontsize=8)
    right.grid(alpha=0.3)
    figure.savefig(path, dpi=DPI)


def _frame(axes: Axes, run: Run, cameras: FloatArray) -> None:
    """Draw the third frame of the track: the stars, and the object's streak and path."""
    config = as_orbit(configuration.load(CONFIG))
    camera = config.camera
    assert camera is not None
    track, sightings = run["track"], run["sightings"]
    place = 2
    middle = int(track["middle_ns"][place])
    times = np.linspace(-0.5 * camera.exposure, 0.5 * camera.exposure, 9)
    control = run["attitude"]
    rate = control["rate"][int(np.searchsorted(control["time_ns"], middle))]
    turn = attitude_matrix(np.array(camera.mounting)) @ rate
    attitudes = np.array([multiply(from_rotation_vector(turn * time), cameras[place]) for time in times])
    directions = track["direction"][place] + times[:, None] * track["rate"][place]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    tracks = [SourceTrack(times, directions, float(track["magnitude"][place]))]
    pixels = StarRenderer(camera, SkySection(), 1).render(0, times, attitudes, tracks)
    axes.imshow(grey_stretch(pixels), cmap="gray", origin="upper")
    seen = sightings[sightings["found"] > 0]
    axes.plot(seen["x"][:, 0], seen["y"][:, 0], ".", color="tab:blue", markersize=3, label="sightings")
    now = int(np.argmin(np.abs(seen["middle_ns"] - middle)))
    axes.plot(
        seen["x"][now, 0],
        seen["y"][now, 0],
        "o",
        mfc="none",
        color="tab:orange",
        ms=14,
        label="in this frame",
    )
    axes.set(title=f"The frame at {middle * 1e-9:.1f} s, and the object's way in the field")
    axes.legend(fontsize=8, loc="lower right")


def _at(times: FloatArray, known: FloatArray, quaternions: FloatArray) -> FloatArray:
    """Return the attitudes (n, 4) that are nearest in time to `times` (n,)."""
    return np.asarray(quaternions[np.clip(np.searchsorted(known, times), 0, len(known) - 1)])


@command
def main(
    run: Annotated[Path, "folder of a flight of config/orbit_object.yaml"],
    *,
    out: Annotated[Path, "the picture"] = Path("docs/pictures/object.png"),
) -> int:
    """Draw the picture; return the exit status."""
    draw(read_run(run), out)
    sys.stdout.write(f"{out}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
