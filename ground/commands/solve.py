"""Command `knightcube solve`, which finds the attitude, the stars and the rate in a picture of the sky."""

from __future__ import annotations

import argparse
import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flight.schema import reader as configuration
from flight.schema.devices import camera_model, likelihood_settings, stated_accuracy
from ground.commands.options import (
    add_field,
    add_output,
    add_picture,
    check_camera,
    check_new,
    exposure_of,
    finite,
    positive,
    print_result,
    prior_contradiction,
    read_picture,
    utc,
    write_new,
)
from ground.pictures import draw_solution
from ground.sky import bodies_in, header_text, sky_facts, sky_text
from knightcube.astro.arrays import Image
from knightcube.astro.attitude.solvers import SOLVERS
from knightcube.astro.catalogue import PROPER_NAMES
from knightcube.astro.earth.sun import FIRST_YEAR, LAST_YEAR, julian_date
from knightcube.errors import UsageError
from knightcube.reference.star_identification import DEFAULT_METHOD, METHODS, method_of
from knightcube.vision.camera.images import grey_stretch, rows_reversed, write_picture
from knightcube.vision.star_tracker import (
    FOV_TOLERANCE,
    UNKNOWN_FOV_DEG,
    StarSolution,
    StarTracker,
    field_of_view,
)
from knightcube.vision.startracker.solve import SolveSettings
from knightcube.vision.startracker.survey import CENTROIDS, DetectionSettings

ARCSECONDS = math.degrees(1.0) * 3600.0
IMAGE = "image"
"""Name of the attitude method that fits the star positions in the image."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube solve` to the parser."""
    parser.description = (
        "Determine where a picture of the sky points: right ascension, declination and roll (position angle "
        "of its upward direction, from north through east), ICRS; which stars it shows; and, from star "
        "streaks, how the camera rotated. PNG, TIFF, JPEG, BMP, PGM or FITS. Without --fov or --camera all "
        f"fields from {UNKNOWN_FOV_DEG[0]:g} to {UNKNOWN_FOV_DEG[1]:g} deg are searched."
    )
    parser.epilog = "example: knightcube solve night.jpg --fov 11.4 --overlay solved.png"
    add_picture(parser)
    add_field(parser)
    add = parser.add_argument
    add("--fov-error", type=positive, metavar="DEG", help="tolerance of --fov (default 5 %% of the field)")
    text = "exposure time, for the rate (default: that of the picture's metadata, or of --camera)"
    add("--exposure", type=positive, metavar="S", help=text)
    add("--prior", type=finite, nargs=3, metavar=("X", "Y", "Z"), help="rough rate, rad/s")
    text = "time of the picture, such as 2026-11-21, for proper motion, aberration and planets"
    add("--date", type=utc, metavar="UTC", help=text)
    add("--wcs", type=Path, metavar="FITS", help="write a header of world coordinates (TAN-SIP) here")
    add(
        "--index",
        type=Path,
        metavar="FILE",
        help="sky index, made by `knightcube index`",
    )
    _add_methods(parser)
    add_output(parser, run)


def _add_methods(parser: argparse.ArgumentParser) -> None:
    text = (
        "identification; all methods except the default need a field of view known to within 1.8 %%: "
        "see --fov-error"
    )
    parser.add_argument("--method", choices=tuple(METHODS), default=DEFAULT_METHOD, help=text)
    text = (
        "image: fit of the star positions in the image, each with its own covariance (default); the "
        "other methods solve Wahba's problem for the directions of the stars"
    )
    parser.add_argument("--attitude", choices=(IMAGE, *SOLVERS), default=IMAGE, help=text)
    text = (
        "centroid method for points: psf fits the point spread (default), window is the centre "
        "of mass, the other methods weigh the pixels differently"
    )
    parser.add_argument("--centroid", choices=CENTROIDS, default=CENTROIDS[0], help=text)


def run(options: argparse.Namespace) -> int:
    """Solve the picture, and print and draw the solution. The exit status is 1 without a solution."""
    check_new(options.wcs)
    if options.date is not None and not FIRST_YEAR <= options.date.year < LAST_YEAR:
        years = f"{FIRST_YEAR} to {LAST_YEAR - 1}"
        raise UsageError(f"--date {options.date:%Y-%m-%d}: give the time of the picture, from {years}")
    pixels = read_picture(options)
    tracker, exposure, axis_sigma = _tracker(options, pixels)
    begin = time.perf_counter()
    solution = tracker.solve(pixels, exposure=exposure, utc=options.date, rate=options.prior)
    unused = prior_contradiction(options.prior, solution.rate)
    if unused:
        solution = tracker.solve(pixels, exposure=exposure, utc=options.date)
    seconds = time.perf_counter() - begin
    sky_map, bodies = solution.sky_map, []
    if sky_map is not None and options.date is not None:
        bodies = bodies_in(sky_map, julian_date(options.date))
    reversed_rows = options.raw is None and rows_reversed(options.image)
    values = {"attitude_method": options.attitude, "centroid_method": options.centroid}
    values |= facts(solution, seconds) | sky_facts(sky_map, bodies, reversed_rows)
    text = _text(solution, seconds, axis_sigma) + (f"prior:            {unused}\n" if unused else "")
    text += sky_text(sky_map, bodies)
    print_result(options, values | {"optical_axis_sigma_px": axis_sigma}, text)
    if options.wcs is not None and sky_map is not None:
        write_new(options.wcs, header_text(sky_map, reversed_rows))
    if options.overlay is not None:
        write_picture(options.overlay, draw_solution(grey_stretch(pixels), solution.frame, solution.index))
        if not options.json:
            sys.stdout.write(f"picture:          {options.overlay}\n")
    return 0 if solution else 1


def _tracker(options: argparse.Namespace, pixels: Image) -> tuple[StarTracker, float | None, float | None]:
    """Return the star tracker that the options describe, and the exposure time, s.

    The third returned value is the standard deviation (px) of the optical axis of a calibrated camera; None
    without a calibrated camera.
    """
    fov, error, configured, lens, settings = options.fov, options.fov_error, None, None, None
    accuracy = None
    if options.camera is not None:
        camera = configuration.load_camera(options.camera)
        check_camera(options, pixels, camera.columns, camera.rows)
        lens, configured = camera_model(camera), camera.exposure
        if camera.lens is None and error is None:
            # The field of view has a tolerance unless the lens is calibrated.
            error = FOV_TOLERANCE * math.degrees(field_of_view(lens))
        accuracy = stated_accuracy(camera) if error is None else None
        settings = SolveSettings(
            detection=DetectionSettings(saturation=camera.saturation),
            likelihood=likelihood_settings(camera),
            lens=accuracy,
        )
    settings = settings or SolveSettings()
    if options.method != DEFAULT_METHOD:
        if fov is None and lens is None:
            raise UsageError(f"--method {options.method}: it needs the field of view: give --fov or --camera")
        settings = replace(settings, method=method_of(options.method))
    if options.attitude != IMAGE:
        settings = replace(settings, attitude=SOLVERS[options.attitude])
    settings = replace(settings, detection=replace(settings.detection, method=options.centroid))
    tracker = StarTracker(fov, error, camera=lens, settings=settings, index=options.index)
    exposure, differing = exposure_of(options, configured)
    sys.stderr.write(differing)
    return tracker, exposure, None if accuracy is None else accuracy.centre


def facts(solution: StarSolution, seconds: float) -> dict[str, Any]:
    """Return the values of a solution as JSON data."""
    values: dict[str, Any] = {
        "status": solution.status,
        "reason": solution.reason or None,
        "shows": solution.frame.kind.value,
        "points_found": len(solution.frame.points),
        "seconds": seconds,
    }
    if not solution:
        return values
    chance, stars = solution.log10_false_alarm, solution.stars
    each = zip(stars.hip.tolist(), stars.magnitude, stars.points, stars.residuals, strict=True)
    return values | {
        "right_ascension_deg": solution.right_ascension_deg,
        "declination_deg": solution.declination_deg,
        "roll_deg": solution.roll_deg,
        "quaternion": solution.quaternion.tolist(),
        "covariance_rad2": solution.covariance.tolist(),
        "field_of_view_deg": solution.field_of_view_deg,
        "mirrored": solution.mirrored,
        "field_of_view_sigma_deg": math.degrees(solution.field_of_view_sigma),
        "focal_length_px": solution.frame.camera.focal_length,
        "log10_false_alarm": chance if math.isfinite(chance) else None,
        "by_light_of_faint_stars": solution.frame.faint,
        "stars": [
            {
                "hip": hip,
                "name": PROPER_NAMES.get(hip),
                "magnitude": round(float(magnitude), 3),
                "point_px": point.tolist(),
                "residual_px": residual.tolist(),
            }
            for hip, magnitude, point, residual in each
        ],
        "motion": _motion_facts(solution),
    }


def _motion_facts(solution: StarSolution) -> dict[str, Any] | None:
    motion = solution.frame.motion
    if motion is None or motion.rate is None or motion.covariance is None:
        return None
    turn = {
        "turn_rad": (motion.rate * motion.exposure).tolist(),
        "streak_length_px": motion.length,
        "direction_of_time_known": solution.rate_sign_known,
    }
    if solution.rate is None:
        return turn
    return turn | {"rate_rad_s": motion.rate.tolist(), "rate_covariance_rad2_s2": motion.covariance.tolist()}


def _text(solution: StarSolution, seconds: float, axis_sigma: float | None = None) -> str:
    lines = [f"status:           {solution.status}"]
    if not solution:
        lines.append(f"reason:           {solution.reason}")
        return "\n".join(lines) + "\n"
    sigma = ARCSECONDS * np.sqrt(np.diag(solution.covariance))
    stars, frame = solution.stars, solution.frame
    rms = float(np.sqrt(np.mean(stars.residuals**2)))
    per_pixel = ARCSECONDS / frame.camera.focal_length
    lines += [
        f"right ascension:  {round(solution.right_ascension_deg, 4) % 360.0:.4f} deg",
        f"declination:      {solution.declination_deg:+.4f} deg",
        f"roll:             {round(solution.roll_deg, 3) % 360.0:.3f} deg",
        f'1 sigma:          {sigma[0]:.2f}" x, {sigma[1]:.2f}" y, {sigma[2]:.1f}" about the boresight',
        f'field of view:    {solution.field_of_view_deg:.4f} deg across, {per_pixel:.2f}" per pixel',
        f"stars:            {len(stars)} of {len(frame.points)} {frame.kind.value} matched,"
        f" residual {rms:.2f} px rms per axis",
        f"chance matches:   10^{solution.log10_false_alarm:.0f} expected"
        + (", by the light of faint stars" if frame.faint else ""),
    ]
    if axis_sigma:
        lines.append(
            f'optical axis:     1 sigma {axis_sigma * per_pixel:.2f}" ({axis_sigma:.2f} px), constant until '
            "the lens moves, in addition to the 1 sigma of the attitude"
        )
    if solution.mirrored:
        lines.append("mirrored:         yes; the attitude belongs to the picture after mirroring")
    named = [PROPER_NAMES.get(hip) or f"HIP {hip}" for hip in stars.hip[:8].tolist()]
    lines.append(f"brightest:        {', '.join(named)}")
    lines += _motion_text(solution)
    lines.append(f"time:             {1e3 * seconds:.0f} ms")
    return "\n".join(lines) + "\n"


def _motion_text(solution: StarSolution) -> list[str]:
    motion = solution.frame.motion
    if motion is None or motion.rate is None or motion.covariance is None:
        return []
    length = f"streaks:          {motion.length:.1f} px long"
    if solution.rate is None:
        return [length + ": give --exposure for the rate"]
    sigma = 1e3 * np.sqrt(np.diag(motion.covariance))
    each = zip(1e3 * motion.rate, sigma, strict=True)
    values = "  ".join(f"{rate:+.4f} +- {spread:.4f}" for rate, spread in each)
    lines = [length, f"rate x, y, z:     {values} mrad/s"]
    if not solution.rate_sign_known:
        lines.append("direction:        unknown, the rate may have the opposite sign: give --prior")
    return lines
