"""`flight horizon --method circle|graphic|vector`: the methods of Meller et al. as they are written."""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ground.commands.options import check_size, finite
from ground.pictures.horizon import draw_circle
from knightcube.astro.arrays import FloatArray, Image
from knightcube.errors import UsageError
from knightcube.reference.horizon import (
    LINES,
    GraphicMethodError,
    LevelCamera,
    NoHorizonError,
    ScannedHorizon,
    circle_nadir,
    graphic_nadir,
    propagated_nadir,
    scan_horizon,
)
from knightcube.vision.camera.images import grey_stretch, read_image, write_picture
from knightcube.vision.camera.lens import CameraModel

METHODS = ("circle", "graphic", "vector")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the paper's methods."""
    paper = parser.add_argument_group("Meller et al.'s own methods")
    paper.add_argument(
        "--method",
        choices=("default", *METHODS),
        default="default",
        help="circle: one picture's edges on a circle; graphic: two level cameras' circles (--second, "
        "--turned); vector: the nadir of an earlier picture (--second) turned with the horizon",
    )
    paper.add_argument(
        "--second", type=Path, metavar="IMAGE", help="graphic: the other camera's; vector: the earlier one"
    )
    paper.add_argument(
        "--turned",
        type=finite,
        metavar="DEG",
        help="graphic: how far to the right of the first camera the second looks",
    )
    paper.add_argument(
        "--nadir",
        type=finite,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="vector: of the earlier picture, camera axes (default: by its circle)",
    )
    paper.add_argument(
        "--lines", type=int, metavar="N", help=f"lines that are scanned, 3 to 512 (default {LINES})"
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """What a method found: nadir (3,) in camera axes, and the circle in the first picture."""

    nadir: FloatArray
    seen: ScannedHorizon


def check(options: argparse.Namespace) -> None:
    """Raise UsageError where options of one method stand beside another."""
    for name, method in (("second", "graphic or vector"), ("turned", "graphic"), ("nadir", "vector")):
        if getattr(options, name) is not None and options.method not in method.split(" or "):
            raise UsageError(f"--{name}: only with --method {method}")
    if options.method == "default":
        if options.lines is not None:
            raise UsageError(f"--lines: only with --method {', '.join(METHODS)}")
        return
    if options.lines is not None and not 3 <= options.lines <= 512:
        raise UsageError(f"--lines {options.lines}: give 3 to 512")
    if options.log_response is not None:
        raise UsageError(f"--log-response: --method {options.method} works on the counts themselves")
    if options.method != "circle" and options.second is None:
        raise UsageError(f"--method {options.method}: give the other picture with --second")
    if options.method == "graphic" and options.turned is None:
        raise UsageError("--method graphic: say with --turned how far to the right the second camera looks")
    if options.altitude is None and (options.method != "vector" or options.nadir is None):
        raise UsageError(f"--method {options.method}: it needs --altitude")
    if options.nadir is not None and not np.linalg.norm(options.nadir) > 0.0:
        raise UsageError("--nadir 0 0 0: give a direction")


def run_paper(options: argparse.Namespace, pixels: Image, camera: CameraModel) -> int:
    """Find nadir by one of the paper's methods, print, draw; exit status 1 when there is none."""
    found, reason = None, ""
    try:
        found = _found(options, pixels, camera)
    except (NoHorizonError, GraphicMethodError) as error:
        reason = str(error)
    if options.json:
        sys.stdout.write(json.dumps(_facts(options.method, found, reason), allow_nan=False) + "\n")
    else:
        sys.stdout.write(_text(options.method, found, reason))
    if options.overlay is not None:
        picture = grey_stretch(pixels)
        drawn = picture if found is None else draw_circle(picture, found.seen, camera)
        write_picture(options.overlay, drawn)
        if not options.json:
            sys.stdout.write(f"picture:          {options.overlay}\n")
    return 0 if found is not None else 1


def _found(options: argparse.Namespace, pixels: Image, camera: CameraModel) -> _Found:
    lines = LINES if options.lines is None else options.lines
    altitude = math.nan if options.altitude is None else 1e3 * options.altitude
    seen = scan_horizon(pixels, camera, lines)
    if options.method == "circle":
        return _Found(circle_nadir(seen.circle, camera, altitude), seen)
    other = read_image(options.second)
    check_size(options.second, other)
    if other.shape != pixels.shape:
        raise UsageError(
            f"{options.second}: {other.shape[1]} x {other.shape[0]} pixels, but {options.image} has"
            f" {pixels.shape[1]} x {pixels.shape[0]}"
        )
    second = scan_horizon(other, camera, lines)
    if options.method == "graphic":
        return _Found(_graphic(options.turned, camera, seen, second, altitude), seen)
    if options.nadir is None:
        before = circle_nadir(second.circle, camera, altitude)
    else:
        before = np.array(options.nadir) / np.linalg.norm(options.nadir)
    return _Found(propagated_nadir(before, second.middle, seen.middle), seen)


def _graphic(
    turned: float, camera: CameraModel, first: ScannedHorizon, second: ScannedHorizon, altitude: float
) -> FloatArray:
    """Return nadir (3,) in the first camera's axes: its boresight is body x, its rows run down body z."""
    angle, axis = math.radians(turned), camera.ideal.centre
    cameras = (
        LevelCamera(np.array([0.0, 1.0]), axis),
        LevelCamera(np.array([-math.sin(angle), math.cos(angle)]), axis),
    )
    x, y, z = graphic_nadir(cameras, (first.circle, second.circle), altitude)
    return np.array([y, z, x])


def _facts(method: str, found: _Found | None, reason: str) -> dict[str, Any]:
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


def _text(method: str, found: _Found | None, reason: str) -> str:
    if found is None:
        return f"status:           no-horizon\nreason:           {reason}\n"
    values, circle = _facts(method, found, reason), found.seen.circle
    x, y, z = found.nadir
    return (
        "status:           found\n"
        f"edges:            {len(found.seen.points)} found\n"
        f"nadir x, y, z:    {x:+.5f} {y:+.5f} {z:+.5f}\n"
        f"from boresight:   {values['from_boresight_deg']:.3f} deg, "
        f"towards {values['towards_deg']:.3f} deg from right to down\n"
        f"circle:           centre {circle.centre[0]:.1f}, {circle.centre[1]:.1f} px,"
        f" radius {circle.radius:.1f} px\n"
        f"1 sigma:          the method {method} gives none\n"
    )
