"""What both estimators check before and after a frame: arguments, frames without a scene, the sense of time.

One frame cannot distinguish omega from -omega; a prior (gyro, or the last estimate) decides.
"""

from __future__ import annotations

import zlib
from dataclasses import replace
from typing import TypeVar

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.errors import FlightError
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import FrameState, frame_state
from knightcube.vision.streaks.streak_result import FrameMotion, StreakStatus

Result = TypeVar("Result", bound=FrameMotion)


def validate(
    pixels: Image, pinhole: Pinhole, exposure: float, prior_rate: FloatArray | None, prior_sigma: float
) -> None:
    """Raise FlightError for an impossible frame, exposure (s) or prior (rad/s)."""
    expected = (pinhole.rows, pinhole.columns)
    if pixels.shape != expected:
        raise FlightError(f"frame of shape {pixels.shape}, the camera has {expected}: set the camera's size")
    if not np.issubdtype(pixels.dtype, np.unsignedinteger):
        raise FlightError(
            f"frame of {pixels.dtype}: pixels must be unsigned integers, as the camera gave them"
        )
    if not (np.isfinite(exposure) and exposure > 0.0):
        raise FlightError(f"exposure of {exposure} s: must be finite and positive")
    if prior_rate is not None and not (np.shape(prior_rate) == (3,) and np.all(np.isfinite(prior_rate))):
        raise FlightError(f"prior rate {prior_rate}: must be three finite values in rad/s, or None")
    if not prior_sigma >= 0.0:
        raise FlightError(f"prior sigma {prior_sigma} rad/s: must not be negative or NaN")


def admit(
    pixels: Image, previous_checksum: int | None, saturation: float, saturated_fraction: float
) -> tuple[int, StreakStatus | None]:
    """Return the checksum of `pixels`, and why they show no scene: black, saturated, frozen; None if they do.

    Pixels equal to the previous frame's mean a frozen camera: no two exposures have the same noise.
    """
    checksum = zlib.crc32(pixels.tobytes())
    state = frame_state(pixels, saturation, saturated_fraction)
    if state is not FrameState.USABLE:
        return checksum, StreakStatus(state.value)
    return checksum, StreakStatus.FROZEN if checksum == previous_checksum else None


def in_time(result: Result, prior_rate: FloatArray | None, prior_sigma: float, sigmas: float) -> Result:
    """Return an ambiguous `result` in the direction of time that the prior gives it, where it is sure."""
    if result.rate is None or prior_rate is None:
        return result
    sign = direction_of_time(result.rate, np.asarray(prior_rate, dtype=float), prior_sigma, sigmas)
    if sign == 0:
        return result
    return replace(result if sign > 0 else result.reversed(), status=StreakStatus.RATE)


def direction_of_time(rate: FloatArray, prior_rate: FloatArray, prior_sigma: float, sigmas: float) -> int:
    """Return the sign (+1, -1) that a prior gives `rate` (3,), or 0 when it is too weak.

    The prior's projection on the axis decides where it exceeds `sigmas` times its deviation `prior_sigma`.
    """
    projection = float(rate @ prior_rate / np.linalg.norm(rate))
    if abs(projection) <= sigmas * prior_sigma:
        return 0
    return 1 if projection > 0.0 else -1
