"""Commands that prepare a camera: `knightcube calibrate`, `index` (sky index) and `samples` (pictures)."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from flight.app.cli import PROGRAM, complain
from flight.app.cli.run import seed_number
from flight.schema import reader as configuration
from flight.schema.devices import camera_model
from ground.commands.options import add_field, check_new, check_size, positive, print_result, write_new
from knightcube.astro.arrays import Image
from knightcube.errors import UsageError, reason_of
from knightcube.vision.camera.images import read_image
from knightcube.vision.camera.lens import SHAPE_TERMS
from knightcube.vision.lens_calibration import (
    MIN_STARS,
    CalibrationImage,
    DeterminedLens,
    OmittedTerm,
    calibrate_lens,
)
from knightcube.vision.lens_knowledge import PARAMETERS, parameters_of
from knightcube.vision.star_tracker import field_of_view
from knightcube.vision.startracker.index import save
from knightcube.vision.startracker.index.build import DEFAULT, IndexSettings, build


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube calibrate` to the parser."""
    parser.description = (
        "Calibrate a camera from pictures of the night sky: focal length, optical axis and radial "
        "distortion, with their errors, and aspect, shear and tangential distortion if the stars show them. "
        "All pictures must be of one camera at one focus; pictures that do not fit are excluded and named. "
        "Ten pictures with stars in the corners are worth more than a hundred without. A term that the stars "
        "do not determine is left out of the lens and named. The camera file states the accuracy of the lens "
        f"(`accuracy`); it needs at least {MIN_STARS} stars."
    )
    parser.epilog = "example: knightcube calibrate night*.tiff --fov 11.4 --out camera.yaml"
    text = "pictures of the night sky: PNG, TIFF, JPEG, BMP, PGM or FITS"
    parser.add_argument("images", type=Path, nargs="+", metavar="IMAGE", help=text)
    parser.add_argument(
        "--fov",
        type=positive,
        metavar="DEG",
        help="rough field of view across the columns, deg (default: search)",
    )
    text = "file to which the camera is written, for --camera of other commands"
    parser.add_argument("--out", type=Path, metavar="YAML", help=text)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> int:
    """Calibrate the camera, and print and write the result. The exit status is 1 if the calibration fails."""
    check_new(options.out)
    frames = _read(options.images)

    def show(round_number: int, number: int) -> None:
        if sys.stderr.isatty():
            end = "\n" if number == len(frames) else ""
            sys.stderr.write(f"\rround {round_number}: picture {number} of {len(frames)} {end}")
            sys.stderr.flush()

    found = calibrate_lens([pixels for _, pixels in frames], fov_deg=options.fov, progress=show)
    pictures = list(zip(options.images, found.images, strict=True))
    lens = found.determined
    if lens is None:
        reasons = [f"{path}: {picture.reason}" for path, picture in pictures]
        if options.fov is not None:
            reasons.append(f"--fov {options.fov:g}: without --fov, fields from 4 to 60 deg are searched")
        return complain("\n".join(reasons), 1)
    mirrored = "mirrored:     yes; the lens is that of the pictures as they are\n" if found.mirrored else ""
    facts = _facts(lens, pictures) | {"mirrored": found.mirrored}
    print_result(options, facts, _text(lens, pictures) + mirrored)
    if options.out is None:
        return 0
    problem, stars = "", lens.calibration.stars
    if stars < MIN_STARS:
        problem = f"{stars} stars are too few for a camera, {MIN_STARS} are needed: give more pictures"
    elif "focal_length" in lens.calibration.undetermined:
        problem = "the stars do not determine the focal length: give more pictures"
    if problem:
        sys.stderr.write(f"{options.out}: not written: {problem}\n")
        return 1
    write_new(options.out, _camera_section(lens))
    if not options.json:
        sys.stdout.write(f"\nwritten: {options.out}, for --camera of the commands `solve` and `rate`\n")
    return 0


def _read(paths: Sequence[Path]) -> list[tuple[Path, Image]]:
    frames = [(path, read_image(path, upright=False)) for path in paths]
    first = frames[0]
    for path, pixels in frames:
        check_size(path, pixels)
        if pixels.shape != first[1].shape:
            sizes = [f"{image.shape[1]} x {image.shape[0]}" for image in (pixels, first[1])]
            raise UsageError(
                f"{path}: {sizes[0]} pixels, but {first[0]} has {sizes[1]}: give pictures of one camera"
            )
    return frames


def _facts(lens: DeterminedLens, pictures: Sequence[tuple[Path, CalibrationImage]]) -> dict[str, Any]:
    found = lens.calibration
    return {
        **found.lens.to_mapping(),
        "sigma": found.sigma,
        "undetermined": list(found.undetermined),
        "terms_left_out": {name: asdict(term) for name, term in lens.omitted.items()},
        "accuracy": lens.accuracy,
        "rms_px_before": found.rms_before,
        "rms_px_after": found.rms_after,
        "chi_square": found.chi_square,
        "degrees_of_freedom": found.degrees,
        "rejected_matches": found.rejected_count,
        "pictures": [
            {
                "path": str(path),
                "status": picture.solution.status.value,
                "left_out": picture.reason or None,
                "stars": len(picture.solution.matched),
            }
            for path, picture in pictures
        ],
    }


def _text(lens: DeterminedLens, pictures: Sequence[tuple[Path, CalibrationImage]]) -> str:
    found = lens.calibration
    used = [picture for _, picture in pictures if not picture.reason]
    stars = sum(len(picture.solution.matched) for picture in used)
    lines = [
        f"{path}: {'excluded' if picture.excluded else 'not solved'}: {picture.reason}"
        for path, picture in pictures
        if picture.reason
    ]
    lines.append(f"pictures:     {len(used)} of {len(pictures)} used, {stars} stars")
    for name, value in zip(PARAMETERS, parameters_of(found.lens), strict=True):
        digits = 2 if name in PARAMETERS[:3] else 5
        if name in found.sigma and name.partition("_")[0] not in lens.omitted:
            lines.append(f"{name + ':':13s} {value:.{digits}f} +- {found.sigma[name]:.{digits}f}")
    lines += [_omitted(name, term) for name, term in lens.omitted.items()]
    accuracy = [
        f"{label} {lens.accuracy[key] * scale:.{digits}f} {unit}"
        if key in lens.accuracy
        else f"{label} not determined"
        for key, label, scale, digits, unit in (
            ("focal_length", "focal length", 1e2, 4, "%"),
            ("centre", "centre", 1.0, 2, "px"),
            ("distortion", "distortion at a corner", 1e2, 4, "%"),
        )
    ]
    before, after = found.rms_before, found.rms_after
    return "\n".join(
        [
            *lines,
            f"field:        {_field_of_view(lens):.4f} deg across the columns, without the distortion",
            f"accuracy:     {', '.join(accuracy)}",
            f"residual:     {before:.3f} px rms with the assumed lens, {after:.3f} with the calibrated one",
            f"chi-square:   {found.chi_square:.0f} for {found.degrees} degrees of freedom,"
            f" {found.rejected_count} matches rejected\n",
        ]
    )


def _omitted(name: str, term: OmittedTerm) -> str:
    digits = 2 if name == "centre" else 5
    fitted = ", ".join(
        f"{value:.{digits}f} +- {sigma:.{digits}f}"
        for value, sigma in zip(term.values, term.sigmas, strict=True)
    )
    assumed = "the image centre" if name == "centre" else "zero"
    return f"{name + ':':13s} left out, not determined by the stars ({fitted}): {assumed} is assumed"


def _field_of_view(lens: DeterminedLens) -> float:
    """Return the horizontal field of view (deg) of the lens, ignoring its distortion."""
    found = lens.calibration.lens
    return 2.0 * math.degrees(math.atan(0.5 * found.columns / found.focal_length))


def _camera_section(terms: DeterminedLens) -> str:
    """Return the text of the section `camera` for a configuration or for a file of the option `--camera`."""
    lens, omitted = terms.calibration.lens, terms.omitted
    assumed = "      # the image centre: the stars do not determine it" if "centre" in omitted else ""
    lines = [
        "# Made by `knightcube calibrate`.",
        "camera:",
        f"  columns: {lens.columns}",
        f"  rows: {lens.rows}",
        f"  field_of_view_deg: {_field_of_view(terms):.6f}",
        "  lens:                       # px; pixel (x, y) on the optical axis; k1, k2 in the tangent plane",
        f"    focal_length: {lens.focal_length:.4f}",
        f"    centre: [{lens.centre[0]:.4f}, {lens.centre[1]:.4f}]{assumed}",
        *(f"    {name}: {getattr(lens, name):.8f}" for name in ("k1", "k2") if name not in omitted),
        *(f"    {name}: {value:.8f}" for name in SHAPE_TERMS if (value := getattr(lens, name)) != 0.0),
        "  accuracy:                   # standard deviations: relative, and px for the centre",
        *(f"    {name}: {value:.3g}" for name, value in terms.accuracy.items()),
    ]
    if omitted:
        lines.append(f"  # The stars do not determine {', '.join(omitted)}: left out.")
    return "\n".join(lines) + "\n"


def configure_samples(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube samples` to the parser."""
    parser.description = (
        "Render sample pictures: a field of stars, streaks with a satellite among them, the Earth's limb, "
        "and a few night skies for a calibration. The file truth.json has the true values of each; the "
        "commands to try are printed."
    )
    parser.epilog = "example: knightcube samples --out samples"
    parser.add_argument(
        "--out", type=Path, default=Path("samples"), metavar="DIR", help="folder (default samples)"
    )
    parser.add_argument(
        "--seed", type=seed_number, default=1, metavar="N", help="seed of the noise (default 1)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run_samples)


def run_samples(options: argparse.Namespace) -> int:
    """Render and write the sample images, and print example commands."""
    from ground.samples import FIELD_DEG, write_samples, write_truth  # noqa: PLC0415 - slow to load

    out: Path = options.out
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise UsageError(f"{out}: is not empty, and its files could be replaced: give another --out")
    except OSError as error:
        raise UsageError(f"{out}: cannot be made: {reason_of(error)}") from error

    def progress(name: str) -> None:
        if sys.stderr.isatty():
            sys.stderr.write(f"\r\x1b[Krendering {name} ...")
            sys.stderr.flush()

    written = write_samples(out, options.seed, progress)
    if sys.stderr.isatty():
        sys.stderr.write("\r\x1b[K")
    write_truth(out / "truth.json", {path.name: sample.truth for path, sample in written})
    nights = [str(path) for path, sample in written if sample.name.startswith("night")]
    lines = [sample.words.format(path) for path, sample in written if not sample.name.startswith("night")]
    lines.append(f"calibrate {' '.join(nights)} --fov {FIELD_DEG:g} --out {out / 'camera.yaml'}")
    facts: dict[str, Any] = {
        "files": [str(path) for path, _ in written],
        "truth": str(out / "truth.json"),
        "try": lines,
    }
    listed = "".join(f"{path}\n" for path in [*facts["files"], facts["truth"]])
    print_result(options, facts, listed + "\ntry:\n" + "".join(f"  {PROGRAM} {line}\n" for line in lines))
    return 0


def configure_index(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube index` to the parser."""
    parser.description = (
        "Make the sky index of one camera: triangles that fit into its field of view, of the stars that it "
        "detects. Pairs of stars that its pixels do not resolve are merged. The file is named by "
        "camera.star_tracker.index of a configuration, or by --index of `knightcube solve`."
    )
    parser.epilog = "example: knightcube index --camera flight.yaml --faintest 6.5 --out mission.index"
    add_field(parser, required=True)
    text = "magnitude of the faintest star that the camera detects (default %(default)s)"
    parser.add_argument("--faintest", type=float, default=DEFAULT.faintest, metavar="V", help=text)
    parser.add_argument(
        "--epoch",
        type=float,
        default=DEFAULT.epoch,
        metavar="YEAR",
        help="epoch, as Julian year (default %(default)s)",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="file of the index")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(command=run_index)


def run_index(options: argparse.Namespace) -> int:
    """Build and write the sky index."""
    if not all(math.isfinite(value) for value in (options.faintest, options.epoch)):
        raise UsageError("--faintest and --epoch: give finite numbers")
    if options.camera is None:
        settings = IndexSettings.of_field(math.radians(options.fov))
    else:
        camera = camera_model(configuration.load_camera(options.camera))
        settings = IndexSettings.of_field(field_of_view(camera), 1.0 / camera.focal_length)
    check_new(options.out)
    sky = build(replace(settings, faintest=options.faintest, epoch=options.epoch))
    try:
        save(sky, options.out)
    except OSError as error:
        raise UsageError(f"--out {options.out}: cannot be written: {reason_of(error)}") from error
    stars, triangles = len(sky.stars), len(sky.triangles)
    facts = {"index": str(options.out), "stars": stars, "triangles": triangles}
    print_result(options, facts, f"{options.out}: {stars} stars, {triangles} triangles\n")
    return 0
