"""`flight horizon`: the Earth's limb in a picture, and the way down from it."""

from __future__ import annotations

import argparse
import json
import math
import sys
from typing import Any

import numpy as np

from flight.schema import reader as configuration
from flight.schema.devices import camera_model
from ground.commands import paper_horizon
from ground.commands.options import add_field, add_output, add_picture, positive, read_picture
from ground.pictures.horizon import draw_horizon
from knightcube.astro.arrays import Image
from knightcube.errors import UsageError
from knightcube.vision.camera.images import grey_stretch, write_picture
from knightcube.vision.camera.lens import CameraModel, Pinhole
from knightcube.vision.horizon.nadir import HorizonSolution, NadirMeasurement, find_nadir
from knightcube.vision.horizon.settings import (
    LEAST_ALTITUDE,
    EdgeSettings,
    HorizonKnowledge,
    HorizonSettings,
    LogarithmicResponse,
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Find the Earth's limb in a picture and the direction to the Earth's centre, in camera axes: z along "
        "the boresight, x to the right, y down. PNG, TIFF, JPEG or FITS, colour too. Without --altitude the "
        "altitude is fitted as well, within --altitudes. The Earth is taken as a sphere; the "
        "uncertainty includes the error of that."
    )
    parser.epilog = (
        "example: python -m flight horizon limb.png --fov 67 --altitude 515 --overlay limb_found.png"
    )
    add_picture(parser)
    add_field(parser, required=True)
    height = parser.add_mutually_exclusive_group()
    height.add_argument("--altitude", type=positive, metavar="KM", help="above the mean Earth")
    low, high = (1e-3 * bound for bound in HorizonSettings().altitudes)
    height.add_argument(
        "--altitudes",
        type=positive,
        nargs=2,
        metavar=("LEAST", "MOST"),
        default=(low, high),
        help=f"km, between which an unknown altitude lies (default {low:g} {high:g})",
    )
    parser.add_argument(
        "--log-response",
        type=positive,
        nargs=2,
        metavar=("PEDESTAL", "COUNTS"),
        help="of a logarithmic detector: dark counts, and counts per decade of light",
    )
    paper_horizon.add_arguments(parser)
    add_output(parser, run)


def run(options: argparse.Namespace) -> int:
    """Find the horizon, print, draw; exit status 1 when none is found."""
    paper_horizon.check(options)
    pixels = read_picture(options)
    camera = _camera(options, pixels)
    altitude = None if options.altitude is None else 1e3 * options.altitude
    if altitude is not None and altitude < LEAST_ALTITUDE:
        least = f"{1e-3 * LEAST_ALTITUDE:g} km"
        raise UsageError(f"--altitude {options.altitude:g}: the limb is seen as one from {least} up")
    if options.method != "default":
        return paper_horizon.run_paper(options, pixels, camera)
    response = None if options.log_response is None else LogarithmicResponse(*options.log_response)
    least, most = (1e3 * bound for bound in options.altitudes)
    settings = HorizonSettings(edges=EdgeSettings(response=response), altitudes=(least, most))
    solution = find_nadir(pixels, camera, HorizonKnowledge(altitude=altitude), settings)
    if options.json:
        sys.stdout.write(json.dumps(facts(solution, altitude is None), allow_nan=False) + "\n")
    else:
        sys.stdout.write(_text(solution, altitude is None))
    if options.overlay is not None:
        write_picture(options.overlay, draw_horizon(grey_stretch(pixels), solution, camera))
        if not options.json:
            sys.stdout.write(f"picture:          {options.overlay}\n")
    return 0 if solution.nadir is not None else 1


def _camera(options: argparse.Namespace, pixels: Image) -> CameraModel:
    rows, columns = pixels.shape
    if options.camera is None:
        if not 1.0 <= options.fov <= 150.0:
            raise UsageError(f"--fov {options.fov:g}: a pinhole camera sees 1 to 150 degrees")
        return Pinhole.from_field_of_view(columns, rows, math.radians(options.fov))
    model = camera_model(configuration.load_camera(options.camera))
    if (rows, columns) != (model.rows, model.columns):
        raise UsageError(
            f"{options.image}: {columns} x {rows} pixels, but the camera of {options.camera} has"
            f" {model.columns} x {model.rows}"
        )
    return model


def facts(solution: HorizonSolution, altitude_fitted: bool) -> dict[str, Any]:
    """Return all that is known of a solution, for `--json`."""
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
        # Across and along the arc from the boresight to nadir the uncertainty differs.
        sigmas = np.degrees(np.sqrt(np.linalg.eigvalsh(nadir.tangent_covariance)))
        lines += [
            f"nadir x, y, z:    {x:+.5f} {y:+.5f} {z:+.5f}",
            f"from boresight:   {values['from_boresight_deg']:.3f} deg, "
            f"towards {values['towards_deg']:.3f} deg from right to down",
            f"1 sigma:          {sigmas[1]:.3f} deg at worst, {sigmas[0]:.3f} deg at best",
            f"limb:             {nadir.used} edges, residual {nadir.residual:.2f} px rms",
        ]
        if altitude_fitted:
            lines.append(
                f"altitude:         {1e-3 * nadir.altitude:.0f} +- {1e-3 * nadir.altitude_sigma:.0f} km"
            )
    return "\n".join(lines) + "\n"
