"""`flight calibrate`: the lens of a camera from pictures of the night sky."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ground.calibration.calibration import PARAMETERS
from ground.calibration.lens_fit import MatchedFrame
from ground.calibration.selection import LEAST_STARS, Selected, calibrate_one_lens
from ground.calibration.terms import FixedTerms, LeftOut
from ground.commands.options import check_size, positive, write_new
from knightcube.astro.arrays import Image
from knightcube.errors import UsageError
from knightcube.vision.camera.images import read_image
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.frame_job import solve_frame
from knightcube.vision.star_tracker import camera_of_field
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.index.sky_index import SkyIndex
from knightcube.vision.startracker.lost_in_space import IdentificationSettings
from knightcube.vision.startracker.solve import FrameSolution, SolveSettings

_ROUNDS = 3
_LEAST_SIGMA_PX = 0.02
# A lens is not fitted to pictures that show the sky as a mirror does.
_SETTINGS = SolveSettings(identification=IdentificationSettings(mirror=False))


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A picture, its solution, and why it was left out; empty if it was not."""

    path: Path
    pixels: Image
    solution: FrameSolution
    left_out: str = ""

    @property
    def used(self) -> bool:
        """Whether the lens rests on it."""
        return self.solution.fix is not None and not self.left_out

    @property
    def reason(self) -> str:
        """Why the lens does not rest on it."""
        return self.left_out or self.solution.reason


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Calibrate a camera from pictures of the night sky: focal length, optical axis, radial distortion, "
        "with their errors. All pictures must be of one camera at one focus; those that do not fit are left "
        "out and named. Ten that put stars into the corners are worth more than a hundred that do not. "
        "A term that the stars do not fix is left out of the lens and named. The camera file says how well "
        f"the lens is known (`accuracy`); fewer than {LEAST_STARS} stars make none."
    )
    parser.epilog = "example: python -m flight calibrate night*.tiff --fov 11.4 --out camera.yaml"
    parser.add_argument("images", type=Path, nargs="+", metavar="IMAGE")
    parser.add_argument("--fov", type=positive, metavar="DEG", help="rough field of view across the columns")
    parser.add_argument("--out", type=Path, metavar="YAML", help="write the camera for --camera here")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Solve, fit, print, write; exit status 1 when no picture is solved or too few stars for a camera."""
    if options.out is not None and options.out.exists():
        raise UsageError(f"{options.out}: exists already: name another file")
    frames = _read(options.images)
    shape = frames[0][1].shape
    sky = default_index()
    pictures, selected = _calibrated(frames, *camera_of_field(options.fov, None, shape), sky)
    if selected is None:
        for picture in pictures:
            sys.stderr.write(f"{picture.path}: {picture.reason}\n")
        return 1
    facts = _facts(selected.terms, pictures)
    text = json.dumps(facts, allow_nan=False) + "\n" if options.json else _text(selected.terms, pictures)
    sys.stdout.write(text)
    if options.out is None:
        return 0
    if problem := _problem(selected):
        sys.stderr.write(f"{options.out}: not written: {problem}\n")
        return 1
    _write(options.out, selected.terms)
    if not options.json:
        sys.stdout.write(f"\nwritten: {options.out}, for --camera of `flight solve` and `flight rate`\n")
    return 0


def _calibrated(
    frames: Sequence[tuple[Path, Image]], camera: CameraModel, scale: tuple[float, float], sky: SkyIndex
) -> tuple[list[Picture], Selected | None]:
    """Return the pictures, each with its solution or why it was left out, and the lens; None without one."""
    model, selected, pictures = camera, None, []
    for round_number in range(_ROUNDS):
        # The better the lens, the more stars in the corners match.
        pictures = _solve(frames, model, scale, sky, round_number)
        solved = [number for number, picture in enumerate(pictures) if picture.solution.fix is not None]
        if not solved:
            return pictures, None
        solutions = [pictures[number].solution for number in solved]
        focal_lengths = np.array([solution.camera.focal_length for solution in solutions])
        sigmas = focal_lengths * np.array([solution.scale_sigma for solution in solutions])
        middle = int(np.argsort(focal_lengths)[len(solved) // 2])
        begun = solutions[middle].camera if selected is None else model
        selected = calibrate_one_lens(
            [_matches(solution, sky) for solution in solutions], begun, focal_lengths, sigmas
        )
        for number, reason in selected.left_out.items():
            pictures[solved[number]] = replace(pictures[solved[number]], left_out=reason)
        model, scale = selected.calibration.lens, (0.999, 1.001)
    return pictures, selected


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
        pictures.append(Picture(path, pixels, solve_frame(pixels, camera, scale, 1.0, sky, _SETTINGS)))
    if sys.stderr.isatty():
        sys.stderr.write("\n")
    return pictures


def _matches(solution: FrameSolution, sky: SkyIndex) -> MatchedFrame:
    matched = solution.matched
    variance = 0.5 * np.trace(solution.covariance[matched], axis1=1, axis2=2) + _LEAST_SIGMA_PX**2
    return MatchedFrame(
        solution.points[matched], np.sqrt(variance), sky.stars.direction[solution.star[matched]]
    )


def _problem(selected: Selected) -> str:
    """Return why the lens is none to write down, empty where it is one."""
    if selected.stars < LEAST_STARS:
        few = f"{selected.stars} stars are too few for a camera, {LEAST_STARS} are needed"
        return f"{few}: give more pictures"
    if "focal_length" in selected.calibration.undetermined:
        return "the stars do not fix the focal length: give more pictures"
    return ""


def _facts(terms: FixedTerms, pictures: Sequence[Picture]) -> dict[str, Any]:
    found = terms.calibration
    return {
        **found.lens.to_mapping(),
        "sigma": found.sigma,
        "undetermined": list(found.undetermined),
        "terms_left_out": {name: asdict(gone) for name, gone in terms.left_out.items()},
        "accuracy": terms.accuracy,
        "rms_px_before": found.rms_before,
        "rms_px_after": found.rms_after,
        "chi_square": found.chi_square,
        "degrees_of_freedom": found.degrees,
        "rejected_matches": found.rejected_count,
        "pictures": [
            {
                "path": str(picture.path),
                "status": picture.solution.status.value,
                "left_out": picture.reason or None,
                "stars": len(picture.solution.matched),
            }
            for picture in pictures
        ],
    }


def _text(terms: FixedTerms, pictures: Sequence[Picture]) -> str:
    found = terms.calibration
    lens, sigma = found.lens, found.sigma
    solved = [picture for picture in pictures if picture.used]
    stars = sum(len(picture.solution.matched) for picture in solved)
    values = dict(zip(PARAMETERS, (lens.focal_length, *lens.centre, lens.k1, lens.k2), strict=True))
    lines = [
        f"{picture.path}: {'left out' if picture.left_out else 'not solved'}: {picture.reason}"
        for picture in pictures
        if not picture.used
    ]
    lines.append(f"pictures:     {len(solved)} of {len(pictures)} used, {stars} stars")
    for name, value in values.items():
        digits = 5 if name in ("k1", "k2") else 2
        if name.partition("_")[0] not in terms.left_out:
            lines.append(f"{name + ':':13s} {value:.{digits}f} +- {sigma[name]:.{digits}f}")
    lines += [_left_out(name, gone) for name, gone in terms.left_out.items()]
    fov = 2.0 * math.degrees(math.atan(0.5 * lens.columns / lens.focal_length))
    lines.append(f"field:        {fov:.4f} deg across, without the distortion")
    lines.append(f"accuracy:     {_accuracy(terms)}")
    lines.append(
        f"residual:     {found.rms_before:.3f} px rms without these terms, {found.rms_after:.3f} with"
    )
    lines.append(
        f"chi-square:   {found.chi_square:.0f} of {found.degrees} degrees of freedom,"
        f" {found.rejected_count} matches not believed"
    )
    return "\n".join(lines) + "\n"


def _left_out(name: str, gone: LeftOut) -> str:
    digits = 2 if name == "centre" else 5
    fitted = ", ".join(
        f"{value:.{digits}f} +- {sigma:.{digits}f}"
        for value, sigma in zip(gone.values, gone.sigmas, strict=True)
    )
    assumed = "the middle of the picture" if name == "centre" else "none"
    return f"{name + ':':13s} left out, not determined by the stars ({fitted}): {assumed} is assumed"


def _accuracy(terms: FixedTerms) -> str:
    places = {"focal_length": ("focal length", 1e2, 4, " %"), "centre": ("centre", 1.0, 2, " px")}
    places["distortion"] = ("distortion at a corner", 1e2, 4, " %")
    return ", ".join(
        f"{label} {terms.accuracy[key] * scale:.{digits}f}{unit}"
        if key in terms.accuracy
        else f"{label} not known"
        for key, (label, scale, digits, unit) in places.items()
    )


def _write(path: Path, terms: FixedTerms) -> None:
    """Write the camera as a section that `--camera` reads and a configuration may take over."""
    lens, gone = terms.calibration.lens, terms.left_out
    fov = 2.0 * math.degrees(math.atan(0.5 * lens.columns / lens.focal_length))
    assumed = "      # the middle: the stars do not fix it" if "centre" in gone else ""
    lines = [
        "# Made by `python -m flight calibrate`.",
        "camera:",
        f"  columns: {lens.columns}",
        f"  rows: {lens.rows}",
        f"  field_of_view_deg: {fov:.6f}",
        "  lens:                       # px; the pixel (x, y) on the axis; radial distortion of tangents",
        f"    focal_length: {lens.focal_length:.4f}",
        f"    centre: [{lens.centre[0]:.4f}, {lens.centre[1]:.4f}]{assumed}",
        *(f"    {name}: {getattr(lens, name):.8f}" for name in ("k1", "k2") if name not in gone),
        "  accuracy:                   # standard deviations: shares of themselves, px for the centre",
        *(f"    {name}: {value:.3g}" for name, value in terms.accuracy.items()),
    ]
    if gone:
        lines.append(f"  # The stars do not fix {', '.join(gone)}: left out.")
    write_new(path, "\n".join(lines) + "\n")
