"""Campaign `rso-orbits`: ten orbits as in the thesis (Tables 4.3 and 4.4).

The camera rotates at 0.05 rad/s about its y axis for ten orbits, with a frame every second. The frames in
which the object is observable are the opportunities. Run 0 starts with the attitude of the thesis, and all
other runs with a random rotation about the y axis. All runs have independent noise. The default detector,
which uses the pixels, is compared with each indicator alone. Each indicator is tested by two rules: the
thesis's strict rule of 2.5 sigma of the frame, and a rule with the lower bounds that the thesis requires. The
streak that an indicator selects counts as correct if it is that of the object, as an overlap if other stars
lie on it, and otherwise as false. Table 4.4 is also counted with the 7,000 brightest stars alone (to V 6.3).
The rates of the ten orbits are estimated by Harris's corners with OLAE, as in the thesis, and by the default
method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.reference.corner_streak_rate import estimate_rate
from knightcube.reference.corner_streaks import StreakSettings
from knightcube.vision.objects.detect import ObjectReport
from sim_hal.star_camera import StarCameraModel, render
from sim_hal.star_camera.objects import source_tracks
from tests.studies.campaigns.rso import EXPOSURE, MATCH_PX, STAR_LIMIT, by_magnitude, ends_error, look, match
from tests.studies.campaigns.statistics import median
from tests.support.opportunities import (
    Opportunity,
    Scenario,
    constant_slew,
    exposure_attitudes,
    opportunities,
    table_4_3,
)
from tests.support.scenes import BRIGHTEST, FIELD, catalogue, faintest

# 2026-05-18 0 h TT. With one frame per second, and with Sun and Earth at least half a field of view from the
# boresight (2.17 and 2.19), this epoch gives the thesis's number of opportunities.
EPOCH = 2_461_178.5
CADENCE = 1.0
HALF_ANGLE = 0.5 * FIELD
RATE = np.array([0.0, 0.05, 0.0])
TABLE_MAGNITUDE = 4.0
MAGNITUDES = (3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0, 6.5, 7.0, 7.5, 8.0)
# Largest distance (px) of another star that counts as lying on a streak, unless it is fainter by more than
# FAINTER.
NEAR_PX = 6.0
FAINTER_MAG = 4.0
# Table 4.4 of the thesis: correct, overlapping and false streaks of each indicator.
THESIS = ((12, 0, 3), (10, 2, 0), (12, 2, 0))
RULES = ("strict", "bounded")
ESTIMATORS = ("harris", "likelihood")


def cases(runs: int, seed: int) -> list[Case]:
    """Return the cases of each run: each magnitude with all stars, and Table 4.4 with the brightest stars."""
    return [
        Case(
            f"{run}/{magnitude}" + ("" if stars is None else f"/{stars}"),
            (seed, run),
            {"run": run, "magnitude": magnitude, "stars": stars},
        )
        for run in range(runs)
        for magnitude, stars in [*((each, None) for each in MAGNITUDES), (TABLE_MAGNITUDE, BRIGHTEST)]
    ]


@lru_cache(maxsize=4)
def flown(seed: tuple[int, ...], run: int) -> tuple[Scenario, tuple[Opportunity, ...]]:
    """Return a run's scenario and its opportunities."""
    camera = StarCameraModel(field_of_view=FIELD)
    scenario = table_4_3(EPOCH, TABLE_MAGNITUDE, camera.pinhole, HALF_ANGLE)
    if run > 0:
        angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi)
        initial = from_rotation_vector(np.array([0.0, angle, 0.0]))
        scenario = replace(scenario, attitude=constant_slew(RATE, initial))
    return scenario, tuple(opportunities(scenario, CADENCE, EXPOSURE))


def run(case: Case) -> Result:
    """Simulate ten orbits, and search for the object at every opportunity."""
    scenario, times = flown(case.seed, case.parameters["run"])
    return {
        **case.parameters,
        "seed": list(case.seed),
        "frames": [one_frame(scenario, at, case, number) for number, at in enumerate(times)],
    }


def one_frame(scenario: Scenario, at: Opportunity, case: Case, number: int) -> Result:
    """Expose at an opportunity; count the selections of each indicator and of the default detector."""
    camera = StarCameraModel(field_of_view=FIELD)
    magnitude, stars = case.parameters["magnitude"], case.parameters.get("stars")
    limit = STAR_LIMIT if stars is None else faintest(stars)
    pixels = expose(scenario, at, magnitude, np.random.default_rng((*case.seed, number)), limit)
    report, seconds = look(pixels, camera, RATE)
    truth = np.array([at.first, at.last])
    found = match(report, truth)
    result = {"magnitude": magnitude, "error_px": found.error, "false": found.false, "seconds": seconds}
    result["harris"] = rate_error(corner_rate(pixels, camera, RATE))
    result["likelihood"] = rate_error(None if report is None else report.rotation / EXPOSURE)
    if report is not None:
        near = star_streaks(scenario, at, limit)
        result |= {rule: count_indicators(report, truth, *near, rule) for rule in RULES}
        result["overlapping"] = sum(
            _overlap(item.endpoints, *near)
            for item in report.objects
            if ends_error(item.endpoints, truth) >= MATCH_PX
        )
    return result


def corner_rate(pixels: Image, camera: StarCameraModel, prior: FloatArray) -> FloatArray | None:
    """Return the rate (3,) by Harris's corners and OLAE with the sign of `prior`, or None without a rate."""
    settings = StreakSettings.of("harris", saturation=float(camera.highest_count), gain=camera.gain)
    return estimate_rate(pixels, camera.pinhole, EXPOSURE, settings, prior, 0.0).rate


def rate_error(rate: FloatArray | None, truth: FloatArray = RATE) -> list[float] | None:
    """Return the relative error of a rate's magnitude, and the error of its axis (deg).

    None without a rate.
    """
    if rate is None:
        return None
    size, true = float(np.linalg.norm(rate)), float(np.linalg.norm(truth))
    off = np.arctan2(np.linalg.norm(np.cross(rate, truth)), rate @ truth)
    return [size / true - 1.0, float(np.degrees(off))]


def mean_errors(errors: Sequence[Sequence[float] | None]) -> dict[str, Any]:
    """Return how many frames have a rate, with the mean absolute errors of magnitude (%) and axis (deg)."""
    found = np.abs([error for error in errors if error is not None]).reshape(-1, 2)
    magnitude, axis = found.mean(axis=0).tolist() if len(found) else (None, None)
    percent = None if magnitude is None else 100.0 * magnitude
    return {"rates": len(found), "magnitude_percent": percent, "axis_deg": axis}


def expose(
    scenario: Scenario, at: Opportunity, magnitude: float, rng: np.random.Generator, limit: float = STAR_LIMIT
) -> Image:
    """Return the frame of an opportunity with its object at `magnitude` in full sunlight."""
    times, attitudes = exposure_attitudes(scenario, at.start, EXPOSURE)
    item = replace(scenario.objects[at.index], magnitude=magnitude)
    tracks = source_tracks(scenario.camera, [item], scenario.epoch, at.start, at.start + EXPOSURE)
    stars, directions = catalogue(limit)
    camera = StarCameraModel(field_of_view=FIELD)
    return render(camera, directions, stars.magnitude, times, attitudes, rng, tracks)


def star_streaks(
    scenario: Scenario, at: Opportunity, limit: float = STAR_LIMIT
) -> tuple[FloatArray, FloatArray]:
    """Return streak ends (n, 2, 2) px and magnitudes (n,) of the stars near the field, down to `limit`."""
    stars, directions = catalogue(limit)
    attitudes = scenario.attitude(at.start + EXPOSURE * np.array([0.0, 1.0]))
    near = directions @ attitude_matrix(attitudes[0])[2] > np.cos(scenario.pinhole.half_diagonal + 0.05)
    ends = [scenario.pinhole.project(directions[near] @ attitude_matrix(q).T) for q in attitudes]
    return np.stack(ends, axis=1), stars.magnitude[near]


def count_indicators(
    report: ObjectReport, truth: FloatArray, ends: FloatArray, magnitudes: FloatArray, rule: str
) -> list[list[int]]:
    """Return the counts (3, 3) of correct, overlapping and false streaks that each indicator selects."""
    streaks = report.indicators.endpoints
    fired = _strict(report.indicators.deviations) if rule == "strict" else report.indicators.fired
    counts = np.zeros((3, 3), dtype=int)
    for streak, which in zip(streaks, fired, strict=True):
        if not which.any():
            continue
        correct = ends_error(streak, truth) < MATCH_PX
        overlap = not correct and _overlap(streak, ends, magnitudes)
        counts[which, 0 if correct else 1 if overlap else 2] += 1
    found: list[list[int]] = counts.tolist()
    return found


def _strict(deviations: FloatArray) -> BoolArray:
    """Return which deviations (n, 3) differ from the frame's mean by more than 2.5 standard deviations."""
    away = np.abs(deviations - deviations.mean(axis=0))
    return np.asarray(away > 2.5 * deviations.std(axis=0))


def _overlap(streak: FloatArray, ends: FloatArray, magnitudes: FloatArray) -> bool:
    """Return whether at least two stars of visible brightness lie on a streak (2, 2), px."""
    chord = streak[1] - streak[0]
    length = float(np.linalg.norm(chord))
    along = chord / length if length > 0.0 else np.array([1.0, 0.0])
    steps = np.linspace(0.0, 1.0, 33)[:, None]
    points = ends[:, :1] + steps * (ends[:, 1:] - ends[:, :1])
    offset = points - streak[0]
    forward = offset @ along
    across = offset @ np.array([-along[1], along[0]])
    on_it = (np.abs(across) < NEAR_PX) & (forward > -NEAR_PX) & (forward < length + NEAR_PX)
    bright = magnitudes[on_it.any(axis=1)]
    return bool(np.count_nonzero(bright < bright.min(initial=np.inf) + FAINTER_MAG) >= 2)


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return Table 4.4, the detection rate by magnitude, and the figures."""
    whole = [result for result in results if result.get("stars") is None]
    frames = [frame for result in whole for frame in result["frames"]]
    rows = [by_magnitude(frames, magnitude) for magnitude in MAGNITUDES]
    skies = {"whole": whole, f"brightest {BRIGHTEST}": [r for r in results if r.get("stars") == BRIGHTEST]}
    seconds = [frame["seconds"] for frame in frames]
    facts: dict[str, Any] = {
        "opportunities": [len(r["frames"]) for r in whole if r["magnitude"] == TABLE_MAGNITUDE],
        "thesis_opportunities": 14,
        "thesis": [list(row) for row in THESIS],
        "skies": {name: table_4_4(own) for name, own in skies.items()},
        "by_magnitude": rows,
        "false": sum(frame["false"] for frame in frames),
        "frames": len(frames),
        "seconds_median": median(seconds),
        "seconds_largest": max(seconds, default=None),
    }
    return summary(facts)


def table_4_4(results: Sequence[Result]) -> dict[str, Any]:
    """Return Table 4.4 for each rule and for the default detector, and the mean errors of the rates."""
    frames = [f for result in results for f in result["frames"] if f["magnitude"] == TABLE_MAGNITUDE]
    counts = {rule: np.zeros((3, 3), dtype=int) for rule in RULES}
    for frame in frames:
        for rule in RULES:
            counts[rule] += np.array(frame.get(rule, np.zeros((3, 3))), dtype=int)
    overlapping = sum(frame.get("overlapping", 0) for frame in frames)
    found = sum(frame["error_px"] is not None for frame in frames)
    return {
        **{rule: counts[rule].tolist() for rule in RULES},
        "judge": [found, overlapping, sum(frame["false"] for frame in frames) - overlapping],
        **{name: mean_errors([frame[name] for frame in frames]) for name in ESTIMATORS},
    }
