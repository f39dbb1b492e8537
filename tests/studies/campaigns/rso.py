"""Campaigns `rso-slew` and `rso-track`: Tables 4.2 and 4.1 over random skies, motions and magnitudes.

The camera turns at a constant rate about its y axis and exposes for half a second. In `rso-slew` an object
moves among the stars and leaves a streak of its own; in `rso-track` the camera follows it, a point among
streaks. A scene is drawn once and shown with the object at each magnitude, and without one: finds are
then false. The rate is that of the thesis's pipeline and of the likelihood, with the object in the frame.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.reference.corner_streaks.rate import estimate_rate
from knightcube.reference.corner_streaks.settings import StreakSettings
from knightcube.vision.camera.lens import EXACT
from knightcube.vision.objects.detect import ObjectReport, detect
from knightcube.vision.objects.settings import ObjectSettings
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.settings import LikelihoodSettings
from knightcube.vision.streaks.streak_result import StreakStatus
from sim_hal.star_camera import SourceTrack, StarCameraModel, render
from tests.studies.campaigns.campaign import Campaign, Case, Result, Summary
from tests.studies.campaigns.rso_pictures import draw_detection_rate, draw_frames
from tests.studies.campaigns.rso_table import thesis_table
from tests.support.scenes import FIELD, SAMPLES, catalogue

EXPOSURE = 0.5
MAGNITUDES = (1.0, 3.0, 4.0, 5.0, 6.0)
SLEW_RATE = 0.05
TRACK_RATE = float(np.deg2rad(2.0))
STAR_LIMIT = 8.5
MATCH_PX = 4.0
# Objects stay so far inside the frame: the thesis, too, uses whole streaks.
MARGIN_PX = 20.0
# Of the objects' motion among the stars, rad/s: streaks of 9 to 87 px.
SLOWEST, FASTEST = 0.006, 0.06
SHOWN = (4.0, 6.0)
# Tables 4.2 and 4.1: rate %, axis deg.
THESIS = {"rso-slew": (0.67, 0.2), "rso-track": (0.9, 0.65)}
ESTIMATORS = ("harris", "likelihood")


@dataclass(frozen=True, slots=True, eq=False)
class Sky:
    """A scene without its noise: attitudes (k, 4) at times (k,) s, and an object's directions there.

    `rate` (3,) is the camera's in rad/s, `path` (k, 2) the object's in px.
    """

    rate: FloatArray
    times: FloatArray
    attitudes: FloatArray
    directions: FloatArray
    path: FloatArray

    def frame(self, camera: StarCameraModel, magnitude: float | None, rng: np.random.Generator) -> Image:
        """Return the frame with the object at `magnitude`, or without it."""
        stars, directions = catalogue(STAR_LIMIT)
        tracks = [] if magnitude is None else [SourceTrack(self.times, self.directions, magnitude)]
        return render(camera, directions, stars.magnitude, self.times, self.attitudes, rng, tracks)


@dataclass(frozen=True, slots=True)
class Found:
    """What a frame's report says of the one object that is there: error of its ends in px, None if missed.

    `false` counts the objects that are not there.
    """

    error: float | None
    false: int


def draw_sky(camera: StarCameraModel, generator: np.random.Generator, tracked: bool) -> Sky:
    """Return a random pointing and an object that stays in the frame."""
    rate = np.array([0.0, TRACK_RATE if tracked else SLEW_RATE, 0.0])
    times = np.linspace(0.0, EXPOSURE, SAMPLES)
    middle = normalise(generator.normal(size=4))
    since = (times - 0.5 * EXPOSURE)[:, None]
    attitudes = multiply(from_rotation_vector(since * rate), middle)
    pinhole = camera.pinhole
    while True:
        place = pinhole.unit_vectors(generator.uniform(MARGIN_PX, camera.columns - MARGIN_PX, (1, 2)))[0]
        motion = rate if tracked else _motion(generator, place)
        # In the axes of the middle attitude: an object on which a camera is that turns by `motion`.
        among_stars = np.swapaxes(attitude_matrix(from_rotation_vector(since * motion)), 1, 2) @ place
        directions = among_stars @ attitude_matrix(middle)
        seen = (attitude_matrix(attitudes) @ directions[..., None])[..., 0]
        path = pinhole.project(seen)
        if np.all(pinhole.contains(path, -MARGIN_PX)):
            return Sky(rate, times, attitudes, directions, path)


def _motion(generator: np.random.Generator, place: FloatArray) -> FloatArray:
    """Return a turn (3,) rad/s across `place`, its speed drawn evenly in its logarithm."""
    speed = np.exp(generator.uniform(np.log(SLOWEST), np.log(FASTEST)))
    axis = np.cross(place, generator.normal(size=3))
    return np.asarray(speed * axis / np.linalg.norm(axis))


def cases_of(tracked: bool, runs: int, seed: int) -> list[Case]:
    """Return each of `runs` scenes without an object and with one at each magnitude."""
    return [
        Case(f"{run}/{magnitude}", (seed, run), {"magnitude": magnitude, "tracked": tracked})
        for run in range(runs)
        for magnitude in (None, *MAGNITUDES)
    ]


def run(case: Case) -> Result:
    """Look for the object of one frame, and estimate the camera's rate from it."""
    camera = StarCameraModel(field_of_view=FIELD)
    generator = np.random.default_rng(case.seed)
    magnitude = case.parameters["magnitude"]
    sky = draw_sky(camera, generator, case.parameters["tracked"])
    pixels = sky.frame(camera, magnitude, generator)
    report, seconds = look(pixels, camera, sky.rate)
    found = match(report, None if magnitude is None else sky.path[[0, -1]])
    return {
        **case.parameters,
        "seed": list(case.seed),
        "status": "none" if report is None else "searched",
        "error_px": found.error,
        "false": found.false,
        "seconds": seconds,
        "true_rate": sky.rate.tolist(),
        **_rates(pixels, camera, sky.rate),
    }


def look(pixels: Image, camera: StarCameraModel, rate: FloatArray) -> tuple[ObjectReport | None, float]:
    """Return the report on a frame, by the likelihood's rotation, and the processor seconds of both."""
    settings = StreakSettings(saturation=float(camera.highest_count), gain=camera.gain)
    begun = time.process_time()
    likelihood = LikelihoodSettings(saturation=settings.saturation, gain=settings.gain, line_time=0.0)
    motion = estimate_motion(pixels, camera.pinhole, EXPOSURE, likelihood, rate, 0.0)
    if motion.rate is None:
        return None, time.process_time() - begun
    turn = motion.rate * EXPOSURE
    report = detect(pixels, camera.pinhole, turn, EXPOSURE, settings, ObjectSettings())
    return report, time.process_time() - begun


def match(report: ObjectReport | None, truth: FloatArray | None) -> Found:
    """Return which object of a report is the true one, of ends (2, 2) px, and how many are none."""
    if report is None:
        return Found(None, 0)
    if truth is None:
        return Found(None, len(report.objects))
    errors = [ends_error(item.endpoints, truth) for item in report.objects]
    hits = [error for error in errors if error < MATCH_PX]
    # A second find of the same object is false as well.
    return Found(min(hits, default=None), len(errors) - min(len(hits), 1))


def ends_error(ends: FloatArray, truth: FloatArray) -> float:
    """Return the larger error of two ends (2, 2) px; one frame does not show which came first."""
    return float(min(np.linalg.norm(ends - other, axis=1).max() for other in (truth, truth[::-1])))


def _rates(pixels: Image, camera: StarCameraModel, rate: FloatArray) -> Result:
    """Return the two estimators' rates, (3,) rad/s, and errors: magnitude in parts of it, axis in rad.

    None without a rate.
    """
    saturation = float(camera.highest_count)
    streaks = StreakSettings(saturation=saturation, gain=camera.gain)
    likelihood = LikelihoodSettings(saturation=saturation, gain=camera.gain, knowledge=EXACT)
    found = {
        "harris": estimate_rate(pixels, camera.pinhole, EXPOSURE, streaks, rate, 0.0),
        "likelihood": estimate_motion(pixels, camera.pinhole, EXPOSURE, likelihood, rate, 0.0),
    }
    rates = {name: e.rate if e.status is StreakStatus.RATE else None for name, e in found.items()}
    return {
        "estimated": {name: None if own is None else own.tolist() for name, own in rates.items()},
        "rates": {name: _rate_error(own, rate) for name, own in rates.items()},
    }


def _rate_error(own: FloatArray | None, rate: FloatArray) -> list[float] | None:
    if own is None:
        return None
    size, true = float(np.linalg.norm(own)), float(np.linalg.norm(rate))
    away = float(np.arctan2(np.linalg.norm(np.cross(own, rate)), own @ rate))
    return [size / true - 1.0, away]


def summarise_as(name: str, results: Sequence[Result], out: Path) -> Summary:
    """Return the table of the thesis beside this one's, detection by magnitude, and the pictures."""
    rates = {estimator: _rate_facts(results, estimator) for estimator in ESTIMATORS}
    rows = [by_magnitude(results, magnitude) for magnitude in MAGNITUDES]
    clean = [r for r in results if r["magnitude"] is None]
    seconds = [r["seconds"] for r in results]
    facts: dict[str, Any] = {
        "thesis": {"rate_percent": THESIS[name][0], "axis_deg": THESIS[name][1]},
        "rates": rates,
        "by_magnitude": rows,
        "clean_frames": len(clean),
        "false_in_clean": sum(r["false"] for r in clean),
        "false": sum(r["false"] for r in results),
        "frames": len(results),
        "seconds_median": float(np.median(seconds)) if seconds else None,
        "seconds_largest": max(seconds, default=None),
    }
    table = "4.1" if name == "rso-track" else "4.2"
    lines = [
        f"Table {table}: mean absolute errors of the rate          thesis (Harris) | Harris | likelihood"
    ]
    for label, key, thesis in (("rate, %", "rate_percent", 0), ("axis, deg", "axis_deg", 1)):
        here = " | ".join(number(rates[estimator][key], 4) for estimator in ESTIMATORS)
        lines.append(f"  {label:10} {THESIS[name][thesis]} | {here}")
    # The thesis's own table is of one frame, with an object of magnitude 1 in it.
    one = next((r for r in results if r["magnitude"] == MAGNITUDES[0]), None)
    if one is not None:
        rows_of_one, facts["one_frame"] = thesis_table(
            name, EXPOSURE, np.array(one["true_rate"]), one["estimated"]
        )
        lines = [*rows_of_one, "", *lines]
    counted = " | ".join(f"{rates[e]['rates']} of {rates[e]['frames']}" for e in ESTIMATORS)
    lines += [f"  rates given  - | {counted}", "", "magnitude  found        ends px (median)  false"]
    lines += [_magnitude_line(row) for row in rows]
    lines += [
        f"without an object: {facts['false_in_clean']} false in {len(clean)} frames",
        f"processor time of a frame: median {number(facts['seconds_median'], 2)} s, "
        f"largest {number(facts['seconds_largest'], 2)} s",
    ]
    return Summary("\n".join(lines) + "\n", facts, _pictures(name, results, rows, out))


def by_magnitude(results: Sequence[Result], magnitude: float) -> dict[str, Any]:
    """Return how many objects of a magnitude were found, and how well."""
    here = [r for r in results if r["magnitude"] == magnitude]
    errors = [r["error_px"] for r in here if r["error_px"] is not None]
    return {
        "magnitude": magnitude,
        "frames": len(here),
        "found": len(errors),
        "error_px": float(np.median(errors)) if errors else None,
        "false": sum(r["false"] for r in here),
    }


def _magnitude_line(row: dict[str, Any]) -> str:
    share = f"{row['found']} of {row['frames']}"
    return f"{row['magnitude']:9.1f}  {share:12} {number(row['error_px'], 2):16}  {row['false']}"


def _rate_facts(results: Sequence[Result], name: str) -> dict[str, Any]:
    good = np.array([r["rates"][name] for r in results if r["rates"][name] is not None]).reshape(-1, 2)
    mean = np.abs(good).mean(axis=0) if len(good) else None
    return {
        "rate_percent": None if mean is None else 100.0 * float(mean[0]),
        "axis_deg": None if mean is None else float(np.rad2deg(mean[1])),
        "rates": len(good),
        "frames": len(results),
    }


def number(value: float | None, digits: int) -> str:
    """Return a number as text, a dash for none."""
    return "-" if value is None else f"{value:.{digits}f}"


def _pictures(
    name: str, results: Sequence[Result], rows: Sequence[dict[str, Any]], out: Path
) -> tuple[Path, ...]:
    """Draw detection over magnitude, and the first scene's frames with the finds in them."""
    if not results:
        return ()
    camera = StarCameraModel(field_of_view=FIELD)
    frames = []
    for magnitude in SHOWN:
        generator = np.random.default_rng(results[0]["seed"])
        sky = draw_sky(camera, generator, results[0]["tracked"])
        pixels = sky.frame(camera, magnitude, generator)
        report, _ = look(pixels, camera, sky.rate)
        frames.append((f"magnitude {magnitude:g}", pixels, report, sky.path[[0, -1]]))
    return (
        draw_frames(frames, out / f"{name}_frames.png"),
        draw_detection_rate({name: rows}, out / f"{name}_detection.png"),
    )


def _cases_of_slew(runs: int, seed: int) -> list[Case]:
    return cases_of(False, runs, seed)


def _cases_of_track(runs: int, seed: int) -> list[Case]:
    return cases_of(True, runs, seed)


def _summarise_slew(results: Sequence[Result], out: Path) -> Summary:
    return summarise_as("rso-slew", results, out)


def _summarise_track(results: Sequence[Result], out: Path) -> Summary:
    return summarise_as("rso-track", results, out)


RSO_SLEW = Campaign(
    "rso-slew",
    "Table 4.2: a moving object in a constant slew, found and measured over magnitude",
    _cases_of_slew,
    run,
    _summarise_slew,
    20,
)
RSO_TRACK = Campaign(
    "rso-track",
    "Table 4.1: a tracked object, a point among streaks, over magnitude",
    _cases_of_track,
    run,
    _summarise_track,
    20,
)
