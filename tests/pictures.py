"""`python -m tests.pictures`: makes the README's pictures anew, from a flight of the demonstration.

The flight is simulated in lock-step with a fixed seed, so the pictures change only when the software does.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from flight import config as configuration
from flight.app import Order, fly
from flight.guidance.vmc import plan
from flight.loop import plant_of
from flight.pinhole import Pinhole
from flight.quaternion import about_axis_y
from flight.report import draw, draw_path
from flight.telemetry.reader import read_run
from flight.vision.settings import StreakSettings
from flight.vision.streak_rate import StreakStatus, estimate_rate
from sim_hal.assembly import StarRenderer
from sim_hal.settings import Sky

ROOT = Path(__file__).resolve().parents[1]
CONFIG = ROOT / "config" / "step_demo.yaml"
RATE = 0.03
"""rad/s: the peak of a 0.1 step."""


def main() -> int:
    """Write the pictures and name them."""
    parser = argparse.ArgumentParser(prog="python -m tests.pictures", description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "pictures", metavar="DIR")
    folder: Path = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        run_folder = Path(place) / "run"
        fly(Order(CONFIG, run_folder))
        drawn = {path.name: path for path in draw(read_run(run_folder), Path(place) / "figures")}
        for name in ("overview.png", "paths.png"):
            (folder / name).write_bytes(drawn[name].read_bytes())
    config = configuration.load(CONFIG)
    plant = plant_of(config)
    draw_path(plan(plant, 0.4, 0.015, -0.3, 0.0, 10.0), plant, folder / "path.png")
    _draw_frame(folder / "frame.png")
    for name in ("overview.png", "paths.png", "path.png", "frame.png"):
        sys.stdout.write(f"{folder / name}\n")
    return 0


def _draw_frame(path: Path) -> None:
    """Draw a frame of a slew at its fastest, with the endpoints that the rate is from."""
    camera = configuration.load(CONFIG).camera
    assert camera is not None
    times = np.linspace(0.0, camera.exposure, 101)
    attitudes = np.array([about_axis_y(-0.3 + RATE * t) for t in times])
    pixels = StarRenderer(camera, Sky(), 1).render(1, times, attitudes)
    pinhole = Pinhole.from_field_of_view(camera.columns, camera.rows, np.deg2rad(camera.field_of_view_deg))
    found = estimate_rate(
        pixels,
        pinhole,
        camera.exposure,
        StreakSettings(),
        prior_rate=np.array([0.0, RATE, 0.0]),
        prior_sigma=1e-3,
    )
    assert found.status is StreakStatus.RATE
    assert found.rate is not None
    figure = Figure(figsize=(9.0, 9.3), layout="constrained")
    axes = figure.subplots()
    low, high = np.percentile(pixels, (1.0, 99.8))
    axes.imshow(pixels, cmap="gray_r", vmin=low, vmax=high, interpolation="nearest")
    for ends in found.endpoints[found.used]:
        axes.plot(ends[:, 0], ends[:, 1], "o", markersize=5, markerfacecolor="none", color="#D55E00")
    axes.set_title(
        f"true rate {1e3 * RATE:.2f} mrad/s, from {found.used_count} streaks "
        f"{1e3 * found.rate[1]:.2f} mrad/s about y (negative image)",
        fontsize=10,
    )
    axes.set_axis_off()
    figure.savefig(path, dpi=90, facecolor="white")


if __name__ == "__main__":
    raise SystemExit(main())
