"""Command `knightcube rate`, which estimates the body rate and moving objects from a picture of streaks."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from typing import Any

import numpy as np

from flight.schema import reader as configuration
from flight.schema.devices import Camera, camera_model, likelihood_settings
from ground.commands.options import (
    add_field,
    add_output,
    add_picture,
    check_camera,
    exposure_of,
    finite,
    positive,
    print_result,
    prior_contradiction,
    read_picture,
)
from ground.pictures import draw_marks
from knightcube.astro.arrays import FloatArray, Image
from knightcube.errors import UsageError
from knightcube.reference.corner_streak_rate import estimate_rate
from knightcube.reference.corner_streaks import DETECTOR_NAMES, StreakSettings
from knightcube.vision.camera.images import grey_stretch, write_picture
from knightcube.vision.camera.lens import Pinhole, streak_camera
from knightcube.vision.frame import raw_counts
from knightcube.vision.objects.detect import SpaceObject, detect_objects
from knightcube.vision.objects.settings import ObjectSettings
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.streak_result import (
    REASONS,
    FrameMotion,
    LikelihoodSettings,
    MotionResult,
    StreakStatus,
)

LIKELIHOOD = "likelihood"

_CURES = {
    StreakStatus.TOO_SHORT: "expose longer; `knightcube solve` gives the attitude without a rate",
    StreakStatus.TOO_FEW: "expose longer, or check the focus and the lens cap",
    StreakStatus.BLACK: "take the lens cap off, or expose longer",
    StreakStatus.SATURATED: "expose for a shorter time, or correct --saturation",
}
"""Remedy for each reason why a picture gives no rate."""
_LONGEST_READOUT = 1.0
"""Longest time (s) between the exposures of the first and the last row of a picture."""
_SHUTTER = (
    "shutter:       not described, included in the uncertainty: give --line-time, 0 for all rows at once\n"
)
_FIELD = "field of view: assumed to be exact: give --fov-error, or --camera with a calibration\n"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `knightcube rate` to the parser."""
    parser.description = (
        "Estimate the mean body rate over one exposure from the star streaks in a picture: PNG, TIFF, "
        "JPEG, BMP, PGM or FITS. The rate is of the camera, in its frame: boresight +z, x right, y down. "
        "A single picture does not determine the sign of the rate: --prior gives the approximate rate."
    )
    parser.epilog = "example: knightcube rate frame.png --fov 20 --exposure 0.2 --overlay found.png"
    add_picture(parser)
    add_field(parser)
    text = "standard deviation of --fov (default 0), for the uncertainty of the rate"
    parser.add_argument("--fov-error", type=positive, metavar="DEG", help=text)
    text = "exposure time (default: that of the picture's metadata, or of --camera)"
    parser.add_argument("--exposure", type=positive, metavar="S", help=text)
    parser.add_argument("--gain", type=positive, metavar="E", help="electrons per count (default 1)")
    parser.add_argument("--saturation", type=positive, metavar="COUNTS", help="counts of a saturated pixel")
    parser.add_argument("--psf", type=positive, metavar="PX", help="point spread, 1 sigma, px (default 1)")
    text = "time between rows, 0 for a global shutter (default: unknown, near 0)"
    parser.add_argument("--line-time", type=finite, metavar="S", help=text)
    parser.add_argument("--prior", type=finite, nargs=3, metavar=("X", "Y", "Z"), help="rough rate, rad/s")
    text = "estimator (default likelihood); the others are the corner detectors of Sease (2013)"
    parser.add_argument("--method", choices=(LIKELIHOOD, *DETECTOR_NAMES), default=LIKELIHOOD, help=text)
    add_output(parser, run)


def run(options: argparse.Namespace) -> int:
    """Estimate, print and draw the rate. The exit status is 1 if the picture gives no rate."""
    pixels, unit, zero = raw_counts(read_picture(options))
    camera = configuration.load_camera(options.camera) if options.camera else None
    pinhole, exposure = _geometry(options, camera, pixels)
    prior = None if options.prior is None else np.array(options.prior)
    likelihood = _likelihood(options, camera).in_units_of(unit, zero)
    found = _estimate(options.method, pixels, pinhole, exposure, likelihood, prior)
    unused = prior_contradiction(options.prior, found.rate)
    if unused:
        found = _estimate(options.method, pixels, pinhole, exposure, likelihood, None)
    objects, unsearched = _objects(pixels, pinhole, found, likelihood, unit)
    facts = _facts(found, objects, options.method) | {"objects_reason": unsearched}
    facts |= {"shutter_described": not likelihood.shutter_unstated}
    unstated = isinstance(found, MotionResult) and found.rate is not None and likelihood.shutter_unstated
    assumed = _FIELD if options.fov and options.fov_error is None and found.rate is not None else ""
    refused = found.rate is not None and unsearched
    text = _text(found, objects) + (f"objects:       not searched: {unsearched}\n" if refused else "")
    text += (_SHUTTER if unstated else "") + assumed
    print_result(
        options, facts | {"prior_used": not unused}, text + (f"prior:         {unused}\n" if unused else "")
    )
    if options.overlay is not None:
        ends = [item.endpoints for item in objects]
        write_picture(options.overlay, draw_marks(grey_stretch(pixels), found.endpoints, found.used, ends))
        if not options.json:
            sys.stdout.write(f"picture:       {options.overlay}\n")
    return 0 if found.rate is not None else 1


def _geometry(options: argparse.Namespace, camera: Camera | None, pixels: Image) -> tuple[Pinhole, float]:
    rows, columns = pixels.shape
    fov_deg = options.fov or (camera.field_of_view_deg if camera else None)
    exposure, differing = exposure_of(options, camera.exposure if camera else None)
    sys.stderr.write(differing)
    if fov_deg is None:
        raise UsageError("the field of view is unknown: give --fov DEG or --camera CONFIG")
    if exposure is None:
        raise UsageError("the picture states no exposure time: give --exposure S or --camera CONFIG")
    if options.line_time is not None and not 0.0 <= rows * options.line_time <= _LONGEST_READOUT:
        limits = f"0 to {_LONGEST_READOUT / rows:.2g} s, a readout of {_LONGEST_READOUT:g} s"
        raise UsageError(f"--line-time {options.line_time:g}: must be {limits}")
    if options.fov is None and camera is not None and camera.lens is not None:
        check_camera(options, pixels, camera.columns, camera.rows)
        return streak_camera(camera_model(camera)), exposure
    if not 0.1 <= fov_deg <= 120.0:
        raise UsageError(f"--fov {fov_deg:g}: must be 0.1 to 120 deg")
    return Pinhole.from_field_of_view(columns, rows, math.radians(fov_deg)), exposure


def _likelihood(options: argparse.Namespace, camera: Camera | None) -> LikelihoodSettings:
    """Return the fit settings: from the options, else from the configuration, else the defaults."""
    settings = LikelihoodSettings() if camera is None else likelihood_settings(camera)
    if options.fov_error is not None:
        if options.fov is None or options.method != LIKELIHOOD:
            raise UsageError(f"--fov-error {options.fov_error:g}: only with --fov and --method {LIKELIHOOD}")
        # The focal length is half of the picture's width divided by tan(fov / 2).
        relative = math.radians(options.fov_error) / math.sin(math.radians(options.fov))
        settings = replace(settings, knowledge=replace(settings.knowledge, focal_length=relative))
    given = {"gain": options.gain, "saturation": options.saturation, "psf_sigma": options.psf}
    given["line_time"] = options.line_time
    return replace(settings, **{name: value for name, value in given.items() if value is not None})


def _estimate(
    method: str,
    pixels: Image,
    pinhole: Pinhole,
    exposure: float,
    likelihood: LikelihoodSettings,
    prior: FloatArray | None,
) -> FrameMotion:
    if method == LIKELIHOOD:
        return estimate_motion(pixels, pinhole, exposure, likelihood, prior, 0.0)
    gain, saturation = likelihood.gain, likelihood.saturation
    settings = StreakSettings.of(method, gain=gain, saturation=saturation)  # type: ignore[arg-type]  # a choice
    return estimate_rate(pixels, pinhole, exposure, settings, prior, 0.0)


def _objects(
    pixels: Image, pinhole: Pinhole, found: FrameMotion, likelihood: LikelihoodSettings, unit: float
) -> tuple[tuple[SpaceObject, ...], str]:
    """Return the objects in the picture, and the reason why the search failed, or an empty text."""
    if found.rate is None:
        return (), "the rate is not known"
    gain, saturation = likelihood.gain, likelihood.saturation
    settings = ObjectSettings(psf_sigma=likelihood.psf_sigma, gain=gain, saturation=saturation)
    detected = detect_objects(pixels, pinhole, found.rate, found.exposure, settings)
    return tuple(replace(item, flux=unit * item.flux) for item in detected.objects), detected.reason


def _facts(found: FrameMotion, objects: tuple[SpaceObject, ...], method: str) -> dict[str, Any]:
    known = found.rate is not None and found.covariance is not None
    return {
        "method": method,
        "status": found.status.value,
        "reason": _reason(found),
        "rate_rad_s": found.rate.tolist() if found.rate is not None else None,
        "covariance_rad2_s2": found.covariance.tolist() if known and found.covariance is not None else None,
        "direction_of_time_known": found.status is StreakStatus.RATE,
        "exposure_s": found.exposure,
        "streak_length_px": found.length if math.isfinite(found.length) else None,
        "residual_rad": found.residual if math.isfinite(found.residual) else None,
        "streaks": [
            {"start_px": ends[0].tolist(), "end_px": ends[1].tolist(), "used": bool(used)}
            for ends, used in zip(found.endpoints, found.used, strict=True)
        ],
        "objects": [
            {
                "endpoints_px": item.endpoints.tolist(),
                "rate_among_stars_rad_s": item.relative_rate,
                "direction": item.direction.tolist(),
                "flux_counts": item.flux,
                "improvement_of_chi_square": item.improvement,
            }
            for item in objects
        ],
    }


def _reason(found: FrameMotion) -> str:
    """Return a line that states why the picture gives no rate, or an empty text."""
    if found.rate is not None:
        return ""
    detailed = found.reason if isinstance(found, MotionResult) else ""
    return detailed or REASONS.get(found.status, "")


def _text(found: FrameMotion, objects: tuple[SpaceObject, ...]) -> str:
    lines = [f"status:        {found.status.value}"]
    if _reason(found):
        cure = f": {_CURES[found.status]}" if found.status in _CURES else ""
        lines.append(f"reason:        {_reason(found)}{cure}")
    if found.rate is not None and found.covariance is not None:
        sigma = np.sqrt(np.diag(found.covariance))
        size = float(np.linalg.norm(found.rate))
        along = found.rate / size
        spread = float(np.sqrt(along @ found.covariance @ along))
        # Small uncertainties need more decimals: each uncertainty has at least two significant digits.
        digits = max(4, 1 - math.floor(math.log10(max(1e3 * float(sigma.min()), 1e-12))))
        pairs = zip(found.rate, sigma, strict=True)
        values = "  ".join(f"{1e3 * r:+.{digits}f} +- {1e3 * s:.{digits}f}" for r, s in pairs)
        lines.append(f"rate x, y, z:  {values} mrad/s")
        lines.append(f"magnitude:     {1e3 * size:.{digits}f} mrad/s +- {100.0 * spread / size:.3f} %")
    if found.status is StreakStatus.AMBIGUOUS:
        lines.append("direction:     unknown, the rate may have the opposite sign: give --prior")
    length = f", {found.length:.1f} px long" if math.isfinite(found.length) else ""
    lines.append(f"streaks:       {found.found} found, {found.used_count} used{length}")
    for item in objects:
        x, y = item.endpoints.mean(axis=0)
        rate = 1e3 * item.relative_rate
        lines.append(f"object:        at {x:.1f}, {y:.1f} px, {rate:.3f} mrad/s among the stars")
    return "\n".join(lines) + "\n"
