"""Errors of attitudes and rates as the thesis defines them (Sease 3.28, 3.29)."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import angle_between, attitude_matrix, conjugate, multiply


def field_fraction(rate: FloatArray, exposure: float, field_of_view: float) -> float:
    """Return the rotation during the exposure, relative to the field of view (3.28)."""
    return float(np.linalg.norm(rate)) * exposure / field_of_view


def error_in_pixels(angle: float, resolution: int, field_of_view: float) -> float:
    """Return an angular error (rad) in px, for a camera with `resolution` px across its field, rad (3.29)."""
    return angle * resolution / field_of_view


def attitude_error(estimate: FloatArray, truth: FloatArray) -> tuple[float, float]:
    """Return the total error and the error across the boresight (rad) of an attitude (4,).

    The total error is the rotation angle from truth to estimate. The error across the boresight is the angle
    between the true and the estimated boresight. It excludes the rotation about the boresight, which is about
    ten times less accurate in a narrow field.
    """
    difference = multiply(estimate, conjugate(truth))
    boresight = attitude_matrix(difference)[:, 2]
    across = np.arctan2(np.hypot(boresight[0], boresight[1]), boresight[2])
    return float(angle_between(estimate, truth)), float(across)
