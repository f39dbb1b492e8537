"""`flight calibrate`: the lens of a camera from pictures of the night sky."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flight.gnc.camera.images import read_image
from flight.gnc.camera.lens import CameraModel, Lens
from flight.gnc.errors import UsageError
from flight.gnc.math.arrays import Image
from flight.gnc.vision.frame_job import solve_frame
from flight.gnc.vision.startracker.index.build import default_index
from flight.gnc.vision.startracker.index.sky_index import SkyIndex
from flight.gnc.vision.startracker.solution import FrameSolution
from flight.gnc.vision.startracker.solve import SolveSettings
from ground.calibration.calibration import PARAMETERS, Calibration, calibrate
from ground.calibration.lens_fit import MatchedFrame
from ground.commands.options import check_size, positive, write_new
from ground.commands.solve import lens_of_field

_ROUNDS = 3
_LEAST_SIGMA_PX = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A picture and its solution."""

    path: Path
    pixels: Image
    solution: FrameSolution


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Calibrate a camera from pictures of the night sky: focal length, optical axis, radial distortion, "
        "with their errors. All pictures must be of one camera at one focus; ten that put stars into the "
        "corners are worth more than a hundred that do not. Undetermined parameters are named."
    )
    parser.epilog = "example: python -m flight calibrate night*.tiff --fov 11.4 --out camera.yaml"
    parser.add_argument("images", type=Path, nargs="+", metavar="IMAGE")
    parser.add_argument("--fov", type=positive, metavar="DEG", help="rough field of view across the columns")
    parser.add_argument("--out", type=Path, metavar="YAML", help="write the camera for --camera here")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Solve, fit, print, write; exit status 1 when no picture could be solved."""
    if options.out is not None and options.out.exists():
        raise UsageError(f"{options.out}: exists already: name another file")
    frames = _read(options.images)
    shape = frames[0][1].shape
    camera, scale = lens_of_field(options.fov, None, shape)
    sky = default_index()
    model: CameraModel = camera
    pictures: list[Picture] = []
    found: Calibration | None = None
    for round_number in range(_ROUNDS):
        # The better the lens, the more stars in the corners match.
        pictures = _solve(frames, model, scale, sky, round_number)
        solved = [picture for picture in pictures if picture.solution.fix is not None]
        if not solved:
            break
        begun = solved[0].solution.camera if found is None else model
        found = calibrate([_matches(picture.solution, sky) for picture in solved], begun)
        model, scale = found.lens, (0.999, 1.001)
    if found is None:
        for picture in pictures:
            sys.stderr.write(f"{picture.path}: {picture.solution.reason}\n")
        return 1
    if options.out is not None:
        _write(options.out, found.lens)
    facts = _facts(found, pictures)
    sys.stdout.write(json.dumps(facts, allow_nan=False) + "\n" if options.json else _text(found, pictures))
    if options.out is not None and not options.json:
        sys.stdout.write(f"\nwritten: {options.out}, for --camera of `flight solve` and `flight rate`\n")
    return 0


def _read(paths: Sequence[Path]) -> list[tuple[Path, Image]]:
    frames = [(path, read_image(path)) for path in paths]
    first = frames[0]
    for path, pixels in frames:
        check_size(path, pixels)
        if pixels.shape != first[1].shape:
            sizes = [f"{image.shape[1]} x {image.shape[0]}" for image in (pixels, first[1])]
            raise UsageError(f"{path}: {sizes[0]} pixels, but {first[0]} has {sizes[1]}: give one camera's")
    return frames


def _solve(
    frames: Sequence[tuple[Path, Image]],
    camera: CameraModel,
    scale: tuple[float, float],
    sky: SkyIndex,
    round_number: int,
) -> list[Picture]:
    pictures = []
    for number, (path, pixels) in enumerate(frames, start=1):
        if sys.stderr.isatty():
            sys.stderr.write(f"\rround {round_number + 1} of {_ROUNDS}: picture {number} of {len(frames)} ")
            sys.stderr.flush()
        pictures.append(Picture(path, pixels, solve_frame(pixels, camera, scale, 1.0, sky, SolveSettings())))
    if sys.stderr.isatty():
        sys.stderr.write("\n")
    return pictures


def _matches(solution: FrameSolution, sky: SkyIndex) -> MatchedFrame:
    matched = solution.matched
    variance = 0.5 * np.trace(solution.covariance[matched], axis1=1, axis2=2) + _LEAST_SIGMA_PX**2
    return MatchedFrame(
        solution.points[matched], np.sqrt(variance), sky.stars.direction[solution.star[matched]]
    )


def _facts(found: Calibration, pictures: Sequence[Picture]) -> dict[str, Any]:
    return {
        **found.lens.to_mapping(),
        "sigma": found.sigma,
        "undetermined": list(found.undetermined),
        "rms_px_before": found.rms_before,
        "rms_px_after": found.rms_after,
        "chi_square": found.chi_square,
        "degrees_of_freedom": found.degrees,
        "rejected_matches": found.rejected_count,
        "pictures": [
            {
                "path": str(picture.path),
                "status": picture.solution.status.value,
                "stars": len(picture.solution.matched),
            }
            for picture in pictures
        ],
    }


def _text(found: Calibration, pictures: Sequence[Picture]) -> str:
    lens, sigma = found.lens, found.sigma
    solved = [picture for picture in pictures if picture.solution.fix is not None]
    stars = sum(len(picture.solution.matched) for picture in solved)
    values = dict(zip(PARAMETERS, (lens.focal_length, *lens.centre, lens.k1, lens.k2), strict=True))
    places = {"k1": 5, "k2": 5}
    lines = [
        f"{picture.path}: not solved: {picture.solution.reason}"
        for picture in pictures
        if picture.solution.fix is None
    ]
    lines.append(f"pictures:     {len(solved)} of {len(pictures)} solved, {stars} stars")
    for name, value in values.items():
        digits = places.get(name, 2)
        note = "   not determined by the stars: the assumed value" if name in found.undetermined else ""
        lines.append(f"{name + ':':13s} {value:.{digits}f} +- {sigma[name]:.{digits}f}{note}")
    fov = 2.0 * math.degrees(math.atan(0.5 * lens.columns / lens.focal_length))
    lines.append(f"field:        {fov:.4f} deg across, without the distortion")
    lines.append(f"residual:     {found.rms_before:.3f} px rms before, {found.rms_after:.3f} px after")
    lines.append(
        f"chi-square:   {found.chi_square:.0f} of {found.degrees} degrees of freedom,"
        f" {found.rejected_count} matches not believed"
    )
    return "\n".join(lines) + "\n"


def _write(path: Path, lens: Lens) -> None:
    """Write the camera as a section that `--camera` reads and a configuration may take over."""
    fov = 2.0 * math.degrees(math.atan(0.5 * lens.columns / lens.focal_length))
    text = (
        "# Made by `python -m flight calibrate`.\n"
        "camera:\n"
        f"  columns: {lens.columns}\n"
        f"  rows: {lens.rows}\n"
        f"  field_of_view_deg: {fov:.6f}\n"
        "  lens:                       # px; the pixel (x, y) on the axis; radial distortion of tangents\n"
        f"    focal_length: {lens.focal_length:.4f}\n"
        f"    centre: [{lens.centre[0]:.4f}, {lens.centre[1]:.4f}]\n"
        f"    k1: {lens.k1:.8f}\n"
        f"    k2: {lens.k2:.8f}\n"
    )
    write_new(path, text)
