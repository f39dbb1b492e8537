"""Spread of the RSO indicators without an RSO, finds with one: `python -m tests.studies.bench.rso_spread`.

The first part measures the lower bounds of `ObjectSettings.bounds` (Sease, text at Table 4.4: "characterize
the performance with no RSOs"): percentiles of the three indicators over the single stars of random fields
(by the truth: not overlaps or pieces), and the false alarms left. The second puts one object a frame,
moving or tracked, at each magnitude and counts what is found. Seeds of its own.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections import Counter
from typing import Any

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.vision.objects.detect import detect
from knightcube.vision.objects.report import ObjectReport
from knightcube.vision.objects.rso_indicators import INDICATORS
from knightcube.vision.objects.settings import ObjectSettings
from knightcube.vision.streaks.corners.settings import DETECTOR_NAMES, StreakSettings
from knightcube.vision.streaks.maximum_likelihood.estimate import estimate_motion
from knightcube.vision.streaks.maximum_likelihood.settings import LikelihoodSettings
from tests.knightcube.vision.objects.space_objects import frame_with, motion_across, object_path, star_field
from tests.knightcube.vision.streaks.frames import rate_at, star_camera, true_endpoints

_SEED = 173_205
_EXPOSURE = 1.0
_FAINTEST_STAR = 7.0
_THETAS_DEG = (90.0, 60.0, 30.0, 10.0)
_PERCENTILES = (50.0, 90.0, 99.0, 99.9)
_CAMERA = star_camera()


def random_rotation(rng: np.random.Generator, frame: int) -> FloatArray:
    """Return a turn (3,) rad with streaks of 30 to 120 px at the middle, of 0.2 rad at most."""
    theta = np.deg2rad(_THETAS_DEG[frame % len(_THETAS_DEG)])
    length = rng.uniform(30.0, 120.0) / _CAMERA.pinhole.focal_length
    return rate_at(theta, min(length / np.sin(theta), 0.2), rng.uniform(0.0, 2.0 * np.pi))


def without(frames: int, seed: int, settings: StreakSettings) -> dict[str, Any]:
    """Return the spread of the indicators over single stars, and the verdicts, over frames without an RSO."""
    deviations, verdicts, crowded = [], Counter[str](), Counter[str]()
    false = failed = 0
    for frame in range(frames):
        rotation = random_rotation(np.random.default_rng([seed, frame]), frame)
        pixels = frame_with(_CAMERA, rotation, _EXPOSURE, seed + frame, [], _FAINTEST_STAR)
        report = _detect(pixels, rotation, settings)
        if report is None:
            failed += 1
            continue
        stars, _ = star_field(_CAMERA, seed + frame, _FAINTEST_STAR)
        single = _single_stars(report.indicators.endpoints, true_endpoints(_CAMERA, stars, rotation))
        deviations.append(np.abs(report.indicators.deviations[single]))
        verdicts.update(verdict.value for verdict in report.verdicts)
        crowded.update(verdict.value for verdict in report.crowded)
        false += len(report.objects)
    spread = np.percentile(np.concatenate(deviations), _PERCENTILES, axis=0)
    return {
        "frames": frames,
        "no_rotation": failed,
        "false": false,
        "verdicts": dict(verdicts),
        "crowded": dict(crowded),
        "spread": {name: spread[:, i].tolist() for i, name in enumerate(INDICATORS)},
    }


def _single_stars(found: FloatArray, true: FloatArray) -> BoolArray:
    """Return which streaks have both ends within 3 px of one star's: neither overlaps nor pieces."""
    distance = np.linalg.norm(found[:, None] - true[None], axis=-1).max(axis=-1)
    return np.asarray(np.nanmin(distance, axis=1) < 3.0)


def with_one(
    frames: int, seed: int, settings: StreakSettings, magnitude: float, tracked: bool
) -> dict[str, Any]:
    """Return how many single objects are found, by their place, and how many of them each indicator finds."""
    found = false = 0
    fired = Counter[str]()
    errors = []
    for frame in range(frames):
        rng = np.random.default_rng([seed, frame])
        rotation = random_rotation(rng, 0 if tracked else frame)
        place = _CAMERA.pinhole.unit_vectors(rng.uniform(150.0, 870.0, (1, 2)))[0]
        angle = rng.uniform(0.4, 1.2) * float(np.linalg.norm(rotation[:2])) + 20.0 / 2904.0
        motion = rotation if tracked else motion_across(place, angle, rng.uniform(0.0, 2.0 * np.pi))
        path = object_path(_CAMERA, place, motion, rotation)
        pixels = frame_with(_CAMERA, rotation, _EXPOSURE, seed + frame, [(path, magnitude)], _FAINTEST_STAR)
        report = _detect(pixels, rotation, settings)
        if report is None:
            continue
        hits, missed = _match(report, path[[0, -1]])
        found += bool(hits)
        false += missed
        for error, names in hits[:1]:
            errors.append(error)
            fired.update(names)
    return {
        "magnitude": magnitude,
        "tracked": tracked,
        "frames": frames,
        "found": found,
        "false": false,
        "fired": dict(fired),
        "endpoint_error": float(np.median(errors)) if errors else float("nan"),
    }


def _detect(pixels: Image, rotation: FloatArray, settings: StreakSettings) -> ObjectReport | None:
    """Return the report by the rotation that the likelihood finds, the true one deciding its sign."""
    likelihood = LikelihoodSettings(saturation=settings.saturation, gain=settings.gain, line_time=0.0)
    motion = estimate_motion(pixels, _CAMERA.pinhole, _EXPOSURE, likelihood, rotation, 0.0)
    if motion.rate is None:
        return None
    turn = motion.rate * _EXPOSURE
    return detect(pixels, _CAMERA.pinhole, turn, _EXPOSURE, settings, ObjectSettings())


def _match(report: ObjectReport, truth: FloatArray) -> tuple[list[tuple[float, tuple[str, ...]]], int]:
    """Return error and indicators of the objects within 4 px of the truth, and how many are not."""
    errors = [
        min(np.abs(one.endpoints - truth).max(), np.abs(one.endpoints[::-1] - truth).max())
        for one in report.objects
    ]
    hits = [
        (float(error), one.fired) for error, one in zip(errors, report.objects, strict=True) if error < 4.0
    ]
    return hits, len(errors) - len(hits)


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    """Print both parts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=40, help="without an RSO (default %(default)s)")
    parser.add_argument("--with-frames", type=int, default=10, help="per magnitude (default %(default)s)")
    parser.add_argument("--magnitudes", type=float, nargs="*", default=[3.0, 4.0, 5.0, 6.0])
    parser.add_argument("--seed", type=int, default=_SEED, help="default %(default)s")
    parser.add_argument("--detector", choices=DETECTOR_NAMES, default="harris")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the tables")
    options = parser.parse_args()
    settings = dataclasses.replace(StreakSettings.of(options.detector), saturation=_CAMERA.full_well)
    clean = without(options.frames, options.seed, settings)
    if not options.json:
        _say(f"{options.detector}, {options.frames} frames without an RSO, seed {options.seed}")
        _say(f"false {clean['false']}, no rotation {clean['no_rotation']}")
        _say(f"verdicts {clean['verdicts']}, crowded {clean['crowded']}")
        _say("deviation of single stars at " + ", ".join(f"{p} %" for p in _PERCENTILES))
        for name in INDICATORS:
            _say(f"{name:>13} " + " ".join(f"{value:6.2f}" for value in clean["spread"][name]))
        _say("\n  kind     mag   found  false  ends px  fired")
    rows = []
    for tracked in (False, True):
        for magnitude in options.magnitudes:
            row = with_one(options.with_frames, options.seed + 1, settings, magnitude, tracked)
            rows.append(row)
            if not options.json:
                _say(
                    f"{'tracked' if tracked else 'moving':8} {magnitude:4.1f}"
                    f"  {row['found']:3d}/{row['frames']:<3d}"
                    f" {row['false']:4d}   {row['endpoint_error']:6.2f}   {row['fired']}"
                )
    if options.json:
        _say(json.dumps({"seed": options.seed, "detector": options.detector, "clean": clean, "with": rows}))


if __name__ == "__main__":
    main()
