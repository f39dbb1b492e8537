"""The star tracker from pixels: real photographs, and streaks: `python -m tests.bench sky`.

Photographs: those of a folder with a `truth.json` (right ascension and declination of the image's centre and
the horizontal field, degrees), with the field known to 5 % and, where it is of 10 to 30 deg, unknown.
Streaked frames: the simulator's camera of 12 deg and 0.1 s, with the field known to 0.1 deg;
the bound is Cramer-Rao's, of the rate's magnitude. Times are of one core's CPU.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from flight.arrays import FloatArray, Image
from flight.images import read_image
from flight.pinhole import Pinhole
from flight.quaternion import conjugate, multiply, to_rotation_vector
from flight.startracker.pointing import Pointing
from flight.startracker.solution import FrameSolution
from flight.startracker.solve import AttitudePrior, RatePrior, SolveSettings, solve_frame
from flight.vision.two_attitudes import attitude_error
from tests.startracker.frames import NARROW, sky, sky_frame

_SEED = 16_018
_PHOTOGRAPHS = Path(__file__).parents[3] / "shared" / "data" / "sky"
_STREAKS_PX = (0.0, 10.0, 20.0, 40.0, 80.0)
_EXPOSURE = 0.1
# rad, of the prior for tracking: 1.5 px.
_PRIOR_SIGMA = 3e-4
_FIELD_SHARE = 0.05
_RIGHT_ARCSEC = 60.0
ARCSECONDS = math.degrees(1.0) * 3600.0


@dataclass(frozen=True)
class Photograph:
    """What became of one photograph; arcsec and ms are NaN where it was not solved."""

    name: str
    known: bool
    solved: bool
    arcsec: float
    stars: int
    ms: float


def believed(pixels: Image, fov_deg: float, low: float, high: float) -> tuple[Pinhole, tuple[float, float]]:
    """Return a camera of `fov_deg` across and the range of its scale that fields `low` to `high` deg make."""
    middle = math.tan(0.5 * math.radians(fov_deg))
    rows, columns = pixels.shape
    scale = tuple(math.tan(0.5 * math.radians(angle)) / middle for angle in (low, high))
    return Pinhole(columns, rows, 0.5 * columns / middle), (scale[0], scale[1])


def photograph(folder: Path, name: str, truth: dict[str, float], known: bool) -> Photograph:
    """Return what the star tracker makes of one photograph."""
    pixels = read_image(folder / name)
    fov = truth["fov"]
    low, high = (fov * (1.0 - _FIELD_SHARE), fov * (1.0 + _FIELD_SHARE)) if known else (10.0, 30.0)
    camera, scale = believed(pixels, fov if known else 17.0, low, high)
    begin = time.process_time()
    found = solve_frame(pixels, camera, scale, 1.0, sky(), SolveSettings())
    ms = 1e3 * (time.process_time() - begin)
    if found.fix is None:
        return Photograph(name, known, False, math.nan, 0, ms)
    pointing = Pointing.of(found.fix.quaternion)
    place = direction(pointing.right_ascension, pointing.declination)
    away = direction(math.radians(truth["ra"]), math.radians(truth["dec"]))
    angle = math.atan2(float(np.linalg.norm(np.cross(place, away))), float(place @ away))
    return Photograph(name, known, True, ARCSECONDS * angle, len(found.matched), ms)


def direction(right_ascension: float, declination: float) -> FloatArray:
    """Return the unit vector (3,) of a place of the sky."""
    cosine = math.cos(declination)
    return np.array(
        [cosine * math.cos(right_ascension), cosine * math.sin(right_ascension), math.sin(declination)]
    )


@dataclass(frozen=True)
class StreakRow:
    """Frames of one length of streak: how many solved right, errors across the boresight, rate, times."""

    length_px: float
    frames: int
    solved: int
    wrong: int
    median_arcsec: float
    worst_arcsec: float
    nees: float
    rate_rms_percent: float
    rate_worst_percent: float
    rate_bound_percent: float
    median_ms: float
    p95_ms: float
    tracking_ms: float


def streak_row(length: float, frames: int) -> StreakRow:
    """Return the figures of `frames` random frames with streaks of `length` px."""
    errors, nees, rates, bounds, times, tracked = [], [], [], [], [], []
    wrong = 0
    for frame in range(frames):
        scene = sky_frame(np.random.default_rng([_SEED, frame, round(length)]), length, _EXPOSURE)
        camera, scale = believed(scene.pixels, 12.0, 11.9, 12.1)
        rate_prior = RatePrior(scene.rate, 1e-6)
        prior = AttitudePrior(scene.attitude, _PRIOR_SIGMA)
        begin = time.process_time()
        found = solve_frame(
            scene.pixels, camera, scale, scene.exposure, sky(), SolveSettings(), None, rate_prior
        )
        middle = time.process_time()
        solve_frame(
            scene.pixels,
            NARROW.pinhole,
            (1.0, 1.0),
            scene.exposure,
            sky(),
            SolveSettings(),
            prior,
            rate_prior,
        )
        times.append(1e3 * (middle - begin))
        tracked.append(1e3 * (time.process_time() - middle))
        if found.fix is None:
            continue
        _, across = attitude_error(found.fix.quaternion, scene.attitude)
        wrong += across * ARCSECONDS > _RIGHT_ARCSEC
        errors.append(across * ARCSECONDS)
        nees.append(_nees(found, scene.attitude))
        if length and found.motion is not None and found.motion.rate is not None:
            speed = float(np.linalg.norm(scene.rate))
            rates.append(100.0 * (float(np.linalg.norm(found.motion.rate)) / speed - 1.0))
            bounds.append(100.0 * scene.rate_bound() / speed)
    return StreakRow(
        length,
        frames,
        len(errors) - wrong,
        wrong,
        float(np.median(errors)),
        float(np.max(errors)),
        float(np.mean(nees)),
        float(np.sqrt(np.mean(np.square(rates)))) if rates else math.nan,
        float(np.max(np.abs(rates))) if rates else math.nan,
        float(np.sqrt(np.mean(np.square(bounds)))) if bounds else math.nan,
        float(np.median(times)),
        float(np.percentile(times, 95.0)),
        float(np.median(tracked)),
    )


def _nees(found: FrameSolution, truth: FloatArray) -> float:
    """Return the squared error of the attitude over its covariance, per degree of freedom."""
    assert found.fix is not None
    error = to_rotation_vector(multiply(found.fix.quaternion, conjugate(truth)))
    return float(error @ np.linalg.solve(found.fix.covariance, error)) / 3.0


def photographs(folder: Path) -> list[Photograph]:
    """Return the results of every photograph of a folder that has a truth."""
    truth = json.loads((folder / "truth.json").read_text())
    done = []
    for name, values in truth.items():
        done.append(photograph(folder, name, values, known=True))
        if 10.0 <= values["fov"] <= 30.0:
            done.append(photograph(folder, name, values, known=False))
    return done


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; exit status 0."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench sky", description=__doc__)
    parser.add_argument("--frames", type=int, default=20, help="of each length (default %(default)s)")
    parser.add_argument("--photographs", type=Path, default=_PHOTOGRAPHS, metavar="FOLDER")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    pictures: list[Photograph] = []
    if (options.photographs / "truth.json").is_file():
        pictures = photographs(options.photographs)
    else:
        sys.stderr.write(f"{options.photographs}: no truth.json: give --photographs; going on without\n")
    rows = [streak_row(length, options.frames) for length in _STREAKS_PX]
    if options.json:
        told = {"photographs": [asdict(one) for one in pictures], "streaks": [asdict(row) for row in rows]}
        sys.stdout.write(json.dumps(told) + "\n")
    else:
        sys.stdout.write(_table(pictures, rows))
    return 0


def _table(pictures: list[Photograph], rows: list[StreakRow]) -> str:
    lines = [f"{'photograph':26s} {'field':8s} {'off':>8s} {'stars':>6s} {'ms':>6s}"]
    for one in pictures:
        off = f'{one.arcsec:7.1f}"' if one.solved else " refused"
        known = "known" if one.known else "unknown"
        lines.append(f"{one.name:26s} {known:8s} {off} {one.stars:6d} {one.ms:6.1f}")
    solved = [one for one in pictures if one.solved]
    right = sum(one.arcsec <= _RIGHT_ARCSEC for one in solved)
    lines.append(f'right to {_RIGHT_ARCSEC:.0f}": {right} of {len(pictures)}, wrong {len(solved) - right}\n')
    lines.append(
        f"{'streak px':>9s} {'right':>9s} {'wrong':>6s} {'median':>8s} {'worst':>8s} {'NEES':>6s}"
        f" {'rate rms %':>11s} {'worst %':>8s} {'bound %':>8s} {'ms':>6s} {'p95':>6s} {'track':>6s}"
    )
    for row in rows:
        lines.append(
            f'{row.length_px:9.0f} {row.solved:4d}/{row.frames:<4d} {row.wrong:6d} {row.median_arcsec:7.2f}"'
            f' {row.worst_arcsec:7.2f}" {row.nees:6.2f} {row.rate_rms_percent:11.3f}'
            f" {row.rate_worst_percent:8.3f} {row.rate_bound_percent:8.3f} {row.median_ms:6.1f}"
            f" {row.p95_ms:6.1f} {row.tracking_ms:6.1f}"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
