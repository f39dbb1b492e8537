"""The thesis's four corner detectors by its own metrics: `python -m tests.studies.bench.corner_detectors`.

Table 3.1 for random star fields: the rate's magnitude in percent, mean of its absolute error (and the rms
error of the whole vector, which is larger: the boresight component is weak), and the attitude at one end by
3.29, of the whole turn and across the boresight, by ESOQ2 with the true stars injected. Raw and with each
detector's constant `endpoint_bias`. A turn of 10 % of the field is a streak of 10 % times sin(theta) (3.28).
The thesis's figure is the largest within its precise region of theta, as is the last line of each block.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import sys
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import from_rotation_vector
from knightcube.errors import FlightError
from knightcube.vision.startracker.two_ends import attitudes_of_ends
from knightcube.vision.streaks.corners.rate_fit import RotationFit, fit_rotation
from knightcube.vision.streaks.corners.settings import DETECTOR_NAMES, DetectorName, StreakSettings
from knightcube.vision.streaks.corners.streaks import Segmented, measure_streaks, segment_frame
from tests.knightcube.vision.streaks.frames import (
    Camera,
    expose,
    random_stars,
    rate_at,
    read_out,
    star_camera,
    true_endpoints,
)
from tests.studies.attitude_errors import attitude_error, error_in_pixels

_SEED = 141_421
_FIELD = float(np.deg2rad(20.0))
_MATCH_PX = 5.0
# Table 3.1: attitude px at 10 and 50 % of the field, rate % at 10 and 50 %, least theta in deg.
_THESIS: dict[DetectorName, tuple[float, float, float, float, float]] = {
    "harris": (0.10, 0.10, 0.69, 0.07, 20.0),
    "minimum-eigenvalue": (0.19, 0.20, 1.20, 0.19, 30.0),
    "trajkovic-4": (0.39, 0.37, 2.44, 0.38, 30.0),
    "trajkovic-8": (0.55, 0.29, 3.49, 0.47, 30.0),
}
_FIGURES = ("magnitude", "vector", "whole", "across")


@dataclasses.dataclass(frozen=True)
class Scene:
    """One frame and its truth."""

    segmented: Segmented
    stars: FloatArray
    rotation: FloatArray
    ends: FloatArray


def scene(camera: Camera, theta: float, fraction: float, exposure: float, seed: list[int]) -> Scene:
    """Return a random field seen while turning by `fraction` of the field of view at `theta` rad."""
    rng = np.random.default_rng(seed)
    rotation = rate_at(theta, fraction * _FIELD, rng.uniform(0.0, 2.0 * np.pi))
    stars, magnitudes = random_stars(rng, camera.pinhole, fraction * _FIELD, 7.0)
    pixels = read_out(camera, expose(camera, stars, magnitudes, rotation, exposure), exposure, rng)
    segmented = segment_frame(pixels, StreakSettings())
    return Scene(segmented, stars, rotation, true_endpoints(camera, stars, rotation))


def errors_of(view: Scene, camera: Camera, settings: StreakSettings) -> FloatArray | None:
    """Return the four figures of one frame: magnitude %, vector %, attitude px whole and across; or None."""
    streaks = measure_streaks(view.segmented, settings)
    if len(streaks) < settings.least_streaks:
        return None
    fit = fit_rotation(streaks.endpoints, streaks.sigma, camera.pinhole, settings)
    if fit is None:
        return None
    sign = 1.0 if fit.rotation_vector @ view.rotation > 0.0 else -1.0
    turned = float(np.linalg.norm(view.rotation))
    magnitude = abs(float(np.linalg.norm(fit.rotation_vector)) / turned - 1.0)
    vector = float(np.linalg.norm(sign * fit.rotation_vector - view.rotation)) / turned
    whole, across = _attitude_errors(view, camera, fit, streaks.sigma, sign)
    return np.array([100.0 * magnitude, 100.0 * vector, whole, across])


def _attitude_errors(
    view: Scene, camera: Camera, fit: RotationFit, sigma: FloatArray, sign: float
) -> tuple[float, float]:
    """Return the mean over both ends of the attitude's error in px (3.29), whole and across the boresight."""
    ends = fit.endpoints[fit.used][:, :: int(sign)]
    distance = np.linalg.norm(view.ends[None] - ends[:, None], axis=-1).max(axis=-1)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    star = distance.argmin(axis=1)
    known = distance[np.arange(len(ends)), star] < _MATCH_PX
    try:
        found = attitudes_of_ends(
            ends[known], view.stars[star[known]], sigma[fit.used][known], camera.pinhole, exposure=1.0
        )
    except FlightError:
        return float("nan"), float("nan")
    errors = [
        attitude_error(attitude.quaternion, from_rotation_vector(part * view.rotation))
        for attitude, part in ((found.start, -0.5), (found.end, 0.5))
    ]
    whole, across = np.mean(errors, axis=0)
    resolution = camera.pinhole.columns
    return error_in_pixels(float(whole), resolution, _FIELD), error_in_pixels(
        float(across), resolution, _FIELD
    )


def measure(
    camera: Camera, theta_deg: float, fraction: float, exposure: float, frames: int, seed: int
) -> list[dict[str, Any]]:
    """Return a row for each detector, raw and compensated, over the same `frames` random frames."""
    found: dict[tuple[DetectorName, bool], list[FloatArray]] = {
        key: [] for key in itertools.product(DETECTOR_NAMES, (False, True))
    }
    for frame in range(frames):
        view = scene(camera, np.deg2rad(theta_deg), fraction, exposure, [seed, round(theta_deg), frame])
        for (detector, compensated), results in found.items():
            settings = StreakSettings.of(detector)
            if not compensated:
                settings = dataclasses.replace(settings, endpoint_bias=0.0)
            result = errors_of(view, camera, settings)
            if result is not None:
                results.append(result)
    rows = []
    for (detector, compensated), results in found.items():
        table = np.array(results).reshape(-1, 4)
        figures = np.nanmean(table, axis=0) if len(table) else np.full(4, np.nan)
        if len(table):
            figures[1] = np.sqrt(np.mean(table[:, 1] ** 2))
        rows.append(
            {"detector": detector, "compensated": compensated, "theta_deg": theta_deg, "percent": fraction}
            | {"frames": frames, "solved": len(table)}
            | dict(zip(_FIGURES, map(float, figures), strict=True))
        )
    return rows


def _worst(rows: list[dict[str, Any]], detector: DetectorName, compensated: bool) -> dict[str, float]:
    """Return the largest figures of a detector within the thesis's precise region."""
    least = _THESIS[detector][4]
    chosen = [
        row
        for row in rows
        if (row["detector"], row["compensated"]) == (detector, compensated) and row["theta_deg"] >= least
    ]
    return {name: float(np.nanmax([row[name] for row in chosen])) for name in _FIGURES}


def _line(row: dict[str, Any]) -> str:
    figures = f"{row['magnitude']:8.3f} {row['vector']:8.3f}   {row['whole']:7.3f} {row['across']:7.3f}"
    return f"{row['theta_deg']:5.0f}  {row['solved']:3d}/{row['frames']:<3d}  {figures}"


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _print(rows: list[dict[str, Any]], fraction: float) -> None:
    for detector, compensated in itertools.product(DETECTOR_NAMES, (False, True)):
        _say(f"\n{detector}, {100 * fraction:.0f} %, {'compensated' if compensated else 'raw'}")
        _say("theta  solved     rate magn., vector %   attitude whole, across px")
        for row in rows:
            if (row["detector"], row["compensated"]) == (detector, compensated):
                _say(_line(row))
        worst = _worst(rows, detector, compensated)
        attitude10, attitude50, rate10, rate50, least = _THESIS[detector]
        attitude, rate = (attitude10, rate10) if fraction < 0.3 else (attitude50, rate50)
        _say(
            f"worst at theta >= {least:.0f}: {worst['magnitude']:.3f} % (thesis {rate}),"
            f" {worst['across']:.3f} px across, {worst['whole']:.3f} whole (thesis {attitude})"
        )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10, help="per cell (default %(default)s)")
    parser.add_argument("--seed", type=int, default=_SEED, help="default %(default)s")
    parser.add_argument("--exposure", type=float, default=1.0, help="s (default %(default)s)")
    parser.add_argument("--theta", type=float, nargs="+", default=[20.0, 30.0, 45.0, 60.0, 75.0, 90.0])
    parser.add_argument("--percent", type=float, nargs="+", default=[10.0, 50.0], help="of the field")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the tables")
    options = parser.parse_args()
    camera = star_camera()
    everything = []
    for percent in options.percent:
        rows = []
        for theta in options.theta:
            rows += measure(camera, theta, 0.01 * percent, options.exposure, options.frames, options.seed)
        everything += rows
        if not options.json:
            _print(rows, 0.01 * percent)
    if options.json:
        _say(json.dumps({"seed": options.seed, "exposure": options.exposure, "rows": everything}))


if __name__ == "__main__":
    main()
