"""Claimed errors of pictures whose lens nobody gave: `python -m tests.studies.bench untold_lens`.

Drawn pictures: stars of the real sky through a lens with its axis off the middle and with distortion, of
which the star tracker is given the field to 5 %; places are off by 0.1 px. The truth is the attitude of the
middle of the picture. Photographs: those of a folder with a `truth.json`, whose values other solvers made
without a lens: some of the difference is theirs. `NEES`: squared error over its covariance, per degree of
freedom; 1 is honest. `median ratio`: error across the boresight over its claimed sigma, 1.18 where honest.
The floor that photographs ask for makes drawn pictures, which have no air and no colours, claim too much
error: `fit alone` is without it.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from knightcube.astro import catalogue
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_matrix,
    multiply,
    normalise,
    to_rotation_vector,
)
from knightcube.vision.camera.images import read_image
from knightcube.vision.camera.lens import Lens
from knightcube.vision.frame_job import solve_frame
from knightcube.vision.startracker.detection import FrameKind
from knightcube.vision.startracker.solve import FrameSolution, SolveSettings, lens_floor, solve_places
from tests.knightcube.vision.startracker.frames import EPOCH, sky
from tests.studies.bench.sky import FIELD_SHARE, PHOTOGRAPHS, angle_arcsec, believed, centre_of

_SEED = 14_005
_PIXELS = 1024
_MOST_STARS = 40
_NOISE_PX = 0.1
_FIELDS_DEG = 8.0, 30.0
# px of 1024, and part of the radius at the corner: standard deviations of the lenses drawn.
LENSES = {"perfect": (0.0, 0.0), "usual": (10.0, 0.005), "poor": (25.0, 0.02)}


def drawn_lens(kind: str, rng: np.random.Generator) -> Lens:
    """Return a random lens of a kind of LENSES."""
    off, bent = LENSES[kind]
    field = math.radians(rng.uniform(*_FIELDS_DEG))
    focal_length = 0.5 * _PIXELS / math.tan(0.5 * field)
    corner = math.tan(0.5 * field) * math.sqrt(2.0)
    centre = 0.5 * (_PIXELS - 1) + off * rng.standard_normal(2)
    k1 = bent * float(np.clip(rng.standard_normal(), -2.5, 2.5)) / corner**2
    return Lens(_PIXELS, _PIXELS, focal_length, (float(centre[0]), float(centre[1])), k1)


def of_the_middle(lens: Lens, attitude: FloatArray) -> FloatArray:
    """Return the attitude (4,) of a camera whose axis goes through the picture's middle."""
    middle = np.array([[0.5 * (lens.columns - 1), 0.5 * (lens.rows - 1)]])
    z = lens.unit_vectors(middle)[0]
    right = (
        lens.unit_vectors(middle + np.array([1.0, 0.0]))[0]
        - lens.unit_vectors(middle - np.array([1.0, 0.0]))[0]
    )
    down = (
        lens.unit_vectors(middle + np.array([0.0, 1.0]))[0]
        - lens.unit_vectors(middle - np.array([0.0, 1.0]))[0]
    )
    # Half of what is not square goes to either side, as a fit of both does.
    one, other = (side - z * (side @ z) for side in (right, down))
    x = one / np.linalg.norm(one) + np.cross(other / np.linalg.norm(other), z)
    x /= np.linalg.norm(x)
    return multiply(from_matrix(np.stack([x, np.cross(z, x), z])), attitude)


def drawn(kind: str, number: int) -> tuple[FrameSolution, FloatArray]:
    """Return the solution of a drawn picture, and the true attitude (4,) of its middle."""
    rng = np.random.default_rng([_SEED, number, *kind.encode()])
    lens, attitude = drawn_lens(kind, rng), normalise(rng.standard_normal(4))
    stars = catalogue.load()
    places = lens.project(stars.directions_at(EPOCH) @ attitude_matrix(attitude).T)
    inside = np.flatnonzero(lens.contains(places))
    chosen = inside[np.argsort(stars.magnitude[inside], kind="stable")][:_MOST_STARS]
    points = places[chosen] + _NOISE_PX * rng.standard_normal((len(chosen), 2))
    covariance = np.broadcast_to(_NOISE_PX**2 * np.eye(2), (len(chosen), 2, 2)).copy()
    field = 2.0 * math.degrees(math.atan(0.5 * _PIXELS / lens.focal_length))
    flux = 10.0 ** (-0.4 * stars.magnitude[chosen])
    shown = np.zeros((_PIXELS, _PIXELS), dtype=np.uint8)
    camera, scale = believed(shown, field, field * (1.0 - FIELD_SHARE), field * (1.0 + FIELD_SHARE))
    found = solve_places(
        points, covariance, FrameKind.POINTS, camera, scale, sky(), SolveSettings(), None, flux
    )
    return found, of_the_middle(lens, attitude)


def row_of(kind: str, count: int) -> dict[str, Any]:
    """Return the figures of `count` pictures through lenses of a kind."""
    nees, alone, ratio, pixels = [], [], [], []
    for number in range(count):
        found, truth = drawn(kind, number)
        if found.fix is None:
            continue
        error = to_rotation_vector(multiply(found.fix.quaternion, conjugate(truth)))
        nees.append(float(error @ np.linalg.solve(found.fix.covariance, error)) / 3.0)
        unfloored = found.fix.covariance - lens_floor(found.camera)
        alone.append(float(error @ np.linalg.solve(unfloored, error)) / 3.0)
        sigma = math.sqrt(0.5 * float(np.trace(found.fix.covariance[:2, :2])))
        ratio.append(float(np.linalg.norm(error[:2])) / sigma)
        pixels.append(float(np.linalg.norm(error[:2])) * found.camera.focal_length)
    return {
        "pictures": kind,
        "tried": count,
        "solved": len(nees),
        "nees": float(np.mean(nees)),
        "nees_of_the_fit_alone": float(np.mean(alone)),
        "median_ratio": float(np.median(ratio)),
        "beyond_5_sigma": int(np.sum(np.array(ratio) > 5.0)),
        "rms_px": float(np.sqrt(np.mean(np.square(pixels)))),
    }


def row_of_photographs(folder: Path) -> dict[str, Any]:
    """Return the figures of the photographs of a folder; without NEES, for not all have a roll."""
    truths = json.loads((folder / "truth.json").read_text())
    ratio, pixels = [], []
    for name, truth in truths.items():
        image, field = read_image(folder / name), truth["fov"]
        camera, scale = believed(image, field, field * (1.0 - FIELD_SHARE), field * (1.0 + FIELD_SHARE))
        found = solve_frame(image, camera, scale, 1.0, sky(), SolveSettings())
        if found.fix is None:
            continue
        off = math.radians(angle_arcsec(attitude_matrix(found.fix.quaternion)[2], centre_of(truth)) / 3600.0)
        ratio.append(off / math.sqrt(0.5 * float(np.trace(found.fix.covariance[:2, :2]))))
        pixels.append(off * found.camera.focal_length)
    return {
        "pictures": "photographs",
        "tried": len(truths),
        "solved": len(ratio),
        "nees": math.nan,
        "nees_of_the_fit_alone": math.nan,
        "median_ratio": float(np.median(ratio)),
        "beyond_5_sigma": int(np.sum(np.array(ratio) > 5.0)),
        "rms_px": float(np.sqrt(np.mean(np.square(pixels)))),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; exit status 0."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.bench untold_lens", description=__doc__)
    parser.add_argument("--pictures", type=int, default=100, help="of each lens (default %(default)s)")
    parser.add_argument("--photographs", type=Path, default=PHOTOGRAPHS, metavar="FOLDER")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    rows = [row_of(kind, options.pictures) for kind in LENSES]
    if (options.photographs / "truth.json").is_file():
        rows.append(row_of_photographs(options.photographs))
    if options.json:
        shown = [
            {k: v for k, v in row.items() if not (isinstance(v, float) and math.isnan(v))} for row in rows
        ]
        sys.stdout.write(json.dumps({"rows": shown}) + "\n")
        return 0
    sys.stdout.write(
        f"{'pictures':12s} {'solved':>10s} {'NEES':>7s} {'fit alone':>10s} {'median ratio':>13s}"
        f" {'beyond 5':>9s} {'rms px':>7s}\n"
    )
    for row in rows:
        solved = f"{row['solved']} of {row['tried']}"
        sys.stdout.write(
            f"{row['pictures']:12s} {solved:>10s} {row['nees']:7.2f} {row['nees_of_the_fit_alone']:10.2f}"
            f" {row['median_ratio']:13.2f}"
            f" {row['beyond_5_sigma']:9d} {row['rms_px']:7.3f}\n"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
