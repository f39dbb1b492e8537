"""`flight solve`: where a picture of the sky points, which stars it shows, and how the camera turned."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flight.schema import reader as configuration
from flight.schema.camera_model import camera_model, likelihood_settings
from flight.schema.devices import Camera
from ground.commands.date import date
from ground.commands.options import (
    add_field,
    add_output,
    add_picture,
    finite,
    positive,
    read_picture,
    write_new,
)
from ground.pictures.sky_picture import draw_solution
from ground.sky.bodies import bodies_in
from ground.sky.facts import sky_facts, sky_text
from ground.sky.world_coordinates import header_text
from knightcube.astro.arrays import Image
from knightcube.astro.attitude.solvers import SOLVERS
from knightcube.astro.catalogue.names import PROPER_NAMES
from knightcube.astro.earth.sun import earth_velocity
from knightcube.errors import UsageError
from knightcube.reference.star_identification.methods import DEFAULT_METHOD, METHODS, method_of
from knightcube.vision.camera.images import grey_stretch, write_picture
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.camera.pinhole import Pinhole
from knightcube.vision.frame_job import solve_frame
from knightcube.vision.startracker.detection import DetectionSettings
from knightcube.vision.startracker.detection.survey import CENTROIDS
from knightcube.vision.startracker.index import sky_index
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.index.sky_index import SkyIndex
from knightcube.vision.startracker.sky_map import Pointing
from knightcube.vision.startracker.solution import FrameSolution
from knightcube.vision.startracker.solve import RatePrior, SolveSettings
from knightcube.vision.streaks.streak_result import StreakStatus

ARCSECONDS = math.degrees(1.0) * 3600.0
UNKNOWN_DEG = 4.0, 60.0
"""Fields of view that are searched when none is given."""
_FOV_TOLERANCE = 0.05
IMAGE = "image"
"""The attitude by the fit in the image."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this command to the parser."""
    parser.description = (
        "Determine where a picture of the sky points: right ascension, declination and roll (the position "
        "angle of up, from north through east), ICRS; which stars it shows; and, from star streaks, "
        "how the camera turned. PNG, TIFF, JPEG, BMP or FITS. Without --fov or --camera all fields from "
        f"{UNKNOWN_DEG[0]:g} to {UNKNOWN_DEG[1]:g} deg are searched."
    )
    parser.epilog = "example: python -m flight solve night.jpg --fov 11.4 --overlay solved.png"
    add_picture(parser)
    add_field(parser)
    parser.add_argument(
        "--fov-error", type=positive, metavar="DEG", help="tolerance of --fov (default 5 %% of it)"
    )
    parser.add_argument(
        "--exposure", type=positive, metavar="S", help="exposure time, for the rate of streaks"
    )
    parser.add_argument("--prior", type=finite, nargs=3, metavar=("X", "Y", "Z"), help="rough rate, rad/s")
    parser.add_argument(
        "--date",
        type=date,
        metavar="UTC",
        help="when, such as 2026-11-21: proper motion, aberration, planets",
    )
    parser.add_argument(
        "--wcs", type=Path, metavar="FITS", help="write a header of world coordinates (TAN-SIP) here"
    )
    parser.add_argument("--index", type=Path, metavar="FILE", help="another sky index")
    _add_methods(parser)
    add_output(parser, run)


def _add_methods(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--method",
        choices=tuple(METHODS),
        default=DEFAULT_METHOD,
        help="of identification; all but the default need the field to 1.8 %%: see --fov-error",
    )
    parser.add_argument(
        "--attitude",
        choices=(IMAGE, *SOLVERS),
        default=IMAGE,
        help="image: the fit in the image, each star with its own covariance (default); else a solver of "
        "directions",
    )
    parser.add_argument(
        "--centroid",
        choices=CENTROIDS,
        default=CENTROIDS[0],
        help="of points: psf fits the point spread (default), window is the centre of mass, the others weigh "
        "its pixels otherwise",
    )


def run(options: argparse.Namespace) -> int:
    """Solve, print, draw; exit status 1 when the picture is not solved."""
    if options.wcs is not None and options.wcs.exists():
        raise UsageError(f"{options.wcs}: exists already: name another file")
    pixels = read_picture(options)
    camera, scale, exposure, settings = _belief(options, pixels)
    sky = sky_index.load(options.index) if options.index else default_index()
    if options.date is not None:
        sky = sky.at(options.date.year)
        settings = replace(settings, velocity=earth_velocity(options.date.julian_date))
    if options.method != DEFAULT_METHOD:
        if options.fov is None and options.camera is None:
            raise UsageError(f"--method {options.method}: it needs the field of view: give --fov or --camera")
        settings = replace(settings, method=method_of(options.method))
    if options.attitude != IMAGE:
        settings = replace(settings, attitude=SOLVERS[options.attitude])
    settings = replace(settings, detection=replace(settings.detection, method=options.centroid))
    prior = None if options.prior is None else RatePrior(np.array(options.prior), 0.0)
    begin = time.perf_counter()
    solution = solve_frame(pixels, camera, scale, exposure or 1.0, sky, settings, rate_prior=prior)
    seconds = time.perf_counter() - begin
    sky_map, bodies = solution.sky_map(settings.velocity), []
    if sky_map is not None and options.date is not None:
        bodies = bodies_in(sky_map, options.date.julian_date)
    if options.json:
        values = {"attitude_method": options.attitude, "centroid_method": options.centroid}
        values |= facts(solution, sky, exposure, seconds) | sky_facts(sky_map, bodies)
        sys.stdout.write(json.dumps(values, allow_nan=False) + "\n")
    else:
        sys.stdout.write(_text(solution, sky, exposure, seconds) + sky_text(sky_map, bodies))
    if options.wcs is not None and sky_map is not None:
        write_new(options.wcs, header_text(sky_map))
    if options.overlay is not None:
        write_picture(options.overlay, draw_solution(grey_stretch(pixels), solution, sky))
        if not options.json:
            sys.stdout.write(f"picture:          {options.overlay}\n")
    return 0 if solution.fix is not None else 1


def _belief(
    options: argparse.Namespace, pixels: Image
) -> tuple[CameraModel, tuple[float, float], float | None, SolveSettings]:
    """Return the camera, the range of its scale, the exposure, and the settings that fit it."""
    if options.camera is None:
        lens, scale = lens_of_field(options.fov, options.fov_error, pixels.shape)
        return lens, scale, options.exposure, SolveSettings()
    camera = configuration.load_camera(options.camera)
    if pixels.shape != (camera.rows, camera.columns):
        raise UsageError(
            f"{options.image}: {pixels.shape[1]} x {pixels.shape[0]} pixels, but the camera of"
            f" {options.camera} has {camera.columns} x {camera.rows}"
        )
    return calibrated(camera, options.fov_error, options.exposure)


def calibrated(
    camera: Camera, error_deg: float | None, exposure: float | None
) -> tuple[CameraModel, tuple[float, float], float | None, SolveSettings]:
    """Return the lens of a configuration; only a calibrated lens has no tolerance."""
    model = camera_model(camera)
    fov = math.degrees(field_of_view(model))
    if camera.lens is not None and error_deg is None:
        scale = 1.0, 1.0
    else:
        _, scale = lens_of_field(fov, error_deg, (camera.rows, camera.columns))
    return (
        model,
        scale,
        exposure or camera.exposure,
        SolveSettings(
            detection=DetectionSettings(saturation=camera.saturation),
            likelihood=likelihood_settings(camera),
        ),
    )


def lens_of_field(
    fov: float | None, error: float | None, shape: tuple[int, ...]
) -> tuple[Pinhole, tuple[float, float]]:
    """Return a camera of `fov` deg across, within `error` deg, and the range of its scale.

    Without a field of view all of UNKNOWN_DEG are meant. Raises UsageError for a field that is none.
    """
    lowest, highest = UNKNOWN_DEG
    if fov is not None:
        if not 1.0 <= fov <= 120.0:
            raise UsageError(f"--fov {fov}: a pinhole camera sees 1 to 120 degrees")
        error = _FOV_TOLERANCE * fov if error is None else error
        lowest, highest = max(fov - error, 0.5), min(fov + error, 125.0)
    tangents = [math.tan(0.5 * math.radians(angle)) for angle in (lowest, highest)]
    middle = math.sqrt(tangents[0] * tangents[1])
    camera = Pinhole(shape[1], shape[0], 0.5 * shape[1] / middle)
    return camera, (tangents[0] / middle, tangents[1] / middle)


def facts(solution: FrameSolution, sky: SkyIndex, exposure: float | None, seconds: float) -> dict[str, Any]:
    """Return the values of a solution, for `--json`."""
    camera = solution.camera
    values: dict[str, Any] = {
        "status": solution.status.value,
        "reason": solution.reason or None,
        "shows": solution.kind.value,
        "points_found": len(solution.points),
        "seconds": seconds,
    }
    if solution.fix is None:
        return values
    pointing = Pointing.of(solution.fix.quaternion)
    fov, chance = field_of_view(camera), solution.log10_false_alarm
    return values | {
        "right_ascension_deg": math.degrees(pointing.right_ascension),
        "declination_deg": math.degrees(pointing.declination),
        "roll_deg": math.degrees(pointing.roll),
        "quaternion": solution.fix.quaternion.tolist(),
        "covariance_rad2": solution.fix.covariance.tolist(),
        "field_of_view_deg": math.degrees(fov),
        "mirrored": solution.mirrored,
        "field_of_view_sigma_deg": math.degrees(math.sin(fov) * solution.scale_sigma),
        "focal_length_px": camera.focal_length,
        "log10_false_alarm": chance if math.isfinite(chance) else None,
        "stars": [
            {
                "hip": int(sky.stars.hip[solution.star[point]]),
                "name": PROPER_NAMES.get(int(sky.stars.hip[solution.star[point]])),
                "magnitude": round(float(sky.stars.magnitude[solution.star[point]]), 3),
                "point_px": solution.points[point].tolist(),
                "residual_px": (solution.points[point] - solution.expected[point]).tolist(),
            }
            for point in solution.matched
        ],
        "motion": _motion_facts(solution, exposure),
    }


def _motion_facts(solution: FrameSolution, exposure: float | None) -> dict[str, Any] | None:
    motion = solution.motion
    if motion is None or motion.rate is None or motion.covariance is None:
        return None
    turn = {
        "turn_rad": (motion.rate * motion.exposure).tolist(),
        "streak_length_px": motion.length,
        "direction_of_time_known": motion.status is StreakStatus.RATE,
    }
    if exposure is None:
        return turn
    return turn | {"rate_rad_s": motion.rate.tolist(), "rate_covariance_rad2_s2": motion.covariance.tolist()}


def field_of_view(camera: CameraModel) -> float:
    """Return the angle across the columns, edge to edge, rad, of a camera without distortion."""
    return 2.0 * math.atan(0.5 * camera.columns / camera.focal_length)


def _text(solution: FrameSolution, sky: SkyIndex, exposure: float | None, seconds: float) -> str:
    lines = [f"status:           {solution.status.value}"]
    if solution.fix is None:
        lines.append(f"reason:           {solution.reason}")
        return "\n".join(lines) + "\n"
    values = facts(solution, sky, exposure, seconds)
    sigma = ARCSECONDS * np.sqrt(np.diag(solution.fix.covariance))
    matched = solution.matched
    residual = solution.points[matched] - solution.expected[matched]
    rms = float(np.sqrt(np.mean(residual**2)))
    per_pixel = ARCSECONDS / solution.camera.focal_length
    lines += [
        f"right ascension:  {values['right_ascension_deg']:.4f} deg",
        f"declination:      {values['declination_deg']:+.4f} deg",
        f"roll:             {values['roll_deg']:.3f} deg",
        f'1 sigma:          {sigma[0]:.2f}" x, {sigma[1]:.2f}" y, {sigma[2]:.1f}" about the boresight',
        f'field of view:    {values["field_of_view_deg"]:.4f} deg across, {per_pixel:.2f}" a pixel',
        f"stars:            {len(matched)} of {len(solution.points)} {solution.kind.value} matched,"
        f" residual {rms:.2f} px rms an axis",
        f"by chance:        10^{solution.log10_false_alarm:.0f}",
    ]
    if solution.mirrored:
        lines.append("mirrored:         yes; the attitude is that of the picture mirrored back")
    named = [PROPER_NAMES.get(star["hip"]) or f"HIP {star['hip']}" for star in values["stars"][:8]]
    lines.append(f"brightest:        {', '.join(named)}")
    lines += _motion_text(solution, exposure)
    lines.append(f"time:             {1e3 * seconds:.0f} ms")
    return "\n".join(lines) + "\n"


def _motion_text(solution: FrameSolution, exposure: float | None) -> list[str]:
    motion = solution.motion
    if motion is None or motion.rate is None or motion.covariance is None:
        return []
    length = f"streaks:          {motion.length:.1f} px long"
    if exposure is None:
        return [length + ": give --exposure for the rate"]
    sigma = 1e3 * np.sqrt(np.diag(motion.covariance))
    each = zip(1e3 * motion.rate, sigma, strict=True)
    values = "  ".join(f"{rate:+.4f} +- {spread:.4f}" for rate, spread in each)
    lines = [length, f"rate x, y, z:     {values} mrad/s"]
    if motion.status is not StreakStatus.RATE:
        lines.append("direction:        unknown, the rate may be its opposite: give --prior")
    return lines
