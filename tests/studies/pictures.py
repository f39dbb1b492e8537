"""Makes the README's pictures from a flight of the demonstration.

The flight is simulated in lock-step with a fixed seed, so the pictures change only when the software does.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import numpy as np
from matplotlib.figure import Figure

from flight.app.flight import fly
from flight.app.run import RunRequest
from flight.bodies.testbed.control import plant_of
from flight.schema import reader as configuration
from flight.schema.bodies import as_testbed
from flight.schema.devices import camera_model
from ground.pictures import draw_horizon, draw_solution
from ground.report import draw, draw_path
from ground.telemetry import read_run
from knightcube.astro import catalogue
from knightcube.astro.quaternion import about_axis_y, from_rotation_vector, multiply
from knightcube.gnc.guidance.vmc import plan
from knightcube.vision.camera.images import grey_stretch, write_picture
from knightcube.vision.frame_job import solve_frame
from knightcube.vision.horizon.nadir import HorizonStatus, find_nadir
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.sky_map import Pointing
from knightcube.vision.startracker.solve import SolveSettings, SolveStatus
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.streak_result import LikelihoodSettings, StreakStatus
from sim_hal.assembly import StarRenderer
from sim_hal.earth_camera import render as render_earth
from sim_hal.settings import SkySection
from sim_hal.star_camera import StarCameraModel, render
from tests.sim_hal.earth_camera.scenes import random_scene
from tests.studies.command import command, scratch
from tests.support import limb_frames

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "config" / "step_demo.yaml"
ORBIT = ROOT / "config" / "orbit.yaml"
POWER = ROOT / "docs" / "examples" / "power.yaml"
RATE = 0.03
"""Body rate (rad/s) in the drawn frame: the peak rate of a 0.1 rad step."""
ORION_DEG = 84.0, -2.0, 15.0
"""Right ascension, declination and roll (deg) of the picture whose stars are identified."""
HORIZON_SEEDS = 2, 4, 6
_OF_TESTBED, _IN_ORBIT = ("overview", "paths"), ("spin", "knowledge", "pointing")
_OF_BATTERY = ("battery",)


@command
def main(*, out: Annotated[Path, "folder of the pictures"] = ROOT / "docs" / "pictures") -> int:
    """Write the pictures and print their names."""
    folder = out
    folder.mkdir(parents=True, exist_ok=True)
    with scratch() as place:
        for flown, names in ((CONFIG, _OF_TESTBED), (ORBIT, _IN_ORBIT), (POWER, _OF_BATTERY)):
            run_folder = place / flown.stem
            fly(RunRequest(flown, run_folder))
            drawn = {path.stem: path for path in draw(read_run(run_folder), run_folder / "figures")}
            for name in names:
                (folder / f"{name}.png").write_bytes(drawn[name].read_bytes())
    config = as_testbed(configuration.load(CONFIG))
    plant = plant_of(config)
    draw_path(plan(plant, 0.4, 0.015, -0.3, 0.0, 10.0), plant, folder / "path.png")
    _draw_frame(folder / "frame.png")
    _draw_solved(folder / "solved.png")
    _draw_horizons(folder / "horizons.png")
    for name in (*_OF_TESTBED, *_IN_ORBIT, *_OF_BATTERY, "path", "frame", "solved", "horizons"):
        sys.stdout.write(f"{folder / name}.png\n")
    return 0


def _draw_frame(path: Path) -> None:
    """Draw a frame at the peak rate of a slew, with the streak end points that determine the rate."""
    camera = configuration.load(CONFIG).camera
    assert camera is not None
    times = np.linspace(0.0, camera.exposure, 101)
    attitudes = np.array([about_axis_y(-0.3 + RATE * t) for t in times])
    pixels = StarRenderer(camera, SkySection(), 1).render(1, times, attitudes)
    found = estimate_motion(
        pixels,
        camera_model(camera).ideal,
        camera.exposure,
        LikelihoodSettings(gain=camera.gain, saturation=camera.saturation, line_time=0.0),
        np.array([0.0, RATE, 0.0]),
        1e-3,
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
        f"true rate {1e3 * RATE:.3f} mrad/s, from {found.used_count} streaks "
        f"{1e3 * found.rate[1]:.3f} mrad/s about y (negative image)",
        fontsize=10,
    )
    axes.set_axis_off()
    figure.savefig(path, dpi=90, facecolor="white")


def _draw_solved(path: Path) -> None:
    """Draw Orion as streaks, with the identified stars and their names."""
    rng = np.random.default_rng(2026)
    camera = StarCameraModel()
    attitude = Pointing(*np.radians(ORION_DEG)).quaternion()
    times = np.linspace(0.0, 0.5, 3)
    turn = np.array([0.008, 0.006, 0.01])
    attitudes = multiply(from_rotation_vector((times[:, None] - 0.25) * 2.0 * turn), attitude)
    stars = catalogue.load()
    pixels = render(camera, stars.directions_at(2026.5), stars.magnitude, times, attitudes, rng)
    sky = default_index()
    found = solve_frame(pixels, camera.pinhole, (0.95, 1.05), 0.5, sky, SolveSettings())
    assert found.status is SolveStatus.SOLVED
    write_picture(path, draw_solution(grey_stretch(pixels), found, sky))


def _draw_horizons(path: Path) -> None:
    """Draw three views of the Earth with its terminator, each with the detected edges and the fitted limb."""
    model = limb_frames.camera_model()
    pictures = []
    for seed in HORIZON_SEEDS:
        generator = np.random.default_rng(seed)
        scene = random_scene(generator, model, "terminator")
        pixels = render_earth(model, scene, generator)
        knowledge = limb_frames.coarse_knowledge(scene, generator)
        found = find_nadir(pixels, model.lens, knowledge, limb_frames.finder_settings(model))
        assert found.status is HorizonStatus.FOUND
        pictures.append(draw_horizon(grey_stretch(pixels), found, model.lens))
    write_picture(path, np.hstack(pictures))


if __name__ == "__main__":
    raise SystemExit(main())
