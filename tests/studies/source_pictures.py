"""Draws figures of Sease 2013 with this project's software.

Fig. 2.1: the star table over the whole sky.

Fig. 3.1 to 3.4: a streak and its four cornerness maps.

Fig. 3.5: the centre of rotation, and the vectors of a streak.

Fig. 3.7 to 3.10: the errors of attitude and rate with the four detectors, from the campaign `streaks-thesis`,
which is run or resumed in the folder.

Fig. 4.2 to 4.4: the indicators of an object among stars.

Fig. 5.4 to 5.6: the planned slew.

Fig. 5.7 and 5.8: the simulated steps.

Fig. 3.6 is a sketch and is not drawn.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flight.bodies.testbed.control import plant_of
from flight.schema import reader as configuration
from flight.schema.bodies import as_testbed
from ground.campaigns.runner import fly as fly_campaign
from ground.report import panels
from ground.report.figures import path_figure
from ground.telemetry import Run
from knightcube.astro import catalogue
from knightcube.astro.arrays import FloatArray, Image
from knightcube.gnc.guidance.vmc import plan
from knightcube.reference.corner_streak_rate import cornerness, estimate_rate
from knightcube.reference.corner_streaks import DETECTOR_NAMES, StreakSettings
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.objects.detect import lengths, olae_residuals, slopes, star_ends
from knightcube.vision.objects.streak_ends import centre_of_rotation, measure_streaks, segment_frame
from sim_hal.settings import Simulation
from sim_hal.star_camera import StarCameraModel
from tests.studies.campaigns import campaign
from tests.studies.campaigns.rso import EXPOSURE, draw_sky
from tests.studies.campaigns.streaks import PERCENTS, THESIS, THETAS_DEG
from tests.studies.command import command
from tests.support.flights import fly
from tests.support.scenes import FIELD, YEAR, slew

STREAK_SEED, CENTRE_SEED, OBJECT_SEED = 1, 1, 1
TURN = 1.0
"""Rotation during the exposure that shows the centre of rotation, as a fraction of the field of view."""
OBJECT_MAGNITUDE = 1.0
"""Magnitude of the object, as in the thesis ("for visualization purposes")."""
STREAKS_SEED = 12
SIMULATION = Path(__file__).resolve().parents[2] / "config" / "step_simulation.yaml"
PRINTED_SIGMAS = 3.6, 3.5, 3.6
"""Deviations of the thesis's object in its Fig. 4.2 to 4.4, in standard deviations of the frame."""
NODES = 10
"""Nodes of the planned path, as in the thesis's Simulation Results."""
_ORANGE, _BLUE, _GREEN = "#D55E00", "#0072B2", "#009E73"


@command
def main(
    *,
    out: Annotated[Path, "folder of the pictures"] = Path("runs") / "source_pictures",
    only: Annotated[str, "only pictures whose name contains it"] = "",
    runs: Annotated[int, "of `streaks-thesis`"] = 2,
) -> int:
    """Draw all figures, and print their names."""
    out.mkdir(parents=True, exist_ok=True)
    pictures = PICTURES | {ACCURACIES: partial(draw_accuracies, out / "streaks-thesis", runs)}
    for name, draw in sorted(pictures.items()):
        if only in name:
            draw().savefig(out / f"{name}.png", dpi=100, facecolor="white")
            sys.stdout.write(f"{out / name}.png\n")
    return 0


def draw_star_table() -> Figure:
    """Draw the star table over the whole sky, with larger dots for brighter stars: Fig. 2.1."""
    stars = catalogue.load()
    x, y, z = stars.directions_at(YEAR).T
    figure = Figure(figsize=(11.0, 5.6), layout="constrained")
    axes = figure.subplots()
    axes.set_facecolor("black")
    size = 10.0 ** (-0.28 * (stars.magnitude - 5.0))
    hours = np.degrees(np.arctan2(y, x)) % 360.0 / 15.0
    axes.scatter(hours, np.degrees(np.arcsin(z)), s=size, c="white", linewidths=0.0)
    axes.set(xlim=(24.0, 0.0), ylim=(-90.0, 90.0), xlabel="right ascension, h", ylabel="declination, deg")
    axes.set_xticks(range(0, 25, 3))
    axes.set_yticks(range(-90, 91, 30))
    axes.set_title(f"{len(stars.magnitude):,} Hipparcos stars to V {stars.magnitude.max():.1f}", fontsize=10)
    return figure


def draw_cornerness() -> Figure:
    """Draw a streak and its cornerness by the four detectors, with the maxima circled: Fig. 3.1 to 3.4."""
    camera = StarCameraModel(field_of_view=FIELD)
    scene = slew(np.random.default_rng(STREAK_SEED), np.pi / 3.0, 0.04, 0.2, model=camera)
    window = _window_of_a_streak(scene.pixels, camera)
    figure = Figure(figsize=(12.0, 5.6), layout="constrained")
    first, *others = figure.subplots(1, 5)
    first.imshow(window, cmap="gray")
    first.set_title("a streak", fontsize=10)
    for axes, name in zip(others, DETECTOR_NAMES, strict=True):
        response = cornerness(window, StreakSettings.of(name))
        axes.imshow(np.maximum(response, 0.0), cmap="inferno")
        row, column = np.unravel_index(response.argmax(), response.shape)
        axes.plot(column, row, "o", color=_GREEN, markersize=12, markerfacecolor="none")
        axes.set_title(name, fontsize=10)
    for axes in figure.axes:
        axes.set(xticks=[], yticks=[])
    return figure


def _window_of_a_streak(pixels: Image, camera: StarCameraModel) -> FloatArray:
    """Return a window around the strongest streak far from the border, with the background removed."""
    streaks = measure_streaks(segment_frame(pixels, StreakSettings()), StreakSettings())
    middles = streaks.endpoints.mean(axis=1)
    room = np.abs(middles - 0.5 * camera.columns).max(axis=1) < 0.5 * camera.columns - 60.0
    best = int(np.flatnonzero(room)[0])
    (x0, y0), (x1, y1) = streaks.endpoints[best].min(axis=0), streaks.endpoints[best].max(axis=0)
    cut = pixels[int(y0) - 10 : int(y1) + 12, int(x0) - 10 : int(x1) + 12].astype(float)
    return np.asarray(cut - np.median(pixels))


def draw_centre() -> Figure:
    """Draw the bisectors of a frame's streaks, their centre, and the vectors of one streak: Fig. 3.5."""
    camera = StarCameraModel(field_of_view=FIELD)
    scene = slew(np.random.default_rng(CENTRE_SEED), np.radians(6.0), TURN, 0.2, model=camera)
    settings = StreakSettings()
    found = estimate_rate(scene.pixels, camera.pinhole, scene.exposure, settings, scene.rate, 0.0)
    ends = found.endpoints[found.used]
    centre = centre_of_rotation(ends)
    figure = Figure(figsize=(8.0, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    _show(left, scene.pixels)
    for middle in ends.mean(axis=1):
        left.plot(*np.stack([middle, centre]).T, color=_BLUE, linewidth=0.7)
    left.plot(*centre, "+", color=_ORANGE, markersize=18, markeredgewidth=2.0)
    true = camera.pinhole.project(np.sign(scene.rate[2]) * scene.rate)
    away = float(np.linalg.norm(centre - true))
    left.set_title(f"centre of rotation, {away:.2f} px from the true one", fontsize=10)
    # The streak with the largest angle at the centre is drawn, because its vectors have similar lengths.
    one = ends[int((lengths(ends) / np.linalg.norm(ends.mean(axis=1) - centre, axis=1)).argmax())]
    middle = one.mean(axis=0)
    _show(right, scene.pixels)
    for label, tail, head, colour in (
        ("$V_c$", centre, middle, _ORANGE),
        ("$V_1$", middle, one[0], _BLUE),
        ("$V_2$", middle, one[1], _GREEN),
    ):
        right.annotate("", head, tail, arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 1.6})
        right.annotate(label, 0.5 * (tail + head), color=colour, fontsize=14, ha="right", va="bottom")
    corners = np.stack([centre, *one])
    about = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    reach = 0.75 * float(np.ptp(corners, axis=0).max())
    right.set(xlim=(about[0] - reach, about[0] + reach), ylim=(about[1] + reach, about[1] - reach))
    right.set_title("the vectors of one streak", fontsize=10)
    return figure


def draw_accuracies(folder: Path, runs: int) -> Figure:
    """Draw the errors of attitude and rate over theta and streak length: Fig. 3.7 to 3.10."""
    cells = accuracies(folder, runs)
    figure = Figure(figsize=(14.0, 7.4), layout="constrained")
    grid = figure.subplots(2, 4, sharex=True, sharey=True)
    for row, (key, unit, scale, printed) in enumerate(
        (("across_px", "attitude, px", 1.0, (2, 3)), ("magnitude", "rate, %", 100.0, (0, 1)))
    ):
        for axes, name in zip(grid[row], DETECTOR_NAMES, strict=True):
            values = np.full((len(THETAS_DEG), len(PERCENTS)), np.nan)
            for cell in cells:
                place = THETAS_DEG.index(cell["theta"]), PERCENTS.index(cell["percent"])
                value = cell[name][key]
                values[place] = np.nan if value is None else scale * value
            axes.imshow(
                np.log10(values), cmap="viridis_r", vmin=-2.0, vmax=1.0, aspect="auto", origin="lower"
            )
            for (theta, percent), value in np.ndenumerate(values):
                axes.text(percent, theta, "" if np.isnan(value) else f"{value:.2f}", ha="center", va="center")
            thesis = THESIS[name]
            first, last = (thesis[index] for index in printed)
            limits = f"thesis: {first:g} at 10 %, {last:g} at 50 %\n(theta > {thesis[4]:g} deg)"
            axes.set_title(f"{name}, {unit}\n{limits}", fontsize=9)
            axes.set_xticks(range(len(PERCENTS)), PERCENTS)
            axes.set_yticks(range(len(THETAS_DEG)), THETAS_DEG)
    figure.supxlabel("streak length, % of the field", fontsize=10)
    figure.supylabel("angle between rotation axis and boresight, deg", fontsize=10)
    return figure


def accuracies(folder: Path, runs: int) -> list[dict[str, Any]]:
    """Return the cells of the campaign `streaks-thesis`, which is run or resumed in a folder."""
    facts = fly_campaign(campaign("streaks-thesis"), runs, STREAKS_SEED, folder, progress=True).facts
    found: list[dict[str, Any]] = facts["cells"]
    return found


def draw_path() -> Figure:
    """Draw the slew that the thesis plans in 10 s, and that this coil performs in 13.8 s: Fig. 5.4 to 5.6."""
    plant = plant_of(as_testbed(configuration.load(SIMULATION)))
    return path_figure(plan(plant, 0.4, 0.015, -0.3, 0.0, 10.0, nodes=NODES), plant)


def draw_steps() -> Figure:
    """Draw attitude and current of the simulated steps: Fig. 5.7 and 5.8."""
    signals = panels.RunSignals(flown_simulation())
    figure = Figure(figsize=(10.0, 7.0), layout="constrained")
    attitude, current = figure.subplots(2, 1, sharex=True)
    panels.attitude(attitude, signals)
    panels.current(current, signals)
    attitude.set_xlabel("")
    return figure


def flown_simulation(duration: float = 700.0) -> Run:
    """Return the run of the thesis's simulation, flown by this software."""
    config = configuration.replace(as_testbed(configuration.load(SIMULATION)), duration=duration)
    steps = tuple(step for step in config.steps if step.at < duration)
    text = SIMULATION.read_text(encoding="utf-8")
    section = configuration.simulation_section(text, SIMULATION.name, Simulation)
    with tempfile.TemporaryDirectory() as place:
        return fly(configuration.replace(config, steps=steps), Path(place) / "run", section=section)


def draw_indicators() -> Figure:
    """Draw slope, length and OLAE residual of every streak in a frame with an object: Fig. 4.2 to 4.4."""
    camera = StarCameraModel(field_of_view=FIELD)
    generator = np.random.default_rng(OBJECT_SEED)
    sky = draw_sky(camera, generator, tracked=False)
    pixels = sky.frame(camera, OBJECT_MAGNITUDE, generator)
    streaks = measure_streaks(segment_frame(pixels, StreakSettings()), StreakSettings())
    ends = streaks.endpoints
    item = int(np.linalg.norm(ends.mean(axis=1) - sky.path.mean(axis=0), axis=1).argmin())
    figure = Figure(figsize=(8.0, 8.4), layout="constrained")
    rows = figure.subplots(3, 1, sharex=True)
    shown = indicators(ends, sky.rate, camera.pinhole)
    for axes, (label, values), printed in zip(rows, shown, PRINTED_SIGMAS, strict=True):
        mean, spread = float(values.mean()), float(values.std())
        axes.plot(values, "o", color=_BLUE, markersize=4)
        axes.plot(item, values[item], "o", color=_ORANGE, markersize=9, markerfacecolor="none")
        axes.axhline(mean, color="black", linewidth=0.8)
        axes.axhspan(mean - spread, mean + spread, color="gray", alpha=0.2, linewidth=0.0)
        beyond = abs(values[item] - mean) / spread
        axes.set_title(
            f"{label}: the object lies {beyond:.1f} sigma from the mean (thesis {printed:g})", fontsize=10
        )
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    rows[-1].set_xlabel("streak index (the object circled; the band is 1 sigma)")
    return figure


def indicators(ends: FloatArray, rate: FloatArray, pinhole: Pinhole) -> list[tuple[str, FloatArray]]:
    """Return the thesis's three indicators (n,) of streaks (n, 2, 2), as plotted in its Fig. 4.2 to 4.4.

    `rate` is the rate of the stars (rad/s) over `EXPOSURE`. The end points of each streak are ordered in the
    direction of a star's motion. A slope is that of the straight line between the two ends in the image; it
    is not corrected for the projection.
    """
    vectors = pinhole.unit_vectors(ends)
    expected = star_ends(vectors, rate * EXPOSURE)
    backward = np.sum((vectors[:, 1] - vectors[:, 0]) * (expected[:, 1] - expected[:, 0]), axis=-1) < 0.0
    vectors = np.where(backward[:, None, None], vectors[:, ::-1], vectors)
    ordered = np.where(backward[:, None, None], ends[:, ::-1], ends)
    slope = np.tan(slopes(ordered))
    return [
        ("slope", np.asarray(slope)),
        ("length, px", lengths(ends)),
        ("OLAE residual", olae_residuals(vectors, rate * EXPOSURE)),
    ]


def _show(axes: Axes, pixels: Image) -> None:
    low, high = np.percentile(pixels, (1.0, 99.9))
    axes.imshow(pixels, cmap="gray_r", vmin=low, vmax=high, interpolation="nearest")
    axes.set(xticks=[], yticks=[])


PICTURES: dict[str, Callable[[], Figure]] = {
    "fig_2_1_sky": draw_star_table,
    "fig_3_1_to_3_4_cornerness": draw_cornerness,
    "fig_3_5_centre_of_rotation": draw_centre,
    "fig_4_2_to_4_4_indicators": draw_indicators,
    "fig_5_4_to_5_6_path": draw_path,
    "fig_5_7_and_5_8_steps": draw_steps,
}
ACCURACIES = "fig_3_7_to_3_10_accuracies"

if __name__ == "__main__":
    raise SystemExit(main())
