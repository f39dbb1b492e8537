"""Rate, endpoints and time by stage of seven estimators on the same frames, beside the Cramer-Rao bound.

`python -m tests.studies.bench streaks`: the maximum-likelihood estimator, the thesis's pipeline with each of
its four detectors, and OpenCV's line segment detector and Hough transform with the thesis's robust rotation
fit (`knightcube.reference.corner_streaks.rate`) behind them, their constant endpoint bias measured on other
frames and taken off as the four detectors' is. Frames of the real sky, theta uniform over the range asked
for, a turn in percent of
the field (3.28). Errors are rms over the frames that gave a rate; a ratio is the rms of error over
that frame's own bound. Wrong is as in the campaign `failures`. Recall: how many of the 20 brightest stars
whose streaks lie in the frame were found with both ends within 6 px; their ends' error is an rms over those.
Times are of the processor. Seeds of its own.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.reference.corner_streaks import rate as streak_rate
from knightcube.reference.corner_streaks.rate import RotationFit, fit_rotation
from knightcube.reference.corner_streaks.settings import DETECTOR_NAMES, DetectorName, StreakSettings
from knightcube.vision.camera.lens import EXACT
from knightcube.vision.objects.streak_ends import chord_outward, extend
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.settings import LikelihoodSettings
from knightcube.vision.streaks.streak_result import MotionResult
from sim_hal.star_camera import StarCameraModel
from tests.studies.bench.stage_clock import REST, WHOLE, clocked
from tests.studies.campaigns import streaks as campaign
from tests.studies.campaigns.failures import WRONG_SHARE, WRONG_SIGMAS
from tests.support.scenes import FIELD, Scene, slew, usable

if TYPE_CHECKING:
    from tests.studies.bench import opencv_lines

_SEED = 16_180
_BRIGHTEST = 20
_MATCH_PX = 6.0
_FAINTEST = 8.5
_PERCENTS = (5.0, 10.0, 20.0, 50.0)
# Frames, turn in percent and theta in deg that OpenCV's endpoint bias is measured on.
_CALIBRATION = (6, 10.0, (20.0, 90.0))
_WITHOUT_OPENCV = "OpenCV is not installed: pip install '.[bench]' adds its two detectors; going on without\n"


@dataclass(frozen=True, slots=True)
class Sighting:
    """What one estimator made of one frame.

    Attributes:
        rate: (3,) rad/s and covariance (3, 3), None when refused; endpoints (n, 2, 2) px, order of no
            meaning.
        stages: s of the processor by stage, `whole` among them.
    """

    rate: FloatArray | None
    covariance: FloatArray | None
    endpoints: FloatArray
    stages: dict[str, float]


Estimator = Callable[[Scene, StarCameraModel], Sighting]


def estimated(pixels: Image, rate: FloatArray, exposure: float, camera: StarCameraModel) -> MotionResult:
    """Return what the likelihood estimator says of a frame; the true `rate` (3,) only gives the sign."""
    settings = LikelihoodSettings(saturation=float(camera.highest_count), gain=camera.gain, knowledge=EXACT)
    return estimate_motion(pixels, camera.pinhole, exposure, settings, rate, 0.0)


def by_likelihood(scene: Scene, camera: StarCameraModel) -> Sighting:
    """Return what the maximum-likelihood estimator sees."""
    with clocked(_module_of(estimate_motion), "knightcube.vision.streaks") as stages:
        found = estimated(scene.pixels, scene.rate, scene.exposure, camera)
    ends = np.concatenate([found.endpoints, found.faint_endpoints])
    return Sighting(found.rate, found.covariance, ends, stages)


def by_corners(detector: DetectorName, scene: Scene, camera: StarCameraModel) -> Sighting:
    """Return what the thesis's pipeline sees with one of its detectors."""
    settings = StreakSettings.of(detector, saturation=float(camera.highest_count), gain=camera.gain)
    with clocked(_module_of(streak_rate.estimate_rate), "knightcube.reference.corner_streaks") as stages:
        found = streak_rate.estimate_rate(
            scene.pixels, camera.pinhole, scene.exposure, settings, scene.rate, 0.0
        )
    return Sighting(found.rate, found.covariance, found.endpoints, stages)


def _module_of(function: Callable[..., Any]) -> ModuleType:
    return sys.modules[function.__module__]


@dataclass(frozen=True, slots=True)
class ByLines:
    """What a line detector of OpenCV sees, with the thesis's fit behind it.

    Attributes:
        lines: the module `opencv_lines`; `name` that of the detector.
        bias: px, outward correction of an end; sigma: px, scatter of an end along the streak.
    """

    lines: ModuleType
    name: str
    bias: float = 0.0
    sigma: float = 1.0

    def detect(self, scene: Scene) -> tuple[FloatArray, dict[str, float]]:
        """Return streaks (n, 2, 2) px, strongest first, as localised, and s by stage."""
        marks = [time.process_time()]
        frame: opencv_lines.Prepared = self.lines.prepare(scene.pixels)
        marks.append(time.process_time())
        segments = self.lines.DETECTORS[self.name](frame)
        marks.append(time.process_time())
        streaks = self.lines.merge(segments, frame)
        marks.append(time.process_time())
        return streaks, dict(zip(("prepare", "detect", "merge"), map(float, np.diff(marks)), strict=True))

    def __call__(self, scene: Scene, camera: StarCameraModel) -> Sighting:
        """Return the rate from the strongest streaks' ends."""
        streaks, stages = self.detect(scene)
        # The thesis's limits are of errors well below a pixel: these detectors' are wider.
        settings = StreakSettings(
            endpoint_bias=self.bias,
            endpoint_bias_sigma=0.1 * self.sigma,
            axis_tolerance=max(1.0, 2.0 * self.sigma),
            worst_residual=max(0.9, 3.0 * self.sigma),
        )
        begun = time.process_time()
        strongest = streaks[: settings.most_streaks]
        sigma = np.full(len(strongest), self.sigma)
        enough = len(strongest) >= settings.least_streaks
        fit = fit_rotation(strongest, sigma, camera.pinhole, settings) if enough else None
        stages["fit"] = time.process_time() - begun
        stages[WHOLE] = sum(stages.values())
        ends = extend(streaks, chord_outward(streaks), self.bias) if len(streaks) else streaks
        if fit is None or self._unfit(fit, camera.pinhole.focal_length, settings):
            return Sighting(None, None, ends, stages)
        rate = fit.rotation_vector / scene.exposure
        sign = 1.0 if rate @ scene.rate > 0.0 else -1.0
        return Sighting(sign * rate, fit.covariance / scene.exposure**2, ends, stages)

    @staticmethod
    def _unfit(fit: RotationFit, focal_length: float, settings: StreakSettings) -> bool:
        """Tell whether `estimate_rate` would refuse: no shared rotation, or too short streaks."""
        used = fit.endpoints[fit.used]
        length = float(np.median(np.linalg.norm(used[:, 1] - used[:, 0], axis=-1)))
        return fit.residual * focal_length > settings.worst_residual or length < settings.least_length

    def calibrated(self, camera: StarCameraModel, exposure: float, seed: int) -> ByLines:
        """Return this with bias and scatter of its ends, measured on frames of their own."""
        frames, percent, thetas = _CALIBRATION
        errors = []
        for scene in scenes(camera, frames, percent, thetas, exposure, (seed, 1)):
            found, _ = self.detect(scene)
            errors.append(_outward_errors(found, _true_ends(scene, camera)))
        along = np.concatenate(errors)
        middle = float(np.median(along))
        spread = 1.4826 * float(np.median(np.abs(along - middle)))
        return ByLines(self.lines, self.name, -middle, max(spread, 0.1))


def scenes(
    camera: StarCameraModel,
    frames: int,
    percent: float,
    thetas: tuple[float, float],
    exposure: float,
    seed: tuple[int, ...],
    faintest: float = _FAINTEST,
) -> list[Scene]:
    """Return frames of a turn of `percent` of the field, theta spread evenly over `thetas` deg.

    The sky holds stars down to magnitude `faintest`.
    """
    found = []
    for frame in range(frames):
        generator = np.random.default_rng((*seed, round(10.0 * percent), frame))
        # One theta from each of `frames` equal parts of the range.
        theta = thetas[0] + (thetas[1] - thetas[0]) * (frame + generator.uniform()) / frames
        angle, fraction = float(np.deg2rad(theta)), percent / 100.0
        found.append(slew(generator, angle, fraction, exposure, faintest, camera))
    return found


def _true_ends(scene: Scene, camera: StarCameraModel) -> FloatArray:
    """Return the ends (n, 2, 2) px of the brightest stars whose streaks lie in the frame."""
    whole = usable(scene, camera)
    brightest = whole[np.argsort(-scene.electrons[whole], kind="stable")][:_BRIGHTEST]
    return np.stack([scene.start[brightest], scene.end[brightest]], axis=1)


def _matched(found: FloatArray, true: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the streaks (k, 2, 2) found for true ones, in the order of their ends, and those true ones."""
    if not len(found):
        return found, true[:0]
    orders = np.concatenate([found, found[:, ::-1]])
    worst = np.linalg.norm(orders[None] - true[:, None], axis=-1).max(axis=-1)
    nearest = worst.argmin(axis=1)
    near = worst[np.arange(len(true)), nearest] < _MATCH_PX
    return orders[nearest[near]], true[near]


def _outward_errors(found: FloatArray, true: FloatArray) -> FloatArray:
    """Return how far (k,) the found ends lie outward of the true ones along the streak, px."""
    ends, truth = _matched(found, true)
    outward = chord_outward(truth)
    outward = outward / np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-9)
    return np.asarray(np.sum((ends - truth) * outward, axis=-1).reshape(-1))


def estimators(camera: StarCameraModel, exposure: float, seed: int) -> dict[str, Estimator]:
    """Return all estimators by name; those of OpenCV only when it is there."""
    known: dict[str, Estimator] = {"likelihood": by_likelihood}
    known |= {name: partial(by_corners, name) for name in DETECTOR_NAMES}
    try:
        from tests.studies.bench import opencv_lines  # noqa: PLC0415
    except ModuleNotFoundError as error:
        if error.name != "cv2":
            raise
        sys.stderr.write(_WITHOUT_OPENCV)
        return known
    opencv_lines.one_thread()
    for name in opencv_lines.DETECTORS:
        known[name] = ByLines(opencv_lines, name).calibrated(camera, exposure, seed)
    return known


def measure(
    known: dict[str, Estimator], camera: StarCameraModel, frames: Sequence[Scene]
) -> dict[str, dict[str, Any]]:
    """Return each estimator's figures over the same frames."""
    bounds = [campaign._bound(scene, camera) for scene in frames]
    true = [_true_ends(scene, camera) for scene in frames]
    seen: dict[str, list[Sighting]] = {name: [] for name in known}
    for estimator in known.values():
        estimator(frames[0], camera)  # fills the caches, as the worker's first frame does
    for scene in frames:
        for name, estimator in known.items():
            seen[name].append(estimator(scene, camera))
    return {name: _figures(sightings, frames, bounds, true) for name, sightings in seen.items()}


def _figures(
    sightings: Sequence[Sighting],
    frames: Sequence[Scene],
    bounds: Sequence[list[float] | None],
    true: Sequence[FloatArray],
) -> dict[str, Any]:
    errors, own, squared, ends, matched = [], [], [], [], 0
    for sighting, scene, bound, truth in zip(sightings, frames, bounds, true, strict=True):
        found, there = _matched(sighting.endpoints, truth)
        matched += len(there)
        ends.append(np.linalg.norm(found - there, axis=-1).reshape(-1))
        if sighting.rate is None or sighting.covariance is None or bound is None:
            continue
        error, size = sighting.rate - scene.rate, float(np.linalg.norm(scene.rate))
        errors.append([np.linalg.norm(sighting.rate) / size - 1.0, np.linalg.norm(error) / size])
        own.append(bound)
        squared.append(float(error @ np.linalg.solve(sighting.covariance, error)))
    relative = np.array(errors).reshape(-1, 2)
    ratio = relative / np.array(own).reshape(-1, 2)
    off = (np.array(squared) > WRONG_SIGMAS**2) & (relative[:, 1] > WRONG_SHARE)
    return {
        "frames": len(frames),
        "rates": len(errors),
        "refused": [number for number, sighting in enumerate(sightings) if sighting.rate is None],
        "wrong": int(np.count_nonzero(off)),
        "magnitude": _rms(relative[:, 0]),
        "magnitude_ratio": _rms(ratio[:, 0]),
        "vector": _rms(relative[:, 1]),
        "vector_ratio": _rms(ratio[:, 1]),
        "nees": float(np.median(squared)) if squared else None,
        "endpoint_px": _rms(np.concatenate(ends)),
        "recall": matched / max(sum(map(len, true)), 1),
        "stages_ms": _stages(sightings),
    }


def _rms(values: FloatArray) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


def _stages(sightings: Sequence[Sighting]) -> dict[str, list[float]]:
    """Return median and 95 % quantile by stage, ms, in the order in which they came; `whole` is last."""
    names = list(dict.fromkeys(name for sighting in sightings for name in sighting.stages))
    order = [name for name in names if name not in (REST, WHOLE)] + [n for n in (REST, WHOLE) if n in names]
    table = {name: 1e3 * np.array([s.stages.get(name, 0.0) for s in sightings]) for name in order}
    return {name: [float(np.quantile(row, q)) for q in (0.5, 0.95)] for name, row in table.items()}


def _lines(percent: float, figures: dict[str, dict[str, Any]]) -> list[str]:
    """Return the tables of one turn: accuracy, then time."""
    lines = [
        f"turn of {percent:g} % of the field",
        "estimator            rates  wrong  magnitude %  x bound  vector %  x bound  NEES of 3, median"
        "  ends px  recall   ms median  p95",
    ]
    for name, row in figures.items():
        median, high = row["stages_ms"][WHOLE]
        lines.append(
            f"{name:18} {row['rates']:3d}/{row['frames']:<3d} {row['wrong']:5d}"
            f"  {_text(row['magnitude'], 100.0, 3):>11}  {_text(row['magnitude_ratio'], 1.0, 2):>7}"
            f"  {_text(row['vector'], 100.0, 3):>8}  {_text(row['vector_ratio'], 1.0, 2):>7}"
            f"  {_text(row['nees'], 1.0, 1):>17}  {_text(row['endpoint_px'], 1.0, 3):>7}"
            f"  {100 * row['recall']:5.0f}%  {median:10.1f}  {high:5.1f}"
        )
    lines.append("ms by stage, median / p95 (below 0.5 ms left out)")
    for name, row in figures.items():
        stages = [
            f"{stage} {median:.1f} / {high:.1f}"
            for stage, (median, high) in row["stages_ms"].items()
            if stage != WHOLE and high >= 0.5
        ]
        lines.append(f"  {name:18} " + ", ".join(stages))
    return lines


def _text(value: float | None, scale: float, digits: int) -> str:
    return "-" if value is None else f"{scale * value:.{digits}f}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables, or one JSON object; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=20, help="for each turn (default %(default)s)")
    parser.add_argument("--seed", type=int, default=_SEED, help="default %(default)s")
    parser.add_argument(
        "--percent", type=float, nargs="+", default=list(_PERCENTS), help="turns, %% of the field"
    )
    parser.add_argument(
        "--theta", type=float, nargs=2, default=[0.0, 90.0], metavar=("LOW", "HIGH"), help="deg (default all)"
    )
    parser.add_argument("--exposure", type=float, default=0.2, help="s (default %(default)s)")
    parser.add_argument(
        "--faintest", type=float, default=_FAINTEST, help="star in the sky, V (default %(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the tables")
    options = parser.parse_args(arguments)
    if options.frames < 1 or not options.exposure > 0.0:
        parser.error("--frames and --exposure must be positive")
    camera = StarCameraModel(field_of_view=FIELD)
    known = estimators(camera, options.exposure, options.seed)
    told = sys.stderr if options.json else sys.stdout
    told.write(
        f"{options.frames} frames for each turn, theta {options.theta[0]:g} to {options.theta[1]:g} deg,"
        f" exposure {options.exposure:g} s, stars to V {options.faintest:g}, seed {options.seed}\n"
    )
    for name, estimator in known.items():
        if isinstance(estimator, ByLines):
            told.write(
                f"{name}: ends corrected by {estimator.bias:+.2f} px, scatter {estimator.sigma:.2f} px\n"
            )
    cells = []
    for percent in options.percent:
        thetas, seed = (options.theta[0], options.theta[1]), (options.seed, 0)
        frames = scenes(camera, options.frames, percent, thetas, options.exposure, seed, options.faintest)
        figures = measure(known, camera, frames)
        cells.append({"percent": percent, "estimators": figures})
        if not options.json:
            sys.stdout.write("\n" + "\n".join(_lines(percent, figures)) + "\n")
            sys.stdout.flush()
    if options.json:
        told_facts = {"seed": options.seed, "exposure_s": options.exposure, "cells": cells}
        sys.stdout.write(json.dumps(told_facts) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
