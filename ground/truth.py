"""The truth beside a rendered picture of the sky, as plain numbers for a JSON file."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.errors import UsageError
from knightcube.vision.startracker.sky_map import Pointing


def sky_truth(rate: FloatArray, exposure: float, attitude: FloatArray, focal_length: float) -> dict[str, Any]:
    """Return the truth of a frame that was exposed for `exposure` s.

    `rate` (3,) rad/s is in camera axes, `attitude` (4,) ICRS into camera at the middle of the exposure,
    `focal_length` in px.
    """
    pointing = Pointing.of(attitude)
    return {
        "rate_rad_s": [float(component) for component in rate],
        "exposure_s": exposure,
        "attitude": [float(component) for component in attitude],
        "right_ascension_deg": math.degrees(pointing.right_ascension),
        "declination_deg": math.degrees(pointing.declination),
        "roll_deg": math.degrees(pointing.roll),
        "streak_px": float(np.hypot(rate[0], rate[1])) * exposure * focal_length,
    }


def write_truth(path: Path, truth: dict[str, Any]) -> None:
    """Write a truth as JSON. Raises UsageError."""
    try:
        path.write_text(json.dumps(truth, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror or error}") from error
