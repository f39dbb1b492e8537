"""Command `knightcube horizon`, which finds the direction to nadir from the Earth's limb in a picture."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flight.schema import reader as configuration
from flight.schema.devices import camera_model
from ground.commands.options import (
    add_field,
    add_output,
    add_picture,
    check_camera,
    check_size,
    finite,
    positive,
    print_result,
    read_picture,
)
from ground.pictures import draw_circle, draw_horizon
from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.errors import UsageError
from knightcube.reference import horizon as meller
from knightcube.vision.camera.images import grey_stretch, read_image, write_picture
from knightcube.vision.camera.lens import CameraModel, Pinhole
from knightcube.vision.horizon.nadir import (
    HorizonSolution,
    NadirMeasurement,
    find_nadir,
    nadir_of_uncertain_field,
)
from knightcube.vision.horizon.settings import (
    LEAST_ALTITUDE,
    EdgeSettings,
    HorizonKnowledge,
    HorizonSettings,
    LogarithmicResponse,
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube horizon` to the parser."""
    parser.description = (
        "Find the Earth's limb in a picture and the direction to the Earth's centre in camera axes: z along "
        "the boresight, x to the right, y down. The picture is grey or colour: PNG, TIFF, JPEG, BMP, PGM "
        "or FITS. Without --altitude the altitude is fitted too, within --altitudes. The Earth is modelled "
        "as a sphere; the uncertainty includes the error of this model."
    )
    parser.epilog = "example: knightcube horizon limb.png --fov 67 --altitude 515 --overlay limb_found.png"
    add_picture(parser)
    add_field(parser, required=True)
    text = "standard deviation of --fov; other fields of view within it are tried too (default 0)"
    parser.add_argument("--fov-error", type=positive, metavar="DEG", help=text)
    height = parser.add_mutually_exclusive_group()
    height.add_argument(
        "--altitude", type=positive, metavar="KM", help="altitude above the mean Earth radius"
    )
    low, high = (1e-3 * bound for bound in HorizonSettings().altitudes)
    height.add_argument(
        "--altitudes",
        type=positive,
        nargs=2,
        metavar=("LEAST", "MOST"),
        default=(low, high),
        help=f"limits of an unknown altitude, km (default {low:g} {high:g})",
    )
    text = "image (PNG, PGM or FITS) of the picture's size; its pixels above 0 show the spacecraft itself"
    parser.add_argument("--mask", type=Path, metavar="IMAGE", help=text)
    text = "response of a logarithmic detector: dark counts, and counts per decade of light"
    parser.add_argument("--log-response", type=positive, nargs=2, metavar=("PEDESTAL", "COUNTS"), help=text)
    _add_paper_options(parser)
    add_output(parser, run)


def run(options: argparse.Namespace) -> int:
    """Find, print and draw the horizon. The exit status is 1 if no horizon is found."""
    _check_method(options)
    pixels = read_picture(options)
    camera = _camera(options, pixels)
    altitude = None if options.altitude is None else 1e3 * options.altitude
    if altitude is not None and altitude < LEAST_ALTITUDE:
        least = f"{1e-3 * LEAST_ALTITUDE:g} km"
        raise UsageError(f"--altitude {options.altitude:g}: this method needs at least {least}")
    if options.method != "default":
        return _run_paper(options, pixels, camera)
    response = None if options.log_response is None else LogarithmicResponse(*options.log_response)
    least, most = (1e3 * bound for bound in options.altitudes)
    settings = HorizonSettings(edges=EdgeSettings(response=response), altitudes=(least, most))
    knowledge = HorizonKnowledge(altitude=altitude)
    hidden = _mask(options, pixels)
    if options.fov_error is None:
        solution = find_nadir(pixels, camera, knowledge, settings, hidden)
    else:
        # The relative uncertainty of the focal length is df / f = d(fov) / sin(fov).
        sigma = math.radians(options.fov_error) / math.sin(math.radians(options.fov))
        solution = nadir_of_uncertain_field(pixels, camera, sigma, knowledge, settings, hidden)
    print_result(options, _facts(solution, altitude is None), _text(solution, altitude is None))
    if options.overlay is not None:
        write_picture(options.overlay, draw_horizon(grey_stretch(pixels), solution, camera))
        if not options.json:
            sys.stdout.write(f"picture:          {options.overlay}\n")
    return 0 if solution.nadir is not None else 1


def _mask(options: argparse.Namespace, pixels: Image) -> BoolArray | None:
    if options.mask is None:
        return None
    hidden = read_image(options.mask) > 0
    if hidden.all():
        raise UsageError(f"--mask {options.mask}: every pixel is above 0: pixels above 0 show the spacecraft")
    if hidden.shape != pixels.shape:
        sizes = [f"{shape[1]} x {shape[0]}" for shape in (hidden.shape, pixels.shape)]
        raise UsageError(f"--mask {options.mask}: {sizes[0]} pixels, but {options.image} has {sizes[1]}")
    return hidden


def _camera(options: argparse.Namespace, pixels: Image) -> CameraModel:
    rows, columns = pixels.shape
    if options.camera is None:
        if not 1.0 <= options.fov <= 150.0:
            raise UsageError(f"--fov {options.fov:g}: must be 1 to 150 deg")
        return Pinhole.from_field_of_view(columns, rows, math.radians(options.fov))
    model = camera_model(configuration.load_camera(options.camera))
    check_camera(options, pixels, model.columns, model.rows)
    return model


def _facts(solution: HorizonSolution, altitude_fitted: bool) -> dict[str, Any]:
    values: dict[str, Any] = {
        "status": solution.status.value,
        "reason": solution.reason or None,
        "edges_found": len(solution.points),
        "pixels_read": solution.pixels_read,
        "candidates": [_nadir_facts(each, altitude_fitted) for each in solution.candidates],
    }
    if solution.nadir is not None:
        values |= _nadir_facts(solution.nadir, altitude_fitted)
        values["limb_points_px"] = solution.points[solution.on_horizon].tolist()
    return values


def _nadir_facts(nadir: NadirMeasurement, altitude_fitted: bool) -> dict[str, Any]:
    x, y, z = nadir.direction
    known = {
        "nadir_camera": nadir.direction.tolist(),
        "from_boresight_deg": math.degrees(math.acos(min(1.0, max(-1.0, z)))),
        "towards_deg": math.degrees(math.atan2(y, x)),
        "covariance_rad2": nadir.covariance.tolist(),
        "sigma_deg": math.degrees(nadir.sigma),
        "residual_px": nadir.residual,
        "edges_used": nadir.used,
    }
    if altitude_fitted:
        known |= {"altitude_km": 1e-3 * nadir.altitude, "altitude_sigma_km": 1e-3 * nadir.altitude_sigma}
    return known


def _text(solution: HorizonSolution, altitude_fitted: bool) -> str:
    lines = [f"status:           {solution.status.value}"]
    if solution.reason:
        lines.append(f"reason:           {solution.reason}")
    lines.append(f"edges:            {len(solution.points)} found")
    for nadir in solution.candidates if solution.nadir is None else (solution.nadir,):
        values = _nadir_facts(nadir, altitude_fitted)
        x, y, z = nadir.direction
        # The uncertainties of nadir along and across the arc from boresight to nadir differ.
        sigmas = np.degrees(np.sqrt(np.linalg.eigvalsh(nadir.tangent_covariance)))
        lines += [
            f"nadir x, y, z:    {x:+.5f} {y:+.5f} {z:+.5f}",
            f"from boresight:   {values['from_boresight_deg']:.3f} deg, "
            f"towards {values['towards_deg']:.3f} deg (0 right, 90 down)",
            f"1 sigma:          {sigmas[1]:.3f} deg and {sigmas[0]:.3f} deg along the principal axes",
            f"limb:             {nadir.used} edges, residual {nadir.residual:.2f} px rms",
        ]
        if altitude_fitted:
            lines.append(
                f"altitude:         {1e-3 * nadir.altitude:.0f} +- {1e-3 * nadir.altitude_sigma:.0f} km"
            )
    return "\n".join(lines) + "\n"


METHODS = ("circle", "graphic", "vector")


def _add_paper_options(parser: argparse.ArgumentParser) -> None:
    paper = parser.add_argument_group("methods of Meller et al.")
    text = (
        "circle: a circle through the edges of one picture; graphic: the circles of two level cameras "
        "(--second, --turned); vector: the nadir of an earlier picture (--second), rotated with the horizon"
    )
    paper.add_argument("--method", choices=("default", *METHODS), default="default", help=text)
    text = "graphic: image of the second camera; vector: earlier image"
    paper.add_argument("--second", type=Path, metavar="IMAGE", help=text)
    text = "graphic: angle of the second camera to the right of the first"
    paper.add_argument("--turned", type=finite, metavar="DEG", help=text)
    text = "vector: nadir of the earlier picture in camera axes (default from its circle)"
    paper.add_argument("--nadir", type=finite, nargs=3, metavar=("X", "Y", "Z"), help=text)
    paper.add_argument(
        "--lines", type=int, metavar="N", help=f"number of scanned lines, 3 to 512 (default {meller.LINES})"
    )


@dataclass(frozen=True, slots=True, eq=False)
class _PaperNadir:
    """Nadir (3,) in camera axes by a method of Meller et al., and the limb circle in the first picture."""

    nadir: FloatArray
    seen: meller.ScannedHorizon


def _check_method(options: argparse.Namespace) -> None:
    error = options.fov_error
    if error is not None and (options.fov is None or options.method != "default"):
        raise UsageError(f"--fov-error {error:g}: only with --fov and --method default")
    if error is not None and not (options.fov - error >= 1.0 and options.fov + error <= 150.0):
        raise UsageError(f"--fov-error {error:g}: --fov {options.fov:g} must stay within 1 to 150 degrees")
    for name, method in (("second", "graphic or vector"), ("turned", "graphic"), ("nadir", "vector")):
        if getattr(options, name) is not None and options.method not in method.split(" or "):
            raise UsageError(f"--{name}: only with --method {method}")
    if options.method == "default":
        if options.lines is not None:
            raise UsageError(f"--lines: only with --method {', '.join(METHODS)}")
        return
    if options.lines is not None and not 3 <= options.lines <= 512:
        raise UsageError(f"--lines {options.lines}: give 3 to 512")
    for name in ("mask", "log_response"):
        if getattr(options, name) is not None:
            option = f"--{name.replace('_', '-')}"
            raise UsageError(f"{option}: --method {options.method} uses the counts directly")
    _check_second(options)


def _check_second(options: argparse.Namespace) -> None:
    """Raise UsageError unless the options give all values that a method of Meller et al. needs."""
    if options.method != "circle" and options.second is None:
        raise UsageError(f"--method {options.method}: give the other picture with --second")
    if options.method == "graphic" and options.turned is None:
        raise UsageError(
            "--method graphic: give with --turned the angle by which the second camera is turned to the right"
        )
    if options.altitude is None and (options.method != "vector" or options.nadir is None):
        raise UsageError(f"--method {options.method}: it needs --altitude")
    if options.nadir is not None and not np.linalg.norm(options.nadir) > 0.0:
        raise UsageError("--nadir 0 0 0: give a direction")


def _run_paper(options: argparse.Namespace, pixels: Image, camera: CameraModel) -> int:
    """Find, print and draw nadir by a method of Meller et al. The exit status is 1 without a horizon."""
    found, reason = None, ""
    try:
        found = _found(options, pixels, camera)
    except (meller.NoHorizonError, meller.GraphicMethodError) as error:
        reason = str(error)
    facts = _paper_facts(options.method, found, reason)
    print_result(options, facts, _paper_text(options.method, found, reason))
    if options.overlay is not None:
        picture = grey_stretch(pixels)
        drawn = picture if found is None else draw_circle(picture, found.seen, camera)
        write_picture(options.overlay, drawn)
        if not options.json:
            sys.stdout.write(f"picture:          {options.overlay}\n")
    return 0 if found is not None else 1


def _found(options: argparse.Namespace, pixels: Image, camera: CameraModel) -> _PaperNadir:
    lines = meller.LINES if options.lines is None else options.lines
    altitude = math.nan if options.altitude is None else 1e3 * options.altitude
    seen = meller.scan_horizon(pixels, camera, lines)
    if options.method == "circle":
        return _PaperNadir(meller.circle_nadir(seen.circle, camera, altitude), seen)
    other = read_image(options.second)
    check_size(options.second, other)
    if other.shape != pixels.shape:
        raise UsageError(
            f"{options.second}: {other.shape[1]} x {other.shape[0]} pixels, but {options.image} has"
            f" {pixels.shape[1]} x {pixels.shape[0]}"
        )
    second = meller.scan_horizon(other, camera, lines)
    if options.method == "graphic":
        # The Graphic Method (`graphic_nadir`) assumes that the axes of both cameras are level.
        angle, axis = math.radians(options.turned), camera.ideal.centre
        towards = (np.array([0.0, 1.0]), np.array([-math.sin(angle), math.cos(angle)]))
        first, other_camera = (meller.LevelCamera(one, axis) for one in towards)
        x, y, z = meller.graphic_nadir((first, other_camera), (seen.circle, second.circle), altitude)
        return _PaperNadir(np.array([y, z, x]), seen)
    if options.nadir is None:
        before = meller.circle_nadir(second.circle, camera, altitude)
    else:
        before = np.array(options.nadir) / np.linalg.norm(options.nadir)
    return _PaperNadir(meller.propagated_nadir(before, second.middle, seen.middle), seen)


def _paper_facts(method: str, found: _PaperNadir | None, reason: str) -> dict[str, Any]:
    if found is None:
        return {"status": "no-horizon", "reason": reason, "method": method}
    x, y, z = found.nadir.tolist()
    return {
        "status": "found",
        "reason": None,
        "method": method,
        "nadir_camera": [x, y, z],
        "from_boresight_deg": math.degrees(math.acos(min(1.0, max(-1.0, z)))),
        "towards_deg": math.degrees(math.atan2(y, x)),
        "circle_centre_px": found.seen.circle.centre.tolist(),
        "circle_radius_px": found.seen.circle.radius,
        "limb_points_px": found.seen.points.tolist(),
    }


def _paper_text(method: str, found: _PaperNadir | None, reason: str) -> str:
    if found is None:
        return f"status:           no-horizon\nreason:           {reason}\n"
    values, circle = _paper_facts(method, found, reason), found.seen.circle
    x, y, z = found.nadir
    return (
        "status:           found\n"
        f"edges:            {len(found.seen.points)} found\n"
        f"nadir x, y, z:    {x:+.5f} {y:+.5f} {z:+.5f}\n"
        f"from boresight:   {values['from_boresight_deg']:.3f} deg, "
        f"towards {values['towards_deg']:.3f} deg (0 right, 90 down)\n"
        f"circle:           centre {circle.centre[0]:.1f}, {circle.centre[1]:.1f} px,"
        f" radius {circle.radius:.1f} px\n"
        f"1 sigma:          not available with the method {method}\n"
    )
